"""The axes of gaussians in memory and in files, and the turns between them.

Axes are named by where x, y and z point, as SPZ's specification names them: R or L
(right, left), U or D (up, down), F or B (forward, back). Memory has those of trainers'
`.ply` files, right, down, forward. Turns that change nothing but signs are exact.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import Floats, one_of
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians
from v3dg.rotations import quaternion_from_rotation

MEMORY = "RDF"
"""The axes of gaussians in memory, with which -y is up."""
MEMORY_UP: Axis = "-y"
OPENGL = "RUB"
"""The axes of `.spz`, and of OpenUSD with y up."""
GLTF = "LUF"
"""The axes of glTF 2.0, whose assets face forward (section 3.4)."""
Z_UP = "RFU"
"""The axes of OpenUSD with z up, and of 3D Tiles."""

# The axes of gaussians of which an axis is up: those that differ least from the axes in
# memory.
_AXES_FROM_UP: dict[Axis, str] = {
    "x": "URF",
    "y": OPENGL,
    "z": Z_UP,
    "-x": "DLF",
    "-y": MEMORY,
    "-z": "RBD",
}
_DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "R": (1.0, 0.0, 0.0),
    "L": (-1.0, 0.0, 0.0),
    "D": (0.0, 1.0, 0.0),
    "U": (0.0, -1.0, 0.0),
    "F": (0.0, 0.0, 1.0),
    "B": (0.0, 0.0, -1.0),
}
# The sign of each harmonic under a change of sign of x, y and z: the coordinates that
# it is odd in.
_ODD = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")

# Limits of a ground: the least share of the points in it; the largest thickness and the
# least width, relative to the extent of the points; the largest share of the points
# below it, and the least share above it.
_GROUND_SHARE = 0.3
_GROUND_THICKNESS = 0.03
_GROUND_WIDTH = 0.7
_MOST_BELOW = 0.02
_LEAST_ABOVE = 0.1
_LEAST_POINTS = 256


def axes_of_up(up: Axis) -> str:
    """Return the axes of gaussians for which this axis is up; ValueError for another
    name."""
    one_of(up, "up", tuple(_AXES_FROM_UP))
    return _AXES_FROM_UP[up]


def up_of_axes(axes: str) -> Axis:
    """The axis that points up."""
    for name, letter in zip("xyz", axes, strict=True):
        if letter == "U":
            return name  # type: ignore[return-value]
        if letter == "D":
            return f"-{name}"  # type: ignore[return-value]
    raise AssertionError(axes)


def turn(source: str, target: str) -> Floats:
    """Return the (3, 3) matrix that takes vectors from one set of axes to another: a
    rotation, or a rotation with a reflection."""
    rows = np.array([_DIRECTIONS[letter] for letter in target])
    columns = np.array([_DIRECTIONS[letter] for letter in source]).T
    return np.asarray(rows @ columns) + 0.0


def turned(gaussians: Gaussians, source: str, target: str) -> Gaussians:
    """Return gaussians on the host, taken from one set of axes to another; arrays that
    do not change are shared."""
    matrix = turn(source, target)
    if np.array_equal(np.abs(matrix), np.eye(3)):
        return _mirrored(gaussians, np.diag(matrix))
    if np.linalg.det(matrix) < 0:
        signs = np.array([-1.0, 1.0, 1.0])
        gaussians = _mirrored(gaussians, signs)
        matrix = matrix * signs
    return gaussians.transform(quaternion_from_rotation(matrix))


def _mirrored(gaussians: Gaussians, signs: Floats) -> Gaussians:
    """Return gaussians with the signs of some coordinates changed, exactly.

    A reflection M takes the rotation R of a gaussian to M R, which stands for the same
    gaussian as the rotation M R M, whose quaternion differs in signs alone.
    """
    if (signs == 1).all():
        return gaussians
    x, y, z = signs.astype(np.float32)
    sign_of_coordinate = {"x": x, "y": y, "z": z}
    num_harmonics = gaussians.sh.shape[1]
    harmonics = np.ones((num_harmonics, 1), np.float32)
    for row, coordinates in enumerate(_ODD[:num_harmonics]):
        for coordinate in coordinates:
            harmonics[row] *= sign_of_coordinate[coordinate]
    mirrored = replace(
        gaussians,
        means=gaussians.means * np.array([x, y, z]),
        quats=gaussians.quats * np.array([1, y * z, x * z, x * y], np.float32),
        sh=gaussians.sh * harmonics,
    )
    return mirrored.trained(antialiased=gaussians.antialiased)


def up_of_ground(points: NDArray[np.floating]) -> Axis | None:
    """Return which of y, -y and z is up, if the points (N, 3) show a ground; None if
    they do not.

    A ground is thin and wide, has many of the points, many of the others above it, and
    next to none below it. It is only sought across y and z.
    """
    finite = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(finite) < _LEAST_POINTS:
        return None
    sides = {"y": _side_above(finite, 1), "z": _side_above(finite, 2)}
    if sides == {"y": 1, "z": 0}:
        return "y"
    if sides == {"y": -1, "z": 0}:
        return "-y"
    if sides == {"y": 0, "z": 1}:
        return "z"
    return None


def _side_above(points: Floats, axis: int) -> int:
    """Return 1 or -1, the side of a ground across an axis on which the points lie; 0
    without a ground."""
    order = np.argsort(points[:, axis])
    heights = points[order, axis]
    size = int(_GROUND_SHARE * len(heights))
    thicknesses = heights[size:] - heights[:-size]
    first = int(thicknesses.argmin())
    thickness = float(thicknesses[first])
    across = np.delete(points[order], axis, axis=1)
    widths = _extents(across)
    ground_widths = _extents(across[first : first + size])
    is_thin = thickness < _GROUND_THICKNESS * widths.min()
    is_wide = (ground_widths > _GROUND_WIDTH * widths).all()
    if not (is_thin and is_wide):
        return 0
    lower_share = float((heights < heights[first] - thickness).mean())
    upper_share = float((heights > heights[first + size] + thickness).mean())
    if lower_share <= _MOST_BELOW and upper_share >= _LEAST_ABOVE:
        return 1
    if upper_share <= _MOST_BELOW and lower_share >= _LEAST_ABOVE:
        return -1
    return 0


def _extents(points: Floats) -> Floats:
    """Return the extent of nearly all points in each coordinate."""
    low, high = np.percentile(points, (5, 95), axis=0)
    return np.asarray(high - low)
