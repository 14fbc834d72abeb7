"""Trees of eight kinds, with a trunk that branches in levels, bark, and thin leaves
through which light passes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.procedural._light import gaussians_of
from benchmarks.worlds.procedural._parts import (
    GOLDEN_ANGLE,
    UP,
    Array,
    Noise,
    Part,
    allot,
    cover,
    leaf_outline,
    mix,
    strips,
    unit,
)
from v3dg.gaussians import Gaussians

_STEPS = 10  # number of segments of a branch
_CLEARANCE = 0.3  # metres; branches keep at least this distance from the ground
_LEAF_ROWS, _LEAF_COLUMNS = 3, 2


@dataclass(frozen=True)
class _Level:
    """The growth of branches of one level from the branches of the previous level."""

    children: int  # number of children of each branch
    start: float  # position of the first child on its parent, in [0,1]
    # Angles in radians to the parent's direction, of the first and of the last child.
    angle: tuple[float, float]
    # Lengths relative to the parent's, of the first and of the last child.
    length: tuple[float, float]
    bulge: float  # additional relative length of children in the middle
    wander: float  # strength of random bends
    rise: float  # strength of the bend upwards; a negative value bends downwards


@dataclass(frozen=True)
class _Kind:
    """The properties of a kind of tree. Lengths are in metres."""

    height: float  # height of the trunk
    girth: float  # radius of the trunk at breast height
    trunk: _Level
    levels: tuple[_Level, ...]
    bark: tuple[tuple[float, float, float], tuple[float, float, float]]
    # Length and half width at the default number of gaussians.
    leaf: tuple[float, float]
    # Two colours; the colours of leaves vary between them.
    leaves: tuple[tuple[float, float, float], ...]
    hang: float = 0.3  # how strongly leaves hang down
    needles: bool = False
    bands: float = 0.0  # strength of dark stripes across the bark, as on birches


def _straight(wander: float = 0.03) -> _Level:
    return _Level(1, 0.0, (0.0, 0.0), (1.0, 1.0), 0.0, wander, 0.0)


_TWIG = _Level(9, 0.12, (0.9, 0.5), (0.55, 0.35), 0.1, 0.10, 0.0)
_KINDS: dict[str, _Kind] = {
    "oak": _Kind(
        7.5,
        0.34,
        _straight(0.07),
        (
            _Level(15, 0.24, (1.35, 0.5), (0.62, 0.36), 0.12, 0.13, 0.03),
            _Level(9, 0.22, (0.95, 0.6), (0.52, 0.36), 0.1, 0.14, 0.02),
            _TWIG,
        ),
        ((0.050, 0.036, 0.024), (0.20, 0.16, 0.115)),
        (0.15, 0.045),
        ((0.045, 0.120, 0.012), (0.120, 0.230, 0.030), (0.20, 0.28, 0.04)),
    ),
    "maple": _Kind(
        7.0,
        0.24,
        _straight(0.05),
        (
            _Level(17, 0.22, (1.15, 0.45), (0.60, 0.34), 0.15, 0.09, 0.03),
            _Level(9, 0.2, (0.9, 0.6), (0.50, 0.34), 0.1, 0.10, 0.0),
            _TWIG,
        ),
        ((0.060, 0.050, 0.042), (0.24, 0.21, 0.18)),
        (0.16, 0.060),
        ((0.52, 0.035, 0.008), (0.68, 0.17, 0.010), (0.78, 0.42, 0.03)),
        0.5,
    ),
    "birch": _Kind(
        10.0,
        0.15,
        _straight(0.03),
        (
            _Level(24, 0.26, (0.95, 0.5), (0.34, 0.16), 0.12, 0.09, 0.0),
            _Level(8, 0.2, (0.8, 0.6), (0.50, 0.38), 0.1, 0.10, -0.06),
            _Level(7, 0.12, (0.8, 0.5), (0.65, 0.45), 0.1, 0.08, -0.12),
        ),
        ((0.46, 0.44, 0.40), (0.86, 0.85, 0.82)),
        (0.10, 0.036),
        ((0.12, 0.22, 0.015), (0.24, 0.33, 0.03), (0.42, 0.42, 0.05)),
        0.7,
        False,
        1.0,
    ),
    "cherry": _Kind(
        4.6,
        0.22,
        _straight(0.10),
        (
            _Level(14, 0.26, (1.25, 0.7), (0.80, 0.55), 0.1, 0.13, 0.03),
            _Level(9, 0.2, (0.85, 0.6), (0.50, 0.36), 0.1, 0.13, 0.02),
            _TWIG,
        ),
        ((0.045, 0.026, 0.022), (0.16, 0.10, 0.085)),
        (0.085, 0.042),
        ((0.83, 0.50, 0.58), (0.90, 0.68, 0.73), (0.95, 0.86, 0.87)),
        0.1,
    ),
    "willow": _Kind(
        6.2,
        0.32,
        _straight(0.08),
        (
            _Level(13, 0.34, (1.0, 0.5), (0.66, 0.50), 0.1, 0.10, 0.02),
            _Level(11, 0.2, (0.9, 0.7), (0.70, 0.55), 0.1, 0.10, -0.16),
            _Level(6, 0.1, (0.7, 0.5), (1.05, 0.80), 0.0, 0.05, -0.42),
        ),
        ((0.060, 0.050, 0.036), (0.22, 0.19, 0.14)),
        (0.17, 0.018),
        ((0.13, 0.22, 0.030), (0.24, 0.33, 0.06), (0.36, 0.40, 0.11)),
        1.4,
    ),
    "poplar": _Kind(
        12.0,
        0.22,
        _straight(0.02),
        (
            _Level(34, 0.08, (0.55, 0.30), (0.24, 0.10), 0.10, 0.06, 0.16),
            _Level(9, 0.12, (0.6, 0.4), (0.42, 0.30), 0.1, 0.08, 0.08),
            _Level(7, 0.12, (0.7, 0.4), (0.50, 0.35), 0.1, 0.08, 0.0),
        ),
        ((0.070, 0.062, 0.050), (0.25, 0.23, 0.19)),
        (0.11, 0.040),
        ((0.035, 0.100, 0.014), (0.090, 0.190, 0.030), (0.15, 0.25, 0.05)),
        0.5,
    ),
    "spruce": _Kind(
        11.0,
        0.20,
        _straight(0.01),
        (
            _Level(70, 0.06, (1.62, 0.70), (0.27, 0.02), 0.0, 0.03, 0.025),
            _Level(16, 0.08, (0.95, 0.7), (0.46, 0.16), 0.0, 0.05, -0.05),
            _Level(6, 0.10, (0.8, 0.6), (0.50, 0.30), 0.0, 0.05, -0.03),
        ),
        ((0.060, 0.036, 0.022), (0.20, 0.13, 0.085)),
        (0.060, 0.0060),
        ((0.014, 0.055, 0.022), (0.035, 0.095, 0.035), (0.07, 0.15, 0.05)),
        0.1,
        True,
    ),
    "pine": _Kind(
        10.5,
        0.24,
        _straight(0.05),
        (
            _Level(20, 0.52, (1.35, 0.7), (0.30, 0.15), 0.08, 0.12, 0.06),
            _Level(9, 0.3, (0.85, 0.6), (0.45, 0.32), 0.1, 0.12, 0.10),
            _Level(7, 0.3, (0.8, 0.5), (0.50, 0.40), 0.1, 0.08, 0.12),
        ),
        ((0.095, 0.045, 0.020), (0.36, 0.18, 0.085)),
        (0.125, 0.0056),
        ((0.030, 0.080, 0.035), (0.060, 0.130, 0.050), (0.11, 0.19, 0.06)),
        0.0,
        True,
    ),
}
TREE_KINDS: tuple[str, ...] = tuple(_KINDS)


@dataclass
class _Branches:
    """B branches as polylines with _STEPS segments."""

    points: Array  # (B,_STEPS+1,3)
    lengths: Array  # (B,)
    radii: Array  # (B,_STEPS+1)


def _grow(
    base: Array,
    direction: Array,
    lengths: Array,
    radii: Array,
    level: _Level,
    rng: np.random.Generator,
) -> _Branches:
    """Return crooked branches that start at ``base`` and taper to a quarter of their
    first radius."""
    points = np.empty((len(base), _STEPS + 1, 3))
    points[:, 0], heading = base, unit(direction)
    for step in range(_STEPS):
        points[:, step + 1] = points[:, step] + heading * (lengths / _STEPS)[:, None]
        points[:, step + 1, 2] = np.maximum(points[:, step + 1, 2], _CLEARANCE)
        heading = unit(
            heading + level.wander * rng.standard_normal(heading.shape) + level.rise * UP
        )
    taper = 1 - 0.78 * np.linspace(0, 1, _STEPS + 1) ** 0.9
    return _Branches(points, lengths, radii[:, None] * taper)


def _at(branches: _Branches, which: NDArray[np.int64], t: Array) -> tuple[Array, Array, Array]:
    """Return points, directions and radii of branches at positions ``t`` in [0,1]."""
    place = np.clip(t, 0, 1 - 1e-9) * _STEPS
    i = place.astype(np.int64)
    f = (place - i)[:, None]
    a, b = branches.points[which, i], branches.points[which, i + 1]
    radius = branches.radii[which, i] * (1 - f[:, 0]) + branches.radii[which, i + 1] * f[:, 0]
    return a + f * (b - a), unit(b - a), radius


def _branch_out(parents: _Branches, level: _Level, rng: np.random.Generator) -> _Branches:
    """Return the children of all branches, which are placed in a spiral around each
    branch."""
    count, k = len(parents.lengths), level.children
    which = np.repeat(np.arange(count), k)
    share = np.tile((np.arange(k) + 0.5) / k, count) + rng.uniform(-0.4, 0.4, count * k) / k
    t = level.start + (1 - level.start) * share
    base, along, thick = _at(parents, which, t)
    turn = np.tile(np.arange(k) * GOLDEN_ANGLE, count) + np.repeat(
        rng.uniform(0, 2 * np.pi, count), k
    )
    turn += 0.35 * rng.standard_normal(count * k)
    side = unit(np.cross(along, [0.31, 0.22, 0.92]) + 1e-9)
    aside = side * np.cos(turn)[:, None] + np.cross(along, side) * np.sin(turn)[:, None]
    angle = (
        level.angle[0]
        + (level.angle[1] - level.angle[0]) * share
        + 0.10 * rng.standard_normal(count * k)
    )
    direction = along * np.cos(angle)[:, None] + aside * np.sin(angle)[:, None]
    relative = level.length[0] + (level.length[1] - level.length[0]) * share
    relative = (relative + level.bulge * np.sin(np.pi * share)) * np.exp(
        0.14 * rng.standard_normal(count * k)
    )
    lengths = relative * parents.lengths[which]
    radii = np.minimum(0.62 * thick, 0.018 * lengths + 0.12 * thick)
    return _grow(base, direction, lengths, radii, level, rng)


def make_tree(
    num_gaussians: int = 315_630, *, kind: str = "oak", seed: int = 0, sh_degree: int = 1
) -> Gaussians:
    """Make a tree with bark on branches of four levels, and leaves or needles on the
    outer branches.

    Args:
        num_gaussians: Exact number of gaussians; the default is the mean of the V3DG
            paper's trees. Smaller numbers give fewer and larger leaves.
        kind: One of ``TREE_KINDS``.
        seed: Each seed gives another tree of the same kind.
        sh_degree: 0 to 3; from degree 1 on, leaves glow if the sun is behind them.

    Returns:
        Gaussians with NumPy arrays, in metres; z is up, and the foot of the trunk is at
        the origin.

    Raises:
        ValueError: ``num_gaussians`` is below 1,000, or ``kind`` is unknown.
    """
    if num_gaussians < 1000:
        raise ValueError(f"num_gaussians: expected at least 1000, got {num_gaussians}")
    if kind not in _KINDS:
        raise ValueError(f"kind: expected one of {', '.join(TREE_KINDS)}, got {kind}")
    shape = _KINDS[kind]
    rng = np.random.default_rng([seed, TREE_KINDS.index(kind)])
    noise = Noise(rng)
    height = shape.height * rng.uniform(0.9, 1.1)
    lean = UP + 0.04 * rng.standard_normal(3)
    trunk = _grow(
        np.zeros((1, 3)), lean[None], np.array([height]), np.array([shape.girth]), shape.trunk, rng
    )
    levels = [trunk]
    for level in shape.levels:
        levels.append(_branch_out(levels[-1], level, rng))

    n_bark = int(num_gaussians * (0.16 if shape.needles else 0.22))
    bark = _bark(levels, n_bark, shape, noise, rng)
    n_leaves = num_gaussians - len(bark.means)
    foliage = (
        _needles(levels, n_leaves, shape, rng)
        if shape.needles
        else _leaves(levels, n_leaves, shape, rng)
    )
    return gaussians_of(Part.concatenate([bark, foliage]), sh_degree, rng)


def _bark(
    levels: list[_Branches], n: int, shape: _Kind, noise: Noise, rng: np.random.Generator
) -> Part:
    """Return n gaussians of bark on all branches: flat ones on thick branches, needles
    along thin branches."""
    start = np.concatenate([b.points[:, :-1].reshape(-1, 3) for b in levels])
    end = np.concatenate([b.points[:, 1:].reshape(-1, 3) for b in levels])
    r0 = np.concatenate([b.radii[:, :-1].ravel() for b in levels])
    r1 = np.concatenate([b.radii[:, 1:].ravel() for b in levels])
    length = np.linalg.norm(end - start, axis=1)
    area = 2 * np.pi * 0.5 * (r0 + r1) * length
    # Thin branches get more gaussians than their area requires; otherwise they would
    # have too few to be visible.
    which = allot(area**0.78, n, rng)
    here = np.bincount(which, minlength=len(area))[which]
    t, angle = rng.random(n), rng.uniform(0, 2 * np.pi, n)
    along = unit(end - start)[which]
    side = unit(np.cross(along, [0.31, 0.22, 0.92]))
    normal = side * np.cos(angle)[:, None] + np.cross(along, side) * np.sin(angle)[:, None]
    radius = r0[which] + (r1 - r0)[which] * t
    centre = start[which] + (end - start)[which] * t[:, None]
    foot = np.exp(-np.maximum(centre[:, 2], 0) / 0.35) * (radius > 0.3 * shape.girth)
    ribs = 0.5 + 0.5 * np.sin(5 * angle + 2.0)
    radius = radius * (1 + foot * (0.35 + 0.55 * ribs))
    # Furrows run along the trunk.
    squeezed = (centre + normal * radius[:, None]) * [1.0, 1.0, 0.22]
    furrow = noise(squeezed, 14.0) + 0.35 * (noise(squeezed + 5, 60.0, 2) - 0.5)
    thick = np.minimum(radius / 0.05, 1)
    points = centre + normal * (radius * (1 + 0.16 * thick * (furrow - 0.5)))[:, None]
    colour = mix(shape.bark[0], shape.bark[1], np.clip(1.7 * furrow - 0.35, 0, 1))
    if shape.bands:
        band = noise(points * [3.5, 3.5, 16.0] + 3, 1.0)
        stripe = np.clip((band - 0.53) * 9, 0, 1) * shape.bands
        colour = mix(np.ones(3), [0.06, 0.055, 0.05], stripe) * colour
    mossy = np.clip(noise(points + 11, 1.5) - 0.45, 0, 1) * np.exp(
        -np.maximum(points[:, 2], 0) / 1.2
    )
    colour = colour + mossy[:, None] * np.array([0.05, 0.10, 0.0])
    spacing = np.sqrt(area[which] / here)
    part = cover(
        points,
        normal,
        along,
        spacing,
        colour,
        rng,
        # Bands across the trunk stay sharp if fewer gaussians are aligned along it.
        aligned=0.5 if shape.bands else 0.8,
        bend=radius,
    )
    # A branch that is thinner than the distance between its gaussians consists of
    # needles along its axis.
    limit = 0.30 * radius
    part.scales[:, 1] = np.minimum(part.scales[:, 1], np.maximum(limit, 0.0015))
    part.scales[:, 2] = np.minimum(part.scales[:, 2], part.scales[:, 1])
    part.scales[:, 0] = np.clip(
        part.scales[:, 0], part.scales[:, 1], np.maximum(0.30 * length[which], 0.002)
    )
    above = np.maximum(points[:, 2], 0)  # no gaussian is far below the ground
    part.scales[:, 0] = np.minimum(
        part.scales[:, 0], np.maximum(0.3 * above + 0.02, part.scales[:, 1])
    )
    return part


def _seats(
    levels: list[_Branches], k: int, rng: np.random.Generator
) -> tuple[Array, Array, NDArray[np.int64]]:
    """Return k random positions on the outer branches, with a density per length, and
    the direction and the index of the branch at each position."""
    twigs, limbs = levels[-1], levels[-2]
    points = np.concatenate([twigs.points, limbs.points])
    lengths = np.concatenate([twigs.lengths, 0.4 * limbs.lengths])
    branches = _Branches(points, lengths, np.zeros(points.shape[:2]))
    which = allot(lengths, k, rng)
    t = rng.random(k)
    t = np.where(which < len(twigs.lengths), 0.1 + 0.9 * t, 0.45 + 0.55 * t)
    place, along, _ = _at(branches, which, t)
    return place, along, which


def _leaf_colours(shape: _Kind, twigs: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Return a colour for each leaf. Leaves of one twig have similar colours."""
    k = len(twigs)
    of_twig = rng.random(int(twigs.max(initial=0)) + 1)[twigs]
    x = np.clip(0.5 * of_twig + 0.5 * rng.random(k) + 0.10 * rng.standard_normal(k), 0, 1)
    a, b, c = (np.array(colour) for colour in shape.leaves)
    first, second = np.minimum(2 * x, 1)[:, None], np.maximum(2 * x - 1, 0)[:, None]
    return np.asarray(a * (1 - first) + b * (first - second) + c * second)


def _leaves(levels: list[_Branches], n: int, shape: _Kind, rng: np.random.Generator) -> Part:
    each = _LEAF_ROWS * _LEAF_COLUMNS
    k = n // each
    place, along, which = _seats(levels, k, rng)
    # Fewer leaves are larger, but they do not preserve the total area.
    grown = (41_000 / k) ** 0.38
    out = unit(along + 0.75 * rng.standard_normal((k, 3)) - shape.hang * UP)
    face = unit(0.9 * UP + 0.75 * rng.standard_normal((k, 3)))
    length = shape.leaf[0] * grown * np.exp(0.22 * rng.standard_normal(k))
    # The lowest leaves hang just above the ground.
    place[:, 2] = np.maximum(place[:, 2], 1.3 * length)
    part, t, s = strips(
        place + 0.15 * out * length[:, None],
        out,
        face,
        length,
        shape.leaf[1] * grown * np.exp(0.15 * rng.standard_normal(k)),
        rng.uniform(0.0, 0.5, k),
        _LEAF_ROWS,
        _LEAF_COLUMNS,
        leaf_outline,
        rng,
    )
    part.albedo = np.repeat(_leaf_colours(shape, which, rng), each, axis=0)
    part.albedo *= (1.12 - 0.25 * np.abs(s))[:, None]
    # The rims of leaves let the background through, and some leaves are much fainter,
    # as after training.
    logits = (
        np.log(part.opacities / (1 - part.opacities))
        - 1.2 * t * t
        + 1.6 * rng.standard_normal(k * each)
    )
    part.opacities = 1 / (1 + np.exp(-logits))
    part.scales[:, 2] *= np.exp(0.6 * rng.standard_normal(k * each))
    part.translucency[:] = 0.6
    part.gloss[:] = 0.12
    rest = n - k * each
    return part if not rest else Part.concatenate([part, part.first(rest)])


def _needles(levels: list[_Branches], n: int, shape: _Kind, rng: np.random.Generator) -> Part:
    """Return needles, a gaussian for each."""
    place, along, which = _seats(levels, n, rng)
    grown = (250_000 / n) ** 0.38
    aside = unit(np.cross(along, rng.standard_normal((n, 3))))
    out = unit(0.75 * along + aside + 0.2 * rng.standard_normal((n, 3)))
    length = shape.leaf[0] * grown * np.exp(0.3 * rng.standard_normal(n))
    width = 0.5 * shape.leaf[1] * grown * np.exp(0.25 * rng.standard_normal(n))
    logits = 1.6 + 2.0 * rng.standard_normal(n)
    return Part(
        place + 0.5 * out * length[:, None],
        out,
        unit(np.cross(out, rng.standard_normal((n, 3)))),
        np.stack([0.33 * length, width, 0.6 * width], -1),
        1 / (1 + np.exp(-logits)),
        _leaf_colours(shape, which, rng),
        np.full(n, 0.08),
        np.full(n, 0.45),
        np.ones(n),
    )
