"""`.ksplat`, of mkkellogg's viewer: sections of gaussians, at three levels of compression.

After a header of 4,096 bytes come headers of 1,024 bytes a section, then the sections' data: for compression
1 and 2 the sizes of buckets that are not full and the buckets' centres, then the gaussians. A gaussian is its
mean (float32, or 16 bits a coordinate around its bucket's centre), its scales and its quaternion w x y z
(float32 or half precision), red, green, blue and opacity (bytes), and higher SH (float32, half precision, or
bytes for the range in the header), band by band and there channel by channel. See docs/formats.md.
"""

from __future__ import annotations

import os
import struct
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import SH_C0, Floats, assemble, normalised
from v3dg.formats._reading import problem, read_bytes
from v3dg.gaussians import Gaussians

_HEADER_BYTES = 4096
_SECTION_BYTES = 1024
_MAX_SECTIONS = 1 << 16
# By compression: types of a mean's coordinates, of scales and quaternions, and of higher SH.
_TYPES = (("<f4", "<f4", "<f4"), ("<u2", "<f2", "<f2"), ("<u2", "<f2", "u1"))
_SH_RANGE = 1.5  # where the header gives none
_DEFAULT_STEPS = 32767  # of a bucket's half side


@dataclass(frozen=True)
class _Section:
    rows: NDArray[np.void]
    centers: Floats | None  # (N, 3) of each gaussian's bucket
    scale: float  # world units of a step
    steps: int
    degree: int


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.ksplat` file of version 0.1 and later, of SH degree 0 to 2.

    Raises:
        ValueError: It is none, or incomplete.
        OSError: It cannot be read.
    """
    content = read_bytes(path)
    if len(content) < _HEADER_BYTES:
        raise problem(path, f"expected a header of {_HEADER_BYTES} bytes, got {len(content)}")
    major, minor, num_sections, count, compression = struct.unpack_from("<BB2xI8xIH", content)
    if major != 0 or minor < 1 or compression > 2:
        raise problem(
            path, f"expected .ksplat 0.1 or later and compression 0 to 2, got {major}.{minor}, {compression}"
        )
    if num_sections > _MAX_SECTIONS or len(content) < _HEADER_BYTES + num_sections * _SECTION_BYTES:
        raise problem(path, f"expected headers of {num_sections} sections, got {len(content)} bytes")
    low, high = struct.unpack_from("<ff", content, 36)
    if not low < high:
        low, high = -_SH_RANGE, _SH_RANGE
    sections = _sections(path, content, num_sections, compression)
    total = sum(len(section.rows) for section in sections)
    if total != count:
        raise problem(path, f"expected {count} gaussians in the sections, got {total}")
    degree = max((section.degree for section in sections), default=0)
    parts = [_decoded(section, degree, compression, low, high) for section in sections]
    if not parts:
        return assemble(0, 0, lambda rows: ())
    return parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)


def _sections(
    path: str | os.PathLike[str], content: bytes, num_sections: int, compression: int
) -> list[_Section]:
    position, parts, higher = _TYPES[compression]
    sections = []
    offset = _HEADER_BYTES + num_sections * _SECTION_BYTES
    for i in range(num_sections):
        header = struct.unpack_from("<IIIIfH2xI4xIIH", content, _HEADER_BYTES + i * _SECTION_BYTES)
        count, room, capacity, num_buckets, side, bucket_bytes, steps, num_full, num_partial, degree = header
        if degree > 2 or count > room:
            raise problem(
                path, f"expected SH degree 0 to 2 and {count} <= {room} gaussians, got degree {degree}"
            )
        record = np.dtype(
            [
                ("mean", position, 3),
                ("scale", parts, 3),
                ("quat", parts, 4),
                ("rgba", "u1", 4),
                ("sh", higher, 3 * ((degree + 1) ** 2 - 1)),
            ]
        )
        buckets = offset + 4 * num_partial
        first = buckets + bucket_bytes * num_buckets
        end = first + record.itemsize * room
        if end > len(content):
            raise problem(path, f"expected section {i} to end within {len(content)} bytes, got {end}")
        rows = np.frombuffer(content, record, count, first)
        centers = None
        if compression:
            partial = np.frombuffer(content, "<u4", num_partial, offset).astype(np.int64)
            if bucket_bytes < 12 or num_full + num_partial > num_buckets:
                raise problem(
                    path, f"expected {num_buckets} buckets in section {i}, got {num_full + num_partial}"
                )
            sizes = np.concatenate([np.full(num_full, capacity, np.int64), partial])
            ends = np.cumsum(np.minimum(sizes, count))
            if count and (not len(ends) or ends[-1] < count):
                raise problem(path, f"expected buckets for {count} gaussians in section {i}, got fewer")
            bucket = np.searchsorted(ends, np.arange(count), side="right")
            points = np.frombuffer(content, np.dtype((np.void, bucket_bytes)), num_buckets, buckets)
            centers = np.ndarray((num_buckets, 3), "<f4", points, strides=(bucket_bytes, 4))[bucket]
        steps = steps or _DEFAULT_STEPS
        sections.append(_Section(rows, centers, side / 2 / steps, steps, degree))
        offset = end
    return sections


def _decoded(section: _Section, degree: int, compression: int, low: float, high: float) -> Gaussians:
    """The gaussians of a section, with zeros for the coefficients that others have beyond its degree."""

    def decode(block: slice) -> tuple[Floats, ...]:
        rows = section.rows[block]
        means = rows["mean"].astype(np.float64)
        if section.centers is not None:
            means = (means - section.steps) * section.scale + section.centers[block]
        rgba = rows["rgba"] / 255.0
        higher = rows["sh"].astype(np.float64)
        if compression == 2:
            higher = low + higher / 255.0 * (high - low)
        sh = np.zeros((len(rows), (degree + 1) ** 2, 3))
        sh[:, 0] = (rgba[:, :3] - 0.5) / SH_C0
        for band in range(1, section.degree + 1):
            first, size = band * band, 2 * band + 1
            of_band = higher[:, 3 * (first - 1) : 3 * (first - 1 + size)]
            sh[:, first : first + size] = of_band.reshape(-1, 3, size).transpose(0, 2, 1)
        return means, normalised(rows["quat"]), rows["scale"], rgba[:, 3], sh

    return assemble(len(section.rows), degree, decode)
