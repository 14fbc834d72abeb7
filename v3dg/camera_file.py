"""Camera files: the `transforms.json` of nerfstudio, instant-ngp and NeRF's synthetic
scenes.

It also reads folders with cameras: runs of nerfstudio, and models of COLMAP, with
COLMAP's own library.
"""

import os
import re
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np

from v3dg import _extras
from v3dg._json import Node, read_json, write_json
from v3dg._numbers import check, one_of, refuse
from v3dg.cameras import (
    Camera,
    Floats,
    check_cameras,
    intrinsics,
    is_rotation,
    viewmat_from_blender,
)

# COLMAP's camera models that are pinholes apart from distortion, which is checked
# separately.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_UNDISTORT = (
    "undistort the pictures first, or leave it out: distortion='ignore', or --distortion ignore"
)
_RUN = "config.yml"  # identifies a run of nerfstudio
_MODEL = ("images.bin", "images.txt")  # identify a model of COLMAP
_DATA = re.compile(
    r"^\s*data: (?:&\w+ )?!!python/object/apply:pathlib\.\w+\n((?:\s*- .*\n)+)", re.MULTILINE
)
# Rotation from a camera with x right, y up, z backward to one with x right, y down, z
# forward.
_FLIP = np.diag([1.0, -1.0, -1.0])


def read_cameras(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    distortion: Literal["refuse", "ignore"] = "refuse",
    applied_transform: Literal["keep", "undo"] = "keep",
) -> dict[str, Camera]:
    """Read the cameras of a nerfstudio `transforms.json`, in file order
    (docs/scene.md).

    ``path`` may also be a folder: a model of COLMAP, binary or text, whose cameras are
    named after their images, with the extra `colmap`; or a run of nerfstudio (also by
    its `config.yml`), whose cameras are in the frame of the training.

    A camera is named by its `file_path`; if any is missing or repeats, all are named by
    their number, from 0. Pictures, depths, masks and point clouds that the file names
    are not read.

    Args:
        size: Width and height in px for a file that has neither `w` and `h` nor focal
            lengths in px.
        distortion: Whether lens distortion is an error, or left out: cameras are
            pinholes.
        applied_transform: Whether cameras stay in the frame of the file, or
            `applied_transform` and `applied_scale` are undone, for assets in the frame
            that the data had before.

    Raises:
        ValueError: The content is not valid, or has cameras that are not pinholes; the
            message names the place in it.
        OSError: The file cannot be read.
    """
    one_of(distortion, "distortion", ("refuse", "ignore"))
    one_of(applied_transform, "applied_transform", ("keep", "undo"))
    folder = Path(path)
    if folder.name in (_RUN, *_MODEL):
        folder = folder.parent
    is_run = (folder / _RUN).is_file()
    if not is_run and folder.is_dir():
        return _read_colmap(folder, distortion)
    if is_run:
        path = _data_of(folder)
    top = read_json(path).some_fields(("frames",))
    transforms = []
    if is_run or applied_transform == "undo":
        transforms.append(_applied(top))
    if is_run:
        transforms.append(_trained(folder))
    names = []
    cameras = []
    for node in top["frames"].items():
        frame = node.some_fields(("transform_matrix",))
        cameras.append(_read_frame(node, frame, top, transforms, size, distortion))
        name = ""
        if "file_path" in frame:
            name = frame["file_path"].text()
        names.append(name)
    if "" in names or len(set(names)) < len(names):
        names = [str(i) for i in range(len(cameras))]
    return dict(zip(names, cameras, strict=True))


def _read_frame(
    node: Node,
    frame: Mapping[str, Node],
    top: Mapping[str, Node],
    transforms: list[tuple[Floats, float]],
    size: tuple[int, int] | None,
    distortion: str,
) -> Camera:
    """The camera of a frame; fields that it lacks are those at the top of the file."""
    fields = {**top, **frame}
    _check_is_pinhole(fields, distortion)
    focal = top
    if "fl_x" in frame or "camera_angle_x" in frame:
        focal = frame
    K, width, height = _intrinsics(node, fields, focal, size)
    near = 0.01
    if "near" in fields:
        near = fields["near"].positive()
    viewmat = node.attempt(partial(viewmat_from_blender, _rows(fields["transform_matrix"])))
    for transform, scale in transforms:  # each leads back to the world before it was applied
        # Camera refuses values that are not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            viewmat = viewmat @ (np.diag([scale, scale, scale, 1.0]) @ transform)
            viewmat[:3] /= scale  # the camera keeps a scale of 1
    return node.attempt(partial(Camera, viewmat, K, width, height, near))


def _data_of(run: Path) -> Path:
    """The `transforms.json` of the data that a nerfstudio run was trained on."""
    # YAML with Python objects, of which only a path is read.
    text = (run / _RUN).read_text(encoding="utf-8", errors="replace")
    files = []
    for entry in _DATA.findall(text):
        parts = re.findall(r"^\s*- (.*)$", entry, re.MULTILINE)
        data = Path(*(part.strip("'\"") for part in parts))
        for folder in (Path(), *list(run.resolve().parents)[:4]):
            file = folder / data
            if file.suffix != ".json":
                file = file / "transforms.json"
            files.append(file)
    existing = next((file for file in files if file.is_file()), None)
    if existing is None:
        tried = (
            " or ".join(map(str, dict.fromkeys(files))) or "a path under data:, which it has not"
        )
        refuse(run / _RUN, f"the run's data at {tried}, got none; put it there")
    return existing


def _trained(run: Path) -> tuple[Floats, float]:
    """The transform from the frame of a run's training to that of its data, as
    `_applied` returns it."""
    top = read_json(run / "dataparser_transforms.json").some_fields(("transform", "scale"))
    matrix = _rows(top["transform"])
    scale = top["scale"].positive()
    if not is_rotation(matrix[:3, :3]):
        raise top["transform"].error("a rotation and a translation")
    inverse = np.linalg.inv(matrix)
    inverse[:3, 3] *= scale
    return np.asarray(inverse, np.float64), 1 / scale


def _read_colmap(folder: Path, distortion: str) -> dict[str, Camera]:
    places = [folder / part for part in ("", "sparse/0", "sparse", "0")]
    models = [place for place in places for name in _MODEL if (place / name).is_file()]
    expected = "a model of COLMAP (images.bin or images.txt) or a run of nerfstudio (config.yml)"
    check(folder, models, f"{expected}, got a folder without")
    pycolmap = _extras.load("pycolmap")
    try:
        model = pycolmap.Reconstruction(os.fspath(models[0]))
    except (RuntimeError, ValueError, IndexError) as error:
        raise ValueError(
            f"{models[0]}: expected a model of COLMAP, got {str(error)[:200]!a}"
        ) from None
    cameras = {}
    for _, image in sorted(model.images.items()):
        camera = model.cameras[image.camera_id]
        is_right = camera.is_perspective_pinhole() and (
            camera.is_undistorted() or distortion == "ignore"
        )
        expected = "a pinhole without lens distortion"
        check(
            f"{models[0]}: {image.name}",
            is_right,
            f"{expected}, got {camera.model_name}; {_UNDISTORT}",
        )
        K = np.diag([camera.focal_length_x, camera.focal_length_y, 1.0])
        K[0, 2] = camera.principal_point_x
        K[1, 2] = camera.principal_point_y
        viewmat = np.eye(4)
        viewmat[:3] = image.cam_from_world().matrix()
        cameras[image.name] = Camera(viewmat, K, camera.width, camera.height)
    return cameras


def write_cameras(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write named cameras as a nerfstudio `transforms.json`; `read_cameras` gives the
    same cameras."""
    check_cameras(cameras)
    frames = []
    for name, camera in cameras.items():
        to_world = np.eye(4)
        to_world[:3, :3] = camera.viewmat[:3, :3].T @ _FLIP
        to_world[:3, 3] = camera.position
        frame = {
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
        frames.append(frame)
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})


def _check_is_pinhole(fields: Mapping[str, Node], distortion: str) -> None:
    model = fields.get("camera_model")
    if model is not None and model.value not in _PINHOLES:
        raise model.error(
            f"a pinhole camera ({', '.join(_PINHOLES)})", "undistort the pictures first"
        )
    fisheye = fields.get("is_fisheye")
    if fisheye is not None and fisheye.value not in (False, 0):
        raise fisheye.error("a pinhole camera", "undistort the pictures first")
    if distortion == "ignore":
        return
    for name in _DISTORTION:
        if name in fields and fields[name].number() != 0:
            raise fields[name].error("no lens distortion", _UNDISTORT)


def _rows(node: Node) -> Floats:
    """A matrix of 3 or 4 rows as (4, 4); a fourth row is ignored, as by other
    readers."""
    num_rows = 4
    if isinstance(node.value, list) and len(node.value) == 3:
        num_rows = 3
    matrix = np.eye(4)
    matrix[:3] = node.matrix(num_rows, 4)[:3]
    return matrix


def _applied(top: Mapping[str, Node]) -> tuple[Floats, float]:
    """The (4, 4) rotation and translation, then the scale, that were applied to the
    file's positions."""
    transform: Floats = np.eye(4)
    if "applied_transform" in top:
        transform = _rows(top["applied_transform"])
    scale = 1.0
    if "applied_scale" in top:
        scale = top["applied_scale"].positive()
    if not is_rotation(transform[:3, :3]):
        raise top["applied_transform"].error("a rotation and a translation")
    return transform, scale


def _intrinsics(
    frame: Node, fields: Mapping[str, Node], focal: Mapping[str, Node], size: tuple[int, int] | None
) -> tuple[Floats, int, int]:
    """K, width and height."""
    if "w" in fields and "h" in fields:
        width = fields["w"].size()
        height = fields["h"].size()
    elif "fl_x" in focal:
        raise frame.problem(
            "expected w and h, in the frame or at the top, got focal lengths in px and no size"
        )
    elif size is None:
        raise frame.problem(
            "expected w and h, in the frame or at the top, got neither; give the size"
        )
    else:
        width, height = size
    if "fl_x" in focal:
        fx = focal["fl_x"].positive()
        fy = fx
        if "fl_y" in focal:
            fy = focal["fl_y"].positive()
        K = np.array([[fx, 0.0, 0.5 * width], [0.0, fy, 0.5 * height], [0.0, 0.0, 1.0]])
    elif "camera_angle_x" in focal:
        fov_x = focal["camera_angle_x"].field_of_view()
        fov_y = None
        if "camera_angle_y" in focal:
            fov_y = focal["camera_angle_y"].field_of_view()
        K = frame.attempt(partial(intrinsics, fov_x, fov_y, width, height))
    else:
        raise frame.problem(
            "expected fl_x or camera_angle_x, in the frame or at the top, got neither"
        )
    for axis, name in enumerate(("cx", "cy")):
        if name in fields:
            K[axis, 2] = fields[name].number()
    return K, width, height
