"""An asset that needs no download: a glazed donut, made from a seed, and a field of many."""

import math
from typing import Any

import numpy as np

from v3dg import _core
from v3dg._numbers import check
from v3dg.gaussians import Gaussians

# Radii: of the circle in the tube's middle, of the tube without and with icing.
_RING, _DOUGH, _TUBE = 0.63, 0.34, 0.37
_SPRINKLES, _SPRINKLE_RADIUS, _SPRINKLE_HALF = 200, 0.013, 0.05
_SPRINKLE_COLORS = np.array(
    [[0.95, 0.95, 0.9], [0.9, 0.6, 0.03], [0.05, 0.3, 0.8], [0.02, 0.5, 0.3], [0.8, 0.05, 0.04]]
)
_TO_SUN = np.array([0.42, -0.50, 0.76])
_SH_C0, _SH_C1 = _core.sh_base0, 0.4886025119029199  # of the constant and the linear basis functions
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def make_donut(num_gaussians: int = 50_000, *, seed: int = 0) -> Gaussians:
    """Make a donut of dough, icing that drips over its rim, and sprinkles.

    Args:
        num_gaussians: How many gaussians, exactly.
        seed: The same seed gives the same gaussians.

    Returns:
        NumPy gaussians of SH degree 1; z is up, the origin in the middle of the hole, the radius 1.

    Raises:
        ValueError: ``num_gaussians`` is below 1,000.
    """
    check("num_gaussians", num_gaussians >= 1000, f"at least 1000, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    count = num_gaussians // 5 // _SPRINKLES  # in each sprinkle
    on_tube = num_gaussians - count * _SPRINKLES
    around, angles = rng.uniform(0, 2 * np.pi, on_tube), np.linspace(-np.pi, np.pi, 1000)
    # Along the tube's section, 0 outside, pi/2 up, spread evenly over its surface.
    share = (_RING * (angles + np.pi) + _TUBE * np.sin(angles)) / (2 * np.pi * _RING)
    along = np.interp(rng.random(on_tube), share, angles)
    phase, outside = rng.uniform(0, 2 * np.pi, (2, 4, 1)), np.cos(along) > 0
    drips = (0.07 * np.sin(np.array([[3], [5], [8], [13]]) * around + np.where(outside, *phase))).sum(0)
    icing = np.clip((np.sin(along) - 0.1 - drips) / 0.08, 0, 1)
    points, normals = _on_tube(around, along, _DOUGH + (_TUBE - _DOUGH) * np.sqrt(icing))
    waves = np.sin(points @ rng.normal(scale=9, size=(3, 6)) + rng.uniform(0, 6.28, 6))
    blotch = waves.mean(1, keepdims=True)
    pale = np.exp(-((along / 0.3) ** 2))[:, None]  # where it floated as it was baked
    dough = np.array([0.42, 0.17, 0.035]) * (1 + 0.5 * blotch)
    dough += (np.array([0.7, 0.46, 0.19]) - dough) * pale
    albedo = dough + (np.array([0.66, 0.11, 0.27]) - dough) * icing[:, None]
    spacing = np.full(on_tube, math.sqrt(4 * np.pi**2 * _RING * _TUBE / on_tube))
    parts = [(points, normals, albedo, spacing, icing)]
    if count:
        parts.append(_sprinkles(count, rng))
    points, normals, albedo, spacing, gloss = (np.concatenate(arrays) for arrays in zip(*parts, strict=True))

    order = rng.permutation(num_gaussians)  # files of trained assets have no order either
    longest = 1.2 * spacing * np.exp(rng.normal(scale=0.4, size=num_gaussians))
    middle = longest * np.exp(-rng.gamma(2, 0.25, num_gaussians))
    thinnest = middle * np.exp(-rng.gamma(3, 0.7, num_gaussians))
    opacities = 1 / (1 + np.exp(-rng.normal(1.5, 2, num_gaussians)))
    scales = np.stack([longest, middle, thinnest], 1)
    arrays = points, _quats(normals, rng), scales, opacities, _lit(normals, albedo, gloss)
    return Gaussians(*(array[order].astype(np.float32) for array in arrays))


def _on_tube(around: Any, along: Any, radius: Any) -> tuple[Any, Any]:
    """Points and their normals, (n, 3)."""
    outwards = np.stack([np.cos(around), np.sin(around), 0 * around], 1)
    normals = np.cos(along)[:, None] * outwards + np.sin(along)[:, None] * np.array([0.0, 0.0, 1.0])
    return _RING * outwards + np.asarray(radius)[..., None] * normals, normals


def _sprinkles(count: int, rng: np.random.Generator) -> tuple[Any, ...]:
    """Sugar rods of so many gaussians each, that lie on the icing in all directions."""
    around, along = rng.uniform(0, 2 * np.pi, _SPRINKLES), rng.uniform(0.2 * np.pi, 0.8 * np.pi, _SPRINKLES)
    seats, up = _on_tube(around, along, np.full(_SPRINKLES, _TUBE))
    axis = np.cross(up, rng.normal(size=(_SPRINKLES, 3)))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = rng.uniform(0, 2 * np.pi, (_SPRINKLES, count, 1))
    normals = np.cos(turn) * up[:, None] + np.sin(turn) * np.cross(axis, up)[:, None]
    places = rng.uniform(-_SPRINKLE_HALF, _SPRINKLE_HALF, (_SPRINKLES, count, 1)) * axis[:, None]
    points = seats[:, None] + places + _SPRINKLE_RADIUS * normals
    num = _SPRINKLES * count
    albedo = np.repeat(_SPRINKLE_COLORS[np.arange(_SPRINKLES) % len(_SPRINKLE_COLORS)], count, axis=0)
    spacing = 0.7 * math.sqrt(4 * np.pi * _SPRINKLE_RADIUS * _SPRINKLE_HALF / count)
    return points.reshape(-1, 3), normals.reshape(-1, 3), albedo, np.full(num, spacing), np.full(num, 0.3)


def _quats(normals: Any, rng: np.random.Generator) -> Any:
    """Rotations that take z to the normals, after any turn about z."""
    x, y, z = (half := normals + np.array([0.0, 0.0, 1.0 + 1e-9])).T / np.linalg.norm(half, axis=1)
    turn = rng.uniform(0, np.pi, len(normals))
    c, s = np.cos(turn), np.sin(turn)
    return np.stack([-z * s, x * c + y * s, y * c - x * s, z * c], 1)


def _lit(normals: Any, albedo: Any, gloss: Any) -> Any:
    """Colours under a sun and a sky, with highlights that lean towards the sun's mirror image, (n, 4, 3)."""
    facing = np.maximum(normals @ _TO_SUN, 0)[:, None]
    light = facing * np.array([1.5, 1.4, 1.2]) + (0.45 + 0.3 * normals[:, 2:]) * np.array([0.5, 0.55, 0.62])
    color = np.clip(albedo * light, 0, 1) ** (1 / 2.2)
    lean = 0.35 * gloss[:, None] * facing**4 * (2 * facing * normals - _TO_SUN)
    x, y, z = lean.T[..., None] / _SH_C1 * np.ones(3)
    # The basis functions of degree 1 are -y, z, -x of the direction from the eye.
    return np.stack([(color - 0.5) / _SH_C0, y, -z, x], 1)


def place_field(count: int = 2000, *, seed: int = 0) -> tuple[Any, Any, Any]:
    """Place donuts side by side on a round hill, turned at random, at 3/4 to full size.

    Returns:
        Positions (count, 3), quaternions (count, 4) w x y z and scales (count,), float64.

    Raises:
        ValueError: ``count`` is below 1.
    """
    check("count", count >= 1, f"at least 1, got {count}")
    rng = np.random.default_rng(seed)
    away, angle = 1.15 * np.sqrt(np.arange(count)), _GOLDEN_ANGLE * np.arange(count)
    height = -0.16 * away**2 / max(away[-1], 1.0) + _TUBE
    turn, lean = rng.uniform(0, np.pi, count), rng.normal(scale=0.12, size=(count, 2))
    quaternions = np.column_stack([np.cos(turn), lean, np.sin(turn)])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    positions = np.stack([away * np.cos(angle), away * np.sin(angle), height], 1)
    return positions, quaternions, rng.uniform(0.75, 1.0, count)
