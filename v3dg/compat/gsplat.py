"""`rasterization` with the arguments and the results of gsplat's, for programs that train with it.

Pictures and gradients are those of `v3dg.rasterize`, on the CPU and on CUDA devices.
"""

import functools
from dataclasses import dataclass, fields
from typing import Any

from v3dg import _core
from v3dg._numbers import check, one_of, real, shown, whole
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rasterize import check_device, draw_views, joined

_FARTHEST = 1e10
_WITHOUT_EFFECT = {"tile_size", "channel_chunk", "segmented"}  # which only say how gsplat computes
_LENS = ("camera_model", "radial_coeffs", "tangential_coeffs", "thin_prism_coeffs", "ftheta_coeffs")
# What is not done, and what to do.
_NOT_DONE = {
    **dict.fromkeys(_LENS, "undistort the pictures first"),
    **dict.fromkeys(("rolling_shutter", "viewmats_rs"), "a camera takes all rows of a picture at once"),
    **dict.fromkeys(("with_ut", "with_eval3d"), "gaussians are ellipses on the image"),
    "covars": "pass quats and scales",
    "sparse_grad": "gradients are dense",
    "distributed": "train on one device",
}


def rasterization(
    means: Any,
    quats: Any,
    scales: Any,
    opacities: Any,
    colors: Any,
    viewmats: Any,
    Ks: Any,
    width: int,
    height: int,
    **options: Any,
) -> tuple[Any, Any, dict[str, Any]]:
    """Draw N gaussians for C cameras, as the function of this name in gsplat 1.5 does.

    Takes torch tensors that are float32, or on the CPU all float64.

    Args:
        means: (N, 3).
        quats: (N, 4).
        scales: (N, 3).
        opacities: (N,).
        colors: (N, 3) or (C, N, 3) colours; with `sh_degree` (N, K, 3) or (C, N, K, 3) coefficients.
        viewmats: (C, 4, 4), without gradient.
        Ks: (C, 3, 3).
        width: Of the pictures in px.
        height: Of the pictures in px.
        options: With gsplat's meaning and default `near_plane`, `far_plane`, `radius_clip`, `eps2d`,
            `sh_degree`, `packed`, `backgrounds` (C, 3), `render_mode`, `absgrad` and `rasterize_mode`. The
            others of gsplat are refused by name where they ask for something; `tile_size`, `channel_chunk`
            and `segmented`, which only say how gsplat computes, have no effect.

    Returns:
        Pictures (C, H, W, D), alphas (C, H, W, 1), and a dict: `means2d`, `depths`, `conics`, `opacities` and
        `radii`, (C, N, ...) or if `packed` of the pairs in sight, with their `camera_ids` and `gaussian_ids`;
        `width`, `height`, `n_cameras`. `means2d` takes gradients, and has `.absgrad` with `absgrad`.

    Raises:
        ValueError: A shape or a value is wrong, or asks for what is not done.
        TypeError: An argument is no tensor, or none of gsplat's.
    """
    look = _look_of(options)
    shape = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    for name, value in {**shape, "colors": colors, "viewmats": viewmats, "Ks": Ks}.items():
        if not hasattr(value, "requires_grad"):
            raise TypeError(f"{name}: expected a torch tensor, got {type(value).__name__}")
    check_device(means)
    cameras = _cameras(viewmats, Ks, width, height, look.near_plane)
    pictures, alphas, info = _draw(look, cameras, [tensor.contiguous() for tensor in shape.values()], colors)
    return pictures, alphas, info | {"width": width, "height": height, "n_cameras": len(cameras)}


def rasterization_2dgs(*_: Any, **__: Any) -> Any:
    """Refuse: 2D gaussians are not drawn."""
    raise NotImplementedError("rasterization_2dgs: expected 3D gaussians, got 2D ones; draw them with gsplat")


@dataclass
class _Look:
    """How a call draws, by the names of gsplat's arguments."""

    near_plane: float = 0.01
    far_plane: float = _FARTHEST
    radius_clip: float = 0.0
    eps2d: float = 0.3
    sh_degree: int | None = None
    packed: bool = True
    backgrounds: Any = None
    render_mode: str = "RGB"
    absgrad: bool = False
    rasterize_mode: str = "classic"

    def __post_init__(self) -> None:
        one_of(self.render_mode, "render_mode", ("RGB", "D", "ED", "RGB+D", "RGB+ED"))
        one_of(self.rasterize_mode, "rasterize_mode", ("classic", "antialiased"))
        self.eps2d = real(self.eps2d, "eps2d", "a variance of at least 0 px²", 0)
        self.clips = self.far_plane < _FARTHEST or self.radius_clip > 0
        self.color, self.depth = "RGB" in self.render_mode, self.render_mode.removeprefix("RGB").lstrip("+")
        if self.sh_degree is not None:
            self.sh_degree = whole(self.sh_degree, "sh_degree", "a degree of 0 to 3", 0, 3)


def _look_of(options: dict[str, Any]) -> _Look:
    """Raise for options that are unknown, or that ask for what is not done."""
    known = {field.name for field in fields(_Look)}
    for name in options.keys() - known - _WITHOUT_EFFECT:
        if name not in _NOT_DONE:
            raise TypeError(f"{name}: expected an argument of gsplat 1.5's rasterization, got another")
        is_nothing = str(options[name]) in {"None", "False", "pinhole", "RollingShutterType.GLOBAL"}
        check(name, is_nothing, f"no such thing, got {shown(options[name])}; {_NOT_DONE[name]}")
    return _Look(**{name: value for name, value in options.items() if name in known})


def _cameras(viewmats: Any, Ks: Any, width: int, height: int, near: float) -> list[Camera]:
    check("viewmats", not viewmats.requires_grad, "no gradient; cameras are not trained, call .detach()")
    check("Ks", len(Ks) == len(viewmats), f"one for each of {len(viewmats)} viewmats, got {len(Ks)}")
    pairs = zip(viewmats.cpu().numpy(), Ks.detach().cpu().numpy(), strict=True)
    return [Camera(viewmat, K, width, height, near) for viewmat, K in pairs]


def _colors(look: _Look, colors: Any, num_cameras: int, means: Any) -> list[Any]:
    """What the core takes as sh, for cameras in turn."""
    num, degree = len(means), look.sh_degree
    if not look.color:
        return [means.new_zeros(num, 1, 3)]
    expected = (num, 1 if degree is None else (degree + 1) ** 2, 3)
    kept = colors[..., None, :] if degree is None else colors[..., : expected[1], :]
    is_right = tuple(kept.shape) in (expected, (num_cameras, *expected))
    shape = f"{(num, 3)}, or with sh_degree {expected} at least, or one such a camera"
    check("colors", is_right, f"shape {shape}, got {tuple(colors.shape)}")
    return [part.contiguous() for part in ([kept] if kept.ndim == 3 else kept)]


def _draw(look: _Look, cameras: Any, shape: list[Any], colors: Any) -> tuple[Any, Any, dict[str, Any]]:
    import torch

    options: dict[str, Any] = {"filter_px2": look.eps2d, "antialiased": look.rasterize_mode != "classic"}
    flow: dict[str, Any] = {}
    names = ("means2d", "depths", "conics", "opacities", "radii", "camera_ids", "gaussian_ids", "is_seen")
    info = dict(zip(names, _locate().apply(look, cameras, options, flow, *shape), strict=True))
    is_seen = info.pop("is_seen")
    pairs = (info["camera_ids"], info["gaussian_ids"]) if look.packed else ...
    sh = _colors(look, colors, len(cameras), shape[0])
    opacities = [shape[3] * of_camera for of_camera in is_seen] if look.clips else [shape[3]]
    given = look.backgrounds if look.color else None
    shades = [torch.zeros(3, dtype=colors.dtype)] if given is None else list(given)
    are_right = given is None or tuple(given.shape) == (len(cameras), 3)
    check("backgrounds", are_right, f"shape {(len(cameras), 3)}, got {given is not None and given.shape}")
    inputs = [*([tensor] for tensor in shape[:3]), opacities, sh, shades]
    options |= {"with_depth": look.depth != "", "plain_colors": look.sh_degree is None or not look.color}
    centers = (info["means2d"], pairs, look.absgrad, flow)
    planes = draw_views([camera.core for camera in cameras], options, inputs, centers)
    pictures = []
    for color, alpha, depth in zip(planes[::3], planes[1::3], planes[2::3], strict=True):
        parts = [color] if look.color else []
        if look.depth:
            parts.append((depth * alpha if look.depth == "D" else depth)[..., None])
        pictures.append(parts[0] if len(parts) == 1 else torch.cat(parts, dim=-1))
    return joined(pictures), joined(planes[1::3])[..., None], info


@functools.cache
def _locate() -> Any:
    """Where gaussians lie on the images: the tensors of the dict, and where it matters which are in sight.

    A picture's gradient reaches the gaussians from the picture itself, and comes by `means2d` to be seen
    there. So another loss on `means2d` or `depths` would be lost, and is refused.
    """
    import torch

    class Locate(torch.autograd.Function):
        @staticmethod
        def forward(ctx: Any, look: _Look, cameras: Any, options: Any, flow: Any, *shape: Any) -> Any:
            ctx.set_materialize_grads(False)
            ctx.flow = flow
            rows = Gaussians(*(*shape, shape[0][:, None])).rows  # whatever their colours
            clip = options | {"far_depth": look.far_plane, "min_radius_px": look.radius_clip}
            found = [_core.ellipses(rows, camera.core, **clip) for camera in cameras]
            arrays = [joined([torch.as_tensor(a) for a in of]) for of in zip(*found, strict=True)]
            is_seen: Any = (arrays[4] > 0).all(-1) if look.packed or look.clips else None
            ids: Any = (None, None)
            if look.packed:
                ids = torch.where(is_seen)
                arrays = [array[ids] for array in arrays]
            constant = [*arrays[2:], *ids, is_seen]
            ctx.mark_non_differentiable(*(tensor for tensor in constant if tensor is not None))
            return *arrays[:2], *constant

        @staticmethod
        def backward(ctx: Any, d_means2d: Any, d_depths: Any, *_: Any) -> Any:
            known = ctx.flow.pop("centers", None)
            is_all = known is not None and d_depths is None and d_means2d.data_ptr() == known.data_ptr()
            check("means2d, depths", is_all, "no loss but that of pictures; project the means for another")
            return (None,) * 8

    return Locate
