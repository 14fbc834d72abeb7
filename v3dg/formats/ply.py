"""`.ply`, as trainers write it: the core reads and writes it. See docs/formats.md."""

import os
import re
from dataclasses import replace
from typing import Literal

from v3dg import _core, _files
from v3dg.cameras import AXES
from v3dg.formats import compressed_ply
from v3dg.formats._declared import NOTHING, Declared
from v3dg.formats._reading import AnyPath, AssetFile
from v3dg.gaussians import Gaussians

write_compressed = compressed_ply.write
_MOST_HEADER = 1 << 16  # bytes in which comments are sought
PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.ply` file; one with packed positions is a compressed one, whatever its
    name."""
    name = os.fspath(path)
    _, _, elements = _core.ply_header(name)
    if any("packed_position" in dict(properties) for _, _, properties in elements):
        return replace(compressed_ply.open_file(path), declared=_declared(path))
    file = _core.PlyFile(name)

    def read(first: int, last: int) -> Gaussians:
        return Gaussians(*file.read(first, last))

    return AssetFile(path, file.num_gaussians, file.sh_degree, read, declared=_declared(path))


def _declared(path: AnyPath) -> Declared:
    """What the header declares: that of nerfstudio has `comment Vertical Axis: z`."""
    with open(_files.open_regular(path), "rb") as file:
        header = file.read(_MOST_HEADER).partition(b"end_header")[0].decode("latin-1")
    match = re.search(r"^comment\s+Vertical Axis:\s*(\S+)\s*$", header, re.MULTILINE)
    if match is None:
        return NOTHING
    for axis in AXES:
        if match[1].lower() == axis:
            return Declared(up=axis, up_reason="as its header says")
    return Declared(notes=(f"Its header has an unknown vertical axis, {match[1][:20]!a}.",))


def write(
    path: AnyPath, gaussians: Gaussians, encoding: PlyEncoding = "binary_little_endian"
) -> None:
    """Write a `.ply` file."""
    host = gaussians.numpy()
    arrays = (host.means, host.quats, host.scales, host.opacities, host.sh)
    with _files.replacing(path) as temporary:
        _core.ply_write(temporary, *arrays, encoding=encoding)
