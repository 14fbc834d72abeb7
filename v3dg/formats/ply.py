"""`.ply`, as trainers write it: the core reads and writes it. See docs/formats.md."""

import os
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, TypeAlias

import numpy as np

from v3dg import _core, _files
from v3dg._numbers import check
from v3dg.cameras import AXES
from v3dg.formats import compressed_ply
from v3dg.formats._declared import NOTHING, Declared
from v3dg.formats._packing import SH_C0
from v3dg.formats._reading import AnyPath, AssetFile, listed
from v3dg.gaussians import Gaussians

write_compressed = compressed_ply.write
_MOST_HEADER = 1 << 16  # bytes in which comments are sought
PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]
_Elements: TypeAlias = Sequence[tuple[str, int, Sequence[tuple[str, str]]]]

_NORMALS = ("nx", "ny", "nz")  # zeros in the files of the 3DGS code
_MAX_COLOR = 8.0  # of a float for 0 to 1: larger ones are for 0 to 255


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.ply` file; one with packed positions is a compressed one, whatever its
    name."""
    name = os.fspath(path)
    _, _, elements = _core.ply_header(name)
    if any("packed_position" in dict(properties) for _, _, properties in elements):
        axis = _vertical_axis(path)
        file = compressed_ply.open_file(path)
        return replace(file, declared=replace(axis, notes=axis.notes + file.declared.notes))
    plain = _core.PlyFile(name)
    has_base_colors = "f_dc_0" not in plain.used

    def read(first: int, last: int) -> Gaussians:
        gaussians = Gaussians(*plain.read(first, last))
        if has_base_colors:
            _check_colors(path, gaussians)
        return gaussians

    return AssetFile(
        path,
        plain.num_gaussians,
        plain.sh_degree,
        read,
        declared=_declared(path, elements, set(plain.used)),
    )


def _check_colors(path: AnyPath, gaussians: Gaussians) -> None:
    """Raise ValueError for base colours that were not stored for 0 to 1."""
    largest = float(np.nan_to_num(gaussians.sh[:, 0]).max(initial=0.0)) * SH_C0 + 0.5
    expected = "colours of 0 to 1 in properties of floats"
    advice = "divide them by 255, or store them as uchar"
    check(path, largest <= _MAX_COLOR, f"{expected}, got {largest:g}; {advice}")


def _vertical_axis(path: AnyPath) -> Declared:
    """The axis that the header declares to be up: that of nerfstudio has `comment
    Vertical Axis: z`."""
    with open(_files.open_regular(path), "rb") as file:
        header = file.read(_MOST_HEADER).partition(b"end_header")[0].decode("latin-1")
    match = re.search(r"^comment\s+Vertical Axis:\s*(\S+)\s*$", header, re.MULTILINE)
    if match is None:
        return NOTHING
    for axis in AXES:
        if match[1].lower() == axis:
            return Declared(up=axis, up_reason="as its header says")
    return Declared(notes=(f"Its header has an unknown vertical axis, {match[1][:20]!a}.",))


def _declared(path: AnyPath, elements: _Elements, used: set[str]) -> Declared:
    """What a file has beside the numbers that are read as they are meant."""
    axis = _vertical_axis(path)
    vertex = next(properties for name, _, properties in elements if name == "vertex")
    unread = [name for name, _ in vertex if name not in used and name not in _NORMALS]
    notes = list(axis.notes)
    if "scale_2" not in used:
        notes.append(
            "scale_2 is missing, so these are the gaussians of 2DGS; "
            "they were read as ellipsoids of no thickness."
        )
    if "f_dc_0" not in used:
        notes.append("Red, green and blue were read as base colours, because f_dc_0 is missing.")
    antialiased = None
    if "filter_3D" in used:
        antialiased = True
        notes.append("filter_3D of Mip-Splatting was applied to scales and opacities.")
    high_coefficients = [name for name in unread if name.startswith("f_rest_")]
    if high_coefficients:
        notes.append("Coefficients of SH degree 4 were left out.")
        unread = [name for name in unread if name not in high_coefficients]
    if unread:
        notes.append(f"Properties of vertex that no gaussian has were left out: {listed(unread)}.")
    left_out = [name for name, count, _ in elements if name != "vertex" and count]
    if left_out:
        notes.append(f"Elements beside vertex were left out: {listed(left_out)}.")
    return replace(axis, antialiased=antialiased, notes=tuple(notes))


def write(
    path: AnyPath, gaussians: Gaussians, encoding: PlyEncoding = "binary_little_endian"
) -> None:
    """Write a `.ply` file."""
    host = gaussians.numpy()
    arrays = (host.means, host.quats, host.scales, host.opacities, host.sh)
    with _files.replacing(path) as temporary:
        _core.ply_write(temporary, *arrays, encoding=encoding)
