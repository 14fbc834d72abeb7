"""Reading and writing Gaussians by file suffix."""

from __future__ import annotations

import os
from typing import Literal

from v3dg import _core, _files
from v3dg.gaussians import Gaussians

SUFFIXES = (".ply",)
"""How the names of files end that `load` reads."""

PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]


def load(path: str | os.PathLike[str]) -> Gaussians:
    """Read an asset from a 3DGS `.ply` file.

    The file may be ascii or binary of either byte order, with its properties in any order and of any scalar
    type, among others that are ignored, for SH degree 0 to 3. Files hold log scales and logit opacities;
    memory gets values, each computed in double precision and rounded once. Quaternions are normalised, except
    those of length zero, which stay as they are. Values that are not finite are passed on.
    Little more memory is needed than for the result.

    Raises:
        ValueError: another suffix, or the content is not a 3DGS `.ply`; says what was expected and found.
        OSError: the file cannot be opened or read (FileNotFoundError, IsADirectoryError, ...).
    """
    _check_suffix(path)
    return Gaussians(*_core.ply_read(os.fspath(path)))


def save(
    path: str | os.PathLike[str],
    gaussians: Gaussians,
    *,
    encoding: PlyEncoding = "binary_little_endian",
) -> None:
    """Write an asset to a 3DGS `.ply` file, replacing what is there in one step once all is written.

    The layout is the original one without its normals, which are always zero: x y z, f_dc, f_rest (channel
    by channel), opacity (logit), scale (log), rot. An opacity of 1 is written as logit 20 and of 0 as logit
    -110, a scale of 0 as log -110: finite, and they read back as exactly 1, 0 and 0.

    Raises:
        ValueError: another suffix, an unknown encoding, a negative scale, or an opacity outside [0, 1].
        OSError: the file cannot be written.
    """
    _check_suffix(path)
    if not isinstance(gaussians, Gaussians):
        raise TypeError(f"gaussians: expected Gaussians, got {type(gaussians).__name__}")
    host = gaussians.numpy()
    with _files.replacing(path) as temporary:
        _core.ply_write(
            temporary, host.means, host.quats, host.scales, host.opacities, host.sh, encoding=encoding
        )


def _check_suffix(path: str | os.PathLike[str]) -> None:
    name = os.fspath(path)
    if not name.lower().endswith(SUFFIXES):
        suffix = os.path.splitext(name)[1]
        raise ValueError(f"{name}: expected a file name that ends in {', '.join(SUFFIXES)}, got '{suffix}'")
