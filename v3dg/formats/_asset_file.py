"""A file of gaussians that is read a run of rows at a time."""

from __future__ import annotations

import os
import weakref
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg.formats._reading import Path, check
from v3dg.gaussians import Gaussians, gaussian_bytes


@dataclass(frozen=True, eq=False)
class AssetFile:
    """What the header of an asset's file says, and its gaussians on demand; open until it is dropped.

    Attributes:
        read: Gaussians from a first row up to a last. Runs that follow each other are the quickest. Raises
            what the format's own `read` raises.
        whole_bytes: Memory that the first read takes and keeps, where the format can only be read whole.
    """

    path: Path
    num_gaussians: int
    sh_degree: int
    read: Callable[[int, int], Gaussians]
    whole_bytes: int = 0


def bytes_of(files: Iterable[Path]) -> int:
    """On disk, of those that are there."""
    return sum(os.stat(file).st_size for file in set(files) if os.path.exists(file))


def whole_file(
    path: Path, count: int, sh_degree: int, read: Callable[[Path], Gaussians], files: Iterable[Path] = ()
) -> AssetFile:
    """A file, and others that it names, that can only be read whole: on the first read, and then kept."""
    whole = cache(lambda: read(path))
    # While it is read: what is on the disk, and on the way to the gaussians no more than twice those.
    memory = bytes_of([path, *files]) + 2 * count * gaussian_bytes(sh_degree)
    return AssetFile(path, count, sh_degree, lambda first, last: whole().subset(slice(first, last)), memory)


class File:
    """A file that is read in places, closed when it is dropped; ValueError where it is no regular one."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _files.naming_errors(path):
            self._descriptor = _files.open_regular(path)
        weakref.finalize(self, os.close, self._descriptor)
        self.num_bytes = os.fstat(self._descriptor).st_size

    def rows(self, dtype: np.dtype[Any], offset: int, count: int) -> NDArray[Any]:
        """`count` records of a kind from an offset on; ValueError where the file has become shorter."""
        rows = np.empty(count, dtype)
        with _files.naming_errors(self.path):
            is_whole = _files.read_at(self._descriptor, rows, offset)
        check(self.path, is_whole, "the file not to change while it is read, got a shorter one")
        return rows
