"""Code that readers of untrusted files share: assets that are read in parts, and limits
on memory."""

import contextlib
import os
import weakref
import zipfile
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache
from typing import IO, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._files import value_errors as value_errors
from v3dg._json import Node
from v3dg._numbers import check as check
from v3dg.formats._declared import NOTHING, Declared
from v3dg.gaussians import Gaussians, gaussian_bytes

# 15 to 62 MB; a file of any size may claim to have this many gaussians
_FREE_GAUSSIANS = 1 << 18
_MAX_NAMES = 8  # number of names in a message
_FREE_BYTES = 1 << 20  # a member of a zip may have this size, however small the zip is


AnyPath: TypeAlias = str | os.PathLike[str]
_Scalar = TypeVar("_Scalar", bound=np.generic)


@dataclass(frozen=True, eq=False)
class AssetFile:
    """The header of an asset's file, and a function that reads its gaussians. The file
    is open while this object exists.

    Attributes:
        read: Function that returns the gaussians from a first row up to an end row. It
            is fastest to read rows in the order of the file. It raises the errors of
            `read_asset`.
        whole_bytes: For formats that can only be read as a whole, the memory in bytes
            that the first read occupies until the file is closed. It is 0 for other
            formats.
        declared: What the file declares about its gaussians.
    """

    path: AnyPath
    num_gaussians: int
    sh_degree: int
    read: Callable[[int, int], Gaussians]
    whole_bytes: int = 0
    declared: Declared = NOTHING


def listed(names: Iterable[str]) -> str:
    """Return names as text for a message: the first few, shortened, and the number of
    the others."""
    all_names = list(names)
    text = ", ".join(f"{name[:40]!a}" for name in all_names[:_MAX_NAMES])
    if len(all_names) > _MAX_NAMES:
        text += f" and {len(all_names) - _MAX_NAMES} more"
    return text


def bytes_of(files: Iterable[AnyPath]) -> int:
    """Return the total size in bytes of those files that exist."""
    return sum(os.stat(file).st_size for file in set(files) if os.path.exists(file))


def whole_file(
    path: AnyPath,
    count: int,
    sh_degree: int,
    read: Callable[[AnyPath], Gaussians],
    files: Iterable[AnyPath] = (),
    declared: Declared = NOTHING,
) -> AssetFile:
    """Return an asset file for a format that can only be read as a whole. The first
    read keeps all gaussians in memory."""
    read_once = cache(lambda: read(path))
    # The memory during the first read: the content of the files, and up to two copies
    # of the gaussians.
    memory = bytes_of([path, *files]) + 2 * count * gaussian_bytes(sh_degree)
    return AssetFile(
        path,
        num_gaussians=count,
        sh_degree=sh_degree,
        read=lambda first, last: read_once().subset(slice(first, last)),
        whole_bytes=memory,
        declared=declared,
    )


class File:
    """A file with random access, which is closed when this object is destroyed. Raises
    ValueError unless it is a regular file."""

    def __init__(self, path: AnyPath) -> None:
        self.path = path
        with _files.naming_errors(path):
            self._descriptor = _files.open_regular(path)
        weakref.finalize(self, os.close, self._descriptor)
        self.num_bytes = os.fstat(self._descriptor).st_size

    def rows(self, dtype: np.dtype[_Scalar], offset: int, count: int) -> NDArray[_Scalar]:
        """Return `count` records, beginning at an offset. Raise ValueError if the file
        has been truncated in the meantime."""
        rows = np.empty(count, dtype)
        with _files.naming_errors(self.path):
            is_whole = _files.read_at(self._descriptor, rows, offset)
        if not is_whole:
            name = os.fspath(self.path)
            raise ValueError(f"{name}: the file was truncated while it was read; read it again")
        return rows


def least_bytes(count: int) -> int:
    """Return the minimum size, in bytes, of a file with `count` gaussians. It is one
    byte for each gaussian after the first _FREE_GAUSSIANS."""
    return max(0, count - _FREE_GAUSSIANS)


class Claims:
    """The files of an asset, and the number of gaussians that they claim to contain.
    Files that are too small for this number are rejected."""

    def __init__(self) -> None:
        # Sizes in bytes, by device and inode, because a file may have several names.
        self._files: dict[tuple[int, int], int] = {}
        self._gaussians = 0

    @contextlib.contextmanager
    def open(self, path: AnyPath) -> Iterator[IO[bytes]]:
        with _files.naming_errors(path), open(_files.open_regular(path), "rb") as file:
            status = os.fstat(file.fileno())
            self._files[status.st_dev, status.st_ino] = status.st_size
            yield file

    def read(self, path: AnyPath) -> bytes:
        with self.open(path) as file:
            return file.read()

    @property
    def num_bytes(self) -> int:
        """Total size of all files in bytes."""
        return sum(self._files.values())

    def add(self, path: AnyPath, count: int) -> None:
        """Accept that a file has `count` more gaussians. Raise ValueError if the files
        are too small for all of them. Call this before allocating memory for the
        gaussians."""
        self._gaussians += count
        num_bytes = self.num_bytes
        is_plausible = least_bytes(self._gaussians) <= num_bytes
        claim = f"{self._gaussians} gaussians in {num_bytes} bytes"
        check(
            path,
            is_plausible,
            f"at least one byte per gaussian after the first {_FREE_GAUSSIANS}, got {claim}; is "
            "the file complete?",
        )


class Archive:
    """A zip whose members have correct checksums. A member must not be larger than the
    zip, or than 1 MiB for a smaller zip."""

    def __init__(self, path: AnyPath, file: IO[bytes]) -> None:
        self._path = path
        start = file.read(4)  # zipfile accepts a zip that starts anywhere in a file
        check(path, start == b"PK\3\4", f"a zip, got a file that begins with {start!r}")
        with value_errors(path, "a zip that is not damaged"):
            self._zip = zipfile.ZipFile(file)
            self._max_bytes = max(_FREE_BYTES, file.seek(0, os.SEEK_END))
        self.names = self._zip.namelist()

    def read(self, name: str) -> bytes:
        check(self._path, name in self._zip.NameToInfo, f"{name!a} in the zip, got none")
        member = self._zip.getinfo(name)
        size = member.file_size
        check(
            self._path,
            size <= self._max_bytes,
            f"{name!a} in the zip to be no larger than the zip, got {size} bytes",
        )
        is_readable = member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
        check(
            self._path,
            is_readable,
            f"{name!a} in the zip to be stored or deflated, got another compression",
        )
        # Torch can be configured to write no checksums.
        if getattr(member, "CRC", None) == 0:
            del member.CRC  # zipfile does not compare a missing checksum
        with value_errors(self._path, "a zip that is not damaged"), self._zip.open(member) as file:
            # Without a size, zipfile would decompress everything, however large it is.
            content = file.read(size)
        check(self._path, len(content) == size, f"{size} bytes in {name!a}, got {len(content)}")
        return content


def integer_of(node: Node, expected: str, low: int, high: int) -> int:
    """Return a JSON value that must be an integer from ``low`` to ``high``."""
    if (
        not isinstance(node.value, int)
        or isinstance(node.value, bool)
        or not low <= node.value <= high
    ):
        raise node.error(expected)
    return node.value
