"""Reads files from the other file systems that fsspec supports, apart from the web."""

import contextlib
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from typing import BinaryIO, Protocol, TypeAlias, cast

from v3dg._urls.failures import DownloadError

Write: TypeAlias = Callable[[bytes, int], None]
"""Writes bytes at an offset of the local file."""

_STEP_BYTES = 1 << 20
# Fields of fsspec's file information that change with the content of a file.
_TAG = re.compile(
    r"tag|md5|sha|crc|checksum|digest|modif|mtime|created|updated|generation|version", re.IGNORECASE
)


class FileSystem(Protocol):
    """The part of a file system of fsspec that this module uses; fsspec has no
    types."""

    async_impl: bool

    def info(self, path: str, /) -> Mapping[str, object]: ...

    def cat_ranges(
        self, paths: Sequence[str], starts: Sequence[int], ends: Sequence[int], /
    ) -> Sequence[bytes | Exception]: ...

    def open(self, path: str, mode: str, /) -> AbstractContextManager[BinaryIO]: ...


class OtherSource:
    """A file in a file system of fsspec.

    Attributes:
        num_bytes: Size of the file in bytes; None if it is unknown until the whole file
            is read.
        tag: Text that changes when the content changes; empty if the file system has
            none.
    """

    def __init__(self, file_system: FileSystem, path: str) -> None:
        info = file_system.info(path)
        self.num_bytes = cast(int | None, info["size"])
        self.tag = ""
        if any(value for name, value in info.items() if _TAG.search(name)):
            self.tag = str(info)
        self._file_system = file_system
        self._path = path
        # Only asynchronous file systems may be used by several threads at once.
        self._lock: AbstractContextManager[object] = threading.Lock()
        if file_system.async_impl:
            self._lock = contextlib.nullcontext()

    def read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        """Write the bytes of all parts (offset of the first byte, offset after the
        last). Return whether the file system sent the whole file instead."""
        firsts = [first for first, _ in parts]
        lasts = [last for _, last in parts]
        with self._lock:
            answers = self._file_system.cat_ranges([self._path] * len(parts), firsts, lasts)
        for (first, last), data in zip(parts, answers, strict=True):
            if isinstance(data, Exception):
                raise data
            if len(data) == self.num_bytes:  # the file system cannot read parts
                write(data, 0)
                return True
            if len(data) != last - first:
                raise changed(first, last, len(data))
            write(data, first)
        return False

    def read_all(self, max_bytes: int, write: Write) -> int:
        """Write the whole file, of at most `max_bytes`, and return its size."""
        num_bytes = 0
        with self._lock, self._file_system.open(self._path, "rb") as file:
            while data := file.read(_STEP_BYTES):
                if num_bytes + len(data) > max_bytes:
                    raise too_long(max_bytes)
                write(data, num_bytes)
                num_bytes += len(data)
        return num_bytes


def changed(first: int, last: int, num_bytes: int) -> DownloadError:
    """Return the problem of a part whose length is not the requested one."""
    text = (
        f"expected {last - first} bytes at offset {first}, got {num_bytes}; the file has changed, "
        "open it again"
    )
    return DownloadError(ValueError, text)


def too_long(max_bytes: int) -> DownloadError:
    """Return the problem of a file that is larger than allowed."""
    return DownloadError(
        ValueError,
        f"expected at most {max_bytes} bytes, got more; check the address, or download the file",
    )
