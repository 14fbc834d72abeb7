"""Arrays on either device, for tests that run on both: NumPy arrays on the CPU, and
torch tensors on CUDA."""

import contextlib

import numpy as np

from v3dg import Gaussians


def on(device, value):
    """Return the array or the gaussians on `device`. A tuple or a list of these becomes
    a tuple."""
    if isinstance(value, (tuple, list)):
        return tuple(on(device, v) for v in value)
    if device == "cpu":
        return value.numpy() if isinstance(value, Gaussians) else host(value)
    import torch

    if isinstance(value, Gaussians):
        return value.torch(device)
    if isinstance(value, np.ndarray):
        value = torch.from_numpy(np.array(value))
    return value.to(device)


def host(value):
    """Return an array, gaussians, or a tuple or list of these, as NumPy arrays."""
    if isinstance(value, (tuple, list)):
        return tuple(host(v) for v in value)
    if isinstance(value, Gaussians):
        return value.numpy()
    return value if isinstance(value, np.ndarray) else value.detach().cpu().numpy()


@contextlib.contextmanager
def free_memory(num_bytes):
    """Leave at most this much memory of the GPU free."""
    import torch

    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    # The first allocation can fail, because the driver takes memory of its own for it.
    for attempt in range(3):
        free = torch.cuda.mem_get_info()[0]
        with contextlib.suppress(torch.OutOfMemoryError):
            rest = torch.empty(max(0, free - num_bytes), dtype=torch.uint8, device="cuda")
            break
        assert attempt < 2, "could not take the memory of the GPU"
    try:
        yield
    finally:
        del rest
        torch.cuda.empty_cache()
