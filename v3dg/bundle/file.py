"""Reads and writes the file of a bundle: a safetensors container with aligned and
hashed pages, followed by the tables.

docs/format.md describes the format and the reasons for it. This module checks the
structure of the file, because the file may be hostile; `v3dg.bundle.tables` checks the
values in the tables.
"""

import os
import re
import weakref
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _files, _urls
from v3dg._json import JsonObject, json_text, parse_json
from v3dg._numbers import check
from v3dg._urls import FileAtUrl
from v3dg.bundle import format as file_format
from v3dg.bundle.codec import CODECS, Codec
from v3dg.bundle.format import (
    DTYPES,
    VERSION,
    Entry,
    entries_of,
    page_tables,
    schema_of,
)
from v3dg.bundle.pages import PageLayout, PageRun
from v3dg.bundle.tables import Clusters, Column, Groups, check_tables, columns_of
from v3dg.gaussians import Gaussians

# Size of the beginning of the header, which a disk writes atomically.
_FIRST_BYTES = 4096
# Maximum size of the tables of a file at a URL, because their size is only a claim
# until they are downloaded. The tables of a billion gaussians are smaller.
_MOST_FETCHED_TABLE_BYTES = 1 << 30
# Number of clusters that may be empty; each further cluster has at least one gaussian.
_FREE_CLUSTERS = 1 << 18


class BundlePlan:
    """The positions of all parts in the file of a bundle. They follow from the page
    layout, the codec and the config."""

    def __init__(self, layout: PageLayout, codec: Codec, config: JsonObject) -> None:
        self.layout = layout
        self.codec = codec
        self.config = config
        self._page_tables = page_tables(layout, codec)
        pages_bytes = int(layout.page_bytes(codec).sum())
        num_clusters = int(layout.first_cluster[-1])
        num_pages = layout.num_pages
        entries = entries_of(codec, num_clusters, max(num_pages - 1, 0), num_pages, pages_bytes)
        self.header = file_format.header_of(entries, codec, config)
        self._pages_end = len(self.header) + int(entries["pages"]["data_offsets"][1])
        self.num_bytes = len(self.header) + int(entries["hash"]["data_offsets"][1])
        self._places = np.append(
            len(self.header) + self._page_tables["pages.offset"], self._pages_end
        )

    def run(self, first_page: int, last_page: int) -> PageRun:
        """Return pages `first_page` to `last_page` with their positions in the file."""
        return self.layout.run(first_page, last_page, self._places)

    def write_tables(
        self, descriptor: int, clusters: Clusters, groups: Groups, hashes: NDArray[np.uint8]
    ) -> None:
        """Check the tables and write them behind the pages; `hashes` (P, 16) are those
        of the pages."""
        check_tables(clusters, groups, int(self.layout.first_gaussian[-1]))
        tables = self._page_tables | columns_of(clusters, groups) | {"pages.hash": hashes}
        schema = schema_of(self.codec)
        end = b"".join(
            tables[name].astype(DTYPES[kind], copy=False).tobytes() for name, kind, _, _ in schema
        )
        end += file_format.hash_of_pieces(self.header + end)
        assert self._pages_end + len(end) == self.num_bytes
        _files.write_at(descriptor, end, self._pages_end)

    def write_header(self, descriptor: int) -> None:
        """Write the header. Its first bytes are written last, so a file that begins
        with them is complete."""
        _files.write_at(descriptor, self.header[_FIRST_BYTES:], _FIRST_BYTES)
        _files.write_at(descriptor, self.header[:_FIRST_BYTES], 0)


def write_pages(
    path: str | os.PathLike[str],
    descriptor: int,
    run: PageRun,
    codec: Codec,
    gaussians: Gaussians,
) -> NDArray[np.uint8]:
    """Write the gaussians of neighbouring pages, which may be on any device, at their
    positions in the file. Return (n, 16) the hashes of the pages."""
    rows = gaussians.numpy().rows
    return _core.write_pages(os.fspath(path), descriptor, rows, codec.name, run.core)


def read_pages(
    path: str | os.PathLike[str],
    descriptor: int,
    run: PageRun,
    codec: Codec,
    hashes: NDArray[np.uint8],
) -> Gaussians:
    """Return the gaussians of neighbouring pages; raise ValueError if the file is too
    short or a hash differs."""
    result = codec.empty(run.rows.stop - run.rows.start)
    _core.read_pages(
        os.fspath(path), descriptor, result.rows, codec.name, hashes[: len(run)], run.core
    )
    return result


class BundleFile:
    """An open bundle file. Its header and tables are read at once, and its pages on
    demand; `verify` checks the hash of header and tables.

    Never more memory is allocated than the size of the file or, for a URL, the number
    of downloaded bytes. The file is closed when this object is destroyed.

    Attributes:
        name: The name of the file, or its complete URL.
        path: The name of the file in messages, without secret parts of a URL.
    """

    def __init__(self, path: str | os.PathLike[str], reader: _core.HashedReader) -> None:
        self.name = os.fspath(path)
        self.path = _urls.shown(path)
        self._at_url: FileAtUrl | None = None
        if isinstance(path, FileAtUrl):
            self._at_url = path
            self._fd = os.dup(path.file.fileno())
        else:
            self._fd = _files.open_regular(path)
        weakref.finalize(self, os.close, self._fd)
        with _files.naming_errors(self.path):
            self._read_header_and_tables(reader)

    def _fetch(self, first: int, last: int) -> None:
        if self._at_url:
            self._at_url.fetch([(first, last)])

    def _fail(self, problem: str) -> NoReturn:
        raise ValueError(f"{self.path}: {problem}")

    def _check(self, name: str, holds: object, expected: str) -> None:
        check(f"{self.path}: {name}", holds, expected)

    def _read_header_and_tables(self, reader: _core.HashedReader) -> None:
        if self._at_url is not None:
            self.num_bytes = self._at_url.num_bytes
        else:
            self.num_bytes = os.fstat(self._fd).st_size
        check(
            self.path, self.num_bytes >= 8, f"a bundle, got a file of only {self.num_bytes} bytes"
        )
        header_bytes = int.from_bytes(self._read(8, 0), "little")
        check(
            self.path,
            header_bytes > 0,
            "a bundle, got an unfinished one or another kind of file; build it again",
        )
        fits = header_bytes <= min(self.num_bytes - 8, file_format.MAX_HEADER_BYTES)
        problem = f"a header length of {header_bytes} in a file of {self.num_bytes} bytes"
        expected = (
            f"a bundle (safetensors), got {problem}; the file is truncated or no bundle, see "
            "v3dg.open"
        )
        self._check("header", fits, expected)
        text = header_bytes.to_bytes(8, "little") + self._read(header_bytes, 8)
        header = self._object("header", text[8:])
        self._read_metadata(header.pop("__metadata__", None))
        self._data_start = 8 + header_bytes
        entries = self._check_entries(header)
        self.pages_bytes = int(entries["pages"]["data_offsets"][1])
        self._read_tables(entries, text, reader)

    def _read_metadata(self, metadata: object) -> None:
        values: dict[str, object] = {}
        if isinstance(metadata, dict):
            values = metadata
        kind = values.get("format")
        if kind != file_format.FORMAT:
            self._fail(
                f"format: expected '{file_format.FORMAT}', got {json_text(kind)}; the file is not "
                "a bundle"
            )
        version = values.get("version")
        if not isinstance(version, str) or not re.fullmatch("[1-9][0-9]{0,8}", version):
            self._fail(f"version: expected an integer of at least 1, got {json_text(version)}")
        self.version = int(version)
        if self.version > VERSION:
            self._fail(f"version: expected at most {VERSION}, got {self.version}; update v3dg")
        degree = values.get("sh_degree")
        if not isinstance(degree, str) or degree not in ("0", "1", "2", "3"):
            self._fail(f"sh_degree: expected '0' to '3', got {json_text(degree)}")
        name: object = Codec.name
        if self.version > 1:
            name = values.get("codec")
        if (
            not isinstance(name, str)
            or name not in CODECS
            or (self.version, name) == (2, Codec.name)
        ):
            self._fail(f"codec: expected a known codec, got {json_text(name)}; update v3dg")
        self.codec = CODECS[name](int(degree))
        config = values.get("config")
        if not isinstance(config, str):
            self._fail(f"config: expected JSON in a string, got {json_text(config)}")
        self.config = self._object("config", config)

    def _object(self, name: str, text: str | bytes) -> JsonObject:
        try:
            value = parse_json(text)
        except ValueError as error:
            self._fail(f"{name}: expected JSON, got {error}")
        self._check(name, isinstance(value, dict), f"a JSON object, got {json_text(value)}")
        return dict(value)

    def _check_entries(self, header: JsonObject) -> dict[str, Entry]:
        """Compare the header with the header that follows from its own counts and the
        size of the file; return its entries."""
        counts = []
        for name in ("clusters.level", "groups.parent", "pages.offset", "pages"):
            entry = header.get(name)
            length = _length_of_vector(entry)
            if length is None:
                self._fail(f"{name}: expected a one-dimensional tensor, got {json_text(entry)}")
            counts.append(length)
        largest = max(counts)
        text = (
            f"more than {json_text(largest)} bytes, as the tensors need, got {self.num_bytes}; the "
            "file is truncated"
        )
        self._check("size", largest <= self.num_bytes, text)
        expected = entries_of(self.codec, *counts)
        for name, entry in expected.items():
            if header.get(name) != entry:
                self._fail(f"{name}: expected {entry}, got {json_text(header.get(name))}")
        self._check_counts(*counts)
        unknown = sorted(set(header) - set(expected))
        if unknown:
            self._fail(
                f"{json_text(unknown[0])}: expected only tensors of format version {self.version}, "
                "got an unknown one; write the bundle again"
            )
        for name, value in (("header", self._data_start), ("pages", counts[3])):
            is_aligned = value % self.codec.alignment == 0
            self._check(
                name,
                is_aligned,
                (f"to end at a multiple of {self.codec.alignment} bytes, got {value}"),
            )
        size = self._data_start + expected["hash"]["data_offsets"][1]
        problem = "followed by other data"
        if size > self.num_bytes:
            problem = "truncated"
        text = f"{size} bytes, got {self.num_bytes}; the file is {problem}"
        self._check("size", size == self.num_bytes, text)
        return expected

    def _check_counts(
        self, num_clusters: int, num_groups: int, num_pages: int, pages_bytes: int
    ) -> None:
        """Raise ValueError if the tables of a file at a URL are larger than its
        gaussians can need; this is checked before the tables are downloaded."""
        if self._at_url is None:
            return
        limit = _FREE_CLUSTERS + pages_bytes // self.codec.gaussian_bytes
        self._check(
            "clusters",
            num_clusters <= limit,
            (f"at most {limit} clusters for the size of its pages, got {num_clusters}"),
        )
        self._check(
            "groups",
            num_groups <= num_clusters,
            (f"at most {num_clusters}, the number of clusters, got {num_groups}"),
        )
        self._check(
            "pages",
            num_pages <= num_groups + 1,
            (f"at most {num_groups + 1}, one more than groups, got {num_pages}"),
        )

    def _read_tables(
        self, entries: dict[str, Entry], text: bytes, reader: _core.HashedReader
    ) -> None:
        place = self._data_start + self.pages_bytes
        num_bytes = self.num_bytes - place
        is_small = self._at_url is None or num_bytes <= _MOST_FETCHED_TABLE_BYTES
        expected = (
            f"at most {_MOST_FETCHED_TABLE_BYTES} bytes for a file at a URL, got {num_bytes}; "
            "download the file first"
        )
        self._check("tables", is_small, expected)
        self._fetch(place, self.num_bytes)
        self._reading = reader.read(self.path, self._fd, text, place, num_bytes, self.version > 2)
        # The tables, followed by the hash of header and tables.
        data = self._reading.wait()
        # `schema_of` defines the types of the columns.
        self.tables: dict[str, Column] = {}
        for name, dtype, _, _ in schema_of(self.codec):
            first, last = (offset - self.pages_bytes for offset in entries[name]["data_offsets"])
            self.tables[name] = data[first:last].view(DTYPES[dtype]).reshape(entries[name]["shape"])

    def verify(self) -> None:
        """Wait for the hash of the header and tables; raise ValueError if it differs
        from the one in the file."""
        if not self._reading.is_sound():
            self._fail(f"hash: does not match the header and the tables; {_core.DAMAGED}")
        del self._reading

    def _read(self, num_bytes: int, offset: int) -> bytes:
        self._fetch(offset, offset + num_bytes)
        out = np.empty(num_bytes, np.uint8)
        if not _files.read_at(self._fd, out, offset):
            self._fail(
                f"size: expected more bytes after offset {offset}, got the end of the file; it was "
                "truncated"
            )
        return out.tobytes()

    @property
    def places(self) -> NDArray[np.int64]:
        """(P+1,) offset of the first byte of each page in the file, and the end of the
        pages."""
        return self._data_start + np.append(self.tables["pages.offset"], self.pages_bytes)

    @property
    def source(self) -> _core.FileSource:
        """The source of pages for the core."""
        fetch = None
        if self._at_url is not None:
            fetch = self._at_url.fetch
        return _core.FileSource(
            name=self.path,
            descriptor=self._fd,
            codec=self.codec.name,
            sh_degree=self.codec.sh_degree,
            places=self.places,
            hashes=self.tables["pages.hash"],
            fetch=fetch,
        )

    def read(self, run: PageRun, out: _core.Rows | NDArray[np.int32]) -> None:
        """Read neighbouring pages and verify their hashes. `out` is filled with their
        gaussians or, if it is an integer array, with their codes."""
        self._fetch(*run.places[[0, -1]])
        hashes = self.tables["pages.hash"][run.first_page :][: len(run)]
        _core.read_pages(self.path, self._fd, out, self.codec.name, hashes, run.core)


def _length_of_vector(entry: object) -> int | None:
    """Return the length of a one-dimensional tensor from its header entry; None for any
    other entry."""
    if not isinstance(entry, dict):
        return None
    shape = entry.get("shape")
    if not isinstance(shape, list) or len(shape) != 1:
        return None
    length = shape[0]
    if type(length) is not int or length < 0:
        return None
    return length
