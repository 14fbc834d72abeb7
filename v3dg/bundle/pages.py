"""Pages: the clusters of each page, and the sources of their gaussians. codec.py
defines the bytes of a page."""

import itertools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, TypeAlias, TypeVar

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
    """The division of all clusters into P pages. Page g contains the clusters that
    group g replaces; the last page contains the last level."""

    # (P+1,) index of the first cluster of each page, and the number of clusters.
    first_cluster: NDArray[np.int64]
    offset: NDArray[np.int64]  # (C+1,) boundaries of the gaussians of clusters

    @staticmethod
    def of(clusters: Clusters) -> "PageLayout":
        """Return the pages of clusters. Clusters with the same parent group must be
        neighbours."""
        parent = clusters.parent_group
        starts = np.flatnonzero(parent[1:] != parent[:-1]) + 1
        count = len(clusters)
        first = np.concatenate([np.zeros(min(count, 1), np.int64), starts, [count]]).astype(
            np.int64
        )
        return PageLayout(first, clusters.offset)

    @cached_property
    def first_gaussian(self) -> NDArray[np.int64]:
        """(P+1,) index of the first gaussian of each page, and the number of
        gaussians."""
        return self.offset[self.first_cluster]

    @property
    def num_pages(self) -> int:
        return len(self.first_cluster) - 1

    def clusters_of(self, page: int) -> NDArray[np.int64]:
        """Return the boundaries of the gaussians of a page's clusters, as indices in
        the bundle."""
        return self.offset[self.first_cluster[page] : self.first_cluster[page + 1] + 1]

    def page_bytes(self, codec: Codec) -> NDArray[np.int64]:
        """Return (P,) the size of each page in bytes, including padding."""
        return codec.page_bytes(np.diff(self.first_gaussian), np.diff(self.first_cluster))

    def run(self, first_page: int, last_page: int, places: NDArray[np.int64]) -> "PageRun":
        """Return the pages from `first_page` up to, but not including, `last_page`.
        ``places`` has the offset of each page in a file, and the end of the last page.
        """
        clusters = self.first_cluster[first_page : last_page + 1]
        return PageRun(
            first_page=first_page,
            first_cluster=clusters - clusters[0],
            offset=self.offset[clusters[0] : clusters[-1] + 1],
            places=places[first_page : last_page + 1],
        )


@dataclass(frozen=True, eq=False)
class PageRun:
    """Neighbouring pages: their clusters, the rows of their gaussians, and their
    positions in a file."""

    first_page: int  # index of the first page in the bundle
    # (n+1,) index of the first cluster of each page, relative to the first cluster of
    # the run, and the number of clusters in the run.
    first_cluster: NDArray[np.int64]
    # Boundaries of the gaussians of all clusters, as indices in the bundle.
    offset: NDArray[np.int64]
    places: NDArray[np.int64]  # (n+1,) offset of each page in the file, and the end

    def __len__(self) -> int:
        return len(self.places) - 1

    @property
    def core(self) -> _core.PageRun:
        """The pages for the compiled operations."""
        return _core.PageRun(
            first_page=self.first_page,
            first_cluster=self.first_cluster,
            offset=self.offset,
            places=self.places,
        )

    @property
    def rows(self) -> slice:
        """The rows of all gaussians in the bundle."""
        return slice(int(self.offset[0]), int(self.offset[-1]))


class MemoryPages:
    """The pages of a bundle whose float32 gaussians are all in memory."""

    def __init__(self, layout: PageLayout, gaussians: Gaussians, codec: Codec) -> None:
        self.layout = layout
        self.gaussians = gaussians
        self.codec = codec

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Return the gaussians of neighbouring pages. They share memory with
        `gaussians`."""
        first, last = self.layout.first_gaussian[[first_page, last_page]].tolist()
        return self.gaussians.subset(slice(first, last))

    def codes_of(self, page: int) -> NDArray[np.int32]:
        """Return a page of the codec "quantized" with these gaussians, rounded."""
        return encoded(self.read(page, page + 1), self.layout, page)


class CodePages:
    """The pages of a quantised bundle whose codes are all in memory; gaussians are
    decoded on demand."""

    def __init__(self, layout: PageLayout, words: NDArray[np.int32], codec: Codec) -> None:
        self.layout = layout
        self.codec = codec
        self._words = words
        self.codes = _core.Codes(words, layout.first_cluster, layout.offset, codec.sh_degree)

    @staticmethod
    def of(layout: PageLayout, gaussians: Gaussians, codec: Codec) -> "CodePages":
        """Return the pages of gaussians on the host."""
        places = offset_of(layout.page_bytes(codec) // 4)  # counted in 32-bit integers
        words = np.empty(int(places[-1]), np.int32)

        def encode(page: int) -> None:
            encoded = _core.encode_page(gaussians.rows, layout.clusters_of(page))
            words[places[page] : places[page + 1]] = encoded

        on_threads(encode, range(layout.num_pages))
        return CodePages(layout, words, codec)

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Return the gaussians of neighbouring pages."""
        clusters = np.arange(*self.layout.first_cluster[[first_page, last_page]], dtype=np.int32)
        return Gaussians(*_core.Model(self.codes, CPU.number).decode(clusters))

    @cached_property
    def _first_word(self) -> NDArray[np.int64]:
        return offset_of(self.layout.page_bytes(self.codec) // 4)

    def codes_of(self, page: int) -> NDArray[np.int32]:
        """Return a page; it shares memory with these pages."""
        first, last = self._first_word[[page, page + 1]].tolist()
        return self._words[first:last]


class FilePages:
    """Pages that are read from a file on demand. The most recent page that was read
    alone is cached."""

    def __init__(self, layout: PageLayout, file: "BundleFile") -> None:
        self.layout = layout
        self.codec = file.codec
        self._file = file
        # The tuple is always replaced as a whole, because threads read it without a
        # lock.
        self._last_page: tuple[int, Gaussians | None] = (-1, None)

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Return the gaussians of the pages from ``first_page`` up to, but not
        including, ``last_page`` on the host, after verifying their hashes."""
        cached_page, cached = self._last_page
        if first_page == cached_page == last_page - 1 and cached is not None:
            return cached
        run = self.layout.run(first_page, last_page, self._file.places)
        gaussians = self.codec.empty(run.rows.stop - run.rows.start)
        self._file.read(run, gaussians.rows)
        if last_page - first_page == 1:
            self._last_page = (first_page, gaussians)
        return gaussians

    def codes_of(self, page: int) -> NDArray[np.int32]:
        """Return a page of the codec "quantized", after verifying its hash. Gaussians
        of the codec "float32" are rounded."""
        if self.codec.name == Codec.name:
            return encoded(self.read(page, page + 1), self.layout, page)
        run = self.layout.run(page, page + 1, self._file.places)
        words = np.empty((run.places[-1] - run.places[0]) // 4, np.int32)
        self._file.read(run, words)
        return words

    def in_memory(self) -> MemoryPages | CodePages:
        """Read and verify all pages, and return them in memory."""
        if self.codec.name == Codec.name:
            return MemoryPages(self.layout, self.read(0, self.layout.num_pages), self.codec)
        run = self.layout.run(0, self.layout.num_pages, self._file.places)
        words = np.empty((run.places[-1] - run.places[0]) // 4, np.int32)
        self._file.read(run, words)
        try:
            return CodePages(self.layout, words, self.codec)
        except ValueError as error:
            raise ValueError(f"{self._file.path}: {error}; {_core.DAMAGED}") from None


class JoinedPages:
    """The pages of several other bundles, which are read from those bundles when they
    are needed."""

    def __init__(
        self,
        layout: PageLayout,
        sources: Sequence["Pages"],
        source: NDArray[np.int64],
        page: NDArray[np.int64],
    ) -> None:
        """Args:
        source, page: (P,) for each page, the index of its source, and its index in that
            source.
        """
        self.layout = layout
        self.codec: Codec = sources[0].codec
        self._sources = sources
        self._source = source
        self._page = page

    def read(self, first_page: int, last_page: int) -> Gaussians:
        """Return the gaussians of neighbouring pages."""
        source = self._source[first_page:last_page]
        page = self._page[first_page:last_page]
        follows = (np.diff(source) == 0) & (np.diff(page) == 1)
        pieces: list[Gaussians] = [
            self._sources[source[run.start]].read(int(page[run.start]), int(page[run.stop - 1]) + 1)
            for run in runs_that_follow(follows)
        ]
        if len(pieces) == 1:
            return pieces[0]
        return Gaussians.concatenate(pieces)

    def codes_of(self, page: int) -> NDArray[np.int32]:
        """Return a page of the codec "quantized"; gaussians of the codec "float32" are
        rounded."""
        source: Pages = self._sources[self._source[page]]
        return source.codes_of(int(self._page[page]))

    def in_memory(self) -> MemoryPages | CodePages:
        """Read all pages, and return them in memory."""
        gaussians = self.read(0, self.layout.num_pages)
        if self.codec.name == Codec.name:
            return MemoryPages(self.layout, gaussians, self.codec)
        return CodePages.of(self.layout, gaussians, self.codec)


Pages: TypeAlias = MemoryPages | CodePages | FilePages | JoinedPages
"""The pages of a bundle: in memory, in a file, or in other bundles."""


def encoded(gaussians: Gaussians, layout: PageLayout, page: int) -> NDArray[np.int32]:
    """Return the gaussians of a page as a page of the codec "quantized"."""
    clusters = layout.clusters_of(page)
    return _core.encode_page(gaussians.rows, clusters - clusters[0])


def on_threads(
    work: Callable[[_Item], _Result], items: Sequence[_Item], max_threads: int = _MAX_THREADS
) -> list[_Result]:
    """Return the results of ``work`` for all items, which several threads compute."""
    if len(items) < 2:
        return list(map(work, items))
    with ThreadPoolExecutor(max_threads) as pool:
        return list(pool.map(work, items))


def runs_that_follow(follows: NDArray[np.bool_]) -> Iterator[range]:
    """Yield the runs of N items in which each item follows the one before it. `follows`
    has N - 1 flags, of the items after the first."""
    starts = [0, *(np.flatnonzero(~follows) + 1).tolist()]
    for start, stop in itertools.pairwise([*starts, len(follows) + 1]):
        yield range(start, stop)


def runs_of_pages(
    first_page: int, last_page: int, page_bytes: NDArray[np.int64], num_bytes: int
) -> Iterator[range]:
    """Split a range of pages into smaller ranges of about ``num_bytes`` each, which
    limits the memory for one of them."""
    ends = np.cumsum(page_bytes[first_page:last_page]) // num_bytes
    cuts = (np.flatnonzero(np.diff(ends)) + first_page + 1).tolist()
    for start, stop in zip([first_page, *cuts], [*cuts, last_page], strict=True):
        yield range(start, stop)
