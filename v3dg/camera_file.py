"""Reads and writes camera files: `transforms.json` of nerfstudio, instant-ngp and
NeRF's synthetic scenes, `cameras.json` of the code of the 3DGS paper, camera paths of
nerfstudio's viewer, and models of COLMAP. Also reads folders with such a file, and runs
of nerfstudio."""

import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np

from v3dg import _files
from v3dg._colmap import IMAGE_FILES, LENS_FILES, Image, read_model
from v3dg._json import Node, read_json, write_json
from v3dg._numbers import check, one_of, refuse
from v3dg.cameras import (
    FISHEYE_TERMS,
    OPENCV_TERMS,
    Camera,
    Floats,
    LensModel,
    by_term,
    check_cameras,
    intrinsics,
    is_rotation,
    rigid,
    viewmat_from_blender,
)

# COLMAP's names of cameras that OpenCV's models can describe.
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "FULL_OPENCV", "SIMPLE_RADIAL", "RADIAL")
_FISHEYES = ("OPENCV_FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE")
# The coefficients of a pinhole camera in a file of nerfstudio, unless it is a
# FULL_OPENCV. In such a file, k4 is the factor of r⁸, which OpenCV does not have.
_PINHOLE_TERMS = ("k1", "k2", "p1", "p2", "k3")
_MOST_NAMED = 8  # number of images that a warning lists
_RUN = "config.yml"  # a folder with this file is a run of nerfstudio
# The file with the transform from the data of a run to its training.
_TRAINING = "dataparser_transforms.json"
_FRAMES = ("transforms.json", "transforms_train.json")
_DATA = re.compile(
    r"^\s*data: (?:&\w+ )?!!python/object/apply:pathlib\.\w+\n((?:\s*- .*\n)+)", re.MULTILINE
)
# Rotation from camera axes x right, y up, z backward to x right, y down, z forward.
_FLIP = np.diag([1.0, -1.0, -1.0])


class CameraWarning(UserWarning):
    """Emitted when cameras of a file are skipped because their numbers are not
    finite."""


def read_cameras(
    path: str | os.PathLike[str],
    *,
    size: tuple[int, int] | None = None,
    distortion: Literal["draw", "ignore"] = "draw",
    applied_transform: Literal["keep", "undo"] = "keep",
) -> dict[str, Camera]:
    """Read the cameras of a nerfstudio `transforms.json`, in file order
    (docs/scene.md).

    Instead of that file, ``path`` may be

    - the `cameras.json` that the code of the 3DGS paper writes;
    - a `camera_path.json` of nerfstudio's viewer, whose frames are named by their
      number unless they have a `file_path`;
    - a folder with one of these files. If it has `dataparser_transforms.json` next to
      `transforms.json`, cameras are in the frame of that training;
    - the folder or the `images` file of a COLMAP model, binary or text, whose cameras
      are named after their images;
    - the folder of a run of nerfstudio, or its `config.yml`, whose cameras are in the
      frame of the training.

    A camera is named by its `file_path`, its image, or `img_name`. If a name is missing
    or occurs twice, all cameras are named by their number, from 0. Pictures, depths,
    masks and point clouds that the file refers to are not read. Images of a COLMAP
    model whose pose or lens is not finite are skipped with a `CameraWarning`.

    Args:
        size: Width and height in px for a file that has neither `w` and `h` nor focal
            lengths in px.
        distortion: "draw" returns cameras with the lens distortion of the file;
            "ignore" returns pinhole cameras without it, and raises an error for a
            fisheye.
        applied_transform: "keep" leaves cameras in the frame of the file. "undo"
            inverts the file's `applied_transform` and `applied_scale`, for assets in
            the original frame of the data.

    Raises:
        ValueError: The content is invalid, or it has cameras of a model that `Camera`
            does not support; the message names the place in the file.
        OSError: The file cannot be read.
    """
    one_of(distortion, "distortion", ("draw", "ignore"))
    one_of(applied_transform, "applied_transform", ("keep", "undo"))
    place = _place_of(Path(path))
    if place.file.name in IMAGE_FILES:
        return _read_colmap(place.file, distortion)
    document = read_json(place.file)
    if isinstance(document.value, list) and document.value:
        return _named(map(_read_3dgs, document.items()))
    if document.has("camera_path") and document.field("camera_path").value != []:
        return _named(_read_path(document, size))
    top = _frames_at_top(document)
    transforms = []
    if place.training is not None or applied_transform == "undo":
        transforms.append(_applied(top))
    if place.training is not None:
        transforms.append(_trained(place.training))
    named = []
    for node in top["frames"].items():
        frame = node.some_fields(("transform_matrix",))
        camera = _read_frame(node, frame, top, transforms, size, distortion)
        name = ""
        if "file_path" in frame:
            name = frame["file_path"].text()
        named.append((name, camera))
    return _named(named)


class _Place(NamedTuple):
    """The file with the cameras, and the file with the transform to the frame of a
    training. The latter is None if cameras stay in the frame of their file."""

    file: Path
    training: Path | None = None


def _place_of(path: Path) -> _Place:
    """Return the camera file for a file, a folder or a run of nerfstudio."""
    folder = path
    if path.name == _RUN:
        folder = path.parent
    if (folder / _RUN).is_file():
        return _Place(_data_of(folder), folder / _TRAINING)
    if path.name in LENS_FILES:
        return _Place(path.with_name(f"images{path.suffix}"))
    if not path.is_dir():
        return _Place(path)
    file = _file_in(path)
    training = path / _TRAINING
    if file.name in _FRAMES and training.is_file():
        return _Place(file, training)
    return _Place(file)


def _named(pairs: Iterable[tuple[str, Camera]]) -> dict[str, Camera]:
    """Return cameras by name. If a name is empty or occurs twice, all cameras are named
    by their number, so that no camera replaces another."""
    names = []
    cameras = []
    for name, camera in pairs:
        names.append(name)
        cameras.append(camera)
    if "" in names or len(set(names)) < len(names):
        names = [str(i) for i in range(len(cameras))]
    return dict(zip(names, cameras, strict=True))


def _file_in(folder: Path) -> Path:
    """Return the camera file in a folder: the `images` file of a COLMAP model, or a
    JSON file."""
    places = [folder / part for part in ("", "sparse/0", "sparse", "0")]
    files = [place / name for place in places for name in IMAGE_FILES]
    files += [folder / name for name in (*_FRAMES, "cameras.json", "camera_path.json")]
    existing = [file for file in files if file.is_file()]
    expected = (
        "a model of COLMAP (images.bin or images.txt), a run of nerfstudio (config.yml), "
        "transforms.json, cameras.json or camera_path.json"
    )
    check(folder, existing, f"{expected}, got a folder with none of them")
    return existing[0]


def _frames_at_top(document: Node) -> dict[str, Node]:
    """Return the fields of a file with frames. Raise a ValueError that describes any
    other file."""
    if document.has("keyframes") or document.has("camera_path"):
        advice = "save the path in nerfstudio's viewer, which then writes its frames, too"
        raise document.problem(f"expected frames in camera_path, got none; {advice}")
    if document.has("transform") and document.has("scale"):
        advice = "give the folder of the run, or put this file beside transforms.json"
        raise document.problem(f"expected cameras, got the transform of a run's training; {advice}")
    return document.some_fields(("frames",))


def _read_3dgs(node: Node) -> tuple[str, Camera]:
    """Return a camera of the `cameras.json` that the code of the 3DGS paper writes.
    Rotation and position are from camera to world; x is right, y down, z forward."""
    if node.has("transform"):
        raise node.problem(
            "expected position, rotation, fx and fy, got only a pose, as written by ns-export "
            "cameras; give the folder of the run"
        )
    required = ("position", "rotation", "fx", "fy", "width", "height")
    fields = node.some_fields(required)
    rotation = np.array(fields["rotation"].matrix(3, 3))
    viewmat = rigid(rotation.T, np.array(fields["position"].vector(3)))
    width = fields["width"].size()
    height = fields["height"].size()
    K = np.diag([fields["fx"].positive(), fields["fy"].positive(), 1.0])
    K[0, 2] = 0.5 * width
    K[1, 2] = 0.5 * height
    name = ""
    if "img_name" in fields and fields["img_name"].value != "":
        name = fields["img_name"].text()
    return name, node.attempt(partial(Camera, viewmat, K, width, height))


def _read_path(document: Node, size: tuple[int, int] | None) -> Iterator[tuple[str, Camera]]:
    """Yield the frames of a camera path of nerfstudio's viewer, named by `file_path` or
    else by their number. Matrices are from camera to world, with x right, y up, z
    backward. `fov` is the vertical field of view in degrees; pixels are square."""
    for key in ("camera_type", "camera_model"):
        if document.has(key) and document.field(key).text() != "perspective":
            raise document.field(key).error('"perspective"')
    if document.has("render_width") and document.has("render_height"):
        width = document.field("render_width").size()
        height = document.field("render_height").size()
    elif size is None:
        raise document.problem(
            "expected render_width and render_height, got neither; pass the size of the pictures"
        )
    else:
        width, height = size
    for number, node in enumerate(document.field("camera_path").items()):
        fov_degrees = node.field("fov").number("degrees between 0 and 180", 0, 180)
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov_degrees))
        K = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]])
        pose = _flat_or_rows(node.field("camera_to_world"))
        viewmat = node.attempt(partial(viewmat_from_blender, pose))
        name = str(number)
        if node.has("file_path"):
            name = node.field("file_path").text()
        yield name, node.attempt(partial(Camera, viewmat, K, width, height))


def _flat_or_rows(node: Node) -> Floats:
    """Return a (4, 4) matrix that the file stores as 16 numbers, row by row, or as four
    rows."""
    if isinstance(node.value, list) and len(node.value) == 16:
        matrix = np.array(node.vector(16)).reshape(4, 4)
        matrix[3] = (0, 0, 0, 1)
        return matrix
    return _rows(node)


def _read_frame(
    node: Node,
    frame: Mapping[str, Node],
    top: Mapping[str, Node],
    transforms: list[tuple[Floats, float]],
    size: tuple[int, int] | None,
    distortion: str,
) -> Camera:
    """Return the camera of a frame. If the frame lacks a field, it is taken from the
    top of the file."""
    fields = {**top, **frame}
    lens_model, coefficients = _lens(fields, distortion)
    focal = top
    if "fl_x" in frame or "camera_angle_x" in frame:
        focal = frame
    K, width, height = _intrinsics(node, fields, focal, size)
    near = 0.01
    if "near" in fields:
        near = fields["near"].positive()
    viewmat = node.attempt(partial(viewmat_from_blender, _rows(fields["transform_matrix"])))
    # Multiplying by a transform gives the camera in the world before that transform.
    for transform, scale in transforms:
        # Camera rejects values that are not finite.
        with np.errstate(over="ignore", invalid="ignore"):
            viewmat = viewmat @ (np.diag([scale, scale, scale, 1.0]) @ transform)
            viewmat[:3] /= scale  # the rotation of a camera must not include a scale
    return node.attempt(partial(Camera, viewmat, K, width, height, near, coefficients, lens_model))


def _data_of(run: Path) -> Path:
    """Return the `transforms.json` of the data that a run of nerfstudio was trained
    on."""
    # The YAML contains Python objects, so only the path is extracted.
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
            " or ".join(map(str, dict.fromkeys(files))) or "a path under data:, which is missing"
        )
        refuse(run / _RUN, f"the data of the run at {tried}, got no file there; put it there")
    return existing


def _trained(file: Path) -> tuple[Floats, float]:
    """Return the transform from the frame of a run's training to the frame of its data,
    in the form that `_applied` returns."""
    top = read_json(file).some_fields(("transform", "scale"))
    matrix = _rows(top["transform"])
    scale = top["scale"].positive()
    if not is_rotation(matrix[:3, :3]):
        raise top["transform"].error("a rotation and a translation")
    inverse = np.linalg.inv(matrix)
    inverse[:3, 3] *= scale
    return np.asarray(inverse, np.float64), 1 / scale


def _read_colmap(images: Path, distortion: str) -> dict[str, Camera]:
    model = read_model(images)
    finite = [image for image in model if image.is_finite]
    if len(finite) < len(model):
        names = [image.name for image in model if not image.is_finite]
        text = f"{len(names)} of {len(model)} images have cameras whose numbers are not finite"
        check(images, finite, f"at least one image with finite numbers, got none: {text}")
        shown_names = ", ".join(names[:_MOST_NAMED])
        if len(names) > _MOST_NAMED:
            shown_names += f" and {len(names) - _MOST_NAMED} more"
        text += f" and are skipped: {shown_names}"
        warnings.warn(f"{images}: {text}", CameraWarning, stacklevel=3)
    named = []
    for image in finite:
        named.append((image.name, _camera_of(image, f"{images}: {image.name}", distortion)))
    return _named(named)


def _camera_of(image: Image, place: str, distortion: str) -> Camera:
    """Return the camera of an image of a COLMAP model."""
    lens = image.lens
    model: LensModel = "PINHOLE"
    coefficients: tuple[float, ...] = ()
    if distortion == "ignore":
        is_pinhole = lens.model.projection == "pinhole"
        expected = "a pinhole apart from lens distortion"
        check(place, is_pinhole, f"{expected}, got {lens.model.name}; draw its distortion")
    elif lens.opencv is None:
        refuse(
            place,
            f"a lens of one of OpenCV's models, got {lens.model.name}; undistort the pictures",
        )
    else:
        model, coefficients = lens.opencv
    K = np.diag([lens.focal_lengths[0], lens.focal_lengths[-1], 1.0])
    K[:2, 2] = lens.center
    with _files.value_errors(place, "a camera"):
        return Camera(
            image.viewmat, K, lens.width, lens.height, distortion=coefficients, model=model
        )


def write_cameras(path: str | os.PathLike[str], cameras: Mapping[str, Camera]) -> None:
    """Write named cameras as a nerfstudio `transforms.json`. `read_cameras` then
    returns the same cameras."""
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
            **_lens_as_json(camera),
        }
        frames.append(frame)
    write_json(path, {"camera_model": "PINHOLE", "frames": frames})


def _lens_as_json(camera: Camera) -> dict[str, object]:
    """Return the fields of nerfstudio for the lens of a camera."""
    if not camera.is_distorted:
        return {}
    if camera.model == "OPENCV_FISHEYE":
        return {"camera_model": camera.model, **by_term(FISHEYE_TERMS, camera.distortion)}
    coefficients = by_term(OPENCV_TERMS, camera.distortion)
    if any(coefficients[term] for term in ("k4", "k5", "k6")):
        return {"camera_model": "FULL_OPENCV", **coefficients}
    return {"camera_model": "OPENCV", **{term: coefficients[term] for term in _PINHOLE_TERMS}}


def _lens(fields: Mapping[str, Node], distortion: str) -> tuple[LensModel, tuple[float, ...]]:
    """Return the camera model and the distortion in a file of nerfstudio."""
    if _is_fisheye(fields, distortion):
        return "OPENCV_FISHEYE", tuple(_term(fields, name) for name in FISHEYE_TERMS)
    model = fields.get("camera_model")
    terms: tuple[str, ...] = _PINHOLE_TERMS
    if model is not None and model.value == "FULL_OPENCV":
        terms = OPENCV_TERMS
    coefficients = tuple(_term(fields, name) for name in terms)
    if distortion == "ignore":
        return "PINHOLE", ()
    for name in ("k4", "k5", "k6"):
        if name not in terms and _term(fields, name) != 0:
            raise fields[name].error(
                "0 unless the camera is a fisheye or a FULL_OPENCV",
                "ignore the distortion: distortion='ignore'",
            )
    if any(coefficients):
        return "OPENCV", coefficients
    return "PINHOLE", ()


def _is_fisheye(fields: Mapping[str, Node], distortion: str) -> bool:
    model = fields.get("camera_model")
    if model is not None and model.value not in (*_PINHOLES, *_FISHEYES):
        names = ", ".join((*_PINHOLES, *_FISHEYES))
        raise model.error(f"a camera model of OpenCV ({names})", "undistort the pictures first")
    signs = []
    if model is not None and model.value in _FISHEYES:
        signs.append(model)
    flag = fields.get("is_fisheye")
    if flag is not None and flag.value not in (False, 0):
        signs.append(flag)
    if signs and distortion == "ignore":
        raise signs[0].error("a pinhole camera", "draw the distortion of a fisheye")
    return bool(signs)


def _term(fields: Mapping[str, Node], name: str) -> float:
    if name not in fields:
        return 0.0
    return fields[name].number()


def _rows(node: Node) -> Floats:
    """Return a (4, 4) matrix that the file stores as 3 or 4 rows. As in other readers,
    a fourth row is ignored."""
    num_rows = 4
    if isinstance(node.value, list) and len(node.value) == 3:
        num_rows = 3
    matrix = np.eye(4)
    matrix[:3] = node.matrix(num_rows, 4)[:3]
    return matrix


def _applied(top: Mapping[str, Node]) -> tuple[Floats, float]:
    """Return the transform that was applied to the file's positions: a (4, 4) rotation
    and translation, followed by a scale."""
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
    """Return K, the width and the height."""
    if "w" in fields and "h" in fields:
        width = fields["w"].size()
        height = fields["h"].size()
    elif "fl_x" in focal:
        raise frame.problem(
            "expected w and h, in the frame or at the top, got focal lengths in px without a size"
        )
    elif size is None:
        raise frame.problem(
            "expected w and h, in the frame or at the top, got neither; pass the size of the "
            "pictures"
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
