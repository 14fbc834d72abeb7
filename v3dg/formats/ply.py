"""`.ply`, as trainers write it: the core reads and writes it. See docs/formats.md."""

import os
from typing import Literal

from v3dg import _core, _files
from v3dg.formats import _ply_comments, compressed_ply
from v3dg.formats._reading import AnyPath, AssetFile
from v3dg.gaussians import Gaussians

write_compressed = compressed_ply.write
PlyEncoding = Literal["binary_little_endian", "binary_big_endian", "ascii"]


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.ply` file; one with packed positions is a compressed one, whatever its
    name."""
    name = os.fspath(path)
    _, _, elements = _core.ply_header(name)
    if any("packed_position" in dict(properties) for _, _, properties in elements):
        return compressed_ply.open_file(path)
    file = _core.PlyFile(name)

    def read(first: int, last: int) -> Gaussians:
        return Gaussians(*file.read(first, last))

    declared = _ply_comments.declared_by(_core.ply_comments(name))
    return AssetFile(path, file.num_gaussians, file.sh_degree, read, declared=declared)


def write(
    path: AnyPath, gaussians: Gaussians, encoding: PlyEncoding = "binary_little_endian"
) -> None:
    """Write a `.ply` file."""
    host = gaussians.numpy()
    arrays = (host.means, host.quats, host.scales, host.opacities, host.sh)
    with _files.replacing(path) as temporary:
        comments = _ply_comments.comments_for(host.antialiased)
        _core.ply_write(temporary, *arrays, encoding=encoding, comments=comments)
