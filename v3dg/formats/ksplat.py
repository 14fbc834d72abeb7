"""`.ksplat`, of mkkellogg's viewer: sections of gaussians, at three levels of compression.

After a header of 4,096 bytes come headers of 1,024 bytes a section, then the sections' data: for compression
1 and 2 the sizes of buckets that are not full and the buckets' centres, then the gaussians. A gaussian is its
mean (float32, or 16 bits a coordinate around its bucket's centre), its scales and its quaternion w x y z
(float32 or half precision), red, green, blue and opacity (bytes), and higher SH (float32, half precision, or
bytes for the range in the header), band by band and there channel by channel. See docs/formats.md.
"""

import math
import os
import struct
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import SH_C0, Floats, assemble
from v3dg.formats._reading import AssetFile, Claims, Path, check, whole_file
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_MAX_SECTIONS = 1 << 16
# By compression: types of a mean's coordinates, of scales and quaternions, and of higher SH.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_SH_RANGE = (-1.5, 1.5)  # where the header gives none
_DEFAULT_STEPS = 32767  # of a bucket's half side
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")
# Of each gaussian's bucket (N, 3), world units of a step, and steps from a corner to the centre.
_Centers: TypeAlias = tuple[NDArray[Any], float, int]


def open_file(path: Path) -> AssetFile:
    """Open a `.ksplat` file; all of it is read with its first rows."""
    with Claims().open(path) as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(min(size, _HEADER_BYTES + _MAX_SECTIONS * _SECTION_BYTES))
    headers, degree, _ = _headers(path, start)
    return whole_file(path, sum(header[0] for header in headers), degree, read)


def read(path: Path) -> Gaussians:
    """Read a `.ksplat` file of version 0.1 and later, of SH degree 0 to 2."""
    content = Claims().read(path)
    headers, degree, compression = _headers(path, content)
    low, high = struct.unpack_from("<ff", content, 36)
    sh_range = (low, high) if low < high else _SH_RANGE
    offset = _HEADER_BYTES + len(headers) * _SECTION_BYTES
    parts = []
    for i, header in enumerate(headers):
        rows, centers, offset = _section(path, content, i, header, offset, compression)
        parts.append(_decoded(rows, centers, degree, sh_range))
    return parts[0] if len(parts) == 1 else Gaussians.concatenate(parts or [assemble(0, 0, lambda rows: ())])


def _headers(path: Path, content: bytes) -> tuple[list[tuple[Any, ...]], int, int]:
    """Those of the sections, which are at the start; the SH degree, and the compression."""
    given = len(content)
    check(path, given >= _HEADER_BYTES, f"a header of {_HEADER_BYTES} bytes, got {given}")
    major, minor, num_sections, count, compression = struct.unpack_from("<BB2xI8xIH", content)
    is_known, found = major == 0 < minor and compression <= 2, f"{major}.{minor}, {compression}"
    check(path, is_known, f".ksplat 0.1 or later and compression 0 to 2, got {found}")
    has_headers = num_sections <= min(_MAX_SECTIONS, (given - _HEADER_BYTES) // _SECTION_BYTES)
    check(path, has_headers, f"headers of {num_sections} sections, got {given} bytes")
    end = _HEADER_BYTES + num_sections * _SECTION_BYTES
    headers = [_SECTION.unpack_from(content, start) for start in range(_HEADER_BYTES, end, _SECTION_BYTES)]
    total, degree = sum(header[0] for header in headers), max((header[-1] for header in headers), default=0)
    check(path, total == count, f"{count} gaussians in the sections, got {total}")
    check(path, degree <= 2, f"SH degree 0 to 2, got {degree}")
    return headers, degree, compression


def _section(
    path: Path, content: bytes, i: int, header: tuple[Any, ...], offset: int, compression: int
) -> tuple[NDArray[np.void], _Centers | None, int]:
    """A section's rows, where their buckets are, and its end; sections follow each other."""
    position, parts, higher = _TYPES[compression]
    count, room, capacity, num_buckets, side, bucket_bytes, steps, num_full, num_partial, degree = header
    check(path, count <= room, f"at most {room} gaussians in section {i}, got {count}")
    formats = [(position, 3), (parts, 3), (parts, 4), ("u1", 4), (higher, 3 * ((degree + 1) ** 2 - 1))]
    record = np.dtype({"names": ("mean", "scale", "quat", "rgba", "sh"), "formats": formats})
    buckets = offset + 4 * num_partial
    first = buckets + bucket_bytes * num_buckets
    end = first + record.itemsize * room
    check(path, end <= len(content), f"section {i} to end within {len(content)} bytes, got {end}")
    rows = np.frombuffer(content, record, count, first)
    if not compression:
        return rows, None, end
    partial = np.frombuffer(content, "<u4", num_partial, offset).astype(np.int64)
    used = num_full + num_partial
    fits = bucket_bytes >= 12 and used <= num_buckets
    check(path, fits, f"{num_buckets} buckets in section {i}, got {used}")
    sizes = np.concatenate([np.full(num_full, capacity, np.int64), partial])
    ends = np.cumsum(np.minimum(sizes, count))
    is_filled = not count or (len(ends) and ends[-1] >= count)
    check(path, is_filled, f"buckets for {count} gaussians in section {i}, got fewer")
    bucket = np.searchsorted(ends, np.arange(count), side="right")
    points = np.frombuffer(content, np.dtype((np.void, bucket_bytes)), num_buckets, buckets)
    centers = np.ndarray((num_buckets, 3), "<f4", points, strides=(bucket_bytes, 4))[bucket]
    steps = steps or _DEFAULT_STEPS
    return rows, (centers, side / 2 / steps, steps), end


def _decoded(
    records: NDArray[np.void], centers: _Centers | None, degree: int, sh_range: tuple[float, float]
) -> Gaussians:
    """The gaussians of a section, with zeros for the coefficients that others have beyond its degree."""

    def decode(block: slice) -> tuple[Floats, ...]:
        rows = records[block]
        means = rows["mean"].astype(np.float64)
        if centers is not None:
            of_buckets, scale, steps = centers
            means = (means - steps) * scale + of_buckets[block]
        rgba = rows["rgba"] / 255.0
        higher = rows["sh"].astype(np.float64)
        if rows.dtype["sh"].base == np.uint8:
            higher = sh_range[0] + higher / 255.0 * (sh_range[1] - sh_range[0])
        sh = np.zeros((len(rows), (degree + 1) ** 2, 3))
        sh[:, 0] = (rgba[:, :3] - 0.5) / SH_C0
        for band in range(1, math.isqrt(1 + higher.shape[1] // 3)):
            first, last = band**2, (band + 1) ** 2
            of_band = higher[:, 3 * (first - 1) : 3 * (last - 1)]  # channel by channel
            sh[:, first:last] = of_band.reshape(-1, 3, last - first).transpose(0, 2, 1)
        return means, normalised(rows["quat"]), rows["scale"], rgba[:, 3], sh

    return assemble(len(records), degree, decode)
