"""`.spz`, of Niantic: about 20 bytes a gaussian before compression, fixed-point positions.

Versions 1 to 3 are one gzip stream: a header of 16 bytes, then positions, opacities, colours, scales,
rotations and higher SH, each for all gaussians. Version 4 is a header of 32 bytes, a table of sizes and a
zstd stream an attribute. Version 1 has positions in half precision, 1 and 2 quaternions without w.
Coordinates are passed on as they are stored. See docs/formats.md.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg.formats._packing import (
    Floats,
    assemble,
    blocks,
    check_writable,
    log_scales,
    normalised,
    opacity_bytes,
    quats_from_three,
    three_of_quats,
    to_integers,
)
from v3dg.formats._reading import Claims, least_bytes, problem, telling
from v3dg.gaussians import Gaussians

_MAGIC = 0x5053474E  # NGSP
_HEADER = struct.Struct("<IIIBBBB")
_ZSTD_HEADER_BYTES = 32
_STREAM_SIZES = struct.Struct("<QQ")
_MAX_TRAILER = 1 << 20  # bytes after the attributes, which vendors' extensions may take
_COLOR_SCALE = 0.15
_SQRT2 = math.sqrt(2.0)
_LARGEST_FIXED = (1 << 23) - 1


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.spz` file of version 1 to 4.

    Raises:
        ValueError: It is none, incomplete, or of a higher version or SH degree.
        OSError: It cannot be read.
    """
    claims = Claims()
    content = claims.read(path)
    if content[:2] == b"\x1f\x8b":
        return _decode(*_sections_of_gzip(path, content, claims))
    if content[:4] == _MAGIC.to_bytes(4, "little"):
        return _decode(*_sections_of_zstd(path, content, claims))
    raise problem(path, f"expected a .spz file, which begins with 1f 8b or NGSP, got {content[:4].hex(' ')}")


def write(path: str | os.PathLike[str], gaussians: Gaussians) -> None:
    """Write a `.spz` file of version 3, which all readers know; the order stays.

    Raises:
        ValueError: A value that the format cannot hold.
        OSError: It cannot be written.
    """
    host = check_writable(gaussians)
    reach = float(np.abs(host.means).max(initial=0.0))
    bits = _fraction_bits(reach)
    if reach * 2**bits > _LARGEST_FIXED:
        raise ValueError(f"means: expected coordinates within ±{_LARGEST_FIXED} for .spz, got {reach:g}")
    compressor = zlib.compressobj(6, zlib.DEFLATED, 31)
    with _files.replacing(path) as temporary, open(temporary, "wb") as file:

        def put(section: bytes) -> None:
            file.write(compressor.compress(section))

        put(_HEADER.pack(_MAGIC, 3, len(host), host.sh_degree, bits, 0, 0))
        for block in blocks(len(host)):
            fixed = np.rint(host.means[block].astype(np.float64) * 2**bits).astype("<i4")
            put(fixed.view(np.uint8).reshape(-1, 4)[:, :3].tobytes())
        for block in blocks(len(host)):
            put(opacity_bytes(host.opacities[block]).astype(np.uint8).tobytes())
        for block in blocks(len(host)):
            put(_bytes((host.sh[block, 0] * _COLOR_SCALE + 0.5) * 255.0))
        for block in blocks(len(host)):
            put(_bytes((log_scales(host.scales[block]) + 10.0) * 16.0))
        for block in blocks(len(host)):
            put(_rotation_words(host.quats[block]))
        for block in blocks(len(host)):
            put(_bytes(host.sh[block, 1:] * 128.0 + 128.0))
        file.write(compressor.flush())
        # Gaussians that are all alike take too little to be believed; gzip passes over zeros at the end.
        file.write(bytes(max(0, least_bytes(len(host)) - file.tell())))


def _bytes(values: Floats) -> bytes:
    return to_integers(values, 255).astype(np.uint8).tobytes()


def _fraction_bits(reach: float) -> int:
    """Bits after the point: 12, as Niantic's writer has it, but 2^-17 of the largest coordinate at most."""
    whole = math.ceil(math.log2(reach)) if reach > 0 else 0
    return max(0, min(max(12, 17 - whole), 22 - whole, 24))


def _rotation_words(quats: Floats) -> bytes:
    # Components are numbered x y z w here.
    three, largest = three_of_quats(np.roll(quats, -1, axis=1))
    magnitude = to_integers(np.abs(three) * _SQRT2 * 511.0, 511)
    words = largest.astype("<u4")
    for column in range(3):
        field = magnitude[:, column] | ((three[:, column] < 0).astype(np.uint32) << 9)
        words = (words << 10) | field
    return words.astype("<u4").tobytes()


def _decode(version: int, degree: int, fraction_bits: int, sections: list[memoryview]) -> Gaussians:
    count = len(sections[1])

    def rows(section: memoryview, dtype: str, width: int) -> NDArray[Any]:
        return np.frombuffer(section, dtype).reshape(count, width)

    positions, opacities = sections[0], rows(sections[1], "u1", 1)
    colors, scales = rows(sections[2], "u1", 3), rows(sections[3], "u1", 3)
    rotations, rest = (
        rows(sections[4], "u1", 4 if version >= 3 else 3),
        rows(sections[5], "u1", -1 if count else 0),
    )

    def means(block: slice) -> Floats:
        if version == 1:
            return rows(positions, "<f2", 3)[block].astype(np.float64)
        three = rows(positions, "u1", 9)[block].reshape(-1, 3, 3).astype(np.int32)
        fixed = three[:, :, 0] | (three[:, :, 1] << 8) | (three[:, :, 2] << 16)
        return ((fixed ^ 0x800000) - 0x800000) / float(1 << fraction_bits)

    def decode(block: slice) -> tuple[Floats, ...]:
        color = (colors[block] / 255.0 - 0.5) / _COLOR_SCALE
        higher = (rest[block].astype(np.float64) - 128.0) / 128.0
        sh = np.concatenate([color[:, None], higher.reshape(len(color), -1, 3)], axis=1)
        log = scales[block] / 16.0 - 10.0
        quats = _quats(rotations[block])
        return means(block), quats, np.exp(log), opacities[block, 0] / 255.0, sh

    return assemble(count, degree, decode)


def _quats(rotations: NDArray[Any]) -> Floats:
    """w x y z of the words of version 3 and later, or of x y z as bytes."""
    if rotations.shape[1] == 3:
        xyz = rotations / 127.5 - 1.0
        w = np.sqrt(np.maximum(0.0, 1.0 - np.square(xyz).sum(axis=1, keepdims=True)))
        quats = np.concatenate([w, xyz], axis=1)
        return normalised(quats)
    words = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    fields = np.stack([(words >> shift) & 1023 for shift in (20, 10, 0)], axis=1)
    three = np.where(fields & 512, -1.0, 1.0) * (fields & 511) / (511.0 * _SQRT2)
    return np.roll(quats_from_three(three, words >> 30), 1, axis=1)


def _checked_header(
    path: str | os.PathLike[str], header: bytes, claims: Claims
) -> tuple[int, int, int, list[int]]:
    """Version, SH degree, fraction bits, and the bytes of each section."""
    magic, version, count, degree, fraction_bits, _, _ = _HEADER.unpack_from(header)
    if magic != _MAGIC:
        raise problem(path, f"expected .spz, which begins with NGSP, got {header[:4].hex(' ')}")
    if not 1 <= version <= 4:
        raise problem(path, f"expected .spz of version 1 to 4, got {version}")
    if degree > 3:
        raise problem(path, f"expected SH degree 0 to 3, got {degree}")
    if fraction_bits > 24:
        raise problem(path, f"expected at most 24 fraction bits, got {fraction_bits}")
    claims.add(path, count)
    widths = (6 if version == 1 else 9, 1, 3, 3, 4 if version >= 3 else 3, 3 * ((degree + 1) ** 2 - 1))
    return version, degree, fraction_bits, [count * width for width in widths]


def _sections_of_gzip(
    path: str | os.PathLike[str], content: bytes, claims: Claims
) -> tuple[int, int, int, list[memoryview]]:
    stream = zlib.decompressobj(31)
    with telling(path, "a gzip stream that is not damaged"):
        header = stream.decompress(content, _HEADER.size)
    if len(header) < _HEADER.size:
        raise problem(path, f"expected a header of {_HEADER.size} bytes, got {len(header)}")
    version, degree, fraction_bits, sizes = _checked_header(path, header, claims)
    if version > 3:
        raise problem(path, f"expected version 1 to 3 in gzip, got {version}")
    with telling(path, "a gzip stream that is not damaged"):
        # More than needed: a length of 0 would mean no limit.
        body = stream.decompress(stream.unconsumed_tail, sum(sizes) + _MAX_TRAILER)
        if not stream.eof and len(body) >= sum(sizes):
            stream.decompress(stream.unconsumed_tail, 1)  # the checksum may be all that is left
    if len(body) < sum(sizes) or not stream.eof:
        raise problem(
            path, f"expected a gzip stream that ends after {sum(sizes)} bytes of gaussians, got another"
        )
    return version, degree, fraction_bits, _split(body, sizes)


def _sections_of_zstd(
    path: str | os.PathLike[str], content: bytes, claims: Claims
) -> tuple[int, int, int, list[memoryview]]:
    import zstandard

    if len(content) < _ZSTD_HEADER_BYTES:
        raise problem(path, f"expected a header of {_ZSTD_HEADER_BYTES} bytes, got {len(content)}")
    version, degree, fraction_bits, sizes = _checked_header(path, content, claims)
    if version < 4:
        raise problem(path, f"expected version {version} in a gzip stream, got it outside of one")
    num_streams, table = content[15], int.from_bytes(content[16:20], "little")
    wanted = sizes if degree else sizes[:-1]
    first = table + num_streams * _STREAM_SIZES.size
    if num_streams != len(wanted) or table < _ZSTD_HEADER_BYTES or first > len(content):
        raise problem(
            path, f"expected a table of {len(wanted)} streams after the header, got {num_streams} at {table}"
        )
    sections = []
    for i, size in enumerate(wanted):
        packed, expanded = _STREAM_SIZES.unpack_from(content, table + i * _STREAM_SIZES.size)
        if expanded != size or packed > len(content) - first:
            raise problem(
                path, f"expected {size} bytes in stream {i}, got {expanded} of {packed} in the file"
            )
        with telling(path, "a zstd stream that is not damaged"):
            reader = zstandard.ZstdDecompressor().stream_reader(content[first : first + packed])
            section = reader.read(size + 1)
        if len(section) != size:
            raise problem(path, f"expected {size} bytes in stream {i}, got another number")
        sections.append(memoryview(section))
        first += packed
    return version, degree, fraction_bits, [*sections, memoryview(b"")][:6]


def _split(body: bytes, sizes: list[int]) -> list[memoryview]:
    ends = np.cumsum(sizes).tolist()
    return [memoryview(body)[end - size : end] for size, end in zip(sizes, ends, strict=True)]
