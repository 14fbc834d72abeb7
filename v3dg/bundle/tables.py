"""The tables of a bundle, which selection reads, and the checks that make its cut exact."""

from __future__ import annotations

import operator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg._numbers import check, check_all, check_type
from v3dg.bundle.format import DTYPES, SCHEMA

NESTING_MARGIN = 4e-6
"""A group's ball contains the balls of the groups below it with this relative margin; see docs/format.md."""

_MIN_RADIUS = 1e-15  # its square is a normal float32 number
_ROUNDING = 1e-9  # two ways to compute the same double need not agree to the last bit


@dataclass(frozen=True, eq=False)
class Clusters:
    """C clusters, by level (0 first), then by position in the split tree; the arrays are read-only.

    Attributes:
        offset: (C+1,) int64. Cluster c holds gaussians offset[c] to offset[c+1].
        level: (C,) int32.
        own_group: (C,) int32. Group whose simplification made the cluster; -1 at level 0.
        parent_group: (C,) int32. Group that the cluster is simplified in; -1 at the last level.
        box: (C,2,3) float32. Lower and upper corner of what the cluster draws, in the asset's frame, without
            the reach of the filter.
        filter_px2: (C,) float32. Variance of the low-pass on the screen that the cluster is drawn with.
        antialiased: (C,) uint8. 1 where opacity is compensated for the filter.
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


@dataclass(frozen=True, eq=False)
class Groups:
    """G groups, in the order of the clusters that they replace, hence by level; the arrays are read-only.

    Attributes:
        ball: (G,4) float32. Centre and radius in the asset's frame; contains the balls of the groups below.
        weight: (G,) float32. One over the number of gaussians the group was simplified to, at least the
            largest weight below.
        parent: (G,) int32. Group above, -1 for those that made the last level.
        level: (G,) int32. Level of the clusters that the group makes; 1 or more.
        error: (G,2) float32. Final residual of the fit in colour and alpha; not a number where not known.
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
    check(name, 0 <= operator.index(index) < count, f"0 to {count - 1}, got {index}")


def _check_arrays(prefix: str, part: Clusters | Groups) -> None:
    """Check kinds and shapes, and take copies of arrays that could be changed after all checks."""
    columns = [column for column in SCHEMA if column[0].startswith(prefix)]
    arrays = [getattr(part, name.removeprefix(prefix)) for name, _, _, _ in columns]
    for (name, _, _, _), array in zip(columns, arrays, strict=True):
        check_type(name, array, np.ndarray, "a NumPy array")
    count = part.level.size
    for (name, kind, rows, rest), array in zip(columns, arrays, strict=True):
        dtype, shape = np.dtype(DTYPES[kind]), (count + (rows == "C+1"), *rest)
        fits = array.dtype == dtype and array.shape == shape
        check(name, fits, f"{dtype} {shape}, got {array.dtype} {array.shape}")
        check(name, array.flags.c_contiguous, "a C-contiguous array; use np.ascontiguousarray")
        if array.flags.writeable:
            own = array.copy()
            own.flags.writeable = False
            object.__setattr__(part, name.removeprefix(prefix), own)


def _ascends(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Which rows are at least all before them."""
    return np.asarray(values >= np.maximum.accumulate(values))


def check_tables(clusters: Clusters, groups: Groups, num_gaussians: int) -> None:
    """Raise ValueError unless the tables fit each other and the gaussians, and the cut will be exact."""
    _check_offsets(clusters, num_gaussians)
    _check_tree(clusters, groups)
    _check_values(clusters, groups)
    _check_nesting(groups)


def _check_offsets(clusters: Clusters, num_gaussians: int) -> None:
    offset, level = clusters.offset, clusters.level
    check("clusters", len(clusters) < 1 << 31, f"fewer than 2^31, got {len(clusters)}")
    check("clusters.offset[0]", offset[0] == 0, f"0, got {offset[0]}")
    check_all("clusters.offset", offset, _ascends(offset), "offsets that never decrease")
    check("clusters.offset[-1]", offset[-1] == num_gaussians, f"{num_gaussians} gaussians, got {offset[-1]}")
    first = level[0] if len(level) else 0
    check("clusters.level[0]", first == 0, f"0, got {first}")
    step = np.diff(level.astype(np.int64), prepend=level[:1])
    check_all("clusters.level", level, (step == 0) | (step == 1), "the level before, or one more")


def _check_tree(clusters: Clusters, groups: Groups) -> None:
    """Every group replaces the clusters of one page and makes clusters of the next level for one parent."""
    num_groups = len(groups)
    level = clusters.level.astype(np.int64)
    last_level = level[-1] if len(level) else 0
    own, parent = clusters.own_group.astype(np.int64), clusters.parent_group.astype(np.int64)
    group_level, group_parent = groups.level.astype(np.int64), groups.parent.astype(np.int64)

    def check_links(name: str, links: Any, expect_none: Any, link_level: Any) -> None:
        inside = (links >= 0) & (links < num_groups)
        found = np.append(group_level, 0)[np.where(inside, links, -1)]
        good = np.where(expect_none, links == -1, inside & (found == link_level))
        check_all(
            name, links, good, lambda i: "-1" if expect_none[i] else f"a group of level {link_level[i]}"
        )

    check_links("clusters.own_group", own, level == 0, level)
    check_links("clusters.parent_group", parent, level == last_level, level + 1)
    is_coarse = (group_level >= 1) & (group_level <= last_level)
    check_all("groups.level", group_level, is_coarse, f"1 to {last_level}")
    check_links("groups.parent", group_parent, group_level == last_level, group_level + 1)

    # The last level's clusters count as having a parent of their own past the others.
    order = np.where(level == last_level, num_groups, parent)
    expected = "parents in ascending order, so that groups are in the order of the clusters they replace"
    check_all("clusters.parent_group", parent, _ascends(order), expected)
    for name, links in (("own_group", own), ("parent_group", parent)):
        num_clusters = np.bincount(links[links >= 0], minlength=num_groups)
        check_all("groups", np.arange(num_groups), num_clusters > 0, f"a cluster with it as {name}")
    of_own = np.where(own >= 0, np.append(group_parent, -1)[own], parent)
    agree = parent == of_own
    check_all("clusters.parent_group", parent, agree, lambda c: f"{of_own[c]}, its own group's parent")


def _check_values(clusters: Clusters, groups: Groups) -> None:
    box = clusters.box
    filled = clusters.offset[1:] > clusters.offset[:-1]
    check_all("clusters.box", box, np.isfinite(box), "finite numbers")
    ordered = (box[:, 0] <= box[:, 1]).all(1) | ~filled
    check_all("clusters.box", box, ordered, "a lower corner not above the upper")
    filter_px2 = clusters.filter_px2
    check_all("clusters.filter_px2", filter_px2, np.isfinite(filter_px2) & (filter_px2 >= 0), "0 or more")
    check_all("clusters.antialiased", clusters.antialiased, clusters.antialiased <= 1, "0 or 1")
    ball, weight = groups.ball, groups.weight
    check_all("groups.ball", ball, np.isfinite(ball), "finite numbers")
    is_wide = ball[:, 3] >= np.float32(_MIN_RADIUS)
    check_all("groups.ball", ball, is_wide, f"a radius of {_MIN_RADIUS} or more")
    check_all("groups.weight", weight, np.isfinite(weight) & (weight > 0), "a positive number")
    bad_error = (groups.error < 0) | np.isinf(groups.error)
    check_all("groups.error", groups.error, ~bad_error, "0 or more, or not a number where unknown")


def _check_nesting(groups: Groups) -> None:
    """Ball and weight contain those below, so the metric never decreases towards the root."""
    below = np.flatnonzero(groups.parent >= 0)
    above = groups.parent[below]
    ball = groups.ball.astype(np.float64)
    needed = np.zeros(len(groups))
    distance = np.sqrt(np.square(ball[below, :3] - ball[above, :3]).sum(1))
    needed[below] = (distance + ball[below, 3]) * (1 + NESTING_MARGIN)
    held = np.ones(len(groups), bool)
    held[below] = ball[above, 3] >= needed[below] * (1 - _ROUNDING)

    def expected(g: int) -> str:
        radius = f"whose radius must be at least {needed[g]:.9g}"
        return f"a ball inside that of group {groups.parent[g]}, {radius}"

    check_all("groups.ball", groups.ball, held, expected)
    heavier = np.ones(len(groups), bool)
    heavier[below] = groups.weight[above] >= groups.weight[below]
    check_all("groups.weight", groups.weight, heavier, "at most the weight of the group above")
