"""The plan of a build: the clusters and groups of every level, and the numbers of their
gaussians. They follow from the size of the asset and the config, so they are known
before anything is built."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle.format import offset_of
from v3dg.bundle.pages import PageLayout
from v3dg.levels.config import BuildConfig

Offsets = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LevelPlan:
    """A level, or neighbouring groups of one. There are G groups and C clusters, and
    each group is simplified to the same number of clusters.

    At level 0, every cluster counts as a group.
    """

    first_group: int  # index of the first group in the level of the whole asset
    offset: Offsets  # (C + 1,) boundaries of the clusters' gaussians
    # (G + 1,) boundaries of the gaussians that each group is simplified to.
    group_offset: Offsets
    leaf_offset: Offsets  # (G + 1,) boundaries of the leaves under each group
    # (G,) a group's metric is its footprint times this weight
    weight: npt.NDArray[np.float32]

    @property
    def num_clusters(self) -> int:
        return len(self.offset) - 1

    @property
    def num_groups(self) -> int:
        return len(self.group_offset) - 1

    @property
    def num_gaussians(self) -> int:
        return int(self.offset[-1])

    def groups(self, first: int, last: int) -> "LevelPlan":
        """Return the plan of some neighbouring groups, with gaussians counted from
        0."""
        clusters_made = self.num_clusters // self.num_groups
        offset = self.offset[first * clusters_made : last * clusters_made + 1]
        group_offset = self.group_offset[first : last + 1]
        leaf_offset = self.leaf_offset[first : last + 1]
        return LevelPlan(
            first_group=self.first_group + first,
            offset=offset - offset[0],
            group_offset=group_offset - group_offset[0],
            leaf_offset=leaf_offset - leaf_offset[0],
            weight=self.weight[first:last],
        )


@dataclass(frozen=True, eq=False)
class Plan:
    """The levels of a whole asset, or of a subtree of it.

    All numbers of clusters and groups are powers of two, so groups nest evenly: the
    boundaries of groups are also boundaries of groups in every lower level.
    """

    levels: tuple[LevelPlan, ...]

    @staticmethod
    def of(num_gaussians: int, config: BuildConfig) -> "Plan":
        """Return the plan of an asset of `num_gaussians`."""
        depth = _core.num_halvings(num_gaussians, config.cluster_size)
        offset = halved(np.array([num_gaussians]), depth)
        level_0 = LevelPlan(
            first_group=0,
            offset=offset,
            group_offset=offset,
            leaf_offset=offset,
            weight=np.zeros(1 << depth, np.float32),
        )
        levels = [level_0]
        while (shape := _next_shape(levels[-1], config)) is not None:
            levels.append(_level_above(levels[-1], *shape))
        return Plan(tuple(levels))

    def subtree(self, level: int, first_group: int, last_group: int) -> "Plan":
        """Return the plan of neighbouring groups of one level and of everything below
        them."""
        levels = []
        for lower in self.levels[: level + 1]:
            ratio = lower.num_groups // self.levels[level].num_groups
            levels.append(lower.groups(first_group * ratio, last_group * ratio))
        return Plan(tuple(levels))

    def units(self, most_leaves: int) -> "list[Plan]":
        """Divide the plan into parts that share no page. If possible, each has at most
        `most_leaves` leaves."""
        num_units = (
            1 << max(0, math.ceil(self.levels[0].num_gaussians / most_leaves) - 1).bit_length()
        )
        if num_units == 1 or len(self.levels) == 1:
            return [self]
        top = max(
            n for n, level in enumerate(self.levels) if n < 2 or level.num_groups >= num_units
        )
        num_groups = self.levels[top].num_groups
        unit_groups = max(1, num_groups // num_units)
        units = []
        for first in range(0, num_groups, unit_groups):
            tree = self.subtree(top, first, first + unit_groups)
            units.append(Plan(tree.levels[:-1]))
        return units

    @property
    def first_page(self) -> list[int]:
        """The index of the first page of each level. The last element is the number of
        pages.

        The page of a group contains the clusters that the group replaces.
        """
        return list(itertools.accumulate(self._num_pages, initial=0))

    @property
    def _num_pages(self) -> list[int]:
        return [*(level.num_groups for level in self.levels[1:]), 1]

    @property
    def layout(self) -> PageLayout:
        """The pages of the bundle."""
        num_pages = np.array(self._num_pages, np.int64)
        clusters = np.repeat([level.num_clusters for level in self.levels] // num_pages, num_pages)
        gaussians = np.concatenate([np.diff(level.offset) for level in self.levels])
        return PageLayout(offset_of(clusters), offset_of(gaussians))


def _next_shape(lower: LevelPlan, config: BuildConfig) -> tuple[int, int] | None:
    """Return the number of groups of a level, and the number of clusters that each
    group is simplified to.

    The result is None after the last level.
    """
    num_groups = max(1, lower.num_clusters // config.group_size)
    clusters_made = max(1, lower.num_clusters // num_groups // 2)
    if (
        num_groups * clusters_made < config.min_clusters
        or lower.num_gaussians // 2 < config.min_gaussians
    ):
        return None
    return num_groups, clusters_made


def _level_above(lower: LevelPlan, num_groups: int, clusters_made: int) -> LevelPlan:
    sizes = (np.diff(lower.offset[:: lower.num_clusters // num_groups]) + 1) // 2
    lower_weight = lower.weight.reshape(num_groups, -1).max(axis=1)
    return LevelPlan(
        first_group=0,
        offset=halved(sizes, clusters_made.bit_length() - 1),
        group_offset=offset_of(sizes),
        leaf_offset=np.ascontiguousarray(lower.leaf_offset[:: lower.num_groups // num_groups]),
        weight=np.maximum((1 / sizes).astype(np.float32), lower_weight),
    )


def halved(sizes: npt.NDArray[np.int64], depth: int) -> Offsets:
    """Return the offsets of parts. The nodes of these sizes are split in two `depth`
    times.

    The sizes of the halves are the same as in `_core.median_split`.
    """
    for _ in range(depth):
        sizes = np.stack([(sizes + 1) // 2, sizes // 2], axis=1).ravel()
    return offset_of(sizes)
