"""The tables of a bundle, from the plan and what was measured of each level."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from v3dg.build.config import BuildConfig
from v3dg.build.plan import Plan
from v3dg.build.simplify import LevelTables
from v3dg.bundle import Clusters, Groups


def assemble(plan: Plan, tables: Sequence[LevelTables], config: BuildConfig) -> tuple[Clusters, Groups]:
    """The tables of all levels, in order."""
    levels = plan.levels
    num_clusters = [level.num_clusters for level in levels]
    num_groups = [0, *(level.num_groups for level in levels[1:])]  # of level 0 there are none in a bundle
    level = np.repeat(np.arange(len(levels), dtype=np.int32), num_clusters)
    # The last level is drawn at all smaller sizes, too, where a pixel sees its whole square: variance 1/12.
    last_px2 = max(config.filter_px2, 1 / 12) if config.filter_px2 > 0 or config.smooth == "yes" else 0.0
    coarse_px2 = np.where(level < len(levels) - 1, config.filter_px2, last_px2)
    clusters = Clusters(
        offset=np.concatenate([[0], np.cumsum(np.concatenate([np.diff(level.offset) for level in levels]))]),
        level=level,
        own_group=_groups_from(num_clusters, num_groups, 0),
        parent_group=_groups_from(num_clusters, num_groups, 1),
        box=np.concatenate([table.box for table in tables]),
        filter_px2=np.where(level == 0, config.asset_filter_px2, coarse_px2).astype(np.float32),
        antialiased=np.where(level == 0, config.asset_antialiased, True).astype(np.uint8),
    )
    none = LevelTables(*(np.zeros((0, *shape), np.float32) for shape in ((2, 3), (4,), (4,), (2,))))
    coarse = [none, *tables[1:]]
    groups = Groups(
        ball=np.concatenate([table.ball for table in coarse]),
        weight=np.concatenate([np.zeros(0, np.float32), *(level.weight for level in levels[1:])]),
        parent=_groups_from(num_groups, num_groups, 1),
        level=np.repeat(np.arange(len(levels), dtype=np.int32), num_groups),
        error=np.concatenate([table.error for table in coarse]),
    )
    return clusters, groups


def _groups_from(counts: Sequence[int], num_groups: Sequence[int], above: int) -> npt.NDArray[np.int32]:
    """The group, `above` levels up, that each of a level's rows belongs to; all have as many. -1 for none."""
    sizes = [*num_groups[above:], *[0] * above]  # of the level that each of them looks at
    parts = [
        first + np.repeat(np.arange(size), count // size) if size else np.full(count, -1)
        for count, size, first in zip(counts, sizes, np.cumsum([0, *num_groups])[above:], strict=False)
    ]
    return np.concatenate(parts).astype(np.int32)
