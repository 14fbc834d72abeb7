"""What readers of strangers' files share: what may be read of a file, and how much its claims may cost."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Iterator
from typing import IO, TypeAlias

from v3dg import _files
from v3dg._json import Node
from v3dg._numbers import check as check

_FREE_GAUSSIANS = 1 << 18  # 15 to 62 MB: that many may all be equal, in a file of any size
_FREE_BYTES = 1 << 20  # that a member of a zip may have whatever the size of the zip


Path: TypeAlias = str | os.PathLike[str]


@contextlib.contextmanager
def telling(path: Path, expected: str) -> Iterator[None]:
    """Turn all that a library raises for damaged content, which none documents, into one error."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        text = str(error) or type(error).__name__
        raise ValueError(f"{os.fspath(path)}: expected {expected}, got {ascii(text[:200])[1:-1]}") from None


def least_bytes(count: int) -> int:
    """Bytes that a file of so many gaussians needs to be believed: one for each, from a number on."""
    return max(0, count - _FREE_GAUSSIANS)


class Claims:
    """The files of an asset, and how many gaussians they claim to hold together."""

    def __init__(self) -> None:
        self._files: dict[tuple[int, int], int] = {}  # bytes; a file may have several names
        self._gaussians = 0

    @contextlib.contextmanager
    def open(self, path: Path) -> Iterator[IO[bytes]]:
        with _files.naming_errors(path), open(_files.open_regular(path), "rb") as file:
            status = os.fstat(file.fileno())
            self._files[status.st_dev, status.st_ino] = status.st_size
            yield file

    def read(self, path: Path) -> bytes:
        with self.open(path) as file:
            return file.read()

    def add(self, path: Path, count: int) -> None:
        """Believe that a file has so many gaussians, or raise ValueError: call it before memory is taken."""
        self._gaussians += count
        num_bytes = sum(self._files.values())
        found = f"{self._gaussians} gaussians in {num_bytes} bytes"
        is_believed = least_bytes(self._gaussians) <= num_bytes
        check(path, is_believed, f"a byte a gaussian beyond {_FREE_GAUSSIANS}, got {found}")


class Archive:
    """A zip whose members are no larger than itself, or 1 MiB, and fit their checksums."""

    def __init__(self, path: Path, file: IO[bytes]) -> None:
        self._path = path
        start = file.read(4)  # zipfile would look for a zip anywhere in the file
        check(path, start == b"PK\3\4", f"a zip, got a file that begins with {start.hex(' ')}")
        with telling(path, "a zip that is not damaged"):
            self._zip = zipfile.ZipFile(file)
            self._most = max(_FREE_BYTES, file.seek(0, os.SEEK_END))
        self.names = self._zip.namelist()

    def read(self, name: str) -> bytes:
        check(self._path, name in self._zip.NameToInfo, f"{name!a} in the zip, got none")
        member = self._zip.getinfo(name)
        size, is_known = member.file_size, member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        check(self._path, size <= self._most, f"{name!a} no larger than the zip, got {size} bytes")
        check(self._path, is_known, f"{name!a} stored or deflated in the zip, got neither")
        if getattr(member, "CRC", None) == 0:  # torch can be told to compute none
            del member.CRC  # then zipfile does not ask for it
        with telling(self._path, "a zip that is not damaged"), self._zip.open(member) as file:
            content = file.read(size)  # without a limit, zipfile expands first and cuts off then
        check(self._path, len(content) == size, f"{size} bytes in {name!a}, got {len(content)}")
        return content


def whole(node: Node, expected: str, low: int, high: int) -> int:
    """A whole number of JSON, within bounds."""
    if not isinstance(node.value, int) or isinstance(node.value, bool) or not low <= node.value <= high:
        raise node.error(expected)
    return node.value
