"""Rotations and quaternions."""

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
    w, x, y, z = quaternions_from_rotations(np.asarray(rotation, np.float64)[None])[0].tolist()
    return w, x, y, z


def quaternions_from_rotations(rotations: Floats) -> Floats:
    """Unit quaternions (I, 4) w x y z with w >= 0 of rotations (I, 3, 3)."""
    # The eigenvector of Bar-Itzhack's symmetric matrix: no case distinctions, stable
    # for any angle.
    trace = np.trace(rotations, axis1=1, axis2=2)
    symmetric = np.broadcast_to(trace[:, None, None], (len(rotations), 4, 4)).copy()
    skew = rotations - rotations.transpose(0, 2, 1)
    symmetric[:, 1:, 0] = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    trace_matrix = trace[:, None, None] * np.eye(3)
    symmetric[:, 1:, 1:] = rotations + rotations.transpose(0, 2, 1) - trace_matrix
    wxyz = np.linalg.eigh(symmetric, UPLO="L")[1][..., -1]
    return np.where(wxyz[:, :1] < 0, -wxyz, wxyz)
