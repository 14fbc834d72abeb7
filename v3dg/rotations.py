"""Rotations and quaternions."""

import numpy as np

from v3dg.cameras import Floats


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
    # The eigenvector of Bar-Itzhack's symmetric matrix: no case distinctions, stable for any angle.
    r = np.asarray(rotation, np.float64)
    symmetric = np.full((4, 4), np.trace(r))
    symmetric[1:, 0] = [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]
    symmetric[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    w, x, y, z = np.linalg.eigh(symmetric, UPLO="L")[1][:, -1].tolist()
    if w < 0:
        return -w, -x, -y, -z
    return w, x, y, z
