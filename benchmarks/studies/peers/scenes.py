"""The scenes and cameras of `peers`, and float64 references for windows of their
pictures."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

import v3dg
from benchmarks.evaluation import gpu
from benchmarks.evaluation.assets import like_trained, read_layout
from benchmarks.worlds.procedural import make_asset
from v3dg import _core
from v3dg.cameras import Camera
from v3dg.levels import BuildConfig, build_bundle

TRAINED_PX2 = 0.3
"""Variance in px² of the filter of the original 3DGS code, with which assets are
trained."""

TRAINED_WIDTH = 1920
"""Width in px of the pictures in which random gaussians have realistic sizes."""

_ONE_LEVEL = 1 << 30  # number of clusters above which another level would be built
_MOST_IN_A_BUNDLE = 5_000_000
_SIZE = {"width": TRAINED_WIDTH, "height": TRAINED_WIDTH * 9 // 16}
_HIGH = 0.9  # fraction of a scene's gaussians below the camera that looks from above
# Distance of the camera from the middle, in diagonals of the visible part.
_DISTANCE = 2.0
# Beyond this distance, a gaussian of opacity 1 has an alpha below 1/255.
_SIGMAS, _MARGIN_PX = 3.34, 2.0
_CHUNK = 4_000_000


@dataclass(frozen=True)
class Subject:
    """The gaussians on a device, in the form that all renderers get, and the
    cameras."""

    name: str
    gaussians: v3dg.Gaussians
    """torch tensors of float32; quaternions have length 1."""
    cameras: dict[str, Camera]
    filters_px2: tuple[float, ...]
    """Variances of filters in px²."""
    layout: Path | None = None
    asset: v3dg.Gaussians | None = field(default=None, repr=False)
    """The asset of the layout's instances; None without a layout."""

    def whole(self, filter_px2: float) -> v3dg.Scene | v3dg.Bundle | v3dg.Gaussians:
        """Return the scene, bundle or asset from which `v3dg.Renderer` draws the same
        picture at a tolerance of 0.

        Raises:
            ValueError: The subject has too many gaussians to build a bundle for the
                filter.
        """
        if self.layout is not None and self.asset is not None:
            return _placed(self.layout, self.asset, filter_px2)[0]
        if filter_px2 == 0:
            return self.gaussians
        if len(self.gaussians) > _MOST_IN_A_BUNDLE:
            raise ValueError(
                f"gaussians: expected at most {_MOST_IN_A_BUNDLE}, got {len(self.gaussians)}"
            )
        return one_level(self.gaussians.numpy(), filter_px2)


def one_level(asset: v3dg.Gaussians, filter_px2: float) -> v3dg.Bundle:
    """Return a bundle with all gaussians of an asset at level 0 and no coarser
    level."""
    config = BuildConfig(min_clusters=_ONE_LEVEL, asset_filter_px2=filter_px2)
    return build_bundle(asset, config=config, progress=False, device="cpu")


def _placed(
    layout: Path, asset: v3dg.Gaussians, filter_px2: float
) -> tuple[v3dg.Scene, dict[str, Camera]]:
    return read_layout(layout, one_level(asset, filter_px2))


def at_size(camera: Camera, width: int, height: int) -> Camera:
    """Return the same camera with another resolution. The width keeps its field of
    view; another aspect ratio changes the vertical field of view."""
    scale = width / camera.width
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] = width / 2, height / 2
    return replace(camera, K=K, width=width, height=height)


def on_device(gaussians: v3dg.Gaussians, device: str) -> v3dg.Gaussians:
    """Return the gaussians as tensors with quaternions of length 1, which some
    renderers require."""
    there = gaussians.torch(device)
    return replace(there, quats=there.quats / there.quats.norm(dim=1, keepdim=True))


def instances(layout: Path, asset: Path | None, cameras: tuple[int, ...], device: str) -> Subject:
    """Return a layout at full detail, drawn without a filter as by its authors."""
    what = make_asset() if asset is None else v3dg.read_asset(asset)
    scene, views = _placed(layout, what, 0.0)
    chosen = {name: views[name] for name in (list(views)[i] for i in cameras)}
    gaussians = on_device(gpu.placed_gaussians(scene, device), device)
    return Subject(layout.stem, gaussians, chosen, (0.0,), layout, what)


def captured(folder: Path, name: str, device: str) -> Subject:
    """Return an asset of a folder as for `pairs`, seen at eye level and from above."""
    about = json.loads((folder / "assets.json").read_text())[name]
    asset = v3dg.read_asset(folder / about["file"])
    means = asset.means.astype(np.float64)
    if "cameras" in about:
        cameras = v3dg.read_cameras(folder / about["cameras"])
        eye_level = cameras[about.get("views", list(cameras))[0]]
        up = -eye_level.viewmat[1, :3]
        # The eye is below the ceiling, if there is one, and looks at the middle of the
        # floor.
        eye, target = (
            place + (height - place @ up) * up
            for place, height in zip(
                (eye_level.position, np.median(means, axis=0)),
                np.quantile(means @ up, [_HIGH, 1 - _HIGH]),
                strict=True,
            )
        )
        above = Camera.look_at(
            eye, target, up, 2 * math.atan(0.5 * eye_level.width / eye_level.fx), **_SIZE
        )
    else:
        up = np.asarray(about["up"], np.float64)
        eye_level, above = (_from(means, up, slope) for slope in (0.15, 6.0))
    return Subject(
        name,
        on_device(asset, device),
        {"eye level": eye_level, "from above": above},
        (TRAINED_PX2, 0.0),
    )


def _from(means: Any, up: Any, slope: float) -> Camera:
    """Return a camera that sees 90 % of an object, from a height of `slope` times its
    distance."""
    aside = np.cross(
        up, [1.0, 0.0, 0.0] if abs(up[0]) < 0.7 * np.linalg.norm(up) else [0.0, 1.0, 0.0]
    )
    up, aside = (np.asarray(v) / np.linalg.norm(v) for v in (up, aside))
    low, high = np.quantile(means, [0.05, 0.95], axis=0)
    direction = (aside + slope * up) / math.hypot(1, slope)
    eye = (low + high) / 2 + _DISTANCE * np.linalg.norm(high - low) * direction
    return Camera.look_at(eye, (low + high) / 2, up, **_SIZE)


def random(count: int, sh_degree: int, device: str) -> Subject:
    """Return random gaussians with the sizes that training gives for 1920 x 1080 px."""
    camera = Camera.look_at((0, 0, 0), (0, 1, 0), **_SIZE)
    gaussians = on_device(like_trained(count, camera, device, sh_degree=sh_degree), device)
    return Subject(f"random {count / 1e6:g} M", gaussians, {"front": camera}, (TRAINED_PX2, 0.0))


def windows(camera: Camera, side: int) -> list[tuple[int, int, int, int]]:
    """Return eight squares of the picture as (x0, y0, x1, y1) in px."""
    boxes = []
    for row in range(2):
        for column in range(4):
            x = round((column + 0.5) * camera.width / 4 - side / 2)
            y = round((row + 0.5) * camera.height / 2 - side / 2)
            x, y = max(0, x), max(0, y)
            boxes.append((x, y, min(camera.width, x + side), min(camera.height, y + side)))
    return boxes


def truths(subject: Subject, camera: Camera, filter_px2: float, side: int) -> list[Any]:
    """Return the float64 reference of each window, (h, w, 3) on black."""
    boxes = windows(camera, side)
    rows = _touching(subject.gaussians, camera, filter_px2, boxes).numpy()
    doubles = _core.Rows(*(getattr(rows, f.name).astype(np.float64) for f in fields(rows)))
    look = {"filter_px2": filter_px2, "antialiased": False, "background": [0.0] * 3}
    picture = _core.rasterize(doubles, camera.core, **look, with_depth=False, keep_tape=False).color
    return [picture[y0:y1, x0:x1] for x0, y0, x1, y1 in boxes]


def _touching(
    gaussians: v3dg.Gaussians,
    camera: Camera,
    filter_px2: float,
    boxes: list[tuple[int, int, int, int]],
) -> v3dg.Gaussians:
    """Return the gaussians that may reach a window. The test uses a ball with the
    radius of the largest axis, so it also returns some gaussians that do not."""
    import torch

    def tensor(array: Any) -> Any:
        return torch.as_tensor(array, dtype=torch.float64, device=gaussians.means.device)

    to_view, origin = tensor(camera.viewmat[:3, :3]), tensor(camera.viewmat[:3, 3])
    focal, center = tensor([camera.fx, camera.fy]), tensor([camera.cx, camera.cy])
    kept = []
    for rows in _chunks(len(gaussians)):
        view = gaussians.means[rows].double() @ to_view.T + origin
        depth = view[:, 2].clamp_min(camera.near)
        slope = view[:, :2] / depth[:, None]
        # The norm of the Jacobian of the projection; an upper bound if the slope is
        # clamped.
        stretch = focal.max() / depth * (1 + slope.square().sum(1)).sqrt()
        sigma = ((stretch * gaussians.scales[rows].amax(1)) ** 2 + filter_px2).sqrt()
        reach = (_SIGMAS * sigma + _MARGIN_PX)[:, None]
        px = slope * focal + center
        touches = torch.zeros_like(depth, dtype=torch.bool)
        for box in boxes:
            low, high = tensor(box[:2]), tensor(box[2:])
            touches |= ((px + reach >= low) & (px - reach <= high)).all(1)
        kept.append(torch.nonzero(touches & (view[:, 2] >= camera.near))[:, 0] + rows.start)
    return gaussians.subset(torch.cat(kept))


def _chunks(count: int) -> Iterator[slice]:
    for start in range(0, count, _CHUNK):
        yield slice(start, min(start + _CHUNK, count))
