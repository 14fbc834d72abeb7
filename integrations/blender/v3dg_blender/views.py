"""Converts Blender's views to cameras of v3dg: render cameras and 3D viewports.

Blender's cameras look along -z with y up, v3dg's along z with y down. Blender describes
every lens by a projection matrix, so one function converts all of them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

import v3dg

if TYPE_CHECKING:
    import bpy
    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

# For selection, a distant pinhole replaces an orthographic view. Its distance is this
# many heights of the view, so depths within one height change sizes by at most 1 %.
_FAR = 100.0


def camera_of_projection(
    view_from_world: Floats, projection: Floats, width: int, height: int, near: float
) -> v3dg.Camera:
    """Return the camera of a view of Blender.

    Args:
        view_from_world: (4, 4) world to view; the view looks along -z, y is up. A scale
            in it is ignored, as Blender does.
        projection: (4, 4) of OpenGL, perspective or orthographic.
        width: Width of the picture in px.
        height: Height of the picture in px.
        near: Smallest depth that is drawn, in world units.

    Raises:
        ValueError: A size is not positive, or a matrix is singular.
    """
    rotation, position = _pose(view_from_world)
    if projection[3, 3] == 0:
        # Clip coordinates are divided by the depth -z.
        fx = 0.5 * width * projection[0, 0]
        fy = 0.5 * height * projection[1, 1]
        cx = 0.5 * width * (1 - projection[0, 2])
        cy = 0.5 * height * (1 + projection[1, 2])
    else:
        distance = _FAR * 2 / projection[1, 1]
        # The point at the centre of the view stays at the centre of the picture.
        x = -projection[0, 3] / projection[0, 0]
        y = -projection[1, 3] / projection[1, 1]
        position = position + rotation.T @ np.array([x, y, distance])
        fx = 0.5 * width * projection[0, 0] * distance
        fy = 0.5 * height * projection[1, 1] * distance
        cx = 0.5 * width
        cy = 0.5 * height
        near = 0.01 * distance
    flipped = rotation * np.array([[1.0], [-1.0], [-1.0]])
    viewmat = np.eye(4)
    viewmat[:3, :3] = flipped
    viewmat[:3, 3] = -flipped @ position
    K = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return v3dg.Camera(viewmat, K, width, height, near)


def _pose(view_from_world: Floats) -> tuple[Floats, Floats]:
    """Return the exact rotation (3, 3) nearest to that of a view, and the eye (3,)."""
    world_from_view: Floats = np.linalg.inv(view_from_world).astype(np.float64)
    left, _, right = np.linalg.svd(world_from_view[:3, :3])
    rotation: Floats = (left @ right).T
    return rotation, world_from_view[:3, 3]


def render_camera(
    scene: bpy.types.Scene, camera: bpy.types.Object, depsgraph: bpy.types.Depsgraph
) -> v3dg.Camera:
    """Return the camera with which a scene is rendered.

    Raises:
        ValueError: The camera is panoramic.
    """
    lens = camera.data
    if lens.type not in ("PERSP", "ORTHO"):
        raise ValueError(
            f"{camera.name}: expected a perspective or orthographic camera, got {lens.type}; "
            "choose another lens"
        )
    render = scene.render
    width = max(1, render.resolution_x * render.resolution_percentage // 100)
    height = max(1, render.resolution_y * render.resolution_percentage // 100)
    projection = camera.calc_matrix_camera(
        depsgraph,
        x=width,
        y=height,
        scale_x=render.pixel_aspect_x,
        scale_y=render.pixel_aspect_y,
    )
    world_from_view = np.array(camera.evaluated_get(depsgraph).matrix_world)
    return camera_of_projection(
        np.linalg.inv(world_from_view), np.array(projection), width, height, lens.clip_start
    )


def viewport_camera(
    region: bpy.types.Region, view: bpy.types.RegionView3D, near: float
) -> v3dg.Camera:
    """Return the current camera of a 3D viewport."""
    return camera_of_projection(
        np.array(view.view_matrix),
        np.array(view.window_matrix),
        max(1, region.width),
        max(1, region.height),
        near,
    )
