"""A 3DGS asset that needs no download: toadstools on a mossy tuft, and a meadow of such
tufts.

The gaussians are distributed as in trained assets: thin discs cover surfaces, needles
follow blades of grass, sizes and opacities vary widely, and the colours of glossy and
translucent parts depend on the view. The simulation of light is simple: one sun with
soft shadows, a sky, and some occlusion.

z is up, the ground is near z = 0, and the radius of the tuft is about 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.procedural._light import SH_C0, SH_C1, SKY, SUN, TO_SUN, display
from benchmarks.worlds.procedural._parts import (
    GOLDEN_ANGLE,
    UP,
    Array,
    Noise,
    Part,
    mix,
    quaternions,
    revolve,
    rotation,
    smoothstep,
    strips,
    unit,
)
from v3dg.gaussians import Gaussians


def _discs(
    points: Array,
    normals: Array,
    tangents: Array,
    spacing: float,
    albedo: Array,
    rng: np.random.Generator,
    *,
    stretch: float = 1.0,
    gloss: float = 0.0,
    translucency: float = 0.0,
    opacity: float = 2.2,
    overlap: float = 0.75,
) -> Part:
    """Return thin discs that together cover a surface, from points at distances of
    ``spacing``.

    ``stretch`` lengthens the discs along their tangents and preserves their area.
    ``opacity`` is the middle of the distribution of logits. A sixth of the discs is
    much fainter, as after training.
    """
    n = len(points)
    size = overlap * spacing * np.exp(0.22 * rng.standard_normal(n))
    long = np.sqrt(stretch) * np.exp(np.abs(0.25 * rng.standard_normal(n)))
    scales = np.stack(
        [size * long, size / long, 0.12 * size * np.exp(0.5 * rng.standard_normal(n))], -1
    )
    logits = opacity + 1.1 * rng.standard_normal(n) - 3.4 * (rng.random(n) < 1 / 6)
    return Part(
        points + 0.06 * spacing * rng.standard_normal((n, 3)),
        unit(tangents + 0.12 * rng.standard_normal((n, 3))),
        unit(normals + 0.08 * rng.standard_normal((n, 3))),
        scales,
        1 / (1 + np.exp(-logits)),
        albedo,
        np.full(n, gloss),
        np.full(n, translucency),
        np.ones(n),
    )


def _ground_height(points: Array, noise: Noise) -> Array:
    """Return the height of the tuft's soil at points: a low mound that falls towards
    its rim."""
    r = np.hypot(points[:, 0], points[:, 1])
    flat = np.stack([points[:, 0], points[:, 1], np.zeros(len(points))], -1)
    return 0.13 * (1 - r**2) + 0.07 * (noise(flat, 2.5, 2) - 0.5) - 0.03 * smoothstep(0.85, 1.05, r)


def _ground(n: int, noise: Noise, rng: np.random.Generator) -> Part:
    """Return moss: a closed layer of discs, covered by a fur of needles."""
    n_base = n // 3
    # The layer extends below the rims of neighbouring tufts.
    disc = revolve(lambda t: (1.18 * t, np.zeros_like(t)), n_base)
    points = disc.points.copy()
    points[:, 2] = _ground_height(points, noise)
    e = 1e-3
    dx = (_ground_height(points + np.array([e, 0, 0]), noise) - points[:, 2]) / e
    dy = (_ground_height(points + np.array([0, e, 0]), noise) - points[:, 2]) / e
    normals = unit(np.stack([-dx, -dy, np.ones(n_base)], -1))
    patch = noise(points, 5.0)
    base = _discs(
        points,
        normals,
        disc.around,
        disc.spacing,
        mix([0.060, 0.130, 0.018], [0.160, 0.220, 0.034], patch),
        rng,
        overlap=0.95,
        opacity=3.0,
    )
    base.occlusion[:] = 0.65

    n_fur = n - n_base
    r, a = np.sqrt(rng.random(n_fur)) * 1.02, rng.uniform(0, 2 * np.pi, n_fur)
    root = np.stack([r * np.cos(a), r * np.sin(a), np.zeros(n_fur)], -1)
    root[:, 2] = _ground_height(root, noise)
    grow = unit(UP + 0.75 * rng.standard_normal((n_fur, 3)))
    # Moss grows in cushions: its needles are long in the middle of a cushion and short
    # between cushions.
    cushion = noise(root, 7.0, 2)
    size = 0.022 * np.sqrt(30000 / max(n_fur, 1)) ** 0.5 * (0.55 + 0.9 * cushion)
    height = rng.random(n_fur) * (0.01 + 0.08 * cushion**2)
    fresh = np.clip(
        0.55 * noise(root + 9, 4.0) + 0.6 * height / 0.05 - 0.1 + 0.22 * rng.standard_normal(n_fur),
        0,
        1,
    )
    fur = Part(
        root + grow * (height + 0.3 * size)[:, None],
        grow,
        unit(np.cross(grow, rng.standard_normal((n_fur, 3)))),
        size[:, None] * [0.75, 0.22, 0.14] * np.exp(0.3 * rng.standard_normal((n_fur, 3))),
        1
        / (1 + np.exp(-(1.4 + 1.3 * rng.standard_normal(n_fur) - 3.0 * (rng.random(n_fur) < 0.3)))),
        mix([0.055, 0.120, 0.018], [0.42, 0.50, 0.060], fresh),
        np.zeros(n_fur),
        np.full(n_fur, 0.35),
        0.25 + 0.75 * smoothstep(0.0, 0.045, height),
    )
    return Part.concatenate([base, fur])


@dataclass
class _Toadstool:
    """The position and shape of a toadstool. The unit of length is the radius of the
    tuft."""

    foot: Array  # (3,)
    lean: Array  # (3,3) rotation of the leaning toadstool
    height: float
    radius: float  # radius of the cap
    dome: float  # height of the cap relative to its radius
    size: float  # fraction of all toadstools' gaussians

    @property
    def cap(self) -> Array:
        """The centre of the rim of the cap."""
        centre: Array = self.foot + self.lean @ np.array([0, 0, self.height])
        return centre


def _toadstool(shape: _Toadstool, n: int, noise: Noise, rng: np.random.Generator) -> Part:
    radius, dome, height = shape.radius, shape.dome * shape.radius, shape.height
    offset = rng.uniform(0, 30, 3)

    def cap_profile(t: Array) -> tuple[Array, Array]:
        # In radians. The rim of the cap is at pi/2, and the edge beyond it turns
        # inwards.
        a = t * 1.78
        return radius * np.sin(a) ** 0.92, dome * np.cos(a) * np.where(a > np.pi / 2, 0.45, 1.0)

    def wobble(points: Array) -> Array:
        """Deform points of the cap irregularly: the cap is not exactly round, and its
        rim is wavy."""
        a = np.arctan2(points[:, 1], points[:, 0])
        r = np.hypot(points[:, 0], points[:, 1]) / radius
        wave = (
            np.sin(3 * a + offset[0])
            + 0.6 * np.sin(5 * a + offset[1])
            + 0.4 * np.sin(9 * a + offset[2])
        )
        out: Array = points.copy()
        out[:, :2] *= (1 + 0.018 * wave * r)[:, None]
        out[:, 2] += 0.03 * radius * wave * r**3
        return out

    n_warts, n_gills, n_stem, n_skirt = int(0.22 * n), int(0.17 * n), int(0.17 * n), int(0.07 * n)
    cap = revolve(cap_profile, n - n_warts - n_gills - n_stem - n_skirt)
    streak = noise(
        np.stack([6 * cap.angle % (2 * np.pi), 2.0 * cap.along, cap.angle * 0], -1) + offset, 1.2
    )
    blotch = noise(cap.points + offset, 3.0 / radius)
    red = mix(
        [0.36, 0.004, 0.008], [0.66, 0.016, 0.010], np.clip(blotch + 0.5 * (streak - 0.5), 0, 1)
    )
    rim = smoothstep(0.62, 0.98, cap.along + 0.25 * (streak - 0.5))
    red = red * (1 - 0.8 * rim[:, None]) + 0.8 * rim[:, None] * np.array([0.78, 0.105, 0.012])
    meridian = np.cross(cap.normals, cap.around)
    skin = _discs(
        wobble(cap.points), cap.normals, meridian, cap.spacing, red, rng, stretch=1.5, gloss=1.0
    )
    # Gaussians near the rim are shortened, so that the edge has no fringe.
    skin.scales[:, 0] *= 1 - 0.45 * smoothstep(0.85, 1.0, cap.along)
    parts = [skin]

    # Warts are large near the top of the cap, and small crumbs near its rim.
    count = max(8, int(40 * min(1.0, n / 4000) ** 0.5))
    on_cap = revolve(lambda t: cap_profile(0.03 + 0.80 * t), count)
    spots = wobble(on_cap.points)
    sizes = radius * 0.085 * (1.25 - 0.6 * on_cap.along) * np.exp(0.35 * rng.standard_normal(count))
    share = sizes**2 / np.sum(sizes**2)
    for spot, normal, size, m in zip(
        spots, on_cap.normals, sizes, (share * n_warts).astype(int), strict=True
    ):
        lump = revolve(lambda t: (np.sin(t * 1.7), 0.55 * np.cos(t * 1.7)), m)
        a = lump.angle
        ragged = 1 + 0.22 * np.sin(3 * a + spot[0] * 99) + 0.16 * np.sin(7 * a + spot[1] * 99)
        points = lump.points * size
        points[:, :2] *= ragged[:, None]
        points[:, :2] += radius * rng.uniform(-0.10, 0.10, 2)
        points[:, 2] += 0.06 * size * rng.standard_normal(m)
        side = unit(np.cross(normal, [0.3, 0.2, 0.93]))
        frame = np.stack([side, np.cross(normal, side), normal], -1)
        cream = mix(
            [0.62, 0.50, 0.33], [0.95, 0.90, 0.78], lump.points[:, 2] * 0.8 + 0.5 * rng.random(m)
        )
        discs = _discs(
            points, lump.normals, lump.around, lump.spacing * size, np.clip(cream, 0, 1), rng
        )
        discs.occlusion[:] = 0.6 + 0.4 * np.clip(lump.points[:, 2] / 0.4, 0, 1)
        wart = discs.moved(frame, spot - 0.1 * size * normal)
        parts.append(wart)

    # The underside of the cap has gills: narrow rays, alternately bright and dark.
    gill = revolve(
        lambda t: (radius * (0.12 + 0.82 * t), 0.10 * dome * (1 - t) ** 2 - 0.05 * dome), n_gills
    )
    rays = 0.5 + 0.5 * np.sin(gill.angle * 46 + 3 * noise(gill.points + offset, 4.0))
    parts.append(
        _discs(
            wobble(gill.points),
            -gill.normals,
            unit(gill.points * [1, 1, 0]),
            gill.spacing,
            mix([0.33, 0.25, 0.16], [0.86, 0.78, 0.60], rays),
            rng,
            stretch=5.0,
        )
    )
    parts[-1].scales[:, 0] *= 1 - 0.75 * gill.along**4  # no gill extends beyond the rim
    parts[-1].occlusion[:] = 0.45 + 0.30 * gill.along

    # The stem is a fibrous column with a bulb and rings of scales.
    def stem_profile(t: Array) -> tuple[Array, Array]:
        z = 1 - t
        bulb = 0.55 * np.exp(-(((z - 0.10) / 0.13) ** 2)) + 0.10 * np.sin(38 * z) * np.exp(
            -(((z - 0.16) / 0.1) ** 2)
        )
        return radius * 0.20 * (1 + 0.25 * (1 - z) + bulb), height * z * 1.0

    stem = revolve(stem_profile, n_stem)
    fibre = noise(
        np.stack([9 * np.cos(stem.angle), 9 * np.sin(stem.angle), stem.points[:, 2] * 5], -1), 1.0
    )
    cream = mix([0.55, 0.45, 0.30], [0.93, 0.88, 0.76], np.clip(fibre * 1.5 - 0.15, 0, 1))
    part = _discs(
        stem.points, stem.normals, np.tile(UP, (n_stem, 1)), stem.spacing, cream, rng, stretch=3.0
    )
    part.occlusion[:] = 0.55 + 0.45 * smoothstep(0, 0.3, stem.points[:, 2] / height)
    parts.append(part)

    # The skirt is a thin torn veil around the stem.
    skirt = revolve(
        lambda t: (radius * (0.20 + 0.19 * t**0.8), height * (0.80 - 0.13 * t**1.3)), n_skirt
    )
    points = skirt.points.copy()
    points[:, 2] += 0.05 * radius * np.sin(9 * skirt.angle + offset[0]) * skirt.along**2
    veil = _discs(
        points,
        skirt.normals,
        np.cross(skirt.normals, skirt.around),
        skirt.spacing,
        mix([0.66, 0.54, 0.34], [0.98, 0.93, 0.78], noise(points * [1, 1, 0.3] + offset, 14.0)),
        rng,
        stretch=2.0,
        translucency=0.5,
    )
    veil.scales[:, 0] *= 1 - 0.5 * skirt.along**3
    veil.opacities *= 1 - 0.5 * smoothstep(
        0.8, 1.0, skirt.along + 0.3 * (noise(points, 20.0) - 0.5)
    )
    parts.append(veil)

    # The cap is moved onto the stem before the whole toadstool leans.
    for i in range(len(parts) - 2):
        parts[i].means[:, 2] += height
    whole = Part.concatenate(parts)
    return whole.moved(shape.lean, shape.foot)


def _on_ground(n: int, noise: Noise, rng: np.random.Generator, low: float, high: float) -> Array:
    """Return random positions on the ground between two distances from the centre."""
    r = np.sqrt(rng.uniform(low**2, high**2, n))
    a = np.arange(n) * GOLDEN_ANGLE + rng.uniform(0, 2 * np.pi) + 0.5 * rng.standard_normal(n)
    points = np.stack([r * np.cos(a), r * np.sin(a), np.zeros(n)], -1)
    points[:, 2] = _ground_height(points, noise)
    return points


def _grass(n: int, noise: Noise, rng: np.random.Generator) -> Part:
    rows = 12
    k = n // rows
    base = _on_ground(k, noise, rng, 0.1, 1.03)
    r = np.hypot(base[:, 0], base[:, 1])
    lean = unit(
        np.stack([base[:, 0], base[:, 1], 0 * r], -1)
        + 0.8 * rng.standard_normal((k, 3)) * [1, 1, 0]
    )
    tall = noise(base + 3, 3.0, 2)
    length = (0.16 + 0.40 * tall**1.5) * np.exp(0.25 * rng.standard_normal(k)) * (0.75 + 0.35 * r)
    along = unit(UP + lean * rng.uniform(0.1, 0.7, k)[:, None])
    part, t, _ = strips(
        base - 0.02 * UP,
        along,
        unit(UP * 0.6 - lean),
        length,
        rng.uniform(0.009, 0.019, k),
        rng.uniform(0.05, 0.5, k),
        rows,
        1,
        lambda t: (1 - t) ** 0.6 * (0.6 + 0.4 * np.minimum(4 * t, 1)),
        rng,
    )
    hue = np.repeat(np.clip(tall + 0.25 * rng.standard_normal(k), 0, 1), rows)
    dry = np.repeat(rng.random(k) < 0.06, rows)
    tip = mix([0.17, 0.42, 0.045], [0.42, 0.52, 0.08], hue)
    tip[dry] = [0.55, 0.42, 0.16]
    part.albedo = mix([0.030, 0.080, 0.012], tip, smoothstep(0.0, 0.75, t))
    part.gloss[:] = 0.22
    part.translucency[:] = 0.55
    part.occlusion = 0.30 + 0.70 * smoothstep(0.05, 0.6, t)
    return part


@dataclass
class _Flower:
    """A kind of flower. Lengths are relative to the radius of the tuft."""

    petals: int
    rows: int  # number of gaussians along a petal
    columns: int  # number of gaussians across a petal
    heart: int  # number of gaussians in the yellow dome
    stalk: int  # number of gaussians along the stalk
    size: float  # length of a petal
    slim: float  # half width of a petal relative to its length
    low: float
    high: float  # range of the stalk's height, from `low` to `high`
    petal: tuple[float, float, float]
    tip: tuple[float, float, float]

    def __len__(self) -> int:
        return self.petals * self.rows * self.columns + self.heart + self.stalk


_DAISY = _Flower(15, 5, 2, 60, 14, 0.105, 0.16, 0.22, 0.46, (0.90, 0.90, 0.92), (0.85, 0.42, 0.60))
_FORGET_ME_NOT = _Flower(
    5, 3, 2, 6, 6, 0.036, 0.42, 0.10, 0.26, (0.12, 0.24, 0.80), (0.30, 0.48, 0.95)
)


def _flowers(kind: _Flower, n: int, noise: Noise, rng: np.random.Generator) -> Part:
    k = max(1, n // len(kind))
    per_petal = kind.rows * kind.columns
    base = _on_ground(k, noise, rng, 0.40, 0.95)
    height = rng.uniform(kind.low, kind.high, k)
    out = unit(base * [1, 1, 0])
    face = unit(UP + 0.55 * out + 0.25 * rng.standard_normal((k, 3)))
    head = base + UP * height[:, None] + 0.10 * out
    size = kind.size * rng.uniform(0.8, 1.2, k)

    parts = []
    side = unit(np.cross(face, [0.6, 0.8, 0.1]))
    other = np.cross(face, side)
    a = np.arange(kind.petals) * 2 * np.pi / kind.petals + rng.uniform(0, 6, (k, 1))
    a = a + rng.uniform(-0.6, 0.6, a.shape) / kind.petals
    ray = (side[:, None] * np.cos(a)[..., None] + other[:, None] * np.sin(a)[..., None]).reshape(
        -1, 3
    )
    faces, heads, sizes = (np.repeat(x, kind.petals, 0) for x in (face, head, size))
    lift = rng.uniform(-0.1, 0.25, (len(ray), 1))
    part, t, s = strips(
        heads + 0.2 * ray * sizes[:, None],
        ray + lift * faces,
        faces,
        sizes * rng.uniform(0.8, 1.05, len(ray)),
        sizes * kind.slim,
        rng.uniform(0.0, 0.25, len(ray)),
        kind.rows,
        kind.columns,
        lambda t: np.sqrt(np.clip(1 - (2 * t - 1.1) ** 2, 0.08, 1)) * (0.5 + 0.5 * t),
        rng,
    )
    tinge = np.clip(
        (t - 0.45) * np.repeat(rng.uniform(-0.3, 1.3, k), kind.petals * per_petal), 0, 0.6
    )
    part.albedo = mix(kind.petal, kind.tip, tinge) * (1 - 0.12 * np.abs(s))[:, None]
    part.translucency[:] = 0.45
    part.occlusion = 0.75 + 0.25 * t
    parts.append(part)

    for i in range(k):
        dome = revolve(lambda t: (np.sin(t * 1.6), 0.55 * np.cos(t * 1.6)), kind.heart)
        radius = 0.30 * size[i]
        yellow = mix([0.78, 0.36, 0.01], [0.95, 0.66, 0.03], rng.random(kind.heart))
        bump = _discs(
            dome.points * radius,
            dome.normals,
            dome.around,
            dome.spacing * radius,
            yellow,
            rng,
            overlap=0.65,
        )
        bump.occlusion[:] = 0.55 + 0.45 * (1 - dome.along)
        parts.append(bump.moved(np.stack([side[i], other[i], face[i]], -1), head[i]))
    parts.append(_stalks(base, head, 0.008, kind.stalk, rng))
    return Part.concatenate(parts)


def _stalks(base: Array, head: Array, width: float, rows: int, rng: np.random.Generator) -> Part:
    k, toward = len(base), head - base
    up = unit(np.cross(toward, rng.standard_normal((k, 3))))
    length, widths = np.linalg.norm(toward, axis=1), np.full(k, width)
    part, t, _ = strips(base, toward, up, length, widths, np.zeros(k), rows, 1, np.ones_like, rng)
    part.albedo = mix([0.05, 0.11, 0.02], [0.20, 0.36, 0.07], t)
    part.scales[:, 2] = part.scales[:, 1]  # makes the gaussians round, not flat
    part.occlusion = 0.4 + 0.6 * t
    return part


def _clover(n: int, noise: Noise, rng: np.random.Generator) -> Part:
    rows, columns, stalk = 6, 4, 6
    k = max(1, n // (3 * rows * columns + stalk))
    base = _on_ground(k, noise, rng, 0.25, 0.98)
    height = rng.uniform(0.07, 0.17, k)
    face = unit(UP + 0.35 * rng.standard_normal((k, 3)))
    head = base + UP * height[:, None] + 0.02 * rng.standard_normal((k, 3))
    side = unit(np.cross(face, [0.6, 0.8, 0.1]))
    a = np.arange(3) * 2 * np.pi / 3 + rng.uniform(0, 6, (k, 1))
    ray = (
        side[:, None] * np.cos(a)[..., None] + np.cross(face, side)[:, None] * np.sin(a)[..., None]
    )
    size = rng.uniform(0.055, 0.10, k)
    part, t, s = strips(
        np.repeat(head, 3, 0),
        ray.reshape(-1, 3) + 0.15 * np.repeat(face, 3, 0),
        np.repeat(face, 3, 0),
        np.repeat(size, 3),
        np.repeat(size, 3) * 0.52,
        rng.uniform(0.0, 0.2, 3 * k),
        rows,
        columns,
        lambda t: np.sqrt(np.clip(t * (1.25 - t) * 2.4, 0.02, 1)),
        rng,
    )
    chevron = np.exp(-(((t - 0.55 + 0.25 * np.abs(s)) / 0.10) ** 2))
    shade = np.repeat(rng.random(k), 3 * rows * columns)
    green = mix([0.040, 0.17, 0.030], [0.11, 0.29, 0.045], shade)
    part.albedo = mix(green, [0.42, 0.60, 0.34], 0.75 * chevron)
    part.gloss[:] = 0.15
    part.translucency[:] = 0.4
    part.occlusion = 0.7 + 0.3 * t
    return Part.concatenate([part, _stalks(base, head, 0.006, stalk, rng)])


def _pebbles(n: int, noise: Noise, rng: np.random.Generator) -> Part:
    k = 6
    parts = []
    for place in _on_ground(k, noise, rng, 0.5, 0.92):
        m = n // k
        ball = revolve(lambda t: (np.sin(np.pi * t), np.cos(np.pi * t)), m)
        axes = rng.uniform(0.05, 0.12) * np.array(
            [rng.uniform(0.8, 1.4), 1.0, rng.uniform(0.5, 0.75)]
        )
        bulge = 0.85 + 0.3 * noise(ball.points + place * 7, 1.6, 2)
        grain = noise(ball.points + place * 5, 6.0)
        grey = mix([0.16, 0.15, 0.15], [0.52, 0.50, 0.47], grain) * rng.uniform(0.7, 1.2)
        stone = _discs(
            ball.points * bulge[:, None] * axes,
            unit(ball.normals / axes),
            ball.around,
            ball.spacing * float(np.mean(axes)),
            grey,
            rng,
            gloss=0.45,
        )
        stone.occlusion = 0.5 + 0.5 * smoothstep(-0.6, 0.5, ball.points[:, 2])
        parts.append(stone.moved(rotation(UP, rng.uniform(0, 6)), place))
    return Part.concatenate(parts)


def _shadow(points: Array, caps: Sequence[_Toadstool]) -> Array:
    """Return (n,) the fraction of the sun's light that caps let through to points. Caps
    are ellipsoids with soft edges here."""
    light = np.ones(len(points))
    for shape in caps:
        axes = np.array([1, 1, shape.dome]) * shape.radius
        start, ray = (points - shape.cap) / axes, TO_SUN / axes
        nearest = -(start @ ray) / (ray @ ray)
        miss = np.linalg.norm(start + nearest[:, None] * ray, axis=1)
        light *= np.where(nearest > 0.05, 0.25 + 0.75 * smoothstep(0.80, 1.12, miss), 1.0)
    return light


def _under_caps(points: Array, caps: Sequence[_Toadstool]) -> Array:
    """Return (n,) the fraction of the sky above points that caps do not cover."""
    free = np.ones(len(points))
    for shape in caps:
        aside = np.hypot(*(points - shape.cap)[:, :2].T) / shape.radius
        below = smoothstep(0.0, 0.25, shape.cap[2] - points[:, 2])
        near_foot = np.hypot(*(points - shape.foot)[:, :2].T) / shape.radius
        free *= 1 - 0.50 * below * np.exp(-((aside / 0.85) ** 2))
        free *= 1 - 0.35 * np.exp(-((near_foot / 0.35) ** 2)) * smoothstep(
            0.25, 0.0, points[:, 2] - shape.foot[2]
        )
    return free


def _lit(part: Part, caps: Sequence[_Toadstool]) -> Array:
    """Compute the light on gaussians; return their colours as spherical harmonics of
    degree 1, (n,4,3)."""
    facing = part.normals @ TO_SUN
    thin = part.translucency
    sunlit = _shadow(part.means, caps)
    sky = part.occlusion * _under_caps(part.means, caps) * (0.62 + 0.38 * part.normals[:, 2])
    front = np.maximum(facing, 0)
    leaf = 0.45 + 0.55 * np.abs(facing)
    direct = sunlit * ((1 - thin) * front + thin * leaf) * (0.35 + 0.65 * part.occlusion)
    bounce = (
        np.array([0.10, 0.13, 0.05]) * (1 - part.normals[:, 2])[:, None] * part.occlusion[:, None]
    )
    linear = part.albedo * (direct[:, None] * SUN + sky[:, None] * SKY + bounce)
    colour = display(linear)

    # The view-dependent part is linear in the direction v to the eye. The reflection of
    # the sky is brighter if the reflected direction 2 (n.v) n - v points higher; the
    # sun's highlight is brighter towards the sun's reflected direction; and thin parts
    # glow if the sun is behind them.
    n = part.normals
    shine = part.gloss[:, None]
    mirrored_sky = 2 * n[:, 2:] * n - UP
    mirrored_sun = 2 * np.maximum(facing, 0)[:, None] * n - TO_SUN
    highlight = (sunlit * smoothstep(0.35, 0.95, facing))[:, None]
    # (n,3) factors of v.
    white = shine * (0.05 * mirrored_sky + 0.42 * highlight * mirrored_sun)
    glow = (thin * sunlit * part.occlusion)[:, None] * -0.22 * TO_SUN
    tint = colour / np.maximum(colour.max(1, keepdims=True), 1e-3)
    gradient = (
        white[:, :, None] * np.array([1.0, 0.98, 0.94]) + glow[:, :, None] * tint[:, None] * 0.5
    )
    colour = colour + shine * (0.02 - 0.12 * highlight)

    sh = np.empty((len(n), 4, 3))
    sh[:, 0] = (colour - 0.5) / SH_C0
    # The spherical harmonics of degree 1 are proportional to -y, z and -x of the
    # direction from the eye, which is -v.
    sh[:, 1] = gradient[:, 1] / SH_C1
    sh[:, 2] = -gradient[:, 2] / SH_C1
    sh[:, 3] = gradient[:, 0] / SH_C1
    return sh


def make_asset(num_gaussians: int = 60_000, *, seed: int = 0) -> Gaussians:
    """Make a tuft of moss with toadstools, grass, daisies, clover and pebbles.

    Args:
        num_gaussians: Exact number of gaussians. Smaller numbers give fewer blades and
            larger gaussians; the asset is recognisable from about 10,000 on.
        seed: The same seed gives the same gaussians.

    Returns:
        Gaussians with NumPy arrays and SH degree 1; z is up, and the radius of the
        ground is about 1.

    Raises:
        ValueError: ``num_gaussians`` is below 1,000.
    """
    if num_gaussians < 1000:
        raise ValueError(f"num_gaussians: expected at least 1000, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    noise = Noise(rng)

    def standing(x: float, y: float, tilt: float, toward: float, *rest: float) -> _Toadstool:
        foot = np.array([[x, y, 0.0]])
        foot[0, 2] = _ground_height(foot, noise)[0] - 0.03
        axis = np.array([-np.sin(toward), np.cos(toward), 0.0])
        return _Toadstool(foot[0], rotation(axis, tilt), *rest)

    caps = [
        standing(-0.10, 0.08, 0.08, 2.5, 0.76, 0.37, 0.68, 0.55),
        standing(0.34, -0.16, 0.18, -0.4, 0.45, 0.235, 0.82, 0.28),
        standing(-0.30, -0.36, 0.16, -2.2, 0.27, 0.135, 1.05, 0.17),
    ]
    n = num_gaussians
    parts = [_toadstool(shape, int(0.40 * n * shape.size), noise, rng) for shape in caps]
    parts += [
        _grass(int(0.20 * n), noise, rng),
        _flowers(_DAISY, int(0.08 * n), noise, rng),
        _flowers(_FORGET_ME_NOT, int(0.035 * n), noise, rng),
        _clover(int(0.06 * n), noise, rng),
        _pebbles(int(0.03 * n), noise, rng),
    ]
    rest = n - sum(len(p.means) for p in parts)
    parts.append(_ground(rest, noise, rng))
    whole = Part.concatenate(parts)
    order = rng.permutation(n)  # files of trained assets have no order, either
    return Gaussians(
        means=whole.means[order].astype(np.float32),
        quats=quaternions(whole.tangents, whole.normals)[order].astype(np.float32),
        scales=whole.scales[order].astype(np.float32),
        opacities=whole.opacities[order].astype(np.float32),
        sh=_lit(whole, caps)[order].astype(np.float32),
    )


def place_field(count: int = 2000, *, seed: int = 0) -> tuple[Array, Array, Array]:
    """Place tufts on a round hill, so close that moss covers it, each with a different
    rotation and size.

    The first tuft is at the origin and upright. Toadstools of different tufts rarely
    touch.

    Returns:
        Positions (count,3), quaternions (count,4) w,x,y,z and scales (count,), as
        float64 and from the middle outwards.

    Raises:
        ValueError: ``count`` is below 1.
    """
    if count < 1:
        raise ValueError(f"count: expected at least 1, got {count}")
    rng = np.random.default_rng(seed)
    # Pitch of a hexagonal grid; up to 1.73, discs of radius 1 cover the plane.
    spacing = 1.68
    reach = int(np.ceil(np.sqrt(count))) + 2
    i, j = (
        x.ravel() for x in np.meshgrid(np.arange(-reach, reach + 1), np.arange(-reach, reach + 1))
    )
    plane = spacing * np.stack([i + 0.5 * j, np.sqrt(0.75) * j], -1)
    plane = plane[np.argsort(np.hypot(plane[:, 0], plane[:, 1]), kind="stable")[:count]]
    plane[1:] += rng.uniform(-0.2, 0.2, (count - 1, 2))

    rim = spacing * np.sqrt(max(count, 7) * np.sqrt(0.75) / np.pi)
    waves = rng.uniform(0, 2 * np.pi, (2, 3))
    # Wave numbers in radians per unit of length.
    pitch = np.array([[0.23, 0.11], [-0.13, 0.27], [0.31, -0.19]])
    phase = plane @ pitch.T + waves[0]
    origin = np.sin(waves[0]).sum()
    swell = 0.30
    height = swell * (np.sin(phase).sum(1) - origin) - 0.14 * rim * (np.hypot(*plane.T) / rim) ** 2
    slope = swell * np.cos(phase) @ pitch - 0.28 * plane / rim
    normal = unit(np.stack([-slope[:, 0], -slope[:, 1], np.ones(count)], -1))
    yaw = rng.uniform(0, 2 * np.pi, count)
    scales = rng.uniform(0.82, 1.12, count)
    normal[0], yaw[0], scales[0] = UP, 0.0, 1.0
    toward = np.stack([np.cos(yaw), np.sin(yaw), np.zeros(count)], -1)
    return np.column_stack([plane, height]), quaternions(toward, normal), scales
