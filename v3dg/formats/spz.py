"""`.spz`, of Niantic: about 20 bytes a gaussian before compression, fixed-point
positions.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then positions, opacities,
colours, scales, rotations and higher SH, each for all gaussians. Version 4 is a header
of 32 bytes, a table of sizes and a zstd stream an attribute. Version 1 has positions in
half precision, 1 and 2 quaternions without w. Coordinates are passed on as they are
stored. See docs/formats.md.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg.formats import _packing
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
"""Bytes that contain the header, also after the optional fields of a gzip header."""
_MAX_TRAILER = 1 << 20  # bytes after the attributes, for extensions of vendors
_COLOR_SCALE = 0.15
_LARGEST_FIXED = (1 << 23) - 1
# Bits of the flags.
_ANTIALIASED = 1
_HAS_EXTENSIONS = 2


class Header(NamedTuple):
    """What the first bytes of a file say."""

    version: int
    sh_degree: int
    fraction_bits: int  # fraction bits of the fixed-point positions
    num_gaussians: int
    flags: int

    @property
    def antialiased(self) -> bool:
        """Whether the gaussians were trained with antialiasing."""
        return bool(self.flags & _ANTIALIASED)

    @property
    def section_bytes(self) -> list[int]:
        """Size of positions, opacities, colours, scales, rotations and higher SH."""
        position_bytes = 9
        if self.version == 1:
            position_bytes = 6
        rotation_bytes = 3
        if self.version >= 3:
            rotation_bytes = 4
        sh_bytes = 3 * ((self.sh_degree + 1) ** 2 - 1)
        widths = (position_bytes, 1, 3, 3, rotation_bytes, sh_bytes)
        return [self.num_gaussians * width for width in widths]


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.spz` file; all of it is read with its first rows."""
    claims = Claims()
    with claims.open(path) as file:
        header = header_of(path, file.read(MAX_START), claims)
    opened = whole_file(path, header.num_gaussians, header.sh_degree, read)
    declared = Declared(antialiased=header.antialiased, notes=flag_notes(header))
    return replace(opened, declared=declared)


def header_of(path: AnyPath, start: bytes | memoryview, claims: Claims) -> Header:
    """The header in the first `MAX_START` bytes of a `.spz` file's content."""
    header = bytes(start)
    if header[:2] == b"\x1f\x8b":
        with value_errors(path, "a gzip stream that is not damaged"):
            header = zlib.decompressobj(31).decompress(header, _HEADER.size)
    return _checked_header(path, header, claims)


def flag_notes(header: Header) -> tuple[str, ...]:
    """Sentences about flags that were not understood."""
    unknown = header.flags & ~(_ANTIALIASED | _HAS_EXTENSIONS)
    if not unknown:
        return ()
    return (f"Its flags {unknown:#04x} are unknown, and are not read.",)


def read(path: AnyPath) -> Gaussians:
    """Read a `.spz` file of version 1 to 4."""
    claims = Claims()
    return decode(path, claims.read(path), claims)


def decode(path: AnyPath, content: bytes, claims: Claims) -> Gaussians:
    """The gaussians of a `.spz` file's content."""
    if content[:2] == b"\x1f\x8b":
        return _decode(*_sections_of_gzip(path, content, claims))
    is_zstd = content[:4] == _MAGIC.to_bytes(4, "little")
    check(
        path, is_zstd, f"a .spz file, which begins with 1f 8b or NGSP, got {content[:4].hex(' ')}"
    )
    return _decode(*_sections_of_zstd(path, content, claims))


def write(path: AnyPath, gaussians: Gaussians, version: int = 3) -> None:
    """Write a `.spz` file of version 2, 3 or 4; the order stays."""
    check("version", version in (2, 3, 4), f"2, 3 or 4 for .spz, got {version}")
    host = _packing.check_writable(gaussians)
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:
        for part in encode(host, version):
            file.write(part)
        # Readers refuse files that are too small for what they claim, and ignore zeros
        # at the end.
        file.write(bytes(max(0, least_bytes(len(host)) - file.tell())))


def encode(host: Gaussians, version: int = 3) -> Iterator[bytes]:
    """Parts of a `.spz` file; ``host`` has passed `check_writable`."""
    reach = float(np.abs(host.means).max(initial=0.0))
    integer_bits = 0
    if reach > 0:
        integer_bits = math.ceil(math.log2(reach))
    # Fraction bits: 12, as in Niantic's writer, or more if a step were above 2^-17 of
    # the largest coordinate.
    bits = max(0, min(max(12, 17 - integer_bits), 22 - integer_bits, 24))
    fits = reach * 2**bits <= _LARGEST_FIXED
    check("means", fits, f"coordinates within ±{_LARGEST_FIXED} for .spz, got {reach:g}")

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
    if host.antialiased:
        flags |= _ANTIALIASED
    header = _HEADER.pack(_MAGIC, version, len(host), host.sh_degree, bits, flags, 0)
    if version == 4:
        if not host.sh_degree:
            del sections[-1]
        yield from _zstd_parts(header, len(host), sections)
        return
    compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
    yield compressor.compress(header)
    for section in sections:
        for rows in _packing.blocks(len(host)):
            yield compressor.compress(section(rows))
    yield compressor.flush()


def _zstd_parts(
    header: bytes, count: int, sections: list[Callable[[slice], bytes]]
) -> Iterator[bytes]:
    """The header, with number of streams and offset of their table; the table of sizes;
    the streams."""
    import zstandard

    raw = [b"".join(map(section, _packing.blocks(count))) for section in sections]
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in raw]
    yield header[:15] + struct.pack("<BI12x", len(raw), _ZSTD_HEADER_BYTES)
    for compressed, stream in zip(packed, raw, strict=True):
        yield _STREAM_SIZES.pack(len(compressed), len(stream))
    yield from packed


def _bytes(values: Floats) -> bytes:
    return _packing.to_integers(values, 255).astype(np.uint8).tobytes()


def _rotation_bytes(quats: Floats) -> bytes:
    """x y z of the quaternion whose w is not negative."""
    unit = normalised(quats)
    return _bytes((unit[:, 1:] * np.where(unit[:, :1] < 0, -1.0, 1.0) + 1.0) * 127.5)


def _rotation_words(quats: Floats) -> bytes:
    # This format numbers components x y z w.
    three, largest = _packing.three_of_quats(np.roll(quats, -1, axis=1))
    magnitude = _packing.to_integers(np.abs(three) * SQRT2 * 511.0, 511)
    fields = magnitude | ((three < 0).astype(np.uint32) << 9)
    words = (largest << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return words.astype("<u4").tobytes()


def _decode(header: Header, sections: list[memoryview]) -> Gaussians:
    count = header.num_gaussians
    positions = np.frombuffer(sections[0], "u1")
    opacities, colors, scales, rotations, higher_sh = (
        np.frombuffer(section, "u1").reshape(count, len(section) // max(1, count))
        for section in sections[1:]
    )

    def means(block: slice) -> Floats:
        if header.version == 1:
            return positions.view("<f2").reshape(-1, 3)[block].astype(np.float64)
        three = positions.reshape(-1, 3, 3)[block].astype(np.int32)
        fixed = three[:, :, 0] | (three[:, :, 1] << 8) | (three[:, :, 2] << 16)
        return ((fixed ^ 0x800000) - 0x800000) / float(1 << header.fraction_bits)

    def decode(block: slice) -> tuple[Floats, ...]:
        color = (colors[block] / 255.0 - 0.5) / _COLOR_SCALE
        higher = (higher_sh[block].astype(np.float64) - 128.0) / 128.0
        sh = np.concatenate([color[:, None], higher.reshape(len(color), -1, 3)], axis=1)
        log_scales = scales[block] / 16.0 - 10.0
        return (
            means(block),
            _quats(rotations[block]),
            np.exp(log_scales),
            opacities[block, 0] / 255.0,
            sh,
        )

    return assemble(count, header.sh_degree, decode)


def _quats(rotations: NDArray[np.uint8]) -> Floats:
    """Quaternions w x y z from words (version 3 and later), or from x y z as bytes."""
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
    check(path, degree <= 3, f"SH degree 0 to 3, got {degree}")
    check(path, fraction_bits <= 24, f"at most 24 fraction bits, got {fraction_bits}")
    claims.add(path, count)
    return Header(version, degree, fraction_bits, count, flags)


def _sections_of_gzip(
    path: AnyPath, content: bytes, claims: Claims
) -> tuple[Header, list[memoryview]]:
    stream = zlib.decompressobj(31)
    with value_errors(path, "a gzip stream that is not damaged"):
        start = stream.decompress(content, _HEADER.size)
    header = _checked_header(path, start, claims)
    check(path, header.version <= 3, f"version 1 to 3 in gzip, got {header.version}")
    sizes = header.section_bytes
    total = sum(sizes)
    with value_errors(path, "a gzip stream that is not damaged"):
        # The limit is never 0, which would mean none.
        body = stream.decompress(stream.unconsumed_tail, total + _MAX_TRAILER)
        if not stream.eof and len(body) >= total:
            # Reads the checksum if nothing else follows.
            stream.decompress(stream.unconsumed_tail, 1)
    is_whole = len(body) >= total and stream.eof
    check(path, is_whole, f"a gzip stream that ends after {total} bytes of gaussians, got another")
    ends = np.cumsum(sizes).tolist()
    sections = [memoryview(body)[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    return header, sections


def _sections_of_zstd(
    path: AnyPath, content: bytes, claims: Claims
) -> tuple[Header, list[memoryview]]:
    import zstandard

    num_bytes = len(content)
    has_header = num_bytes >= _ZSTD_HEADER_BYTES
    check(path, has_header, f"a header of {_ZSTD_HEADER_BYTES} bytes, got {num_bytes}")
    header = _checked_header(path, content, claims)
    check(
        path,
        header.version == 4,
        f"version {header.version} in a gzip stream, got it outside of one",
    )
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
        f"a table of {len(sizes)} streams after the header, got {num_streams} at {table}",
    )
    sections = []
    for i, size in enumerate(sizes):
        packed, expanded = _STREAM_SIZES.unpack_from(content, table + i * _STREAM_SIZES.size)
        fits = expanded == size and packed <= num_bytes - first
        check(path, fits, f"{size} bytes in stream {i}, got {expanded} of {packed} in the file")
        with value_errors(path, "a zstd stream that is not damaged"):
            reader = zstandard.ZstdDecompressor().stream_reader(content[first : first + packed])
            section = reader.read(size + 1)
        check(path, len(section) == size, f"{size} bytes in stream {i}, got another number")
        sections.append(memoryview(section))
        first += packed
    if not header.sh_degree:
        sections.append(memoryview(b""))
    return header, sections
