"""The surfaces of a standing, dressed person: layers of smoothly joined round cones.

Lengths are in metres for a person of average height, and a factor scales the whole
person. The x axis points to the person's left, the face looks along -y, and the soles
are at z = 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from benchmarks.worlds.procedural._parts import UP, Array, unit

_HIPS, _WAIST, _CHEST, _NECK, _HEAD = 0.93, 1.08, 1.29, 1.47, 1.64  # heights in metres
_SIDES = (-1.0, 1.0)


@dataclass(frozen=True)
class _Cone:
    """The convex hull of a sphere of radius a at p and a sphere of radius b at q.
    ``flat`` scales the hull along y."""

    p: Array
    q: Array
    a: float
    b: float
    flat: float = 1.0


def _cone(p: npt.ArrayLike, q: npt.ArrayLike, a: float, b: float, flat: float = 1.0) -> _Cone:
    return _Cone(np.array(p, dtype=np.float64), np.array(q, dtype=np.float64), a, b, flat)


@dataclass(frozen=True)
class Shape:
    """A layer of the body or of the clothes: round cones with smooth joints."""

    cones: tuple[_Cone, ...]
    blend: float  # radius of the rounding at joints, in metres

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Return the approximate signed distance, (n,), negative inside, and its
        gradient, (n,3)."""
        total, gradient = np.zeros(len(points)), np.zeros((len(points), 3))
        for cone in self.cones:
            axis = cone.q - cone.p
            squeeze = np.array([1.0, 1 / cone.flat, 1.0])
            away = (points - cone.p) * squeeze
            t = np.clip(away @ axis / max(float(axis @ axis), 1e-12), 0, 1)
            away = away - t[:, None] * axis
            length = np.maximum(np.sqrt(np.einsum("ij,ij->i", away, away)), 1e-9)
            weight = np.exp(
                np.clip((cone.a + (cone.b - cone.a) * t - length) / self.blend, -40, 40)
            )
            total += weight
            gradient += (weight / length)[:, None] * away * squeeze
        return -self.blend * np.log(total), unit(gradient)

    def spread(self, n: int, rng: np.random.Generator) -> tuple[Array, Array, float]:
        """Return n nearly evenly distributed points on the surface, their normals, and
        the distance between neighbours."""
        areas = np.array(
            [
                np.pi * (c.a + c.b) * (np.linalg.norm(c.q - c.p) + c.a + c.b) * (1 + c.flat) / 2
                for c in self.cones
            ]
        )
        # More points than needed are made, because points inside another cone are
        # dropped.
        many = int(1.6 * n) + 64
        which = rng.choice(len(areas), many, p=areas / areas.sum())
        p, q = (np.stack([getattr(c, name) for c in self.cones])[which] for name in "pq")
        a, b, flat = (
            np.array([getattr(c, name) for c in self.cones])[which] for name in ("a", "b", "flat")
        )
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
class Figure:
    """The layers of a person, and two heights."""

    limbs: tuple[Shape, ...]  # both arms, and the legs if a skirt shows them
    face: Shape  # head and neck
    shirt: Shape
    trousers: Shape
    shoes: Shape
    scalp: Shape
    head: Array  # centre
    hips: float  # height in metres
    shirt_hem: float
    trouser_hem: float


@dataclass(frozen=True)
class _Build:
    """The features that differ between persons, besides their size."""

    woman: bool
    stout: float  # 1 for average width
    shoulder: float  # half width in metres
    hip: float
    waist: float  # radius in metres
    chest: float
    stride: float
    raised: Array  # (2,) angles between arms and body, radians
    bent: Array  # (2,) angles of the elbows, radians
    long_sleeves: bool
    skirt: bool


def random_figure(rng: np.random.Generator) -> Figure:
    """Return a person with random build, pose and clothes."""
    woman = bool(rng.random() < 0.5)
    size, stout = rng.normal(0.965 if woman else 1.03, 0.035), rng.normal(1.0, 0.09)
    build = _Build(
        woman,
        stout,
        shoulder=(0.165 if woman else 0.195) * (0.5 + 0.5 * stout),
        hip=(0.105 if woman else 0.095) * stout,
        waist=(0.115 if woman else 0.130) * stout,
        chest=(0.130 if woman else 0.150) * stout,
        stride=rng.uniform(0.05, 0.10),
        raised=rng.uniform(0.05, 0.28, 2),
        bent=rng.uniform(0.1, 0.9, 2),
        long_sleeves=bool(rng.random() < 0.5),
        skirt=bool(woman and rng.random() < 0.45),
    )
    head = np.array([0.015 * rng.standard_normal(), -0.02, _HEAD])
    arms, sleeves = zip(*(_arm(build, i) for i in range(2)), strict=True)
    legs, trousers, shoes = (
        [c for side in _SIDES for c in part(build, side)] for part in (_leg, _trouser, _shoe)
    )
    torso = _torso(build)
    waist = build.waist
    shirt = [_Cone(c.p, c.q, c.a + 0.014, c.b + 0.014, c.flat) for c in torso]
    shirt.append(_cone((0, 0.01, _HIPS - 0.03), (0, 0, _WAIST), waist + 0.050, waist + 0.022, 0.84))
    if build.skirt:
        trousers = [_cone((0, 0, _HIPS + 0.03), (0, 0, 0.52), 0.145 * stout, 0.235, 0.78)]
    belt = [torso[0], _cone((0, 0, _HIPS), (0, 0, _WAIST - 0.02), waist + 0.020, waist, 0.80)]

    def scaled(cones: Sequence[_Cone], blend: float) -> Shape:
        return Shape(
            tuple(_Cone(size * c.p, size * c.q, size * c.a, size * c.b, c.flat) for c in cones),
            blend,
        )

    face = _face(head)
    back = head + np.array([0.0, 0.045, 0.01])
    return Figure(
        limbs=tuple(scaled(cones, 0.0075) for cones in (*arms, *([legs] if build.skirt else []))),
        face=scaled(face, 0.0075),
        shirt=scaled([*shirt, *sleeves[0], *sleeves[1]], 0.016),
        trousers=scaled([*trousers, *belt], 0.014),
        shoes=scaled(shoes, 0.006),
        scalp=scaled(
            [face[0], _cone(back, back + np.array([0.0, 0.010, -0.055]), 0.083, 0.062)], 0.006
        ),
        head=size * head,
        hips=size * _HIPS,
        shirt_hem=size * (_HIPS - 0.06),
        trouser_hem=size * (0.49 if build.skirt else 0.055),
    )


def _joints(build: _Build, side: float) -> tuple[Array, Array, Array]:
    """Return the positions of hip, knee and ankle. One foot is in front of the
    other."""
    hip = np.array([side * build.hip, 0.0, _HIPS - 0.04])
    knee = np.array([side * 0.095, -0.02 - 0.4 * side * build.stride, 0.50])
    return hip, knee, np.array([side * 0.105, 0.03 + side * build.stride, 0.09])


def _leg(build: _Build, side: float) -> list[_Cone]:
    hip, knee, ankle = _joints(build, side)
    thigh = (0.5 * (hip[0] + knee[0]), 0.0, 0.7)
    return [_cone(thigh, knee, 0.064 * build.stout, 0.052), _cone(knee, ankle, 0.052, 0.036)]


def _trouser(build: _Build, side: float) -> list[_Cone]:
    hip, knee, ankle = _joints(build, side)
    return [
        _cone(hip, knee, 0.094 * build.stout, 0.072),
        _cone(knee, (*ankle[:2], 0.07), 0.072, 0.062),
    ]


def _shoe(build: _Build, side: float) -> list[_Cone]:
    x, y, _ = _joints(build, side)[2]
    heel, toe = (x, y + 0.02, 0.046), (x + side * 0.025, y - 0.165, 0.034)
    return [_cone(heel, toe, 0.044, 0.034), _cone(heel, (x, y + 0.01, 0.085), 0.044, 0.043)]


def _arm(build: _Build, which: int) -> tuple[list[_Cone], list[_Cone]]:
    """Return the cones of an arm with its hand, and the cones of its sleeve."""
    side, raised, bent = _SIDES[which], build.raised[which], build.bent[which]
    shoulder = np.array([side * build.shoulder, 0.0, _NECK - 0.105])
    out = np.array([side * np.sin(raised), 0.03, -np.cos(raised)])
    elbow = shoulder + 0.295 * out
    fore = unit(
        np.array([side * (0.6 * np.sin(raised) - 0.15 * bent), -np.sin(bent), -np.cos(bent)])
    )
    wrist, palm = elbow + 0.25 * fore, elbow + 0.325 * fore
    across = unit(np.cross(fore, [1.0, 0.0, 0.0]))
    arm = [
        _cone(shoulder, elbow, 0.047, 0.037),
        _cone(elbow, wrist, 0.037, 0.026),
        _cone(wrist, palm, 0.027, 0.034, 0.8),
        _cone(wrist + 0.03 * fore, wrist + 0.065 * fore + 0.045 * across, 0.012, 0.009),  # thumb
    ]
    for finger in range(4):
        root = palm + across * (0.020 * (finger - 1.5)) + 0.015 * fore
        curl = np.array([-0.02 * side, 0.0, 0.0])
        arm.append(
            _cone(root, root + fore * (0.075 - 0.012 * abs(finger - 1.3)) + curl, 0.0095, 0.0075)
        )
    if not build.long_sleeves:
        return arm, [_cone(shoulder, shoulder + 0.19 * out, 0.066, 0.062)]
    return arm, [
        _cone(shoulder, elbow, 0.066, 0.056),
        _cone(elbow, wrist - 0.01 * fore, 0.055, 0.042),
    ]


def _torso(build: _Build) -> list[_Cone]:
    hip, shoulder, wide = 0.6 * build.hip, build.shoulder, 0.125 * build.stout
    collar = (0, 0.015, _NECK - 0.065)
    torso = [
        _cone((-hip, 0, _HIPS), (hip, 0, _HIPS), wide, wide, 0.9),
        _cone((0, 0, _HIPS), (0, 0, _WAIST), build.waist + 0.02, build.waist, 0.8),
        _cone((0, 0, _WAIST), (0, 0, _CHEST), build.waist, build.chest, 0.78),
        _cone(
            (-0.55 * shoulder, 0, _CHEST + 0.03),
            (0.55 * shoulder, 0, _CHEST + 0.03),
            0.085,
            0.085,
            0.95,
        ),
    ]
    for side in _SIDES:
        torso.append(_cone(collar, (side * 0.8 * shoulder, 0, _NECK - 0.115), 0.060, 0.042))
        if build.woman:
            breast = np.array([side * 0.068, -0.075, _CHEST - 0.015])
            torso.append(_cone(breast, breast + np.array([0, 0.005, -0.005]), 0.056, 0.056))
    return torso


def _face(head: Array) -> list[_Cone]:
    """Return the skull first, then the face, the ears and the neck, at positions
    relative to the centre of the head."""

    def cone(
        p: Sequence[float], q: Sequence[float], a: float, b: float, flat: float = 1.0
    ) -> _Cone:
        return _cone(head + p, head + q, a, b, flat)

    ears = [
        cone((s * 0.088, 0.022, -0.010), (s * 0.092, 0.030, 0.020), 0.011, 0.014) for s in _SIDES
    ]
    return [
        cone((0, 0.018, 0.022), (0, 0.012, 0.028), 0.094, 0.092, 1.05),
        cone((0, -0.012, -0.020), (0, -0.038, -0.085), 0.070, 0.036),  # jaw
        cone((-0.024, -0.034, -0.080), (0.024, -0.034, -0.080), 0.024, 0.024),  # chin
        cone((0, -0.040, 0.015), (0, -0.044, -0.050), 0.046, 0.040),  # between brow and lips
        cone((0, -0.086, 0.008), (0, -0.101, -0.028), 0.007, 0.0115),  # nose
        cone((-0.016, -0.077, -0.061), (0.016, -0.077, -0.061), 0.0085, 0.0085),  # lips
        cone((-0.030, -0.076, 0.030), (0.030, -0.076, 0.030), 0.014, 0.014),  # brow
        *ears,
        _cone((0, 0.015, _NECK - 0.05), head + np.array([0, 0.02, -0.06]), 0.058, 0.052),
    ]
