"""A furnished room that resembles a captured one: millions of flat gaussians on walls
and furniture, with clutter and a few floaters."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from benchmarks.worlds.procedural._light import SH_C0
from benchmarks.worlds.procedural._parts import Array, unit
from v3dg.gaussians import Gaussians

SIZE = np.array([8.0, 6.0, 2.8])  # in metres; the middle of the floor is the origin
_FURNITURE = 26
_CLUTTER = 320
_FLOATERS = 0.004  # fraction of the gaussians that float in the air
_LOOKS = 1 << 14  # number of different dependences of colours on the view


@dataclass(frozen=True)
class _Box:
    """A box on the floor or on furniture, turned around z."""

    low: Array  # (3,) centre of the lower side
    size: Array  # (3,)
    turn: float  # in radians
    colour: Array  # (3,) in display values


@dataclass(frozen=True)
class _Faces:
    """The rectangles that form the surfaces of the room."""

    corner: Array  # (F, 3)
    edges: Array  # (F, 2, 3)
    colour: Array  # (F, 3)


def make_room(num_gaussians: int = 5_500_000, *, seed: int = 0, sh_degree: int = 3) -> Gaussians:
    """Make a room of 8 x 6 x 2.8 m with furniture and clutter.

    Gaussians have equal density on all surfaces. Their sizes and opacities vary as in
    captured rooms, and their colours depend a little on the view.

    Args:
        num_gaussians: Exact number of gaussians.
        seed: The same seed gives the same gaussians.
        sh_degree: 0 to 3.
    """
    rng = np.random.default_rng(seed)
    faces = _faces_of(_boxes(rng))
    area = np.linalg.norm(np.cross(faces.edges[:, 0], faces.edges[:, 1]), axis=1)
    which = rng.choice(len(area), num_gaussians, p=area / area.sum())
    along = rng.random((num_gaussians, 2), dtype=np.float32)
    means = faces.corner[which] + along[:, :1] * faces.edges[which, 0]
    means += along[:, 1:] * faces.edges[which, 1]
    spacing = np.sqrt(area.sum() / num_gaussians)
    size = spacing * np.exp(0.45 * rng.standard_normal(num_gaussians, dtype=np.float32) - 0.1)
    scales = np.stack([size, size * rng.uniform(0.3, 1, num_gaussians), 0.12 * size], axis=1)
    floats = rng.random(num_gaussians, dtype=np.float32) < _FLOATERS
    means[floats] = rng.uniform(-0.5, 0.5, (floats.sum(), 3)) * SIZE + [0, 0, SIZE[2] / 2]
    scales[floats] *= rng.uniform(1, 6, (floats.sum(), 1))
    faint = rng.uniform(0.02, 0.3, num_gaussians)
    opacities = np.where(floats, faint, 1 - rng.random(num_gaussians) ** 3)
    table = 0.03 * rng.standard_normal((_LOOKS, (sh_degree + 1) ** 2, 3), dtype=np.float32)
    sh = table[rng.integers(_LOOKS, size=num_gaussians)]
    sh[:, 0] = (faces.colour[which] + _texture(means, rng) - 0.5) / SH_C0
    rows = (means, _turned(faces, which, rng), scales, opacities, sh)
    return Gaussians(*(np.ascontiguousarray(row, dtype=np.float32) for row in rows))


def _boxes(rng: np.random.Generator) -> list[_Box]:
    """Return furniture on the floor, and clutter on furniture and on the floor."""
    boxes: list[_Box] = []
    for _ in range(_FURNITURE):
        size = rng.uniform([0.4, 0.35, 0.35], [1.2, 0.8, 1.9])
        angle = rng.uniform(0, 2 * np.pi)
        place = np.array([np.cos(angle) * 3.4, np.sin(angle) * 2.5, 0.0])
        boxes.append(_Box(place, size, rng.normal(0, 0.15), rng.uniform(0.1, 0.8, 3)))
    for _ in range(_CLUTTER):
        size = np.exp(rng.normal(np.log(0.12), 0.5, 3))
        below = boxes[rng.integers(_FURNITURE)]
        offset = rng.uniform(-0.4, 0.4, 2) * below.size[:2]
        place = below.low + np.array([*offset, below.size[2]])
        boxes.append(_Box(place, size, rng.uniform(0, np.pi), rng.uniform(0, 1, 3)))
    return boxes


def _faces_of(boxes: list[_Box]) -> _Faces:
    room = _Box(np.zeros(3), SIZE, 0.0, np.array([0.75, 0.72, 0.66]))
    corners = []
    edges = []
    colours = []
    for box in [room, *boxes]:
        cos = np.cos(box.turn)
        sin = np.sin(box.turn)
        axes = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]]) * box.size[:, None]
        low = box.low - axes[0] / 2 - axes[1] / 2
        for side in range(3):
            first = axes[(side + 1) % 3]
            second = axes[(side + 2) % 3]
            for corner in (low, low + axes[side]):
                corners.append(corner)
                edges.append([first, second])
                colours.append(box.colour * (0.7 + 0.15 * side))
    return _Faces(np.array(corners), np.array(edges), np.array(colours))


def _texture(means: Array, rng: np.random.Generator) -> NDArray[np.float32]:
    """Return random differences of brightness (n, 1), the sum of waves of many
    sizes."""
    total = np.zeros(len(means), np.float32)
    for octave in range(8):
        direction = rng.normal(size=3) * 3.0 * 1.7**octave
        waves = np.sin((means @ direction).astype(np.float32))
        total += np.float32(0.05 * 0.9**octave) * waves
    return total[:, None]


def _turned(faces: _Faces, which: NDArray[np.int64], rng: np.random.Generator) -> Array:
    """Return quaternions that rotate z to the normals of faces, and x to random
    directions."""
    normals = unit(np.cross(faces.edges[:, 0], faces.edges[:, 1]))
    noise = rng.standard_normal((len(which), 3), dtype=np.float32)
    normal = unit(normals[which] + 0.05 * noise)
    half = normal + np.array([0, 0, 1])
    half[np.linalg.norm(half, axis=1) < 1e-6] = [1, 0, 0]
    half = unit(half)
    # A rotation about z, followed by half a turn about `half`, which exchanges z and
    # the normal.
    angle = rng.uniform(0, np.pi, len(which))
    cos = np.cos(angle)
    sin = np.sin(angle)
    x, y, z = half.T
    return np.stack([-z * sin, x * cos + y * sin, y * cos - x * sin, z * cos], axis=1)
