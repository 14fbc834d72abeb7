"""A test asset that needs no data: a glazed donut generated from a seed, and positions
for a field of donuts."""

import math
from dataclasses import dataclass

import numpy as np

from v3dg import _core
from v3dg._numbers import Floats, check
from v3dg.gaussians import Gaussians

_RING = 0.63  # radius of the circle at the centre of the tube
_DOUGH = 0.34  # radius of the tube without icing
_TUBE = 0.37  # radius of the tube with icing
_SPRINKLES = 200
_SPRINKLE_RADIUS = 0.013
_SPRINKLE_HALF = 0.05  # half of the length of a sprinkle
_SPRINKLE_COLORS = np.array(
    [[0.95, 0.95, 0.9], [0.9, 0.6, 0.03], [0.05, 0.3, 0.8], [0.02, 0.5, 0.3], [0.8, 0.05, 0.04]]
)
_TO_SUN = np.array([0.42, -0.50, 0.76])
_SH_C0 = _core.sh_base0  # value of the constant basis function
_SH_C1 = 0.4886025119029199  # factor of the linear basis functions
_GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def make_donut(num_gaussians: int = 50_000, *, seed: int = 0) -> Gaussians:
    """Make a donut with icing and sprinkles.

    Args:
        num_gaussians: Exact number of gaussians.
        seed: The same seed gives the same gaussians.

    Returns:
        NumPy gaussians of SH degree 1. z is up, the origin is the middle of the hole,
        and the radius is 1.

    Raises:
        ValueError: ``num_gaussians`` is below 1,000.
    """
    check("num_gaussians", num_gaussians >= 1000, f"at least 1000, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    count = num_gaussians // 5 // _SPRINKLES  # number of gaussians in each sprinkle
    on_tube = num_gaussians - count * _SPRINKLES
    surface = _tube(on_tube, rng)
    if count:
        surface = surface.followed_by(_sprinkles(count, rng))
    # Shuffle the gaussians, because their order is random in files of trained assets,
    # too.
    order = rng.permutation(num_gaussians)
    longest = 1.2 * surface.spacing * np.exp(rng.normal(scale=0.4, size=num_gaussians))
    middle = longest * np.exp(-rng.gamma(2, 0.25, num_gaussians))
    thinnest = middle * np.exp(-rng.gamma(3, 0.7, num_gaussians))
    opacities = 1 / (1 + np.exp(-rng.normal(1.5, 2, num_gaussians)))
    scales = np.stack([longest, middle, thinnest], 1)
    arrays = [
        surface.points,
        _quats(surface.normals, rng),
        scales,
        opacities,
        _lit(surface.normals, surface.albedo, surface.gloss),
    ]
    return Gaussians(*(array[order].astype(np.float32) for array in arrays))


@dataclass(frozen=True, eq=False)
class _Surface:
    """Points on a surface.

    Attributes:
        points: (n, 3).
        normals: (n, 3).
        albedo: (n, 3), linear RGB.
        spacing: (n,) distance to the nearest other points.
        gloss: (n,), 0 to 1.
    """

    points: Floats
    normals: Floats
    albedo: Floats
    spacing: Floats
    gloss: Floats

    def followed_by(self, surface: "_Surface") -> "_Surface":
        """Return a surface with the points of this one, followed by the points of
        another."""
        pairs = zip(vars(self).values(), vars(surface).values(), strict=True)
        return _Surface(*(np.concatenate(arrays) for arrays in pairs))


def _tube(count: int, rng: np.random.Generator) -> _Surface:
    """Return the dough and its icing, with this number of points."""
    azimuth = rng.uniform(0, 2 * np.pi, count)
    angles = np.linspace(-np.pi, np.pi, 1000)
    # The angle in the cross-section of the tube is 0 at the outside and pi/2 at the
    # top. Angles are chosen such that points are evenly distributed over the surface.
    share = (_RING * (angles + np.pi) + _TUBE * np.sin(angles)) / (2 * np.pi * _RING)
    section_angle = np.interp(rng.random(count), share, angles)
    phase = rng.uniform(0, 2 * np.pi, (2, 4, 1))
    is_outside = np.cos(section_angle) > 0
    frequency = np.array([[3], [5], [8], [13]])
    drips = (0.07 * np.sin(frequency * azimuth + np.where(is_outside, *phase))).sum(0)
    icing = np.clip((np.sin(section_angle) - 0.1 - drips) / 0.08, 0, 1)
    points, normals = _on_tube(azimuth, section_angle, _DOUGH + (_TUBE - _DOUGH) * np.sqrt(icing))
    waves = np.sin(points @ rng.normal(scale=9, size=(3, 6)) + rng.uniform(0, 6.28, 6))
    blotch = waves.mean(1, keepdims=True)
    # The stripe of a donut that stays above the oil during frying is pale.
    pale = np.exp(-((section_angle / 0.3) ** 2))[:, None]
    dough = np.array([0.42, 0.17, 0.035]) * (1 + 0.5 * blotch)
    dough += (np.array([0.7, 0.46, 0.19]) - dough) * pale
    albedo = dough + (np.array([0.66, 0.11, 0.27]) - dough) * icing[:, None]
    spacing = np.full(count, math.sqrt(4 * np.pi**2 * _RING * _TUBE / count))
    return _Surface(points, normals, albedo, spacing, icing)


def _on_tube(azimuth: Floats, section_angle: Floats, radius: Floats) -> tuple[Floats, Floats]:
    """Return points and their normals, (n, 3)."""
    outwards = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1)
    normals = np.cos(section_angle)[:, None] * outwards
    normals = normals + np.sin(section_angle)[:, None] * np.array([0.0, 0.0, 1.0])
    return _RING * outwards + radius[:, None] * normals, normals


def _sprinkles(count: int, rng: np.random.Generator) -> _Surface:
    """Return sprinkles. They are rods of ``count`` points each, which lie on the icing
    in random directions."""
    azimuth = rng.uniform(0, 2 * np.pi, _SPRINKLES)
    section_angle = rng.uniform(0.2 * np.pi, 0.8 * np.pi, _SPRINKLES)
    seats, up = _on_tube(azimuth, section_angle, np.full(_SPRINKLES, _TUBE))
    axis = np.cross(up, rng.normal(size=(_SPRINKLES, 3)))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    turn = rng.uniform(0, 2 * np.pi, (_SPRINKLES, count, 1))
    normals = np.cos(turn) * up[:, None] + np.sin(turn) * np.cross(axis, up)[:, None]
    places = rng.uniform(-_SPRINKLE_HALF, _SPRINKLE_HALF, (_SPRINKLES, count, 1)) * axis[:, None]
    points = seats[:, None] + places + _SPRINKLE_RADIUS * normals
    num = _SPRINKLES * count
    albedo = np.repeat(
        _SPRINKLE_COLORS[np.arange(_SPRINKLES) % len(_SPRINKLE_COLORS)], count, axis=0
    )
    spacing = 0.7 * math.sqrt(4 * np.pi * _SPRINKLE_RADIUS * _SPRINKLE_HALF / count)
    return _Surface(
        points.reshape(-1, 3),
        normals.reshape(-1, 3),
        albedo,
        np.full(num, spacing),
        np.full(num, 0.3),
    )


def _quats(normals: Floats, rng: np.random.Generator) -> Floats:
    """Return quaternions (n, 4) of rotations that map z to the normals, after a random
    rotation about z."""
    half = normals + np.array([0.0, 0.0, 1.0 + 1e-9])
    x, y, z = half.T / np.linalg.norm(half, axis=1)
    turn = rng.uniform(0, np.pi, len(normals))
    cosine = np.cos(turn)
    sine = np.sin(turn)
    return np.stack([-z * sine, x * cosine + y * sine, y * cosine - x * sine, z * cosine], 1)


def _lit(normals: Floats, albedo: Floats, gloss: Floats) -> Floats:
    """Return SH coefficients (n, 4, 3) of colours that are lit by a sun and a sky. The
    linear coefficients add highlights in the direction of the sun's reflection."""
    facing = np.maximum(normals @ _TO_SUN, 0)[:, None]
    light = facing * np.array([1.5, 1.4, 1.2]) + (0.45 + 0.3 * normals[:, 2:]) * np.array(
        [0.5, 0.55, 0.62]
    )
    color = np.clip(albedo * light, 0, 1) ** (1 / 2.2)
    lean = 0.35 * gloss[:, None] * facing**4 * (2 * facing * normals - _TO_SUN)
    x, y, z = lean.T[..., None] / _SH_C1 * np.ones(3)
    # The basis functions of degree 1 are -y, z, -x of the direction from the eye.
    return np.stack([(color - 0.5) / _SH_C0, y, -z, x], 1)


def place_field(count: int = 2000, *, seed: int = 0) -> tuple[Floats, Floats, Floats]:
    """Place donuts side by side on a round hill, with random rotations and scales from
    3/4 to 1.

    Returns:
        Positions (count, 3), quaternions (count, 4) w x y z and scales (count,),
        float64.

    Raises:
        ValueError: ``count`` is below 1.
    """
    check("count", count >= 1, f"at least 1, got {count}")
    rng = np.random.default_rng(seed)
    distance = 1.15 * np.sqrt(np.arange(count))
    angle = _GOLDEN_ANGLE * np.arange(count)
    height = -0.16 * distance**2 / max(distance[-1], 1.0) + _TUBE
    turn = rng.uniform(0, np.pi, count)
    lean = rng.normal(scale=0.12, size=(count, 2))
    quaternions = np.column_stack([np.cos(turn), lean, np.sin(turn)])
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    positions = np.stack([distance * np.cos(angle), distance * np.sin(angle), height], 1)
    return positions, quaternions, rng.uniform(0.75, 1.0, count)
