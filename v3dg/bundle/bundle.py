"""Bundle: all clusters of all levels of one asset; write and open."""

from __future__ import annotations

import html
import os
from collections.abc import Iterable
from dataclasses import fields, replace
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _files
from v3dg._json import parse_json
from v3dg._numbers import check, check_all, check_type
from v3dg._urls import in_parts, is_url, shown
from v3dg.bundle.codec import Codec, codec_of
from v3dg.bundle.file import BundleFile, BundlePlan, write_pages
from v3dg.bundle.format import HASH_BYTES, VERSION, config_to_json, page_tables
from v3dg.bundle.pages import CodePages, FilePages, MemoryPages, PageLayout, on_threads, runs_of_pages
from v3dg.bundle.tables import Clusters, Groups, check_index, check_tables
from v3dg.gaussians import Gaussians

_Pages: TypeAlias = MemoryPages | CodePages | FilePages
_BYTES_AT_ONCE = 64 << 20


class Bundle:
    """All clusters of all levels of one asset. In memory, or a file of which pages are read when needed.

    Attributes:
        config: How it was built, as JSON values.
        sh_degree: 0 to 3, the same for all gaussians.
        codec: How its file keeps gaussians. "float32": every bit. "quantized": in 16 (SH degree 0) to 40
            bytes (degree 3), to which they are rounded when the bundle is made; docs/format.md has the error.

    Raises:
        ValueError: The tables do not fit each other or the gaussians, do not guarantee an exact cut,
            ``config`` is not JSON, or the codec is unknown or cannot hold a value.
    """

    _file: BundleFile | None = None

    def __init__(
        self,
        clusters: Clusters,
        groups: Groups,
        gaussians: Gaussians,
        config: dict[str, Any] | None = None,
        codec: str = Codec.name,
    ) -> None:
        check_type("clusters", clusters, Clusters, "Clusters")
        check_type("groups", groups, Groups, "Groups")
        check_type("gaussians", gaussians, Gaussians, "Gaussians")
        # Made anew, because unpickling leaves out what making does: checks, and that arrays are read-only.
        clusters, groups = replace(clusters), replace(groups)
        check_tables(clusters, groups, len(gaussians))
        kept = codec_of(codec, gaussians.sh_degree)
        gaussians = kept.rounded(gaussians.numpy(), clusters.offset)
        if codec != Codec.name:
            clusters = clusters.around(gaussians)
        layout = PageLayout.of(clusters)
        in_memory = MemoryPages if codec == Codec.name else CodePages.of
        told = parse_json(config_to_json(config or {}))
        self._set(clusters, groups, told, in_memory(layout, gaussians, kept))

    def _set(self, clusters: Clusters, groups: Groups, config: dict[str, Any], pages: _Pages) -> None:
        self.config = config
        self._clusters, self._groups = clusters, groups
        self._codec, self.codec = pages.codec, pages.codec.name
        self.sh_degree = pages.codec.sh_degree
        self._layout = pages.layout
        self._pages = pages

    @classmethod
    def open(cls, path: str | os.PathLike[str]) -> Bundle:
        """Open a bundle file: read and check its header and tables, leave the gaussians on disk until used.

        The file stays open, so a file that is later saved over it does not change this bundle. With the extra
        `fsspec` it may be at a URL, of which what is used is fetched, once by a process.

        Raises:
            FileNotFoundError: There is no such file.
            ValueError: It is not a bundle, is newer than this build can read, or is damaged; the message says
                which file and field. Damage in the gaussians is found when they are read.
        """
        return cls.open_all([in_parts(path)])[0]

    @classmethod
    def open_all(cls, paths: Iterable[str | os.PathLike[str]]) -> list[Bundle]:
        """Open several bundle files as `open` does, at the same time.

        Raises:
            FileNotFoundError, ValueError: As `open`, for the first file with which something is wrong.
        """
        reader, paths = _core.HashedReader(), list(paths)
        try:
            # Also where there are fewer processors: a disk answers several at once.
            return on_threads(lambda path: cls._open(BundleFile(path, reader)), paths, most=8)
        except (OSError, ValueError):
            for path in paths[:-1]:
                cls.open_all([path])  # where one before has a fault as well, that is told
            raise

    @classmethod
    def _open(cls, file: BundleFile) -> Bundle:
        tables = file.tables
        try:
            clusters = Clusters(**{f.name: tables[f"clusters.{f.name}"] for f in fields(Clusters)})
            groups = Groups(**{f.name: tables[f"groups.{f.name}"] for f in fields(Groups)})
            num_gaussians = int(clusters.offset[-1])
            most = file.pages_bytes // file.codec.gaussian_bytes
            # Before anything is computed from it.
            expected = f"at most {most} gaussians, got {num_gaussians}"
            check("clusters.offset[-1]", num_gaussians <= most, expected)
            check_tables(clusters, groups, num_gaussians)
            pages = FilePages(PageLayout.of(clusters), file)
            _check_page_tables(pages, file)
            bundle = cls.__new__(cls)
            bundle._set(clusters, groups, file.config, pages)
            bundle._file = file
        except ValueError as error:
            file.verify()  # for what is wrong with the tables is mostly damage
            raise ValueError(f"{file.path}: {error}") from None
        file.verify()  # after the checks, for tables are hashed meanwhile
        return bundle

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the bundle to a file; the same bundle gives the same bytes.

        The file appears at ``path`` when it is complete and not before: on an error or an interrupt, what was
        there stays and nothing else is left.

        Raises:
            ValueError: The name does not end in `.v3dg`, or is of a device or a pipe.
            OSError: The file cannot be written.
        """
        _files.check_bundle_name(path)
        page_bytes = self._layout.page_bytes(self._codec)
        plan = BundlePlan(self._layout, self._codec, self.config)
        with _files.replacing(path) as temporary, open(temporary, "wb", buffering=0) as file:
            hashes = [np.empty((0, HASH_BYTES), np.uint8)]
            for pages in runs_of_pages(0, self.num_pages, page_bytes, _BYTES_AT_ONCE):
                gaussians = self._pages.read(pages.start, pages.stop)
                run = plan.run(pages.start, pages.stop)
                hashes.append(write_pages(file.fileno(), run, self._codec, gaussians))
            plan.write_tables(file.fileno(), self.clusters, self.groups, np.concatenate(hashes))
            plan.write_header(file.fileno())

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what is in memory, and of a file its path: the copy opens it again."""
        if self.path is not None:
            return Bundle.open, (self.path if is_url(self.path) else os.path.abspath(self.path),)
        return Bundle, (self.clusters, self.groups, self.gaussians, self.config, self.codec)

    @property
    def clusters(self) -> Clusters:
        """C clusters."""
        return self._clusters

    @property
    def groups(self) -> Groups:
        """G groups."""
        return self._groups

    @property
    def path(self) -> str | None:
        """Name of the file that the bundle was opened from, if it was; of one at a URL, the whole URL."""
        return None if self._file is None else self._file.name

    @property
    def num_levels(self) -> int:
        """Number of levels; 0 for a bundle without clusters."""
        return int(self.clusters.level[-1]) + 1 if len(self.clusters) else 0

    @property
    def num_pages(self) -> int:
        """Number of pages: page g is the clusters that group g replaces, the last page is the last level."""
        return self._layout.num_pages

    @property
    def num_gaussians(self) -> int:
        """Number of gaussians of all levels."""
        return int(self.clusters.offset[-1])

    def __repr__(self) -> str:
        where = "" if self._file is None else f", path={self._file.path!r}"
        return (
            f"Bundle(num_gaussians={self.num_gaussians}, num_clusters={len(self.clusters)}, "
            f"num_levels={self.num_levels}, sh_degree={self.sh_degree}{where})"
        )

    def _repr_html_(self) -> str:
        """What it is and a table of its levels, for notebooks."""
        names = ("level", "clusters", "gaussians", "bytes")
        rows = [names, *([f"{level[name]:,}" for name in names] for level in self.info()["levels"])]
        cells = "".join(f"<tr><td>{'<td>'.join(row)}" for row in rows)
        return f"<p>{html.escape(repr(self))}<table>{cells}</table>"

    def level_range(self, level: int) -> range:
        """Ids of the clusters of one level."""
        check_index("level", level, self.num_levels)
        first, last = np.searchsorted(self.clusters.level, [level, level + 1])
        return range(int(first), int(last))

    def page_range(self, page: int) -> range:
        """Ids of the clusters of one page."""
        check_index("page", page, self.num_pages)
        first = self._layout.first_cluster
        return range(int(first[page]), int(first[page + 1]))

    @property
    def gaussians(self) -> Gaussians:
        """All gaussians, in the order of the clusters; read and verified on first use, then kept.

        Of a quantised bundle, codes are kept: each use makes new rows of them.
        """
        pages = self._in_memory()
        return pages.gaussians if isinstance(pages, MemoryPages) else pages.read(0, self.num_pages)

    @property
    def codes(self) -> _core.Codes | None:
        """What is drawn of a quantised bundle, for the compiled operations; read and verified like them."""
        pages = None if self.codec == Codec.name else self._in_memory()
        return pages.codes if isinstance(pages, CodePages) else None

    def _in_memory(self) -> MemoryPages | CodePages:
        if isinstance(self._pages, FilePages):
            self._pages = self._pages.in_memory()
        return self._pages

    @property
    def page_bytes(self) -> int:
        """What all pages take together, in memory as in the file."""
        return int(self._layout.page_bytes(self._codec).sum())

    @property
    def is_in_memory(self) -> bool:
        """Whether all gaussians are, and not only those that are read page by page."""
        return not isinstance(self._pages, FilePages)

    @property
    def page_source(self) -> Any:
        """What the core reads single pages from: the file, or all gaussians where they are in memory."""
        if self._file is None or isinstance(self._pages, MemoryPages):
            return self.gaussians.rows
        return self._file.source

    def read_page(self, page: int) -> Gaussians:
        """Gaussians of the clusters that share parent group ``page``, or of the last level; verified."""
        check_index("page", page, self.num_pages)
        return self._pages.read(page, page + 1)

    def cluster_gaussians(self, cluster: int) -> Gaussians:
        """Gaussians of one cluster; reads its page and keeps it until another is read."""
        check_index("cluster", cluster, len(self.clusters))
        page = int(np.searchsorted(self._layout.first_cluster, cluster, side="right")) - 1
        first = int(self._layout.first_gaussian[page])
        start, stop = (int(offset) - first for offset in self.clusters.offset[cluster : cluster + 2])
        return self.read_page(page).subset(slice(start, stop))

    def level_gaussians(self, level: int) -> Gaussians:
        """Gaussians of one level; reads the pages of that level only."""
        clusters = self.level_range(level)
        first, last = np.searchsorted(self._layout.first_cluster, [clusters.start, clusters.stop])
        return self._pages.read(int(first), int(last))

    def info(self) -> dict[str, Any]:
        """Describe the bundle in JSON values, without reading gaussians; sizes are those of its file."""
        page_level = self.clusters.level[self._layout.first_cluster[:-1]]
        page_sizes = self._layout.page_bytes(self._codec)
        sizes = [int(page_sizes[page_level == level].sum()) for level in range(self.num_levels)]
        return {
            "path": None if self.path is None else shown(self.path),
            "version": self._file.version if self._file else VERSION,
            "codec": self.codec,
            "bytes": (self._file or BundlePlan(self._layout, self._codec, self.config)).num_bytes,
            "sh_degree": self.sh_degree,
            "num_gaussians": self.num_gaussians,
            "num_clusters": len(self.clusters),
            "num_groups": len(self.groups),
            "num_pages": self.num_pages,
            "num_levels": self.num_levels,
            "levels": [self._level_info(level, size) for level, size in enumerate(sizes)],
            "config": self.config,
        }

    def _level_info(self, level: int, size: int) -> dict[str, Any]:
        clusters, error = self.level_range(level), self.groups.error[self.groups.level == level]
        first, last = self.clusters.offset[[clusters.start, clusters.stop]].tolist()
        return {
            "level": level,
            "clusters": len(clusters),
            "gaussians": last - first,
            "error_color": _mean(error[:, 0]) if level else 0.0,
            "error_alpha": _mean(error[:, 1]) if level else 0.0,
            "bytes": size,
        }


def _check_page_tables(pages: FilePages, file: BundleFile) -> None:
    tables, expected = file.tables, page_tables(pages.layout, pages.codec)
    num_pages, expected_num_pages = len(tables["pages.offset"]), pages.layout.num_pages
    check("pages", num_pages == expected_num_pages, f"{expected_num_pages} for the clusters, got {num_pages}")
    for name, values in expected.items():
        check_all(name, tables[name], tables[name] == values, lambda i, v=values: f"{v[i]} for its clusters")
    total = int(pages.layout.page_bytes(pages.codec).sum())
    check("pages", total == file.pages_bytes, f"{total} bytes for the gaussians, got {file.pages_bytes}")


def _mean(values: NDArray[np.float32]) -> float | None:
    known = values[~np.isnan(values)]
    return float(known.mean(dtype=np.float64)) if known.size else None
