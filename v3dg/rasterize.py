"""Draws gaussians without levels of detail: projects, bins and blends them.
Differentiable for torch tensors."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Any, Protocol, cast

import numpy as np

from v3dg import _core, _device
from v3dg._numbers import check_type, color, real
from v3dg.cameras import Camera
from v3dg.gaussians import Array, Gaussians
from v3dg.image import Image
from v3dg.io import loaded

if TYPE_CHECKING:
    import torch


def rasterize(
    gaussians: Gaussians | str | os.PathLike[str],
    camera: Camera,
    *,
    filter_px2: float = 0.0,
    antialiased: bool | None = None,
    background: Sequence[float] = (0.0, 0.0, 0.0),
) -> Image:
    """Draw gaussians as defined by 3D Gaussian Splatting and implemented by gsplat 1.5.

    Alpha is clamped to 0.999, and contributions below 1/255 are skipped. Gaussians are
    blended by ascending depth, and by index where depths are equal. A pixel stops
    before its transmittance would fall to 1e-4.

    With torch tensors the picture is differentiable with respect to the gaussians'
    means, quats, scales, opacities and sh, and to `background` if that is a tensor;
    float64 tensors on the CPU are computed in float64. Tensors on a CUDA device are
    drawn there, on its current stream. Pictures and gradients are the same in every
    run.

    Args:
        gaussians: N gaussians in world space, or the path of an asset's file.
        camera: Camera of any model.
        filter_px2: Variance of the low-pass filter in screen space, px². The original
            code of 3DGS trains with 0.3.
        antialiased: Whether to multiply opacities by the square root of det(covariance)
            before / after the filter (Mip-Splatting, eq. 9), so that the filter widens
            a gaussian without increasing its total opacity. None uses
            `Gaussians.antialiased`.
        background: Three numbers, or a tensor of three.

    Raises:
        ValueError: The filter is negative, the background is not three numbers, or the
            gaussians are float64 on a CUDA device.
        RuntimeError: The gaussians are on a CUDA device, and v3dg was built without
            CUDA.
    """
    gaussians = loaded(gaussians)
    # Any object with the same arrays as Gaussians is accepted.
    if not hasattr(gaussians, "means"):
        check_type("gaussians", gaussians, Gaussians, "Gaussians")
    check_type("camera", camera, Camera, "a Camera")
    filter_px2 = real(filter_px2, "filter_px2", "a variance of at least 0 px²", 0)
    background_color = color(background, "background")
    if antialiased is None:
        antialiased = bool(getattr(gaussians, "antialiased", None))
    check_type("antialiased", antialiased, bool, "True, False or None")
    means = gaussians.means
    if isinstance(means, np.ndarray):
        drawn = _core.rasterize(
            gaussians.rows,
            camera.core,
            filter_px2=filter_px2,
            antialiased=antialiased,
            background=background_color,
            with_depth=True,
            keep_tape=False,
        )
        return Image(drawn.color, drawn.alpha, drawn.depth)
    import torch

    check_device(means)
    arrays = [means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh]
    arrays.append(torch.as_tensor(background, dtype=means.dtype))
    settings = DrawSettings(filter_px2=filter_px2, antialiased=antialiased)
    return Image(*draw_views([camera.core], settings, [[array] for array in arrays]))


def check_device(means: Array) -> None:
    """Raise an error unless tensors of this dtype can be drawn on their device."""
    if means.is_cuda and not _core.has_cuda:
        raise RuntimeError(
            f"gaussians: {_device.missing_for_cuda()}, or move the tensors to the CPU"
        )
    if means.is_cuda and str(means.dtype) == "torch.float64":
        advice = "move the tensors to the CPU, or use float32"
        raise ValueError(f"gaussians: float64 is supported only on the CPU; {advice}")


def joined(parts: Sequence[torch.Tensor]) -> torch.Tensor:
    """Return stacked tensors; a single tensor is not copied."""
    import torch

    if len(parts) == 1:
        return parts[0].unsqueeze(0)
    return torch.stack(list(parts))


@dataclass(frozen=True)
class DrawSettings:
    """Arguments of `_core.rasterize`."""

    filter_px2: float
    antialiased: bool
    with_depth: bool = True
    plain_colors: bool = False  # whether sh contains colours instead of coefficients


@dataclass(eq=False)
class CenterGradient:
    """The gradient with respect to the centres on the images. The backward pass sets
    it."""

    value: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class CenterProbe:
    """Receives the gradient of pictures with respect to the image positions of
    gaussians' centres.

    Attributes:
        centers: Centres (V, N, 2)[pairs] for V views and N gaussians. Their values are
            not used; they exist so that autograd provides their gradient.
        pairs: The index that selects the rows in `centers`.
        with_sizes: Whether `centers.absgrad` becomes the sum over pixels of absolute
            gradients.
        gradient: Receives the gradient with respect to `centers`. It is a separate
            object, because the operation that made the centres keeps a reference to it;
            a reference to the centres themselves would be a cycle.
    """

    centers: torch.Tensor
    pairs: tuple[torch.Tensor, torch.Tensor] | EllipsisType
    with_sizes: bool
    gradient: CenterGradient


def draw_views(
    cameras: Sequence[_core.Camera],
    settings: DrawSettings,
    inputs: Sequence[Sequence[torch.Tensor]],
    probe: CenterProbe | None = None,
) -> tuple[torch.Tensor, ...]:
    """Draw tensors differentiably. Return colour, alpha and depth (or None) of the
    first view, then those of the next view, and so on.

    Args:
        cameras: V cameras.
        inputs: For each of means, quats, scales, opacities, sh and backgrounds: one
            tensor, or several that are assigned to the views cyclically.
        probe: Receives the gradient with respect to the centres on the images.
    """
    import torch

    tensors = [tensor for group in inputs for tensor in group]
    keep_tape = torch.is_grad_enabled() and any(tensor.requires_grad for tensor in tensors)
    counts = [len(group) for group in inputs]
    centers = None
    if probe is not None:
        centers = probe.centers
    return tuple(_function()(cameras, settings, keep_tape, counts, probe, centers, *tensors))


def _slots_of_view(counts: list[int], view: int) -> list[int]:
    """Return, for each kind of input, the index (among all tensors) of the tensor that
    a view uses."""
    return [sum(counts[:kind]) + view % count for kind, count in enumerate(counts)]


def _to_core(gradient: torch.Tensor | None) -> Array | None:
    if gradient is None:
        return None
    gradient = gradient.detach().contiguous()
    if gradient.is_cuda:
        return gradient
    return gradient.numpy()


def _draw_view(
    camera: _core.Camera, settings: DrawSettings, inputs: Sequence[torch.Tensor], *, keep_tape: bool
) -> tuple[list[torch.Tensor | None], _core.Tape | None]:
    """Return colour, alpha and depth of one view, and the data for its backward
    pass."""
    import torch

    *arrays, background = (tensor.detach() for tensor in inputs)
    drawn = _core.rasterize(
        Gaussians(*arrays).rows,
        camera,
        filter_px2=settings.filter_px2,
        antialiased=settings.antialiased,
        background=background.tolist(),
        with_depth=settings.with_depth,
        keep_tape=keep_tape,
        plain_colors=settings.plain_colors,
    )
    planes: list[torch.Tensor | None] = []
    for plane in (drawn.color, drawn.alpha, drawn.depth):
        if plane is None:
            planes.append(None)
        else:
            planes.append(torch.as_tensor(plane))
    return planes, drawn.tape


def _add_to(sums: list[torch.Tensor | None], slot: int, gradient: torch.Tensor) -> None:
    total = sums[slot]
    if total is None:
        sums[slot] = gradient
    else:
        sums[slot] = total.add_(gradient)


def _set_probe(probe: CenterProbe, gradients: list[list[torch.Tensor]]) -> torch.Tensor:
    """Store and return the gradient with respect to the centres, given that of each
    view. Also store the sums of absolute gradients, if requested."""
    d_centers, *sizes = (joined(parts)[probe.pairs] for parts in zip(*gradients, strict=True))
    probe.gradient.value = d_centers
    if probe.with_sizes:
        cast(Any, probe.centers).absgrad = sizes[0]
    return d_centers


def _input_parts(gradients: _core.Gradients) -> list[Array]:
    """Return the gradients with respect to the inputs of `draw_views`, in their
    order."""
    return [
        gradients.means,
        gradients.quats,
        gradients.scales,
        gradients.opacities,
        gradients.sh,
        gradients.background,
    ]


def _center_parts(gradients: _core.Gradients) -> list[torch.Tensor]:
    """Return the gradients with respect to the centres and, if requested, the sums of
    absolute gradients."""
    import torch

    parts = (gradients.centers, gradients.center_sizes)
    return [torch.as_tensor(part) for part in parts if part is not None]


class _Context(Protocol):
    """The data that autograd stores between the forward and the backward pass."""

    counts: list[int]
    probe: CenterProbe | None
    tapes: list[_core.Tape]
    devices: list[torch.device]
    needs_input_grad: tuple[bool, ...]
    saved_tensors: tuple[torch.Tensor, ...]

    def save_for_backward(self, *tensors: torch.Tensor | None) -> None: ...
    def set_materialize_grads(self, value: bool, /) -> None: ...


def _forward(
    ctx: _Context,
    cameras: Sequence[_core.Camera],
    settings: DrawSettings,
    inputs: Sequence[torch.Tensor],
    *,
    keep_tape: bool,
) -> tuple[torch.Tensor | None, ...]:
    """Return the planes of the pictures of all cameras, one picture after another."""
    pictures: list[torch.Tensor | None] = []
    for view, camera in enumerate(cameras):
        inputs_of_view = [inputs[slot] for slot in _slots_of_view(ctx.counts, view)]
        planes, tape = _draw_view(camera, settings, inputs_of_view, keep_tape=keep_tape)
        if tape is not None:
            ctx.tapes.append(tape)
        pictures += planes
    # On a GPU, the backward pass reads the inputs again, so autograd must detect if
    # they were overwritten.
    if inputs[0].is_cuda:
        ctx.save_for_backward(*inputs[: -ctx.counts[-1]], *pictures)
    return tuple(pictures)


def _backward(
    ctx: _Context, gradients: Sequence[torch.Tensor | None]
) -> tuple[torch.Tensor | None, ...]:
    """Return the gradients with respect to the centres and then to all inputs."""
    import torch

    _ = ctx.saved_tensors  # raises an error if a saved tensor was overwritten
    wants_centers, *wants_input = ctx.needs_input_grad[5:]
    probe = ctx.probe
    with_sizes = probe is not None and probe.with_sizes
    sums: list[torch.Tensor | None] = [None] * len(wants_input)
    center_gradients: list[list[torch.Tensor]] = []
    for view, tape in enumerate(ctx.tapes):
        d_color, d_alpha, d_depth = map(_to_core, gradients[3 * view : 3 * view + 3])
        parts = _core.rasterize_backward(tape, d_color, d_alpha, d_depth, wants_centers, with_sizes)
        center_gradients.append(_center_parts(parts))
        slots = _slots_of_view(ctx.counts, view)
        for slot, part in zip(slots, _input_parts(parts), strict=True):
            if wants_input[slot]:
                _add_to(sums, slot, torch.as_tensor(part).to(ctx.devices[slot]))
    d_centers = None
    if wants_centers and probe is not None:
        d_centers = _set_probe(probe, center_gradients)
    return d_centers, *sums


@functools.cache
def _function() -> Callable[..., tuple[torch.Tensor, ...]]:
    """Return the differentiable operation for torch tensors on any device."""
    import torch

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: _Context,
            cameras: Sequence[_core.Camera],
            settings: DrawSettings,
            keep_tape: bool,
            counts: list[int],
            probe: CenterProbe | None,
            *tensors: torch.Tensor,
        ) -> tuple[torch.Tensor | None, ...]:
            # The first tensor, the centres, is only used in the backward pass.
            inputs = tensors[1:]
            ctx.set_materialize_grads(False)
            ctx.counts = counts
            ctx.probe = probe
            ctx.tapes = []
            ctx.devices = [tensor.device for tensor in inputs]
            return _forward(ctx, cameras, settings, inputs, keep_tape=keep_tape)

        @staticmethod
        def backward(
            ctx: _Context, *gradients: torch.Tensor | None
        ) -> tuple[torch.Tensor | None, ...]:
            return None, None, None, None, None, *_backward(ctx, gradients)

    return Rasterize.apply
