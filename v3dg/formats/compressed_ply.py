"""`.compressed.ply`, of PlayCanvas and SuperSplat: 16 bytes per gaussian, relative to
the ranges of chunks of 256 gaussians.

Element `chunk` has the minimum and maximum position, log scale and colour of its
gaussians as floats. Element `vertex` has, for each gaussian, a position and a scale
(11, 10 and 11 bits within these ranges), a quaternion (2 bits for the index of its
largest component, 10 bits for each of the others), and a colour and an opacity (8 bits
for each value). Element `sh` has one byte for each coefficient, for values from -4 to
4, channel by channel. See docs/formats.md.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _files
from v3dg.formats import _packing, _ply_comments
from v3dg.formats._packing import SH_C0, SQRT2, Floats, assemble
from v3dg.formats._reading import AnyPath, AssetFile, File, check, listed
from v3dg.gaussians import Gaussians

_CHUNK = 256
# The radius of the inner shell is eight times a distance. A tenth of the gaussians are
# within this distance from the median position. The shell contains all of a compact
# asset, or the dense part of an asset with far gaussians.
_INNER_SHARE = 0.1
_INNER_FACTOR = 8.0
_SHELL_GROWTH = 4.0  # ratio of the radius of a shell to that of the next smaller one
# Weights of the extents of a chunk. y has half as many steps as x and z. No weight is
# above 1, so that coordinates do not overflow.
_STEP_WEIGHTS = np.array([0.5, 1.0, 0.5], np.float32)
_MAX_LOG_SCALE = 20.0
LIMITS = _packing.Limits(log_scale=(-20.0, _MAX_LOG_SCALE), harmonic=(-4.0, 4.0))
"""The ranges of values in the format."""
_PLY_TYPES = {"float": "<f4", "uint": "<u4", "uchar": "u1"}
_PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
_RANGES = {"": "xyz", "scale_": "xyz", "color": "rgb"}
# For each field of a word, its lowest bit and its largest value.
_Fields: TypeAlias = tuple[tuple[int, int], ...]
_XYZ: _Fields = ((21, 2047), (11, 1023), (0, 2047))
_THREE: _Fields = ((20, 1023), (10, 1023), (0, 1023))
_RGBA: _Fields = ((24, 255), (16, 255), (8, 255), (0, 255))


@dataclass(frozen=True)
class _Element:
    """An element of the header, and the offset of its rows in the file."""

    kinds: dict[str, str]  # the type of each property, by name
    dtype: np.dtype[np.void]
    count: int
    offset: int

    def rows(self, file: File, first: int, last: int) -> NDArray[np.void]:
        return file.rows(self.dtype, self.offset + first * self.dtype.itemsize, last - first)


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.compressed.ply` file."""
    file = File(path)
    elements = _elements(file)
    for name in ("chunk", "vertex"):
        check(
            path,
            name in elements,
            f"the elements chunk and vertex of a compressed .ply, but {name} is missing",
        )
    chunk = elements["chunk"]
    vertex = elements["vertex"]
    sh = elements.get("sh")
    count = vertex.count
    kinds = _range_kinds(path, chunk)
    _require(path, "vertex", vertex, _PACKED, "uint")
    num_chunks = -(-count // _CHUNK)
    check(
        path,
        chunk.count >= num_chunks,
        f"{num_chunks} chunks for {count} gaussians, got {chunk.count}",
    )
    degree = _degree(path, sh, count)

    def read_rows(first: int, last: int) -> Gaussians:
        first_chunk = first // _CHUNK
        ranges = _ranges(chunk.rows(file, first_chunk, max(first_chunk, -(-last // _CHUNK))), kinds)
        sh_bytes = np.zeros((last - first, 0), np.uint8)
        if sh is not None:
            columns = sh.rows(file, first, last)
            sh_bytes = np.stack([columns[f"f_rest_{i}"] for i in range(len(sh.kinds))], axis=1)
        packed = vertex.rows(file, first, last)
        chunk_from_row = np.arange(first, last) // _CHUNK - first_chunk

        def decode(rows: slice) -> tuple[Floats, ...]:
            return _decoded(packed[rows], chunk_from_row[rows], ranges, sh_bytes[rows])

        return assemble(last - first, degree, decode)

    declared = _ply_comments.declared_by(_core.ply_comments(path))
    declared = replace(declared, notes=(*declared.notes, *_notes(elements)))
    return AssetFile(path, count, degree, read_rows, declared=declared)


def _notes(elements: Mapping[str, _Element]) -> tuple[str, ...]:
    """Return a sentence for each part of the file that is ignored."""
    used = {
        "chunk": [name for kind in _RANGES for name in _range_names(kind)],
        "vertex": list(_PACKED),
    }
    notes = []
    for element, read_names in used.items():
        names = [name for name in elements[element].kinds if name not in read_names]
        if names:
            notes.append(f"Properties of {element} were ignored: {listed(names)}.")
    unread = [name for name in elements if name not in (*used, "sh")]
    if unread:
        notes.append(f"Elements other than chunk, vertex and sh were ignored: {listed(unread)}.")
    return tuple(notes)


def _decoded(
    block: NDArray[np.void],
    chunks: NDArray[np.int64],
    ranges: dict[str, tuple[Floats, Floats]],
    sh_bytes: NDArray[np.uint8],
) -> tuple[Floats, ...]:
    """Return the means, quats, scales, opacities and sh of rows of `vertex` and `sh`.
    `chunks` are the indices of the rows' chunks."""

    def interpolated(kind: str, fractions: Floats) -> Floats:
        low, high = ranges[kind]
        return np.asarray(low[chunks] * (1.0 - fractions) + high[chunks] * fractions)

    rotation = block["packed_rotation"]
    three = (_fractions(rotation, _THREE) - 0.5) * SQRT2
    rgba = _fractions(block["packed_color"], _RGBA)
    color = (interpolated("color", rgba[:, :3]) - 0.5) / SH_C0
    means = interpolated("", _fractions(block["packed_position"], _XYZ))
    scales = np.exp(interpolated("scale_", _fractions(block["packed_scale"], _XYZ)))
    quats = _packing.quats_from_three(three, rotation >> 30)
    higher = _SH_VALUE[sh_bytes].reshape(len(block), 3, -1).transpose(0, 2, 1)
    sh = np.concatenate([color[:, None], higher], axis=1)
    return means, quats, scales, rgba[:, 3], sh


def write(path: AnyPath, gaussians: Gaussians) -> Gaussians:
    """Write a `.compressed.ply` file. Gaussians are reordered so that each chunk
    contains neighbours in space. Return them in the order of the file."""
    host = _packing.check_writable(gaussians)
    host = host.subset(chunk_order(host))
    count = len(host)
    num_rest = 3 * (host.sh.shape[1] - 1)
    num_chunks = -(-count // _CHUNK)
    values = {
        "": host.means.astype(np.float64),
        "scale_": np.minimum(_packing.log_scales(host.scales), _MAX_LOG_SCALE),
        "color": host.sh[:, 0].astype(np.float64) * SH_C0 + 0.5,
    }
    starts = np.arange(num_chunks) * _CHUNK
    ranges = []
    fractions = {}
    for kind, array in values.items():
        # The limits are rounded before they are used, so that the writer and the reader
        # have the same range.
        low = np.minimum.reduceat(array, starts).astype(np.float32)
        high = np.maximum.reduceat(array, starts).astype(np.float32)
        ranges += [low, high]
        chunks = np.arange(count) // _CHUNK
        extent = np.where(high > low, high.astype(np.float64) - low, 1.0)[chunks]
        fractions[kind] = np.clip((array - low[chunks]) / extent, 0.0, 1.0)
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:
        file.write(_header(host, num_chunks))
        file.write(np.concatenate(ranges, axis=1).astype("<f4").tobytes())
        for rows in _packing.blocks(count):
            three, largest = _packing.three_of_quats(host.quats[rows])
            words = np.empty((len(three), 4), "<u4")
            words[:, 0] = _word(fractions[""][rows], _XYZ)
            words[:, 1] = _word(three / SQRT2 + 0.5, _THREE) | (largest.astype("u4") << 30)
            words[:, 2] = _word(fractions["scale_"][rows], _XYZ)
            rgb = _word(fractions["color"][rows], _RGBA[:3])
            words[:, 3] = rgb | _packing.opacity_bytes(host.opacities[rows])
            file.write(words.tobytes())
        if num_rest:
            for rows in _packing.blocks(count):
                higher = host.sh[rows, 1:].transpose(0, 2, 1).astype(np.float64)
                file.write(
                    np.clip(np.floor((higher / 8 + 0.5) * 256), 0, 255).astype(np.uint8).tobytes()
                )
    return host


def chunk_order(gaussians: Gaussians) -> NDArray[np.int64]:
    """Return the order (N,) in a file of gaussians on the host with finite positions.

    The range of a chunk is divided into 1,024 or 2,048 steps, so a chunk with far
    gaussians would be too coarse for near ones. Therefore the file contains one shell
    around the median position after another, each in chunks of a median split. If the
    gaussians of a shell do not fill its last chunk, the least visible ones are left
    over. They share a chunk with the innermost gaussians of the next shells.
    """
    distances = _distances(gaussians.means)
    shells = _shells(distances)
    scales = np.sort(gaussians.scales.astype(np.float64), axis=1)
    visibility = gaussians.opacities * scales[:, 1] * scales[:, 2]  # opacity times area
    by_shell = np.argsort(shells, kind="stable")
    ends = np.cumsum(np.bincount(shells))
    parts = []
    remaining = by_shell[:0]  # left over from smaller shells; less than a chunk
    for rows in np.split(by_shell, ends[:-1]):
        is_inner = _lowest(distances[rows], -len(remaining) % _CHUNK)
        remaining = np.concatenate([remaining, rows[is_inner]])
        outer = rows[~is_inner]
        if not len(outer):
            continue
        parts.append(remaining)
        remaining = outer[:0]
        if shells[outer[0]] != shells[by_shell[-1]]:
            is_rest = _lowest(visibility[outer], len(outer) % _CHUNK)
            remaining = outer[is_rest]
            outer = outer[~is_rest]
        parts.append(outer[_split(gaussians.means[outer])])
    return np.concatenate([*parts, remaining])


def _split(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return an order (N,) in which each chunk contains neighbours."""
    depth = _core.num_halvings(-(-len(means) // _CHUNK), 1)
    order, _ = _core.median_split(means * _STEP_WEIGHTS, np.array([0, len(means)]), depth, _CHUNK)
    return np.asarray(order, np.int64)


def _distances(means: NDArray[np.float32]) -> NDArray[np.float64]:
    """Return the distance (N,) of each position from the median position, along the
    axis on which this distance is largest."""
    positions = means.astype(np.float64)
    if not len(positions):
        return np.zeros(0)
    return np.asarray(np.abs(positions - np.median(positions, axis=0)).max(axis=1))


def _shells(distances: NDArray[np.float64]) -> NDArray[np.intp]:
    """Return the index (N,) of the shell of each distance. It is 0 up to the radius of
    the inner shell, and rises by one with each factor `_SHELL_GROWTH`."""
    radius = 0.0
    if len(distances):
        radius = _INNER_FACTOR * float(np.quantile(distances, _INNER_SHARE))
    if radius == 0:
        return np.zeros(len(distances), np.intp)
    growth = np.log(np.maximum(distances / radius, 1.0)) / math.log(_SHELL_GROWTH)
    shells: NDArray[np.intp] = np.ceil(growth).astype(np.intp)
    return shells


def _lowest(values: NDArray[np.floating], count: int) -> NDArray[np.bool_]:
    """Return whether each value (N,) is among the ``count`` lowest. Equal values are
    ordered by index. If there are at most ``count`` values, all are."""
    if count >= len(values):
        return np.ones(len(values), bool)
    if count == 0:
        return np.zeros(len(values), bool)
    highest = np.partition(values, count - 1)[count - 1]
    is_lowest = values < highest
    is_lowest[np.flatnonzero(values == highest)[: count - is_lowest.sum()]] = True
    return np.asarray(is_lowest)


def _header(host: Gaussians, num_chunks: int) -> bytes:
    count = len(host)
    num_rest = 3 * (host.sh.shape[1] - 1)
    comments = _ply_comments.comments_for(host.antialiased)
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        "comment made by v3dg",
        *(f"comment {comment}" for comment in comments),
        f"element chunk {num_chunks}",
    ]
    lines += [f"property float {name}" for kind in _RANGES for name in _range_names(kind)]
    lines += [f"element vertex {count}", *(f"property uint {name}" for name in _PACKED)]
    if num_rest:
        lines += [f"element sh {count}", *(f"property uchar f_rest_{i}" for i in range(num_rest))]
    lines.append("end_header\n")
    return "\n".join(lines).encode()


# Each byte of SH stands for the middle of an interval, except that the first and the
# last byte are the exact limits.
_SH_VALUE = ((np.arange(256) + 0.5) / 256 - 0.5) * 8
_SH_VALUE[0] = -4.0
_SH_VALUE[255] = 4.0


def _fractions(words: _packing.Integers, fields: _Fields) -> Floats:
    return np.stack(
        [((words >> shift) & largest) / float(largest) for shift, largest in fields], axis=1
    )


def _word(fractions: Floats, fields: _Fields) -> NDArray[np.uint32]:
    word = np.zeros(len(fractions), np.uint32)
    for column, (shift, largest) in zip(fractions.T, fields, strict=True):
        word |= _packing.to_integers(column * largest, largest) << np.uint32(shift)
    return word


def _range_names(kind: str) -> list[str]:
    prefix = kind
    if kind == "color":
        prefix = ""
    return [f"{end}_{prefix}{axis}" for end in ("min", "max") for axis in _RANGES[kind]]


def _range_kinds(path: AnyPath, chunk: _Element) -> list[str]:
    """Return the kinds of ranges that the chunks of a file have. Older files have none
    for colours."""
    kinds = [kind for kind in _RANGES if kind != "color" or chunk.kinds.keys() & _range_names(kind)]
    for kind in kinds:
        _require(path, "chunk", chunk, _range_names(kind), "float")
    return kinds


def _ranges(chunk: NDArray[np.void], kinds: Sequence[str]) -> dict[str, tuple[Floats, Floats]]:
    """Return, by kind, the minima and the maxima of each chunk, (C, 3) each. Colours
    without ranges have the range from 0 to 1."""
    shape = (len(chunk), 3)
    ranges: dict[str, tuple[Floats, Floats]] = {"color": (np.zeros(shape), np.ones(shape))}
    for kind in kinds:
        with np.errstate(invalid="ignore"):  # values may be signalling NaN
            values = np.stack([chunk[name] for name in _range_names(kind)], axis=1).astype(
                np.float64
            )
        ranges[kind] = (values[:, :3], values[:, 3:])
    return ranges


def _degree(path: AnyPath, sh: _Element | None, count: int) -> int:
    if sh is None:
        return 0
    names = [f"f_rest_{i}" for i in range(len(sh.kinds))]
    num_coefficients, remainder = divmod(len(names), 3)
    is_known = remainder == 0 and num_coefficients in _packing.DEGREES
    check(
        path, is_known, f"0, 9, 24 or 45 properties f_rest_* (SH degree 0 to 3), got {len(names)}"
    )
    _require(path, "sh", sh, names, "uchar")
    check(path, sh.count == count, f"{count} rows in element sh, as in vertex, got {sh.count}")
    return _packing.DEGREES[num_coefficients]


def _require(path: AnyPath, label: str, element: _Element, names: Sequence[str], kind: str) -> None:
    for name in names:
        check(
            path,
            element.kinds.get(name) == kind,
            f"'property {kind} {name}' in element {label}, but it is missing or has another type",
        )


def _elements(file: File) -> dict[str, _Element]:
    """Return the elements in the header of a file, in order, with the offsets of their
    rows."""
    path = file.path
    encoding, offset, header = _core.ply_header(path)
    is_little = encoding == "binary_little_endian"
    check(
        path, is_little, f"'format binary_little_endian 1.0' in a compressed .ply, got {encoding}"
    )
    elements: dict[str, _Element] = {}
    for name, count, properties in header:
        label = f"element {name[:40]!a}"
        kinds = dict(properties)
        unknown_kind = next((kind for kind in kinds.values() if kind not in _PLY_TYPES), None)
        check(
            path,
            unknown_kind is None,
            f"'property float|uint|uchar NAME' in {label}, got {unknown_kind}",
        )
        is_unique = name not in elements and 0 < len(kinds) == len(properties)
        check(
            path,
            is_unique,
            f"properties of {label} with distinct names, got repeated names or no properties",
        )
        dtype = np.dtype([(key, _PLY_TYPES[kind]) for key, kind in properties])
        num_bytes = count * dtype.itemsize
        remaining = file.num_bytes - offset
        expected = f"{count} rows of {label} with {dtype.itemsize} bytes each"
        check(path, num_bytes <= remaining, f"{expected}, got {remaining} bytes")
        elements[name] = _Element(kinds, dtype, count, offset)
        offset += num_bytes
    check(
        path,
        offset == file.num_bytes,
        f"a file that ends after {offset} bytes, as its header says, got one of {file.num_bytes}",
    )
    return elements
