"""Pages: which clusters lie together, and where the gaussians of a page come from. Bytes are codec.py's."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _device
from v3dg.gaussians import Gaussians

if TYPE_CHECKING:
    from collections.abc import Iterator

    from numpy.typing import NDArray

    from v3dg.bundle.file import BundleFile
    from v3dg.bundle.tables import Clusters

_READ_THREADS = 8
_BYTES_PER_TASK = 16 << 20


@dataclass(frozen=True, eq=False)
class PageLayout:
    """P pages in file order: page g is the clusters that group g replaces, the last page is the last level.

    Attributes:
        first_cluster: (P+1,) int64. First cluster of each page, and the number of clusters.
        first_gaussian: (P+1,) int64. First gaussian of each page, and the number of gaussians.
    """

    first_cluster: NDArray[np.int64]
    first_gaussian: NDArray[np.int64]

    @staticmethod
    def of(clusters: Clusters) -> PageLayout:
        """The pages of clusters: those that share a parent group are neighbours."""
        parent = clusters.parent_group
        starts = np.flatnonzero(parent[1:] != parent[:-1]) + 1
        count = len(clusters)
        first = np.concatenate([np.zeros(min(count, 1), np.int64), starts, [count]]).astype(np.int64)
        return PageLayout(first, clusters.offset[first])

    @property
    def num_pages(self) -> int:
        return len(self.first_cluster) - 1

    @property
    def num_gaussians(self) -> NDArray[np.int64]:
        """(P,) of each page."""
        return np.diff(self.first_gaussian)

    def rows(self, first_page: int, last_page: int) -> range:
        """The gaussians of a run of pages."""
        return range(int(self.first_gaussian[first_page]), int(self.first_gaussian[last_page]))

    def slice_in(self, page: int, first_page: int) -> slice:
        """Where a page's gaussians are among those that begin with the first page's."""
        rows, before = self.rows(page, page + 1), int(self.first_gaussian[first_page])
        return slice(rows.start - before, rows.stop - before)


class MemoryPages:
    """Pages whose gaussians are all in memory, on the host."""

    def __init__(self, layout: PageLayout, gaussians: Gaussians) -> None:
        self.layout = layout
        self.gaussians = gaussians

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Gaussians of a run of pages; they share memory with `gaussians`."""
        rows = self.layout.rows(first_page, last_page)
        return self.gaussians.subset(slice(rows.start, rows.stop))

    def write(self, first_page: int, last_page: int, gaussians: Gaussians) -> None:
        """Copy the gaussians of a run of pages, on any device, to their place."""
        place = vars(self.read(first_page, last_page)).values()
        for array, out in zip(vars(gaussians).values(), place, strict=True):
            _device.copy_to_host(array, out)


class FilePages:
    """Pages that are read from a file when they are asked for; a single one is kept until the next."""

    def __init__(self, layout: PageLayout, file: BundleFile) -> None:
        self.layout = layout
        self._file = file
        self._last_page: tuple[int, Gaussians] | None = None

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Gaussians of a run of pages, on the host; verified."""
        if last_page - first_page != 1:
            return self._read(first_page, last_page)
        kept = self._last_page
        if kept is None or kept[0] != first_page:
            self._last_page = kept = (first_page, self._read(first_page, last_page))
        return kept[1]

    def _read(self, first_page: int, last_page: int) -> Gaussians:
        """Read pages straight into the arrays of the result."""
        result = self._file.codec.empty(len(self.layout.rows(first_page, last_page)))

        def read(pages: range) -> None:
            for page in pages:
                read_arrays = partial(self._file.read_page, page)
                self._file.codec.decode(read_arrays, result, self.layout.slice_in(page, first_page))

        tasks = list(runs_of_pages(first_page, last_page, self._file.tables["pages.bytes"], _BYTES_PER_TASK))
        if len(tasks) == 1:
            read(tasks[0])
        else:
            with ThreadPoolExecutor(min(_READ_THREADS, os.cpu_count() or 1)) as pool:
                list(pool.map(read, tasks))
        return result


def runs_of_pages(
    first_page: int, last_page: int, page_bytes: NDArray[np.int64], num_bytes: int
) -> Iterator[range]:
    """Cut a run of pages into runs of about so many bytes: enough work, and little memory."""
    ends = np.cumsum(page_bytes[first_page:last_page]) // num_bytes
    cuts = (np.flatnonzero(np.diff(ends)) + first_page + 1).tolist()
    for start, stop in zip([first_page, *cuts], [*cuts, last_page], strict=True):
        yield range(start, stop)
