"""The tables of a bundle, computed from the plan and from the measurements of each
level."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from v3dg.bundle import Clusters, Groups
from v3dg.levels.config import BuildConfig
from v3dg.levels.plan import Plan
from v3dg.levels.simplify import LevelTables


def assemble(
    plan: Plan, tables: Sequence[LevelTables], config: BuildConfig
) -> tuple[Clusters, Groups]:
    """Return the tables of all levels, in order."""
    levels = plan.levels
    num_clusters = [level.num_clusters for level in levels]
    # No groups are simplified to level 0.
    num_groups = [0, *(level.num_groups for level in levels[1:])]
    sizes = np.concatenate([np.diff(level.offset) for level in levels])
    level = np.repeat(np.arange(len(levels), dtype=np.int32), num_clusters)
    last_px2 = 0.0
    if config.filter_px2 > 0 or config.smooth == "yes":
        # The last level is also drawn at all smaller sizes, so the variance of its
        # filter is at least that of a box of one pixel, 1/12 px².
        last_px2 = max(config.filter_px2, 1 / 12)
    coarse_px2 = np.where(level < len(levels) - 1, config.filter_px2, last_px2)
    antialiased = np.ones(len(level), np.uint8)
    asset_filter_px2, is_antialiased = config.asset_look
    antialiased[level == 0] = is_antialiased
    clusters = Clusters(
        offset=np.concatenate([[0], np.cumsum(sizes)]),
        level=level,
        own_group=_groups_from(num_clusters, num_groups, 0),
        parent_group=_groups_from(num_clusters, num_groups, 1),
        box=np.concatenate([table.box for table in tables]),
        filter_px2=np.where(level == 0, asset_filter_px2, coarse_px2).astype(np.float32),
        antialiased=antialiased,
    )
    groups = Groups(
        ball=np.concatenate([np.zeros((0, 4), np.float32), *(table.ball for table in tables[1:])]),
        weight=np.concatenate([np.zeros(0, np.float32), *(level.weight for level in levels[1:])]),
        parent=_groups_from(num_groups, num_groups, 1),
        level=np.repeat(np.arange(len(levels), dtype=np.int32), num_groups),
        error=np.concatenate(
            [np.zeros((0, 2), np.float32), *(table.error for table in tables[1:])]
        ),
    )
    return clusters, groups


def _groups_from(
    counts: Sequence[int], num_groups: Sequence[int], num_up: int
) -> npt.NDArray[np.int32]:
    """Return, for each row of every level, the index of the group that contains it
    `num_up` levels higher, or -1 if there is none.

    The rows are clusters or groups; `counts` has their number for each level. Each
    group of a level contains the same number of rows.
    """
    first_group = np.cumsum([0, *num_groups])
    parts = []
    for level, count in enumerate(counts, num_up):
        if level < len(num_groups) and num_groups[level] > 0:
            size = num_groups[level]
            parts.append(first_group[level] + np.repeat(np.arange(size), count // size))
        else:
            parts.append(np.full(count, -1))
    return np.concatenate(parts).astype(np.int32)
