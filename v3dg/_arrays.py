"""Arrays on torch's current CUDA device, and the stream that work on them is enqueued on."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v3dg.gaussians import Gaussians


def current_device() -> int:
    import torch

    return int(torch.cuda.current_device())


def current_stream() -> int:
    import torch

    return int(torch.cuda.current_stream().cuda_stream)


def empty(shape: tuple[int, ...]) -> Any:
    """float32, not initialised."""
    import torch

    return torch.empty(shape, dtype=torch.float32, device="cuda")


def rows_on_device(gaussians: Gaussians) -> tuple[Any, ...]:
    """The five arrays as the core wants them: float32, quats and sh at a multiple of 16 bytes."""
    import torch

    g = gaussians.torch("cuda")
    rows = [r.detach().to(torch.float32) for r in (g.means, g.quats, g.scales, g.opacities, g.sh)]
    return tuple(r if r.data_ptr() % 16 == 0 else r.clone() for r in rows)
