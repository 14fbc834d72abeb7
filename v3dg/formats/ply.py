"""`.ply` as trainers write it. The core reads and writes it. See docs/formats.md."""

import os
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from v3dg import _core, _files
from v3dg._numbers import check
from v3dg.formats import _ply_comments, compressed_ply
from v3dg.formats._declared import Declared
from v3dg.formats._packing import SH_C0
from v3dg.formats._reading import AnyPath, AssetFile, listed
from v3dg.gaussians import Gaussians

write_compressed = compressed_ply.write
PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]
_Elements: TypeAlias = Sequence[tuple[str, int, Sequence[tuple[str, str]]]]

_NORMALS = ("nx", "ny", "nz")  # the code of 3DGS writes zeros here
# If no value is larger than this, floats are colours from 0 to 1, and otherwise colours
# from 0 to 255.
_MAX_COLOR = 8.0


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.ply` file. If it has packed positions, it is read as a `.compressed.ply`
    file, whatever its name."""
    name = os.fspath(path)
    _, _, elements = _core.ply_header(name)
    if any("packed_position" in dict(properties) for _, _, properties in elements):
        return compressed_ply.open_file(path)
    plain = _core.PlyFile(name)
    used = {stored.removeprefix(plain.prefix) for stored in plain.used}
    has_base_colors = "f_dc_0" not in used

    def read(first: int, last: int) -> Gaussians:
        gaussians = Gaussians(*plain.read(first, last))
        if has_base_colors:
            _check_colors(path, gaussians)
        return gaussians

    declared = _declared(_core.ply_comments(name), elements, used, plain.prefix)
    return AssetFile(path, plain.num_gaussians, plain.sh_degree, read, declared=declared)


def _check_colors(path: AnyPath, gaussians: Gaussians) -> None:
    """Raise ValueError for base colours that seem to be stored as 0 to 255."""
    largest = float(np.nan_to_num(gaussians.sh[:, 0]).max(initial=0.0)) * SH_C0 + 0.5
    expected = "colours from 0 to 1 in float properties"
    advice = "divide them by 255, or store them as uchar"
    check(path, largest <= _MAX_COLOR, f"{expected}, got {largest:g}; {advice}")


def _declared(
    comments: Sequence[str], elements: _Elements, used: set[str], prefix: str
) -> Declared:
    """Return what a file declares, with notes about content that is ignored or
    converted. ``used`` has the names of the properties that are read, without their
    prefix."""
    by_comments = _ply_comments.declared_by(comments)
    vertex = next(properties for name, _, properties in elements if name == "vertex")
    names = [name.removeprefix(prefix) for name, _ in vertex]
    unread = [name for name in names if name not in used and name not in _NORMALS]
    notes = list(by_comments.notes)
    if prefix:
        notes.append(
            f"The names of its properties begin with {prefix}, as CloudCompare writes them; they "
            "were read without it. CloudCompare does not turn rotations and harmonics with "
            "the points."
        )
    if "scale_2" not in used:
        notes.append(
            "scale_2 is missing, so these are the gaussians of 2DGS; "
            "they were read as ellipsoids of no thickness."
        )
    if "f_dc_0" not in used:
        notes.append("Red, green and blue were read as base colours because f_dc_0 is missing.")
    antialiased = by_comments.antialiased
    if "filter_3D" in used:
        if antialiased is None:
            antialiased = True
        notes.append(
            "filter_3D of Mip-Splatting was applied to scales and opacities; it trains with a "
            "filter of 0.1 px² by default, where others have 0.3."
        )
    high_coefficients = [name for name in unread if name.startswith("f_rest_")]
    if high_coefficients:
        notes.append("Coefficients of SH degree 4 were ignored.")
        unread = [name for name in unread if name not in high_coefficients]
    if unread:
        notes.append(f"Properties of vertex that are unknown were ignored: {listed(unread)}.")
    left_out = [name for name, count, _ in elements if name != "vertex" and count]
    if left_out:
        notes.append(f"Elements other than vertex were ignored: {listed(left_out)}.")
    return replace(by_comments, antialiased=antialiased, notes=tuple(notes))


def write(
    path: AnyPath, gaussians: Gaussians, encoding: PlyEncoding = "binary_little_endian"
) -> None:
    """Write a `.ply` file."""
    host = gaussians.numpy()
    arrays = (host.means, host.quats, host.scales, host.opacities, host.sh)
    with _files.replacing(path) as temporary:
        comments = _ply_comments.comments_for(host.antialiased)
        _core.ply_write(temporary, *arrays, encoding=encoding, comments=comments)
