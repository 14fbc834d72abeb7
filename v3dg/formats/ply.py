"""`.ply`, as trainers write it: the core reads and writes it. See docs/formats.md."""

from __future__ import annotations

import os
from typing import Literal

from v3dg import _core, _files
from v3dg.formats import compressed_ply
from v3dg.gaussians import Gaussians

PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `.ply` file; one that has packed positions as a compressed one, whatever its name.

    Raises:
        ValueError: It is none of the two; says what was expected and found.
        OSError: It cannot be read.
    """
    if compressed_ply.is_compressed(path):
        return compressed_ply.read(path)
    return Gaussians(*_core.ply_read(os.fspath(path)))


def write(
    path: str | os.PathLike[str], gaussians: Gaussians, encoding: PlyEncoding = "binary_little_endian"
) -> None:
    """Write a `.ply` file.

    Raises:
        ValueError: An unknown encoding, a negative scale, or an opacity outside [0, 1].
        OSError: It cannot be written.
    """
    host = gaussians.numpy()
    with _files.replacing(path) as temporary:
        _core.ply_write(
            temporary, host.means, host.quats, host.scales, host.opacities, host.sh, encoding=encoding
        )
