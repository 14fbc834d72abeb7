"""The file of a bundle: a safetensors container with aligned, hashed pages in front of the tables.

docs/format.md says what is in the file and why. This module moves bytes and trusts none of them; what the
tables mean is checked by `v3dg.bundle`.
"""

from __future__ import annotations

import errno
import hashlib
import json
import os
import weakref
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np

from v3dg import _files
from v3dg._json import parse_json

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Mapping, Sequence

    from numpy.typing import NDArray

    Tables = Mapping[str, NDArray[Any]]

FORMAT = "v3dg"
VERSION = 1
ALIGNMENT_BYTES = 4096  # of a page in the file: the memory page, so that a page maps or loads directly
HASH_BYTES = 16

_MAX_HEADER_BYTES = 1 << 20  # the header holds 20 entries and the config; more is damage or an attack
_THREADS = 8
_RUN_BYTES = 64 << 20
_READ_BYTES = 1 << 30  # one read call moves at most 2 GiB - 4 KiB
_DTYPES = {"I64": "<i8", "F32": "<f4", "I32": "<i4", "U8": "|u1"}
_SCHEMA: tuple[tuple[str, str, str, tuple[int, ...]], ...] = (
    # name, safetensors dtype, rows (C clusters, C+1, G groups, P pages), rest of the shape. In file order:
    # wide types first, so that every table is aligned to its own type.
    ("clusters.offset", "I64", "C+1", ()),
    ("pages.offset", "I64", "P", ()),
    ("pages.bytes", "I64", "P", ()),
    ("clusters.level", "I32", "C", ()),
    ("clusters.own_group", "I32", "C", ()),
    ("clusters.parent_group", "I32", "C", ()),
    ("clusters.box", "F32", "C", (2, 3)),
    ("clusters.filter_px2", "F32", "C", ()),
    ("groups.ball", "F32", "G", (4,)),
    ("groups.weight", "F32", "G", ()),
    ("groups.parent", "I32", "G", ()),
    ("groups.level", "I32", "G", ()),
    ("groups.error", "F32", "G", (2,)),
    ("pages.first_cluster", "I32", "P", ()),
    ("pages.num_clusters", "I32", "P", ()),
    ("clusters.antialiased", "U8", "C", ()),
    ("pages.hash", "U8", "P", (HASH_BYTES,)),
)
TABLE_NAMES = tuple(name for name, _, _, _ in _SCHEMA)


def floats_per_gaussian(sh_degree: int) -> int:
    """Count the float32 values of one gaussian: 3 mean, 4 quaternion, 3 scale, 1 opacity, 3 (d+1)² SH."""
    return 11 + 3 * (sh_degree + 1) ** 2


def padding_bytes(num_bytes: int) -> int:
    """Count the bytes from here to the next multiple of the alignment."""
    return -num_bytes % ALIGNMENT_BYTES


def page_file_bytes(page_bytes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Round the sizes of pages up to the alignment: what they take in the file."""
    return page_bytes + -page_bytes % ALIGNMENT_BYTES


def page_hash(pieces: Iterable[NDArray[Any]]) -> bytes:
    """BLAKE2b-128 of the bytes of the pieces, one after another."""
    digest = hashlib.blake2b(digest_size=HASH_BYTES)
    for piece in pieces:
        digest.update(piece.reshape(-1).view(np.uint8).data)
    return digest.digest()


def _page_in_file(pieces: Sequence[NDArray[Any]]) -> tuple[NDArray[np.uint8], bytes]:
    """A page's bytes with their padding, and their hash."""
    padding = np.zeros(padding_bytes(sum(piece.nbytes for piece in pieces)), np.uint8)
    data = np.concatenate([piece.reshape(-1).view(np.uint8) for piece in (*pieces, padding)])
    return data, page_hash((data,))


def _runs(pages: Iterable[Sequence[NDArray[Any]]]) -> Iterator[list[Sequence[NDArray[Any]]]]:
    """Cut pages into runs that are enough work for all threads and little memory."""
    run, num_bytes = [], 0
    for pieces in pages:
        run.append(pieces)
        num_bytes += sum(piece.nbytes for piece in pieces)
        if num_bytes > _RUN_BYTES:
            yield run
            run, num_bytes = [], 0
    yield run


def _entries(num_clusters: int, num_groups: int, num_pages: int, pages_bytes: int) -> dict[str, Any]:
    """Every tensor of the file, in file order, as the header describes it."""
    rows = {"C": num_clusters, "C+1": num_clusters + 1, "G": num_groups, "P": num_pages}
    entries: dict[str, Any] = {}
    end = 0

    def append(name: str, dtype: str, shape: list[int]) -> None:
        nonlocal end
        num_bytes = np.dtype(_DTYPES[dtype]).itemsize
        for side in shape:
            num_bytes *= side
        entries[name] = {"dtype": dtype, "shape": shape, "data_offsets": [end, end + num_bytes]}
        end += num_bytes

    append("pages", "U8", [pages_bytes])
    for name, dtype, count, rest in _SCHEMA:
        append(name, dtype, [rows[count], *rest])
    append("hash", "U8", [HASH_BYTES])
    return entries


def _header(entries: dict[str, Any], sh_degree: int, config_json: str) -> bytes:
    """The length and the JSON, filled up with spaces so that the data starts aligned."""
    metadata = {"format": FORMAT, "version": str(VERSION), "sh_degree": str(sh_degree), "config": config_json}
    text = json.dumps({"__metadata__": metadata, **entries}, sort_keys=True, separators=(",", ":")).encode()
    text += b" " * padding_bytes(8 + len(text))
    if len(text) > _MAX_HEADER_BYTES:
        raise ValueError(
            f"config: expected at most {_MAX_HEADER_BYTES} bytes of JSON, got {len(config_json)}; shorten it"
        )
    return len(text).to_bytes(8, "little") + text


def file_bytes(tables: Tables, sh_degree: int, config_json: str) -> int:
    """Size of the file that `write` makes of this."""
    entries = _table_entries(tables)
    return len(_header(entries, sh_degree, config_json)) + int(entries["hash"]["data_offsets"][1])


def _table_entries(tables: Tables) -> dict[str, Any]:
    return _entries(
        len(tables["clusters.level"]),
        len(tables["groups.parent"]),
        len(tables["pages.bytes"]),
        int(page_file_bytes(tables["pages.bytes"]).sum()),
    )


def write(
    path: str | os.PathLike[str],
    tables: Tables,
    pages: Iterable[Sequence[NDArray[Any]]],
    *,
    sh_degree: int,
    config_json: str,
) -> None:
    """Write a bundle to a temporary file beside ``path``, then rename it; a failure leaves nothing behind.

    Args:
        tables: Every name of TABLE_NAMES but ``pages.hash``, which is computed.
        pages: The arrays of each page, in order; their bytes follow one another in the file.
    """
    with _files.replacing(path) as temporary, open(temporary, "xb", buffering=1 << 20) as file:
        entries = _table_entries(tables)
        header = _header(entries, sh_degree, config_json)
        file.write(header)
        digest = hashlib.blake2b(header, digest_size=HASH_BYTES)
        hashes = bytearray()
        with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:
            for run in _runs(pages):
                for page, page_digest in pool.map(_page_in_file, run):
                    file.write(page.data)
                    hashes += page_digest
        hash_table = np.frombuffer(hashes, np.uint8).reshape(-1, HASH_BYTES)
        for name, dtype, _, _ in _SCHEMA:
            table = hash_table if name == "pages.hash" else tables[name]
            data = table.astype(_DTYPES[dtype], copy=False).tobytes()
            file.write(data)
            digest.update(data)
        file.write(digest.digest())
        assert file.tell() == len(header) + entries["hash"]["data_offsets"][1]


def _short(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 80 else text[:77] + "..."


class BundleFile:
    """An open bundle file: header and tables are read and checked against the file's own hash, pages are not.

    Attributes:
        path: As given.
        num_bytes: Size of the file.
        pages_bytes: Size of all pages with their padding.
        sh_degree: 0 to 3.
        config: The JSON object that was saved.
        tables: One array for every name in TABLE_NAMES, with the shapes of docs/format.md.

    Raises:
        FileNotFoundError: There is no such file.
        ValueError: It is not a bundle of a known version, or the header, a size or the hash is wrong. Nothing
            is allocated that is larger than the file.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.path = os.fspath(path)
        self._fd = _files.open_regular(path)
        self.close = weakref.finalize(self, os.close, self._fd)
        try:
            with _files.naming_errors(path):
                self._read_header_and_tables()
        except BaseException:
            self.close()
            raise

    def _fail(self, problem: str) -> NoReturn:
        raise ValueError(f"{self.path}: {problem}")

    def _read_header_and_tables(self) -> None:
        self.num_bytes = os.fstat(self._fd).st_size
        if self.num_bytes < 8:
            self._fail(f"expected a bundle, got a file of {self.num_bytes} bytes")
        length = np.empty(8, np.uint8)
        self._read([length], 0)
        header_bytes = int.from_bytes(length.tobytes(), "little")
        if header_bytes > min(self.num_bytes - 8, _MAX_HEADER_BYTES):
            self._fail(
                f"header: expected a bundle (safetensors), got a header length of {header_bytes} in a file "
                f"of {self.num_bytes} bytes; it is another kind of file or it is truncated"
            )
        text = np.empty(header_bytes, np.uint8)
        self._read([text], 8)
        try:
            header = parse_json(text.tobytes())
        except ValueError as error:
            self._fail(f"header: expected JSON (safetensors), got {_short(str(error))}")
        if not isinstance(header, dict):
            self._fail(f"header: expected a JSON object (safetensors), got {_short(header)}")

        self._read_metadata(header.pop("__metadata__", None))
        self._data_start = 8 + header_bytes
        entries = self._check_entries(header)
        self.pages_bytes = int(entries["pages"]["data_offsets"][1])
        self._read_tables(entries, (length, text))

    def _read_metadata(self, metadata: Any) -> None:
        if not isinstance(metadata, dict) or metadata.get("format") != FORMAT:
            found = metadata.get("format") if isinstance(metadata, dict) else None
            self._fail(f"format: expected '{FORMAT}', got {_short(found)}; not a bundle")
        version = metadata.get("version")
        if (
            not isinstance(version, str)
            or not version.isdecimal()
            or not version.isascii()
            or len(version) > 9
        ):
            self._fail(f"version: expected a number, got {_short(version)}")
        if int(version) > VERSION:
            self._fail(f"version {int(version)}, this build reads up to {VERSION}; update v3dg")
        if int(version) < 1:
            self._fail(f"version: expected 1 or more, got {_short(version)}")
        if metadata.get("sh_degree") not in ("0", "1", "2", "3"):
            self._fail(f"sh_degree: expected '0' to '3', got {_short(metadata.get('sh_degree'))}")
        self.sh_degree = int(metadata["sh_degree"])
        config = metadata.get("config")
        if not isinstance(config, str):
            self._fail(f"config: expected a string of JSON, got {_short(config)}")
        try:
            self.config = parse_json(config)
        except ValueError as error:
            self._fail(f"config: expected JSON, got {_short(str(error))}")
        if not isinstance(self.config, dict):
            self._fail(f"config: expected a JSON object, got {_short(self.config)}")

    def _check_entries(self, header: dict[str, Any]) -> dict[str, Any]:
        """Compare the header with the one that its own counts and the file's size call for."""
        counts = []
        for name in ("clusters.level", "groups.parent", "pages.bytes", "pages"):
            entry = header.get(name)
            shape = entry.get("shape") if isinstance(entry, dict) else None
            if not isinstance(shape, list) or len(shape) != 1 or type(shape[0]) is not int or shape[0] < 0:
                self._fail(f"{name}: expected a tensor with one side, got {_short(entry)}")
            counts.append(shape[0])
        if max(counts) > self.num_bytes:
            self._fail(
                f"size: expected more than {_short(max(counts))} bytes for tensors, got {self.num_bytes}; "
                "the file is truncated"
            )
        expected = _entries(*counts)
        for name, entry in expected.items():
            if header.get(name) != entry:
                self._fail(f"{name}: expected {entry}, got {_short(header.get(name))}")
        unknown = sorted(set(header) - set(expected))
        if unknown:
            self._fail(f"{_short(unknown[0])}: expected only the tensors of version {VERSION}")
        for name, value in (("header", self._data_start), ("pages", counts[3])):
            if value % ALIGNMENT_BYTES:
                self._fail(f"{name}: expected to end at a multiple of {ALIGNMENT_BYTES}, got {value}")
        num_bytes = self._data_start + expected["hash"]["data_offsets"][1]
        if num_bytes != self.num_bytes:
            problem = "truncated" if num_bytes > self.num_bytes else "followed by other data"
            self._fail(f"size: expected {num_bytes} bytes, got {self.num_bytes}; the file is {problem}")
        return expected

    def _read_tables(self, entries: dict[str, Any], header: tuple[NDArray[Any], NDArray[Any]]) -> None:
        start = self.pages_bytes
        end = entries["hash"]["data_offsets"][0]
        # Of eight-byte elements, so that every table in it is aligned.
        data = np.empty(-(-(end - start) // 8), np.int64).view(np.uint8)[: end - start]
        stored = np.empty(HASH_BYTES, np.uint8)
        self._read([data, stored], self._data_start + start)
        if page_hash((*header, data)) != stored.tobytes():
            self._fail(
                "hash: the header and tables do not match it; the file is damaged, copy or build it again"
            )
        self.tables: dict[str, NDArray[Any]] = {}
        for name, dtype, _, _ in _SCHEMA:
            first, last = (offset - start for offset in entries[name]["data_offsets"])
            self.tables[name] = data[first:last].view(_DTYPES[dtype]).reshape(entries[name]["shape"])

    def _read(self, buffers: Sequence[NDArray[Any]], offset: int) -> None:
        """Fill all buffers from one place of the file."""
        remaining = [memoryview(buffer.reshape(-1).view(np.uint8).data) for buffer in buffers if buffer.size]
        while remaining:
            if len(remaining[0]) > _READ_BYTES:
                num_read = os.preadv(self._fd, [remaining[0][:_READ_BYTES]], offset)
            else:
                num_read = os.preadv(self._fd, remaining, offset)
            if num_read == 0:
                self._fail(f"size: expected bytes at {offset}, got the end of the file; it was truncated")
            offset += num_read
            while remaining and num_read >= len(remaining[0]):
                num_read -= len(remaining.pop(0))
            if num_read:
                remaining[0] = remaining[0][num_read:]

    def read_page(self, page: int, arrays: Sequence[NDArray[Any]]) -> None:
        """Read a page into arrays that together have its size, and verify its hash.

        Raises:
            ValueError: The page is damaged, or the file was truncated after it was opened.
        """
        num_bytes = int(self.tables["pages.bytes"][page])
        padding = np.empty(padding_bytes(num_bytes), np.uint8)
        first = int(self.tables["pages.first_cluster"][page])
        last = first + int(self.tables["pages.num_clusters"][page]) - 1
        try:
            self._read((*arrays, padding), self._data_start + int(self.tables["pages.offset"][page]))
        except OSError as error:
            raise OSError(
                error.errno, f"{os.strerror(error.errno or errno.EIO)} in page {page}", self.path
            ) from error
        if page_hash((*arrays, padding)) != self.tables["pages.hash"][page].tobytes():
            self._fail(
                f"page {page} (clusters {first} to {last}): the hash does not match; the file is damaged, "
                "copy or build it again"
            )
