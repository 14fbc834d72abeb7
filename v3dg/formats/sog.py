"""SOG, of PlayCanvas: pictures whose pixels are gaussians, and a `meta.json`; in a zip (`.sog`) or a folder.

Version 2: positions are 16 bits a coordinate of sign(x) ln(1 + |x|), log scales and colours are indices into
tables of 256 values, quaternions three bytes and the index of the largest component, opacity is a byte, and
higher SH an index into a palette of whole sets of coefficients. See docs/formats.md.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._json import Node, parse_json
from v3dg._version import __version__
from v3dg.formats._codebook import nearest, palette_of, table_of
from v3dg.formats._packing import (
    Floats,
    assemble,
    check_writable,
    log_scales,
    morton_order,
    opacity_bytes,
    problem,
    quats_from_three,
    read_bytes,
    three_of_quats,
    to_integers,
)
from v3dg.gaussians import Gaussians

# What compresses better than this was not made of gaussians that differ.
_MAX_GAUSSIANS_PER_BYTE = 64
_MAX_META = 1 << 24
_COEFFICIENTS = {1: 3, 2: 8, 3: 15}
_PALETTE_COLUMNS = 64  # entries of the palette side by side in its picture
_SQRT2 = math.sqrt(2.0)
_MAX_LOG = 88.0  # of a float32

Load = Callable[[str], bytes]


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.sog` file, or the `meta.json` of a folder with its pictures.

    Raises:
        ValueError: It is none, incomplete, or of another version than 2.
        OSError: It cannot be read.
    """
    path = Path(path)
    if path.suffix == ".json":
        meta = read_bytes(path)
        return _read(path, meta, lambda name: read_bytes(path.with_name(name)))
    content = read_bytes(path)
    if content[:4] != b"PK\3\4":  # zipfile would look for a zip anywhere in the file
        raise problem(path, f"expected a zip with SOG, got a file that begins with {content[:4].hex(' ')}")
    load = _zip_loader(path, content)
    return _read(path, load("meta.json"), load)


def _zip_loader(path: Path, content: bytes) -> Load:
    """What reads a file of a zip by its name."""
    with _telling_damage(path):
        bundle = zipfile.ZipFile(io.BytesIO(content))

    def load(name: str) -> bytes:
        if name not in bundle.namelist():
            raise problem(path, f"expected {name!a} in the zip, got none")
        member = bundle.getinfo(name)
        if member.file_size > max(len(content), _MAX_META):  # pictures are compressed already
            raise problem(path, f"expected {name!a} no larger than the zip, got {member.file_size} bytes")
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise problem(path, f"expected {name!a} stored or deflated in the zip, got neither")
        with _telling_damage(path):
            return bundle.read(member)

    return load


@contextlib.contextmanager
def _telling_damage(path: Path) -> Iterator[None]:
    """Turn all that zipfile raises for damaged files, which it does not document, into one error."""
    try:
        yield
    except (zipfile.BadZipFile, EOFError, RuntimeError, ValueError, struct.error, zlib.error) as error:
        raise problem(path, f"expected a zip with SOG, got one that is damaged: {str(error)!a}") from None


def _read(path: Path, text: bytes, load: Load) -> Gaussians:
    try:
        meta = Node(parse_json(text.decode("utf-8")), os.fspath(path), "")
    except ValueError as error:
        raise problem(path, f"expected JSON in meta.json, got text that does not parse: {error}") from None
    fields = meta.some_fields(())
    if "version" not in fields:
        raise problem(
            path, "expected SOG version 2, got an older file; convert it with splat-transform first"
        )
    if fields["version"].value != 2:
        raise fields["version"].error("SOG version 2")
    fields = meta.some_fields(("count", "means", "scales", "quats", "sh0"))
    count = fields["count"].value
    if not isinstance(count, int) or isinstance(count, bool) or count < 0:
        raise fields["count"].error("a number of gaussians")
    pictures = _Pictures(path, load, count)
    means_fields = fields["means"].some_fields(("mins", "maxs", "files"))
    low = np.array(means_fields["mins"].vector(3))
    high = np.array(means_fields["maxs"].vector(3))
    lower, upper = (pictures.pixels(name) for name in _names(means_fields["files"], 2))
    (quats,) = (pictures.pixels(name) for name in _names(fields["quats"].some_fields(("files",))["files"], 1))
    scale_table, scales = _indexed(fields["scales"], pictures)
    color_table, color = _indexed(fields["sh0"], pictures)
    tags = quats[:, 3]
    if count and tags.min() < 252:
        raise problem(path, f"expected quaternions tagged 252 to 255, got {tags.min()}")
    degree, higher = _higher(path, fields.get("shN"), pictures)

    def decode(rows: slice) -> tuple[Floats, ...]:
        whole = lower[rows, :3] | (upper[rows, :3].astype(np.uint16) << 8)
        logs = np.clip(low + (high - low) * (whole / 65535.0), -_MAX_LOG, _MAX_LOG)
        means = np.sign(logs) * np.expm1(np.abs(logs))
        three = (quats[rows, :3] / 255.0 * 2.0 - 1.0) / _SQRT2
        widths = np.exp(scale_table[scales[rows, :3]])
        sh = np.concatenate([color_table[color[rows, :3]][:, None], higher(rows)], axis=1)
        return means, quats_from_three(three, tags[rows] - 252), widths, color[rows, 3] / 255.0, sh

    return assemble(count, degree, decode)


def write(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.sog` file; gaussians are put in an order that keeps neighbours together.

    Raises:
        ValueError: A value that the format cannot hold.
        OSError: It cannot be written.
    """
    host = check_writable(gaussians)
    files = encode(host.subset(morton_order(host.means)))
    with _files.replacing(path) as temporary, zipfile.ZipFile(temporary, "w") as bundle:
        for name, content in files.items():
            bundle.writestr(zipfile.ZipInfo(name), content)  # of 1980: the same gaussians, the same file


def encode(gaussians: Gaussians) -> dict[str, bytes]:
    """The files of a SOG, by name: NumPy gaussians with values that can be held, in their order."""
    count = len(gaussians)
    width = 4 * max(1, math.ceil(math.sqrt(count) / 4))
    height = 4 * max(1, math.ceil(count / width / 4))

    def picture(*columns: NDArray[Any]) -> bytes:
        pixels = np.full((width * height, 4), 255, np.uint8)
        pixels[:count, : len(columns)] = np.stack(columns, axis=1)
        return _webp(pixels.reshape(height, width, 4))

    means = gaussians.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (logs.min(axis=0), logs.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    whole = to_integers((logs - low) / np.where(high > low, high - low, 1.0) * 65535.0, 65535)
    three, largest = three_of_quats(gaussians.quats)
    log_widths = log_scales(gaussians.scales)
    scale_table, color_table = table_of(log_widths), table_of(gaussians.sh[:, 0])
    files = {
        "means_l.webp": picture(*(whole & 255).T),
        "means_u.webp": picture(*(whole >> 8).T),
        "scales.webp": picture(*nearest(scale_table, log_widths).T),
        "quats.webp": picture(*to_integers((three * _SQRT2 + 1.0) * 127.5, 255).T, largest + 252),
        "sh0.webp": picture(*nearest(color_table, gaussians.sh[:, 0]).T, opacity_bytes(gaussians.opacities)),
    }
    meta: dict[str, Any] = {
        "version": 2,
        "asset": {"generator": f"v3dg {__version__}"},
        "count": count,
        "means": {
            "mins": low.tolist(),
            "maxs": high.tolist(),
            "files": ["means_l.webp", "means_u.webp"],
        },
        "scales": {"codebook": scale_table.tolist(), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": color_table.tolist(), "files": ["sh0.webp"]},
    }
    if gaussians.sh_degree:
        coefficients = _COEFFICIENTS[gaussians.sh_degree]
        palette, labels = palette_of(
            gaussians.sh[:, 1:].reshape(count, 3 * coefficients), _palette_size(count)
        )
        table = table_of(palette)
        rows = -(-len(palette) // _PALETTE_COLUMNS)
        pixels = np.full((rows * _PALETTE_COLUMNS, coefficients, 4), 255, np.uint8)
        pixels[: len(palette), :, :3] = nearest(table, palette).reshape(-1, coefficients, 3)
        files["shN_centroids.webp"] = _webp(pixels.reshape(rows, _PALETTE_COLUMNS * coefficients, 4))
        files["shN_labels.webp"] = picture(labels & 255, labels >> 8, np.zeros(count, np.uint8))
        meta["shN"] = {
            "count": len(palette),
            "bands": gaussians.sh_degree,
            "codebook": table.tolist(),
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        }
    return {"meta.json": json.dumps(meta, separators=(",", ":")).encode(), **files}


def _palette_size(count: int) -> int:
    """A quarter of the gaussians, but enough for a small asset to keep all its coefficients, and 16 bits."""
    return min(max(1024, count // 4), 65536)


def _webp(pixels: NDArray[np.uint8]) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    # exact: without it, colours of pixels whose alpha is 0 are lost.
    Image.fromarray(pixels).save(stream, "WEBP", lossless=True, exact=True, quality=50, method=4)
    return stream.getvalue()


class _Pictures:
    """The pictures of one file, each loaded once it is known to be no larger than the file can justify."""

    def __init__(self, path: Path, load: Load, count: int) -> None:
        self._path, self._load, self._count = path, load, count

    def pixels(self, name: str) -> NDArray[np.uint8]:
        """(N, 4) red, green, blue and alpha of the gaussians."""
        return self._decoded(name, self._count, None).reshape(-1, 4)[: self._count]

    def palette(self, name: str, width: int, rows: int) -> NDArray[np.uint8]:
        """(rows, width, 3)."""
        return self._decoded(name, width * rows, width)[:rows, :, :3]

    def _decoded(self, name: str, at_least: int, width: int | None) -> NDArray[np.uint8]:
        from PIL import Image, UnidentifiedImageError

        content = self._load(name)
        try:
            with warnings.catch_warnings():
                warnings.simplefilter(
                    "ignore", Image.DecompressionBombWarning
                )  # what is too large is told below
                picture = Image.open(io.BytesIO(content), formats=("WEBP", "PNG"))
            with picture:
                num_pixels = picture.width * picture.height
                if num_pixels < at_least or (width is not None and picture.width != width):
                    shape = f"{at_least} pixels" + ("" if width is None else f" in rows of {width}")
                    raise problem(
                        self._path,
                        f"expected {shape} in {name!a}, got {picture.width} x {picture.height}",
                    )
                if num_pixels > _MAX_GAUSSIANS_PER_BYTE * max(len(content), 1024):
                    raise problem(
                        self._path,
                        f"expected a picture of {len(content)} bytes in {name!a}, "
                        f"got one that claims {num_pixels} pixels",
                    )
                return np.asarray(picture.convert("RGBA"))
        except (UnidentifiedImageError, OSError, SyntaxError, Image.DecompressionBombError) as error:
            raise problem(self._path, f"expected a picture in {name!a}, got {str(error)!a}") from None


def _names(node: Node, count: int) -> list[str]:
    """Names of files beside meta.json; nothing outside of its folder is read."""
    items = node.items()
    if len(items) != count:
        raise node.error(f"{count} file names")
    for item in items:
        if item.text() != os.path.basename(item.text()) or "\\" in item.text() or item.text() == "..":
            raise item.error("the name of a file beside meta.json")
    return [item.text() for item in items]


def _indexed(node: Node, pictures: _Pictures) -> tuple[Floats, NDArray[np.uint8]]:
    """A table of 256 values, and the pixels that hold indices into it."""
    fields = node.some_fields(("codebook", "files"))
    (name,) = _names(fields["files"], 1)
    return _codebook(fields["codebook"]), pictures.pixels(name)


def _codebook(node: Node) -> Floats:
    entries = node.items()
    if not 1 <= len(entries) <= 256:
        raise node.error("1 to 256 numbers")
    table = np.zeros(256)
    # Some versions of splat-transform wrote null for the first value, which continues the others.
    skip = int(entries[0].value is None and len(entries) == 256)
    table[skip : len(entries)] = [entry.number() for entry in entries[skip:]]
    if skip:
        table[0] = table[1] + (table[1] - table[255]) / 255
    return table


def _higher(path: Path, node: Node | None, pictures: _Pictures) -> tuple[int, Callable[[slice], Floats]]:
    """The degree, and (n, K - 1, 3) coefficients past the first for a block."""
    if node is None:
        return 0, lambda rows: np.zeros((rows.stop - rows.start, 0, 3))
    fields = node.some_fields(("count", "bands", "codebook", "files"))
    degree, entries = fields["bands"].value, fields["count"].value
    if degree not in _COEFFICIENTS or isinstance(degree, bool):
        raise fields["bands"].error("1 to 3")
    if not isinstance(entries, int) or isinstance(entries, bool) or not 1 <= entries <= 65536:
        raise fields["count"].error("1 to 65536 entries")
    coefficients = _COEFFICIENTS[degree]
    table = _codebook(fields["codebook"])
    palette_name, labels_name = _names(fields["files"], 2)
    rows = -(-entries // _PALETTE_COLUMNS)
    palette = pictures.palette(palette_name, _PALETTE_COLUMNS * coefficients, rows).reshape(
        -1, coefficients, 3
    )
    pixels = pictures.pixels(labels_name)
    labels = pixels[:, 0] | (pixels[:, 1].astype(np.uint16) << 8)
    if len(labels) and labels.max() >= len(palette):
        raise problem(path, f"expected labels below {entries}, got {labels.max()}")
    return degree, lambda rows: table[palette[labels[rows]]]
