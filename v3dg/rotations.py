"""Rotations and quaternions."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from v3dg.cameras import Floats

# The squares of components beyond these overflow a double, or lose digits to denormal
# numbers.
_LEAST = 1e-140
_MOST = 1e140


def in_range(quaternions: NDArray[np.floating]) -> Floats:
    """Return quaternions (..., 4) as doubles whose squares neither vanish nor overflow.

    The shortest and the longest are multiplied by a power of two, which rounds nothing.
    Others stay, and so do zero quaternions and those that are not finite.
    """
    scaled = np.array(quaternions, np.float64)
    largest = np.abs(scaled).max(axis=-1)
    is_extreme = ((largest < _LEAST) & (largest > 0)) | ((largest > _MOST) & (largest < np.inf))
    if is_extreme.any():
        exponents = np.frexp(largest[is_extreme])[1]
        scaled[is_extreme] = np.ldexp(scaled[is_extreme], -exponents[..., None])
    return scaled


def normalised(quaternions: NDArray[np.floating]) -> Floats:
    """Return quaternions (..., 4) of length one, in double precision.

    Those of length zero stay, and those that are not finite contain NaN. No length is
    too short or too long.
    """
    unit = in_range(quaternions)
    length = np.linalg.norm(unit, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        np.divide(unit, length, out=unit, where=length != 0)
    return unit


def rotation_from_quaternion(quaternions: Floats) -> Floats:
    """Rotation matrices (I, 3, 3) of unit quaternions (I, 4) w x y z."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def quaternion_from_rotation(rotation: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion w x y z with w >= 0 of a (3, 3) rotation."""
    # The eigenvector of Bar-Itzhack's symmetric matrix: no case distinctions, stable
    # for any angle.
    r = np.asarray(rotation, np.float64)
    symmetric = np.full((4, 4), np.trace(r))
    symmetric[1:, 0] = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    symmetric[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    w, x, y, z = np.linalg.eigh(symmetric, UPLO="L")[1][:, -1].tolist()
    if w < 0:
        return -w, -x, -y, -z
    return w, x, y, z


def quaternion_from_angles(degrees: Sequence[float]) -> tuple[float, float, float, float]:
    """Unit quaternion w x y z of turns about the fixed axes x, then y, then z; angles
    (3,) in degrees."""
    x, y, z = np.radians(np.asarray(degrees, np.float64)) / 2
    cos_x, cos_y, cos_z = np.cos([x, y, z]).tolist()
    sin_x, sin_y, sin_z = np.sin([x, y, z]).tolist()
    return (
        cos_x * cos_y * cos_z + sin_x * sin_y * sin_z,
        sin_x * cos_y * cos_z - cos_x * sin_y * sin_z,
        cos_x * sin_y * cos_z + sin_x * cos_y * sin_z,
        cos_x * cos_y * sin_z - sin_x * sin_y * cos_z,
    )
