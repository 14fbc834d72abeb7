"""From where a tab looks: what a browser knows of its camera, and the pinhole camera that it makes."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from v3dg.cameras import Camera, Floats, VectorLike
from v3dg.rotations import rotation_from_quaternion


@dataclass(frozen=True)
class View:
    """A camera without a size in pixels.

    Attributes:
        wxyz: Rotation from camera (x right, y down, z forward) to world, a quaternion of any length but zero.
        position: The eye, world units.
        fov_y: Vertical field of view in radians.
        aspect: Width over height.
    """

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov_y: float
    aspect: float

    @classmethod
    def of_camera(cls, camera: Camera) -> View:
        """Take over pose and field of view; a principal point off the middle is lost."""
        half_x, half_y = camera.width / 2 / camera.fx, camera.height / 2 / camera.fy
        wxyz = quaternion_from_rotation(camera.viewmat[:3, :3].T)
        return cls(wxyz, tuple(camera.position.tolist()), 2 * math.atan(half_y), half_x / half_y)

    def camera(self, width: int, height: int, near: float) -> Camera:
        """Return the camera whose picture of that size fills the view; its pixels need not be square."""
        quaternion = np.asarray(self.wxyz, np.float64)
        rotation = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion)).T
        viewmat = np.eye(4)
        viewmat[:3, :3] = rotation
        viewmat[:3, 3] = -rotation @ np.asarray(self.position, np.float64)
        half_y = math.tan(self.fov_y / 2)
        fx, fy = width / 2 / (half_y * self.aspect), height / 2 / half_y
        K = np.array([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])
        return Camera(viewmat, K, width, height, near)


def quaternion_from_rotation(rotation: Floats) -> tuple[float, float, float, float]:
    """Unit quaternion w x y z with w >= 0 of a (3, 3) rotation."""
    # The eigenvector of Bar-Itzhack's symmetric matrix: no case distinctions, stable for any angle.
    r = np.asarray(rotation, np.float64)
    symmetric = np.full((4, 4), np.trace(r))
    symmetric[1:, 0] = r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]
    symmetric[1:, 1:] = r + r.T - np.trace(r) * np.eye(3)
    w, x, y, z = np.linalg.eigh(symmetric, UPLO="L")[1][:, -1].tolist()
    return (-w, -x, -y, -z) if w < 0 else (w, x, y, z)


def look_at(eye: VectorLike, target: VectorLike, up: VectorLike, fov_y: float, aspect: float) -> View:
    """Return the view at ``eye`` with ``target`` in the middle and ``up`` upwards."""
    of_camera = View.of_camera(Camera.look_at(eye, target, up, width=1, height=1))
    return replace(of_camera, fov_y=fov_y, aspect=aspect)
