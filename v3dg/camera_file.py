"""Camera files: the `transforms.json` of nerfstudio, instant-ngp and NeRF's synthetic scenes.

And folders with cameras: nerfstudio's runs, and COLMAP's models, with its own library.
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
from v3dg._numbers import check, one_of
from v3dg.cameras import Camera, Floats, check_cameras, intrinsics, is_rotation, viewmat_from_blender

# Names of COLMAP's models that are pinholes but for the distortion, which is looked at by itself.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "SIMPLE_RADIAL", "RADIAL")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_UNDISTORT = "undistort the pictures first, or leave it out: distortion='ignore', or --distortion ignore"
_RUN = "config.yml"  # by which a run of nerfstudio is known
_MODEL = ("images.bin", "images.txt")  # by which a model of COLMAP is
_DATA = re.compile(r"^\s*data: (?:&\w+ )?!!python/object/apply:pathlib\.\w+\n((?:\s*- .*\n)+)", re.MULTILINE)
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

    Or those of a folder: of a model of COLMAP, binary or text, by their images' names, with the extra
    `colmap`; or of a run of nerfstudio (also by its `config.yml`), in the frame that it trained in.

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
    place = Path(path)
    if place.name in (_RUN, *_MODEL):
        place = place.parent
    is_run = (place / _RUN).is_file()
    if is_run:
        path, applied_transform = _data_of(place), "undo"
    elif place.is_dir():
        return _read_colmap(place, distortion)
    top = read_json(path).some_fields(("frames",))
    transforms = [_applied(top)] if applied_transform == "undo" else []
    transforms += [_trained(place)] if is_run else []
    names, cameras = [], []
    for node in top["frames"].items():
        frame = node.some_fields(("transform_matrix",))
        fields = {**top, **frame}
        _check_is_pinhole(fields, distortion)
        focal = frame if "fl_x" in frame or "camera_angle_x" in frame else top
        K, width, height = _intrinsics(node, fields, focal, size)
        near = fields["near"].positive() if "near" in fields else 0.01
        viewmat = node.attempt(partial(viewmat_from_blender, _rows(fields["transform_matrix"])))
        for transform, scale in transforms:  # to the world before them
            with np.errstate(over="ignore", invalid="ignore"):  # the camera refuses what comes of it
                viewmat = viewmat @ (np.diag([scale, scale, scale, 1.0]) @ transform)
                viewmat[:3] /= scale  # the camera's own unit goes along
        cameras.append(node.attempt(partial(Camera, viewmat, K, width, height, near)))
        names.append(frame["file_path"].text() if "file_path" in frame else "")
    if "" in names or len(set(names)) < len(names):
        names = [str(i) for i in range(len(cameras))]
    return dict(zip(names, cameras, strict=True))


def _data_of(run: Path) -> Path:
    """The `transforms.json` of the data that a nerfstudio run was trained on."""
    # YAML with objects of Python in it, of which only a path is looked at.
    text = (run / _RUN).read_text(encoding="utf-8", errors="replace")
    parts = [re.findall(r"^\s*- (.*)$", found, re.MULTILINE) for found in _DATA.findall(text)]
    named = [Path(*(part.strip("'\"") for part in found)) for found in parts]
    folders = [folder / data for data in named for folder in (Path(), *list(run.resolve().parents)[:4])]
    files = [folder if folder.suffix == ".json" else folder / "transforms.json" for folder in folders]
    found = next((file for file in files if file.is_file()), None)
    tried = " or ".join(map(str, dict.fromkeys(files))) or "a path under data:, which it has not"
    check(run / _RUN, found, f"the run's data at {tried}, got none; put it there")
    assert found is not None
    return found


def _trained(run: Path) -> tuple[Floats, float]:
    """What takes a point of the frame that a run trained in to that of its data: as `_applied` has it."""
    top = read_json(run / "dataparser_transforms.json").some_fields(("transform", "scale"))
    matrix, scale = _rows(top["transform"]), top["scale"].positive()
    if not is_rotation(matrix[:3, :3]):
        raise top["transform"].error("a rotation and a translation")
    back = np.linalg.inv(matrix)
    back[:3, 3] *= scale
    return np.asarray(back, np.float64), 1 / scale


def _read_colmap(folder: Path, distortion: str) -> dict[str, Camera]:
    places = [folder / part for part in ("", "sparse/0", "sparse", "0")]
    models = [place for place in places for name in _MODEL if (place / name).is_file()]
    expected = "a model of COLMAP (images.bin or images.txt) or a run of nerfstudio (config.yml)"
    check(folder, models, f"{expected}, got a folder without")
    pycolmap, cameras = _extras.load("pycolmap"), {}
    try:
        model = pycolmap.Reconstruction(os.fspath(models[0]))
    except (RuntimeError, ValueError, IndexError) as error:
        raise ValueError(f"{models[0]}: expected a model of COLMAP, got {str(error)[:200]!a}") from None
    for _, image in sorted(model.images.items()):
        camera = model.cameras[image.camera_id]
        is_right = camera.is_perspective_pinhole() and (camera.is_undistorted() or distortion == "ignore")
        found = f"{camera.model_name}; {_UNDISTORT}"
        check(f"{models[0]}: {image.name}", is_right, f"a pinhole without lens distortion, got {found}")
        K, viewmat = np.diag([camera.focal_length_x, camera.focal_length_y, 1.0]), np.eye(4)
        K[:2, 2] = camera.principal_point_x, camera.principal_point_y
        viewmat[:3] = image.cam_from_world().matrix()
        cameras[image.name] = Camera(viewmat, K, camera.width, camera.height)
    return cameras


def write_cameras(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write named cameras as a nerfstudio `transforms.json`; `read_cameras` gives the same cameras."""
    check_cameras(cameras)
    frames = []
    for name, camera in cameras.items():
        to_world = np.eye(4)
        to_world[:3, :3] = camera.viewmat[:3, :3].T @ _FLIP
        to_world[:3, 3] = camera.position
        size = {"w": camera.width, "h": camera.height}
        lens = {"fl_x": camera.fx, "fl_y": camera.fy, "cx": camera.cx, "cy": camera.cy, "near": camera.near}
        frames.append({"file_path": name, **size, **lens, "transform_matrix": to_world.tolist()})
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
            raise fields[name].error("no lens distortion", _UNDISTORT)


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
