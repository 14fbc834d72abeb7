"""Draws gaussians without levels of detail: projects, bins and blends them. Drawing is
differentiable for torch tensors."""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, cast

import numpy as np

from v3dg import _core, _device
from v3dg._numbers import check_type, color, real
from v3dg.cameras import Camera
from v3dg.gaussians import Array, Gaussians
from v3dg.image import Image
from v3dg.io import loaded

if TYPE_CHECKING:
    import torch

_T = TypeVar("_T")


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

    With torch tensors, the picture is differentiable with respect to the gaussians'
    means, quats, scales, opacities and sh, and to `background` if that is a tensor.
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
    views = Views(cameras=(camera.core,), num_cameras=1)
    planes = draw_views(views, settings, [[array] for array in arrays])
    return Image(*(plane.squeeze(0) for plane in planes))


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
    """Return stacked tensors. A single tensor is not copied."""
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


@dataclass(frozen=True, eq=False)
class Views:
    """The cameras of S sets of gaussians. There are C cameras for each set, so V = S *
    C views in total.

    Attributes:
        cameras: The cameras of each set: either one camera of any model, which is
            faster than a batch of one, or C pinhole cameras whose arrays are on the
            CPU.
        num_cameras: C.
        viewmats: (V, 4, 4) tensor of the poses if they have gradients. The cameras must
            then be `_core.Cameras`.
    """

    cameras: tuple[_core.Camera | _core.Cameras, ...]
    num_cameras: int
    viewmats: torch.Tensor | None = None

    @property
    def num_views(self) -> int:
        return len(self.cameras) * self.num_cameras

    def inputs_of(self, group: Sequence[_T], number: int) -> Sequence[_T]:
        """Return the values for a set. There may be one value for all views, one for
        each set, or one for each view."""
        if len(group) == self.num_views > len(self.cameras):
            first = number * self.num_cameras
            return group[first : first + self.num_cameras]
        if len(group) == 1:
            return group
        return group[number : number + 1]


@dataclass(eq=False)
class CenterGradient:
    """Holds the gradient with respect to the centres on the images. The backward pass
    sets it."""

    value: torch.Tensor | None = None


@dataclass(frozen=True, eq=False)
class CenterProbe:
    """Receives the gradient of pictures with respect to the image positions of
    gaussians' centres.

    Attributes:
        centers: Centres (V, N, 2)[pairs] for V views and N gaussians, in any shape.
            Their values are not used. They exist so that autograd requests their
            gradient.
        pairs: The index that selects the rows in `centers`.
        with_sizes: Whether `centers.absgrad` becomes the sum over pixels of absolute
            gradients.
        gradient: Receives the gradient with respect to `centers`. It is a separate
            object, because the operation that made the centres keeps a reference to it.
            A reference to the centres themselves would be a cycle.
    """

    centers: torch.Tensor
    pairs: tuple[torch.Tensor, torch.Tensor] | EllipsisType
    with_sizes: bool
    gradient: CenterGradient


def draw_views(
    views: Views,
    settings: DrawSettings,
    inputs: Sequence[Sequence[torch.Tensor]],
    probe: CenterProbe | None = None,
) -> tuple[torch.Tensor, ...]:
    """Draw tensors differentiably. Return colour, alpha and depth (or None), (C, H, W,
    ...), of the first set, then those of the next set, and so on.

    Args:
        inputs: For each of means, quats, scales, opacities, sh and backgrounds, one
            tensor, or one for each set. The last three may also have one for each view.
        probe: Receives the gradient with respect to the centres on the images.
    """
    import torch

    tensors = [tensor for group in inputs for tensor in group]
    optional = [None, views.viewmats]
    if probe is not None:
        optional[0] = probe.centers
    keep_tape = torch.is_grad_enabled() and any(
        tensor is not None and tensor.requires_grad for tensor in (views.viewmats, *tensors)
    )
    call = _Call(
        views=Views(views.cameras, views.num_cameras),  # the poses are passed as tensors
        settings=settings,
        counts=[len(group) for group in inputs],
        keep_tape=keep_tape,
        probe=probe,
    )
    return tuple(_function()(call, *optional, *tensors))


@dataclass(frozen=True, eq=False)
class _Call:
    """The arguments of `draw_views` that are not tensors."""

    views: Views
    settings: DrawSettings
    counts: list[int]  # number of tensors for each kind of input
    keep_tape: bool
    probe: CenterProbe | None

    def slots_of_set(self, number: int) -> list[Sequence[int]]:
        """Return, for each kind of input, the indices (among all tensors) of the
        tensors that a set uses."""
        slots: list[Sequence[int]] = []
        first = 0
        for count in self.counts:
            slots.append(self.views.inputs_of(range(first, first + count), number))
            first += count
        return slots


def _to_core(gradient: torch.Tensor | None) -> Array | None:
    if gradient is None:
        return None
    gradient = gradient.detach().contiguous()
    if gradient.is_cuda:
        return gradient
    return gradient.numpy()


def _alone(plane: Array | None) -> Array | None:
    """Return the gradient (H, W, ...) of the only picture."""
    if plane is None:
        return None
    return plane[0]


def _draw_set(
    camera: _core.Camera | _core.Cameras,
    settings: DrawSettings,
    groups: Sequence[Sequence[torch.Tensor]],
    *,
    keep_tape: bool,
) -> tuple[list[torch.Tensor | None], _core.Tape | _core.ViewsTape | None]:
    """Return colour, alpha and depth of the pictures of one set, and the data for their
    backward pass."""
    *groups, backgrounds = ([tensor.detach() for tensor in group] for group in groups)
    count = max(len(group) for group in groups)
    rows = [
        Gaussians(*(group[view % len(group)] for group in groups)).rows for view in range(count)
    ]
    drawn: _core.Rasterized | _core.RasterizedViews
    if isinstance(camera, _core.Camera):
        drawn = _core.rasterize(
            rows[0],
            camera,
            filter_px2=settings.filter_px2,
            antialiased=settings.antialiased,
            background=backgrounds[0].tolist(),
            with_depth=settings.with_depth,
            keep_tape=keep_tape,
            plain_colors=settings.plain_colors,
        )
    else:
        drawn = _core.rasterize_views(
            rows,
            camera,
            filter_px2=settings.filter_px2,
            antialiased=settings.antialiased,
            backgrounds=joined(backgrounds).tolist(),
            with_depth=settings.with_depth,
            keep_tape=keep_tape,
            plain_colors=settings.plain_colors,
        )
    return _planes(drawn), drawn.tape


def _planes(drawn: _core.Rasterized | _core.RasterizedViews) -> list[torch.Tensor | None]:
    """Return colour, alpha and depth (C, H, W, ...) as tensors."""
    import torch

    planes: list[torch.Tensor | None] = []
    for plane in (drawn.color, drawn.alpha, drawn.depth):
        if plane is None:
            planes.append(None)
        elif isinstance(drawn, _core.Rasterized):
            planes.append(torch.as_tensor(plane).unsqueeze(0))
        else:
            planes.append(torch.as_tensor(plane))
    return planes


def _add_to(sums: list[torch.Tensor | None], slot: int, gradient: torch.Tensor) -> None:
    total = sums[slot]
    if total is None:
        sums[slot] = gradient
    else:
        sums[slot] = total.add_(gradient)


def _set_probe(probe: CenterProbe, gradients: list[list[torch.Tensor]]) -> torch.Tensor:
    """Store and return the gradient with respect to the centres, computed from that of
    each set. If requested, also store the sums of absolute gradients."""
    import torch

    of_centers: list[torch.Tensor] = []
    for parts in zip(*gradients, strict=True):
        whole = parts[0]
        if len(parts) > 1:
            whole = torch.cat(parts)
        of_centers.append(whole[probe.pairs].view(probe.centers.shape))
    d_centers, *sizes = of_centers
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
    """Return the gradients (C, N, 2) with respect to the centres and, if requested, the
    sums of absolute gradients."""
    import torch

    parts = (gradients.centers, gradients.center_sizes)
    tensors = [torch.as_tensor(part) for part in parts if part is not None]
    return [tensor[(None,) * (3 - tensor.ndim)] for tensor in tensors]


class _Context(Protocol):
    """The data that autograd stores between the forward and the backward pass."""

    call: _Call
    tapes: list[_core.Tape | _core.ViewsTape]
    devices: list[torch.device]
    pose: tuple[torch.device, torch.dtype]
    needs_input_grad: tuple[bool, ...]
    saved_tensors: tuple[torch.Tensor, ...]

    def save_for_backward(self, *tensors: torch.Tensor | None) -> None: ...
    def set_materialize_grads(self, value: bool, /) -> None: ...


def _forward(ctx: _Context, inputs: Sequence[torch.Tensor]) -> tuple[torch.Tensor | None, ...]:
    """Return the planes of the pictures of all sets, one set after another."""
    call = ctx.call
    pictures: list[torch.Tensor | None] = []
    for number, camera in enumerate(call.views.cameras):
        slots = call.slots_of_set(number)
        groups = [[inputs[slot] for slot in slots_of_kind] for slots_of_kind in slots]
        planes, tape = _draw_set(camera, call.settings, groups, keep_tape=call.keep_tape)
        if tape is not None:
            ctx.tapes.append(tape)
        pictures += planes
    # On a GPU, the backward pass reads the inputs again, so autograd must detect if
    # they were overwritten.
    if inputs[0].is_cuda:
        ctx.save_for_backward(*inputs[: -call.counts[-1]], *pictures)
    return tuple(pictures)


def _gradients_of_set(
    ctx: _Context, number: int, planes: Sequence[torch.Tensor | None], wants: Sequence[bool]
) -> _core.Gradients:
    """Run the backward pass of a set. `wants` has three flags, which request gradients
    of the centres, sums of their absolute values, and gradients of the poses."""
    tape = ctx.tapes[number]
    d_color, d_alpha, d_depth = map(_to_core, planes)
    if isinstance(tape, _core.Tape):
        return _core.rasterize_backward(
            tape, _alone(d_color), _alone(d_alpha), _alone(d_depth), wants[0], wants[1]
        )
    slots = ctx.call.slots_of_set(number)
    return _core.rasterize_views_backward(
        tape,
        d_color,
        d_alpha,
        d_depth,
        with_centers=wants[0],
        with_sizes=wants[1],
        with_poses=wants[2],
        opacities_for_each_view=len(slots[3]) > 1,
        sh_for_each_view=len(slots[4]) > 1,
    )


def _backward(
    ctx: _Context, gradients: Sequence[torch.Tensor | None]
) -> tuple[torch.Tensor | None, ...]:
    """Return the gradients with respect to the centres, to the poses, and then to all
    inputs."""
    import torch

    _ = ctx.saved_tensors  # raises an error if a saved tensor was overwritten
    wants_centers, wants_poses, *wants_input = ctx.needs_input_grad[1:]
    probe = ctx.call.probe
    wants = (wants_centers, probe is not None and probe.with_sizes, wants_poses)
    sums: list[torch.Tensor | None] = [None] * len(wants_input)
    center_gradients: list[list[torch.Tensor]] = []
    poses: list[torch.Tensor] = []
    for number in range(len(ctx.tapes)):
        parts = _gradients_of_set(ctx, number, gradients[3 * number : 3 * number + 3], wants)
        center_gradients.append(_center_parts(parts))
        if wants_poses:
            poses.append(torch.as_tensor(parts.poses))
        slots = ctx.call.slots_of_set(number)
        for slots_of_kind, part in zip(slots, _by_slot(parts, slots), strict=True):
            for slot, gradient in zip(slots_of_kind, part, strict=True):
                if wants_input[slot]:
                    _add_to(sums, slot, gradient.to(ctx.devices[slot]))
    d_centers = None
    if wants_centers and probe is not None:
        d_centers = _set_probe(probe, center_gradients)
    d_viewmats = None
    if wants_poses:
        device, dtype = ctx.pose
        d_viewmats = torch.nn.functional.pad(torch.cat(poses), (0, 0, 0, 1)).to(device, dtype)
    return d_centers, d_viewmats, *sums


def _by_slot(
    gradients: _core.Gradients, slots: Sequence[Sequence[int]]
) -> list[Sequence[torch.Tensor]]:
    """Return, for each kind of input, the gradients of the tensors in its slots."""
    import torch

    tensors = [torch.as_tensor(part) for part in _input_parts(gradients)]
    kinds: list[Sequence[torch.Tensor]] = []
    for tensor, slots_of_kind in zip(tensors[:-1], slots, strict=False):
        if len(slots_of_kind) > 1:
            kinds.append(tensor.unbind())
        else:
            kinds.append([tensor])
    backgrounds = tensors[-1].view(-1, 3)
    if len(slots[-1]) > 1:
        kinds.append(backgrounds.unbind())
    else:
        total = backgrounds[0]
        for background in backgrounds[1:]:
            total = total + background
        kinds.append([total])
    return kinds


@functools.cache
def _function() -> Callable[..., tuple[torch.Tensor, ...]]:
    """Return the differentiable operation for torch tensors on any device."""
    import torch

    class Rasterize(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: _Context,
            call: _Call,
            centers: torch.Tensor | None,
            viewmats: torch.Tensor | None,
            *inputs: torch.Tensor,
        ) -> tuple[torch.Tensor | None, ...]:
            # The centres and the poses are only used in the backward pass.
            ctx.set_materialize_grads(False)
            ctx.call = call
            ctx.tapes = []
            ctx.devices = [tensor.device for tensor in inputs]
            if viewmats is not None:
                ctx.pose = (viewmats.device, viewmats.dtype)
            return _forward(ctx, inputs)

        @staticmethod
        def backward(
            ctx: _Context, *gradients: torch.Tensor | None
        ) -> tuple[torch.Tensor | None, ...]:
            return None, *_backward(ctx, gradients)

    return Rasterize.apply
