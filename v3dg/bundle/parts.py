"""Parts of a bundle: some of its clusters as a separate bundle, and bundles whose pages
come from several others."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from v3dg.bundle.bundle import Bundle
from v3dg.bundle.format import offset_of
from v3dg.bundle.pages import JoinedPages, PageLayout


@dataclass(frozen=True, eq=False)
class BundlePart:
    """Clusters of neighbouring levels of a bundle. They include all clusters on the
    paths between them, so that they form a separate bundle.

    Attributes:
        clusters: (C,) indices of the clusters, ascending.
        groups: (G,) indices of the groups that made clusters of the part from other
            clusters of the part, ascending.
        first_level: The level of the whole bundle that is level 0 of the part.
    """

    clusters: NDArray[np.int64]
    groups: NDArray[np.int64]
    first_level: int

    def of(self, bundle: Bundle) -> Bundle:
        """Return the part of a bundle, in memory.

        Only the pages of the part are read.
        """
        clusters = bundle.clusters
        groups = bundle.groups
        sizes = np.diff(clusters.offset)[self.clusters]
        # The last element is for the group -1, which means no group.
        number = np.full(len(groups) + 1, -1, np.int32)
        number[self.groups] = np.arange(len(self.groups), dtype=np.int32)
        part_clusters = replace(
            clusters,
            offset=offset_of(sizes),
            level=clusters.level[self.clusters] - np.int32(self.first_level),
            own_group=number[clusters.own_group[self.clusters]],
            parent_group=number[clusters.parent_group[self.clusters]],
            box=clusters.box[self.clusters],
            filter_px2=clusters.filter_px2[self.clusters],
            antialiased=clusters.antialiased[self.clusters],
        )
        part_groups = replace(
            groups,
            ball=groups.ball[self.groups],
            weight=groups.weight[self.groups],
            parent=number[groups.parent[self.groups]],
            level=groups.level[self.groups] - np.int32(self.first_level),
            error=groups.error[self.groups],
        )
        gaussians = bundle.pages_gaussians(bundle.pages_of(self.clusters))
        return Bundle(part_clusters, part_groups, gaussians, bundle.config, bundle.codec)


@dataclass(frozen=True, eq=False)
class ReplacedPart:
    """A part of a bundle, and the bundle that replaces its levels from `first_level`
    on. Levels are counted in the part. Both bundles have the same tables, except for
    the numbers of gaussians and the boxes of the clusters."""

    part: BundlePart
    bundle: Bundle
    first_level: int = 0


def joined(bundle: Bundle, replaced: Iterable[ReplacedPart]) -> Bundle:
    """Return a bundle in which parts are replaced. It reads its pages from the bundles
    in the arguments when they are needed."""
    sizes = np.diff(bundle.clusters.offset)
    box = bundle.clusters.box.copy()
    source = np.zeros(bundle.num_pages, np.int64)
    page = np.arange(bundle.num_pages)
    bundles = [bundle]
    for new in replaced:
        is_new = new.bundle.clusters.level >= new.first_level
        clusters = new.part.clusters[is_new]
        sizes[clusters] = np.diff(new.bundle.clusters.offset)[is_new]
        box[clusters] = new.bundle.clusters.box[is_new]
        pages = bundle.pages_of(clusters)
        source[pages] = len(bundles)
        page[pages] = new.bundle.pages_of(np.flatnonzero(is_new))
        bundles.append(new.bundle)
    clusters_of_all = replace(bundle.clusters, offset=offset_of(sizes), box=box)
    pages_of_all = JoinedPages(
        PageLayout.of(clusters_of_all), [part.pages for part in bundles], source, page
    )
    return Bundle.of_pages(clusters_of_all, bundle.groups, bundle.config, pages_of_all)


@dataclass(frozen=True, eq=False)
class Division:
    """A bundle in parts.

    Attributes:
        units: Subtrees that together have all levels below level `top`.
        upper: The levels from `top` on, and some levels below it.
        top: The lowest level that is in no unit.
    """

    units: list[BundlePart]
    upper: BundlePart
    top: int


def levels_of_at_most(bundle: Bundle, most_gaussians: int) -> BundlePart:
    """Return the part of a bundle that begins with the first level of at most this many
    gaussians. If there is no such level, it begins with the last one."""
    first = 0
    while first < bundle.num_levels - 1 and _size_of_level(bundle, first) > most_gaussians:
        first += 1
    return _levels_from(bundle, first)


def _levels_from(bundle: Bundle, first: int) -> BundlePart:
    return BundlePart(
        np.flatnonzero(bundle.clusters.level >= first),
        np.flatnonzero(bundle.groups.level > first),
        first_level=first,
    )


def divided(bundle: Bundle, most_leaves: int) -> Division | None:
    """Divide a bundle into units of at most `most_leaves` gaussians of level 0, and the
    part above them.

    The part above begins up to six levels below the top of the units, with a level of
    at most `most_leaves` gaussians. Its other levels can be compared with this one.

    Returns:
        None for a bundle of at most `most_leaves`, and if the groups of a bundle do not
        divide it into few enough such subtrees.
    """
    num_leaves = bundle.num_leaves
    if num_leaves <= most_leaves:
        return None
    groups = bundle.groups
    leaves = _leaves_of_groups(bundle)
    top = 0
    num_units = 0
    for level in range(_LEAST_TOP, bundle.num_levels):
        of_level = leaves[groups.level == level]
        if len(of_level) > 1 and of_level.max() <= most_leaves:
            top = level
            num_units = len(of_level)
    if top == 0 or num_units > _MOST_UNITS * num_leaves / most_leaves:
        return None
    unit = _units_of_groups(bundle, top)
    unit_of_cluster = np.append(unit, -1)[bundle.clusters.parent_group]
    is_below = groups.level < top
    units = [
        BundlePart(
            np.flatnonzero(unit_of_cluster == number),
            np.flatnonzero(is_below & (unit == number)),
            first_level=0,
        )
        for number in range(num_units)
    ]
    first = max(top - _LEVELS_BELOW, 1)
    while first < top - 1 and _size_of_level(bundle, first) > most_leaves:
        first += 1
    return Division(units, _levels_from(bundle, first), top)


# The part above the units begins at most this many levels below level `top`. A build
# also fits a level to the level six below it.
_LEVELS_BELOW = 6
# A unit has at least levels 0 and 1, so that the part above it can begin with level 1.
_LEAST_TOP = 2
# The number of units may exceed the minimum by this factor. If each group has two parts
# of equal size, a factor of two suffices.
_MOST_UNITS = 4


def _size_of_level(bundle: Bundle, level: int) -> int:
    """Return the number of gaussians of a level."""
    rows = bundle.level_rows(level)
    return int(rows.stop - rows.start)


def _leaves_of_groups(bundle: Bundle) -> NDArray[np.int64]:
    """Return (G,) the number of gaussians of level 0 under each group."""
    clusters = bundle.clusters
    groups = bundle.groups
    leaves = np.zeros(len(groups) + 1, np.int64)
    is_leaf = clusters.level == 0
    np.add.at(leaves, clusters.parent_group[is_leaf], np.diff(clusters.offset)[is_leaf])
    for level in range(1, bundle.num_levels):
        of_level = np.flatnonzero(groups.level == level)
        np.add.at(leaves, groups.parent[of_level], leaves[of_level])
    return leaves[:-1]


def _units_of_groups(bundle: Bundle, top: int) -> NDArray[np.int64]:
    """Return (G,) the number of the group of level `top` that contains each group, or
    -1 above that level."""
    groups = bundle.groups
    unit = np.full(len(groups) + 1, -1, np.int64)
    of_top = np.flatnonzero(groups.level == top)
    unit[of_top] = np.arange(len(of_top))
    for level in range(top - 1, 0, -1):
        of_level = np.flatnonzero(groups.level == level)
        unit[of_level] = unit[groups.parent[of_level]]
    return unit[:-1]
