"""Views are viewpoints without a size in pixels, as browsers use them. This module also
makes the pinhole cameras for pictures of views."""

import math
from dataclasses import dataclass, replace

import numpy as np

from v3dg.cameras import Camera, VectorLike, rigid
from v3dg.rotations import in_range, quaternion_from_rotation, rotation_from_quaternion


@dataclass(frozen=True)
class View:
    """A viewpoint: a camera without a size in pixels.

    Attributes:
        wxyz: Rotation from the camera's axes (x right, y down, z forward) to the world,
            as a quaternion, which need not be normalised.
        position: Position of the camera in world units.
        fov_y: Vertical field of view in radians.
        aspect: Width divided by height.
    """

    wxyz: tuple[float, float, float, float]
    position: tuple[float, float, float]
    fov_y: float
    aspect: float

    @classmethod
    def of_camera(cls, camera: Camera) -> "View":
        """Return the view with the pose and the field of view of a camera. The
        principal point is ignored."""
        half_x = camera.width / 2 / camera.fx
        half_y = camera.height / 2 / camera.fy
        wxyz = quaternion_from_rotation(camera.viewmat[:3, :3].T)
        return cls(wxyz, tuple(camera.position.tolist()), 2 * math.atan(half_y), half_x / half_y)

    def camera(self, width: int, height: int, near: float) -> Camera:
        """Return the camera for a picture of ``width`` x ``height`` px that fills the
        view. Its pixels need not be square."""
        quaternion = in_range(np.asarray(self.wxyz, np.float64))
        rotation = rotation_from_quaternion(quaternion / np.linalg.norm(quaternion)).T
        viewmat = rigid(rotation, np.asarray(self.position, np.float64))
        half_y = math.tan(self.fov_y / 2)
        fx = width / 2 / (half_y * self.aspect)
        fy = height / 2 / half_y
        K = np.array([[fx, 0.0, width / 2], [0.0, fy, height / 2], [0.0, 0.0, 1.0]])
        return Camera(viewmat, K, width, height, near)


def look_at(
    eye: VectorLike, target: VectorLike, up: VectorLike, fov_y: float, aspect: float
) -> View:
    """Return the view from ``eye`` that has ``target`` in the middle and ``up``
    pointing upwards."""
    of_camera = View.of_camera(Camera.look_at(eye, target, up, width=1, height=1))
    return replace(of_camera, fov_y=fov_y, aspect=aspect)
