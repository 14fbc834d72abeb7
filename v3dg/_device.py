"""Where work runs: on the CPU, with NumPy arrays, or on a CUDA device, with torch tensors."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from typing import Any, Literal, TypeVar

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.gaussians import Array, Gaussians

_T = TypeVar("_T")
_MUCH_MEMORY = 1 << 30


def resolve(device: str) -> Literal["cpu", "cuda"]:
    """The device that "auto", "cpu" or "cuda" stands for; "auto" is CUDA where nothing is missing for it.

    Raises:
        ValueError: It is none of the three.
        RuntimeError: It is "cuda", and something is missing; never another device in its place.
    """
    if device not in ("auto", "cpu", "cuda"):
        raise ValueError(f"device: expected 'auto', 'cpu' or 'cuda', got {device!r}")
    if device == "cpu":
        return "cpu"
    missing = missing_for_cuda()
    if missing is None:
        return "cuda"
    if device == "cuda":
        raise RuntimeError(f"device: {missing}; or use 'cpu'")
    return "cpu"


def missing_for_cuda() -> str | None:
    """What has to be done before CUDA can be used; None where it can."""
    if not _core.has_cuda:
        return "v3dg was built without CUDA; install it again where nvcc is found"
    if _core.num_cuda_devices() == 0:
        return "expected a CUDA device and its driver, found none"
    try:
        import torch
    except ImportError:
        return "expected torch, which owns arrays on CUDA devices; pip install 'v3dg[torch]'"
    if not torch.cuda.is_available():
        return (
            f"expected a torch that can use the CUDA device, got {torch.__version__}; install one with CUDA"
        )
    return None


def describe(device: Literal["cpu", "cuda"]) -> str:
    """What of a device the last bits of results depend on."""
    if device == "cpu":
        return _core.isa()
    import torch

    return str(torch.cuda.get_device_name())


def of(array: Array) -> Any:
    """Where an array is: "cpu" for NumPy's, else its torch device."""
    return "cpu" if isinstance(array, np.ndarray) else array.device


def place(gaussians: Gaussians, device: Any) -> Gaussians:
    """The gaussians as NumPy arrays ("cpu") or as tensors on a CUDA device, without gradients.

    "cuda" is the device that they are on, if it is one, else the current one.
    """
    if device == "cpu":
        return gaussians.numpy()
    is_there = device == "cuda" and str(of(gaussians.means)).startswith("cuda")
    there = gaussians.torch(None if is_there else device)
    return Gaussians(*(getattr(there, field.name).detach() for field in fields(there)))


def current_device() -> int:
    """Torch's current CUDA device."""
    import torch

    return int(torch.cuda.current_device())


def current_stream() -> int:
    """The stream of that device that torch's work, and so ours, is enqueued on."""
    import torch

    return int(torch.cuda.current_stream().cuda_stream)


def is_capturing() -> bool:
    """Whether a CUDA graph is being captured on that stream."""
    import torch

    return bool(torch.cuda.is_current_stream_capturing())


def aligned(tensor: Any) -> Any:
    """The tensor, contiguous, where the core can read it in words of 16 bytes."""
    tensor = tensor.contiguous()
    return tensor if tensor.data_ptr() % 16 == 0 else tensor.clone()


def library_of(array: Array) -> Any:
    """numpy or torch; many functions have the same names and arguments in both."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def like(values: Any, array: Array) -> Array:
    """Values as an array of the same kind, type and device as another."""
    if isinstance(array, np.ndarray):
        return np.asarray(values, array.dtype)
    import torch

    return torch.as_tensor(values, dtype=array.dtype, device=array.device)


def to_host(array: Array) -> npt.NDArray[Any]:
    """The array as one of NumPy's."""
    host: npt.NDArray[Any] = array if isinstance(array, np.ndarray) else array.cpu().numpy()
    return host


def copy_to_host(array: Array, out: npt.NDArray[Any]) -> None:
    """Copy an array from any device into one of NumPy's."""
    if isinstance(array, np.ndarray):
        np.copyto(out, array)
    else:
        import torch

        torch.from_numpy(out).copy_(array)


@contextmanager
def memory_errors() -> Iterator[None]:
    """Turn torch's error about missing device memory into what the core raises, MemoryError."""
    try:
        yield
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":
            raise
        raise MemoryError(str(error)) from error


def with_this_stream(work: Callable[[_T], None], device: Any) -> Callable[[_T], None]:
    """The same work on this thread's stream, whatever thread it will run on."""
    if device == "cpu":
        return work
    import torch

    stream = torch.cuda.current_stream(device)

    def on_stream(argument: _T) -> None:
        with torch.cuda.stream(stream):
            work(argument)

    return on_stream


def spare_memory(device: Any) -> None:
    """Have torch give back what it keeps for later, where that is much: the core cannot use it."""
    if device == "cpu":
        return
    import torch

    if torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device) > _MUCH_MEMORY:
        torch.cuda.empty_cache()
