"""Scratch folders with files of rows. They are removed when the work is done."""

import os
from collections.abc import Collection, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from v3dg import _files

# the name of a file that marks the folder as created by this module
_MARK = "v3dg-scratch"

_Scalar = TypeVar("_Scalar", np.float32, np.uint32)


class RowFile(AbstractContextManager["RowFile[_Scalar]"], Generic[_Scalar]):
    """A file of rows of one width, float32 or uint32, in the machine's byte order."""

    def __init__(
        self, path: Path, width: int, dtype: type[_Scalar], *, must_be_new: bool = False
    ) -> None:
        self.path = path
        self._width = width
        self._dtype: np.dtype[_Scalar] = np.dtype(dtype)
        self._row_bytes = width * self._dtype.itemsize
        flags = os.O_RDONLY
        if must_be_new:
            flags = os.O_RDWR | os.O_CREAT | os.O_EXCL
        self._descriptor = os.open(path, flags | _files.NO_LINK | _files.PLAIN, 0o600)

    def __exit__(self, *_: object) -> None:
        os.close(self._descriptor)

    def read(self, first: int, last: int) -> npt.NDArray[_Scalar]:
        """Return rows `first` to `last`, (M, width), or (M,) if the width is 1."""
        shape: tuple[int, ...] = (last - first,)
        if self._width != 1:
            shape = (last - first, self._width)
        rows = np.empty(shape, self._dtype)
        with _files.naming_errors(self.path):
            if not _files.read_at(self._descriptor, rows, first * self._row_bytes):
                expected = f"expected rows {first} to {last} of a scratch file"
                raise OSError(f"{self.path}: {expected}, got fewer; build again")
        return rows

    def blocks(self, first: int, last: int, size: int) -> Iterator[npt.NDArray[_Scalar]]:
        """Yield rows `first` to `last`, at most `size` at a time."""
        for start in range(first, last, size):
            yield self.read(start, min(start + size, last))

    def write(self, first: int, rows: npt.NDArray[_Scalar]) -> None:
        """Write rows, beginning at row `first`."""
        data = np.ascontiguousarray(rows, self._dtype).reshape(-1).view(np.uint8).data
        with _files.naming_errors(self.path):
            _files.write_at(self._descriptor, data, first * self._row_bytes)


@contextmanager
def scratch_folder(folder: Path, names: Collection[str]) -> Iterator[None]:
    """Create an empty folder for files with these names. Remove it at the end.

    First, remove files with these names that a killed run has left.
    """
    folder.mkdir(mode=0o700, exist_ok=True)
    with _files.locked_folder(folder, folder):
        present = os.listdir(folder)
        own_names: set[str] = set()
        if _MARK in present:
            own_names = {_MARK, *names}
        foreign_names = sorted(set(present) - own_names)
        if foreign_names:
            raise ValueError(
                f"{folder}: expected scratch files of a build, got another file, "
                f"{foreign_names[0]!a}; move it elsewhere"
            )
        # The mark is created before, and removed after, all other files. So a folder
        # without a mark has no files of a build.
        os.close(
            os.open(
                folder / _MARK,
                os.O_WRONLY | os.O_CREAT | _files.NO_LINK | _files.PLAIN,
                0o600,
            )
        )
        try:
            _remove(folder, names)
            yield
        finally:
            _remove(folder, names)
            _remove(folder, [_MARK])
            with suppress(OSError):
                folder.rmdir()


def _remove(folder: Path, names: Collection[str]) -> None:
    for name in names:
        (folder / name).unlink(missing_ok=True)
