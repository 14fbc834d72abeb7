"""Camera files: the `transforms.json` of nerfstudio, instant-ngp and NeRF's synthetic scenes."""

from __future__ import annotations

import os
from collections.abc import Mapping
from functools import partial
from typing import Literal

import numpy as np

from v3dg._json import Node, read_json, write_json
from v3dg._numbers import one_of
from v3dg.cameras import Camera, Floats, intrinsics, is_rotation, viewmat_from_blender

# Names of COLMAP's models that are pinholes but for the distortion, which is looked at by itself.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
# From a camera with x right, y up, z backward to one with x right, y down, z forward.
_FLIP = np.diag([1.0, -1.0, -1.0])


def read_cameras(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    distortion: Literal["refuse", "ignore"] = "refuse",
    applied_transform: Literal["keep", "undo"] = "keep",
) -> dict[str, Camera]:
    """Read the cameras of a nerfstudio `transforms.json`, in file order (docs/scene.md).

    A camera is named by its `file_path`; where those are missing or repeat, by its place, from 0. Pictures,
    depths, masks and point clouds that the file names are not looked at.

    Args:
        size: Width and height in px for a file that has neither `w` and `h` nor focal lengths in px.
        distortion: Whether lens distortion is an error, or left out: cameras are pinholes.
        applied_transform: Whether cameras stay in the frame of the file, or `applied_transform` and
            `applied_scale` are undone, for assets in the frame that the data had before.

    Raises:
        ValueError: The file is not such a file, or has other cameras than pinholes; names the place in it.
        OSError: The file cannot be read.
    """
    one_of(distortion, "distortion", ("refuse", "ignore"))
    one_of(applied_transform, "applied_transform", ("keep", "undo"))
    root = read_json(path)
    top = root.some_fields(("frames",))
    undo_transform = _applied(top) if applied_transform == "undo" else None
    names, cameras = [], []
    for node in top["frames"].items():
        frame = node.some_fields(("transform_matrix",))
        fields = {**top, **frame}
        _check_is_pinhole(fields, distortion)
        focal = frame if "fl_x" in frame or "camera_angle_x" in frame else top
        K, width, height = _intrinsics(node, fields, focal, size)
        near = fields["near"].positive() if "near" in fields else 0.01
        matrix = _rows(fields["transform_matrix"])
        viewmat = node.attempt(partial(viewmat_from_blender, matrix))
        if undo_transform is not None:
            viewmat = _undone(viewmat, *undo_transform)
        cameras.append(node.attempt(partial(Camera, viewmat, K, width, height, near)))
        names.append(frame["file_path"].text() if "file_path" in frame else "")
    if "" in names or len(set(names)) < len(names):
        names = [str(i) for i in range(len(cameras))]
    return dict(zip(names, cameras, strict=True))


def write_cameras(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write named cameras as a nerfstudio `transforms.json`; `read_cameras` gives the same cameras."""
    frames = []
    for name, camera in cameras.items():
        to_world = np.eye(4)
        to_world[:3, :3] = camera.viewmat[:3, :3].T @ _FLIP
        to_world[:3, 3] = camera.position
        frames.append(
            {
                "file_path": name,
                "w": camera.width,
                "h": camera.height,
                "fl_x": camera.fx,
                "fl_y": camera.fy,
                "cx": camera.cx,
                "cy": camera.cy,
                "near": camera.near,
                "transform_matrix": to_world.tolist(),
            }
        )
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})


def _check_is_pinhole(fields: Mapping[str, Node], distortion: str) -> None:
    model = fields.get("camera_model")
    if model is not None and model.value not in _PINHOLES:
        raise model.error(f"a pinhole camera ({', '.join(_PINHOLES)})", "undistort the pictures first")
    fisheye = fields.get("is_fisheye")
    if fisheye is not None and fisheye.value not in (False, 0):
        raise fisheye.error("a pinhole camera", "undistort the pictures first")
    for name in _DISTORTION if distortion == "refuse" else ():
        if name in fields and fields[name].number() != 0:
            raise fields[name].error("no lens distortion", "undistort the pictures first, or ignore it")


def _rows(node: Node) -> Floats:
    """A matrix of 3 or 4 rows as (4, 4); as elsewhere, a fourth row is not looked at."""
    num_rows = 3 if isinstance(node.value, list) and len(node.value) == 3 else 4
    matrix = np.eye(4)
    matrix[:3] = node.matrix(num_rows, 4)[:3]
    return matrix


def _applied(top: Mapping[str, Node]) -> tuple[Floats, float]:
    """(4, 4) rotation and translation, then the scale, that the file's positions went through."""
    transform = _rows(top["applied_transform"]) if "applied_transform" in top else np.eye(4)
    scale = top["applied_scale"].positive() if "applied_scale" in top else 1.0
    if not is_rotation(transform[:3, :3]):
        raise top["applied_transform"].error("a rotation and a translation")
    return transform, scale


def _undone(viewmat: Floats, transform: Floats, scale: float) -> Floats:
    """World to camera for the world before the transform and the scale."""
    with np.errstate(over="ignore", invalid="ignore"):  # the camera refuses what comes of it
        before = viewmat @ (np.diag([scale, scale, scale, 1.0]) @ transform)
        before[:3] /= scale  # the camera's own unit goes along
    return before


def _intrinsics(
    frame: Node, fields: Mapping[str, Node], focal: Mapping[str, Node], size: tuple[int, int] | None
) -> tuple[Floats, int, int]:
    """K, width and height."""
    if "w" in fields and "h" in fields:
        width, height = fields["w"].size(), fields["h"].size()
    elif size is None or "fl_x" in focal:
        found = "focal lengths in px and no size" if "fl_x" in focal else "neither; give the size"
        raise frame.problem(f"expected w and h, in the frame or at the top, got {found}")
    else:
        width, height = size
    if "fl_x" in focal:
        fx = focal["fl_x"].positive()
        fy = focal["fl_y"].positive() if "fl_y" in focal else fx
        K = np.array([[fx, 0.0, 0.5 * width], [0.0, fy, 0.5 * height], [0.0, 0.0, 1.0]])
    elif "camera_angle_x" in focal:
        fov_x = focal["camera_angle_x"].field_of_view()
        fov_y = focal["camera_angle_y"].field_of_view() if "camera_angle_y" in focal else None
        K = frame.attempt(partial(intrinsics, fov_x, fov_y, width, height))
    else:
        raise frame.problem("expected fl_x or camera_angle_x, in the frame or at the top, got neither")
    for axis, name in enumerate(("cx", "cy")):
        if name in fields:
            K[axis, 2] = fields[name].number()
    return K, width, height
