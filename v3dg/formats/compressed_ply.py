"""`.compressed.ply`, of PlayCanvas and SuperSplat: 16 bytes a gaussian, within the ranges of chunks of 256.

Element `chunk` holds the lowest and highest position, log scale and colour of its gaussians as floats,
element `vertex` a position and a scale (11, 10 and 11 bits of that range), a quaternion (index of its largest
component, 10 bits each for the others), colour and opacity (8 bits each), and element `sh` a byte a
coefficient, channel by channel, for -4 to 4. See docs/formats.md.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _files
from v3dg.formats import _packing
from v3dg.formats._packing import SH_C0, SQRT2, Floats, assemble
from v3dg.formats._reading import AssetFile, File, Path, check
from v3dg.gaussians import Gaussians

_CHUNK = 256
_PLY_TYPES = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = {"": "xyz", "scale_": "xyz", "color": "rgb"}
# Where each field of a word begins, and its largest value.
_Fields: TypeAlias = tuple[tuple[int, int], ...]
_XYZ: _Fields = ((21, 2047), (11, 1023), (0, 2047))
_THREE: _Fields = ((20, 1023), (10, 1023), (0, 1023))
_RGBA: _Fields = ((24, 255), (16, 255), (8, 255), (0, 255))


@dataclass(frozen=True)
class _Element:
    """Where its rows are in the file."""

    kinds: dict[str, str]  # of its properties, by name
    dtype: np.dtype[Any]
    count: int
    offset: int

    def rows(self, file: File, first: int, last: int) -> NDArray[Any]:
        return file.rows(self.dtype, self.offset + first * self.dtype.itemsize, last - first)


def open_file(path: Path) -> AssetFile:
    """Open a `.compressed.ply` file."""
    file = File(path)
    elements = _elements(file)
    for name in ("chunk", "vertex"):
        check(path, name in elements, f"the elements chunk and vertex of a compressed .ply, got no {name}")
    chunk, vertex, sh = elements["chunk"], elements["vertex"], elements.get("sh")
    count = vertex.count
    kinds = [kind for kind in _RANGES if kind != "color" or chunk.kinds.keys() & _range_names(kind)]
    for kind in kinds:
        _require(path, "chunk", chunk, _range_names(kind), "float")
    _require(path, "vertex", vertex, _PACKED, "uint")
    num_chunks = -(-count // _CHUNK)
    check(path, chunk.count >= num_chunks, f"{num_chunks} chunks for {count} gaussians, got {chunk.count}")
    degree = _degree(path, sh, count)

    def read_rows(first: int, last: int) -> Gaussians:
        first_chunk = first // _CHUNK
        ranges = _ranges(chunk.rows(file, first_chunk, max(first_chunk, -(-last // _CHUNK))), kinds)
        rest = np.zeros((last - first, 0), np.uint8)
        if sh is not None:
            columns = sh.rows(file, first, last)
            rest = np.stack([columns[f"f_rest_{i}"] for i in range(len(sh.kinds))], axis=1)
        packed = vertex.rows(file, first, last)
        chunk_from_row = np.arange(first, last) // _CHUNK - first_chunk

        def decode(rows: slice) -> tuple[Floats, ...]:
            block, chunks = packed[rows], chunk_from_row[rows]

            def within(kind: str, fractions: Floats) -> Floats:
                low, high = ranges[kind][0][chunks], ranges[kind][1][chunks]
                return np.asarray(low * (1.0 - fractions) + high * fractions)

            rotation = block["packed_rotation"]
            three = (_fractions(rotation, _THREE) - 0.5) * SQRT2
            rgba = _fractions(block["packed_color"], _RGBA)
            color = (within("color", rgba[:, :3]) - 0.5) / SH_C0
            means = within("", _fractions(block["packed_position"], _XYZ))
            scales = np.exp(within("scale_", _fractions(block["packed_scale"], _XYZ)))
            quats = _packing.quats_from_three(three, rotation >> 30)
            higher = _REST_VALUE[rest[rows]].reshape(len(block), 3, -1).transpose(0, 2, 1)
            return means, quats, scales, rgba[:, 3], np.concatenate([color[:, None], higher], axis=1)

        return assemble(last - first, degree, decode)

    return AssetFile(path, count, degree, read_rows)


def write(path: Path, gaussians: Gaussians) -> None:
    """Write a `.compressed.ply` file; gaussians are put in an order that keeps neighbours together."""
    host = _packing.check_writable(gaussians)
    order = _core.morton_order(host.means)
    count, num_rest = len(host), 3 * (host.sh.shape[1] - 1)
    num_chunks = -(-count // _CHUNK)
    values = {
        "": host.means[order].astype(np.float64),
        "scale_": np.minimum(_packing.log_scales(host.scales[order]), 20.0),
        "color": host.sh[order, 0].astype(np.float64) * SH_C0 + 0.5,
    }
    starts = np.arange(num_chunks) * _CHUNK
    ranges, fractions = [], {}
    for kind, array in values.items():
        # Rounded first, so that writer and reader mean the same range.
        low = np.minimum.reduceat(array, starts).astype(np.float32)
        high = np.maximum.reduceat(array, starts).astype(np.float32)
        ranges += [low, high]
        chunks = np.arange(count) // _CHUNK
        extent = np.where(high > low, high.astype(np.float64) - low, 1.0)[chunks]
        fractions[kind] = np.clip((array - low[chunks]) / extent, 0.0, 1.0)
    header = ["ply", "format binary_little_endian 1.0", "comment made by v3dg", f"element chunk {num_chunks}"]
    header += [f"property float {name}" for kind in _RANGES for name in _range_names(kind)]
    header += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if num_rest:
        header += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(num_rest))]
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:
        file.write("\n".join([*header, "end_header\n"]).encode())
        file.write(np.concatenate(ranges, axis=1).astype("<f4").tobytes())
        for block in _packing.blocks(count):
            rows = order[block]
            three, largest = _packing.three_of_quats(host.quats[rows])
            words = np.empty((len(rows), 4), "<u4")
            words[:, 0] = _word(fractions[""][block], _XYZ)
            words[:, 1] = _word(three / SQRT2 + 0.5, _THREE) | (largest.astype("u4") << 30)
            words[:, 2] = _word(fractions["scale_"][block], _XYZ)
            rgb = _word(fractions["color"][block], _RGBA[:3])
            words[:, 3] = rgb | _packing.opacity_bytes(host.opacities[rows])
            file.write(words.tobytes())
        for block in _packing.blocks(count if num_rest else 0):
            rest = host.sh[order[block], 1:].transpose(0, 2, 1).astype(np.float64)
            file.write(np.clip(np.floor((rest / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes())


# The middle of what a byte of SH stands for; the ends are exact.
_REST_VALUE = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
_REST_VALUE[[0, 255]] = -4.0, 4.0


def _fractions(words: NDArray[Any], fields: _Fields) -> Floats:
    return np.stack([((words >> shift) & most) / float(most) for shift, most in fields], axis=1)


def _word(fractions: Floats, fields: _Fields) -> NDArray[np.uint32]:
    word = np.zeros(len(fractions), np.uint32)
    for column, (shift, most) in zip(fractions.T, fields, strict=True):
        word |= _packing.to_integers(column * most, most) << np.uint32(shift)
    return word


def _range_names(kind: str) -> list[str]:
    prefix = "" if kind == "color" else kind
    return [f"{end}_{prefix}{axis}" for end in ("min", "max") for axis in _RANGES[kind]]


def _ranges(chunk: NDArray[Any], kinds: Sequence[str]) -> dict[str, tuple[Floats, Floats]]:
    """Lowest and highest of each chunk, (C, 3) each; files without ranges of colour mean 0 to 1."""
    ones: Floats = np.ones((len(chunk), 3))
    ranges = {"color": (0.0 * ones, ones)}
    for kind in kinds:
        with np.errstate(invalid="ignore"):  # signalling NaN
            values = np.stack([chunk[name] for name in _range_names(kind)], axis=1).astype(np.float64)
        ranges[kind] = (values[:, :3], values[:, 3:])
    return ranges


def _degree(path: Path, sh: _Element | None, count: int) -> int:
    if sh is None:
        return 0
    names = [f"f_rest_{i}" for i in range(len(sh.kinds))]
    degree = _packing.DEGREES.get(len(names) // 3, -1) if len(names) % 3 == 0 else -1
    check(path, degree >= 0, f"0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), got {len(names)}")
    _require(path, "sh", sh, names, "uchar")
    check(path, sh.count == count, f"{count} rows of element sh like vertex, got {sh.count}")
    return degree


def _require(path: Path, shown: str, element: _Element, names: Sequence[str], kind: str) -> None:
    for name in names:
        check(path, element.kinds.get(name) == kind, f"'property {kind} {name}' in element {shown}, got none")


def _elements(file: File) -> dict[str, _Element]:
    """Where the rows of each element are, as the header lists them."""
    path, given = file.path, file.num_bytes
    encoding, offset, listed = _core.ply_header(path)
    wanted = "'format binary_little_endian 1.0' in a compressed .ply"
    check(path, encoding == "binary_little_endian", f"{wanted}, got {encoding}")
    found: dict[str, _Element] = {}
    for name, count, fields in listed:
        shown = f"element {name[:40]!a}"
        other = next((kind for _, kind in fields if kind not in _PLY_TYPES), None)
        check(path, other is None, f"'property float|uint|uchar NAME' in {shown}, got {other}")
        is_clear = name not in found and 0 < len(dict(fields)) == len(fields)
        check(path, is_clear, f"properties of {shown}, each once")
        dtype, left = np.dtype([(field, _PLY_TYPES[kind]) for field, kind in fields]), given - offset
        wanted = f"{count} rows of {shown} with {dtype.itemsize} bytes each"
        check(path, count * dtype.itemsize <= left, f"{wanted}, got {left} bytes")
        found[name] = _Element(dict(fields), dtype, count, offset)
        offset += count * dtype.itemsize
    check(path, offset == given, f"the end of the file after {offset} bytes, got {given}")
    return found
