"""`.splat`, of antimatter15's viewer: 32 bytes a gaussian, colour without view
dependence.

A record is the mean (3 float32), the scales (3 float32, not logs), red, green, blue and
opacity (a byte each) and the quaternion w x y z (a byte each, 128 for 0). There is no
header.
"""

import numpy as np

from v3dg.formats._packing import SH_C0, Floats, assemble
from v3dg.formats._reading import AnyPath, AssetFile, File, check
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

_QUATERNION_LENGTHS = (124.0, 132.0)  # of one of length 1, in steps of its bytes
_LARGEST = 1e9  # a coordinate or a scale beyond it is not one of an asset


def is_start_of_one(start: bytes, num_bytes: int) -> bool:
    """Return whether these first bytes of a file of this length can only be records:
    their quaternions have the length 1, and their numbers are plausible."""
    num_records = len(start) // _RECORD.itemsize
    if num_bytes % _RECORD.itemsize or not num_records:
        return False
    records = np.frombuffer(start, _RECORD, num_records)
    lengths = np.linalg.norm(records["quat"].astype(np.float64) - 128.0, axis=1)
    is_rotation = (lengths > _QUATERNION_LENGTHS[0]) & (lengths < _QUATERNION_LENGTHS[1])
    is_mean = np.abs(records["mean"]) < _LARGEST
    is_scale = (records["scale"] > 0) & (records["scale"] < _LARGEST)
    return bool(is_rotation.all() and is_mean.all() and is_scale.all())


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.splat` file."""
    file = File(path)
    size = _RECORD.itemsize
    is_whole = file.num_bytes % size == 0
    check(path, is_whole, f"a multiple of 32 bytes, got {file.num_bytes}; is the file complete?")

    def read(first: int, last: int) -> Gaussians:
        records = file.rows(_RECORD, first * size, last - first)

        def decode(rows: slice) -> tuple[Floats, ...]:
            block = records[rows]
            rgba = block["rgba"] / 255.0
            quats = normalised((block["quat"].astype(np.float64) - 128.0) / 128.0)
            sh = (rgba[:, None, :3] - 0.5) / SH_C0
            return block["mean"], quats, block["scale"], rgba[:, 3], sh

        return assemble(len(records), 0, decode)

    return AssetFile(path, file.num_bytes // size, 0, read)
