"""A Doric temple of weathered marble, with a tiled roof, grass between its steps and
ivy on a wall."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.worlds.procedural._light import gaussians_of
from benchmarks.worlds.procedural._parts import (
    UP,
    Array,
    Noise,
    Part,
    Patch,
    SurfaceMap,
    cover,
    leaf_outline,
    mix,
    sample,
    smoothstep,
    strips,
    surface_area,
    unit,
)
from v3dg.gaussians import Gaussians

# Lengths are in metres. There are 6 x 11 columns around a rectangle; x is parallel to
# the front, which faces -y.
_COLUMNS_X, _COLUMNS_Y, _PITCH = 6, 11, 2.35
_HALF_X, _HALF_Y = (_COLUMNS_X - 1) * _PITCH / 2, (_COLUMNS_Y - 1) * _PITCH / 2
_STEP, _TREAD = 0.38, 0.42
_FLOOR = 3 * _STEP
_SHAFT, _RADIUS = 4.7, 0.52
_BEAM = _FLOOR + _SHAFT + 0.55  # height of the bottom of the architrave
_FRIEZE, _CORNICE, _EAVES = _BEAM + 0.75, _BEAM + 1.55, _BEAM + 1.85
_RIDGE = _EAVES + 1.9
_OVERHANG = 0.95


@dataclass(frozen=True)
class _Face:
    """A part of the temple's surface with one material."""

    surface: SurfaceMap
    area: float
    material: str
    bend: float = np.inf  # smallest radius of curvature in metres
    cells: int = 8
    closed: str = ""


def _quad(
    a: Sequence[float], b: Sequence[float], c: Sequence[float], d: Sequence[float]
) -> SurfaceMap:
    """Return the bilinear patch with corners a, b along u and corners d, c at the
    opposite side. Its normal is (b - a) x (d - a)."""
    corners = (np.array(x, dtype=np.float64) for x in (a, b, c, d))
    p, q, r, s = corners

    def surface(u: Array, v: Array) -> Array:
        u, v = u[:, None], v[:, None]
        return np.asarray((1 - v) * ((1 - u) * p + u * q) + v * ((1 - u) * s + u * r))

    return surface


def _box(
    low: Sequence[float], high: Sequence[float], material: str, sides: str = "xXyYzZ"
) -> list[_Face]:
    """Return some faces of a box: small letters name faces at ``low``, capitals faces
    at ``high``."""
    (x, y, z), (X, Y, Z) = low, high
    corners = {
        "x": ((x, Y, z), (x, y, z), (x, y, Z), (x, Y, Z)),
        "X": ((X, y, z), (X, Y, z), (X, Y, Z), (X, y, Z)),
        "y": ((x, y, z), (X, y, z), (X, y, Z), (x, y, Z)),
        "Y": ((X, Y, z), (x, Y, z), (x, Y, Z), (X, Y, Z)),
        "z": ((x, Y, z), (X, Y, z), (X, y, z), (x, y, z)),
        "Z": ((x, y, Z), (X, y, Z), (X, Y, Z), (x, Y, Z)),
    }
    return [_flat(corners[side], material) for side in sides]


def _flat(corners: Sequence[Sequence[float]], material: str) -> _Face:
    surface = _quad(*corners)
    return _Face(surface, surface_area(surface, 1), material, cells=2)


def _ring(
    half_x: float, half_y: float, width: float, bottom: float, top: float, material: str
) -> list[_Face]:
    """Return a beam along the sides of a rectangle with the given outer half lengths.
    The beam has faces on all sides."""
    outer = _box((-half_x, -half_y, bottom), (half_x, half_y, top), material, "xXyY")
    inside = (half_x - width, half_y - width)
    a, b = inside
    inner = [
        _flat(((-a, -b, bottom), (-a, b, bottom), (-a, b, top), (-a, -b, top)), material),
        _flat(((a, b, bottom), (a, -b, bottom), (a, -b, top), (a, b, top)), material),
        _flat(((a, -b, bottom), (-a, -b, bottom), (-a, -b, top), (a, -b, top)), material),
        _flat(((-a, b, bottom), (a, b, bottom), (a, b, top), (-a, b, top)), material),
    ]
    under = []
    for low, high in (
        ((-half_x, -half_y), (half_x, -b)),
        ((-half_x, b), (half_x, half_y)),
        ((-half_x, -b), (-a, b)),
        ((a, -b), (half_x, b)),
    ):
        for face, z in (("z", bottom), ("Z", top)):
            under += _box((*low, z), (*high, z), material, face)
    return outer + inner + under


def _column(x: float, y: float) -> list[_Face]:
    """Return a fluted shaft that narrows upwards, and the round and the square part of
    its capital."""

    def shaft(v: Array, u: Array) -> Array:
        angle = -2 * np.pi * u
        # The shaft has an entasis, a slight bulge.
        radius = _RADIUS * (1 - 0.22 * v + 0.035 * np.sin(np.pi * v))
        flute = np.abs(np.cos(10 * angle))  # 20 flutes that meet in sharp edges
        radius = radius * (1 - 0.055 * (1 - flute**2))
        return np.stack(
            [x + radius * np.cos(angle), y + radius * np.sin(angle), _FLOOR + _SHAFT * v], -1
        )

    def cushion(u: Array, v: Array) -> Array:
        angle = 2 * np.pi * u
        radius = _RADIUS * (0.78 + 0.46 * np.sin(0.5 * np.pi * v) ** 0.8)
        z = _FLOOR + _SHAFT + 0.30 * v
        return np.stack([x + radius * np.cos(angle), y + radius * np.sin(angle), z], -1)

    top = _FLOOR + _SHAFT + 0.30
    half = 1.30 * _RADIUS
    faces = [
        _Face(shaft, 2 * np.pi * 0.9 * _RADIUS * _SHAFT * 1.1, "column", 0.10, 80, "v"),
        _Face(cushion, 2 * np.pi * 1.1 * _RADIUS * 0.42, "marble", 0.25, 24, "u"),
    ]
    return faces + _box((x - half, y - half, top), (x + half, y + half, _BEAM), "marble", "xXyYz")


def _frieze() -> list[_Face]:
    """Return the triglyphs, one above each column and one above each gap, and the plain
    slabs behind them."""
    faces = _ring(_HALF_X + 0.50, _HALF_Y + 0.50, 1.0, _FRIEZE, _CORNICE, "metope")
    width, step = 0.50, 0.065
    for half, other, count, along in (
        (_HALF_X, _HALF_Y + 0.50, 2 * _COLUMNS_X - 1, 0),
        (_HALF_Y, _HALF_X + 0.50, 2 * _COLUMNS_Y - 1, 1),
    ):
        for place in np.linspace(-half, half, count):
            for sign in (-1.0, 1.0):
                for bar in (-1, 0, 1):
                    middle, thick = place + bar * width / 3, width / 9.5
                    low, high = sorted((sign * other, sign * (other + step)))
                    a = (middle - thick, low) if along == 0 else (low, middle - thick)
                    b = (middle + thick, high) if along == 0 else (high, middle + thick)
                    sides = (
                        ("xX" + ("Y" if sign > 0 else "y"))
                        if along == 0
                        else ("yY" + ("X" if sign > 0 else "x"))
                    )
                    faces += _box((*a, _FRIEZE + 0.03), (*b, _CORNICE - 0.06), "triglyph", sides)
    return faces


def _roof() -> list[_Face]:
    half_x, half_y = _HALF_X + _OVERHANG, _HALF_Y + _OVERHANG
    rows, columns = 15, 44
    faces = []
    for sign in (-1.0, 1.0):

        def slope(u: Array, v: Array, sign: float = sign) -> Array:
            """Return rows of flat tiles with round tiles over their joints."""
            across = (columns * u) % 1.0
            down = (rows * v) % 1.0
            hump = 0.085 * smoothstep(0.2, 0.0, np.minimum(across, 1 - across))
            # The step at the end of a row is steep, but not vertical.
            lift = hump + 0.05 * (down - smoothstep(0.85, 1.0, down))
            y = sign * half_y * (1 - 2 * u)
            x = sign * half_x * v
            return np.stack([x, y, _RIDGE + (_EAVES - _RIDGE) * v + lift], -1)

        faces.append(_Face(slope, surface_area(slope, 352), "tile", 0.10, 352))
        under = (
            (sign * half_x, -half_y, _EAVES),
            (0, -half_y, _RIDGE),
            (0, half_y, _RIDGE),
            (sign * half_x, half_y, _EAVES),
        )
        faces.append(_flat([(x, sign * y, z - 0.25) for x, y, z in under], "wood"))
    for sign in (-1.0, 1.0):
        y = sign * (_HALF_Y + 0.45)
        left, right, top = (-half_x, y, _EAVES), (half_x, y, _EAVES), (0.0, y, _RIDGE - 0.1)
        corners = (left, right, top, top) if sign < 0 else (right, left, top, top)
        faces.append(_flat(corners, "pediment"))
        # A sloping cornice along each edge of the gable.
        for side in (-1.0, 1.0):
            edge, out = (side * half_x, _EAVES), sign * half_y
            low_y, high_y = sorted((y, out))
            for drop, name in ((0.0, "front"), (0.32, "under")):
                a, b = (edge[0], edge[1] - drop), (0.0, _RIDGE - drop)
                if name == "front":
                    quad = (
                        (a[0], out, a[1] - 0.32),
                        (b[0], out, b[1] - 0.32),
                        (b[0], out, b[1]),
                        (a[0], out, a[1]),
                    )
                else:
                    quad = (
                        (a[0], low_y, a[1]),
                        (b[0], low_y, b[1]),
                        (b[0], high_y, b[1]),
                        (a[0], high_y, a[1]),
                    )
                flip = (side * sign < 0) if name == "front" else side < 0
                faces.append(_flat(quad[::-1] if flip else quad, "marble"))
    return faces


@functools.cache
def _faces() -> tuple[_Face, ...]:
    faces: list[_Face] = []
    for i in range(3):
        out = 0.85 + (2 - i) * _TREAD
        x, y = _HALF_X + out, _HALF_Y + out
        faces += _box((-x, -y, i * _STEP), (x, y, (i + 1) * _STEP), "step", "xXyY")
        z, a, b = (i + 1) * _STEP, x - _TREAD, y - _TREAD
        if i < 2:
            for low, high in (
                ((-x, -y), (x, -b)),
                ((-x, b), (x, y)),
                ((-x, -b), (-a, b)),
                ((a, -b), (x, b)),
            ):
                faces += _box((*low, z), (*high, z), "step", "Z")
        else:
            faces += _box((-x, -y, z), (x, y, z), "floor", "Z")
    for i in range(_COLUMNS_X):
        for j in range(_COLUMNS_Y):
            if i in (0, _COLUMNS_X - 1) or j in (0, _COLUMNS_Y - 1):
                faces += _column(-_HALF_X + i * _PITCH, -_HALF_Y + j * _PITCH)
    # The cella has walls with two sides, a doorway in its front wall, and a ceiling.
    a, b, door, lintel = _HALF_X - 2.1, _HALF_Y - 2.6, 1.15, _FLOOR + 3.9
    faces += _box((-a, -b, _FLOOR), (a, b, _BEAM), "wall", "xXY")
    faces += _box((-a, -b, _FLOOR), (-door, -b, _BEAM), "wall", "y")
    faces += _box((door, -b, _FLOOR), (a, -b, _BEAM), "wall", "y")
    faces += _box((-door, -b, lintel), (door, -b, _BEAM), "wall", "yz")
    inner_a, inner_b = a - 0.5, b - 0.5
    faces += [
        _flat(
            (
                (-door, -b, _FLOOR),
                (-door, -inner_b, _FLOOR),
                (-door, -inner_b, lintel),
                (-door, -b, lintel),
            ),
            "wall",
        ),
        _flat(
            (
                (door, -inner_b, _FLOOR),
                (door, -b, _FLOOR),
                (door, -b, lintel),
                (door, -inner_b, lintel),
            ),
            "wall",
        ),
        _flat(
            (
                (inner_a, inner_b, _FLOOR),
                (-inner_a, inner_b, _FLOOR),
                (-inner_a, inner_b, _BEAM),
                (inner_a, inner_b, _BEAM),
            )[::-1],
            "wall",
        ),
    ]
    faces += _box((-_HALF_X, -_HALF_Y, _BEAM + 0.7), (_HALF_X, _HALF_Y, _BEAM + 0.7), "wood", "z")
    faces += _ring(_HALF_X + 0.50, _HALF_Y + 0.50, 1.0, _BEAM, _FRIEZE - 0.08, "marble")
    faces += _ring(_HALF_X + 0.57, _HALF_Y + 0.57, 1.14, _FRIEZE - 0.08, _FRIEZE, "marble")
    faces += _frieze()
    faces += _ring(_HALF_X + 0.62, _HALF_Y + 0.62, 1.2, _CORNICE, _CORNICE + 0.10, "marble")
    faces += _ring(_HALF_X + _OVERHANG, _HALF_Y + _OVERHANG, 1.4, _CORNICE + 0.10, _EAVES, "marble")
    return (*faces, *_roof())


# The relative density of gaussians on each material, and whether their long axes are
# aligned with the surface's first direction.
_DENSITY = {
    "column": 1.3,
    "tile": 1.0,
    "triglyph": 1.6,
    "pediment": 1.3,
    "wood": 0.6,
    "floor": 0.6,
    "wall": 0.8,
}


def make_temple(num_gaussians: int = 1_350_487, *, seed: int = 0, sh_degree: int = 1) -> Gaussians:
    """Make a Doric temple of 6 x 11 columns.

    Args:
        num_gaussians: Exact number of gaussians; the default is the number of the V3DG
            paper's temple. The temple is recognisable from about 50,000 on.
        seed: Each seed gives different weathering and plants.
        sh_degree: 0 to 3.

    Returns:
        Gaussians with NumPy arrays, in metres. The temple measures 15 x 27 and is 10
        high; z is up, the ground is at z = 0, and the origin is below the middle.

    Raises:
        ValueError: ``num_gaussians`` is below 5,000; the temple has about a thousand
            faces.
    """
    if num_gaussians < 5000:
        raise ValueError(f"num_gaussians: expected at least 5000, got {num_gaussians}")
    rng = np.random.default_rng(seed)
    noise = Noise(rng)
    plants = [_grass(int(0.025 * num_gaussians), rng), _ivy(int(0.045 * num_gaussians), noise, rng)]
    n = num_gaussians - sum(len(part.means) for part in plants)

    faces = _faces()
    shares = np.array([face.area * _DENSITY.get(face.material, 1.0) for face in faces])
    ends = np.round(np.cumsum(shares) / shares.sum() * n).astype(int)
    counts = np.diff(ends, prepend=0)
    patches: dict[str, list[tuple[Patch, float]]] = {}
    for face, count in zip(faces, counts, strict=True):
        if count:
            patch = sample(face.surface, count, rng, face.cells, closed=face.closed)
            patches.setdefault(face.material, []).append((patch, face.bend))
    parts = [_stone(material, of_it, noise, rng) for material, of_it in patches.items()]
    return gaussians_of(Part.concatenate([*parts, *plants]), sh_degree, rng)


def _stone(
    material: str, patches: list[tuple[Patch, float]], noise: Noise, rng: np.random.Generator
) -> Part:
    """Return gaussians that cover the patches of one material, with worn edges and
    colours."""
    points, normals, tangents, room = (
        np.concatenate([getattr(patch, name) for patch, _ in patches])
        for name in ("points", "normals", "tangents", "room")
    )
    counts = [len(patch.u) for patch, _ in patches]
    spacing = np.repeat([patch.spacing for patch, _ in patches], counts)
    bend = np.repeat([bend for _, bend in patches], counts)
    colour = (
        _material_colour(material, points, noise)
        * _joints(material, points, normals, noise)[:, None]
    )
    if material == "pediment":
        figures = smoothstep(0.46, 0.62, noise(points * [1.0, 0.0, 1.0] + 5, 1.9))
        points = points + normals * (0.30 * figures)[:, None]
        colour = mix(np.ones(3), [1.35, 1.05, 0.80], figures) * colour
    dents = 0.05 * smoothstep(0.66, 0.74, noise(points + 3, 2.3))
    wear = 0.035 * (noise(points + 91, 1.7) - 0.5) - dents
    return cover(
        points + normals * wear[:, None],
        normals,
        tangents,
        spacing,
        np.clip(_weathered(material, points, normals, colour, noise), 0, 1),
        rng,
        gloss=0.0 if material in ("wood", "tile") else 0.10,
        bend=bend,
        room=room,
        aligned=0.9 if material == "column" else 0.0,
    )


def _material_colour(material: str, points: Array, noise: Noise) -> Array:
    grain = noise(points, 9.0)
    if material == "tile":
        # A separate shade for each tile.
        each = noise(np.round(points * [1.2, 1.55, 1.2]) * 7.7, 1.0, 1)
        return mix([0.36, 0.11, 0.045], [0.72, 0.31, 0.14], np.clip(0.7 * each + 0.5 * grain, 0, 1))
    if material == "wood":
        return mix([0.05, 0.028, 0.014], [0.16, 0.09, 0.045], noise(points * [6, 0.6, 6], 1.0))
    cloud = np.clip(0.75 * noise(points + 31, 0.55) + 0.55 * grain - 0.1, 0, 1)
    marble = mix([0.50, 0.40, 0.27], [0.86, 0.80, 0.69], cloud)
    paint = {"metope": [0.62, 0.30, 0.22], "pediment": [0.50, 0.56, 0.66]}.get(
        material, [1.0, 1.0, 1.0]
    )
    return np.asarray(marble * np.array(paint))


def _joints(material: str, points: Array, normals: Array, noise: Noise) -> Array:
    """Return factors of the brightness: dark joints, and a shade for each stone. Stones
    are courses of walls, slabs of floors and drums of columns."""
    x, y, z = points.T
    if material == "column":
        return 1 - 0.55 * smoothstep(0.02, 0.005, _to_joint(z - _FLOOR, _SHAFT / 5))
    if material not in ("wall", "step", "floor"):
        return np.ones(len(points))
    tall, long = (0.52, 1.24) if material == "wall" else (1.1, 1.3)
    height = np.where(np.abs(normals[:, 2]) > 0.7, y, z)
    along = (
        x if material == "floor" else np.where(np.abs(normals[:, 0]) > np.abs(normals[:, 1]), y, x)
    )
    course = np.floor(height / tall)
    shifted = along + 0.5 * long * course
    joint = np.minimum(_to_joint(height, tall), _to_joint(shifted, long))
    stone = noise(np.stack([course, np.floor(shifted / long), 0 * x], -1) * 3.7, 1.0, 1)
    return (0.86 + 0.28 * stone) * (1 - 0.6 * smoothstep(0.022, 0.006, joint))


def _weathered(material: str, points: Array, normals: Array, colour: Array, noise: Noise) -> Array:
    """Return the colours with dark streaks of rain below ledges, and with lichen on
    flat parts."""
    if material == "wood":
        return colour
    streak = noise(points * [1.0, 1.0, 0.07] + 17, 2.4) * noise(points + 57, 0.6)
    stain = np.clip(4.5 * (streak - 0.30), 0, 0.75)
    colour = colour * (1 - stain[:, None] * np.array([0.55, 0.58, 0.62]))
    if material == "wall":
        return colour
    lichen = smoothstep(0.62, 0.72, noise(points + 71, 3.1)) * (
        0.25 + 0.75 * (np.abs(normals[:, 2]) > 0.7)
    )
    return mix(colour, [0.36, 0.34, 0.08], 0.6 * lichen)


def _to_joint(x: Array, length: float) -> Array:
    """Return the distance to the nearest joint between blocks of the same length."""
    return np.asarray(np.abs(x / length - np.round(x / length)) * length)


def _grass(n: int, rng: np.random.Generator) -> Part:
    """Return blades of grass in the corners of the steps and around the base of the
    temple."""
    rows = 6
    k = max(n // rows, 1)
    step = rng.integers(0, 3, k)
    out = (
        0.85
        + (3 - step) * _TREAD
        - 0.04
        + np.abs(0.05 * rng.standard_normal(k))
        + (step == 0) * rng.exponential(0.12, k)
    )
    half = np.stack([_HALF_X + out, _HALF_Y + out], -1)
    # A tuft is many blades near one point of the rectangle's edge.
    tuft = rng.random(max(k // 45, 1))
    place = (tuft[rng.integers(len(tuft), size=k)] + 0.0025 * rng.standard_normal(k)) % 1.0
    side, along = (4 * place).astype(int), 2 * ((4 * place) % 1.0) - 1
    sign = np.where(side % 2, 1.0, -1.0)
    x = np.where(side < 2, sign * half[:, 0], along * half[:, 0])
    y = np.where(side < 2, along * half[:, 1], sign * half[:, 1])
    base = np.stack([x, y, step * _STEP], -1)
    lean = 0.45 * rng.standard_normal((k, 3)) * [1, 1, 0]
    part, t, _ = strips(
        base,
        UP + lean,
        UP * 0.5 - lean,
        rng.uniform(0.10, 0.42, k),
        rng.uniform(0.004, 0.009, k),
        rng.uniform(0.05, 0.5, k),
        rows,
        1,
        lambda t: (1 - t) ** 0.6,
        rng,
    )
    hue = np.repeat(rng.random(k), rows)
    part.albedo = mix([0.04, 0.09, 0.015], [0.30, 0.36, 0.07], np.clip(0.6 * t + 0.5 * hue, 0, 1))
    part.translucency[:] = 0.5
    part.occlusion = 0.5 + 0.5 * t
    return part


def _ivy(n: int, noise: Noise, rng: np.random.Generator) -> Part:
    """Return leaves of ivy that climb from the ground up the columns at one corner, and
    over the beams."""
    rows, columns = 3, 2
    k = max(n // (rows * columns), 1)
    many = 6 * k
    # Indices of columns along one side, counted from the corner.
    which = rng.integers(0, 5, many)
    foot = np.stack([np.full(many, _HALF_X), -_HALF_Y + which * _PITCH], -1)
    angle = rng.uniform(0, 2 * np.pi, many)
    z = _FLOOR + (_SHAFT + 0.5) * rng.random(many)
    out = np.stack([np.cos(angle), np.sin(angle), np.zeros(many)], -1)
    base = (
        np.concatenate([foot, z[:, None]], 1)
        + out * (_RADIUS * (1.0 - 0.15 * (z - _FLOOR) / _SHAFT))[:, None]
    )
    beam = rng.random(many) < 0.25
    y = -_HALF_Y - 0.5 + 9.0 * rng.random(many) ** 1.3
    over = np.stack(
        [np.full(many, _HALF_X + 0.53), y, _BEAM + (_CORNICE - _BEAM) * rng.random(many)], -1
    )
    base[beam], out[beam] = over[beam], [1.0, 0.0, 0.0]
    reach = 1.25 - 0.16 * (base[:, 1] + _HALF_Y) - 0.035 * (base[:, 2] - _FLOOR)
    kept = np.argsort(noise(base * [1, 1, 0.5] + 43, 0.9) - 0.55 * reach)[:k]
    base, out = base[kept], out[kept]
    hang = unit(0.8 * rng.standard_normal((k, 3)) - 0.8 * UP + 0.5 * out)
    part, _, s = strips(
        base + 0.05 * rng.random((k, 1)) * out,
        hang,
        unit(out + 0.5 * rng.standard_normal((k, 3))),
        rng.uniform(0.06, 0.13, k),
        rng.uniform(0.03, 0.05, k),
        rng.uniform(0, 0.3, k),
        rows,
        columns,
        leaf_outline,
        rng,
    )
    shade = np.repeat(rng.random(k), rows * columns)
    part.albedo = (
        mix([0.020, 0.065, 0.012], [0.10, 0.19, 0.03], shade) * (1.25 - 0.5 * np.abs(s))[:, None]
    )
    part.translucency[:] = 0.4
    part.gloss[:] = 0.25
    return part
