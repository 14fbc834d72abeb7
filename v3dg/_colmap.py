"""The cameras of COLMAP's models, from `cameras` and `images`, binary or text.

Newer models also have `rigs` and `frames`, which are not needed, because `images`
contains the resulting poses. Source: COLMAP's documentation, Output Format, and its
table of camera models.
"""

import codecs
import math
import os
import re
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Literal, NamedTuple, NoReturn, TypeAlias

import numpy as np

from v3dg import _files
from v3dg._numbers import Floats, check, refuse
from v3dg.cameras import FISHEYE_TERMS, OPENCV_TERMS, LensModel
from v3dg.rotations import normalised, rotation_from_quaternion

IMAGE_FILES = ("images.bin", "images.txt")
LENS_FILES = ("cameras.bin", "cameras.txt")
_USUAL_NAME_BYTES = 256
_MAX_NAME_BYTES = 1 << 16
_COUNT = struct.Struct("<Q")
_LENS = struct.Struct("<IiQQ")  # id, model, width, height
_IMAGE = struct.Struct("<I7dI")  # id, quaternion, translation, id of the lens
_POINT_BYTES = 24  # x, y and the index of a 3D point
_IMAGE_WORDS = 9  # number of words in a line before the name of the image
# NaN and infinity as the C libraries of Windows print them.
_WINDOWS_NOT_FINITE = re.compile(
    rb"[+-]?(?:s?nan\(\w*\)|1\.#(?:IND|INF|QNAN|SNAN)\d*)", re.IGNORECASE
)


_Term: TypeAlias = Literal["k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"]


class _Model(NamedTuple):
    """A camera model.

    Attributes:
        num_focal: Number of focal lengths, which are the first parameters. The
            principal point follows.
        num_distortion: Number of distortion parameters, which are the last ones.
        projection: The projection of a lens without distortion.
        terms: The names that OpenCV uses for the parameters after the principal point.
            None if OpenCV has no such model of distortion.
    """

    name: str
    num_focal: int
    num_distortion: int
    projection: Literal["pinhole", "fisheye", "sphere"]
    terms: tuple[_Term, ...] | None = None


_MODELS = (
    _Model("SIMPLE_PINHOLE", 1, 0, "pinhole", ()),
    _Model("PINHOLE", 2, 0, "pinhole", ()),
    _Model("SIMPLE_RADIAL", 1, 1, "pinhole", ("k1",)),
    _Model("RADIAL", 1, 2, "pinhole", ("k1", "k2")),
    _Model("OPENCV", 2, 4, "pinhole", ("k1", "k2", "p1", "p2")),
    _Model("OPENCV_FISHEYE", 2, 4, "fisheye", ("k1", "k2", "k3", "k4")),
    _Model("FULL_OPENCV", 2, 8, "pinhole", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    _Model("FOV", 2, 1, "pinhole"),
    _Model("SIMPLE_RADIAL_FISHEYE", 1, 1, "fisheye", ("k1",)),
    _Model("RADIAL_FISHEYE", 1, 2, "fisheye", ("k1", "k2")),
    _Model("THIN_PRISM_FISHEYE", 2, 8, "fisheye"),
    _Model("RAD_TAN_THIN_PRISM_FISHEYE", 2, 12, "fisheye"),
    _Model("SIMPLE_DIVISION", 1, 1, "pinhole"),
    _Model("DIVISION", 2, 1, "pinhole"),
    _Model("SIMPLE_FISHEYE", 1, 0, "fisheye", ()),
    _Model("FISHEYE", 2, 0, "fisheye", ()),
    _Model("EUCM", 2, 2, "pinhole"),
    _Model("EQUIRECTANGULAR", 0, 0, "sphere"),
)
_NUM_WIDTH_HEIGHT = 2  # the parameters of EQUIRECTANGULAR are width and height


@dataclass(frozen=True)
class Lens:
    """The size of an image, and its lens. COLMAP calls the two together a camera.

    Attributes:
        distortion: The distortion parameters.
    """

    model: _Model
    width: int
    height: int
    focal_lengths: tuple[float, ...]
    center: tuple[float, ...]
    distortion: tuple[float, ...]

    @property
    def is_distorted(self) -> bool:
        if self.model.name == "EUCM":
            # If the first parameter is 0, the second one has no effect.
            return self.distortion[0] != 0
        return any(self.distortion)

    @property
    def opencv(self) -> tuple[LensModel, tuple[float, ...]] | None:
        """The model and the distortion for `Camera`; None if `Camera` has no such
        model."""
        names: tuple[str, ...] = self.model.terms or ()
        terms = dict(zip(names, self.distortion, strict=False))
        is_known = self.model.terms is not None
        if self.model.projection == "fisheye" and is_known:
            return "OPENCV_FISHEYE", tuple(terms.get(name, 0.0) for name in FISHEYE_TERMS)
        if self.model.projection == "pinhole" and not self.is_distorted:
            return "PINHOLE", ()
        if self.model.projection == "pinhole" and is_known:
            return "OPENCV", tuple(terms.get(name, 0.0) for name in OPENCV_TERMS)
        return None

    @property
    def is_finite(self) -> bool:
        return all(map(math.isfinite, (*self.focal_lengths, *self.center, *self.distortion)))


@dataclass(frozen=True)
class Image:
    """A registered image: its name, its lens, and the (4, 4) matrix from world to
    camera. NaN and infinity in the file are preserved."""

    name: str
    lens: Lens
    viewmat: Floats

    @property
    def is_finite(self) -> bool:
        return self.lens.is_finite and bool(np.isfinite(self.viewmat).all())


def read_model(images: Path) -> list[Image]:
    """Read the images of a model, in the order of their ids, from its `images.bin` or
    `images.txt` and the file with the cameras in the same folder.

    Raises:
        ValueError: The content is not valid; the message names the file.
        OSError: A file cannot be read.
    """
    lens_file = images.with_name(f"cameras{images.suffix}")
    with _opened(lens_file) as file:
        lenses = dict(_LENS_READERS[images.suffix](lens_file, file))
    entries: dict[int, Image] = {}
    with _opened(images) as file:
        for number, quaternion, translation, lens, name in _IMAGE_READERS[images.suffix](
            images, file
        ):
            check(images, number not in entries, f"distinct image ids, got {number} twice")
            expected = f"a camera of image {number} that {lens_file.name} contains"
            check(images, lens in lenses, f"{expected}, got camera {lens}")
            entries[number] = Image(name, lenses[lens], _viewmat(quaternion, translation))
    return [entries[number] for number in sorted(entries)]


class _ImageEntry(NamedTuple):
    number: int
    quaternion: tuple[float, ...]
    translation: tuple[float, ...]
    lens: int
    name: str


def _opened(path: Path) -> IO[bytes]:
    with _files.naming_errors(path):
        return open(_files.open_regular(path), "rb")


def _viewmat(quaternion: tuple[float, ...], translation: tuple[float, ...]) -> Floats:
    viewmat = np.eye(4)
    if not all(map(math.isfinite, quaternion)):
        viewmat[:3, :3] = math.nan
    elif any(quaternion):  # Camera rejects a zero matrix
        viewmat[:3, :3] = rotation_from_quaternion(normalised(np.array(quaternion)))
    else:
        viewmat[:3, :3] = 0
    viewmat[:3, 3] = translation
    return viewmat


def _lens(
    path: Path, number: int, model: _Model, width: int, height: int, parameters: list[float]
) -> Lens:
    center = model.num_focal
    distortion = center + 2 * (model.num_focal > 0)
    expected = _num_parameters(model)
    count = len(parameters)
    check(path, count == expected, f"{expected} parameters of camera {number}, got {count}")
    return Lens(
        model,
        width,
        height,
        focal_lengths=tuple(parameters[:center]),
        center=tuple(parameters[center:distortion]),
        distortion=tuple(parameters[distortion:]),
    )


def _num_parameters(model: _Model) -> int:
    if model.num_focal == 0:
        return _NUM_WIDTH_HEIGHT
    return model.num_focal + 2 + model.num_distortion


def _take(path: Path, file: IO[bytes], size: int) -> bytes:
    content = file.read(size)
    check(
        path,
        len(content) == size,
        f"{size} more bytes, got the end of the file; is the file complete?",
    )
    return content


def _count(path: Path, file: IO[bytes], least_bytes: int) -> int:
    """Read a number of entries. Raise ValueError if the file is too short to have so
    many."""
    (count,) = _COUNT.unpack(_take(path, file, _COUNT.size))
    num_bytes = os.fstat(file.fileno()).st_size
    check(
        path,
        count <= num_bytes // least_bytes,
        f"at least {count * least_bytes} bytes for {count} entries, got a file of "
        f"{num_bytes} bytes; the file is incomplete or damaged",
    )
    return int(count)


def _binary_lenses(path: Path, file: IO[bytes]) -> Iterator[tuple[int, Lens]]:
    for _ in range(_count(path, file, _LENS.size)):
        number, kind, width, height = _LENS.unpack(_take(path, file, _LENS.size))
        is_known = 0 <= kind < len(_MODELS)
        check(path, is_known, f"a known model for camera {number}, got model number {kind}")
        model = _MODELS[kind]
        size = _num_parameters(model)
        parameters = struct.unpack(f"<{size}d", _take(path, file, 8 * size))
        yield number, _lens(path, number, model, width, height, list(parameters))


def _binary_images(path: Path, file: IO[bytes]) -> Iterator[_ImageEntry]:
    end = os.fstat(file.fileno()).st_size
    for _ in range(_count(path, file, _IMAGE.size)):
        number, *pose, lens = _IMAGE.unpack(_take(path, file, _IMAGE.size))
        name = _binary_name(path, file)
        num_points = _count(path, file, 1)
        position = file.seek(_POINT_BYTES * num_points, os.SEEK_CUR)
        expected = f"{num_points} points of image {number}"
        check(path, position <= end, f"{expected}, got the end of the file; is the file complete?")
        yield _ImageEntry(number, tuple(pose[:4]), tuple(pose[4:]), lens, name)


def _binary_name(path: Path, file: IO[bytes]) -> str:
    """Read a name up to its terminating zero byte. Afterwards, the position of the file
    is after that byte."""
    start = file.tell()
    for num_bytes in (_USUAL_NAME_BYTES, _MAX_NAME_BYTES):
        file.seek(start)
        content = file.read(num_bytes)
        size = content.find(b"\0")
        if size >= 0:
            break
    check(
        path,
        size >= 0,
        f"a name of at most {_MAX_NAME_BYTES} bytes, got a longer one; is the file complete?",
    )
    file.seek(start + size + 1)
    return _text(content[:size])


def _text(content: bytes) -> str:
    """Decode a name in UTF-8. Bytes that are not UTF-8 become escapes."""
    return content.decode("utf-8", errors="backslashreplace")


def _number(word: bytes) -> float:
    """Convert a word of text to a number. Infinite numbers become NaN. Raise ValueError
    if the word is not a number."""
    if _WINDOWS_NOT_FINITE.fullmatch(word):
        return math.nan
    return float(word)


def _bad_line(path: Path, number: int, expected: str, line: bytes) -> NoReturn:
    refuse(path, f"{expected} in line {number}, got {_text(line[:60])!a}")


def _numbered_lines(file: IO[bytes]) -> Iterator[tuple[int, bytes]]:
    """Yield the lines of a text with their numbers, without a byte order mark."""
    for number, line in enumerate(file, start=1):
        if number == 1:
            line = line.removeprefix(codecs.BOM_UTF8)
        yield number, line


def _text_lenses(path: Path, file: IO[bytes]) -> Iterator[tuple[int, Lens]]:
    models = {model.name: model for model in _MODELS}
    for number, line in _numbered_lines(file):
        words = line.split()
        if not words or words[0].startswith(b"#"):
            continue
        try:
            identity, width, height = (int(words[i]) for i in (0, 2, 3))
            parameters = [_number(word) for word in words[4:]]
        except (ValueError, IndexError):
            _bad_line(path, number, "CAMERA_ID MODEL WIDTH HEIGHT PARAMS", line)
        name = _text(words[1])
        check(path, name in models, f"a known model of camera {identity}, got {name[:40]!a}")
        yield identity, _lens(path, identity, models[name], width, height, parameters)


def _text_images(path: Path, file: IO[bytes]) -> Iterator[_ImageEntry]:
    lines = _numbered_lines(file)
    for number, line in lines:
        words = line.split(maxsplit=_IMAGE_WORDS)
        if not words or words[0].startswith(b"#"):
            continue
        try:
            identity = int(words[0])
            pose = [_number(word) for word in words[1:8]]
            lens = int(words[8])
        except (ValueError, IndexError):
            _bad_line(path, number, "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME", line)
        name = b"".join(words[_IMAGE_WORDS:]).rstrip(b"\r\n")
        _check_points(path, next(lines, (number + 1, b"")))
        yield _ImageEntry(identity, tuple(pose[:4]), tuple(pose[4:]), lens, _text(name))


def _check_points(path: Path, numbered: tuple[int, bytes]) -> None:
    """Raise ValueError unless a line is a list of the points of an image. The line may
    be empty. If it were missing, the next image would be read in its place."""
    number, line = numbered
    words = line.split()
    try:
        is_list = len(words) % 3 == 0 and all(float(word) == float(word) for word in words[-3:])
    except ValueError:
        is_list = False
    if not is_list:
        _bad_line(path, number, "the points of an image, or an empty line,", line)


_LENS_READERS = {".bin": _binary_lenses, ".txt": _text_lenses}
_IMAGE_READERS = {".bin": _binary_images, ".txt": _text_images}
