"""Bundle: all clusters of all levels of one asset, with the tables that selection reads; save and open."""

from __future__ import annotations

import json
import operator
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg._json import parse_json
from v3dg.bundle import file as bundle_file
from v3dg.bundle.file import BundleFile
from v3dg.gaussians import Gaussians

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from numpy.typing import NDArray

__all__ = ["Bundle", "Clusters", "Groups"]

NESTING_MARGIN = 4e-6
"""A group's ball contains the balls of the groups below it with this relative margin; see docs/format.md."""

_MIN_RADIUS = 1e-15  # its square is a normal float32 number
_ROUNDING = 1e-9  # two ways to compute the same double need not agree to the last bit
_READ_THREADS = 8
_BYTES_PER_TASK = 16 << 20


@dataclass(frozen=True, eq=False)
class Clusters:
    """C clusters, by level (0 first), then by position in the split tree.

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
        count = _row_count("clusters.level", self.level)
        _check_array("clusters.offset", self.offset, np.int64, (count + 1,))
        _check_array("clusters.level", self.level, np.int32, (count,))
        _check_array("clusters.own_group", self.own_group, np.int32, (count,))
        _check_array("clusters.parent_group", self.parent_group, np.int32, (count,))
        _check_array("clusters.box", self.box, np.float32, (count, 2, 3))
        _check_array("clusters.filter_px2", self.filter_px2, np.float32, (count,))
        _check_array("clusters.antialiased", self.antialiased, np.uint8, (count,))

    def __len__(self) -> int:
        return len(self.level)


@dataclass(frozen=True, eq=False)
class Groups:
    """G groups, in the order of the clusters that they replace, hence by level.

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
        count = _row_count("groups.parent", self.parent)
        _check_array("groups.ball", self.ball, np.float32, (count, 4))
        _check_array("groups.weight", self.weight, np.float32, (count,))
        _check_array("groups.parent", self.parent, np.int32, (count,))
        _check_array("groups.level", self.level, np.int32, (count,))
        _check_array("groups.error", self.error, np.float32, (count, 2))

    def __len__(self) -> int:
        return len(self.parent)


class Bundle:
    """All clusters of all levels of one asset. In memory, or a file of which pages are read when needed.

    Attributes:
        clusters: C clusters.
        groups: G groups.
        config: How it was built, as JSON values.
        sh_degree: 0 to 3, the same for all gaussians.

    Raises:
        ValueError: The tables do not fit each other or the gaussians, do not guarantee an exact cut, or
            ``config`` is not JSON.
    """

    def __init__(
        self,
        clusters: Clusters,
        groups: Groups,
        gaussians: Gaussians,
        config: dict[str, Any] | None = None,
    ) -> None:
        for name, value, kind in (
            ("clusters", clusters, Clusters),
            ("groups", groups, Groups),
            ("gaussians", gaussians, Gaussians),
        ):
            if not isinstance(value, kind):
                raise TypeError(f"{name}: expected {kind.__name__}, got {type(value).__name__}")
        check_tables(clusters, groups, len(gaussians))
        self._set(clusters, groups, gaussians.sh_degree, config or {}, gaussians.numpy(), None)

    def _set(
        self,
        clusters: Clusters,
        groups: Groups,
        sh_degree: int,
        config: dict[str, Any],
        gaussians: Gaussians | None,
        file: BundleFile | None,
    ) -> None:
        self._config_json = _to_json(config)
        self.config: dict[str, Any] = parse_json(self._config_json)
        self.clusters = clusters
        self.groups = groups
        self.sh_degree = sh_degree
        self._page_start = _page_starts(clusters)
        self._gaussians = gaussians  # None: in the file
        self._file = file
        self._last_page: tuple[int, Gaussians] | None = None

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Bundle:
        """Open a bundle file: read and check its header and tables, leave the gaussians on disk until used.

        The file stays open, so a file that is later saved over it does not change this bundle.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not a bundle, is newer than this build can read, or is damaged; the message says
                which file and field. Damage in the gaussians is found when they are read.
        """
        file = BundleFile(path)
        tables = file.tables
        try:
            clusters = Clusters(**{f.name: tables[f"clusters.{f.name}"] for f in fields(Clusters)})
            groups = Groups(**{f.name: tables[f"groups.{f.name}"] for f in fields(Groups)})
            num_gaussians = int(clusters.offset[-1])
            most = file.pages_bytes // (4 * bundle_file.floats_per_gaussian(file.sh_degree))
            if num_gaussians > most:  # before anything is computed from it
                raise ValueError(
                    f"clusters.offset[-1]: expected at most {most} gaussians, got {num_gaussians}"
                )
            check_tables(clusters, groups, num_gaussians)
            _check_page_tables(tables, _page_tables(clusters, file.sh_degree), file.pages_bytes)
        except ValueError as error:
            file.close()
            raise ValueError(f"{file.path}: {error}") from None
        bundle = cls.__new__(cls)
        bundle._set(clusters, groups, file.sh_degree, file.config, None, file)
        return bundle

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write the bundle to a file; the same bundle gives the same bytes.

        The file appears at ``path`` when it is complete and not before: on an error or an interrupt, what was
        there stays and nothing else is left.
        """
        tables: dict[str, NDArray[Any]] = {
            f"{name}.{f.name}": getattr(table, f.name)
            for name, table in (("clusters", self.clusters), ("groups", self.groups))
            for f in fields(table)
        }
        tables |= _page_tables(self.clusters, self.sh_degree)
        pages = (self._page_attributes(page) for page in range(self.num_pages))
        bundle_file.write(path, tables, pages, sh_degree=self.sh_degree, config_json=self._config_json)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what is in memory, and of a file its path: the copy opens it again."""
        if self._file is not None:
            return Bundle.open, (os.path.abspath(self._file.path),)
        return Bundle, (self.clusters, self.groups, self._gaussians, self.config)

    @property
    def path(self) -> str | None:
        """File that the bundle was opened from, if it was."""
        return None if self._file is None else os.fspath(self._file.path)

    @property
    def num_levels(self) -> int:
        """Number of levels; 0 for a bundle without clusters."""
        return int(self.clusters.level[-1]) + 1 if len(self.clusters) else 0

    @property
    def num_pages(self) -> int:
        """Number of pages: page g is the clusters that group g replaces, the last page is the last level."""
        return len(self._page_start) - 1

    @property
    def num_gaussians(self) -> int:
        """Number of gaussians of all levels."""
        return int(self.clusters.offset[-1])

    def __repr__(self) -> str:
        where = "" if self._file is None else f", path={self.path!r}"
        return (
            f"Bundle(num_gaussians={self.num_gaussians}, num_clusters={len(self.clusters)}, "
            f"num_levels={self.num_levels}, sh_degree={self.sh_degree}{where})"
        )

    def level_range(self, level: int) -> range:
        """Ids of the clusters of one level."""
        _check_index("level", level, self.num_levels)
        first, last = np.searchsorted(self.clusters.level, [level, level + 1])
        return range(int(first), int(last))

    def page_range(self, page: int) -> range:
        """Ids of the clusters of one page."""
        _check_index("page", page, self.num_pages)
        return range(int(self._page_start[page]), int(self._page_start[page + 1]))

    @property
    def gaussians(self) -> Gaussians:
        """All gaussians, in the order of the clusters; read and verified on first use, then kept."""
        if self._gaussians is None:
            self._gaussians = self._read_pages(0, self.num_pages)
            self._last_page = None
        return self._gaussians

    def read_page(self, page: int) -> Gaussians:
        """Gaussians of the clusters that share parent group ``page``, or of the last level; verified."""
        clusters = self.page_range(page)
        if self._gaussians is not None:
            return self._gaussians.subset(self._gaussian_slice(clusters))
        last_page = self._last_page
        if last_page is None or last_page[0] != page:
            last_page = (page, self._read_pages(page, page + 1))
            self._last_page = last_page
        return last_page[1]

    def cluster_gaussians(self, cluster: int) -> Gaussians:
        """Gaussians of one cluster; reads its page and keeps it until another is read."""
        _check_index("cluster", cluster, len(self.clusters))
        if self._gaussians is not None:
            return self._gaussians.subset(self._gaussian_slice(range(cluster, cluster + 1)))
        page = int(np.searchsorted(self._page_start, cluster, side="right")) - 1
        first = int(self.clusters.offset[self._page_start[page]])
        start, stop = (int(offset) - first for offset in self.clusters.offset[cluster : cluster + 2])
        return self.read_page(page).subset(slice(start, stop))

    def level_gaussians(self, level: int) -> Gaussians:
        """Gaussians of one level; reads the pages of that level only."""
        clusters = self.level_range(level)
        if self._gaussians is not None:
            return self._gaussians.subset(self._gaussian_slice(clusters))
        first, last = np.searchsorted(self._page_start, [clusters.start, clusters.stop])
        return self._read_pages(int(first), int(last))

    def info(self) -> dict[str, Any]:
        """Describe the bundle in JSON values, without reading gaussians; sizes are those of its file."""
        page_tables = _page_tables(self.clusters, self.sh_degree)
        page_level = self.clusters.level[self._page_start[:-1]]
        page_sizes = bundle_file.page_file_bytes(page_tables["pages.bytes"])
        tables = {"clusters.level": self.clusters.level, "groups.parent": self.groups.parent, **page_tables}
        levels = []
        for level in range(self.num_levels):
            clusters = self.level_range(level)
            gaussians = self._gaussian_slice(clusters)
            error = self.groups.error[self.groups.level == level]
            levels.append(
                {
                    "level": level,
                    "clusters": len(clusters),
                    "gaussians": gaussians.stop - gaussians.start,
                    "error_color": _mean(error[:, 0]) if level else 0.0,
                    "error_alpha": _mean(error[:, 1]) if level else 0.0,
                    "bytes": int(page_sizes[page_level == level].sum()),
                }
            )
        return {
            "path": self.path,
            "version": bundle_file.VERSION,
            "bytes": bundle_file.file_bytes(tables, self.sh_degree, self._config_json),
            "sh_degree": self.sh_degree,
            "num_gaussians": self.num_gaussians,
            "num_clusters": len(self.clusters),
            "num_groups": len(self.groups),
            "num_pages": self.num_pages,
            "num_levels": self.num_levels,
            "levels": levels,
            "config": self.config,
        }

    def _page_attributes(self, page: int) -> Sequence[Any]:
        if self._gaussians is None:
            return _attributes(self.read_page(page))
        rows = self._gaussian_slice(self.page_range(page))
        return [array[rows] for array in _attributes(self._gaussians)]

    def _gaussian_slice(self, clusters: range) -> slice:
        offset = self.clusters.offset
        return slice(int(offset[clusters.start]), int(offset[clusters.stop]))

    def _read_pages(self, first_page: int, last_page: int) -> Gaussians:
        """Read a run of pages from the file straight into the arrays of the result."""
        file = self._file
        assert file is not None
        offset = self.clusters.offset[self._page_start]
        start, stop = int(offset[first_page]), int(offset[last_page])
        count = stop - start
        means = np.empty((count, 3), np.float32)
        quats = np.empty((count, 4), np.float32)
        scales = np.empty((count, 3), np.float32)
        opacities = np.empty((count,), np.float32)
        sh = np.empty((count, (self.sh_degree + 1) ** 2, 3), np.float32)

        def read(pages: range) -> None:
            for page in pages:
                rows = slice(int(offset[page]) - start, int(offset[page + 1]) - start)
                file.read_page(page, [array[rows] for array in (means, quats, scales, opacities, sh)])

        tasks = list(_tasks(first_page, last_page, file.tables["pages.bytes"]))
        if len(tasks) == 1:
            read(tasks[0])
        else:
            with ThreadPoolExecutor(min(_READ_THREADS, os.cpu_count() or 1)) as pool:
                list(pool.map(read, tasks))
        return Gaussians(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)


def _tasks(first_page: int, last_page: int, page_bytes: NDArray[np.int64]) -> Iterator[range]:
    """Cut a run of pages into runs that are worth a thread's while."""
    ends = np.cumsum(page_bytes[first_page:last_page]) // _BYTES_PER_TASK
    cuts = (np.flatnonzero(np.diff(ends)) + first_page + 1).tolist()
    for start, stop in zip([first_page, *cuts], [*cuts, last_page], strict=True):
        yield range(start, stop)


def _attributes(gaussians: Gaussians) -> Sequence[Any]:
    """The arrays of a page, in file order."""
    return gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, gaussians.sh


def _page_starts(clusters: Clusters) -> NDArray[np.int64]:
    """First cluster of each page, and the number of clusters: (P+1,)."""
    parent = clusters.parent_group
    starts = np.flatnonzero(parent[1:] != parent[:-1]) + 1
    count = len(clusters)
    return np.concatenate([np.zeros(min(count, 1), np.int64), starts, [count]]).astype(np.int64)


def _page_tables(clusters: Clusters, sh_degree: int) -> dict[str, NDArray[Any]]:
    """The tables of the pages except the hashes; all follow from the clusters."""
    starts = _page_starts(clusters)
    num_bytes = np.diff(clusters.offset[starts]) * (4 * bundle_file.floats_per_gaussian(sh_degree))
    ends = np.cumsum(bundle_file.page_file_bytes(num_bytes))
    return {
        "pages.offset": np.concatenate([np.zeros(1, np.int64), ends])[:-1],
        "pages.bytes": num_bytes,
        "pages.first_cluster": starts[:-1].astype(np.int32),
        "pages.num_clusters": np.diff(starts).astype(np.int32),
    }


def _check_page_tables(
    tables: dict[str, NDArray[Any]], expected: dict[str, NDArray[Any]], pages_bytes: int
) -> None:
    num_pages, expected_num_pages = len(tables["pages.bytes"]), len(expected["pages.bytes"])
    if num_pages != expected_num_pages:
        raise ValueError(f"pages: expected {expected_num_pages} for the clusters, got {num_pages}")
    for name, values in expected.items():
        _check_all(name, tables[name], tables[name] == values, lambda i, v=values: f"{v[i]} for its clusters")
    total = int(bundle_file.page_file_bytes(expected["pages.bytes"]).sum())
    if total != pages_bytes:
        raise ValueError(f"pages: expected {total} bytes for the gaussians, got {pages_bytes}")


def _mean(values: NDArray[np.float32]) -> float | None:
    known = values[~np.isnan(values)]
    return float(known.mean(dtype=np.float64)) if known.size else None


def _to_json(config: dict[str, Any]) -> str:
    if not isinstance(config, dict):
        raise TypeError(f"config: expected a dict, got {type(config).__name__}")
    try:
        return json.dumps(config, sort_keys=True, separators=(",", ":"), allow_nan=False)
    except (TypeError, ValueError, RecursionError) as error:
        raise ValueError(f"config: expected values that JSON can hold, got {error}") from None


def _check_index(name: str, index: int, count: int) -> None:
    if not 0 <= operator.index(index) < count:
        raise ValueError(f"{name}: expected 0 to {count - 1}, got {index}")


def _row_count(name: str, array: object) -> int:
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{name}: expected a NumPy array, got {type(array).__name__}")
    if array.ndim == 0:
        raise ValueError(f"{name}: expected an array with rows, got a scalar")
    return len(array)


def _check_array(name: str, array: object, dtype: type[np.generic], shape: tuple[int, ...]) -> None:
    if not isinstance(array, np.ndarray):
        raise TypeError(f"{name}: expected a NumPy array, got {type(array).__name__}")
    if array.dtype != dtype or array.shape != shape:
        raise ValueError(f"{name}: expected {dtype.__name__} {shape}, got {array.dtype} {array.shape}")
    if not array.flags.c_contiguous:
        raise ValueError(f"{name}: expected a C-contiguous array; use np.ascontiguousarray")


def _check_all(name: str, values: NDArray[Any], good: NDArray[np.bool_], expected: Any) -> None:
    """Name the first row that is not good; ``expected`` is a text, or makes one from the row."""
    if not good.all():
        row = int(np.argmin(good.reshape(len(good), -1).all(1)))
        text = expected(row) if callable(expected) else expected
        raise ValueError(f"{name}[{row}]: expected {text}, got {values[row].tolist()}")


def _after_first(good: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Conditions on neighbours as conditions on rows: the first row meets them."""
    return np.concatenate([np.ones(1, bool), good])


def check_tables(clusters: Clusters, groups: Groups, num_gaussians: int) -> None:
    """Check that the tables fit each other and the gaussians, and that the cut will be exact.

    Raises:
        ValueError: Names the table, its first wrong row and what was expected.
    """
    _check_offsets(clusters, num_gaussians)
    _check_tree(clusters, groups)
    _check_values(clusters, groups)
    _check_nesting(groups)


def _check_offsets(clusters: Clusters, num_gaussians: int) -> None:
    offset, level = clusters.offset, clusters.level
    if len(clusters) >= 1 << 31:
        raise ValueError(f"clusters: expected fewer than 2^31, got {len(clusters)}")
    if offset[0] != 0:
        raise ValueError(f"clusters.offset[0]: expected 0, got {offset[0]}")
    _check_all(
        "clusters.offset", offset, _after_first(offset[1:] >= offset[:-1]), "offsets that never decrease"
    )
    if offset[-1] != num_gaussians:
        raise ValueError(f"clusters.offset[-1]: expected {num_gaussians} gaussians, got {offset[-1]}")
    if len(clusters) and level[0] != 0:
        raise ValueError(f"clusters.level[0]: expected 0, got {level[0]}")
    step = np.diff(level.astype(np.int64))
    _check_all(
        "clusters.level", level, _after_first((step == 0) | (step == 1)), "the level before, or one more"
    )


def _check_tree(clusters: Clusters, groups: Groups) -> None:
    """Every group replaces the clusters of one page and makes clusters of the next level for one parent."""
    num_groups = len(groups)
    level = clusters.level.astype(np.int64)
    last_level = level[-1] if len(level) else 0
    own, parent = clusters.own_group.astype(np.int64), clusters.parent_group.astype(np.int64)
    group_level, group_parent = groups.level.astype(np.int64), groups.parent.astype(np.int64)

    def check_links(name: str, links: Any, expect_none: Any, link_level: Any) -> None:
        inside = (links >= 0) & (links < num_groups)
        found = np.zeros(len(links), np.int64)
        found[inside] = group_level[links[inside]]
        good = np.where(expect_none, links == -1, inside & (found == link_level))
        _check_all(
            name, links, good, lambda i: "-1" if expect_none[i] else f"a group of level {link_level[i]}"
        )

    check_links("clusters.own_group", own, level == 0, level)
    check_links("clusters.parent_group", parent, level == last_level, level + 1)
    _check_all(
        "groups.level", group_level, (group_level >= 1) & (group_level <= last_level), f"1 to {last_level}"
    )
    check_links("groups.parent", group_parent, group_level == last_level, group_level + 1)

    # The last level's clusters count as having a parent of their own past the others.
    order = np.where(level == last_level, num_groups, parent)
    expected = "parents in ascending order, so that groups are in the order of the clusters they replace"
    _check_all("clusters.parent_group", parent, _after_first(order[1:] >= order[:-1]), expected)
    for name, links in (("own_group", own), ("parent_group", parent)):
        num_clusters = np.bincount(links[links >= 0], minlength=num_groups)
        _check_all("groups", np.arange(num_groups), num_clusters > 0, f"a cluster with it as {name}")
    made = own >= 0
    agree = np.ones(len(level), bool)
    agree[made] = parent[made] == group_parent[own[made]]
    _check_all(
        "clusters.parent_group", parent, agree, lambda c: f"{group_parent[own[c]]}, its own group's parent"
    )


def _check_values(clusters: Clusters, groups: Groups) -> None:
    box = clusters.box
    filled = clusters.offset[1:] > clusters.offset[:-1]
    _check_all("clusters.box", box, np.isfinite(box), "finite numbers")
    ordered = (box[:, 0] <= box[:, 1]).all(1) | ~filled
    _check_all("clusters.box", box, ordered, "a lower corner not above the upper")
    filter_px2 = clusters.filter_px2
    _check_all("clusters.filter_px2", filter_px2, np.isfinite(filter_px2) & (filter_px2 >= 0), "0 or more")
    _check_all("clusters.antialiased", clusters.antialiased, clusters.antialiased <= 1, "0 or 1")
    ball, weight = groups.ball, groups.weight
    _check_all("groups.ball", ball, np.isfinite(ball), "finite numbers")
    _check_all(
        "groups.ball", ball, ball[:, 3] >= np.float32(_MIN_RADIUS), f"a radius of {_MIN_RADIUS} or more"
    )
    _check_all("groups.weight", weight, np.isfinite(weight) & (weight > 0), "a positive number")
    bad_error = (groups.error < 0) | np.isinf(groups.error)
    _check_all("groups.error", groups.error, ~bad_error, "0 or more, or not a number where unknown")


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
    _check_all(
        "groups.ball",
        groups.ball,
        held,
        lambda g: (
            f"a ball inside that of group {groups.parent[g]}, whose radius must be at least {needed[g]:.9g}"
        ),
    )
    heavier = np.ones(len(groups), bool)
    heavier[below] = groups.weight[above] >= groups.weight[below]
    _check_all("groups.weight", groups.weight, heavier, "at most the weight of the group above")
