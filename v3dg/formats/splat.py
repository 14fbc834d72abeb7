"""`.splat`, of antimatter15's viewer: 32 bytes a gaussian, colour without view dependence.

A record is the mean (3 float32), the scales (3 float32, not logs), red, green, blue and opacity (a byte each)
and the quaternion w x y z (a byte each, 128 for 0). There is no header.
"""

from __future__ import annotations

import numpy as np

from v3dg.formats._packing import SH_C0, Floats, assemble, normalised
from v3dg.formats._reading import Path, check, read_bytes
from v3dg.gaussians import Gaussians

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read(path: Path) -> Gaussians:
    """Read a `.splat` file."""
    content = read_bytes(path)
    is_whole = len(content) % _RECORD.itemsize == 0
    check(path, is_whole, f"a multiple of 32 bytes, got {len(content)}; is the file complete?")
    records = np.frombuffer(content, _RECORD)

    def decode(rows: slice) -> tuple[Floats, ...]:
        block = records[rows]
        rgba = block["rgba"] / 255.0
        quats = normalised((block["quat"].astype(np.float64) - 128.0) / 128.0)
        return block["mean"], quats, block["scale"], rgba[:, 3], (rgba[:, None, :3] - 0.5) / SH_C0

    return assemble(len(records), 0, decode)
