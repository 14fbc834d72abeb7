"""The subjects of `pairs`: assets with their views and sizes, and levels of these
assets by other tools."""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

import v3dg

HOME_PX2 = 2.0
# Fraction of gaussians in the ball; the remaining ones may be far away.
_BALL_SHARE = 0.995
_DISTANCE = 2.5  # of the camera from the centre of an object, in radii


@dataclass(frozen=True)
class Size:
    """A view at one size: the camera of the whole picture, and the camera of the
    compared window."""

    camera: v3dg.Camera
    window: v3dg.Camera


class Subject:
    """An asset of assets.json, with its views and sizes."""

    def __init__(self, folder: Path, name: str, about: dict[str, Any], views: int) -> None:
        self.name, self._folder, self._about = name, folder, about
        self.asset = v3dg.read_asset(folder / about["file"])
        self.cameras = self._scene_views(views) if self.is_scene else self._object_views(views)

    def _scene_views(self, views: int) -> list[v3dg.Camera]:
        cameras = v3dg.read_cameras(self._folder / self._about["cameras"])
        return [cameras[name] for name in self._about.get("views", list(cameras))[:views]]

    def _object_views(self, views: int) -> list[v3dg.Camera]:
        """Return cameras with square pictures around the ball that contains nearly all
        gaussians."""
        means = self.asset.means.astype(np.float64)
        center = np.quantile(means, [0.01, 0.99], axis=0).mean(axis=0)
        radius = float(np.quantile(np.linalg.norm(means - center, axis=1), _BALL_SHARE))
        fov, up = 2 * math.asin(1 / _DISTANCE), self._about["up"]
        return v3dg.turntable(
            center, _DISTANCE * radius, views, up=up, fov_x=fov, width=1024, height=1024
        )

    @property
    def is_scene(self) -> bool:
        return "cameras" in self._about

    @property
    def refined_from(self) -> list[v3dg.Camera]:
        """Return the cameras from which a scene is refined. For an object the list is
        empty, and the refinement uses directions all around."""
        name = self._about.get("refined_from")
        return [] if name is None else list(v3dg.read_cameras(self._folder / name).values())

    def counts(self, gaussians: v3dg.Gaussians) -> list[int]:
        """Return for each view the number of gaussians that count: all for an object;
        those in the picture for a scene."""
        if not self.is_scene:
            return [len(gaussians)] * len(self.cameras)
        return [int(places(gaussians.means, camera)[1].sum()) for camera in self.cameras]

    @cached_property
    def _share_seen(self) -> float:
        """Return the fraction of the asset's gaussians that are in a picture, averaged
        over the pictures."""
        return float(np.mean(self.counts(self.asset))) / len(self.asset)

    def sizes(self, count: int, factor: float, widest: int) -> list[Size]:
        """Return the sizes of all views, at `factor` times the native length of a side
        of a level with `count` gaussians."""
        if self.is_scene:
            wanted = HOME_PX2 * count * self._share_seen
            scales = [math.sqrt(wanted / (c.width * c.height)) for c in self.cameras]
        else:
            solid_angle = 2 * math.pi * (1 - math.sqrt(1 - _DISTANCE**-2))
            scales = [math.sqrt(HOME_PX2 * count / solid_angle) / c.fx for c in self.cameras]
        rng = np.random.default_rng([zlib.crc32(self.name.encode()), count, round(64 * factor)])
        return [
            self._size(scaled(c, factor * s), widest, rng)
            for c, s in zip(self.cameras, scales, strict=True)
        ]

    def _size(self, camera: v3dg.Camera, widest: int, rng: np.random.Generator) -> Size:
        if max(camera.width, camera.height) <= widest:
            return Size(camera, camera)
        px, is_seen = places(self.asset.means, camera)
        ids = np.flatnonzero(is_seen)
        largest = np.sort(self.asset.scales[ids].astype(np.float64), axis=1)[:, 1:].prod(axis=1)
        # The probability is proportional to the largest scale. Otherwise the windows of
        # a scene would always show the sky.
        weights = self.asset.opacities[ids] * np.sqrt(largest)
        target = px[rng.choice(ids, p=weights / weights.sum())]
        size = np.minimum([camera.width, camera.height], widest)
        corner = np.clip(
            np.round(target - size / 2), 0, np.array([camera.width, camera.height]) - size
        )
        K = camera.K.copy()
        K[:2, 2] -= corner
        return Size(camera, replace(camera, K=K, width=int(size[0]), height=int(size[1])))

    @property
    def published_counts(self) -> dict[str, int]:
        """Return the number of gaussians of each level by the asset's authors."""
        return {
            label: level["gaussians"] for label, level in self._about.get("published", {}).items()
        }

    def peers(
        self, percents: tuple[float, ...]
    ) -> Iterator[tuple[float | str, str, v3dg.Gaussians]]:
        """Yield the levels of other tools and of the asset's authors: the percentage or
        published name, the name of the method, and the gaussians."""
        for path in sorted((self._folder / "peers" / self.name).glob("*_*")):
            tool, _, percent = path.name.removesuffix(path.suffix).rpartition("_")
            if float(percent) in percents:
                yield float(percent), tool, read_level(path)
        for label, level in self._about.get("published", {}).items():
            yield f"published {label}", "published", read_level(self._folder / level["file"])


def places(means: Any, camera: v3dg.Camera) -> tuple[Any, Any]:
    """Project means; return (N, 2) px, and (N,) whether they are in the picture."""
    seen = means.astype(np.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    is_before = seen[:, 2] > camera.near
    depth = np.where(is_before, seen[:, 2], 1)
    px = np.stack(
        [camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy], 1
    )
    return px, is_before & ((px >= 0) & (px < [camera.width, camera.height])).all(axis=1)


def scaled(camera: v3dg.Camera, scale: float) -> v3dg.Camera:
    """Return the camera with its resolution multiplied; width and height are rounded up
    to whole px."""
    width, height = (math.ceil(scale * side) for side in (camera.width, camera.height))
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] += (np.array([width, height]) - scale * np.array([camera.width, camera.height])) / 2
    return replace(camera, K=K, width=width, height=height)


def pack_level(path: Path, gaussians: v3dg.Gaussians) -> None:
    """Write gaussians in about 27 bytes each, plus at least half a byte for each SH
    coefficient above degree 0.

    Means have 17 bits of mantissa. SH coefficients above degree 0 are stored as the
    square root in one byte, which preserves small values. The error in pictures is far
    smaller than the error of the levels.
    """
    sh = gaussians.sh.reshape(len(gaussians), -1)
    base, rest = sh[:, :3], sh[:, 3:]
    top = np.float32(np.abs(rest).max(initial=1e-9))
    bits = (np.ascontiguousarray(gaussians.means).view(np.uint32) + 64) & np.uint32(0xFFFFFF80)
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    np.savez_compressed(
        path,
        means=bits.view(np.float32),
        log_scales=np.log(gaussians.scales.clip(1e-30)).astype(np.float16),
        quats=np.round(2047 * gaussians.quats / norms).astype(np.int16),
        opacities=np.round(65535 * gaussians.opacities).astype(np.uint16),
        sh0=base.astype(np.float16),
        rest_root=np.round(127 * np.sign(rest) * np.sqrt(np.abs(rest) / top)).astype(np.int8),
        rest_top=top,
    )


def read_level(path: Path) -> v3dg.Gaussians:
    """Read a file of `pack_level`, or an asset in any format that v3dg reads."""
    if path.suffix != ".npz":
        return v3dg.read_asset(path)
    with np.load(path) as file:
        parts = {name: file[name] for name in file.files}
    root = parts["rest_root"].astype(np.float32) / 127
    sh = np.concatenate(
        [parts["sh0"].astype(np.float32), parts["rest_top"] * root * np.abs(root)], axis=1
    )
    quats = parts["quats"].astype(np.float32)
    return v3dg.Gaussians(
        means=parts["means"],
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(parts["log_scales"].astype(np.float32)),
        opacities=parts["opacities"].astype(np.float32) / 65535,
        sh=np.ascontiguousarray(sh.reshape(len(sh), -1, 3)),
    )
