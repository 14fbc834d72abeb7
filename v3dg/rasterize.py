"""Draw gaussians as they are: project, bin, blend; differentiable on torch tensors."""

import functools
import os
from collections.abc import Sequence
from typing import Any

import numpy as np

from v3dg import _core, _device
from v3dg._numbers import check_type, color, real
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.image import Image
from v3dg.io import loaded


def rasterize(
    gaussians: Gaussians | str | os.PathLike[str],
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
        gaussians: N gaussians in world space; or the file of an asset.
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
    gaussians = loaded(gaussians)
    if not hasattr(gaussians, "means"):  # whatever has their arrays will do
        check_type("gaussians", gaussians, Gaussians, "Gaussians")
    check_type("camera", camera, Camera, "a Camera")
    filter_px2 = real(filter_px2, "filter_px2", "a variance of at least 0 px²", 0)
    options: dict[str, Any] = {"filter_px2": filter_px2, "antialiased": bool(antialiased), "with_depth": True}
    shade = color(background, "background")
    if isinstance(gaussians.means, np.ndarray):
        planes = _core.rasterize(gaussians.rows, camera.core, background=shade, keep_tape=False, **options)
        return Image(*planes[:3])
    import torch

    check_device(gaussians.means)
    arrays = [getattr(gaussians, name) for name in ("means", "quats", "scales", "opacities", "sh")]
    arrays.append(torch.as_tensor(background, dtype=arrays[0].dtype))
    return Image(*draw_views([camera.core], options, [[array] for array in arrays]))


def check_device(means: Any) -> None:
    """Raise unless tensors like these can be drawn where they are."""
    if means.is_cuda and not _core.has_cuda:
        raise RuntimeError(f"gaussians: {_device.missing_for_cuda()}; or call gaussians.torch('cpu')")
    if means.is_cuda and str(means.dtype) == "torch.float64":
        advice = "call gaussians.torch('cpu'), or use float32"
        raise ValueError(f"gaussians: float64 is computed on the CPU only; {advice}")


def joined(parts: Sequence[Any]) -> Any:
    """Tensors stacked, a single one without a copy."""
    import torch

    return parts[0].unsqueeze(0) if len(parts) == 1 else torch.stack(list(parts))


def draw_views(cameras: Any, options: dict[str, Any], inputs: Any, centers: Any = None) -> tuple[Any, ...]:
    """Draw tensors; differentiable. Returns colour, alpha and depth (or None) of the first view, the next...

    Args:
        cameras: V, as the core takes them.
        options: What `_core.rasterize` takes besides.
        inputs: Means, quats, scales, opacities, sh, backgrounds: one tensor of each, or several that views
            take in turn.
        centers: A tensor; pairs; whether sizes are wanted; a dict. The tensor is where gaussians lie on the
            images, (V, N, 2)[pairs]. It passes on no gradient, but takes that of the pictures, which the dict
            gets as `centers`; its `absgrad` becomes the sum of the sizes of what pixels give to it.
    """
    import torch

    tensors = [tensor for group in inputs for tensor in group]
    keep_tape = torch.is_grad_enabled() and any(t.requires_grad for t in tensors)
    counts = [len(group) for group in inputs]
    options = {**options, "keep_tape": keep_tape}
    return tuple(_function().apply(cameras, options, counts, centers, centers and centers[0], *tensors))


@functools.cache
def _function() -> Any:
    """The operation and its gradient, for torch's tensors on any device."""
    import torch

    def to_core(gradient: Any) -> Any:
        gradient = gradient.detach().contiguous()
        return gradient if gradient.is_cuda else gradient.numpy()

    def slots_of(counts: list[int], view: int) -> list[int]:
        return [sum(counts[:k]) + view % count for k, count in enumerate(counts)]

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, cameras: Any, options: Any, counts: Any, centers: Any, *tensors: Any) -> Any:
            ctx.set_materialize_grads(False)
            ctx.counts, ctx.tapes, pictures = counts, [], []
            ctx.centers = centers or (None, None, False, {})
            ctx.devices = [tensor.device for tensor in tensors[1:]]
            for view, camera in enumerate(cameras):
                *arrays, shade = (tensors[1 + slot].detach() for slot in slots_of(counts, view))
                rows = Gaussians(*arrays).rows
                *planes, _, tape = _core.rasterize(rows, camera, background=shade.tolist(), **options)
                ctx.tapes.append(tape)
                pictures += [None if plane is None else torch.as_tensor(plane) for plane in planes]
            if tensors[1].is_cuda:  # backward reads them again, and so has to know of what is written to
                ctx.save_for_backward(*tensors[1 : -counts[-1]], *pictures)
            return tuple(pictures)

        @staticmethod
        def backward(ctx: Any, *gradients: Any) -> Any:
            _ = ctx.saved_tensors  # complains of what was written to since
            wants_centers, *wanted = ctx.needs_input_grad[4:]
            sums: list[Any] = [None] * len(wanted)
            tensor, pairs, with_size, flow = ctx.centers
            of_views: list[Any] = []
            for view, tape in enumerate(ctx.tapes):
                planes = gradients[3 * view : 3 * view + 3]
                d_color, d_alpha, d_depth = (None if d is None else to_core(d) for d in planes)
                out = _core.rasterize_backward(tape, d_color, d_alpha, d_depth, wants_centers, with_size)
                of_views.append([torch.as_tensor(part) for part in out[6:] if part is not None])
                for slot, part in zip(slots_of(ctx.counts, view), out, strict=False):
                    if wanted[slot]:
                        part = torch.as_tensor(part).to(ctx.devices[slot])
                        sums[slot] = part if sums[slot] is None else sums[slot].add_(part)
            d_centers = None
            if wants_centers:
                d_centers, *sizes = (joined(parts)[pairs] for parts in zip(*of_views, strict=True))
                flow["centers"] = d_centers
                if with_size:
                    tensor.absgrad = sizes[0]
            return None, None, None, None, d_centers, *sums

    return Rasterize
