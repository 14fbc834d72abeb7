"""`.hier`, of Hierarchical 3DGS (H3DG): a tree of gaussians, of which the leaves are read.

After the number of gaussians come their columns: positions, rotations w x y z, log scales, opacities and SH
of degree 3, then the number of nodes, the nodes, and boxes. A number below zero means that all but the
positions is in half precision.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import assemble
from v3dg.formats._reading import AssetFile, File, Path, check
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_INT = np.dtype("<i4")
_WIDTHS = (3, 4, 3, 1, 48)
# What is looked at of a node: where its gaussians begin, and how many of them are leaves.
_NODES = {
    kind: np.dtype({"names": ["start", "leaves"], "formats": ["<i4", of], "offsets": at, "itemsize": size})
    for kind, of, at, size in (("<f4", "<i4", [8, 12], 28), ("<f2", "<i2", [4, 16], 20))
}


def open_file(path: Path) -> AssetFile:
    """Open a `.hier` file."""
    file = File(path)
    check(path, file.num_bytes >= 4, f"a number of gaussians, got {file.num_bytes} bytes")
    signed = int(file.rows(_INT, 0, 1)[0])
    count, kind = abs(signed), "<f2" if signed < 0 else "<f4"
    dtypes = [np.dtype((kind if i else "<f4", width)) for i, width in enumerate(_WIDTHS)]
    first = 4 + np.cumsum([0, *(count * dtype.itemsize for dtype in dtypes)])
    check(path, first[-1] + 4 <= file.num_bytes, f"{count} gaussians, got {file.num_bytes} bytes")
    num_nodes, node = int(file.rows(_INT, first[-1], 1)[0]), _NODES[kind]
    of_node = node.itemsize + 8 * dtypes[1].base.itemsize  # with its box, which is not looked at
    fits = num_nodes * of_node == file.num_bytes - first[-1] - 4
    check(path, fits, f"{num_nodes} nodes and no more, got {file.num_bytes} bytes")
    leaves = _leaves(path, file.rows(node, first[-1] + 4, num_nodes), count)

    def read(start: int, stop: int) -> Gaussians:
        rows = leaves[start:stop]
        low, high = (rows[0], rows[-1] + 1) if len(rows) else (0, 0)
        columns = [
            file.rows(dtype, place + low * dtype.itemsize, high - low)[rows - low]
            for dtype, place in zip(dtypes, first, strict=False)
        ]

        def decode(block: slice) -> tuple[NDArray[np.floating[Any]], ...]:
            means, quats, logs, shares, sh = (column[block].astype(np.float64) for column in columns)
            # Opacities are kept without a sign, and those of inner nodes go beyond 1.
            opacities = np.minimum(np.abs(shares[:, 0]), 1.0)
            return means, normalised(quats), np.exp(logs), opacities, sh.reshape(-1, 16, 3)

        return assemble(len(rows), 3, decode)

    return AssetFile(path, len(leaves), 3, read)


def _leaves(path: Path, nodes: NDArray[Any], count: int) -> NDArray[np.int64]:
    """The gaussians that are leaves, in ascending order, each once."""
    first, size = nodes["start"].astype(np.int64), nodes["leaves"].astype(np.int64)
    first, size = first[size != 0], size[size != 0]
    fits = (size > 0) & (first >= 0) & (first + size <= count)
    check(path, fits.all(), f"leaves among {count} gaussians, got others")
    begins, ends = (np.bincount(places, minlength=count + 1) for places in (first, first + size))
    return np.flatnonzero(np.cumsum(begins - ends)[:count] > 0)
