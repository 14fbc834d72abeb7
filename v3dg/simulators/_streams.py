"""The order of torch's and warp's work on a CUDA device."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import warp


@contextmanager
def torch_in_order(device: warp.Device) -> Iterator[None]:
    """Order torch's work in this context after warp's earlier work and before warp's
    later work, without waiting on the host. On the CPU, do nothing."""
    if not device.is_cuda:
        yield
        return
    import torch

    place = warp.device_to_torch(device)
    torch_stream = warp.stream_from_torch(torch.cuda.current_stream(place))
    warp_stream = warp.get_stream(device)
    torch_stream.wait_stream(warp_stream)
    yield
    warp_stream.wait_stream(torch_stream)
