"""Gaussians without lighting, and the shapes of which assets are composed."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))
UP = np.array([0.0, 0.0, 1.0])


@dataclass
class Part:
    """n gaussians before lighting. Their colours are linear reflectances."""

    means: Array  # (n,3)
    tangents: Array  # (n,3) unit vectors, the axis of the first scale
    normals: Array  # (n,3) unit vectors, the axis of the third scale
    scales: Array  # (n,3)
    opacities: Array  # (n,)
    albedo: Array  # (n,3)
    gloss: Array  # (n,) strength of the highlight; 0 is matt
    translucency: Array  # (n,) fraction of light that passes through; 0 is opaque
    occlusion: Array  # (n,) visible fraction of the sky

    @staticmethod
    def concatenate(parts: Sequence[Part]) -> Part:
        return Part(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Part)))

    def first(self, n: int) -> Part:
        """Return the first n gaussians, which gives an exact number."""
        return Part(*(getattr(self, f.name)[:n] for f in fields(Part)))

    def moved(self, rotation: Array, translation: Array) -> Part:
        turned = (x @ rotation.T for x in (self.means, self.tangents, self.normals))
        means, tangents, normals = turned
        rest = (getattr(self, f.name) for f in fields(Part)[3:])
        return Part(means + translation, tangents, normals, *rest)


def unit(v: Array) -> Array:
    lengths: Array = np.linalg.norm(v, axis=-1, keepdims=True)
    return v / np.maximum(lengths, 1e-12)


def mix(a: Array | Sequence[float], b: Array | Sequence[float], weight: Array) -> Array:
    """Return colours between ``a`` (weight 0) and ``b`` (weight 1), a row for each
    weight."""
    w = weight[:, None]
    return np.asarray(a) * (1 - w) + np.asarray(b) * w


def smoothstep(low: float, high: float, x: Array) -> Array:
    t = np.clip((x - low) / (high - low), 0, 1)
    return t * t * (3 - 2 * t)


def rotation(axis: Array, angle: float) -> Array:
    x, y, z = unit(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn: Array = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return turn


class Noise:
    """Smooth noise in [0,1] as a function of position, interpolated from a periodic
    lattice of random values."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._lattice = rng.random((32, 32, 32))

    def __call__(self, points: Array, frequency: float, octaves: int = 3) -> Array:
        total, weight = np.zeros(len(points)), 0.0
        for octave in range(octaves):
            total += 0.5**octave * self._once(points * (frequency * 2**octave) + 17.3 * octave)
            weight += 0.5**octave
        return total / weight

    def _once(self, points: Array) -> Array:
        floor = np.floor(points)
        f = points - floor
        f = f * f * (3 - 2 * f)
        low = floor.astype(np.int64) & 31
        high = (low + 1) & 31
        fx, fy, fz = f.T
        lattice = self._lattice.ravel()
        x0, x1 = low[:, 0] << 10, high[:, 0] << 10
        y0, y1 = low[:, 1] << 5, high[:, 1] << 5
        z0, z1 = low[:, 2], high[:, 2]

        def along_x(yz: NDArray[np.int64]) -> Array:
            a = lattice[x0 + yz]
            return np.asarray(a + fx * (lattice[x1 + yz] - a))

        near, far = along_x(y0 + z0), along_x(y0 + z1)
        near += fy * (along_x(y1 + z0) - near)
        far += fy * (along_x(y1 + z1) - far)
        return np.asarray(near + fz * (far - near))


@dataclass
class Surface:
    """n evenly distributed points on a surface of revolution around z."""

    points: Array  # (n,3)
    normals: Array  # (n,3) unit vectors that point outwards
    around: Array  # (n,3) unit tangents around the axis
    along: Array  # (n,) position on the profile, 0 at its start to 1 at its end
    angle: Array  # (n,) radians around the axis
    spacing: float  # side of the square whose area one point represents


def revolve(profile: Callable[[Array], tuple[Array, Array]], n: int) -> Surface:
    """Distribute points with equal area each in a golden-angle spiral. ``profile`` maps
    [0,1] to radius and height."""
    t = np.linspace(0, 1, 513)
    radius, height = profile(t)
    step = np.hypot(np.diff(radius), np.diff(height))
    area = np.concatenate([[0], np.cumsum(np.pi * (radius[1:] + radius[:-1]) * step)])
    along = np.interp((np.arange(n) + 0.5) / max(n, 1) * area[-1], area, t)
    r, z = profile(along)
    r1, z1 = profile(np.minimum(along + 1e-4, 1))
    r0, z0 = profile(np.maximum(along - 1e-4, 0))
    slope = unit(np.stack([r1 - r0, z1 - z0], -1))
    angle = np.arange(n) * GOLDEN_ANGLE
    cos, sin = np.cos(angle), np.sin(angle)
    points = np.stack([r * cos, r * sin, z], -1)
    # The profile runs from the top outwards and down, so its left side is the outside.
    normals = np.stack([-slope[:, 1] * cos, -slope[:, 1] * sin, slope[:, 0]], -1)
    around = np.stack([-sin, cos, np.zeros(n)], -1)
    return Surface(points, normals, around, along, angle, float(np.sqrt(area[-1] / max(n, 1))))


def strips(
    base: Array,
    along: Array,
    up: Array,
    length: Array,
    width: Array,
    bend: Array,
    rows: int,
    columns: int,
    outline: Callable[[Array], Array],
    rng: np.random.Generator,
) -> tuple[Part, Array, Array]:
    """Make K leaves of ``rows`` × ``columns`` gaussians, such as blades of grass,
    petals or leaflets.

    A leaf starts at ``base``, extends ``along`` and bends away from ``up`` by ``bend``.
    ``outline`` maps [0,1] to the half width as a fraction of ``width``.

    Returns:
        The leaves, and two positions of each gaussian: along its leaf in [0,1], and
            across it in [-1,1].
    """
    k = len(base)
    t = (np.arange(rows) + 0.5) / rows
    s = (np.arange(columns) + 0.5) / columns * 2 - 1
    t, s = (x.ravel() for x in np.meshgrid(t, s, indexing="ij"))
    t = np.clip(t + rng.uniform(-0.25, 0.25, (k, rows * columns)) / rows, 0.01, 0.99)
    s = s + rng.uniform(-0.25, 0.25, (k, rows * columns)) / columns
    half = outline(t) * width[:, None]
    along, up = unit(along), unit(up - along * np.sum(unit(along) * up, 1, keepdims=True))
    side = np.cross(up, along)
    drop = -bend[:, None] * length[:, None] * t * t
    curl = 0.25 * half * (s * s)  # the edges rise, so that the leaf is a shallow gutter
    means = (
        base[:, None]
        + along[:, None] * (length[:, None] * t)[..., None]
        + up[:, None] * (drop + curl)[..., None]
        + side[:, None] * (half * s)[..., None]
    )
    tangent = unit(along[:, None] - 2 * (bend[:, None] * t)[..., None] * up[:, None])
    normal = unit(np.cross(tangent, side[:, None]) + 0.5 * s[..., None] * side[:, None])
    lengthwise = np.broadcast_to(0.62 * length[:, None] / rows, t.shape)
    across = np.maximum(0.68 * half / columns, 0.05 * lengthwise)
    scales = np.stack([lengthwise, across, 0.15 * across], -1)
    n = k * rows * columns
    logits = 2.6 - 1.3 * t**4 - 0.5 * np.abs(s) ** 3 + 0.8 * rng.standard_normal(t.shape)
    part = Part(
        means.reshape(n, 3),
        tangent.reshape(n, 3),
        normal.reshape(n, 3),
        (scales * np.exp(0.15 * rng.standard_normal(scales.shape))).reshape(n, 3),
        1 / (1 + np.exp(-logits.ravel())),
        np.zeros((n, 3)),
        np.zeros(n),
        np.zeros(n),
        np.ones(n),
    )
    return part, t.ravel(), s.ravel()


def quaternions(tangents: Array, normals: Array) -> Array:
    """Return quaternions (w,x,y,z) of rotations that map x to the tangent and z to the
    normal.

    If the two are not orthogonal, the tangent is only approximated.
    """
    z = unit(normals)
    x = tangents - z * np.sum(tangents * z, 1, keepdims=True)
    stray = np.linalg.norm(x, axis=1) < 1e-6
    x[stray] = np.cross(z[stray], [0.6, 0.0, 0.8]) + np.cross(z[stray], [0.0, 0.6, 0.8])
    x = unit(x)
    y = np.cross(z, x)
    m = np.stack([x, y, z], -1)
    # Each of the four formulas is well conditioned if its component is the largest.
    diagonal = np.stack([m[:, 0, 0], m[:, 1, 1], m[:, 2, 2]], -1)
    squares = np.stack(
        [
            1 + diagonal.sum(1),
            1 + 2 * diagonal[:, 0] - diagonal.sum(1),
            1 + 2 * diagonal[:, 1] - diagonal.sum(1),
            1 + 2 * diagonal[:, 2] - diagonal.sum(1),
        ],
        -1,
    )
    wx, wy, wz = m[:, 2, 1] - m[:, 1, 2], m[:, 0, 2] - m[:, 2, 0], m[:, 1, 0] - m[:, 0, 1]
    xy, xz, yz = m[:, 0, 1] + m[:, 1, 0], m[:, 0, 2] + m[:, 2, 0], m[:, 1, 2] + m[:, 2, 1]
    candidates = np.stack(
        [
            np.stack([squares[:, 0], wx, wy, wz], -1),
            np.stack([wx, squares[:, 1], xy, xz], -1),
            np.stack([wy, xy, squares[:, 2], yz], -1),
            np.stack([wz, xz, yz, squares[:, 3]], -1),
        ],
        1,
    )
    return unit(candidates[np.arange(len(m)), np.argmax(squares, 1)])


def allot(weights: Array, n: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Assign n gaussians to weighted items, in the items' order and as evenly as the
    weights allow."""
    ends = np.cumsum(weights)
    at = (np.arange(n) + rng.random(n)) / max(n, 1) * ends[-1]
    return np.asarray(np.minimum(np.searchsorted(ends, at, side="right"), len(weights) - 1))


def leaf_outline(t: Array) -> Array:
    """Return the half width along a leaf, at most 1. The leaf is round at its base and
    narrow at its tip."""
    return np.sqrt(np.clip(t * (1.06 - t) * 3.6, 0.03, 1))


@dataclass
class Patch:
    """n evenly distributed points on a parametric surface."""

    points: Array  # (n,3)
    # (n,3) unit vectors along the cross product of the derivatives by u and v.
    normals: Array
    tangents: Array  # (n,3) unit vectors along the derivative by u
    u: Array  # (n,) in [0,1]
    v: Array  # (n,) in [0,1]
    # (n,2) distances to the borders of the surface, along and across the tangent.
    room: Array
    area: float

    @property
    def spacing(self) -> float:
        """The side of the square whose area one point represents."""
        return float(np.sqrt(self.area / max(len(self.u), 1)))


# Maps u and v (n,) in [0,1] to points (n,3).
SurfaceMap: TypeAlias = Callable[[Array, Array], Array]


def surface_area(surface: SurfaceMap, cells: int = 64) -> float:
    """Return the area of a parametric surface, computed on a grid with ``cells`` cells
    per side."""
    return float(_cell_areas(surface, cells).sum())


def _cell_areas(surface: SurfaceMap, cells: int) -> Array:
    edge = np.linspace(0, 1, cells + 1)
    u, v = (x.ravel() for x in np.meshgrid(edge, edge, indexing="ij"))
    p = surface(u, v).reshape(cells + 1, cells + 1, 3)
    diagonals = np.cross(p[1:, 1:] - p[:-1, :-1], p[:-1, 1:] - p[1:, :-1])
    areas: Array = 0.5 * np.linalg.norm(diagonals, axis=-1).ravel()
    return areas


def sample(
    surface: SurfaceMap, n: int, rng: np.random.Generator, cells: int = 64, *, closed: str = ""
) -> Patch:
    """Distribute n points on a parametric surface, with equal numbers on equal areas.

    ``closed`` names the parameters, u or v, in whose direction the surface has no
    border.
    """
    areas = _cell_areas(surface, cells)
    cell = allot(areas, n, rng)
    u, v = (cell // cells + rng.random(n)) / cells, (cell % cells + rng.random(n)) / cells
    points, step = surface(u, v), 1e-4
    back_u, back_v = np.where(u > 0.5, -step, step), np.where(v > 0.5, -step, step)
    du = (surface(u + back_u, v) - points) / back_u[:, None]
    dv = (surface(u, v + back_v) - points) / back_v[:, None]
    length_u, length_v = np.linalg.norm(du, axis=1), np.linalg.norm(dv, axis=1)
    cosine = np.abs(np.sum(du * dv, axis=1)) / np.maximum(length_u * length_v, 1e-12)
    sine = np.sqrt(np.maximum(1 - cosine**2, 0))
    endless = np.full(n, np.inf)
    room_u = endless if "u" in closed else length_u * np.minimum(u, 1 - u)
    room_v = endless if "v" in closed else length_v * np.minimum(v, 1 - v) * sine
    # On a skew surface, the borders at the sides can also be reached across the
    # tangent.
    room = np.stack([room_u, np.minimum(room_v, room_u * sine / np.maximum(cosine, 1e-9))], -1)
    return Patch(points, unit(np.cross(du, dv)), unit(du), u, v, room, float(areas.sum()))


def cover(
    points: Array,
    normals: Array,
    tangents: Array,
    spacing: Array | float,
    albedo: Array,
    rng: np.random.Generator,
    *,
    gloss: Array | float = 0.0,
    translucency: Array | float = 0.0,
    aligned: float = 0.0,
    opacity: float = 0.3,
    bend: Array | float = np.inf,
    room: Array | None = None,
) -> Part:
    """Return flat gaussians that together cover a surface, from points at distances of
    ``spacing``.

    Sizes, shapes and opacities have the distributions of a trained asset
    (docs/worlds.md): the mean size is lognormal, the ratios of neighbouring axes are
    exponentials of gamma variates, and logits of opacities are normal with deviation
    2.3 around ``opacity``. The long axes lie in the surface, in all directions or, with
    ``aligned`` = 1, along the tangents.

    Axes that would stick out of the surface are shortened, as by training. ``bend`` is
    the smallest radius of curvature of the surface; with ``aligned``, only the
    curvature across the tangents counts. ``room`` (n,2) has the distances to the
    surface's borders along and across the tangents. Near a border, long axes are
    parallel to it.
    """
    n = len(points)
    spacing = np.broadcast_to(np.asarray(spacing, dtype=np.float64), n)
    middle_ratio = np.exp(0.4 * rng.gamma(3.0, size=n))
    thin_ratio = np.exp(0.5 * rng.gamma(3.0, size=n))
    size = 0.75 * spacing * np.exp(0.7 * rng.standard_normal(n))
    # These gaussians are large and opaque, and lie slightly below the others, so that
    # nothing shines through gaps.
    base = rng.random(n) < 0.12
    size[base] = 2.2 * spacing[base]
    middle_ratio[base] = np.minimum(middle_ratio[base], 2)
    # At two standard deviations, the ends of this length rise above the surface by less
    # than the spacing.
    longest = np.sqrt(0.4 * bend * spacing)
    long, middle = size * np.sqrt(middle_ratio), np.minimum(size / np.sqrt(middle_ratio), longest)
    angle = rng.uniform(-np.pi / 2, np.pi / 2, n) * (1 - aligned) + 0.1 * rng.standard_normal(n)
    if room is not None:
        beside = room.min(axis=1) < 2 * long
        lengthwise = room[:, 1] <= room[:, 0]
        angle = np.where(beside, np.where(lengthwise, 0.0, np.pi / 2), angle)
        # Two standard deviations of this length reach the border.
        space = np.maximum(0.45 * room, 0.22 * spacing[:, None])
        free = np.where(beside, np.where(lengthwise, space[:, 0], space[:, 1]), np.inf)
        long = np.minimum(long, free)
        free = np.where(beside, np.where(lengthwise, space[:, 1], space[:, 0]), np.inf)
        middle = np.minimum(middle, free)
    bent = np.abs(np.sin(angle)) if aligned else np.ones(n)
    long = np.minimum(long, longest / np.maximum(bent, 1e-3))
    across = np.cross(normals, tangents)
    turned = tangents * np.cos(angle)[:, None] + across * np.sin(angle)[:, None]
    tilt = 0.06 * np.minimum(1, spacing / long)[:, None]
    return Part(
        points - normals * (np.where(base, 0.5, 0.0) * spacing)[:, None],
        turned,
        unit(normals + tilt * rng.standard_normal((n, 3))),
        np.stack([long, middle, np.minimum(long, middle) / thin_ratio], -1),
        1
        / (
            1
            + np.exp(
                -(np.where(base, 4.5, opacity) + np.where(base, 1.0, 2.3) * rng.standard_normal(n))
            )
        ),
        albedo,
        np.broadcast_to(np.asarray(gloss, dtype=np.float64), n).copy(),
        np.broadcast_to(np.asarray(translucency, dtype=np.float64), n).copy(),
        np.ones(n),
    )
