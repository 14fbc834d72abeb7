"""`.spz`, of Niantic: about 20 bytes per gaussian before compression, with fixed-point
positions.

Versions 1 to 3 are one gzip stream. It has a header of 16 bytes, then positions,
opacities, colours, scales, rotations and higher SH, each for all gaussians. Version 4
has a header of 32 bytes, a table of sizes, and one zstd stream for each attribute.
Version 1 stores positions in half precision. Versions 1 and 2 store quaternions without
w.

The axes are right, up, back, unless the extension SPZ_ADOBE_coordinate_system declares
others. Some programs store the axes of `.ply` without declaring them. If the gaussians
contain a ground, it shows which axes they have. See docs/formats.md.
"""

import itertools
import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg.cameras import Axis
from v3dg.formats import _axes, _packing
from v3dg.formats._declared import Declared
from v3dg.formats._packing import SQRT2, Floats, assemble
from v3dg.formats._reading import (
    AnyPath,
    AssetFile,
    Claims,
    check,
    least_bytes,
    value_errors,
    whole_file,
)
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_MAGIC = 0x5053474E  # NGSP
_HEADER = struct.Struct("<IIIBBBB")
_ZSTD_HEADER_BYTES = 32
_STREAM_SIZES = struct.Struct("<QQ")
MAX_START = 1 << 16
"""The header is always within this number of bytes from the start of the file, even
after the optional fields of a gzip header."""
# Maximum number of bytes that are read of the extensions of vendors, which follow the
# attributes. A small compressed stream could otherwise expand to any size.
_MAX_TRAILER = 1 << 20
_COLOR_SCALE = 0.15
_MAX_DEGREE = 3  # coefficients of degree 4 are dropped
_LARGEST_FIXED = (1 << 23) - 1
# Bits of the flags.
_ANTIALIASED = 1
_HAS_EXTENSIONS = 2
_MOST_POINTS = 100_000  # number of points that are used to detect a ground
# The type of an extension and the number of bytes that follow.
_EXTENSION = struct.Struct("<II")
_AXES_EXTENSION = 0xADBE0003  # SPZ_ADOBE_coordinate_system
# The axes by their number in SPZ_ADOBE_coordinate_system, as defined by version 4 of
# Niantic's library.
_AXES = (
    *("", "LDB", "RDB", "LUB", "RUB", "LDF", "RDF", "LUF", "RUF"),
    *("LFD", "RFD", "LFU", "RFU", "LBD", "RBD", "LBU", "RBU"),
)
# The axes in files of programs that store gaussians unchanged, by the axis that points
# up.
_STORED_AXES: dict[Axis, str] = {"y": _axes.OPENGL, "-y": _axes.MEMORY, "z": _axes.Z_UP}


LIMITS = _packing.Limits(
    log_scale=(-10.0, -10.0 + 255 / 16),
    color=(-0.5 / _COLOR_SCALE, 0.5 / _COLOR_SCALE),
    harmonic=(-1.0, 127.5 / 128),
)
"""The ranges of values in the format. They are extended by half a step if values beyond
the range are rounded into it."""


class Header(NamedTuple):
    """The header of a file."""

    version: int
    stored_degree: int  # degree of the spherical harmonics, 0 to 4
    fraction_bits: int  # number of fraction bits of the fixed-point positions
    num_gaussians: int
    flags: int

    @property
    def sh_degree(self) -> int:
        """The SH degree that is read."""
        return min(self.stored_degree, _MAX_DEGREE)

    @property
    def antialiased(self) -> bool:
        """Whether the gaussians were trained with antialiasing."""
        return bool(self.flags & _ANTIALIASED)

    @property
    def section_bytes(self) -> list[int]:
        """The sizes in bytes of positions, opacities, colours, scales, rotations and
        higher SH."""
        position_bytes = 9
        if self.version == 1:
            position_bytes = 6
        rotation_bytes = 3
        if self.version >= 3:
            rotation_bytes = 4
        sh_bytes = 3 * ((self.stored_degree + 1) ** 2 - 1)
        widths = (position_bytes, 1, 3, 3, rotation_bytes, sh_bytes)
        return [self.num_gaussians * width for width in widths]


@dataclass(frozen=True, eq=False)
class _Content:
    """The decompressed content of a file."""

    header: Header
    sections: list[memoryview]
    extensions: bytes  # records, each with a type, a length and a payload


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.spz` file of version 1 to 4 and decompress it. The first read decodes
    all gaussians."""
    claims = Claims()
    content = _expanded(path, claims.read(path), claims)
    axes, reason, is_guessed = _axes_of(path, content)

    def read(_: AnyPath) -> Gaussians:
        return _axes.turned(_decode(content), axes, _axes.MEMORY)

    header = content.header
    notes = _notes(content)
    declared = Declared(_axes.MEMORY_UP, reason, header.antialiased, notes, is_guessed)
    return whole_file(path, header.num_gaussians, header.sh_degree, read, declared=declared)


def header_of(path: AnyPath, start: bytes | memoryview, claims: Claims) -> Header:
    """Return the header of a `.spz` file, given the first `MAX_START` bytes of the
    file."""
    header = bytes(start)
    if header[:2] == b"\x1f\x8b":
        with value_errors(path, "a gzip stream that is not damaged"):
            header = zlib.decompressobj(31).decompress(header, _HEADER.size)
    return _checked_header(path, header, claims)


def decode(path: AnyPath, content: bytes, claims: Claims, axes: str, target: str) -> Gaussians:
    """Return the gaussians of a `.spz` file with this content, converted to the axes
    ``target``. The file has the axes that it records. Without a record, it has
    ``axes``."""
    expanded = _expanded(path, content, claims)
    return _axes.turned(_decode(expanded), _recorded_axes(path, expanded) or axes, target)


def _expanded(path: AnyPath, content: bytes, claims: Claims) -> _Content:
    if content[:2] == b"\x1f\x8b":
        return _sections_of_gzip(path, content, claims)
    is_zstd = content[:4] == _MAGIC.to_bytes(4, "little")
    check(
        path, is_zstd, f"a .spz file, which begins with 1f 8b or NGSP, got {content[:4].hex(' ')}"
    )
    return _sections_of_zstd(path, content, claims)


def write(
    path: AnyPath, gaussians: Gaussians, version: int = 3, *, up: Axis = _axes.MEMORY_UP
) -> Gaussians:
    """Write a `.spz` file of version 2, 3 or 4, in the order of the gaussians. `up` is
    the axis of the gaussians that points up. Return the gaussians of the file on the
    host, in the original axes."""
    check("version", version in (2, 3, 4), f"2, 3 or 4 for a .spz file, got {version}")
    written = _packing.check_writable(gaussians)
    host = _axes.turned(written, _axes.axes_of_up(up), _axes.OPENGL)
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:
        for part in encode(host, version, axes=_axes.OPENGL):
            file.write(part)
        # Readers reject files that are too small for their number of gaussians, and
        # ignore zeros at the end.
        file.write(bytes(max(0, least_bytes(len(host)) - file.tell())))
    return written


def encode(host: Gaussians, version: int = 3, *, axes: str = "") -> Iterator[bytes]:
    """Yield the parts of a `.spz` file. ``host`` must have passed `check_writable`. If
    ``axes`` is not empty, the file declares these axes."""
    bits = _fraction_bits(host.means)

    def fixed(rows: slice) -> bytes:
        numbers = np.rint(host.means[rows].astype(np.float64) * 2**bits).astype("<i4")
        return bytes(numbers.view(np.uint8).reshape(-1, 4)[:, :3].tobytes())

    rotations = _rotation_words
    if version == 2:
        rotations = _rotation_bytes
    sections: list[Callable[[slice], bytes]] = [
        fixed,
        lambda rows: _packing.opacity_bytes(host.opacities[rows]).astype(np.uint8).tobytes(),
        lambda rows: _bytes((host.sh[rows, 0] * _COLOR_SCALE + 0.5) * 255.0),
        lambda rows: _bytes((_packing.log_scales(host.scales[rows]) + 10.0) * 16.0),
        lambda rows: rotations(host.quats[rows]),
        lambda rows: _bytes(host.sh[rows, 1:] * 128.0 + 128.0),
    ]
    flags = 0
    extensions = b""
    if host.antialiased:
        flags |= _ANTIALIASED
    if axes:
        flags |= _HAS_EXTENSIONS
        extensions = _EXTENSION.pack(_AXES_EXTENSION, 4) + struct.pack("<I", _AXES.index(axes))
    header = _HEADER.pack(_MAGIC, version, len(host), host.sh_degree, bits, flags, 0)
    if version == 4:
        if not host.sh_degree:
            del sections[-1]
        yield from _zstd_parts(header, extensions, len(host), sections)
        return
    compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
    yield compressor.compress(header)
    for section in sections:
        for rows in _packing.blocks(len(host)):
            yield compressor.compress(section(rows))
    yield compressor.compress(extensions)
    yield compressor.flush()


def _fraction_bits(means: NDArray[np.float32]) -> int:
    """Return the number of fraction bits. It is 12, as in Niantic's writer, or more if
    one step would exceed 2^-17 of the largest coordinate."""
    reach = float(np.abs(means).max(initial=0.0))
    integer_bits = 0
    if reach > 0:
        integer_bits = math.ceil(math.log2(reach))
    bits = max(0, min(max(12, 17 - integer_bits), 22 - integer_bits, 24))
    fits = reach * 2**bits <= _LARGEST_FIXED
    check("means", fits, f"coordinates within ±{_LARGEST_FIXED} for .spz, got {reach:g}")
    return bits


def _zstd_parts(
    header: bytes, extensions: bytes, count: int, sections: list[Callable[[slice], bytes]]
) -> Iterator[bytes]:
    """Yield the header, which contains the number of streams and the offset of their
    table. Then yield the extensions, the table of sizes, and the streams."""
    import zstandard

    raw = [b"".join(map(section, _packing.blocks(count))) for section in sections]
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in raw]
    yield header[:15] + struct.pack("<BI12x", len(raw), _ZSTD_HEADER_BYTES + len(extensions))
    yield extensions
    for compressed, stream in zip(packed, raw, strict=True):
        yield _STREAM_SIZES.pack(len(compressed), len(stream))
    yield from packed


def _bytes(values: Floats) -> bytes:
    return _packing.to_integers(values, 255).astype(np.uint8).tobytes()


def _rotation_bytes(quats: Floats) -> bytes:
    """Return the components x y z as bytes. Quaternions with a negative w are negated
    first.

    Readers compute w from the other components. If w is small, it depends strongly on
    the bytes. Therefore each component is rounded up or down such that the rotation is
    as close as possible.
    """
    unit = normalised(quats)
    unit = unit * np.where(unit[:, :1] < 0, -1.0, 1.0)
    low = np.floor((unit[:, 1:] + 1.0) * 127.5)
    best = np.zeros((len(unit), 3), np.uint8)
    best_cosine = np.full(len(unit), -1.0)
    for ups in itertools.product((0, 1), repeat=3):
        rounded = np.minimum(low + ups, 255).astype(np.uint8)
        cosine = np.abs((_quats(rounded) * unit).sum(axis=1))
        is_closer = cosine > best_cosine
        best[is_closer] = rounded[is_closer]
        best_cosine[is_closer] = cosine[is_closer]
    return best.tobytes()


def _rotation_words(quats: Floats) -> bytes:
    # SPZ orders the components of a quaternion x y z w.
    three, largest = _packing.three_of_quats(np.roll(quats, -1, axis=1))
    magnitude = _packing.to_integers(np.abs(three) * SQRT2 * 511.0, 511)
    fields = magnitude | ((three < 0).astype(np.uint32) << 9)
    words = (largest << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return words.astype("<u4").tobytes()


def _means(content: _Content, rows: slice) -> Floats:
    """Return the stored positions, (N, 3)."""
    positions = np.frombuffer(content.sections[0], "u1")
    if content.header.version == 1:
        return positions.view("<f2").reshape(-1, 3)[rows].astype(np.float64)
    three = positions.reshape(-1, 3, 3)[rows].astype(np.int32)
    fixed = three[:, :, 0] | (three[:, :, 1] << 8) | (three[:, :, 2] << 16)
    return ((fixed ^ 0x800000) - 0x800000) / float(1 << content.header.fraction_bits)


class _StoredAxes(NamedTuple):
    """The axes of the stored gaussians, and how they were determined, as a phrase."""

    axes: str
    reason: str
    is_guessed: bool = False


def _axes_of(path: AnyPath, content: _Content) -> _StoredAxes:
    recorded = _recorded_axes(path, content)
    if recorded:
        return _StoredAxes(recorded, f"as its record of axes says ({recorded})")
    stride = max(1, content.header.num_gaussians // _MOST_POINTS)
    up = _axes.up_of_ground(_means(content, slice(None, None, stride)))
    if up is None:
        return _StoredAxes(_axes.OPENGL, "as specified for .spz, with y up")
    reason = f"guessed from its ground, which shows that {up} is up in the file"
    return _StoredAxes(_STORED_AXES[up], reason, is_guessed=True)


def _recorded_axes(path: AnyPath, content: _Content) -> str:
    """Return the axes that a file records. Without a record, return an empty text."""
    for kind, payload in _records(content.extensions):
        if kind == _AXES_EXTENSION:
            number = int.from_bytes(payload, "little")
            is_known = len(payload) == 4 and number < len(_AXES)
            expected = (
                f"an axes record with a number from 0 to {len(_AXES) - 1}, got "
                f"{payload[:8].hex(' ')}"
            )
            check(path, is_known, expected)
            if _AXES[number]:
                return _AXES[number]
    return ""


def _records(extensions: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield the type and the payload of each extension."""
    first = 0
    while first + _EXTENSION.size <= len(extensions):
        kind, num_bytes = _EXTENSION.unpack_from(extensions, first)
        first += _EXTENSION.size
        yield kind, extensions[first : first + num_bytes]
        first += num_bytes


def _notes(content: _Content) -> tuple[str, ...]:
    """Return sentences about content of the file that is ignored."""
    extensions = tuple(
        f"Its extension {kind:#010x}, of {len(payload)} bytes, was ignored."
        for kind, payload in _records(content.extensions)
        if kind != _AXES_EXTENSION
    )
    return (*header_notes(content.header), *extensions)


def header_notes(header: Header) -> list[str]:
    """Return sentences about what the header declares and what is ignored."""
    notes = []
    unknown = header.flags & ~(_ANTIALIASED | _HAS_EXTENSIONS)
    if unknown:
        notes.append(f"Its flags {unknown:#04x} are unknown and were ignored.")
    if header.stored_degree > _MAX_DEGREE:
        notes.append(f"Coefficients above SH degree {_MAX_DEGREE} were ignored.")
    return notes


def _decode(content: _Content) -> Gaussians:
    header = content.header
    count = header.num_gaussians
    opacities, colors, scales, rotations, higher_sh = (
        np.frombuffer(section, "u1").reshape(count, len(section) // max(1, count))
        for section in content.sections[1:]
    )

    def decode(block: slice) -> tuple[Floats, ...]:
        color = (colors[block] / 255.0 - 0.5) / _COLOR_SCALE
        higher = (higher_sh[block].astype(np.float64) - 128.0) / 128.0
        sh = np.concatenate([color[:, None], higher.reshape(len(color), -1, 3)], axis=1)
        sh = sh[:, : (header.sh_degree + 1) ** 2]
        log_scales = scales[block] / 16.0 - 10.0
        return (
            _means(content, block),
            _quats(rotations[block]),
            np.exp(log_scales),
            opacities[block, 0] / 255.0,
            sh,
        )

    return assemble(count, header.sh_degree, decode)


def _quats(rotations: NDArray[np.uint8]) -> Floats:
    """Return quaternions w x y z, given words (version 3 or later) or the bytes of x y
    z."""
    if rotations.shape[1] == 3:
        xyz = rotations / 127.5 - 1.0
        return normalised(_packing.quats_from_three(xyz, np.zeros(len(xyz), np.intp)))
    words = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    three = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511.0 * SQRT2)
    return np.roll(_packing.quats_from_three(three, words >> 30), 1, axis=1)


def _checked_header(path: AnyPath, header: bytes, claims: Claims) -> Header:
    check(path, len(header) >= _HEADER.size, f"a header of {_HEADER.size} bytes, got {len(header)}")
    magic, version, count, degree, fraction_bits, flags, _ = _HEADER.unpack_from(header)
    check(path, magic == _MAGIC, f".spz, which begins with NGSP, got {header[:4].hex(' ')}")
    check(path, 1 <= version <= 4, f".spz of version 1 to 4, got {version}")
    check(path, degree <= 4, f"SH degree 0 to 4, got {degree}")
    check(path, fraction_bits <= 24, f"at most 24 fraction bits, got {fraction_bits}")
    claims.add(path, count)
    return Header(version, degree, fraction_bits, count, flags)


def _sections_of_gzip(path: AnyPath, content: bytes, claims: Claims) -> _Content:
    stream = zlib.decompressobj(31)
    with value_errors(path, "a gzip stream that is not damaged"):
        start = stream.decompress(content, _HEADER.size)
    header = _checked_header(path, start, claims)
    check(path, header.version <= 3, f"version 1 to 3 in gzip, got {header.version}")
    sizes = header.section_bytes
    total = sum(sizes)
    with value_errors(path, "a gzip stream that is not damaged"):
        # A limit of 0 would mean no limit, but this one is always positive.
        body = stream.decompress(stream.unconsumed_tail, total + _MAX_TRAILER)
        if not stream.eof and len(body) >= total:
            # One more byte is requested, so that the checksum is read even if nothing
            # follows.
            stream.decompress(stream.unconsumed_tail, 1)
    is_whole = len(body) >= total and stream.eof
    check(
        path,
        is_whole,
        f"a gzip stream that ends after {total} bytes of gaussians, got another; is the file "
        "complete?",
    )
    ends = np.cumsum(sizes).tolist()
    sections = [memoryview(body)[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    extensions = b""
    if header.flags & _HAS_EXTENSIONS:
        extensions = body[total:]
    return _Content(header, sections, extensions)


def _sections_of_zstd(path: AnyPath, content: bytes, claims: Claims) -> _Content:
    import zstandard

    num_bytes = len(content)
    has_header = num_bytes >= _ZSTD_HEADER_BYTES
    check(path, has_header, f"a header of {_ZSTD_HEADER_BYTES} bytes, got {num_bytes}")
    header = _checked_header(path, content, claims)
    check(path, header.version == 4, f"version 4 without gzip, got version {header.version}")
    sizes = header.section_bytes
    if not header.sh_degree:
        del sizes[-1]
    num_streams = content[15]
    table = int.from_bytes(content[16:20], "little")
    first = table + num_streams * _STREAM_SIZES.size
    has_table = num_streams == len(sizes) and table >= _ZSTD_HEADER_BYTES and first <= num_bytes
    check(
        path,
        has_table,
        f"a table of {len(sizes)} streams after the header, got one of {num_streams} at offset "
        f"{table}",
    )
    sections = []
    for i, size in enumerate(sizes):
        packed, expanded = _STREAM_SIZES.unpack_from(content, table + i * _STREAM_SIZES.size)
        fits = expanded == size and packed <= num_bytes - first
        check(path, fits, f"{size} bytes in stream {i}, got {expanded} (compressed: {packed})")
        with value_errors(path, "a zstd stream that is not damaged"):
            reader = zstandard.ZstdDecompressor().stream_reader(content[first : first + packed])
            section = reader.read(size + 1)
        check(path, len(section) == size, f"{size} bytes in stream {i}, got another number")
        sections.append(memoryview(section))
        first += packed
    if not header.sh_degree:
        sections.append(memoryview(b""))
    extensions = b""
    if header.flags & _HAS_EXTENSIONS:
        extensions = content[_ZSTD_HEADER_BYTES:table]
    return _Content(header, sections, extensions)
