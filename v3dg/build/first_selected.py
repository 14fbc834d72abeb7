"""At which size level 1 of a smooth asset is first selected: where it is no worse than the leaves."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg.build.config import BuildConfig
from v3dg.build.plan import Plan
from v3dg.build.simplify import LevelTables, children
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rasterize import rasterize

_Floats: TypeAlias = npt.NDArray[Any]

# By how much the radii of balls of level 1 grow at least and at most: a group is selected at 1.5 to 0.19 px²
# a gaussian at the default tolerance. And by how much they grow where it is not measured.
_LEAST, _MOST, UNMEASURED = 1.4, 4.0, 2.0
# Pictures are taken from so many sides, at so many px² for a gaussian of half of the groups.
_SIDES, _PX2, _WIDEST_PX, _SAMPLES = 8, (0.2, 0.5, 1.2, 3.0), 2048, 2
_DISTANCE, _SHARE = 8.0, 0.999  # from the centre, in radii; of the gaussians that the radius holds
# A pixel counts by this power of how far it is off, as people see it. By this measure a level is as good as
# the leaves, by FLIP, where it has so many times their loss.
_POWER, _AS_GOOD = 0.7, 1.15
# Groups that few pixels show are taken to be like all: so many times the mean loss of a group is added, in
# the proportion that all groups have. And it counts little what they look like: so much more for leaves.
_LIKE_ALL, _OUT_OF_SIGHT = 0.2, 0.05
_NOTHING = 1e-9  # a loss, and of the picture's ball a footprint, below which there is none


def grown(plan: Plan, tables: Sequence[LevelTables], growth: _Floats) -> list[LevelTables]:
    """The tables with balls of level 1 so many times as large; those above contain them."""
    made, ball = [*tables], tables[1].ball.copy()
    ball[:, 3] *= growth
    for number in range(1, len(tables)):
        if number > 1:
            ball = _core.bound_spheres(ball, children(plan, number - 1, number))
        made[number] = replace(tables[number], ball=ball)
    return made


def measured_growth(
    plan: Plan, gaussians: Sequence[Gaussians], ball: _Floats, config: BuildConfig, where: Device
) -> _Floats:
    """(G,) times that the balls of level 1 are to grow, from the gaussians of levels 0 and 1."""
    placed = [_device.place(part, where) for part in gaussians]
    footprint = np.pi * ball[:, 3].astype(np.float64) ** 2 / np.diff(plan.levels[1].group_offset)
    loss, px2 = _losses(placed, plan, footprint, config)
    of_leaves, of_level = loss[:, 0], loss[:, 1]
    mean = of_leaves.mean(axis=1, keepdims=True)
    like_all = _LIKE_ALL * of_level.mean(axis=1, keepdims=True)
    of_leaves = of_leaves + (_LIKE_ALL + _OUT_OF_SIGHT) * mean
    ratio = (of_level + like_all + _NOTHING) / (of_leaves + _NOTHING) / _AS_GOOD
    # From the smallest size on, as long as the sum over sizes says that the level is better.
    sizes = np.geomspace(3 / _MOST**2, 3 / _LEAST**2, 64)
    per_group = zip(np.log(px2).T, np.log(ratio).T, strict=True)
    sums = np.cumsum([np.interp(np.log(sizes), x, y) for x, y in per_group], axis=1)
    growth: _Floats = np.sqrt(3 / sizes[sums.argmin(axis=1)])
    return growth


def _losses(
    gaussians: Sequence[Gaussians], plan: Plan, footprint: _Floats, config: BuildConfig
) -> tuple[_Floats, _Floats]:
    """(S, 2, G) loss of the leaves of groups, and of level 1, in pictures of so many sizes; (S, G) px²."""
    leaves, level = gaussians
    means = _device.to_host(leaves.means).astype(np.float64)
    center = np.median(means, axis=0)
    radius = np.quantile(np.linalg.norm(means - center, axis=1), _SHARE) or 1.0
    own = {"filter_px2": config.asset_filter_px2, "antialiased": config.asset_antialiased}
    coarse = {"filter_px2": config.filter_px2, "antialiased": True}
    loss, px2 = np.zeros((len(_PX2), 2, len(footprint))), np.zeros((len(_PX2), len(footprint)))
    black, shifts = replace(leaves, sh=0 * leaves.sh[:, :1]), np.random.default_rng(0)
    for size, wanted in enumerate(_PX2):
        seen = np.maximum(footprint / radius**2, _NOTHING) / _DISTANCE**2
        focal = min(np.sqrt(wanted / np.median(seen)), _WIDEST_PX / 2 * np.sqrt(_DISTANCE**2 - 1))
        px2[size] = seen * focal**2
        width = int(2 * focal / np.sqrt(_DISTANCE**2 - 1)) + 8
        for side in range(_SIDES):
            shift = shifts.uniform(-0.5, 0.5, 2)
            camera = _camera(center, radius, side, focal, width, shift)
            truth = _picture(leaves, camera.scaled(_SAMPLES), own)
            truth = truth.reshape(width, _SAMPLES, width, _SAMPLES, 3).mean(axis=(1, 3))
            off = _off(_picture(leaves, camera, own) - truth), _off(_picture(level, camera, coarse) - truth)
            shares = _by_leaf(black, camera, own, np.stack([*off, 0 * off[0]], axis=2))
            loss[size] += np.add.reduceat(shares, plan.levels[1].leaf_offset[:-1]).T
    return loss, px2


def _camera(center: _Floats, radius: float, side: int, focal: float, width: int, shift: _Floats) -> Camera:
    """Looks at the ball from afar, from evenly all around; its pixels lie elsewhere by a part of one."""
    z, angle = 1 - (2 * side + 1) / _SIDES, np.pi * (1 + np.sqrt(5)) * (side + 0.5)
    outwards = np.array([*np.sqrt(1 - z * z) * np.array([np.cos(angle), np.sin(angle)]), z])
    eye, up = center + _DISTANCE * radius * outwards, np.eye(3)[np.abs(outwards).argmin()]
    u, v = width / 2 + shift
    K = np.array([[focal, 0, u], [0, focal, v], [0, 0, 1]])
    return Camera(Camera.look_at(eye, center, up, width=width, height=width).viewmat, K, width, width, radius)


def _picture(gaussians: Gaussians, camera: Camera, way: dict[str, Any]) -> _Floats:
    color: _Floats = _device.to_host(rasterize(gaussians, camera, background=(1, 1, 1), **way).color)
    return color.clip(0, 1)


def _off(difference: _Floats) -> _Floats:
    for axis in (0, 1):  # as little is seen of what is off in a single pixel; the border is empty
        both = np.roll(difference, 1, axis) + np.roll(difference, -1, axis)
        difference = (2 * difference + both) / 4
    off: _Floats = np.abs(difference).mean(axis=2) ** np.float32(_POWER)
    return off


def _by_leaf(black: Gaussians, camera: Camera, way: dict[str, Any], of_pixels: _Floats) -> _Floats:
    """(N, 2) sums over pixels of two of their values, each shared out by how much is seen of whom."""
    options = {"background": (0, 0, 0), "with_depth": False, "keep_tape": True, "plain_colors": True, **way}
    tape: Any = _core.rasterize(black.rows, camera.core, **options)[4]
    gradient = _device.place_rows(of_pixels, np.ones(len(of_pixels), bool), _device.of(black.means))
    sums: _Floats = _device.to_host(_core.rasterize_backward(tape, gradient, None, None)[4])
    return sums[:, 0, :2].astype(np.float64)
