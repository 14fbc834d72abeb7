"""`rasterization` with the arguments and results of gsplat's function, for programs
that train with it.

Pictures and gradients are those of `v3dg.rasterize`, on the CPU and on CUDA devices.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import EllipsisType
from typing import TYPE_CHECKING, Any, NoReturn, Protocol, TypeAlias

from v3dg import _core
from v3dg._numbers import check, one_of, real, value_text, whole
from v3dg.cameras import Camera
from v3dg.gaussians import Array, Gaussians
from v3dg.rasterize import (
    CenterGradient,
    CenterProbe,
    DrawSettings,
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
    "camera_ids",
    "gaussian_ids",
    "is_seen",
)
_FARTHEST = 1e10
# Arguments that only change how gsplat computes, and not its results.
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

    The tensors must be float32 or, on the CPU, all float64.

    Args:
        means: (N, 3) centres in world space.
        quats: (N, 4) rotations w, x, y, z; they need not be normalised.
        scales: (N, 3) standard deviations; not logarithms.
        opacities: (N,) in [0, 1]; not logits.
        colors: (N, 3) or (C, N, 3) colours; with `sh_degree` (N, K, 3) or (C, N, K, 3)
            coefficients.
        viewmats: (C, 4, 4) world to camera, without gradient.
        Ks: (C, 3, 3) intrinsics in px.
        width: Width of the pictures in px.
        height: Height of the pictures in px.
        near_plane: Gaussians with a smaller depth are not drawn.
        far_plane: Gaussians with a larger depth are not drawn.
        radius_clip: Gaussians with a radius of at most this many px are not drawn.
        eps2d: Variance of the low-pass filter in px².
        sh_degree: Degree of the coefficients in `colors`; None for colours.
        packed: Whether the dict contains only visible pairs of a camera and a gaussian.
        backgrounds: (C, 3) colours; black if None.
        render_mode: "RGB", "D", "ED", "RGB+D" or "RGB+ED", where D is depth and ED
            expected depth.
        absgrad: Whether to set `.absgrad` of `means2d` to the sum of absolute
            gradients.
        rasterize_mode: "classic", or "antialiased" to compensate opacities for the
            filter.
        options: The other arguments of gsplat. `tile_size`, `channel_chunk` and
            `segmented` only affect how gsplat computes and are ignored. All others are
            not supported and must have a value that turns them off.

    Returns:
        Pictures (C, H, W, D), alphas (C, H, W, 1), and a dict: `means2d`, `depths`,
        `conics`, `opacities` and `radii`, which are (C, N, ...) or, if `packed`, have
        one row per visible pair; `camera_ids` and `gaussian_ids` of the pairs; `width`,
        `height` and `n_cameras`. `means2d` receives gradients, and has `.absgrad` if
        `absgrad` is set.

    Raises:
        ValueError: A shape or a value is wrong, or is not supported.
        TypeError: An argument is not a tensor, or not an argument of gsplat.
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
    _check_tensors({**shape, "colors": colors, "viewmats": viewmats, "Ks": Ks})
    cameras = _cameras(viewmats, Ks, width, height, near_plane)
    return _draw(look, cameras, list(shape.values()), colors, size=(width, height))


def _check_tensors(tensors: Mapping[str, torch.Tensor]) -> None:
    """Raise TypeError unless all arguments are tensors; raise an error if their device
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
    def has_color(self) -> bool:
        return "RGB" in self.render_mode

    @property
    def depth(self) -> str:
        """The kind of depth: "D" for accumulated depth, "ED" for expected depth, or
        ""."""
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


def _cameras(
    viewmats: torch.Tensor, Ks: torch.Tensor, width: int, height: int, near: float
) -> list[_core.Camera]:
    check(
        "viewmats",
        not viewmats.requires_grad,
        "tensors without gradient, got tensors that require it; cameras are not trained, so call "
        ".detach()",
    )
    check("Ks", len(Ks) == len(viewmats), f"as many as viewmats ({len(viewmats)}), got {len(Ks)}")
    pairs = zip(viewmats.cpu().numpy(), Ks.detach().cpu().numpy(), strict=True)
    return [Camera(viewmat, K, width, height, near).core for viewmat, K in pairs]


def _sh_of_views(
    look: _Look, colors: torch.Tensor, num_cameras: int, means: torch.Tensor
) -> list[torch.Tensor]:
    """Return the SH coefficients (N, K, 3) for the core: one array for all cameras, or
    one array per camera."""
    count = len(means)
    if not look.has_color:
        return [means.new_zeros(count, 1, 3)]
    if look.sh_degree is None:
        expected = (count, 1, 3)
        coefficients = colors[..., None, :]
    else:
        expected = (count, (look.sh_degree + 1) ** 2, 3)
        coefficients = colors[..., : expected[1], :]
    is_right = tuple(coefficients.shape) in (expected, (num_cameras, *expected))
    shape = (
        f"{(count, 3)}, or at least {expected} with sh_degree, or the same with a first dimension "
        "for cameras"
    )
    check("colors", is_right, f"shape {shape}, got {tuple(colors.shape)}")
    if coefficients.ndim == 3:
        return [coefficients.contiguous()]
    return [part.contiguous() for part in coefficients]


def _background_of_views(look: _Look, num_cameras: int, dtype: torch.dtype) -> list[torch.Tensor]:
    """Return background colours (3,): black for all cameras, or one colour per
    camera."""
    import torch

    if look.backgrounds is None or not look.has_color:
        return [torch.zeros(3, dtype=dtype)]
    shape = tuple(look.backgrounds.shape)
    check("backgrounds", shape == (num_cameras, 3), f"shape {(num_cameras, 3)}, got {shape}")
    return list(look.backgrounds)


def _draw(
    look: _Look,
    cameras: list[_core.Camera],
    shape: list[torch.Tensor],
    colors: torch.Tensor,
    size: tuple[int, int],
) -> tuple[torch.Tensor, torch.Tensor, Info]:
    """Return pictures, alphas and gsplat's dict. ``shape`` is means, quats, scales and
    opacities; ``size`` is width and height in px."""
    *geometry, opacity = (tensor.contiguous() for tensor in shape)
    gradient = CenterGradient()
    located = _locate()(look, cameras, gradient, *geometry, opacity)
    info: Info = dict(zip(_LOCATED, located, strict=True))
    is_seen = info.pop("is_seen")
    pairs: tuple[torch.Tensor, torch.Tensor] | EllipsisType = ...
    if look.packed:
        pairs = (info["camera_ids"], info["gaussian_ids"])
    probe = CenterProbe(info["means2d"], pairs, with_sizes=look.absgrad, gradient=gradient)
    opacities = [opacity]
    if look.clips:
        opacities = [opacity * is_seen_by_camera for is_seen_by_camera in is_seen]
    settings = DrawSettings(
        filter_px2=look.eps2d,
        antialiased=look.rasterize_mode == "antialiased",
        with_depth=look.depth != "",
        plain_colors=look.sh_degree is None or not look.has_color,
    )
    sh = _sh_of_views(look, colors, len(cameras), geometry[0])
    backgrounds = _background_of_views(look, len(cameras), colors.dtype)
    inputs = [*([tensor] for tensor in geometry), opacities, sh, backgrounds]
    planes = draw_views(cameras, settings, inputs, probe)
    alphas = planes[1::3]
    pictures = [
        _picture(look, color, alpha, depth)
        for color, alpha, depth in zip(planes[::3], alphas, planes[2::3], strict=True)
    ]
    info["width"], info["height"] = size
    info["n_cameras"] = len(cameras)
    return joined(pictures), joined(alphas)[..., None], info


def _picture(
    look: _Look, color: torch.Tensor, alpha: torch.Tensor, depth: torch.Tensor | None
) -> torch.Tensor:
    """Return the channels (H, W, D) of a picture that the render mode requests."""
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

    def set_materialize_grads(self, value: object) -> None: ...
    def mark_non_differentiable(self, *tensors: torch.Tensor) -> None: ...


@functools.cache
def _locate() -> Callable[..., tuple[torch.Tensor | None, ...]]:
    """Return the operation that projects gaussians onto the images. Its results are the
    tensors in the dict.

    The gradient of a picture flows to the gaussians directly, not through `means2d`,
    which only reports it to training strategies. A loss on `means2d` or `depths` would
    therefore have no effect, so it raises an error.
    """
    import torch

    class Locate(torch.autograd.Function):
        @staticmethod
        def forward(
            ctx: _Context,
            look: _Look,
            cameras: list[_core.Camera],
            gradient: CenterGradient,
            *shape: torch.Tensor,
        ) -> tuple[torch.Tensor | None, ...]:
            ctx.set_materialize_grads(value=False)
            ctx.gradient = gradient
            (means2d, depths, *constants), optional = _located(look, cameras, *shape)
            ctx.mark_non_differentiable(
                *constants, *(tensor for tensor in optional if tensor is not None)
            )
            return means2d, depths, *constants, *optional

        @staticmethod
        def backward(
            ctx: _Context, d_means2d: torch.Tensor | None, d_depths: torch.Tensor | None, *_: None
        ) -> tuple[None, ...]:
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
            return (None,) * 7

    return Locate.apply


def _located(
    look: _Look,
    cameras: list[_core.Camera],
    means: torch.Tensor,
    quats: torch.Tensor,
    scales: torch.Tensor,
    opacities: torch.Tensor,
) -> tuple[list[torch.Tensor], list[torch.Tensor | None]]:
    """Return centres, depths, conics, opacities and radii; then, where needed, the
    cameras and gaussians of the visible pairs, and (C, N) whether each gaussian is
    visible."""
    import torch

    unused_colors = means[:, None]
    rows = Gaussians(means, quats, scales, opacities, unused_colors).rows
    columns = zip(*(_ellipses(rows, camera, look) for camera in cameras), strict=True)
    arrays = [joined([torch.as_tensor(part) for part in column]) for column in columns]
    is_seen = None
    camera_ids = None
    gaussian_ids = None
    if look.packed or look.clips:
        is_seen = (arrays[4] > 0).all(-1)
    if look.packed and is_seen is not None:
        camera_ids, gaussian_ids = torch.where(is_seen)
        arrays = [array[camera_ids, gaussian_ids] for array in arrays]
    return arrays, [camera_ids, gaussian_ids, is_seen]


def _ellipses(rows: _core.Rows, camera: _core.Camera, look: _Look) -> tuple[Array, ...]:
    """Return centres, depths, conics, opacities and radii of gaussians on an image."""
    ellipses = _core.ellipses(
        rows,
        camera,
        filter_px2=look.eps2d,
        antialiased=look.rasterize_mode == "antialiased",
        far_depth=look.far_plane,
        min_radius_px=look.radius_clip,
    )
    return ellipses.centers, ellipses.depths, ellipses.conics, ellipses.opacities, ellipses.radii
