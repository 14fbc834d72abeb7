"""Draw gaussians as they are: project, bin, blend; differentiable on torch tensors."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg import _core, _device
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians

if TYPE_CHECKING:
    from collections.abc import Sequence


@dataclass(frozen=True, eq=False)
class Raster:
    """A picture of H x W pixels, of the same kind of arrays as the gaussians it was drawn from.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn.
    """

    color: Any
    alpha: Any
    depth: Any


def rasterize(
    gaussians: Gaussians,
    camera: Camera,
    *,
    filter_px2: float = 0.0,
    antialiased: bool = False,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Raster:
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
    if not filter_px2 >= 0:
        raise ValueError(f"filter_px2: expected a variance of at least 0 px², got {filter_px2}")
    if len(background) != 3:
        raise ValueError(f"background: expected three numbers, got {len(background)}")
    options = (float(filter_px2), bool(antialiased), intrinsics(camera), camera.width, camera.height)
    if isinstance(gaussians.means, np.ndarray):
        model = _core.Model(*rows_of(gaussians))
        color, alpha, depth, _, _ = _core.rasterize(
            model, view_of_world(camera), *options, [float(b) for b in background], True, False
        )
        return Raster(color, alpha, depth)
    return _rasterize_torch(gaussians, camera, options, background)


def rows_of(gaussians: Gaussians) -> tuple[Any, Any, Any, Any, Any]:
    """The five arrays, in the order in which the core takes them."""
    g = gaussians
    return g.means, g.quats, g.scales, g.opacities, g.sh


def intrinsics(camera: Camera) -> list[float]:
    """Focal lengths, principal point and near depth, in the order in which the core takes them."""
    k = camera.K
    return [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2]), float(camera.near)]


def view_of_world(camera: Camera) -> Any:
    """(15,) world to view for the core: linear part, translation, the eye in the world."""
    v = np.asarray(camera.viewmat, np.float64)
    return np.concatenate([v[:3, :3].ravel(), v[:3, 3], -v[:3, :3].T @ v[:3, 3]])


def _rasterize_torch(
    gaussians: Gaussians, camera: Camera, options: tuple[float, bool, list[float], int, int], background: Any
) -> Raster:
    import torch

    rows = rows_of(gaussians)
    bg = torch.as_tensor(background, dtype=rows[0].dtype)
    draw = _draw_on_cuda if rows[0].is_cuda else _draw_on_cpu
    needs_tape = torch.is_grad_enabled() and any(t.requires_grad for t in (*rows, bg))
    return Raster(*draw(rows, bg, view_of_world(camera), options, needs_tape))


def _draw_on_cpu(
    rows: tuple[Any, ...], bg: Any, view: Any, options: tuple[float, bool, list[float], int, int], tape: bool
) -> Any:
    import torch

    model_type = _core.ModelDouble if rows[0].dtype == torch.float64 else _core.Model

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, *tensors: Any) -> Any:
            arrays = [np.ascontiguousarray(t.detach().numpy()) for t in tensors[:5]]
            *out, _, ctx.tape = _core.rasterize(
                model_type(*arrays), view, *options, tensors[5].tolist(), True, tape
            )
            return tuple(torch.from_numpy(o) for o in out)

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            arrays = [np.ascontiguousarray(g.detach().numpy()) for g in gradients]
            return tuple(torch.from_numpy(g) for g in _core.rasterize_backward(ctx.tape, *arrays))

    apply: Any = Rasterize.apply
    return apply(*rows, bg)


def _draw_on_cuda(
    rows: tuple[Any, ...], bg: Any, view: Any, options: tuple[float, bool, list[float], int, int], tape: bool
) -> Any:
    import torch

    if not _core.has_cuda:
        raise RuntimeError(f"gaussians: {_device.missing_for_cuda()}; or call gaussians.torch('cpu')")
    if rows[0].dtype == torch.float64:
        raise ValueError(
            "gaussians: float64 is computed on the CPU only; call gaussians.torch('cpu'), or use float32"
        )
    with torch.cuda.device(rows[0].device):
        return _cuda_function().apply(view, options, tape, *rows, bg)


@functools.cache
def _cuda_function() -> Any:
    import torch

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, view: Any, options: Any, tape: bool, *tensors: Any) -> Any:
            ctx.set_materialize_grads(False)
            filter_px2, antialiased, k, width, height = options
            inputs = tuple(_device.aligned(t.detach()) for t in tensors[:5])
            new = inputs[0].new_empty
            picture = new((height, width, 3)), new((height, width)), new((height, width))
            stream = _device.current_stream()
            bg = tensors[5].tolist()
            kept = _core.rasterize_cuda(inputs, view, filter_px2, antialiased, k, bg, picture, stream)
            if tape:
                ctx.tape, ctx.inputs, ctx.background_device = kept, inputs, tensors[5].device
                ctx.save_for_backward(*tensors[:5], *picture)
            return picture

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            # Reading them complains of what was written to since.
            pictures = ctx.saved_tensors[5:]
            d_color, d_alpha = (
                torch.zeros_like(p) if g is None else g.contiguous()
                for p, g in zip(pictures[:2], gradients[:2], strict=True)
            )
            d_depth = None if gradients[2] is None else gradients[2].contiguous()
            out = tuple(torch.empty_like(t) for t in ctx.inputs)
            d_background = d_color.new_empty(3)
            with torch.cuda.device(d_color.device):
                stream = _device.current_stream()
                _core.rasterize_backward_cuda(ctx.tape, d_color, d_alpha, d_depth, out, d_background, stream)
            if ctx.needs_input_grad[8]:
                return None, None, None, *out, d_background.to(ctx.background_device)
            return None, None, None, *out, None

    return Rasterize
