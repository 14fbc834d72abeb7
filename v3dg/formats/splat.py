"""`.splat`, of antimatter15's viewer: 32 bytes per gaussian, with colours that do not
depend on the view.

A record contains the mean (3 float32), the scales (3 float32, not logarithms), red,
green, blue and opacity (one byte each), and the quaternion w x y z (one byte each,
where 128 means 0). There is no header.
"""

import numpy as np

from v3dg.formats._packing import SH_C0, Floats, assemble
from v3dg.formats._reading import AnyPath, AssetFile, File, check
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])

# Lengths of a unit quaternion, in steps of its bytes, that are accepted.
_QUATERNION_LENGTHS = (124.0, 132.0)
_LARGEST = 1e9  # no asset has larger coordinates or scales


def is_start_of_one(start: bytes, num_bytes: int) -> bool:
    """Return whether a file of this length with these first bytes is a `.splat`. The
    bytes must be records with unit quaternions and plausible numbers."""
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
