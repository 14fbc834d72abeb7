"""People: bodies of smoothly joined round cones, dressed, with hair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg.gaussians import Gaussians
from v3dg.procedural._light import gaussians_of
from v3dg.procedural._parts import UP, Array, Noise, Part, cover, mix, smoothstep, unit

_SKINS = np.array(
    [[0.62, 0.36, 0.24], [0.48, 0.26, 0.16], [0.30, 0.15, 0.085], [0.14, 0.065, 0.038], [0.70, 0.44, 0.32]]
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


@dataclass(frozen=True)
class _Cone:
    """Spheres of radius a at p to radius b at q, and all between them; ``flat`` squeezes it along y."""

    p: Array
    q: Array
    a: float
    b: float
    flat: float = 1.0


def _cone(p: npt.ArrayLike, q: npt.ArrayLike, a: float, b: float, flat: float = 1.0) -> _Cone:
    return _Cone(np.array(p, dtype=np.float64), np.array(q, dtype=np.float64), a, b, flat)


@dataclass(frozen=True)
class _Shape:
    """Round cones joined smoothly: a layer of the body or of its clothes."""

    cones: tuple[_Cone, ...]
    blend: float  # how far joints are rounded, in metres

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance, nearly, negative inside, and the direction in which it grows, (n,) and (n,3)."""
        total, gradient = np.zeros(len(points)), np.zeros((len(points), 3))
        for cone in self.cones:
            axis = cone.q - cone.p
            squeeze = np.array([1.0, 1 / cone.flat, 1.0])
            away = (points - cone.p) * squeeze
            t = np.clip(away @ axis / max(float(axis @ axis), 1e-12), 0, 1)
            away = away - t[:, None] * axis
            length = np.maximum(np.sqrt(np.einsum("ij,ij->i", away, away)), 1e-9)
            weight = np.exp(np.clip((cone.a + (cone.b - cone.a) * t - length) / self.blend, -40, 40))
            total += weight
            gradient += (weight / length)[:, None] * away * squeeze
        return -self.blend * np.log(total), unit(gradient)

    def spread(self, n: int, rng: np.random.Generator) -> tuple[Array, Array, float]:
        """n points on the surface, nearly even, their normals, and the spacing."""
        areas = np.array(
            [
                np.pi * (c.a + c.b) * (np.linalg.norm(c.q - c.p) + c.a + c.b) * (1 + c.flat) / 2
                for c in self.cones
            ]
        )
        # More than enough, as what falls inside another cone is dropped.
        many = int(1.6 * n) + 64
        which = rng.choice(len(areas), many, p=areas / areas.sum())
        p, q = (np.stack([getattr(c, name) for c in self.cones])[which] for name in "pq")
        a, b, flat = (np.array([getattr(c, name) for c in self.cones])[which] for name in ("a", "b", "flat"))
        length = np.linalg.norm(q - p, axis=1)
        reach = rng.uniform(-a, length + b)
        axis = unit(np.where(length[:, None] > 1e-6, q - p, UP))
        side = unit(np.cross(axis, [0.3, 0.9, 0.2]))
        angle = rng.uniform(0, 2 * np.pi, many)
        around = side * np.cos(angle)[:, None] + np.cross(axis, side) * np.sin(angle)[:, None]
        t = np.clip(reach / np.maximum(length, 1e-6), 0, 1)
        radius = a + (b - a) * t
        beyond = reach - np.clip(reach, 0, length)
        ring = np.sqrt(np.maximum(radius**2 - beyond**2, 0))
        offset = (around * ring[:, None] + axis * beyond[:, None]) * np.stack(
            [np.ones(many), flat, np.ones(many)], -1
        )
        points = p + (q - p) * t[:, None] + offset
        start, _ = self.distance(points)
        points = points[start > -1.2 * self.blend]
        for _ in range(2):
            d, normal = self.distance(points)
            points = points - d[:, None] * normal
        d, normal = self.distance(points)
        kept = np.flatnonzero(np.abs(d) < 0.004)
        kept = rng.permutation(kept)[:n] if len(kept) >= n else rng.choice(kept, n)
        area = float(areas.sum()) * len(points) / many
        return points[kept], normal[kept], float(np.sqrt(area / n))


@dataclass(frozen=True)
class _Figure:
    """A person's layers, in metres; the body looks along -y."""

    limbs: tuple[_Shape, ...]  # each arm, and the legs where a skirt shows them
    face: _Shape  # head and neck
    shirt: _Shape
    trousers: _Shape
    shoes: _Shape
    scalp: _Shape
    head: Array  # centre
    hips: float  # height
    shirt_hem: float  # heights
    trouser_hem: float


def _figure(rng: np.random.Generator) -> _Figure:
    woman = rng.random() < 0.5
    size = rng.normal(0.965 if woman else 1.03, 0.035)
    stout = rng.normal(1.0, 0.09)
    sway, stride = 0.05 * rng.standard_normal(), 0.05 + 0.05 * rng.random()
    shoulder = (0.165 if woman else 0.195) * (0.5 + 0.5 * stout)
    hip = (0.105 if woman else 0.095) * stout
    waist, chest = (0.115 if woman else 0.130) * stout, (0.130 if woman else 0.150) * stout
    z_hip, z_waist, z_chest, z_neck = 0.93, 1.08, 1.29, 1.47
    head = np.array([0.3 * sway, -0.02, 1.64])

    legs, shoes, sleeves, trousers = [], [], [], []
    arms: list[list[_Cone]] = []
    raised = rng.uniform(0.05, 0.28, 2)  # rad that the arms stand off
    bent = rng.uniform(0.1, 0.9, 2)  # and the elbows bend
    long_sleeves, skirt = rng.random() < 0.5, woman and rng.random() < 0.45
    for i, s in enumerate((-1.0, 1.0)):
        knee = (s * 0.095, -0.02 - 0.4 * s * stride, 0.50)
        ankle = (s * 0.105, 0.03 + s * stride, 0.09)
        top = (s * hip, 0.0, z_hip - 0.04)
        legs += [
            _cone((0.5 * (top[0] + knee[0]), 0.0, 0.7), knee, 0.064 * stout, 0.052),
            _cone(knee, ankle, 0.052, 0.036),
        ]
        trousers += [
            _cone(top, knee, 0.094 * stout, 0.072),
            _cone(knee, (ankle[0], ankle[1], 0.07), 0.072, 0.062),
        ]
        toe = (ankle[0] + s * 0.025, ankle[1] - 0.165, 0.034)
        shoes += [
            _cone((ankle[0], ankle[1] + 0.02, 0.046), toe, 0.044, 0.034),
            _cone((ankle[0], ankle[1] + 0.02, 0.046), (ankle[0], ankle[1] + 0.01, 0.085), 0.044, 0.043),
        ]
        joint = np.array([s * shoulder, 0.0, z_neck - 0.105])
        out = np.array([s * np.sin(raised[i]), 0.03, -np.cos(raised[i])])
        elbow = joint + 0.295 * out
        fore = unit(
            np.array([-0.15 * s * bent[i] + s * np.sin(raised[i]) * 0.6, -np.sin(bent[i]), -np.cos(bent[i])])
        )
        wrist = elbow + 0.25 * fore
        arm = [_cone(joint, elbow, 0.047, 0.037), _cone(elbow, wrist, 0.037, 0.026)]
        palm = wrist + 0.075 * fore
        arm.append(_cone(wrist, palm, 0.027, 0.034, 0.8))
        side = unit(np.cross(fore, [1.0, 0.0, 0.0]) + 1e-6)
        for finger in range(4):
            root = palm + side * (0.020 * (finger - 1.5)) + 0.015 * fore
            arm.append(
                _cone(
                    root,
                    root + fore * (0.075 - 0.012 * abs(finger - 1.3)) - 0.02 * s * np.array([1, 0, 0]),
                    0.0095,
                    0.0075,
                )
            )
        arm.append(_cone(wrist + 0.03 * fore, wrist + 0.065 * fore + 0.045 * side, 0.012, 0.009))
        arms.append(arm)
        sleeves.append(_cone(joint, elbow, 0.066, 0.056))
        if long_sleeves:
            sleeves.append(_cone(elbow, wrist - 0.01 * fore, 0.055, 0.042))
        else:
            sleeves[-1] = _cone(joint, joint + 0.19 * out, 0.066, 0.062)
    torso = [
        _cone((-0.6 * hip, 0, z_hip), (0.6 * hip, 0, z_hip), 0.125 * stout, 0.125 * stout, 0.9),
        _cone((0, 0, z_hip), (0, 0, z_waist), waist + 0.02, waist, 0.8),
        _cone((0, 0, z_waist), (0, 0, z_chest), waist, chest, 0.78),
        _cone(
            (-0.55 * shoulder, 0.0, z_chest + 0.03),
            (0.55 * shoulder, 0.0, z_chest + 0.03),
            0.085,
            0.085,
            0.95,
        ),
        _cone((0, 0.015, z_neck - 0.065), (-0.8 * shoulder, 0, z_neck - 0.115), 0.060, 0.042),
        _cone((0, 0.015, z_neck - 0.065), (0.8 * shoulder, 0, z_neck - 0.115), 0.060, 0.042),
    ]
    if woman:
        torso += [
            _cone((s * 0.068, -0.075, z_chest - 0.015), (s * 0.068, -0.07, z_chest - 0.02), 0.056, 0.056)
            for s in (-1.0, 1.0)
        ]
    x, y, z = head
    face = [
        _cone((x, y + 0.018, z + 0.022), (x, y + 0.012, z + 0.028), 0.094, 0.092, 1.05),
        _cone((x, y - 0.012, z - 0.02), (x, y - 0.038, z - 0.085), 0.070, 0.036, 1.0),
        _cone((x - 0.024, y - 0.034, z - 0.080), (x + 0.024, y - 0.034, z - 0.080), 0.024, 0.024),
        _cone((x, y - 0.040, z + 0.015), (x, y - 0.044, z - 0.050), 0.046, 0.040),
        _cone((x, y - 0.086, z + 0.008), (x, y - 0.101, z - 0.028), 0.007, 0.0115),  # nose
        _cone((x - 0.016, y - 0.077, z - 0.061), (x + 0.016, y - 0.077, z - 0.061), 0.0085, 0.0085),  # lips
        _cone((x - 0.030, y - 0.076, z + 0.030), (x + 0.030, y - 0.076, z + 0.030), 0.014, 0.014),  # brow
        _cone((x - 0.088, y + 0.022, z - 0.01), (x - 0.092, y + 0.030, z + 0.02), 0.011, 0.014),  # ears
        _cone((x + 0.088, y + 0.022, z - 0.01), (x + 0.092, y + 0.030, z + 0.02), 0.011, 0.014),
        _cone((0, 0.015, z_neck - 0.05), (x, y + 0.02, z - 0.06), 0.058, 0.052),
    ]
    if skirt:
        trousers = [_cone((0, 0, z_hip + 0.03), (0, 0, 0.52), 0.145 * stout, 0.235, 0.78)]
    belt = [torso[0], _cone((0, 0, z_hip), (0, 0, z_waist - 0.02), waist + 0.020, waist, 0.80)]
    shirt = [_Cone(c.p, c.q, c.a + 0.014, c.b + 0.014, c.flat) for c in torso]
    shirt.append(_cone((0, 0.01, z_hip - 0.03), (0, 0, z_waist), waist + 0.050, waist + 0.022, 0.84))

    def scaled(cones: Sequence[_Cone], blend: float) -> _Shape:
        return _Shape(
            tuple(_Cone(size * c.p, size * c.q, size * c.a, size * c.b, c.flat) for c in cones), blend
        )

    scalp = [face[0], _cone((x, y + 0.045, z + 0.01), (x, y + 0.055, z - 0.045), 0.083, 0.062)]
    return _Figure(
        tuple(scaled(cones, 0.0075) for cones in (*arms, *([legs] if skirt else []))),
        scaled(face, 0.0075),
        scaled([*shirt, *sleeves], 0.016),
        scaled([*trousers, *belt], 0.014),
        scaled(shoes, 0.006),
        scaled(scalp, 0.006),
        size * head,
        size * z_hip,
        size * (z_hip - 0.06),
        size * (0.49 if skirt else 0.055),
    )


def make_person(num_gaussians: int = 343_274, *, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """Make a standing person in shirt, trousers or skirt, and shoes.

    Args:
        num_gaussians: How many gaussians, exactly; the default is the mean of the V3DG paper's persons.
        seed: Another person: build, pose, skin, hair and clothes.
        sh_degree: 0 to 3.

    Returns:
        NumPy gaussians; z is up, the soles are at z = 0, the face looks along -y; lengths in metres.

    Raises:
        ValueError: ``num_gaussians`` is below 2,000.
    """
    if num_gaussians < 2000:
        raise ValueError(f"num_gaussians: expected at least 2000, got {num_gaussians}")
    rng = np.random.default_rng([seed, 7])
    noise = Noise(rng)
    figure = _figure(rng)
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


def _seen(figure: _Figure, points: Array, *, behind: Sequence[_Shape]) -> Array:
    """Which points no other layer hides."""
    free = np.ones(len(points), bool)
    for shape in behind:
        near = np.flatnonzero(free & ((points[:, 2] > figure.shirt_hem) | (shape is not figure.shirt)))
        d, _ = shape.distance(points[near])
        free[near[d < 0]] = False
    return free


def _enough(
    shape: _Shape, n: int, figure: _Figure, behind: Sequence[_Shape], rng: np.random.Generator
) -> tuple[Array, Array, float]:
    """n points of a layer that no other hides."""
    probe, _, _ = shape.spread(600, rng)
    share = max(float(_seen(figure, probe, behind=behind).mean()), 0.05)
    points, normals, spacing = shape.spread(int(1.12 * n / share) + 50, rng)
    seen = np.flatnonzero(_seen(figure, points, behind=behind))
    chosen = seen[:n] if len(seen) >= n else rng.choice(seen, n)
    return points[chosen], normals[chosen], spacing * float(np.sqrt(max(len(seen) / n, 1.0)))


def _skin(figure: _Figure, n: int, skin: Array, hair: Array, noise: Noise, rng: np.random.Generator) -> Part:
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
            tone = _face(points - figure.head, tone, hair, noise)
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
                opacity=1.3,
            )
        )
    return Part.concatenate(parts)


def _face(at: Array, tone: Array, hair: Array, noise: Noise) -> Array:
    """Eyes, brows, lips and cheeks painted at places relative to the head's centre."""
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
        tone, 0.85 * ellipse(0.034, 0.0, 0.022, 9.0) * smoothstep(0.0055, 0.002, np.abs(z - arch)), hair * 1.2
    )
    lips = ellipse(0.0, -0.061, 0.025, 0.0085)
    tone = paint(tone, 0.8 * lips, tone * [1.0, 0.60, 0.60])
    tone = paint(tone, lips * smoothstep(0.0018, 0.0006, np.abs(z + 0.061)), tone * 0.35)
    return paint(tone, 0.7 * ellipse(0.0065, -0.043, 0.0042, 0.0026), tone * 0.25)


def _cloth(
    shape: _Shape,
    n: int,
    figure: _Figure,
    colours: Array,
    pattern: int,
    noise: Noise,
    rng: np.random.Generator,
) -> Part:
    """Woven cloth with folds, in one colour, in stripes across or along, or in checks."""
    on_top = shape is figure.shirt
    points, normals, spacing = _enough(shape, n, figure, () if on_top else (figure.shirt,), rng)
    # Cut at the hem, where the round cones end in balls.
    kept = np.flatnonzero(points[:, 2] > (figure.shirt_hem if on_top else figure.trouser_hem))
    kept = np.concatenate([kept, rng.choice(kept, n - len(kept))])
    points, normals = points[kept], normals[kept]
    folded = points * [1.0, 1.0, 0.38]
    crease = noise(folded, 11.0, 2) - 0.5
    e = 2e-3
    slope = np.stack([noise(folded + e * np.eye(3)[i], 11.0, 2) - 0.5 - crease for i in range(3)], -1) / e
    depth = 0.020 * smoothstep(0.0, 0.25, figure.hips + 0.45 - np.abs(points[:, 2] - figure.hips))
    normals = unit(normals - depth[:, None] * (slope - normals * np.sum(slope * normals, 1, keepdims=True)))
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
        points, normals, tangents, spacing, np.clip(colour, 0, 1), rng, gloss=0.03, bend=0.05, opacity=1.3
    )


def _shoes(figure: _Figure, n: int, noise: Noise, rng: np.random.Generator) -> Part:
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
    return cover(points, normals, tangents, spacing, colour, rng, gloss=0.3, bend=0.03, opacity=1.3)


def _hair(figure: _Figure, n: int, hair: Array, noise: Noise, rng: np.random.Generator) -> Part:
    """Strands of a few needles each that grow from the scalp and fall."""
    length = float(rng.choice([0.030, 0.055, 0.20, 0.30]))
    rows = 4 if length < 0.1 else 10
    k = n // rows
    parting = rng.uniform(-0.03, 0.03)
    roots, normals, _ = figure.scalp.spread(4 * k, rng)
    at = roots - figure.head
    # No hair on the face: the hairline runs from the forehead down before the ears.
    line = 0.060 - 1.15 * np.maximum(at[:, 1] + 0.06, 0) + 0.012 * (noise(roots, 60.0) - 0.5)
    grows = np.flatnonzero((at[:, 2] > line) & (at[:, 2] > -0.075))
    grows = grows[:k] if len(grows) >= k else rng.choice(grows, k)
    roots, normals, at = roots[grows], normals[grows], at[grows]
    lock = noise(roots + 3, 26.0, 2)
    strand = length * (0.65 + 0.7 * lock) * np.exp(0.15 * rng.standard_normal(k))
    comb = np.stack([np.sign(at[:, 0] - parting) * 0.6, 0.45 + 0.3 * at[:, 1] / 0.1, np.full(k, -0.6)], -1)
    comb -= normals * np.sum(comb * normals, 1, keepdims=True)  # along the scalp
    stray = 0.10 * rng.standard_normal((k, 3)) + 0.8 * (lock - 0.5)[:, None] * np.roll(normals, 1, axis=1)
    heading = unit(unit(comb) + 0.10 * normals + stray)
    points, means, tangents = roots.copy(), [], []
    for _ in range(rows):
        step = strand[:, None] / rows
        means.append(points + 0.5 * heading * step)
        tangents.append(heading)
        points = points + heading * step
        # Hair falls, and slides along head and shoulders.
        heading = unit(heading - 0.7 * UP + 0.05 * rng.standard_normal((k, 3)))
        for shape, skirt in ((figure.scalp, 0.006), (figure.face, 0.004), (figure.shirt, 0.006)):
            if length < 0.1 and shape is not figure.scalp:
                continue
            d, out = shape.distance(points)
            inside = np.maximum(skirt - d, 0)
            points = points + out * inside[:, None]
            heading = unit(heading - out * (np.minimum(np.sum(heading * out, 1), 0) * (inside > 0))[:, None])
    mean, tangent = np.concatenate(means), unit(np.concatenate(tangents))
    t = np.repeat(np.arange(rows) / (rows - 1), k)
    count = len(mean)
    shade = np.tile(0.55 + 0.9 * noise(roots, 90.0, 2), rows) * np.exp(0.15 * rng.standard_normal(count))
    wide = 0.0016 * np.sqrt(58_000 / max(count, 1)) ** 0.8 * np.exp(0.3 * rng.standard_normal(count))
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
