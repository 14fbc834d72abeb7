"""The tables of a bundle that selection reads, and the checks that guarantee an exact
cut."""

from dataclasses import dataclass, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._numbers import check, check_type, refuse, value_text, whole_number
from v3dg.bundle.format import DTYPES, SCHEMA
from v3dg.gaussians import Gaussians

Column: TypeAlias = NDArray[Any]  # `bundle.format.SCHEMA` defines the dtype

NESTING_MARGIN = _core.nesting_margin
"""The relative margin that is added to a group's ball. With it, the ball contains the
balls of the groups below in spite of rounding; see docs/format.md."""


@dataclass(frozen=True, eq=False)
class Clusters:
    """The table of C clusters, sorted by level (0 first), and then by position in the
    tree of the median split. The arrays are read-only.

    Attributes:
        offset: (C+1,) int64. Cluster c contains gaussians offset[c] to offset[c+1] - 1.
        level: (C,) int32. Level of the cluster.
        own_group: (C,) int32. Group that made the cluster, or -1 at level 0.
        parent_group: (C,) int32. Group that replaces the cluster, or -1 at the last
            level.
        box: (C,2,3) float32. Minimum and maximum corner of the cluster's visible extent
            in the asset's frame. The extent that the filter adds is not included.
        filter_px2: (C,) float32. Variance of the cluster's screen-space low-pass
            filter, px². With a fade, clusters of level 0 are drawn with a filter even
            if this is 0.
        antialiased: (C,) uint8. 1 if opacities are compensated for the filter, and
            otherwise 0.
    """

    offset: NDArray[np.int64]
    level: NDArray[np.int32]
    own_group: NDArray[np.int32]
    parent_group: NDArray[np.int32]
    box: NDArray[np.float32]
    filter_px2: NDArray[np.float32]
    antialiased: NDArray[np.uint8]

    def __post_init__(self) -> None:
        _check_arrays("clusters.", self)

    def __len__(self) -> int:
        return len(self.level)

    def around(self, gaussians: Gaussians) -> "Clusters":
        """Return these clusters with boxes around other gaussians. The boxes of empty
        clusters do not change."""
        has_gaussians = np.diff(self.offset)[:, None, None] > 0
        box = np.where(has_gaussians, _core.bound_by_boxes(gaussians.rows, self.offset), self.box)
        return replace(self, box=box)


@dataclass(frozen=True, eq=False)
class Groups:
    """The table of G groups, in the order of the clusters that they replace, and
    therefore sorted by level. The arrays are read-only.

    Attributes:
        ball: (G,4) float32. Centre and radius, in the asset's frame, of a ball that
            contains the balls of the groups below.
        weight: (G,) float32. One over the number of gaussians that the group was
            simplified to, but at least the largest weight of the groups below.
        parent: (G,) int32. The group above, or -1 for groups that made clusters of the
            last level.
        level: (G,) int32. Level of the clusters that the group made, at least 1.
        error: (G,2) float32. Remaining errors of the fit in colour and alpha, or NaN if
            unknown.
    """

    ball: NDArray[np.float32]
    weight: NDArray[np.float32]
    parent: NDArray[np.int32]
    level: NDArray[np.int32]
    error: NDArray[np.float32]

    def __post_init__(self) -> None:
        _check_arrays("groups.", self)

    def __len__(self) -> int:
        return len(self.parent)


def check_index(name: str, index: int, count: int) -> None:
    number = whole_number(index, name)
    check(name, 0 <= number < count, f"0 to {count - 1}, got {value_text(number)}")


def _check_arrays(prefix: str, part: Clusters | Groups) -> None:
    """Check dtypes and shapes. Writable arrays are replaced by read-only copies, so
    that later changes cannot invalidate the checks."""
    count = np.size(part.level)
    for name, kind, rows, row_shape in [
        column for column in SCHEMA if column[0].startswith(prefix)
    ]:
        array = getattr(part, name.removeprefix(prefix))
        check_type(name, array, np.ndarray, "a NumPy array")
        dtype = np.dtype(DTYPES[kind])
        num_rows = count + (rows == "C+1")
        shape = (num_rows, *row_shape)
        if array.dtype != dtype or array.shape != shape:
            refuse(name, f"dtype {dtype} and shape {shape}, got {array.dtype} and {array.shape}")
        check(
            name,
            array.flags.c_contiguous,
            "a C-contiguous array, got a strided one; call numpy.ascontiguousarray",
        )
        if array.flags.writeable:
            copy = array.copy()
            copy.flags.writeable = False
            object.__setattr__(part, name.removeprefix(prefix), copy)


def columns_of(clusters: Clusters, groups: Groups) -> dict[str, Column]:
    """Return all columns of the tables, by their names in files."""
    columns = {f"clusters.{name}": array for name, array in vars(clusters).items()}
    columns.update({f"groups.{name}": array for name, array in vars(groups).items()})
    return columns


def check_tables(clusters: Clusters, groups: Groups, num_gaussians: int) -> None:
    """Raise ValueError unless the tables agree with each other and with the gaussians,
    and guarantee an exact cut."""
    check("clusters", len(clusters) < 1 << 31, f"fewer than 2^31 clusters, got {len(clusters)}")
    _core.check_tables(*columns_of(clusters, groups).values(), num_gaussians=num_gaussians)
