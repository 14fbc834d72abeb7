"""What readers of strangers' files share: what may be read of a file, and how much its claims may cost."""

from __future__ import annotations

import contextlib
import os
import zipfile
from collections.abc import Iterator
from typing import IO

from v3dg import _files
from v3dg._json import Node

_FREE_GAUSSIANS = 1 << 18  # 15 to 62 MB: that many may all be equal, in a file of any size
_FREE_BYTES = 1 << 20  # that a member of a zip may have whatever the size of the zip


def problem(path: str | os.PathLike[str], text: str) -> ValueError:
    return ValueError(f"{os.fspath(path)}: {text}")


@contextlib.contextmanager
def telling(path: str | os.PathLike[str], expected: str) -> Iterator[None]:
    """Turn all that a library raises for damaged content, which none documents, into one error."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        text = str(error) or type(error).__name__
        raise problem(path, f"expected {expected}, got {ascii(text[:200])[1:-1]}") from None


def read_bytes(path: str | os.PathLike[str]) -> bytes:
    """All of a regular file.

    Raises:
        ValueError: It is a directory, a device or a pipe.
        OSError: It cannot be read.
    """
    return Claims().read(path)


def least_bytes(count: int) -> int:
    """Bytes that a file of so many gaussians needs to be believed: one for each, from a number on."""
    return max(0, count - _FREE_GAUSSIANS)


class Claims:
    """The files of an asset, and how many gaussians they claim to hold together."""

    def __init__(self) -> None:
        self._files: dict[tuple[int, int], int] = {}  # bytes; a file may have several names
        self._gaussians = 0

    @contextlib.contextmanager
    def open(self, path: str | os.PathLike[str]) -> Iterator[IO[bytes]]:
        with _files.naming_errors(path), open(_files.open_regular(path), "rb") as file:
            status = os.fstat(file.fileno())
            self._files[status.st_dev, status.st_ino] = status.st_size
            yield file

    def read(self, path: str | os.PathLike[str]) -> bytes:
        with self.open(path) as file:
            return file.read()

    def add(self, path: str | os.PathLike[str], count: int) -> None:
        """Believe that a file has so many gaussians, or raise ValueError: call it before memory is taken."""
        self._gaussians += count
        if least_bytes(self._gaussians) > (num_bytes := sum(self._files.values())):
            raise problem(
                path,
                f"expected a byte a gaussian beyond {_FREE_GAUSSIANS}, "
                f"got {self._gaussians} gaussians in {num_bytes} bytes",
            )


class Archive:
    """A zip whose members are no larger than itself, or 1 MiB, and fit their checksums."""

    def __init__(self, path: str | os.PathLike[str], file: IO[bytes]) -> None:
        self._path = path
        start = file.read(4)
        if start != b"PK\3\4":  # zipfile would look for a zip anywhere in the file
            raise problem(path, f"expected a zip, got a file that begins with {start.hex(' ')}")
        with telling(path, "a zip that is not damaged"):
            self._zip = zipfile.ZipFile(file)
            self._most = max(_FREE_BYTES, file.seek(0, os.SEEK_END))
        self.names = self._zip.namelist()

    def read(self, name: str) -> bytes:
        if name not in self._zip.NameToInfo:
            raise problem(self._path, f"expected {name!a} in the zip, got none")
        member = self._zip.getinfo(name)
        if member.file_size > self._most:
            raise problem(
                self._path, f"expected {name!a} no larger than the zip, got {member.file_size} bytes"
            )
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise problem(self._path, f"expected {name!a} stored or deflated in the zip, got neither")
        if getattr(member, "CRC", None) == 0:  # torch can be told to compute none
            del member.CRC  # then zipfile does not ask for it
        with telling(self._path, "a zip that is not damaged"), self._zip.open(member) as file:
            # With a limit: without one, zipfile expands first and cuts off then.
            content = file.read(member.file_size)
        if len(content) != member.file_size:
            raise problem(self._path, f"expected {member.file_size} bytes in {name!a}, got {len(content)}")
        return content


def whole(node: Node, expected: str, low: int, high: int) -> int:
    """A whole number of JSON, within bounds."""
    if not isinstance(node.value, int) or isinstance(node.value, bool) or not low <= node.value <= high:
        raise node.error(expected)
    return node.value
