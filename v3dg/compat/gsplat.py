"""`rasterization` with the arguments and results of gsplat's function, for programs
that train with it.

Pictures and gradients are those of `v3dg.rasterize`, on the CPU and on CUDA devices.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TypeAlias

from v3dg import _core
from v3dg._device import CPU
from v3dg._numbers import check, one_of, real, value_text, whole
from v3dg.camera_batch import CameraBatch
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rasterize import (
    CenterGradient,
    CenterProbe,
    DrawSettings,
    Views,
    check_device,
    draw_views,
    joined,
)

if TYPE_CHECKING:
    import torch

Info: TypeAlias = dict[str, Any]  # values are tensors and numbers, as in gsplat

_LOCATED = (
    "means2d",
    "depths",
    "conics",
    "opacities",
    "radii",
    "batch_ids",
    "camera_ids",
    "gaussian_ids",
    "is_seen",
)
_FARTHEST = 1e10
# Arguments that only change how gsplat computes, but not its results.
_IGNORED = {"tile_size", "channel_chunk", "segmented"}
# Arguments of gsplat that are not supported, with advice.
_UNSUPPORTED = {
    "camera_model": "only pinholes are supported; undistort pictures of fisheyes",
    "radial_coeffs": "undistort the pictures first",
    "tangential_coeffs": "undistort the pictures first",
    "thin_prism_coeffs": "undistort the pictures first",
    "ftheta_coeffs": "undistort the pictures first",
    "rolling_shutter": "all rows of a picture must have the same camera; remove it",
    "viewmats_rs": "all rows of a picture must have the same camera; remove it",
    "with_ut": "gaussians are projected as ellipses; remove it",
    "with_eval3d": "gaussians are projected as ellipses; remove it",
    "covars": "pass quats and scales",
    "sparse_grad": "gradients are always dense; remove it",
    "distributed": "train on one device",
}


def rasterization(
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = 0.01,
    far_plane: float = _FARTHEST,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = True,
    backgrounds: torch.Tensor | None = None,
    render_mode: str = "RGB",
    absgrad: bool = False,
    rasterize_mode: str = "classic",
    **options: object,
) -> tuple[torch.Tensor, torch.Tensor, Info]:
    """Draw N gaussians for C cameras, like the function with this name in gsplat 1.5.

    All cameras are drawn together. The tensors must be float32 or, on the CPU, may all
    be float64. As in gsplat, all tensors may have the same additional batch dimensions
    in front, for several sets of N gaussians with C cameras each. The results then have
    them, too.

    Args:
        means: (N, 3) centres in world space.
        quats: (N, 4) rotations w, x, y, z, which need not be normalised.
        scales: (N, 3) standard deviations (not logarithms).
        opacities: (N,) in [0, 1] (not logits).
        colors: (N, 3) or (C, N, 3) colours. With `sh_degree`, (N, K, 3) or (C, N, K, 3)
            coefficients.
        viewmats: (C, 4, 4) from world to camera. Their elements are independent
            variables of the gradient, so it can be propagated to any parameters of
            poses. The last row has no gradient.
        Ks: (C, 3, 3) intrinsics in px, without gradient.
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        near_plane: Gaussians with a smaller depth are not drawn.
        far_plane: Gaussians with a larger depth are not drawn.
        radius_clip: Gaussians with a radius of at most this many px are not drawn.
        eps2d: Variance of the low-pass filter in px².
        sh_degree: Degree of the coefficients in `colors`. None means that they are
            colours.
        packed: Whether the dict contains only visible pairs of a camera and a gaussian.
        backgrounds: (C, 3) colours. None means black.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED", where D is accumulated depth
            and ED expected depth.
        absgrad: Whether to set `.absgrad` of `means2d` to the sum of absolute
            gradients.
        rasterize_mode: "classic", or "antialiased" to compensate opacities for the
            filter.
        options: The other arguments of gsplat. `tile_size`, `channel_chunk` and
            `segmented` only affect how gsplat computes, so they are ignored. All others
            are not supported, and must have a value that turns them off.

    Returns:
        Pictures (C, H, W, D), alphas (C, H, W, 1), and a dict: `means2d`, `depths`,
        `conics`, `opacities` and `radii`, which are (C, N, ...) or, if `packed`, have
        one row per visible pair; `batch_ids`, `camera_ids` and `gaussian_ids` of the
        pairs; `width`, `height`, `n_batches` and `n_cameras`. `means2d` receives
        gradients, and has `.absgrad` if `absgrad` is set.

    Raises:
        ValueError: A shape or a value is wrong, or is not supported.
        TypeError: An argument is not a tensor, or gsplat does not have it.
    """
    _check_unsupported(options)
    look = _Look(
        near_plane=near_plane,
        far_plane=far_plane,
        radius_clip=radius_clip,
        eps2d=eps2d,
        sh_degree=sh_degree,
        packed=packed,
        backgrounds=backgrounds,
        render_mode=render_mode,
        absgrad=absgrad,
        rasterize_mode=rasterize_mode,
    )
    shape = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    sizes = _sizes(shape, colors, viewmats, Ks)
    views = _views(sizes, viewmats, Ks, (width, height), near_plane)
    return _draw(look, views, sizes, list(shape.values()), colors, (width, height))


def _check_tensors(tensors: Mapping[str, torch.Tensor]) -> None:
    """Raise TypeError unless all arguments are tensors. Raise an error if their device
    cannot draw them."""
    for name, value in tensors.items():
        if not hasattr(value, "requires_grad"):
            raise TypeError(f"{name}: expected a torch tensor, got {type(value).__name__}")
    check_device(tensors["means"])


def rasterization_2dgs(*arguments: object, **options: object) -> NoReturn:
    """Raise NotImplementedError: 2D gaussians are not supported."""
    raise NotImplementedError(
        "rasterization_2dgs: 2D gaussians are not supported; draw them with gsplat"
    )


@dataclass
class _Look:
    """The arguments of a call that affect drawing, with gsplat's names."""

    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    sh_degree: int | None
    packed: bool
    backgrounds: torch.Tensor | None
    render_mode: str
    absgrad: bool
    rasterize_mode: str

    def __post_init__(self) -> None:
        one_of(self.render_mode, "render_mode", ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
        one_of(self.rasterize_mode, "rasterize_mode", ("classic", "antialiased"))
        self.eps2d = real(self.eps2d, "eps2d", "a variance of at least 0 px²", 0)
        if self.sh_degree is not None:
            self.sh_degree = whole(self.sh_degree, "sh_degree", "a degree from 0 to 3", 0, 3)

    @property
    def clips(self) -> bool:
        """Whether gaussians may be omitted because of their depth or size."""
        return self.far_plane < _FARTHEST or self.radius_clip > 0

    @property
    def settings(self) -> DrawSettings:
        return DrawSettings(
            filter_px2=self.eps2d,
            antialiased=self.rasterize_mode == "antialiased",
            with_depth=self.depth != "",
            plain_colors=self.sh_degree is None or not self.has_color,
        )

    @property
    def has_color(self) -> bool:
        return "RGB" in self.render_mode

    @property
    def depth(self) -> str:
        """The kind of depth: "D" for accumulated depth, "ED" for expected depth, or ""
        for none."""
        return self.render_mode.removeprefix("RGB").lstrip("+")


def _check_unsupported(options: dict[str, object]) -> None:
    """Raise an error for arguments that gsplat does not have, and for values that v3dg
    does not support."""
    for name in options.keys() - _IGNORED:
        if name not in _UNSUPPORTED:
            raise TypeError(
                f"{name}: expected an argument of gsplat 1.5's rasterization, got an unknown one"
            )
        value = options[name]
        if str(value) not in {"None", "False", "pinhole", "RollingShutterType.GLOBAL"}:
            raise ValueError(f"{name}: {value_text(value)} is not supported; {_UNSUPPORTED[name]}")


@dataclass(frozen=True)
class _Sizes:
    """The numbers of sets, cameras and gaussians."""

    batch: tuple[int, ...]  # batch dimensions; their product is the number of sets
    num_cameras: int
    num_gaussians: int

    @property
    def num_sets(self) -> int:
        return math.prod(self.batch)

    @property
    def num_views(self) -> int:
        return self.num_sets * self.num_cameras


def _sizes(
    shape: Mapping[str, torch.Tensor],
    colors: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
) -> _Sizes:
    """Return the sizes of the tensors. Raise an error if an argument is not a tensor,
    or if the sizes do not match. The shapes inside one set are checked later."""
    _check_tensors({**shape, "colors": colors, "viewmats": viewmats, "Ks": Ks})
    means = shape["means"]
    batch = tuple(means.shape[:-2])
    for name, num_dimensions in (("quats", 2), ("scales", 2), ("opacities", 1)):
        of_tensor = tuple(shape[name].shape[:-num_dimensions])
        expected = f"the batch dimensions {batch} of means"
        check(name, of_tensor == batch, f"{expected}, got shape {tuple(shape[name].shape)}")
    expected_viewmats = (*batch, "C", 4, 4)
    poses = tuple(viewmats.shape)
    fits = len(poses) == len(expected_viewmats) and poses[-2:] == (4, 4) and poses[:-3] == batch
    check("viewmats", fits, f"shape {expected_viewmats}, got {poses}".replace("'", ""))
    num_cameras = poses[-3]
    check("viewmats", num_cameras > 0, "at least one camera, got none")
    check("means", math.prod(batch) > 0, f"at least one set, got batch dimensions {batch}")
    if Ks.ndim == viewmats.ndim and Ks.shape[:-3] == batch:
        expected = f"as many as viewmats ({num_cameras})"
        check("Ks", Ks.shape[-3] == num_cameras, f"{expected}, got {Ks.shape[-3]}")
    expected_Ks = (*batch, num_cameras, 3, 3)
    check("Ks", tuple(Ks.shape) == expected_Ks, f"shape {expected_Ks}, got {tuple(Ks.shape)}")
    num_gaussians = 0
    if means.ndim >= 2:
        num_gaussians = int(means.shape[-2])
    return _Sizes(batch, num_cameras, num_gaussians)


def _views(
    sizes: _Sizes, viewmats: torch.Tensor, Ks: torch.Tensor, size: tuple[int, int], near: float
) -> Views:
    """Return the cameras of each set."""
    count = sizes.num_cameras
    poses = viewmats.detach().cpu().reshape(-1, count, 4, 4).numpy()
    intrinsics = Ks.detach().cpu().reshape(-1, count, 3, 3).numpy()
    pairs = zip(poses, intrinsics, strict=True)
    if count == 1 and not viewmats.requires_grad:
        return Views(tuple(Camera(pose[0], K[0], *size, near).core for pose, K in pairs), count)
    cameras = tuple(CameraBatch(pose, K, *size, near).core_on(CPU) for pose, K in pairs)
    trained = None
    if viewmats.requires_grad:
        trained = viewmats.reshape(-1, 4, 4)
    return Views(cameras, count, trained)


def _sh_of_views(
    look: _Look, colors: torch.Tensor, sizes: _Sizes, means: torch.Tensor
) -> list[torch.Tensor]:
    """Return the SH coefficients (N, K, 3) for the core. There is one array for all
    cameras, one for each set, or one for each camera."""
    count = sizes.num_gaussians
    if not look.has_color:
        return [means.new_zeros(count, 1, 3)]
    if look.sh_degree is None:
        expected = (count, 1, 3)
        coefficients = colors[..., None, :]
    else:
        expected = (count, (look.sh_degree + 1) ** 2, 3)
        coefficients = colors[..., : expected[1], :]
    for_all = (*sizes.batch, *expected)
    for_each = (*sizes.batch, sizes.num_cameras, *expected)
    is_right = tuple(coefficients.shape) in (for_all, for_each)
    shape = (
        f"{(*sizes.batch, count, 3)}, or at least {for_all} with sh_degree, or the same with a "
        "dimension for cameras before that for gaussians"
    )
    check("colors", is_right, f"shape {shape}, got {tuple(colors.shape)}")
    return [part.contiguous() for part in _of_sets(coefficients, coefficients.ndim - 3)]


def _background_of_views(look: _Look, sizes: _Sizes, dtype: torch.dtype) -> list[torch.Tensor]:
    """Return background colours (3,): black for all cameras, or one colour per
    camera."""
    import torch

    if look.backgrounds is None or not look.has_color:
        return [torch.zeros(3, dtype=dtype)]
    shape = tuple(look.backgrounds.shape)
    expected = (*sizes.batch, sizes.num_cameras, 3)
    check("backgrounds", shape == expected, f"shape {expected}, got {shape}")
    return list(look.backgrounds.flatten(0, -2))


def _draw(
    look: _Look,
    views: Views,
    sizes: _Sizes,
    shape: list[torch.Tensor],
    colors: torch.Tensor,
    size: tuple[int, int],
) -> tuple[torch.Tensor, torch.Tensor, Info]:
    """Return pictures, alphas and gsplat's dict. ``shape`` has means, quats, scales and
    opacities. ``size`` has width and height in px."""
    num_batch = len(sizes.batch)
    by_set = [_of_sets(tensor, num_batch) for tensor in shape]
    *geometry, opacities = by_set
    gradient = CenterGradient()
    located = _locate()(
        look, views, sizes, gradient, *(tensor for group in by_set for tensor in group)
    )
    info: Info = dict(zip(_LOCATED, located, strict=True))
    is_seen = info.pop("is_seen")
    pairs: tuple[torch.Tensor, torch.Tensor] | EllipsisType = ...
    if look.packed:
        views_of_pairs = info["batch_ids"] * sizes.num_cameras + info["camera_ids"]
        pairs = (views_of_pairs, info["gaussian_ids"])
    probe = CenterProbe(info["means2d"], pairs, with_sizes=look.absgrad, gradient=gradient)
    if look.clips:
        opacities = [
            opacities[view // sizes.num_cameras] * is_seen_by_camera
            for view, is_seen_by_camera in enumerate(is_seen)
        ]
    sh = _sh_of_views(look, colors, sizes, shape[0])
    backgrounds = _background_of_views(look, sizes, colors.dtype)
    groups = [*geometry, opacities, sh, backgrounds]
    planes = draw_views(views, look.settings, groups, probe)
    alphas = _whole(planes[1::3], sizes.batch)
    pictures = [
        _picture(look, color, alpha, depth)
        for color, alpha, depth in zip(planes[::3], planes[1::3], planes[2::3], strict=True)
    ]
    info["width"], info["height"] = size
    info["n_batches"] = sizes.num_sets
    info["n_cameras"] = sizes.num_cameras
    return _whole(pictures, sizes.batch), alphas[..., None], info


def _of_sets(tensor: torch.Tensor, num_batch: int) -> list[torch.Tensor]:
    """Return the contiguous tensor of each set."""
    tensor = tensor.contiguous()
    if num_batch == 0:
        return [tensor]
    return list(tensor.flatten(0, num_batch - 1))


def _whole(parts: Sequence[torch.Tensor], batch: tuple[int, ...]) -> torch.Tensor:
    """Return the planes of all sets with the batch dimensions."""
    if not batch:
        return parts[0]
    stacked = joined(parts)
    return stacked.view(*batch, *stacked.shape[1:])


def _picture(
    look: _Look, color: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor | None
) -> torch.Tensor:
    """Return the channels (C, H, W, D) of pictures that the render mode requests."""
    import torch

    if depth is None:
        return color
    if look.depth == "D":
        depth = depth * alpha
    if not look.has_color:
        return depth[..., None]
    return torch.cat([color, depth[..., None]], dim=-1)


class _Context(Protocol):
    """The object that torch passes to the forward and backward pass of a
    `torch.autograd.Function`."""

    gradient: CenterGradient
    needs_input_grad: tuple[bool, ...]

    def set_materialize_grads(self, value: object) -> None: ...
    def mark_non_differentiable(self, *tensors: torch.Tensor) -> None: ...


@functools.cache
def _locate() -> Callable[..., tuple[torch.Tensor | None, ...]]:
    """Return the operation that projects gaussians onto the images. Its results are the
    tensors in the dict.

    The gradient of a picture flows to the gaussians directly. It does not flow through
    `means2d`, which only reports it to training strategies. Therefore a loss on
    `means2d` or `depths` would have no effect, so it raises an error.
    """
    import torch

    class Locate(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: _Context,
            look: _Look,
            views: Views,
            sizes: _Sizes,
            gradient: CenterGradient,
            *shape: torch.Tensor,
        ) -> tuple[torch.Tensor | None, ...]:
            ctx.set_materialize_grads(value=False)
            ctx.gradient = gradient
            (means2d, depths, *constants), optional = _located(look, views, sizes, shape)
            ctx.mark_non_differentiable(
                *constants, *(tensor for tensor in optional if tensor is not None)
            )
            return means2d, depths, *constants, *optional

        @staticmethod
        def backward(
            ctx: _Context, d_means2d: torch.Tensor | None, d_depths: torch.Tensor | None, *_: None
        ) -> tuple[None, ...]:
            num_inputs = len(ctx.needs_input_grad)
            gradient = ctx.gradient.value
            ctx.gradient.value = None
            is_all = (
                gradient is not None
                and d_means2d is not None
                and d_depths is None
                and d_means2d.data_ptr() == gradient.data_ptr()
            )
            check(
                "means2d, depths",
                is_all,
                "a loss on pictures only, got a loss on one of these tensors; project the means "
                "in torch instead",
            )
            return (None,) * num_inputs

    return Locate.apply


def _located(
    look: _Look, views: Views, sizes: _Sizes, shape: Sequence[torch.Tensor]
) -> tuple[list[torch.Tensor], list[torch.Tensor | None]]:
    """Return centres, depths, conics, opacities and radii. If needed, they are followed
    by the sets, cameras and gaussians of the visible pairs, and by (V, N) whether each
    gaussian is visible. `shape` has the means of all sets, then their quats, and so
    on."""
    import torch

    num_sets = sizes.num_sets
    columns: list[list[torch.Tensor]] = []
    for number, cameras in enumerate(views.cameras):
        means, quats, scales, opacities = shape[number::num_sets]
        unused_colors = means[:, None]
        rows = Gaussians(means, quats, scales, opacities, unused_colors).rows
        columns.append(_ellipses(rows, cameras, look))
    arrays = []
    for column in zip(*columns, strict=True):
        whole = column[0]
        if num_sets > 1:
            whole = torch.cat(column)
        arrays.append(whole)
    is_seen = None
    ids: list[torch.Tensor | None] = [None, None, None]
    if look.packed or look.clips:
        is_seen = (arrays[4] > 0).all(-1)
    if look.packed and is_seen is not None:
        view_ids, gaussian_ids = torch.where(is_seen)
        arrays = [array[view_ids, gaussian_ids] for array in arrays]
        camera_ids = view_ids % sizes.num_cameras
        ids = [view_ids // sizes.num_cameras, camera_ids, gaussian_ids]
    elif sizes.batch:
        arrays = [array.view(*sizes.batch, sizes.num_cameras, *array.shape[1:]) for array in arrays]
    return arrays, [*ids, is_seen]


def _ellipses(
    rows: _core.Rows, cameras: _core.Camera | _core.Cameras, look: _Look
) -> list[torch.Tensor]:
    """Return centres, depths, conics, opacities and radii (C, N, ...) of gaussians on
    the images of cameras."""
    import torch

    antialiased = look.rasterize_mode == "antialiased"
    if isinstance(cameras, _core.Cameras):
        arrays = _core.ellipses_of_views(
            rows,
            cameras,
            filter_px2=look.eps2d,
            antialiased=antialiased,
            far_depth=look.far_plane,
            min_radius_px=look.radius_clip,
        )
        return [torch.as_tensor(array) for array in arrays]
    e = _core.ellipses(
        rows,
        cameras,
        filter_px2=look.eps2d,
        antialiased=antialiased,
        far_depth=look.far_plane,
        min_radius_px=look.radius_clip,
    )
    of_camera = (e.centers, e.depths, e.conics, e.opacities, e.radii)
    return [torch.as_tensor(array).unsqueeze(0) for array in of_camera]
