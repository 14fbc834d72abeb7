"""How steady pictures of a moving camera are: paths, and what changes between frames that should not.

What a frame is off, less what the frame before it was off, is what an eye sees beside the motion: flicker,
and levels that are replaced at once. A whole picture hides that, for what pops is small; so the worst tile
counts.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from benchmarks.evaluation.measure import Row
from v3dg import _device
from v3dg.cameras import Camera
from v3dg.metrics import box_downsample
from v3dg.render import render

TILE_PX = 16
SUPERSAMPLING = 4
_DRIFT = 5e-4  # of the distance, a frame: nothing else is seen to move
_ZOOM = 5e-3
_TURN = 5e-4  # rad a frame
_SHAKE = 2e-3  # of the distance, to either side
# Frames a wave of each of the two that make up a shaking hand, so that they do not meet.
_WAVES = (7.3, 11.9)


@dataclass(frozen=True)
class Path:
    """Cameras of frames that follow each other; `is_drift` if so slowly that an eye finds a pop."""

    name: str
    cameras: list[Camera]
    is_drift: bool


def paths_from(first: Camera, target: Any, frames: int) -> list[Path]:
    """Ways to go from a camera that looks at the target: so many frames each."""
    away = first.position - target
    right, down = first.viewmat[0, :3], first.viewmat[1, :3]
    distance = float(np.linalg.norm(away))

    def moved(eye: Any, looked_at: Any = target) -> Camera:
        fov = 2 * np.arctan(first.width / 2 / first.fx)
        size = {"width": first.width, "height": first.height}
        return Camera.look_at(eye, looked_at, -down, float(fov), **size, near=first.near)

    def shaken(k: int) -> Camera:
        aside, up = (_SHAKE * distance * np.sin(2 * np.pi * k / wave) for wave in _WAVES)
        return moved(first.position + aside * right + up * down)

    steps = range(frames)
    step = _DRIFT * distance * right
    ways = {
        "drift in": [moved(target + away * (1 - _DRIFT) ** k) for k in steps],
        "drift out": [moved(target + away * (1 + _DRIFT) ** k) for k in steps],
        "strafe": [moved(first.position + k * step, target + k * step) for k in steps],
        "orbit": [
            moved(target + np.cos(_TURN * k) * away + np.sin(_TURN * k) * distance * right) for k in steps
        ],
        "hand shake": [shaken(k) for k in steps],
        "turn in place": [moved(first.position, target + k * _TURN * distance * right) for k in steps],
        "zoom": [moved(target + away * (1 - _ZOOM) ** k) for k in steps],
    }
    return [Path(name, cameras, name.startswith("drift")) for name, cameras in ways.items()]


def true_picture(subject: Any, camera: Camera, device: str) -> Any:
    """(H, W, 3) of all gaussians, floats in [0, 1], of so many samples that it hardly flickers."""
    color = render(subject, camera.scaled(SUPERSAMPLING), tolerance=0.0, device=device).color
    return box_downsample(_device.to_host(color).clip(0, 1), SUPERSAMPLING)


class Steadiness:
    """Compares the frames of one path, one after another, with the true ones."""

    def __init__(self) -> None:
        self._last: Any = None
        self._whole: list[float] = []
        self._worst_tile: list[float] = []
        self._mse: list[float] = []

    def add(self, picture: Any, truth: Any) -> None:
        """Take the next frame: (H, W, 3) floats in [0, 1]."""
        error = _device.to_host(picture).clip(0, 1) - truth
        self._mse.append(float(np.square(error).mean()))
        if self._last is not None:
            change = np.square(255.0 * (error - self._last)).mean(-1)
            self._whole.append(float(np.sqrt(change.mean())))
            self._worst_tile.append(float(np.sqrt(tile_means(change).max())))
        self._last = error

    def row(self) -> Row:
        """Root mean squares in 255ths: of whole pictures, and of the worst tile of each; PSNR in dB."""
        return {
            "rms": round(float(np.mean(self._whole)), 4),
            "tile_mean": round(float(np.mean(self._worst_tile)), 4),
            "tile_median": round(float(np.median(self._worst_tile)), 4),
            "tile_p99": round(float(np.percentile(self._worst_tile, 99)), 4),
            "tile_worst": round(max(self._worst_tile), 4),
            "psnr": round(float(-10 * np.log10(np.mean(self._mse))), 3),
        }


def tile_means(values: Any) -> Any:
    """Means of (H, W) values over the tiles of a picture; those at its right and bottom may be smaller."""
    starts = [np.arange(0, side, TILE_PX) for side in values.shape]
    sums = np.add.reduceat(np.add.reduceat(values, starts[0], axis=0), starts[1], axis=1)
    height, width = (
        np.diff(np.append(start, side)) for start, side in zip(starts, values.shape, strict=True)
    )
    return sums / np.outer(height, width)


def compare(
    subject: Any, cameras: Iterable[Camera], cuts: dict[str, dict[str, Any]], device: str
) -> list[Row]:
    """Draw the frames of a path with several options of `render`: how steady they are, gaussians a frame."""
    steadiness = {name: Steadiness() for name in cuts}
    counts: dict[str, list[int]] = {name: [] for name in cuts}
    for camera in cameras:
        truth = true_picture(subject, camera, device)
        for name, options in cuts.items():
            image = render(subject, camera, device=device, **options)
            steadiness[name].add(image.color, truth)
            counts[name].append(image.stats.gaussians_selected)
    return [
        {"cut": name, **options, "gaussians": float(np.mean(counts[name])), **steadiness[name].row()}
        for name, options in cuts.items()
    ]
