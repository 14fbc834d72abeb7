"""Pages: the clusters of each, and the sources of their gaussians. codec.py defines
their bytes."""

import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._device import CPU
from v3dg.bundle.codec import Codec
from v3dg.bundle.format import offset_of
from v3dg.bundle.tables import Clusters
from v3dg.gaussians import Gaussians

if TYPE_CHECKING:
    from v3dg.bundle.file import BundleFile

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")
_MAX_THREADS = min(8, os.cpu_count() or 1)


@dataclass(frozen=True, eq=False)
class PageLayout:
    """P pages in file order: page g is what group g replaces, the last page is the last
    level."""

    first_cluster: NDArray[np.int64]  # (P+1,) of each page, and the number of clusters
    offset: NDArray[np.int64]  # (C+1,) gaussians of each cluster

    @staticmethod
    def of(clusters: Clusters) -> "PageLayout":
        """The pages of clusters: those that share a parent group are neighbours."""
        parent = clusters.parent_group
        starts = np.flatnonzero(parent[1:] != parent[:-1]) + 1
        count = len(clusters)
        first = np.concatenate([np.zeros(min(count, 1), np.int64), starts, [count]]).astype(
            np.int64
        )
        return PageLayout(first, clusters.offset)

    @cached_property
    def first_gaussian(self) -> NDArray[np.int64]:
        """(P+1,) of each page, and the number of gaussians."""
        return self.offset[self.first_cluster]

    @property
    def num_pages(self) -> int:
        return len(self.first_cluster) - 1

    def clusters_of(self, page: int) -> NDArray[np.int64]:
        """Gaussians of each cluster of a page, in the bundle; and the end."""
        return self.offset[self.first_cluster[page] : self.first_cluster[page + 1] + 1]

    def page_bytes(self, codec: Codec) -> NDArray[np.int64]:
        """(P,) size of each page, including padding."""
        return codec.page_bytes(np.diff(self.first_gaussian), np.diff(self.first_cluster))

    def run(self, first_page: int, last_page: int, places: NDArray[np.int64]) -> "PageRun":
        """A run of the pages; ``places`` has the first byte of every page in a file,
        and the end."""
        clusters = self.first_cluster[first_page : last_page + 1]
        return PageRun(
            first_page=first_page,
            first_cluster=clusters - clusters[0],
            offset=self.offset[clusters[0] : clusters[-1] + 1],
            places=places[first_page : last_page + 1],
        )


@dataclass(frozen=True, eq=False)
class PageRun:
    """Neighbouring pages: their clusters, the rows of their gaussians and their place
    in the file."""

    first_page: int  # number in the bundle
    first_cluster: NDArray[np.int64]  # (n+1,) of each page, in the run, and the end
    offset: NDArray[np.int64]  # gaussians of each cluster of the run, in the bundle, and the end
    places: NDArray[np.int64]  # (n+1,) first byte of each page in the file, and the end

    def __len__(self) -> int:
        return len(self.places) - 1

    @property
    def core(self) -> _core.PageRun:
        """The run for the compiled operations."""
        return _core.PageRun(
            first_page=self.first_page,
            first_cluster=self.first_cluster,
            offset=self.offset,
            places=self.places,
        )

    @property
    def rows(self) -> slice:
        """Their gaussians in the bundle."""
        return slice(int(self.offset[0]), int(self.offset[-1]))

    def clusters_of(self, number: int) -> NDArray[np.int64]:
        """Gaussians of each cluster of one page, by its place in the run, among those
        of all; and the end."""
        first, last = self.first_cluster[number : number + 2].tolist()
        return np.asarray(self.offset[first : last + 1] - self.offset[0])


class MemoryPages:
    """Pages of float32 whose gaussians are all in memory, on the host."""

    def __init__(self, layout: PageLayout, gaussians: Gaussians, codec: Codec) -> None:
        self.layout = layout
        self.gaussians = gaussians
        self.codec = codec

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Gaussians of a run of pages; they share memory with `gaussians`."""
        first, last = self.layout.first_gaussian[[first_page, last_page]].tolist()
        return self.gaussians.subset(slice(first, last))


class CodePages:
    """Quantised pages that are all in memory as codes, which are decoded on demand."""

    def __init__(self, layout: PageLayout, words: NDArray[np.int32], codec: Codec) -> None:
        self.layout = layout
        self.codec = codec
        self.codes = _core.Codes(words, layout.first_cluster, layout.offset, codec.sh_degree)

    @staticmethod
    def of(layout: PageLayout, gaussians: Gaussians, codec: Codec) -> "CodePages":
        """The pages of gaussians on the host."""
        places = offset_of(layout.page_bytes(codec) // 4)  # in words
        words = np.empty(int(places[-1]), np.int32)

        def encode(page: int) -> None:
            (encoded,) = codec.encode(gaussians, layout.clusters_of(page))
            words[places[page] : places[page + 1]] = encoded

        on_threads(encode, range(layout.num_pages))
        return CodePages(layout, words, codec)

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Gaussians of a run of pages."""
        clusters = np.arange(*self.layout.first_cluster[[first_page, last_page]], dtype=np.int32)
        return Gaussians(*_core.Model(self.codes, CPU.number).decode(clusters))


class FilePages:
    """Pages that are read from a file on demand; the last single page that was read is
    cached."""

    def __init__(self, layout: PageLayout, file: "BundleFile") -> None:
        self.layout = layout
        self.codec = file.codec
        self._file = file
        # Replaced as a whole, because threads read it without a lock.
        self._last_page: tuple[int, Gaussians | None] = (-1, None)

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Gaussians of a run of pages, on the host; verified."""
        cached_page, cached = self._last_page
        if first_page == cached_page == last_page - 1 and cached is not None:
            return cached
        run = self.layout.run(first_page, last_page, self._file.places)
        gaussians = self.codec.empty(run.rows.stop - run.rows.start)
        self._file.read(run, gaussians.rows)
        if last_page - first_page == 1:
            self._last_page = (first_page, gaussians)
        return gaussians

    def in_memory(self) -> MemoryPages | CodePages:
        """Read all pages into memory and verify them."""
        if self.codec.name == Codec.name:
            return MemoryPages(self.layout, self.read(0, self.layout.num_pages), self.codec)
        run = self.layout.run(0, self.layout.num_pages, self._file.places)
        words = np.empty((run.places[-1] - run.places[0]) // 4, np.int32)
        self._file.read(run, words)
        try:
            return CodePages(self.layout, words, self.codec)
        except ValueError as error:
            raise ValueError(f"{self._file.path}: {error}; {_core.DAMAGED}") from None


def on_threads(
    work: Callable[[_Item], _Result], items: Sequence[_Item], max_threads: int = _MAX_THREADS
) -> list[_Result]:
    """The results of ``work`` for all items, computed by several threads if there are
    several items."""
    if len(items) < 2:
        return list(map(work, items))
    with ThreadPoolExecutor(max_threads) as pool:
        return list(pool.map(work, items))


def runs_of_pages(
    first_page: int, last_page: int, page_bytes: NDArray[np.int64], num_bytes: int
) -> Iterator[range]:
    """Split a run of pages into runs of about ``num_bytes``, which bounds the memory
    that a run takes."""
    ends = np.cumsum(page_bytes[first_page:last_page]) // num_bytes
    cuts = (np.flatnonzero(np.diff(ends)) + first_page + 1).tolist()
    for start, stop in zip([first_page, *cuts], [*cuts, last_page], strict=True):
        yield range(start, stop)
