"""`.splat`, of antimatter15's viewer: 32 bytes a gaussian, colour without view dependence.

A record is the mean (3 float32), the scales (3 float32, not logs), red, green, blue and opacity (a byte each)
and the quaternion w x y z (a byte each, 128 for 0). There is no header.
"""

from __future__ import annotations

import os

import numpy as np

from v3dg.formats._packing import SH_C0, Floats, assemble, normalised
from v3dg.formats._reading import problem, read_bytes
from v3dg.gaussians import Gaussians

_RECORD = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.splat` file.

    Raises:
        ValueError: Its size is no multiple of 32 bytes.
        OSError: It cannot be read.
    """
    content = read_bytes(path)
    if len(content) % _RECORD.itemsize:
        raise problem(path, f"expected a multiple of 32 bytes, got {len(content)}; is the file complete?")
    records = np.frombuffer(content, _RECORD)

    def decode(rows: slice) -> tuple[Floats, ...]:
        block = records[rows]
        rgba = block["rgba"] / 255.0
        quats = normalised((block["quat"].astype(np.float64) - 128.0) / 128.0)
        return block["mean"], quats, block["scale"], rgba[:, 3], (rgba[:, None, :3] - 0.5) / SH_C0

    return assemble(len(records), 0, decode)
