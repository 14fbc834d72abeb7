"""The shape of every level, from counts alone: what a group is made of is known before anything is built."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.build.config import BuildConfig
from v3dg.bundle.format import offset_of
from v3dg.bundle.pages import PageLayout

Offsets = npt.NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class LevelPlan:
    """One level, or a run of its groups: C clusters made by G groups, each of as many clusters.

    At level 0 every cluster is a group of its own.
    """

    first_group: int  # its number in the level of the whole asset
    offset: Offsets  # (C + 1,) gaussians of each cluster
    group_offset: Offsets  # (G + 1,) gaussians that each group is simplified to
    leaf_offset: Offsets  # (G + 1,) gaussians of level 0 under each group
    weight: npt.NDArray[np.float32]  # (G,) of the footprint

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
        """A run of the groups, their gaussians counted from 0."""
        made = self.num_clusters // self.num_groups
        clusters = self.offset[first * made : last * made + 1]
        offsets = clusters, self.group_offset[first : last + 1], self.leaf_offset[first : last + 1]
        own, made_of, leaves = (offset - offset[0] for offset in offsets)
        return LevelPlan(self.first_group + first, own, made_of, leaves, self.weight[first:last])


@dataclass(frozen=True, eq=False)
class Plan:
    """The levels of a whole asset, or those of a subtree of it.

    All counts of clusters and groups are powers of two, so groups nest evenly: those under a run of groups
    are a run of whole groups of every level below.
    """

    levels: tuple[LevelPlan, ...]

    @staticmethod
    def of(num_gaussians: int, config: BuildConfig) -> "Plan":
        """The plan of an asset with so many gaussians."""
        depth = _core.num_halvings(num_gaussians, config.cluster_size)
        offset = halved(np.array([num_gaussians]), depth)
        levels = [LevelPlan(0, offset, offset, offset, np.zeros(1 << depth, np.float32))]
        while (shape := _next_shape(levels[-1], config)) is not None:
            levels.append(_level_above(levels[-1], *shape))
        return Plan(tuple(levels))

    def subtree(self, level: int, first_group: int, last_group: int) -> "Plan":
        """What is under a run of groups of one level, up to that level."""
        top = self.levels[level].num_groups
        levels = ((below, below.num_groups // top) for below in self.levels[: level + 1])
        return Plan(tuple(below.groups(first_group * n, last_group * n) for below, n in levels))

    def units(self, most_leaves: int) -> "list[Plan]":
        """Cut the plan into parts that share no page, each above so many leaves at most where it can."""
        wanted = 1 << max(0, math.ceil(self.levels[0].num_gaussians / most_leaves) - 1).bit_length()
        if wanted == 1 or len(self.levels) == 1:
            return [self]
        level = max(n for n, here in enumerate(self.levels) if n < 2 or here.num_groups >= wanted)
        num_groups = self.levels[level].num_groups
        each = max(1, num_groups // wanted)
        trees = (self.subtree(level, first, first + each) for first in range(0, num_groups, each))
        return [Plan(tree.levels[:-1]) for tree in trees]

    @property
    def first_page(self) -> list[int]:
        """Of each level, and the number of pages: a group's page is that of the clusters that it replaces."""
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


def _next_shape(below: LevelPlan, config: BuildConfig) -> tuple[int, int] | None:
    """Groups that a level's clusters form, and clusters each makes; None after the last level."""
    num_groups = max(1, below.num_clusters // config.group_size)
    made = max(1, below.num_clusters // num_groups // 2)
    if num_groups * made < config.min_clusters or below.num_gaussians // 2 < config.min_gaussians:
        return None
    return num_groups, made


def _level_above(below: LevelPlan, num_groups: int, clusters_made: int) -> LevelPlan:
    sizes = (np.diff(below.offset[:: below.num_clusters // num_groups]) + 1) // 2
    group_offset = offset_of(sizes)
    weight = np.maximum((1 / sizes).astype(np.float32), below.weight.reshape(num_groups, -1).max(axis=1))
    leaf_offset = np.ascontiguousarray(below.leaf_offset[:: below.num_groups // num_groups])
    return LevelPlan(0, halved(sizes, clusters_made.bit_length() - 1), group_offset, leaf_offset, weight)


def halved(sizes: npt.NDArray[np.int64], depth: int) -> Offsets:
    """Where parts begin when nodes are split in two so many times, as the median split does it; the end."""
    for _ in range(depth):
        sizes = np.stack([(sizes + 1) // 2, sizes // 2], axis=1).ravel()
    return offset_of(sizes)
