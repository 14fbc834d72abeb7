"""Measurements: times of calls, errors of pictures, tolerances at equal counts of
gaussians, and the radii by which gsplat clips gaussians."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from v3dg import _device, metrics
from v3dg._judges import Judges
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.pictures import Picture
from v3dg.scene import Scene
from v3dg.select import select

Row = dict[str, Any]

COARSEST = 1e9
"""Tolerance in px² that selects the coarsest cut of any bundle; a finite number,
because JSON has no infinity."""

_WARM_UPS = 1
_HALVINGS = 30
# In gsplat 1.5, a gaussian ends at an alpha of 1/255 and at 3.33 standard deviations.
_MIN_ALPHA, _REACH_SIGMAS = 1 / 255, 3.33
# The projection is linearised at most this fraction of half the picture beyond each
# border.
_FRUSTUM_MARGIN = 0.15


@dataclass(frozen=True)
class Time:
    """Milliseconds of repeated calls: the median, the minimum and the maximum."""

    median: float
    least: float
    most: float

    def row(self, name: str) -> Row:
        return {
            f"{name}_ms": round(self.median, 3),
            f"{name}_ms_range": [round(self.least, 3), round(self.most, 3)],
        }


def time_ms(call: Callable[[], Any], device: str, repeats: int) -> Time:
    """Measure single calls after a warm-up.

    Each call is measured from idle device to idle device, so Python's overhead is
    included.
    """
    for _ in range(_WARM_UPS):
        call()
    times = times_ms(call, device, repeats)
    return Time(statistics.median(times), min(times), max(times))


def times_ms(call: Callable[[], Any], device: str, repeats: int) -> list[float]:
    """Return milliseconds of single calls, each from idle device to idle device."""
    clock = _cuda_ms if device == "cuda" else _wall_ms
    return [clock(call) for _ in range(repeats)]


def _wall_ms(call: Callable[[], Any]) -> float:
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)


def _cuda_ms(call: Callable[[], Any]) -> float:
    import torch

    event: Any = torch.cuda.Event
    start, end = (event(enable_timing=True) for _ in range(2))
    torch.cuda.synchronize()
    start.record()
    call()
    end.record()
    torch.cuda.synchronize()
    return float(start.elapsed_time(end))


def crop(picture: Picture, side: int) -> Picture:
    """Return the middle of a picture, at most `side` px wide and high."""
    height, width = picture.shape[:2]
    top, left = max(0, (height - side) // 2), max(0, (width - side) // 2)
    return picture[top : top + side, left : left + side]


def _flip_and_psnr(pair: tuple[Picture, Picture]) -> tuple[float, float]:
    truth, picture = (p.astype(np.float32) / np.float32(255) for p in pair)
    return metrics.flip(truth, picture), metrics.psnr(truth, picture)


class Judge(Judges):
    """Computes FLIP and PSNR of many pairs of pictures on all cores, so it must not run
    while times are measured."""

    def errors(self, pairs: Iterable[tuple[Picture, Picture]]) -> list[Row]:
        """Return a row with "flip" and "psnr" for each (reference, picture). PSNR is
        None for equal pictures."""
        return [
            {"flip": round(flip, 5), "psnr": round(psnr, 2) if math.isfinite(psnr) else None}
            for _, (flip, psnr) in self.measured(pairs, _flip_and_psnr)
        ]


def tolerance_for(scene: Scene, camera: Camera, count: int) -> float:
    """Return the smallest tolerance at which at most `count` gaussians are selected;
    `COARSEST` if even the coarsest cut has more."""
    if select(scene, camera, tolerance=COARSEST, device="cpu").num_gaussians > count:
        return COARSEST
    return select(scene, camera, budget=count, device="cpu").tolerance


def _bisect(fits: Callable[[float], bool], low: float, high: float) -> float:
    """Return the smallest value for which `fits` holds, by bisection on a logarithmic
    scale. `fits` must hold for `high` and for all values above the result."""
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if fits(middle) else (middle, high)
    return high


def like(values: Any, array: Any) -> Any:
    """Convert values to the library, dtype and device of `array`."""
    if isinstance(array, np.ndarray):
        return np.asarray(values, array.dtype)
    import torch

    return torch.as_tensor(values, dtype=array.dtype, device=array.device)


def screen_radii(gaussians: Gaussians, camera: Camera) -> Any:
    """Return the radii that gsplat 1.5 computes for gaussians, (N,) px.

    The radius is half the larger side of the box in which gsplat draws a gaussian, and
    0 for a gaussian that it does not draw. gsplat's `radius_clip` omits gaussians whose
    radius is at most that value. gsplat first rounds radii up to whole pixels. The
    radii returned here are not rounded, so that a clip radius exists for any number of
    gaussians.
    """
    library = _device.library_of(gaussians.means)
    viewmat = like(camera.viewmat, gaussians.means)
    world_to_view = viewmat[:3, :3]
    view = gaussians.means @ world_to_view.T + viewmat[:3, 3]
    depth = view[:, 2].clip(camera.near)
    w, x, y, z = (gaussians.quats / library.linalg.norm(gaussians.quats, axis=1)[:, None]).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    axes = library.stack([library.stack(row, -1) for row in rows], -2)
    # The covariance in view space is halves @ halvesᵀ.
    halves = world_to_view @ (axes * gaussians.scales[:, None, :])
    centers, variances = [], []
    for axis, size, focal, principal in (
        (0, camera.width, camera.fx, camera.cx),
        (1, camera.height, camera.fy, camera.cy),
    ):
        margin = _FRUSTUM_MARGIN * size / focal
        slope = (view[:, axis] / depth).clip(
            -principal / focal - margin, (size - principal) / focal + margin
        )
        variance = (
            ((halves[:, axis] - slope[:, None] * halves[:, 2]) * (focal / depth)[:, None]) ** 2
        ).sum(-1)
        variances.append(variance)
        centers.append(focal * view[:, axis] / depth + principal)
    sigmas = (2 * library.log((gaussians.opacities / _MIN_ALPHA).clip(1))) ** 0.5
    radii = [sigmas.clip(0, _REACH_SIGMAS) * variance**0.5 for variance in variances]
    inside = view[:, 2] > camera.near
    for center, radius, size in zip(centers, radii, (camera.width, camera.height), strict=True):
        inside = inside & (center + radius > 0) & (center - radius < size)
    return library.maximum(*radii) * inside


def clip_radius_for(radii: Any, count: int) -> float:
    """Return the smallest clip radius, in px, that leaves at most `count` gaussians."""
    return _bisect(lambda clip: int((radii > clip).sum()) <= count, 1e-3, 1e5)
