"""Steadiness of the pictures of a moving camera: camera paths, and changes between
frames that the motion does not explain.

Besides the motion, an eye sees how the error changes between consecutive frames:
flicker, and levels that change at once. Pops are small, so an average over the whole
picture would hide them, and the worst tile is reported. For faster motion, the
difference is computed along the motion: the previous frame's error is warped to the
current picture by the depth. To measure pops alone, two pictures from the same position
are compared: one with the cut of this frame, and one with the cut of the previous
frame.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from benchmarks.evaluation.measure import Row
from v3dg import _device
from v3dg.cameras import Camera
from v3dg.metrics import box_downsample
from v3dg.render import Renderer, render
from v3dg.scene import Scene
from v3dg.select import Selection, select

TILE_PX = 16
SUPERSAMPLING = 4
# Motion per frame as a fraction of the distance, so slow that only pops appear to move.
_DRIFT = 5e-4
_ZOOM = 5e-3
_TURN = 5e-4  # rotation per frame in radians
_SHAKE = 2e-3  # amplitude of the shaking as a fraction of the distance
# Frames per period of the two waves of a shaking hand. The periods differ, so that the
# waves do not coincide.
_WAVES = (7.3, 11.9)
# A walking camera: its vertical motion as a fraction of the distance, and its frames
# per step.
_BOB, _STEP_FRAMES = 2e-3, 30.0
_COVERED = 0.9  # minimum alpha of pixels whose depth is used
# Fraction of the depth. A pixel whose depth differs by more was hidden in the previous
# frame.
_SAME_DEPTH = 0.02

# Options of `Renderer.render`, or a function that returns the options for a frame.
Options = dict[str, Any]
Cut = Options | Callable[[Scene, Camera], Options]


@dataclass(frozen=True)
class Path:
    """Cameras of consecutive frames.

    Attributes:
        is_drift: Whether the motion is so slow that an eye notices pops.
        moves: (F, 3) displacement of all instances from their initial positions, in
            world units.
    """

    name: str
    cameras: list[Camera]
    is_drift: bool
    moves: Any

    def seen_from(self, k: int) -> Camera:
        """Return the camera of frame `k` relative to the initial positions of the
        instances."""
        camera, shift = self.cameras[k], np.eye(4)
        shift[:3, 3] = self.moves[k]
        return replace(camera, viewmat=camera.viewmat @ shift)


def paths_from(first: Camera, target: Any, frames: int) -> list[Path]:
    """Return paths of `frames` cameras each that start at `first`.

    The target keeps its position in the picture, except on paths that rotate the
    camera. It need not be in the middle of the picture.
    """
    away = first.position - target
    right, down = first.viewmat[0, :3], first.viewmat[1, :3]
    distance = float(np.linalg.norm(away))

    def towards(eye: Any, looked_at: Any) -> Any:
        return Camera.look_at(eye, looked_at, -down, width=1, height=1).viewmat[:3, :3]

    aside_of_target = first.viewmat[:3, :3] @ towards(first.position, target).T

    def moved(eye: Any, looked_at: Any = target) -> Camera:
        viewmat = np.eye(4)
        viewmat[:3, :3] = aside_of_target @ towards(eye, looked_at)
        viewmat[:3, 3] = -viewmat[:3, :3] @ eye
        return replace(first, viewmat=viewmat)

    def shaken(k: int) -> Camera:
        aside, up = (_SHAKE * distance * np.sin(2 * np.pi * k / wave) for wave in _WAVES)
        return moved(first.position + aside * right + up * down)

    def walked(k: int) -> Camera:
        up = -_BOB * distance * np.sin(2 * np.pi * k / _STEP_FRAMES) * down
        eye = first.position - k * _ZOOM * away + up
        return moved(eye, eye - away)

    steps = range(frames)
    step = _DRIFT * distance * right
    still = np.zeros((frames, 3))
    ways = {
        "drift in": [moved(target + away * (1 - _DRIFT) ** k) for k in steps],
        "drift out": [moved(target + away * (1 + _DRIFT) ** k) for k in steps],
        "strafe": [moved(first.position + k * step, target + k * step) for k in steps],
        "orbit": [
            moved(target + np.cos(_TURN * k) * away + np.sin(_TURN * k) * distance * right)
            for k in steps
        ],
        "hand shake": [shaken(k) for k in steps],
        "turn in place": [
            moved(first.position, target + k * _TURN * distance * right) for k in steps
        ],
        "zoom": [moved(target + away * (1 - _ZOOM) ** k) for k in steps],
        "walk": [walked(k) for k in steps],
    }
    paths = [Path(name, cameras, name.startswith("drift"), still) for name, cameras in ways.items()]
    nearer = np.array([away * (1 - (1 - _DRIFT) ** k) for k in steps])
    return [*paths, Path("moved instances", [first] * frames, True, nearer)]


def true_picture(subject: Any, camera: Camera, device: str, samples: int = SUPERSAMPLING) -> Any:
    """Return the reference picture, (H, W, 3) floats in [0, 1]: all gaussians, with
    enough samples per side of a pixel that the picture hardly flickers."""
    color = render(subject, camera.scaled(samples), tolerance=0.0, device=device).color
    return box_downsample(_device.to_host(color).clip(0, 1), samples)


class Warp:
    """Warps values of one picture to another one, by the depths of both pictures."""

    def __init__(self, before: Camera, after: Camera, images: tuple[Any, Any]) -> None:
        (depth_before, alpha_before), (depth, alpha) = (
            (_device.to_host(image.depth), _device.to_host(image.alpha)) for image in images
        )
        row, column = np.indices(depth.shape)
        ray = np.stack(
            [(column + 0.5 - after.cx) / after.fx, (row + 0.5 - after.cy) / after.fy], -1
        )
        seen = depth[..., None] * np.concatenate([ray, np.ones((*depth.shape, 1))], -1)
        rotation, shift = after.viewmat[:3, :3], after.viewmat[:3, 3]
        place = (seen - shift) @ rotation
        x, y, z = np.moveaxis(place @ before.viewmat[:3, :3].T + before.viewmat[:3, 3], -1, 0)
        deep = np.maximum(z, before.near)
        self._x = before.fx * x / deep + before.cx - 0.5
        self._y = before.fy * y / deep + before.cy - 0.5
        height, width = depth.shape
        inside = (self._x >= 0) & (self._x <= width - 1) & (self._y >= 0) & (self._y <= height - 1)
        self.is_valid = inside & (alpha > _COVERED) & (z > before.near)
        self.is_valid &= self(alpha_before) > _COVERED
        self.is_valid &= np.abs(self(depth_before) - z) < _SAME_DEPTH * deep

    def __call__(self, values: Any) -> Any:
        """Return (H, W, ...) values, interpolated between the four nearest pixels.
        Pixels where the warp is not valid have arbitrary values."""
        height, width = values.shape[:2]
        x, y = np.clip(self._x, 0, width - 1), np.clip(self._y, 0, height - 1)
        left, top = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
        right, below = x - left, y - top
        if values.ndim == 3:
            right, below = right[..., None], below[..., None]
        upper = (1 - right) * values[top, left] + right * values[top, left + 1]
        lower = (1 - right) * values[top + 1, left] + right * values[top + 1, left + 1]
        return (1 - below) * upper + below * lower


class Steadiness:
    """Compares the frames of one path with their reference pictures, one frame after
    another."""

    def __init__(self) -> None:
        self._last: Any = None
        self._whole: list[float] = []
        self._worst_tile: list[float] = []
        self._warped: list[float] = []
        self._mse: list[float] = []

    def add(self, picture: Any, truth: Any, warp: Warp | None = None) -> None:
        """Add the next frame.

        Args:
            picture: (H, W, 3) floats in [0, 1].
            truth: The reference picture of the frame.
            warp: The warp from the previous frame to this frame.
        """
        error = _device.to_host(picture).clip(0, 1) - truth
        self._mse.append(float(np.square(error).mean()))
        if self._last is not None:
            change = np.square(255.0 * (error - self._last)).mean(-1)
            self._whole.append(float(np.sqrt(change.mean())))
            self._worst_tile.append(worst_tile(error - self._last))
        if warp is not None:
            change = np.square(255.0 * (error - warp(self._last))).mean(-1) * warp.is_valid
            self._warped.append(float(np.sqrt(tile_means(change).max())))
        self._last = error

    def row(self) -> Row:
        """Return the root mean squares of changes in units of 1/255, for whole pictures
        and for each picture's worst tile; and PSNR in dB."""
        row = {
            "rms": round(float(np.mean(self._whole)), 4),
            "tile_mean": round(float(np.mean(self._worst_tile)), 4),
            "tile_median": round(float(np.median(self._worst_tile)), 4),
            "tile_p99": round(float(np.percentile(self._worst_tile, 99)), 4),
            "tile_worst": round(max(self._worst_tile), 4),
            "psnr": round(float(-10 * np.log10(np.mean(self._mse))), 3),
        }
        if self._warped:
            row["warped_mean"] = round(float(np.mean(self._warped)), 4)
            row["warped_worst"] = round(max(self._warped), 4)
        return row


def tile_means(values: Any) -> Any:
    """Return means of (H, W) values over tiles of `TILE_PX`; tiles at the right and
    lower borders may be smaller."""
    starts = [np.arange(0, side, TILE_PX) for side in values.shape]
    sums = np.add.reduceat(np.add.reduceat(values, starts[0], axis=0), starts[1], axis=1)
    height, width = (
        np.diff(np.append(start, side)) for start, side in zip(starts, values.shape, strict=True)
    )
    return sums / np.outer(height, width)


def worst_tile(change: Any) -> float:
    """Return the root mean square of the worst tile of (H, W, 3) colour differences, in
    units of 1/255; colours are in [0, 1]."""
    return float(np.sqrt(tile_means(np.square(255.0 * change).mean(-1)).max()))


def changed_items(before: Selection, after: Selection) -> int:
    """Return the number of (instance, cluster) pairs that appear, disappear or change
    their weight."""
    if np.array_equal(before.instance_ids, after.instance_ids) and np.array_equal(
        before.cluster_ids, after.cluster_ids
    ):
        return int((before.weights != after.weights).sum())
    mine, other = (
        (cut.instance_ids.astype(np.int64) << 32) + cut.cluster_ids for cut in (before, after)
    )
    common, first, second = np.intersect1d(mine, other, assume_unique=True, return_indices=True)
    other_weights = int((before.weights[first] != after.weights[second]).sum())
    return len(before) + len(after) - 2 * len(common) + other_weights


class _Follower:
    """The state of one of the compared ways to draw a path."""

    def __init__(self, cut: Cut, scene: Scene, device: str) -> None:
        self._cut, self._scene, self._device = cut, scene, device
        self._renderer = Renderer(scene, device=device)
        self._steadiness = Steadiness()
        self._counts: list[int] = []
        self._tolerances: list[float] = []
        self._changed: list[int] = []
        self._pops: list[float] = []
        self._last: Selection | None = None

    def draw(self, camera: Camera, truth: Any, warp: Warp | None) -> None:
        options = self._cut if isinstance(self._cut, dict) else self._cut(self._scene, camera)
        image = self._renderer.render(camera, **options)
        self._steadiness.add(image.color, truth, warp)
        self._counts.append(image.stats.gaussians_selected)
        self._tolerances.append(image.stats.tolerance)
        tolerance, fade = image.stats.tolerance, options.get("fade")
        items = options.get("cut") or select(
            self._scene, camera, tolerance=tolerance, fade=fade, cull=False, device="cpu"
        )
        if self._last is not None:
            self._changed.append(changed_items(self._last, items))
            self._pops.append(self._pop(camera, self._last, items) if self._changed[-1] else 0.0)
        self._last = items

    def _pop(self, camera: Camera, *cuts: Selection) -> float:
        """Return the error of the worst tile between pictures of two cuts from one
        position."""
        # These pictures do not use the path's renderer, because their frames would
        # change the state of its budget.
        pictures = (render(self._scene, camera, cut=cut, device=self._device).color for cut in cuts)
        before, after = map(_device.to_host, pictures)
        return worst_tile(after.clip(0, 1) - before.clip(0, 1))

    def row(self) -> Row:
        return {
            "gaussians": float(np.mean(self._counts)),
            "most_gaussians": max(self._counts),
            "changed_items": float(np.mean(self._changed)),
            "most_changed_items": max(self._changed),
            "pop_mean": round(float(np.mean(self._pops)), 4),
            "pop_worst": round(max(self._pops), 4),
            "tolerances": [min(self._tolerances), max(self._tolerances)],
            **self._steadiness.row(),
        }


def compare(
    subject: Any,
    path: Path,
    cuts: dict[str, Cut],
    device: str,
    *,
    along_motion: bool = True,
    samples: int = SUPERSAMPLING,
) -> list[Row]:
    """Draw the frames of a path with several options of `render`.

    Args:
        along_motion: Whether to warp errors along the motion as well, which draws all
            gaussians once more.
        samples: Samples per side of a pixel of the reference pictures.

    Returns:
        A row for each of `cuts`: measures of steadiness, and gaussians per frame.
    """
    scene = copy.copy(Scene.of(subject))
    start = scene.positions
    followers = {name: _Follower(cut, scene, device) for name, cut in cuts.items()}
    last: Any = None
    for k, camera in enumerate(path.cameras):
        scene.move(positions=start + path.moves[k])
        truth = true_picture(scene, camera, device, samples)
        warp, whole = None, None
        if along_motion:
            whole = render(scene, camera, tolerance=0.0, depth=True, device=device)
        if last is not None:
            warp = Warp(path.seen_from(k - 1), path.seen_from(k), (last, whole))
        for follower in followers.values():
            follower.draw(camera, truth, warp)
        last = whole
    return [
        {"cut": name, **(cut if isinstance(cut, dict) else {}), **followers[name].row()}
        for name, cut in cuts.items()
    ]
