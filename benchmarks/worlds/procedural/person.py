"""Persons with skin, clothes, shoes and hair, made from the figures of `_body`."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from benchmarks.worlds.procedural._body import Figure, Shape, random_figure
from benchmarks.worlds.procedural._light import gaussians_of
from benchmarks.worlds.procedural._parts import UP, Array, Noise, Part, cover, mix, smoothstep, unit
from v3dg.gaussians import Gaussians

_SKINS = np.array(
    [
        [0.62, 0.36, 0.24],
        [0.48, 0.26, 0.16],
        [0.30, 0.15, 0.085],
        [0.14, 0.065, 0.038],
        [0.70, 0.44, 0.32],
    ]
)
_HAIRS = np.array(
    [
        [0.012, 0.010, 0.009],
        [0.060, 0.028, 0.012],
        [0.16, 0.075, 0.030],
        [0.42, 0.27, 0.10],
        [0.30, 0.29, 0.28],
    ]
)
_CLOTHS = np.array(
    [
        [0.55, 0.04, 0.04],
        [0.03, 0.09, 0.32],
        [0.70, 0.68, 0.63],
        [0.04, 0.22, 0.12],
        [0.72, 0.42, 0.04],
        [0.05, 0.05, 0.06],
        [0.30, 0.10, 0.34],
        [0.06, 0.34, 0.42],
        [0.55, 0.20, 0.10],
        [0.30, 0.33, 0.36],
    ]
)
_TROUSERS = np.array(
    [
        [0.035, 0.060, 0.130],
        [0.022, 0.022, 0.026],
        [0.30, 0.24, 0.15],
        [0.10, 0.11, 0.12],
        [0.14, 0.085, 0.05],
    ]
)


def make_person(num_gaussians: int = 343_274, *, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """Make a standing person with a shirt, trousers or a skirt, and shoes.

    Args:
        num_gaussians: Exact number of gaussians; the default is the mean of the V3DG
            paper's persons.
        seed: Each seed gives another build, pose, skin, hair and clothes.
        sh_degree: 0 to 3.

    Returns:
        Gaussians with NumPy arrays, in metres; z is up, the soles are at z = 0, and the
        face looks along -y.

    Raises:
        ValueError: ``num_gaussians`` is below 2,000.
    """
    if num_gaussians < 2000:
        raise ValueError(f"num_gaussians: expected at least 2000, got {num_gaussians}")
    rng = np.random.default_rng([seed, 7])
    noise = Noise(rng)
    figure = random_figure(rng)
    skin = _SKINS[rng.integers(len(_SKINS))]
    hair = _HAIRS[rng.integers(len(_HAIRS))]
    n = num_gaussians
    share = {"shirt": 0.27, "trousers": 0.20, "shoes": 0.05, "hair": 0.17}
    counts = {name: int(part * n) for name, part in share.items()}
    parts = [
        _cloth(
            figure.shirt,
            counts["shirt"],
            figure,
            _CLOTHS[rng.integers(len(_CLOTHS), size=2)],
            int(rng.integers(4)),
            noise,
            rng,
        ),
        _cloth(
            figure.trousers,
            counts["trousers"],
            figure,
            _TROUSERS[rng.integers(len(_TROUSERS), size=2)],
            0,
            noise,
            rng,
        ),
        _shoes(figure, counts["shoes"], noise, rng),
        _hair(figure, counts["hair"], hair, noise, rng),
    ]
    parts.insert(0, _skin(figure, n - sum(counts.values()), skin, hair, noise, rng))
    return gaussians_of(Part.concatenate(parts), sh_degree, rng)


def _seen(figure: Figure, points: Array, *, behind: Sequence[Shape]) -> Array:
    """Return (n,) whether points are not hidden by any of the layers ``behind``."""
    free = np.ones(len(points), bool)
    for shape in behind:
        near = np.flatnonzero(
            free & ((points[:, 2] > figure.shirt_hem) | (shape is not figure.shirt))
        )
        d, _ = shape.distance(points[near])
        free[near[d < 0]] = False
    return free


def _enough(
    shape: Shape, n: int, figure: Figure, behind: Sequence[Shape], rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """Return n points of a layer that no other layer hides, their normals, and the
    distance between neighbours."""
    probe, _, _ = shape.spread(600, rng)
    share = max(float(_seen(figure, probe, behind=behind).mean()), 0.05)
    points, normals, spacing = shape.spread(int(1.12 * n / share) + 50, rng)
    seen = np.flatnonzero(_seen(figure, points, behind=behind))
    chosen = seen[:n] if len(seen) >= n else rng.choice(seen, n)
    return points[chosen], normals[chosen], spacing * float(np.sqrt(max(len(seen) / n, 1.0)))


def _skin(
    figure: Figure, n: int, skin: Array, hair: Array, noise: Noise, rng: np.random.Generator
) -> Part:
    n_face = int(0.55 * n)
    clothes = (figure.shirt, figure.trousers, figure.shoes)
    parts = []
    each = (n - n_face) // len(figure.limbs)
    counts = [n - each * len(figure.limbs)] + [each] * len(figure.limbs)
    for shape, count in zip((figure.face, *figure.limbs), counts, strict=True):
        points, normals, spacing = _enough(shape, count, figure, clothes, rng)
        tone = skin * (0.86 + 0.28 * noise(points, 30.0))[:, None]
        flush = noise(points + 7, 14.0)
        tone = tone * (1 + np.stack([0.10 * flush, -0.06 * flush, -0.06 * flush], -1))
        if shape is figure.face:
            tone = _face(points - figure.head, tone, hair)
        parts.append(
            cover(
                points,
                normals,
                unit(np.cross(normals, [0.1, 0.9, 0.3])),
                spacing,
                np.clip(tone, 0, 1),
                rng,
                gloss=0.16,
                bend=0.03,
            )
        )
    return Part.concatenate(parts)


def _face(at: Array, tone: Array, hair: Array) -> Array:
    """Return the colours of eyes, brows, lips and cheeks at positions relative to the
    centre of the head."""
    front = at[:, 1] < -0.03
    x, z = np.abs(at[:, 0]), at[:, 2]

    def paint(tone: Array, mask: Array, colour: Array | Sequence[float]) -> Array:
        return mix(tone, colour, np.clip(mask, 0, 1) * front)

    def ellipse(cx: float, cz: float, rx: float, rz: float, soft: float = 0.25) -> Array:
        return smoothstep(1 + soft, 1 - soft, np.hypot((x - cx) / rx, (z - cz) / rz))

    tone = paint(tone, 0.35 * ellipse(0.045, -0.030, 0.028, 0.024, 0.6), tone * [1.25, 0.78, 0.75])
    tone = paint(tone, 0.4 * ellipse(0.032, 0.008, 0.021, 0.014, 0.5), tone * 0.7)
    tone = paint(tone, ellipse(0.032, 0.007, 0.0155, 0.0078), [0.95, 0.93, 0.91])
    tone = paint(tone, ellipse(0.032, 0.007, 0.0064, 0.0064), [0.10, 0.055, 0.025])
    tone = paint(tone, ellipse(0.032, 0.007, 0.0030, 0.0030), [0.01, 0.01, 0.01])
    tone = paint(tone, ellipse(0.032, 0.0136, 0.0165, 0.0024), [0.02, 0.014, 0.012])
    arch = 0.031 - 3.0 * (x - 0.034) ** 2
    tone = paint(
        tone,
        0.85 * ellipse(0.034, 0.0, 0.022, 9.0) * smoothstep(0.0055, 0.002, np.abs(z - arch)),
        hair * 1.2,
    )
    lips = ellipse(0.0, -0.061, 0.025, 0.0085)
    tone = paint(tone, 0.8 * lips, tone * [1.0, 0.60, 0.60])
    tone = paint(tone, lips * smoothstep(0.0018, 0.0006, np.abs(z + 0.061)), tone * 0.35)
    return paint(tone, 0.7 * ellipse(0.0065, -0.043, 0.0042, 0.0026), tone * 0.25)


def _cloth(
    shape: Shape,
    n: int,
    figure: Figure,
    colours: Array,
    pattern: int,
    noise: Noise,
    rng: np.random.Generator,
) -> Part:
    """Return woven cloth with folds; its pattern is plain, has stripes across or along,
    or is checked."""
    on_top = shape is figure.shirt
    points, normals, spacing = _enough(shape, n, figure, () if on_top else (figure.shirt,), rng)
    # The cloth ends at the hem; without this cut, the cones would end in balls.
    kept = np.flatnonzero(points[:, 2] > (figure.shirt_hem if on_top else figure.trouser_hem))
    kept = np.concatenate([kept, rng.choice(kept, n - len(kept))])
    points, normals = points[kept], normals[kept]
    folded = points * [1.0, 1.0, 0.38]
    crease = noise(folded, 11.0, 2) - 0.5
    e = 2e-3
    slope = (
        np.stack([noise(folded + e * np.eye(3)[i], 11.0, 2) - 0.5 - crease for i in range(3)], -1)
        / e
    )
    depth = 0.020 * smoothstep(0.0, 0.25, figure.hips + 0.45 - np.abs(points[:, 2] - figure.hips))
    normals = unit(
        normals - depth[:, None] * (slope - normals * np.sum(slope * normals, 1, keepdims=True))
    )
    points = points + normals * (depth * crease)[:, None]
    weave = 0.88 + 0.24 * noise(points, 220.0, 1)
    first, second = colours
    across = 0.5 + 0.5 * np.tanh(6 * np.sin(points[:, 2] * 2 * np.pi / 0.075))
    along = 0.5 + 0.5 * np.tanh(6 * np.sin(points[:, 0] * 2 * np.pi / 0.060))
    amount = (np.zeros(n), across, along, 0.5 * (across + along))[pattern]
    colour = mix(first, second, amount) * (weave * (1 + 0.8 * crease))[:, None]
    if on_top:
        collar = smoothstep(0.006, 0.002, np.abs(points[:, 2] - (figure.head[2] - 0.20)))
        placket = smoothstep(0.004, 0.002, np.abs(points[:, 0] - 0.012)) * (points[:, 1] < 0)
        colour *= (1 - 0.5 * np.maximum(collar, placket))[:, None]
    tangents = unit(np.cross(normals, [0.9, 0.3, 0.1]))
    return cover(
        points,
        normals,
        tangents,
        spacing,
        np.clip(colour, 0, 1),
        rng,
        gloss=0.03,
        bend=0.05,
        opacity=1.3,
    )


def _shoes(figure: Figure, n: int, noise: Noise, rng: np.random.Generator) -> Part:
    points, normals, spacing = _enough(figure.shoes, n, figure, (figure.trousers,), rng)
    points[:, 2] = np.maximum(points[:, 2], 0.002)
    leather = _TROUSERS[rng.integers(1, 5)] * 0.8
    sole = smoothstep(0.024, 0.020, points[:, 2])
    white = rng.random() < 0.5
    colour = mix(
        leather * (0.8 + 0.4 * noise(points, 60.0))[:, None],
        [0.75, 0.74, 0.72] if white else [0.02, 0.02, 0.02],
        sole,
    )
    tangents = unit(np.cross(normals, [0.9, 0.3, 0.1]))
    return cover(points, normals, tangents, spacing, colour, rng, gloss=0.3, bend=0.03)


def _hair(figure: Figure, n: int, hair: Array, noise: Noise, rng: np.random.Generator) -> Part:
    """Return strands of hair that grow from the scalp and hang down, with a few needles
    each."""
    length = float(rng.choice([0.030, 0.055, 0.20, 0.30]))
    rows = 4 if length < 0.1 else 10
    k = n // rows
    parting = rng.uniform(-0.03, 0.03)
    roots, normals, _ = figure.scalp.spread(4 * k, rng)
    at = roots - figure.head
    # The face has no hair: the hairline runs from the forehead down in front of the
    # ears.
    line = 0.060 - 1.15 * np.maximum(at[:, 1] + 0.06, 0) + 0.012 * (noise(roots, 60.0) - 0.5)
    grows = np.flatnonzero((at[:, 2] > line) & (at[:, 2] > -0.075))
    grows = grows[:k] if len(grows) >= k else rng.choice(grows, k)
    roots, normals, at = roots[grows], normals[grows], at[grows]
    lock = noise(roots + 3, 26.0, 2)
    strand = length * (0.65 + 0.7 * lock) * np.exp(0.15 * rng.standard_normal(k))
    comb = np.stack(
        [np.sign(at[:, 0] - parting) * 0.6, 0.45 + 0.3 * at[:, 1] / 0.1, np.full(k, -0.6)], -1
    )
    # Makes the directions tangential to the scalp.
    comb -= normals * np.sum(comb * normals, 1, keepdims=True)
    stray = 0.10 * rng.standard_normal((k, 3)) + 0.8 * (lock - 0.5)[:, None] * np.roll(
        normals, 1, axis=1
    )
    heading = unit(unit(comb) + 0.10 * normals + stray)
    points, means, tangents = roots.copy(), [], []
    for _ in range(rows):
        step = strand[:, None] / rows
        means.append(points + 0.5 * heading * step)
        tangents.append(heading)
        points = points + heading * step
        # Hair falls and slides along the head and the shoulders.
        heading = unit(heading - 0.7 * UP + 0.05 * rng.standard_normal((k, 3)))
        for shape, skirt in ((figure.scalp, 0.006), (figure.face, 0.004), (figure.shirt, 0.006)):
            if length < 0.1 and shape is not figure.scalp:
                continue
            d, out = shape.distance(points)
            inside = np.maximum(skirt - d, 0)
            points = points + out * inside[:, None]
            heading = unit(
                heading - out * (np.minimum(np.sum(heading * out, 1), 0) * (inside > 0))[:, None]
            )
    mean, tangent = np.concatenate(means), unit(np.concatenate(tangents))
    t = np.repeat(np.arange(rows) / (rows - 1), k)
    count = len(mean)
    shade = np.tile(0.55 + 0.9 * noise(roots, 90.0, 2), rows) * np.exp(
        0.15 * rng.standard_normal(count)
    )
    wide = (
        0.0016 * np.sqrt(58_000 / max(count, 1)) ** 0.8 * np.exp(0.3 * rng.standard_normal(count))
    )
    along = 0.40 * np.tile(strand, rows) / rows
    logits = 1.8 - 2.2 * t**2 + 1.2 * rng.standard_normal(count)
    part = Part(
        mean,
        tangent,
        unit(mean - figure.head + 0.02 * rng.standard_normal((count, 3))),
        np.stack([np.maximum(along, wide), wide, 0.5 * wide], -1),
        1 / (1 + np.exp(-logits)),
        np.clip(hair * shade[:, None], 0, 1),
        np.full(count, 0.30),
        np.full(count, 0.15),
        0.6 + 0.4 * t,
    )
    return part if count == n else Part.concatenate([part, part.first(n - count)])
