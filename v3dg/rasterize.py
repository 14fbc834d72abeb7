"""Draw gaussians as they are: project, bin, blend; differentiable on torch tensors."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg import _core, _device
from v3dg._numbers import color, real
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.image import Image

if TYPE_CHECKING:
    from collections.abc import Sequence


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    filter_px2: float = 0.0,
    antialiased: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Image:
    """Draw gaussians with the meaning of 3D Gaussian Splatting, as gsplat 1.5 defines it.

    Alpha is cut at 0.999, contributions below 1/255 are skipped, a pixel stops before its transmittance would
    fall to 1e-4, and gaussians are blended in the order of their depth, equal depths by index.

    On torch tensors the picture is differentiable with respect to the gaussians' means, quats, scales,
    opacities and sh, and to `background` when that is a tensor; float64 tensors on the CPU are computed in
    float64. Tensors on a CUDA device are drawn there, on its current stream. Pictures and gradients are the
    same on every run.

    Args:
        gaussians: N gaussians in world space.
        camera: Pinhole camera.
        filter_px2: Variance of the low-pass filter in screen space, px²; 0.3 draws assets that were trained
            with the original 3DGS code as they were trained.
        antialiased: Scale opacities by sqrt(det before / det after the filter) (Mip-Splatting, eq. 9), so
            that the filter spreads a gaussian without adding to it.
        background: Three numbers, or a tensor of them.

    Raises:
        ValueError: The filter is negative, the background is not three numbers, or the gaussians are float64
            on a CUDA device.
        RuntimeError: The gaussians are on a CUDA device, and v3dg was built without CUDA.
    """
    options: dict[str, Any] = {
        "filter_px2": real(filter_px2, "filter_px2", "a variance of at least 0 px²", 0),
        "antialiased": bool(antialiased),
        "with_depth": True,
    }
    shade = color(background, "background")
    if isinstance(gaussians.means, np.ndarray):
        planes = _core.rasterize(gaussians.rows, camera.core, background=shade, keep_tape=False, **options)
        return Image(*planes[:3])
    return _rasterize_torch(gaussians, camera, options, background)


def _rasterize_torch(gaussians: Gaussians, camera: Camera, options: dict[str, Any], background: Any) -> Image:
    import torch

    means = gaussians.means
    if means.is_cuda and not _core.has_cuda:
        raise RuntimeError(f"gaussians: {_device.missing_for_cuda()}; or call gaussians.torch('cpu')")
    if means.is_cuda and means.dtype == torch.float64:
        advice = "call gaussians.torch('cpu'), or use float32"
        raise ValueError(f"gaussians: float64 is computed on the CPU only; {advice}")
    arrays = (gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh)
    shade = torch.as_tensor(background, dtype=means.dtype)
    keep_tape = torch.is_grad_enabled() and any(t.requires_grad for t in (*arrays, shade))
    return Image(*_function().apply(camera.core, {**options, "keep_tape": keep_tape}, *arrays, shade))


@functools.cache
def _function() -> Any:
    """The operation and its gradient, for torch's tensors on any device."""
    import torch

    def to_core(gradient: Any) -> Any:
        gradient = gradient.detach().contiguous()
        return gradient if gradient.is_cuda else gradient.numpy()

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, camera: Any, options: dict[str, Any], *tensors: Any) -> Any:
            ctx.set_materialize_grads(False)
            rows = Gaussians(*(t.detach() for t in tensors[:5])).rows
            *planes, _, tape = _core.rasterize(rows, camera, background=tensors[5].tolist(), **options)
            picture = tuple(torch.as_tensor(plane) for plane in planes)
            ctx.tape, ctx.background_device = tape, tensors[5].device
            if tensors[0].is_cuda:  # backward reads them again, and so has to know of what is written to
                ctx.save_for_backward(*tensors[:5], *picture)
            return picture

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            _ = ctx.saved_tensors  # complains of what was written to since
            d_color, d_alpha, d_depth = (None if g is None else to_core(g) for g in gradients)
            *out, d_background = _core.rasterize_backward(ctx.tape, d_color, d_alpha, d_depth)
            background = torch.as_tensor(d_background).to(ctx.background_device)
            return None, None, *(torch.as_tensor(d) for d in out), background

    return Rasterize
