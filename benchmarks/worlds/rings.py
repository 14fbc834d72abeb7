"""Donuts that fall into a pile: rigid rings with round tubes that touch the ground and
each other.

The simulation uses position-based rigid bodies (Müller et al., Detailed Rigid Body
Simulation with Extended Position Based Dynamics, SCA 2020), and solves all contacts of
a substep together. Two rings touch where the circles that are the axes of their tubes
are closest, so rings have the exact contacts of tori.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg.rotations import rotation_from_quaternion

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

_GROUND_SAMPLES = 8  # number of points of a ring that are tested against the ground
# Number of points from which the closest points of two rings are searched.
_PAIR_SAMPLES = 6
_SUBSTEPS = 4
_FRICTION = 0.5
_SOFTNESS = 1.5  # fraction of the speed that a contact removes per second
# Factor of the summed corrections, because each contact ignores the others.
_RELAX = 0.7


class Pile:
    """N rings that fall under gravity; z is up, the ground is z = 0.

    Attributes:
        positions: (N, 3) centres.
        quaternions: (N, 4) rotations as w, x, y, z of length 1; the axis of an
            unrotated ring is z.
        scales: (N,) scale factors of ring and tube.
    """

    def __init__(
        self,
        positions: npt.ArrayLike,
        quaternions: npt.ArrayLike,
        scales: npt.ArrayLike,
        *,
        ring: float,
        tube: float,
        gravity: float = 9.81,
    ) -> None:
        """Place rings at rest.

        Args:
            ring: Radius of the circle that is the axis of the tube, at scale 1.
            tube: Radius of the tube, at scale 1; less than ``ring``.
            gravity: Length units per s².

        Raises:
            ValueError: The shapes of the arrays do not match, or ``tube`` is not
                between 0 and ``ring``.
        """
        self.positions = np.array(positions, dtype=np.float64)
        self.quaternions = np.array(quaternions, dtype=np.float64)
        self.scales = np.array(scales, dtype=np.float64)
        count = len(self.positions)
        if (
            self.positions.shape != (count, 3)
            or self.quaternions.shape != (count, 4)
            or self.scales.shape != (count,)
        ):
            raise ValueError(
                "positions, quaternions, scales: expected shapes (N, 3), (N, 4), (N,), got "
                f"{self.positions.shape}, {self.quaternions.shape}, {self.scales.shape}"
            )
        if not 0 < tube < ring:
            raise ValueError(
                f"tube: expected a radius between 0 and the ring's {ring:g}, got {tube:g}"
            )
        self.ring, self.tube = ring * self.scales, tube * self.scales
        self._gravity = gravity
        self._velocities = np.zeros((count, 3))
        self._spins = np.zeros((count, 3))
        # The moments of inertia of a uniform torus of mass 1, about a diameter and
        # about the axis.
        about_axis = self.ring**2 + 0.75 * self.tube**2
        about_diameter = 0.5 * self.ring**2 + 0.625 * self.tube**2
        mass = self.scales**3
        self._lightness = 1 / mass
        self._ease = np.stack([1 / (mass * about_diameter)] * 2 + [1 / (mass * about_axis)], -1)

    def __len__(self) -> int:
        return len(self.scales)

    def step(self, seconds: float = 1 / 60) -> None:
        """Advance the simulation, by at most about 1/60 s for a stable pile."""
        pairs = self._pairs_within(seconds)
        for _ in range(_SUBSTEPS):
            self._substep(seconds / _SUBSTEPS, pairs)

    def relax(self, iterations: int = 40) -> None:
        """Separate overlapping rings without advancing time; afterwards all rings are
        at rest."""
        self._velocities[:], self._spins[:] = 0, 0
        pairs = self._pairs_within(1 / 60)
        for _ in range(iterations):
            rotations = rotation_from_quaternion(self.quaternions)
            contacts = _Contacts.of(self.positions, rotations, self.ring, self.tube, pairs)
            if not len(contacts.depth):
                return
            self._separate(contacts, rotations, self.positions.copy(), self.quaternions.copy())

    def deepest_overlap(self) -> float:
        """Return the depth of the deepest overlap between two rings, or between a ring
        and the ground, relative to the radius of the tubes."""
        pairs = _near_pairs(self.positions, self.ring + self.tube)
        contacts = _Contacts.of(
            self.positions, rotation_from_quaternion(self.quaternions), self.ring, self.tube, pairs
        )
        return float((contacts.depth / self.tube[contacts.first]).max(initial=0.0))

    def _pairs_within(self, seconds: float) -> tuple[Ints, Ints]:
        """Return the pairs of rings that may touch within ``seconds``."""
        reach = self.ring + self.tube
        speed = np.sqrt((self._velocities**2).sum(axis=1)) + reach * np.sqrt(
            (self._spins**2).sum(axis=1)
        )
        margin = 0.05 * self.tube + (speed + self._gravity * seconds) * seconds
        a, b = _near_pairs(self.positions, reach + margin)
        on_a, on_b = _nearest_on_rings(
            self.positions, rotation_from_quaternion(self.quaternions), self.ring, a, b
        )
        distance = np.sqrt(((on_a - on_b) ** 2).sum(axis=-1).min(axis=1, initial=np.inf))
        near = distance < (self.tube + margin)[a] + (self.tube + margin)[b]
        return a[near], b[near]

    def _substep(self, seconds: float, pairs: tuple[Ints, Ints]) -> None:
        before, turned_before = self.positions.copy(), self.quaternions.copy()
        self._velocities[:, 2] -= self._gravity * seconds
        self.positions += self._velocities * seconds
        self.quaternions = _turned(self.quaternions, self._spins * seconds)
        rotations = rotation_from_quaternion(self.quaternions)
        contacts = _Contacts.of(self.positions, rotations, self.ring, self.tube, pairs)
        touching = self._separate(contacts, rotations, before, turned_before)
        self._velocities = (self.positions - before) / seconds
        self._spins = _rotation_vector(self.quaternions, turned_before) / seconds
        # Contacts damp the motion, because dough is soft.
        self._velocities *= 1 - _SOFTNESS * seconds * touching[:, None]
        self._spins *= 1 - 2 * _SOFTNESS * seconds * touching[:, None]

    def _separate(
        self, contacts: _Contacts, rotations: Floats, before: Floats, turned_before: Floats
    ) -> npt.NDArray[np.bool_]:
        """Separate overlapping bodies and reduce their sliding, for all contacts
        together; return (N,) which bodies touch."""
        first, second, ground = contacts.first, contacts.second, contacts.second < 0
        other = np.where(ground, first, second)
        arm_a = contacts.point - self.positions[first]
        arm_b = contacts.point - self.positions[other]
        old = rotation_from_quaternion(turned_before)

        def moved(body: Ints, arm: Floats) -> Floats:
            """Return how far the bodies' material at the contacts has moved in this
            substep."""
            local = np.einsum("nji,nj->ni", rotations[body], arm)
            was = before[body] + np.einsum("nij,nj->ni", old[body], local)
            return np.asarray(self.positions[body] + arm - was)

        slip = moved(first, arm_a) - np.where(ground[:, None], 0.0, moved(other, arm_b))
        normal = contacts.normal
        slip -= normal * np.sum(slip * normal, axis=1, keepdims=True)
        length = np.sqrt((slip**2).sum(axis=1))
        allowed = np.minimum(length, _FRICTION * contacts.depth)
        push = (
            normal * contacts.depth[:, None] - slip * (allowed / np.maximum(length, 1e-12))[:, None]
        )

        size = np.sqrt((push**2).sum(axis=1))
        toward = push / np.maximum(size, 1e-12)[:, None]
        ease_a = self._give(first, arm_a, toward, rotations)
        ease_b = np.where(ground, 0.0, self._give(other, arm_b, toward, rotations))
        impulse = push / (ease_a + ease_b)[:, None]

        count = len(self)
        shift, turn, touching = np.zeros((count, 3)), np.zeros((count, 3)), np.zeros(count)
        for body, arm, share in (
            (first, arm_a, impulse),
            (other, arm_b, np.where(ground[:, None], 0.0, -impulse)),
        ):
            twist = np.cross(arm, share)
            twist = np.einsum(
                "nij,nj->ni",
                rotations[body],
                self._ease[body] * np.einsum("nji,nj->ni", rotations[body], twist),
            )
            for axis in range(3):
                shift[:, axis] += np.bincount(body, self._lightness[body] * share[:, axis], count)
                turn[:, axis] += np.bincount(body, twist[:, axis], count)
            touching += np.bincount(body, share.any(axis=1), count)
        # The sum of corrections by contacts that push in the same direction would be
        # too large, and their mean would converge too slowly. So the sum is divided by
        # the root of their number.
        weight = _RELAX / np.maximum(np.sqrt(touching), 1)
        self.positions += weight[:, None] * shift
        self.quaternions = _turned(self.quaternions, weight[:, None] * turn)
        return touching > 0

    def _give(self, body: Ints, arm: Floats, direction: Floats, rotations: Floats) -> Floats:
        """Return how far the end of each arm moves if a unit impulse acts on it."""
        local = np.einsum("nji,nj->ni", rotations[body], np.cross(arm, direction))
        return np.asarray(self._lightness[body] + np.sum(self._ease[body] * local**2, axis=1))


@dataclass
class _Contacts:
    """C contacts, where bodies overlap."""

    first: Ints  # (C,)
    second: Ints  # (C,) -1 is the ground
    point: Floats  # (C,3) positions in the middle of the overlap
    normal: Floats  # (C,3) unit vectors from the second body to the first
    depth: Floats  # (C,) > 0

    @staticmethod
    def of(
        positions: Floats, rotations: Floats, ring: Floats, tube: Floats, pairs: tuple[Ints, Ints]
    ) -> _Contacts:
        angle = np.arange(_GROUND_SAMPLES) * (2 * np.pi / _GROUND_SAMPLES)
        circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
        rim = positions[:, None] + ring[:, None, None] * np.einsum("nij,kj->nki", rotations, circle)
        below = tube[:, None] - rim[..., 2]
        body, place = np.nonzero(below > 0)
        low = rim[body, place]
        low[:, 2] = 0.5 * (low[:, 2] - tube[body])
        parts = [
            _Contacts(
                body,
                np.full(len(body), -1),
                low,
                np.tile([0.0, 0.0, 1.0], (len(body), 1)),
                below[body, place],
            )
        ]

        a, b = pairs
        if len(a):
            on_a, on_b = _nearest_on_rings(positions, rotations, ring, a, b)
            away = on_a - on_b
            distance = np.sqrt((away**2).sum(axis=-1))
            depth = (tube[a] + tube[b])[:, None] - distance
            # Two rings may touch at two points: at the deepest point, and at the
            # deepest point far from it.
            row = np.arange(len(a))
            deepest = depth.argmax(axis=1)
            elsewhere = ((on_a - on_a[row, deepest][:, None]) ** 2).sum(axis=-1) > (ring[a] ** 2)[
                :, None
            ]
            another = np.where(elsewhere, depth, -1.0).argmax(axis=1)
            for pick, counts in ((deepest, True), (another, elsewhere[row, another])):
                hit = np.flatnonzero((depth[row, pick] > 0) & counts)
                k = pick[hit]
                normal = away[hit, k] / np.maximum(distance[hit, k], 1e-9)[:, None]
                point = on_b[hit, k] + normal * (tube[b[hit]] - 0.5 * depth[hit, k])[:, None]
                parts.append(_Contacts(a[hit], b[hit], point, normal, depth[hit, k]))
        columns = zip(
            *((p.first, p.second, p.point, p.normal, p.depth) for p in parts), strict=True
        )
        return _Contacts(*(np.concatenate(column) for column in columns))


def _nearest_on_rings(
    positions: Floats, rotations: Floats, ring: Floats, a: Ints, b: Ints
) -> tuple[Floats, Floats]:
    """Return the closest points of the circles of pairs, (P,S,3) on each circle, from S
    starting points."""

    def onto(points: Floats, body: Ints) -> Floats:
        """Return the points on the bodies' circles that are closest to `points`."""
        axis = rotations[body][:, None, :, 2]
        offset = points - positions[body][:, None]
        offset = offset - axis * (offset * axis).sum(axis=-1, keepdims=True)
        length = np.maximum(np.sqrt((offset**2).sum(axis=-1, keepdims=True)), 1e-9)
        return np.asarray(positions[body][:, None] + offset * (ring[body][:, None, None] / length))

    angle = np.arange(_PAIR_SAMPLES) * (2 * np.pi / _PAIR_SAMPLES)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    on_a = positions[a][:, None] + ring[a][:, None, None] * np.einsum(
        "nij,kj->nki", rotations[a], circle
    )
    for _ in range(3):
        on_b = onto(on_a, b)
        on_a = onto(on_b, a)
    return on_a, on_b


def _near_pairs(positions: Floats, reach: Floats) -> tuple[Ints, Ints]:
    """Return pairs a < b of overlapping balls. The search uses a grid with cells as
    wide as the largest ball."""
    if not len(positions):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    width = 2 * float(reach.max())
    cell = np.floor(positions / width).astype(np.int64)
    cell -= cell.min(axis=0) - 1
    size = cell.max(axis=0) + 2
    key = (cell[:, 0] * size[1] + cell[:, 1]) * size[2] + cell[:, 2]
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    firsts, seconds = [], []
    for dx, dy, dz in np.ndindex(3, 3, 3):
        step = ((dx - 1) * size[1] + dy - 1) * size[2] + dz - 1
        if step < 0:
            continue  # this pair of cells is found from the other cell
        begin, end = (np.searchsorted(ordered, key + step, side=s) for s in ("left", "right"))
        count = end - begin
        first = np.repeat(np.arange(len(key)), count)
        within = np.arange(len(first)) - np.repeat(np.cumsum(count) - count, count)
        second = order[np.repeat(begin, count) + within]
        if step == 0:
            first, second = first[first < second], second[first < second]
        firsts.append(first)
        seconds.append(second)
    a, b = np.concatenate(firsts), np.concatenate(seconds)
    near = ((positions[a] - positions[b]) ** 2).sum(axis=1) < (reach[a] + reach[b]) ** 2
    return np.minimum(a, b)[near], np.maximum(a, b)[near]


def _turned(quaternions: Floats, rotation_vectors: Floats) -> Floats:
    """Return quaternions after additional small rotations by vectors in world space."""
    w, v = quaternions[:, :1], quaternions[:, 1:]
    r = 0.5 * rotation_vectors
    result = np.concatenate(
        [w - (r * v).sum(axis=1, keepdims=True), v + w * r + np.cross(r, v)], axis=1
    )
    return np.asarray(result / np.sqrt((result**2).sum(axis=1, keepdims=True)))


def _rotation_vector(after: Floats, before: Floats) -> Floats:
    """Return the small rotation from `before` to `after`, as a vector in world
    space."""
    w0, v0, w1, v1 = before[:, :1], before[:, 1:], after[:, :1], after[:, 1:]
    scalar = w1 * w0 + (v1 * v0).sum(axis=1, keepdims=True)
    vector = w0 * v1 - w1 * v0 - np.cross(v1, v0)
    return np.asarray(2 * np.sign(scalar) * vector)
