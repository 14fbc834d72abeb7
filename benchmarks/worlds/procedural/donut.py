"""A glazed donut with sprinkles. The axis of its tube is the circle of radius ``RING``
around the origin."""

from __future__ import annotations

import numpy as np

from benchmarks.worlds.procedural._light import gaussians_of
from benchmarks.worlds.procedural._parts import (
    Array,
    Noise,
    Part,
    SurfaceMap,
    cover,
    mix,
    revolve,
    sample,
    smoothstep,
    unit,
)
from v3dg.gaussians import Gaussians

RING = 0.068  # radius of the circle that is the axis of the tube
TUBE = 0.040  # radius of the tube with icing
_DOUGH = 0.037
_SPRINKLES = 260
_SPRINKLE_COLOURS = np.array(
    [
        [0.95, 0.95, 0.90],
        [0.90, 0.62, 0.03],
        [0.05, 0.30, 0.80],
        [0.02, 0.55, 0.35],
        [0.80, 0.06, 0.05],
        [0.30, 0.07, 0.45],
    ]
)
_ICINGS = np.array(
    [[0.66, 0.11, 0.27], [0.13, 0.045, 0.02], [0.88, 0.80, 0.62], [0.72, 0.28, 0.05]]
)


def _on_tube(around: Array, along: Array, radius: Array) -> Array:
    """Return points on tubes of ``radius``.

    ``around`` is the angle around the donut's axis. ``along`` is the angle in the
    cross-section of the tube, 0 at the outside and pi/2 at the top.
    """
    r = RING + radius * np.cos(along)
    return np.stack([r * np.cos(around), r * np.sin(around), radius * np.sin(along)], -1)


def make_donut(num_gaussians: int = 45_624, *, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """Make a donut of baked dough, with icing that drips over its rim, and sprinkles of
    six colours.

    Args:
        num_gaussians: Exact number of gaussians; the default is the number of the V3DG
            paper's donut.
        seed: The same seed gives the same gaussians. Every fourth seed gives pink
            icing.
        sh_degree: 0 to 3; the icing is glossy from degree 1 on, and sharpest at 3.

    Returns:
        Gaussians with NumPy arrays; z is up, the origin is in the middle of the hole,
        the diameter is 0.22.

    Raises:
        ValueError: ``num_gaussians`` is below 1,000.
    """
    if num_gaussians < 1000:
        raise ValueError(f"num_gaussians: expected at least 1000, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    noise = Noise(rng)
    phase = rng.uniform(0, 2 * np.pi, 8)
    icing_colour = _ICINGS[seed % len(_ICINGS)]

    def waves(around: Array, amounts: tuple[float, ...], first: int) -> Array:
        counts = (3, 5, 8, 13)
        terms = [
            a * np.sin(k * around + phase[first + i])
            for i, (k, a) in enumerate(zip(counts, amounts, strict=True))
        ]
        return np.asarray(sum(terms))

    def rim(around: Array) -> tuple[Array, Array]:
        """Return the angles in the cross-section at which the icing ends: at the
        outside and in the hole."""
        outer = 0.10 + waves(around, (0.10, 0.13, 0.14, 0.05), 0)
        inner = np.pi - 0.35 + waves(around, (0.12, 0.10, 0.10, 0.04), 4)
        return outer, inner

    def icing(u: Array, v: Array) -> Array:
        around = 2 * np.pi * u
        outer, inner = rim(around)
        rounded = np.clip(1 - (2 * v - 1) ** 2, 0, 1)
        thick = (TUBE - _DOUGH + 0.0005) * np.minimum(1.0, 3.2 * rounded) ** 0.5
        # Icing is thicker near its edge, where it stopped flowing.
        beads = 1 + 0.25 * np.exp(-((rounded - 0.12) ** 2) / 0.01)
        return _on_tube(around, outer + v * (inner - outer), _DOUGH - 0.0005 + thick * beads)

    def dough(u: Array, v: Array) -> Array:
        around = 2 * np.pi * u
        outer, inner = rim(around)
        along = inner - 0.15 + v * (2 * np.pi - (inner - outer) + 0.3)
        # A pale line marks the surface of the oil in which the donut was baked.
        pinch = 1 - 0.02 * np.exp(-((np.cos(along) - 1) ** 2) / 0.02)
        return _on_tube(around, along, _DOUGH * pinch)

    n_sprinkle = int(0.30 * num_gaussians) // _SPRINKLES
    n_dough = int(0.30 * num_gaussians)
    n_icing = num_gaussians - n_dough - n_sprinkle * _SPRINKLES

    crust = sample(dough, n_dough, rng, closed="u")
    section = np.arctan2(
        crust.points[:, 2], np.hypot(crust.points[:, 0], crust.points[:, 1]) - RING
    )
    grain, blotch = noise(crust.points, 260.0), noise(crust.points + 3, 45.0)
    pale = np.exp(-((section / 0.30) ** 2)) * (0.75 + 0.5 * blotch)
    brown = mix(
        [0.33, 0.12, 0.022], [0.52, 0.23, 0.05], np.clip(0.9 * blotch + 0.5 * (grain - 0.5), 0, 1)
    )
    brown = brown * (1 - pale[:, None]) + pale[:, None] * np.array([0.70, 0.46, 0.19])
    brown *= (0.88 + 0.24 * grain)[:, None]
    body = cover(
        crust.points,
        crust.normals,
        crust.tangents,
        crust.spacing,
        brown,
        rng,
        gloss=0.08,
        bend=_DOUGH,
    )

    glaze = sample(icing, n_icing, rng, closed="u")
    mottle = noise(glaze.points + 7, 60.0)
    pink = icing_colour * (0.93 + 0.14 * mottle)[:, None]
    edge = smoothstep(0.12, 0.0, np.minimum(glaze.v, 1 - glaze.v))
    pink *= (1 - 0.12 * edge)[:, None]
    coat = cover(
        glaze.points,
        glaze.normals,
        glaze.tangents,
        glaze.spacing,
        pink,
        rng,
        gloss=1.0,
        bend=_DOUGH,
        room=glaze.room,
    )

    parts = [body, coat]
    if n_sprinkle:
        parts.append(_sprinkles(icing, n_sprinkle, rng))
    return gaussians_of(Part.concatenate(parts), sh_degree, rng, even=0.6)


def _sprinkles(icing: SurfaceMap, n: int, rng: np.random.Generator) -> Part:
    """Return sugar capsules of n gaussians each that lie on the icing in random
    directions."""
    seats = sample(lambda u, v: icing(u, 0.10 + 0.80 * v), _SPRINKLES, rng)
    turn = rng.uniform(0, 2 * np.pi, _SPRINKLES)
    axis = (
        seats.tangents * np.cos(turn)[:, None]
        + np.cross(seats.normals, seats.tangents) * np.sin(turn)[:, None]
    )
    axis = unit(axis + 0.15 * rng.standard_normal(axis.shape))
    radius, half = 0.00125, 0.0050

    def capsule(t: Array) -> tuple[Array, Array]:
        angle = np.pi * t
        return radius * np.sin(angle) ** 0.5, half * np.cos(angle) + 0 * t

    shape = revolve(capsule, n)
    side = unit(np.cross(axis, seats.normals))
    frames = np.stack([side, np.cross(axis, side), axis], -1)  # (K,3,3) axes as columns

    def placed(vectors: Array) -> Array:
        return np.asarray(np.einsum("kij,nj->kni", frames, vectors).reshape(-1, 3))

    centres = np.repeat(seats.points + 0.6 * radius * seats.normals, n, axis=0)
    colours = np.repeat(
        _SPRINKLE_COLOURS[rng.integers(len(_SPRINKLE_COLOURS), size=_SPRINKLES)], n, axis=0
    )
    along = placed(np.broadcast_to([0.0, 0.0, 1.0], (n, 3)))
    part = cover(
        placed(shape.points) + centres,
        placed(shape.normals),
        along,
        shape.spacing,
        colours,
        rng,
        gloss=0.35,
        aligned=0.9,
        opacity=2.0,
        bend=4 * radius,
    )
    part.scales[:, 0] = np.minimum(part.scales[:, 0], 0.4 * half)
    return part
