"""The class `Bundle`: the clusters of all levels of one asset, in memory or in a
file."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable, Sequence
from dataclasses import fields, replace

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _files
from v3dg._json import JsonObject, parse_json
from v3dg._numbers import check, check_all, check_type
from v3dg._urls import in_parts, is_url, shown
from v3dg.bundle.codec import Codec, codec_of
from v3dg.bundle.file import BundleFile, BundlePlan, write_pages
from v3dg.bundle.format import HASH_BYTES, VERSION, config_to_json, page_tables
from v3dg.bundle.pages import (
    CodePages,
    FilePages,
    MemoryPages,
    PageLayout,
    Pages,
    on_threads,
    runs_of_pages,
    runs_that_follow,
)
from v3dg.bundle.tables import Clusters, Groups, check_index, check_tables
from v3dg.gaussians import Gaussians

_RUN_BYTES = 64 << 20  # bytes of pages that are encoded together


class Bundle:
    """All clusters of all levels of one asset, in memory, or in a file whose pages are
    read on demand.

    Attributes:
        config: The settings of the build as a JSON object.
        sh_degree: SH degree of all gaussians, 0 to 3.
        codec: The encoding of gaussians in the file. "float32" is lossless. "quantized"
            takes 16 bytes (SH degree 0) to 40 bytes (degree 3) per gaussian, and rounds
            gaussians when the bundle is created; docs/format.md lists the errors.

    Raises:
        ValueError: The tables are inconsistent with each other or with the gaussians,
            or do not guarantee an exact cut; ``config`` is not JSON; or the codec is
            unknown or cannot represent a value.
    """

    def __init__(
        self,
        clusters: Clusters,
        groups: Groups,
        gaussians: Gaussians,
        config: JsonObject | None = None,
        codec: str = Codec.name,
    ) -> None:
        check_type("clusters", clusters, Clusters, "Clusters")
        check_type("groups", groups, Groups, "Groups")
        check_type("gaussians", gaussians, Gaussians, "Gaussians")
        # The tables are constructed again, because tables that were unpickled have not
        # been checked, and their arrays are writable.
        clusters = replace(clusters)
        groups = replace(groups)
        check_tables(clusters, groups, len(gaussians))
        page_codec = codec_of(codec, gaussians.sh_degree)
        gaussians = page_codec.rounded(gaussians.numpy(), clusters.offset)
        if codec != Codec.name:
            clusters = clusters.around(gaussians)
        layout = PageLayout.of(clusters)
        pages: Pages
        if codec == Codec.name:
            pages = MemoryPages(layout, gaussians, page_codec)
        else:
            pages = CodePages.of(layout, gaussians, page_codec)
        self._set(clusters, groups, parse_json(config_to_json(config or {})), pages)

    def _set(
        self,
        clusters: Clusters,
        groups: Groups,
        config: JsonObject,
        pages: Pages,
        file: BundleFile | None = None,
    ) -> None:
        self.config = config
        self._clusters = clusters
        self._groups = groups
        self._codec = pages.codec
        self.codec = pages.codec.name
        self.sh_degree = pages.codec.sh_degree
        self._layout = pages.layout
        self._pages = pages
        self._file = file

    @classmethod
    def of_pages(
        cls, clusters: Clusters, groups: Groups, config: JsonObject, pages: Pages
    ) -> Bundle:
        """Return a bundle with these pages, which are read when they are needed.

        Raises:
            ValueError: The tables are inconsistent, or do not guarantee an exact cut.
        """
        clusters = replace(clusters)
        check_tables(clusters, groups, int(clusters.offset[-1]))
        bundle = cls.__new__(cls)
        cls._set(bundle, clusters, groups, parse_json(config_to_json(config)), pages)
        return bundle

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Bundle:
        """Open a bundle file. Its header and tables are read and checked; its gaussians
        stay on disk until they are used.

        The file stays open, so saving another file over it does not change this bundle.
        With the extra `fsspec`, the file may be at a URL. Only the parts that are used
        are downloaded, once per process.

        Raises:
            FileNotFoundError: The file does not exist.
            ValueError: The file is not a bundle, has a newer version, or is damaged;
                the message names the file and the field. Damaged gaussians are detected
                when they are read.
        """
        return cls.open_all([in_parts(path)])[0]

    @classmethod
    def open_all(cls, paths: Iterable[str | os.PathLike[str]]) -> list[Bundle]:
        """Open several bundle files concurrently; see `open`.

        Raises:
            FileNotFoundError, ValueError: See `open`. If several files are invalid, the
                error is that of the first one.
        """
        reader = _core.HashedReader()
        paths = list(paths)
        try:
            # More threads than processors are useful, because disks process several
            # requests at once.
            return on_threads(
                lambda path: cls._open(BundleFile(path, reader)), paths, max_threads=8
            )
        except (OSError, ValueError):
            for path in paths[:-1]:
                cls.open_all([path])  # raises the error of this file if it is invalid
            raise

    @classmethod
    def _open(cls, file: BundleFile) -> Bundle:
        tables = file.tables
        try:
            clusters = Clusters(**{f.name: tables[f"clusters.{f.name}"] for f in fields(Clusters)})
            groups = Groups(**{f.name: tables[f"groups.{f.name}"] for f in fields(Groups)})
            num_gaussians = int(clusters.offset[-1])
            # The number of gaussians must be checked before any size is computed from
            # it.
            max_gaussians = file.pages_bytes // file.codec.gaussian_bytes
            expected = f"at most {max_gaussians} gaussians, got {num_gaussians}"
            check("clusters.offset[-1]", num_gaussians <= max_gaussians, expected)
            check_tables(clusters, groups, num_gaussians)
            pages = FilePages(PageLayout.of(clusters), file)
            _check_page_tables(pages, file)
            bundle = cls.__new__(cls)
            cls._set(bundle, clusters, groups, file.config, pages, file)
        except ValueError as error:
            # Inconsistent tables are mostly due to damage, which `verify` reports.
            file.verify()
            raise ValueError(f"{file.path}: {error}") from None
        file.verify()  # last, because the tables are hashed while they are checked
        return bundle

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the bundle to a file. Equal bundles give the same bytes.

        The file appears at ``path`` only when it is complete. After an error or an
        interrupt, an existing file is unchanged, and no temporary file remains.

        Raises:
            ValueError: The name does not end in `.v3dg`, or it is a device or a pipe.
            OSError: The file cannot be written.
        """
        _files.check_bundle_name(path)
        page_bytes = self._layout.page_bytes(self._codec)
        plan = BundlePlan(self._layout, self._codec, self.config)
        with _files.replacing(path) as temporary, open(temporary, "wb", buffering=0) as file:
            hashes = [np.empty((0, HASH_BYTES), np.uint8)]
            for pages in runs_of_pages(0, self.num_pages, page_bytes, _RUN_BYTES):
                gaussians = self._pages.read(pages.start, pages.stop)
                run = plan.run(pages.start, pages.stop)
                hashes.append(write_pages(temporary, file.fileno(), run, self._codec, gaussians))
            plan.write_tables(file.fileno(), self.clusters, self.groups, np.concatenate(hashes))
            plan.write_header(file.fileno())

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        """Pickle a bundle in memory completely. A bundle in a file is pickled as its
        path; unpickling opens the file."""
        path = self.path
        if path is not None:
            if not is_url(path):
                path = os.path.abspath(path)
            return Bundle.open, (path,)
        return Bundle, (self.clusters, self.groups, self.gaussians, self.config, self.codec)

    @property
    def clusters(self) -> Clusters:
        """The table of all clusters."""
        return self._clusters

    @property
    def groups(self) -> Groups:
        """The table of all groups."""
        return self._groups

    @property
    def path(self) -> str | None:
        """Name or complete URL of the bundle's file; None for a bundle in memory."""
        if self._file is None:
            return None
        return self._file.name

    @property
    def num_levels(self) -> int:
        """Number of levels; 0 for a bundle without clusters."""
        if not len(self.clusters):
            return 0
        return int(self.clusters.level[-1]) + 1

    @property
    def num_pages(self) -> int:
        """Number of pages. Page g contains the clusters that group g replaces; the last
        page contains the last level."""
        return self._layout.num_pages

    @property
    def num_gaussians(self) -> int:
        """Number of gaussians in all levels together."""
        return int(self.clusters.offset[-1])

    def __repr__(self) -> str:
        path = ""
        if self._file is not None:
            path = f", path={self._file.path!r}"
        return (
            f"Bundle(num_gaussians={self.num_gaussians}, num_clusters={len(self.clusters)}, "
            f"num_levels={self.num_levels}, sh_degree={self.sh_degree}{path})"
        )

    def _repr_html_(self) -> str:
        """Return a summary and a table of the levels as HTML, for notebooks."""
        names = ("level", "clusters", "gaussians", "bytes")
        rows = [names, *([f"{level[name]:,}" for name in names] for level in self.info()["levels"])]
        cells = "".join(f"<tr><td>{'<td>'.join(row)}" for row in rows)
        return f"<p>{html.escape(repr(self))}<table>{cells}</table>"

    def level_range(self, level: int) -> range:
        """Return the indices of the clusters in a level."""
        check_index("level", level, self.num_levels)
        first, last = np.searchsorted(self.clusters.level, [level, level + 1])
        return range(int(first), int(last))

    def level_rows(self, level: int) -> slice:
        """Return the rows of the gaussians of a level, among all gaussians."""
        clusters = self.level_range(level)
        first, last = self.clusters.offset[[clusters.start, clusters.stop]].tolist()
        return slice(first, last)

    @property
    def num_leaves(self) -> int:
        """Number of gaussians of level 0; 0 for a bundle without levels."""
        end = np.searchsorted(self.clusters.level, 1)
        return int(self.clusters.offset[end])

    def page_range(self, page: int) -> range:
        """Return the indices of the clusters in a page."""
        check_index("page", page, self.num_pages)
        first = self._layout.first_cluster
        return range(int(first[page]), int(first[page + 1]))

    @property
    def gaussians(self) -> Gaussians:
        """All gaussians, in the order of the clusters. They are read and verified on
        first use, and then cached.

        A quantised bundle caches its codes instead, and decodes them to new arrays on
        each use.
        """
        pages = self._in_memory()
        if isinstance(pages, MemoryPages):
            return pages.gaussians
        return pages.read(0, self.num_pages)

    @property
    def codes(self) -> _core.Codes | None:
        """All codes of a quantised bundle, for the compiled operations. They are read
        and verified on first use, and then cached."""
        if self.codec == Codec.name:
            return None
        pages = self._in_memory()
        assert isinstance(pages, CodePages)
        return pages.codes

    def _in_memory(self) -> MemoryPages | CodePages:
        if not isinstance(self._pages, MemoryPages | CodePages):
            self._pages = self._pages.in_memory()
        return self._pages

    @property
    def page_bytes(self) -> int:
        """Total size of all pages in bytes, in memory and in the file."""
        return int(self._layout.page_bytes(self._codec).sum())

    @property
    def is_in_memory(self) -> bool:
        """Whether all gaussians are in memory; if not, they are read page by page."""
        return isinstance(self._pages, MemoryPages | CodePages)

    @property
    def page_source(self) -> _core.Rows | _core.FileSource:
        """The source from which the core reads single pages: the file, or the gaussians
        if they are in memory."""
        if self._file is None or isinstance(self._pages, MemoryPages):
            return self.gaussians.rows
        return self._file.source

    def read_page(self, page: int) -> Gaussians:
        """Return the gaussians of a page, after verifying its hash. Page g contains the
        clusters that group g replaces; the last page contains the coarsest level, which
        no group replaces."""
        check_index("page", page, self.num_pages)
        return self._pages.read(page, page + 1)

    @property
    def page_layout(self) -> PageLayout:
        """The clusters of each page."""
        return self._layout

    def code_pages(self, pages: Sequence[int]) -> list[NDArray[np.int32]]:
        """Return pages of the codec "quantized". If the bundle has the codec "float32",
        its gaussians are rounded.

        Raises:
            ValueError: A page is damaged, or cannot be rounded.
            OSError: A page cannot be read.
        """
        return on_threads(self._pages.codes_of, pages)

    @property
    def page_hashes(self) -> NDArray[np.uint8]:
        """(P, 16) the hashes of the pages in the bundle's file.

        Raises:
            ValueError: The bundle is not in a file.
        """
        check(
            "bundle", self._file is not None, "a bundle in a file, got one in memory; save it first"
        )
        assert self._file is not None
        return self._file.tables["pages.hash"]

    @property
    def pages(self) -> Pages:
        """The pages, in memory or read when they are needed."""
        return self._pages

    def pages_of(self, clusters: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the indices of the pages that contain clusters, each once, ascending.
        The clusters must be in ascending order."""
        pages = np.searchsorted(self._layout.first_cluster, clusters, side="right") - 1
        return np.unique(pages)

    def pages_gaussians(self, pages: NDArray[np.int64]) -> Gaussians:
        """Return the gaussians of some pages, in the order of the pages."""
        pieces = [
            self._pages.read(int(pages[run.start]), int(pages[run.stop - 1]) + 1)
            for run in runs_that_follow(np.diff(pages) == 1)
        ]
        return Gaussians.concatenate(pieces)

    def cluster_gaussians(self, cluster: int) -> Gaussians:
        """Return the gaussians of one cluster. The cluster's page is cached until
        another page is read."""
        check_index("cluster", cluster, len(self.clusters))
        page = int(np.searchsorted(self._layout.first_cluster, cluster, side="right")) - 1
        first = int(self._layout.first_gaussian[page])
        start = int(self.clusters.offset[cluster]) - first
        stop = int(self.clusters.offset[cluster + 1]) - first
        return self.read_page(page).subset(slice(start, stop))

    def level_gaussians(self, level: int) -> Gaussians:
        """Return the gaussians of a level; only the pages of that level are read. The
        gaussians of level 0 have `antialiased` set if the asset was trained with
        antialiasing."""
        clusters = self.level_range(level)
        first, last = np.searchsorted(self._layout.first_cluster, [clusters.start, clusters.stop])
        gaussians = self._pages.read(int(first), int(last))
        table = self.clusters.antialiased[clusters.start : clusters.stop]
        if level == 0 and len(table) and table.all():
            return gaussians.trained(antialiased=True)
        return gaussians

    def info(self) -> JsonObject:
        """Return a description of the bundle as a JSON object, without reading
        gaussians. Sizes in bytes are those of the bundle's file."""
        page_level = self.clusters.level[self._layout.first_cluster[:-1]]
        page_sizes = self._layout.page_bytes(self._codec)
        sizes = [int(page_sizes[page_level == level].sum()) for level in range(self.num_levels)]
        if self._file is not None:
            version = self._file.version
            num_bytes = self._file.num_bytes
        else:
            version = VERSION
            num_bytes = BundlePlan(self._layout, self._codec, self.config).num_bytes
        path = None
        if self.path is not None:
            path = shown(self.path)
        return {
            "path": path,
            "version": version,
            "codec": self.codec,
            "bytes": num_bytes,
            "sh_degree": self.sh_degree,
            "num_gaussians": self.num_gaussians,
            "num_clusters": len(self.clusters),
            "num_groups": len(self.groups),
            "num_pages": self.num_pages,
            "num_levels": self.num_levels,
            "levels": [self._level_info(level, size) for level, size in enumerate(sizes)],
            "config": self.config,
        }

    def _level_info(self, level: int, size: int) -> JsonObject:
        clusters = self.level_range(level)
        first, last = self.clusters.offset[[clusters.start, clusters.stop]].tolist()
        error_color: float | None = 0.0
        error_alpha: float | None = 0.0
        if level:
            errors = self.groups.error[self.groups.level == level]
            error_color = _mean_of_known(errors[:, 0])
            error_alpha = _mean_of_known(errors[:, 1])
        return {
            "level": level,
            "clusters": len(clusters),
            "gaussians": last - first,
            "error_color": error_color,
            "error_alpha": error_alpha,
            "bytes": size,
        }


def _check_page_tables(pages: FilePages, file: BundleFile) -> None:
    num_pages = len(file.tables["pages.offset"])
    expected_num_pages = pages.layout.num_pages
    check(
        "pages",
        num_pages == expected_num_pages,
        f"{expected_num_pages} pages for the clusters of the file, got {num_pages}",
    )
    for name, expected in page_tables(pages.layout, pages.codec).items():
        values = file.tables[name]
        check_all(
            name,
            values,
            values == expected,
            lambda row, e=expected: f"{e[row]}, which follows from the clusters",
        )
    total = int(pages.layout.page_bytes(pages.codec).sum())
    check(
        "pages",
        total == file.pages_bytes,
        f"{total} bytes for all gaussians, got {file.pages_bytes}",
    )


def _mean_of_known(values: NDArray[np.float32]) -> float | None:
    """Return the mean of all values that are not NaN, which means unknown; None if all
    are NaN."""
    numbers = values[~np.isnan(values)]
    if not numbers.size:
        return None
    return float(numbers.mean(dtype=np.float64))
