"""`.hier`, of Hierarchical 3DGS (H3DG): a tree of gaussians. Only the leaves are read.

The number of gaussians is followed by their columns: positions, rotations w x y z, log
scales, opacities and SH of degree 3. Then follow the number of nodes, the nodes, and
boxes. If the number of gaussians is negative, everything except the positions is in
half precision.
"""

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import Floats, assemble
from v3dg.formats._reading import AnyPath, AssetFile, File, check
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_INT = np.dtype("<i4")
_WIDTHS = (3, 4, 3, 1, 48)
# The fields of a node that are read: the index of its first gaussian, and the number of
# its gaussians that are leaves.
_FLOAT_NODE = np.dtype(
    {"names": ["start", "leaves"], "formats": ["<i4", "<i4"], "offsets": [8, 12], "itemsize": 28}
)
_HALF_NODE = np.dtype(
    {"names": ["start", "leaves"], "formats": ["<i4", "<i2"], "offsets": [4, 16], "itemsize": 20}
)


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.hier` file."""
    file = File(path)
    check(path, file.num_bytes >= 4, f"a file of at least 4 bytes, got {file.num_bytes}")
    signed = int(file.rows(_INT, 0, 1)[0])
    count = abs(signed)
    kind = "<f4"
    node = _FLOAT_NODE
    if signed < 0:
        kind = "<f2"
        node = _HALF_NODE
    dtypes = [np.dtype(("<f4", _WIDTHS[0])), *(np.dtype((kind, width)) for width in _WIDTHS[1:])]
    column_starts = 4 + np.cumsum([0, *(count * dtype.itemsize for dtype in dtypes)])
    columns_end = int(column_starts[-1])
    # The size of a node includes its box, which is not read.
    node_bytes = node.itemsize + 8 * np.dtype(kind).itemsize
    num_nodes = _num_nodes(file, count, columns_end, node_bytes)
    leaves = _leaves(path, file.rows(node, columns_end + 4, num_nodes), count)

    def read(first: int, last: int) -> Gaussians:
        rows = leaves[first:last]
        low = 0
        high = 0
        if len(rows):
            low = int(rows[0])
            high = int(rows[-1]) + 1
        columns = [
            file.rows(dtype, start + low * dtype.itemsize, high - low)[rows - low]
            for dtype, start in zip(dtypes, column_starts.tolist(), strict=False)
        ]

        def decode(block: slice) -> tuple[Floats, ...]:
            means, quats, log_scales, alphas, sh = (
                column[block].astype(np.float64) for column in columns
            )
            # The sign of an opacity has no meaning, and opacities of inner nodes exceed
            # 1.
            opacities = np.minimum(np.abs(alphas[:, 0]), 1.0)
            return means, normalised(quats), np.exp(log_scales), opacities, sh.reshape(-1, 16, 3)

        return assemble(len(rows), 3, decode)

    return AssetFile(path, len(leaves), 3, read)


def _num_nodes(file: File, count: int, columns_end: int, node_bytes: int) -> int:
    """Return the number of nodes, which follows the columns of the gaussians; raise
    ValueError unless the file has the size that both numbers imply."""
    damaged = f"got a file of {file.num_bytes} bytes; the file is damaged, or no .hier file"
    least_bytes = columns_end + 4
    expected = f"at least {least_bytes} bytes for {count} gaussians"
    check(file.path, least_bytes <= file.num_bytes, f"{expected}, {damaged}")
    num_nodes = int(file.rows(_INT, columns_end, 1)[0])
    num_bytes = least_bytes + num_nodes * node_bytes
    expected = f"{num_bytes} bytes for {count} gaussians and {num_nodes} nodes"
    check(file.path, num_bytes == file.num_bytes, f"{expected}, {damaged}")
    return num_nodes


def _leaves(path: AnyPath, nodes: NDArray[np.void], count: int) -> NDArray[np.int64]:
    """Return the indices of the gaussians that are leaves, ascending and without
    repetition."""
    has_leaves = nodes["leaves"] != 0
    first = nodes["start"][has_leaves].astype(np.int64)
    size = nodes["leaves"][has_leaves].astype(np.int64)
    end = first + size
    fits = (size > 0) & (first >= 0) & (end <= count)
    check(
        path,
        fits.all(),
        f"nodes whose leaves are among the {count} gaussians, got others; is the file damaged?",
    )
    num_starts = np.bincount(first, minlength=count + 1)
    num_ends = np.bincount(end, minlength=count + 1)
    return np.flatnonzero(np.cumsum(num_starts - num_ends)[:count] > 0)
