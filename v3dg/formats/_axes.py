"""The axes of gaussians in memory and in files, and the conversions between them.

Axes are named by the directions of x, y and z, as in the specification of SPZ: R or L
(right, left), U or D (up, down), F or B (forward, back). In memory, they are right,
down, forward, as in the `.ply` files of trainers. Conversions that only change signs
are exact.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import Floats, one_of
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians
from v3dg.rotations import quaternion_from_rotation

MEMORY = "RDF"
"""The axes of gaussians in memory, where -y points up."""
MEMORY_UP: Axis = "-y"
OPENGL = "RUB"
"""The axes of `.spz`, and of OpenUSD with y up."""
GLTF = "LUF"
"""The axes of glTF 2.0, whose assets face forward (section 3.4)."""
Z_UP = "RFU"
"""The axes of OpenUSD with z up, and of 3D Tiles."""

# For each axis that can point up, the complete axes that differ as little as possible
# from those in memory.
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
# The coordinates in which each spherical harmonic is odd. If the sign of such a
# coordinate changes, the sign of the harmonic changes, too.
_ODD = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")

# Limits for detecting a ground: its minimum fraction of the points, its maximum
# thickness and minimum width relative to the extent of all points, the maximum fraction
# of points below it, and the minimum fraction of points above it.
_GROUND_SHARE = 0.3
_GROUND_THICKNESS = 0.03
_GROUND_WIDTH = 0.7
_MOST_BELOW = 0.02
_LEAST_ABOVE = 0.1
_LEAST_POINTS = 256


def axes_of_up(up: Axis) -> str:
    """Return the axes of gaussians for which this axis points up. Raise ValueError for
    an invalid name."""
    one_of(up, "up", tuple(_AXES_FROM_UP))
    return _AXES_FROM_UP[up]


def up_of_axes(axes: str) -> Axis:
    """Return the axis that points up."""
    for name, letter in zip("xyz", axes, strict=True):
        if letter == "U":
            return name  # type: ignore[return-value]
        if letter == "D":
            return f"-{name}"  # type: ignore[return-value]
    raise AssertionError(axes)


def turn(source: str, target: str) -> Floats:
    """Return the (3, 3) matrix that converts vectors between two sets of axes. It is a
    rotation, possibly with a reflection."""
    rows = np.array([_DIRECTIONS[letter] for letter in target])
    columns = np.array([_DIRECTIONS[letter] for letter in source]).T
    return np.asarray(rows @ columns) + 0.0


def turned(gaussians: Gaussians, source: str, target: str) -> Gaussians:
    """Return gaussians on the host, converted between two sets of axes. Arrays that do
    not change are shared."""
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

    A reflection M turns the rotation R of a gaussian into M R. The rotation M R M gives
    the same gaussian, and its quaternion differs from that of R only in signs.
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
    """Return which of y, -y and z points up if the points (N, 3) show a ground, and
    otherwise None.

    A ground is thin and wide and contains many of the points. Many other points are
    above it, and hardly any below it. Only grounds perpendicular to y or z are
    detected.
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
    """Return on which side of a ground the points lie along an axis: 1 for larger
    coordinates, -1 for smaller ones, or 0 if no ground is perpendicular to the axis."""
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
