"""`.spz`, of Niantic: about 20 bytes a gaussian before compression, fixed-point positions.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then positions, opacities, colours, scales,
rotations and higher SH, each for all gaussians. Version 4 is a header of 32 bytes, a table of sizes and a
zstd stream an attribute. Version 1 has positions in half precision, 1 and 2 quaternions without w.
Coordinates are passed on as they are stored. See docs/formats.md.
"""

import math
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg.formats import _packing
from v3dg.formats._packing import SQRT2, Floats, assemble
from v3dg.formats._reading import AssetFile, Claims, Path, check, least_bytes, telling, whole_file
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_MAGIC = 0x5053474E  # NGSP
_HEADER = struct.Struct("<IIIBBBB")
_ZSTD_HEADER_BYTES = 32
_STREAM_SIZES = struct.Struct("<QQ")
_MAX_TRAILER = 1 << 20  # bytes after the attributes, which vendors' extensions may take
_MAX_START = 1 << 16  # bytes in which the header is found, also behind the fields of a gzip stream
_COLOR_SCALE = 0.15
_LARGEST_FIXED = (1 << 23) - 1


def open_file(path: Path) -> AssetFile:
    """Open a `.spz` file; all of it is read with its first rows."""
    claims = Claims()
    with claims.open(path) as file:
        header = file.read(_MAX_START)
    if header[:2] == b"\x1f\x8b":
        with telling(path, "a gzip stream that is not damaged"):
            header = zlib.decompressobj(31).decompress(header, _HEADER.size)
    _, degree, _, sizes = _checked_header(path, header, claims)
    return whole_file(path, sizes[1], degree, read)


def read(path: Path) -> Gaussians:
    """Read a `.spz` file of version 1 to 4."""
    claims = Claims()
    return decode(path, claims.read(path), claims)


def decode(path: Path, content: bytes, claims: Claims) -> Gaussians:
    """The gaussians of a `.spz` file's content."""
    if content[:2] == b"\x1f\x8b":
        return _decode(*_sections_of_gzip(path, content, claims))
    is_zstd = content[:4] == _MAGIC.to_bytes(4, "little")
    check(path, is_zstd, f"a .spz file, which begins with 1f 8b or NGSP, got {content[:4].hex(' ')}")
    return _decode(*_sections_of_zstd(path, content, claims))


def write(path: Path, gaussians: Gaussians, version: int = 3) -> None:
    """Write a `.spz` file of version 2, 3 or 4; the order stays."""
    check("version", version in (2, 3, 4), f"2, 3 or 4 for .spz, got {version}")
    host = _packing.check_writable(gaussians)
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:
        for part in encode(host, version):
            file.write(part)
        # Gaussians that are all alike take too little to be believed; readers pass over zeros at the end.
        file.write(bytes(max(0, least_bytes(len(host)) - file.tell())))


def encode(host: Gaussians, version: int = 3) -> Iterator[bytes]:
    """Parts of a `.spz` file, of NumPy gaussians with values that can be held."""
    reach = float(np.abs(host.means).max(initial=0.0))
    whole = math.ceil(math.log2(reach)) if reach > 0 else 0
    # After the point: 12, as Niantic's writer has it, but 2^-17 of the largest coordinate at most.
    bits = max(0, min(max(12, 17 - whole), 22 - whole, 24))
    fits = reach * 2**bits <= _LARGEST_FIXED
    check("means", fits, f"coordinates within ±{_LARGEST_FIXED} for .spz, got {reach:g}")

    def fixed(rows: slice) -> bytes:
        numbers = np.rint(host.means[rows].astype(np.float64) * 2**bits).astype("<i4")
        return bytes(numbers.view(np.uint8).reshape(-1, 4)[:, :3].tobytes())

    rotations = _rotation_bytes if version == 2 else _rotation_words
    sections: list[Callable[[slice], bytes]] = [
        fixed,
        lambda rows: _packing.opacity_bytes(host.opacities[rows]).astype(np.uint8).tobytes(),
        lambda rows: _bytes((host.sh[rows, 0] * _COLOR_SCALE + 0.5) * 255.0),
        lambda rows: _bytes((_packing.log_scales(host.scales[rows]) + 10.0) * 16.0),
        lambda rows: rotations(host.quats[rows]),
        lambda rows: _bytes(host.sh[rows, 1:] * 128.0 + 128.0),
    ]
    header = _HEADER.pack(_MAGIC, version, len(host), host.sh_degree, bits, 0, 0)
    if version == 4:
        yield from _zstd_parts(header, len(host), sections if host.sh_degree else sections[:-1])
        return
    compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
    yield compressor.compress(header)
    for section in sections:
        for rows in _packing.blocks(len(host)):
            yield compressor.compress(section(rows))
    yield compressor.flush()


def _zstd_parts(header: bytes, count: int, sections: list[Callable[[slice], bytes]]) -> Iterator[bytes]:
    """The header with the number of streams and the place of the table of their sizes, the table, streams."""
    import zstandard

    raw = [b"".join(map(section, _packing.blocks(count))) for section in sections]
    packed = [zstandard.ZstdCompressor(level=12).compress(stream) for stream in raw]
    yield header[:15] + struct.pack("<BI12x", len(raw), _ZSTD_HEADER_BYTES)
    yield b"".join(_STREAM_SIZES.pack(len(a), len(b)) for a, b in zip(packed, raw, strict=True))
    yield from packed


def _bytes(values: Floats) -> bytes:
    return _packing.to_integers(values, 255).astype(np.uint8).tobytes()


def _rotation_bytes(quats: Floats) -> bytes:
    """x y z of the quaternion whose w is not negative."""
    unit = normalised(quats)
    return _bytes((unit[:, 1:] * np.where(unit[:, :1] < 0, -1.0, 1.0) + 1.0) * 127.5)


def _rotation_words(quats: Floats) -> bytes:
    # Components are numbered x y z w here.
    three, largest = _packing.three_of_quats(np.roll(quats, -1, axis=1))
    magnitude = _packing.to_integers(np.abs(three) * SQRT2 * 511.0, 511)
    fields = magnitude | ((three < 0).astype(np.uint32) << 9)
    words = (largest << 30) | (fields[:, 0] << 20) | (fields[:, 1] << 10) | fields[:, 2]
    return words.astype("<u4").tobytes()


def _decode(version: int, degree: int, fraction_bits: int, sections: list[memoryview]) -> Gaussians:
    count = len(sections[1])
    positions = np.frombuffer(sections[0], "u1")
    opacities, colors, scales, rotations, rest = (
        np.frombuffer(section, "u1").reshape(count, len(section) // max(1, count)) for section in sections[1:]
    )

    def means(block: slice) -> Floats:
        if version == 1:
            return positions.view("<f2").reshape(-1, 3)[block].astype(np.float64)
        three = positions.reshape(-1, 3, 3)[block].astype(np.int32)
        fixed = three[:, :, 0] | (three[:, :, 1] << 8) | (three[:, :, 2] << 16)
        return ((fixed ^ 0x800000) - 0x800000) / float(1 << fraction_bits)

    def decode(block: slice) -> tuple[Floats, ...]:
        color = (colors[block] / 255.0 - 0.5) / _COLOR_SCALE
        higher = (rest[block].astype(np.float64) - 128.0) / 128.0
        sh = np.concatenate([color[:, None], higher.reshape(len(color), -1, 3)], axis=1)
        log = scales[block] / 16.0 - 10.0
        return means(block), _quats(rotations[block]), np.exp(log), opacities[block, 0] / 255.0, sh

    return assemble(count, degree, decode)


def _quats(rotations: NDArray[Any]) -> Floats:
    """w x y z of the words of version 3 and later, or of x y z as bytes."""
    if rotations.shape[1] == 3:
        xyz = rotations / 127.5 - 1.0
        return normalised(_packing.quats_from_three(xyz, np.zeros(len(xyz), np.intp)))
    words = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    three = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511.0 * SQRT2)
    return np.roll(_packing.quats_from_three(three, words >> 30), 1, axis=1)


def _checked_header(path: Path, header: bytes, claims: Claims) -> tuple[int, int, int, list[int]]:
    """Version, SH degree, fraction bits, and the bytes of each section."""
    check(path, len(header) >= _HEADER.size, f"a header of {_HEADER.size} bytes, got {len(header)}")
    magic, version, count, degree, fraction_bits, _, _ = _HEADER.unpack_from(header)
    check(path, magic == _MAGIC, f".spz, which begins with NGSP, got {header[:4].hex(' ')}")
    check(path, 1 <= version <= 4, f".spz of version 1 to 4, got {version}")
    check(path, degree <= 3, f"SH degree 0 to 3, got {degree}")
    check(path, fraction_bits <= 24, f"at most 24 fraction bits, got {fraction_bits}")
    claims.add(path, count)
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))
    return version, degree, fraction_bits, [count * width for width in widths]


def _sections_of_gzip(path: Path, content: bytes, claims: Claims) -> tuple[int, int, int, list[memoryview]]:
    stream = zlib.decompressobj(31)
    with telling(path, "a gzip stream that is not damaged"):
        header = stream.decompress(content, _HEADER.size)
    version, degree, fraction_bits, sizes = _checked_header(path, header, claims)
    check(path, version <= 3, f"version 1 to 3 in gzip, got {version}")
    total = sum(sizes)
    with telling(path, "a gzip stream that is not damaged"):
        # More than needed: a length of 0 would mean no limit.
        body = stream.decompress(stream.unconsumed_tail, total + _MAX_TRAILER)
        if not stream.eof and len(body) >= total:
            stream.decompress(stream.unconsumed_tail, 1)  # the checksum may be all that is left
    is_whole = len(body) >= total and stream.eof
    check(path, is_whole, f"a gzip stream that ends after {total} bytes of gaussians, got another")
    ends = np.cumsum(sizes).tolist()
    sections = [memoryview(body)[end - size : end] for size, end in zip(sizes, ends, strict=True)]
    return version, degree, fraction_bits, sections


def _sections_of_zstd(path: Path, content: bytes, claims: Claims) -> tuple[int, int, int, list[memoryview]]:
    import zstandard

    size, given = _ZSTD_HEADER_BYTES, len(content)
    check(path, given >= size, f"a header of {size} bytes, got {given}")
    version, degree, fraction_bits, sizes = _checked_header(path, content, claims)
    check(path, version == 4, f"version {version} in a gzip stream, got it outside of one")
    num_streams, table = content[15], int.from_bytes(content[16:20], "little")
    wanted = sizes if degree else sizes[:-1]
    first = table + num_streams * _STREAM_SIZES.size
    is_there = num_streams == len(wanted) and table >= _ZSTD_HEADER_BYTES and first <= given
    check(path, is_there, f"a table of {len(wanted)} streams after the header, got {num_streams} at {table}")
    sections = []
    for i, size in enumerate(wanted):
        packed, expanded = _STREAM_SIZES.unpack_from(content, table + i * _STREAM_SIZES.size)
        fits = expanded == size and packed <= given - first
        check(path, fits, f"{size} bytes in stream {i}, got {expanded} of {packed} in the file")
        with telling(path, "a zstd stream that is not damaged"):
            reader = zstandard.ZstdDecompressor().stream_reader(content[first : first + packed])
            section = reader.read(size + 1)
        check(path, len(section) == size, f"{size} bytes in stream {i}, got another number")
        sections.append(memoryview(section))
        first += packed
    return version, degree, fraction_bits, [*sections, memoryview(b"")][:6]
