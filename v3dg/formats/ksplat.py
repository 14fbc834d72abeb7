"""`.ksplat`, of mkkellogg's viewer: sections of gaussians, with one of three
compression levels, 0 to 2.

The header of the file has 4,096 bytes. A header of 1,024 bytes for each section
follows, then the data of the sections. At levels 1 and 2, the data of a section begin
with the sizes of buckets that are not full and the centres of all buckets. The
gaussians follow. Each has a mean (float32, or 16 bits per coordinate relative to the
centre of its bucket), scales and a quaternion w x y z (float32 or half precision), red,
green, blue and opacity (bytes), and higher SH (float32, half precision, or bytes within
a range from the header), band by band and channel by channel in each band. See
docs/formats.md.
"""

import math
import os
import struct
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._declared import NOTHING, Declared
from v3dg.formats._packing import SH_C0, Floats, assemble
from v3dg.formats._reading import AnyPath, AssetFile, Claims, check, whole_file
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

HEADER_BYTES = 4096
_USED_HEADER_BYTES = 44  # all following bytes are zero
_MINOR = 1  # the newest version is 0.1
_SECTION_BYTES = 1024
_MAX_SECTIONS = 1 << 16
# By compression level: the types of a mean's coordinates, of scales and quaternions,
# and of higher SH.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_SH_RANGE = (-1.5, 1.5)  # used if the header has no range
_DEFAULT_STEPS = 32767  # steps in half a side of a bucket
_SECTION = struct.Struct("<IIIIfH2xI4xIIH")


class _Section(NamedTuple):
    """The header of a section, with its fields in the order of the file."""

    num_gaussians: int
    max_gaussians: int
    bucket_size: int  # number of gaussians in a full bucket
    num_buckets: int
    bucket_side: float  # world units
    bucket_bytes: int
    num_steps: int  # steps in half a side of a bucket; 0 means the default
    num_full_buckets: int
    num_partial_buckets: int
    sh_degree: int


class _Buckets(NamedTuple):
    """The buckets of a section, for means that are stored relative to them."""

    centers: NDArray[np.float32]  # (N, 3) centre of each gaussian's bucket
    step_world: float
    num_steps: int  # steps in half a side of a bucket


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.ksplat` file. The first read loads all of it."""
    with Claims().open(path) as file:
        size = os.fstat(file.fileno()).st_size
        start = file.read(min(size, HEADER_BYTES + _MAX_SECTIONS * _SECTION_BYTES))
    sections, degree, _ = _headers(path, start)
    count = sum(section.num_gaussians for section in sections)
    return whole_file(path, count, degree, read, declared=_declared(start))


def is_start_of_one(start: bytes) -> bool:
    """Return whether the first bytes of a file, at least `HEADER_BYTES`, are a header
    of this format. The format has no magic number, so this requires plausible numbers
    in the header, and zeros after them."""
    if len(start) < HEADER_BYTES or any(start[_USED_HEADER_BYTES:HEADER_BYTES]):
        return False
    major, minor, most_sections, num_sections, _, _, compression = struct.unpack_from(
        "<BB2xIIIIH", start
    )
    is_version = major == 0 < minor
    has_sections = 0 < num_sections <= most_sections <= _MAX_SECTIONS
    return bool(is_version and has_sections and compression <= 2)


def _declared(start: bytes) -> Declared:
    """Return a note if the header has a newer version, whose content may differ from
    what this reader expects."""
    minor = start[1]
    if minor <= _MINOR:
        return NOTHING
    return Declared(notes=(f"Version 0.{minor} was read as version 0.{_MINOR}.",))


def read(path: AnyPath) -> Gaussians:
    """Read a `.ksplat` file of version 0.1 or later with SH degree 0 to 2."""
    content = Claims().read(path)
    sections, degree, compression = _headers(path, content)
    low, high = struct.unpack_from("<ff", content, 36)
    sh_range = _SH_RANGE
    if low < high:
        sh_range = (low, high)
    start = HEADER_BYTES + len(sections) * _SECTION_BYTES
    parts = []
    for i, section in enumerate(sections):
        rows, buckets, start = _section(path, content, start, i, section, compression)
        parts.append(_decoded(rows, buckets, degree, sh_range))
    if not parts:
        return assemble(0, 0, lambda rows: ())
    if len(parts) == 1:
        return parts[0]
    return Gaussians.concatenate(parts)


def _headers(path: AnyPath, content: bytes) -> tuple[list[_Section], int, int]:
    """Return the headers of all sections, the SH degree and the compression level;
    ``content`` is the beginning of a file, or all of it."""
    num_bytes = len(content)
    check(path, num_bytes >= HEADER_BYTES, f"a header of {HEADER_BYTES} bytes, got {num_bytes}")
    major, minor, num_sections, count, compression = struct.unpack_from("<BB2xI8xIH", content)
    is_known = major == 0 < minor and compression <= 2
    kind = f"version {major}.{minor} and compression {compression}"
    check(path, is_known, f".ksplat version 0.1 or later and compression 0 to 2, got {kind}")
    has_headers = num_sections <= min(_MAX_SECTIONS, (num_bytes - HEADER_BYTES) // _SECTION_BYTES)
    check(
        path,
        has_headers,
        f"a file with headers of {num_sections} sections, got one of {num_bytes} bytes; is it "
        "complete?",
    )
    end = HEADER_BYTES + num_sections * _SECTION_BYTES
    starts = range(HEADER_BYTES, end, _SECTION_BYTES)
    sections = [_Section(*_SECTION.unpack_from(content, start)) for start in starts]
    total = sum(section.num_gaussians for section in sections)
    check(path, total == count, f"{count} gaussians in the sections, got {total}")
    degree = max((section.sh_degree for section in sections), default=0)
    check(path, degree <= 2, f"SH degree 0 to 2, got {degree}")
    return sections, degree, compression


def _section(
    path: AnyPath, content: bytes, start: int, number: int, section: _Section, compression: int
) -> tuple[NDArray[np.void], _Buckets | None, int]:
    """Return the rows of a section, the buckets of their means, and the offset at which
    the section ends."""
    mean_type, shape_type, sh_type = _TYPES[compression]
    count = section.num_gaussians
    max_count = section.max_gaussians
    check(
        path, count <= max_count, f"at most {max_count} gaussians in section {number}, got {count}"
    )
    record = np.dtype(
        [
            ("mean", mean_type, 3),
            ("scale", shape_type, 3),
            ("quat", shape_type, 4),
            ("rgba", "u1", 4),
            ("sh", sh_type, (3 * ((section.sh_degree + 1) ** 2 - 1),)),
        ]
    )
    buckets_start = start + 4 * section.num_partial_buckets
    rows_start = buckets_start + section.bucket_bytes * section.num_buckets
    end = rows_start + record.itemsize * max_count
    check(
        path, end <= len(content), f"section {number} to end within {len(content)} bytes, got {end}"
    )
    rows = np.frombuffer(content, record, count, rows_start)
    buckets = None
    if compression:
        buckets = _buckets(path, content, start, number, section)
    return rows, buckets, end


def _buckets(path: AnyPath, content: bytes, start: int, number: int, section: _Section) -> _Buckets:
    """Return the buckets of a section that begins at ``start``."""
    count = section.num_gaussians
    sizes = np.frombuffer(content, "<u4", section.num_partial_buckets, start)
    partial_sizes = sizes.astype(np.int64)
    num_used = section.num_full_buckets + section.num_partial_buckets
    fits = section.bucket_bytes >= 12 and num_used <= section.num_buckets
    check(
        path,
        fits,
        f"at most {section.num_buckets} used buckets in section {number}, got {num_used}",
    )
    full_sizes = np.full(section.num_full_buckets, section.bucket_size, np.int64)
    ends = np.cumsum(np.minimum(np.concatenate([full_sizes, partial_sizes]), count))
    is_enough = not count or (len(ends) and ends[-1] >= count)
    expected = f"buckets for all {count} gaussians of section {number}, got too few"
    check(path, is_enough, f"{expected}; is the file damaged?")
    bucket_from_row = np.searchsorted(ends, np.arange(count), side="right")
    bucket = np.dtype((np.void, section.bucket_bytes))
    buckets_start = start + 4 * section.num_partial_buckets
    stored = np.frombuffer(content, bucket, section.num_buckets, buckets_start)
    strides = (section.bucket_bytes, 4)
    centers: NDArray[np.float32] = np.ndarray(
        (section.num_buckets, 3), "<f4", stored, strides=strides
    )
    num_steps = section.num_steps or _DEFAULT_STEPS
    step_world = section.bucket_side / 2 / num_steps
    return _Buckets(centers[bucket_from_row], step_world, num_steps)


def _decoded(
    records: NDArray[np.void], buckets: _Buckets | None, degree: int, sh_range: tuple[float, float]
) -> Gaussians:
    """Return the gaussians of a section, whose coefficients are padded with zeros up to
    ``degree``."""

    def decode(block: slice) -> tuple[Floats, ...]:
        rows = records[block]
        means = rows["mean"].astype(np.float64)
        if buckets is not None:
            means = (means - buckets.num_steps) * buckets.step_world + buckets.centers[block]
        rgba = rows["rgba"] / 255.0
        higher = rows["sh"].astype(np.float64)
        if rows.dtype["sh"].base == np.uint8:
            higher = sh_range[0] + higher / 255.0 * (sh_range[1] - sh_range[0])
        sh = np.zeros((len(rows), (degree + 1) ** 2, 3))
        sh[:, 0] = (rgba[:, :3] - 0.5) / SH_C0
        for band in range(1, math.isqrt(1 + higher.shape[1] // 3)):
            first = band**2
            last = (band + 1) ** 2
            # The file stores coefficients channel by channel.
            coefficients = higher[:, 3 * (first - 1) : 3 * (last - 1)]
            sh[:, first:last] = coefficients.reshape(-1, 3, last - first).transpose(0, 2, 1)
        return means, normalised(rows["quat"]), rows["scale"], rgba[:, 3], sh

    return assemble(len(records), degree, decode)
