"""Finished levels of a build, kept in a file so that it can be gone on with."""

from __future__ import annotations

import json
import math
import os
import stat
import struct
import threading
from collections.abc import Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager, suppress
from io import FileIO
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _device, _files
from v3dg._device import Device
from v3dg._version import __version__
from v3dg.build.plan import LevelPlan
from v3dg.build.scratch import lock
from v3dg.build.simplify import Level, LevelTables
from v3dg.bundle.format import HASH_BYTES, page_hash
from v3dg.gaussians import Gaussians, shapes_of

_FLOATS_AT_ONCE = 4 << 20
_RECORD = struct.Struct("<II")  # in front of a level: its part, its number
PIECE = 1 << 16
"""Gaussians that are read, examined and hashed at a time; the digest of an asset depends on it."""


class Checkpoint:
    """Finished levels in a file that grows by one after each; level 0, the leaves, is quicker to make anew.

    A level whose writing was cut off does not count; one that is whole but damaged is an error. The file is
    locked while a build uses it, and is gone after one that finished no level. Any thread may load and save.

    Args:
        parts: What is built alone, by its number: the plans of its levels by theirs.
        made_with: What the bundle will say of how it was built, its asset's digest with it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        parts: Sequence[Mapping[int, LevelPlan]],
        sh_degree: int,
        made_with: dict[str, Any],
        device: Device,
    ) -> None:
        self._path = None if path is None else Path(path)
        self._parts = parts
        what = json.dumps([made_with, _device.describe(device), __version__], sort_keys=True).encode()
        self._head = b"v3dg levels 4\n" + page_hash([np.frombuffer(what, np.uint8)])
        self._sh_degree = sh_degree
        self._num_bytes = 0  # of the file that are good
        self._places: dict[tuple[int, int], int] = {}  # of parts' levels in the file
        self._lock = threading.Lock()

    def __enter__(self) -> Checkpoint:
        if self._path is not None:
            if not self._path.parent.is_dir():
                raise ValueError(f"resume_path: expected a file in an existing folder, got {self._path}")
            self._file = _open_locked(self._path)
            try:
                with self._reading():
                    head = self._file.read(len(self._head))
                if not self._head.startswith(head):
                    raise ValueError(
                        f"{self._path}: holds something else, or levels of another asset, config, seed, "
                        "device or version; remove it to start again"
                    )
                with self._reading():
                    self._find_levels()
            except BaseException:
                self._file.close()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._path is not None:
            if os.fstat(self._file.fileno()).st_size == 0:
                self._path.unlink(missing_ok=True)
            self._file.close()

    @property
    def num_gaussians(self) -> int:
        """Of the finished levels."""
        return sum(self._parts[part][number].num_gaussians for part, number in self._places)

    def load(self, part: int) -> Iterator[Level]:
        """The finished levels of a part but the leaves, one after another."""
        for number in sorted(self._parts[part]):
            if number > 0:
                with self._lock:
                    if (part, number) not in self._places:
                        return
                    with self._reading():
                        level = self._read(self._places[part, number], self._parts[part][number])
                yield level

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:
            raise ValueError(
                f"{self._path}: expected levels of an interrupted build, could not read them "
                f"({error}); remove it to start again"
            ) from error

    def _find_levels(self) -> None:
        """Note where levels are, up to the one that was cut off."""
        size = os.fstat(self._file.fileno()).st_size
        if size < len(self._head):
            return
        self._num_bytes = place = len(self._head)
        while place + _RECORD.size + HASH_BYTES <= size:
            self._file.seek(place)
            part, number = _RECORD.unpack(self._file.read(_RECORD.size))
            if not (part < len(self._parts) and number in self._parts[part]):
                raise ValueError("a level is damaged")
            num_floats = sum(map(math.prod, self._shapes(self._parts[part][number])))
            end = place + _RECORD.size + HASH_BYTES + 4 * num_floats
            if end > size:
                return
            self._places[part, number] = place + _RECORD.size
            self._num_bytes = place = end

    def _shapes(self, plan: LevelPlan) -> list[tuple[int, ...]]:
        """Of the arrays of a level, in order; all are float32."""
        clusters, groups = plan.num_clusters, plan.num_groups
        rows = shapes_of(plan.num_gaussians, self._sh_degree)
        return [*rows, (clusters, 2, 3), (groups, 4), (groups, 4), (groups, 2)]

    def _read(self, place: int, plan: LevelPlan) -> Level:
        self._file.seek(place)
        digest = self._file.read(HASH_BYTES)
        arrays = [
            np.fromfile(self._file, np.float32, math.prod(shape)).reshape(shape)
            for shape in self._shapes(plan)
        ]
        if _digest_of_arrays(arrays) != digest:
            raise ValueError("a level is damaged")
        return Level(Gaussians(*arrays[:5]), LevelTables(*arrays[5:]))

    def save(self, part: int, number: int, level: Level) -> None:
        """Add a level that is on the host, if it is new; what a full disk cuts off is removed again."""
        if self._path is None or (part, number) in self._places:
            return
        arrays = [*vars(level.gaussians).values(), *vars(level.tables).values()]
        head = _RECORD.pack(part, number) + _digest_of_arrays(arrays)
        with self._lock, _files.naming_errors(self._path):
            descriptor, end = self._file.fileno(), self._num_bytes
            os.ftruncate(descriptor, end)
            head = (self._head if end == 0 else b"") + head
            pieces = [memoryview(head), *(array.reshape(-1).view(np.uint8).data for array in arrays)]
            try:
                for data in pieces:
                    _files.write_at(descriptor, data, end)
                    end += len(data)
            except OSError:
                os.ftruncate(descriptor, self._num_bytes)
                raise
            self._places[part, number] = end - sum(map(len, pieces[1:])) - HASH_BYTES
            self._num_bytes = end


def discard_levels(resume_path: str | os.PathLike[str]) -> None:
    """Remove what an interrupted build left there, if anything.

    Raises:
        RuntimeError: A build is using it.
    """
    if os.path.lexists(resume_path):
        with _open_locked(resume_path):
            os.unlink(resume_path)


def _open_locked(path: str | os.PathLike[str]) -> FileIO:
    """Open or make a file to read and write; other builds are kept out until it is closed."""
    # O_NONBLOCK: opening a pipe must not wait for a writer; regular files ignore it.
    flags = os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NONBLOCK | os.O_NOFOLLOW
    while True:
        if os.path.islink(path):
            raise ValueError(f"{os.fspath(path)}: expected a file of levels, got a link; remove it")
        # Whoever may see the bundle is settled when it replaces what is there.
        file = FileIO(path, "r+", opener=lambda name, _: os.open(name, flags, 0o600))
        try:
            status = os.fstat(file.fileno())
            if not stat.S_ISREG(status.st_mode):
                raise ValueError(f"{os.fspath(path)}: expected a file of levels, got a device or a pipe")
            lock(file.fileno(), path)
            # The build that had the lock before may have removed the file.
            with suppress(FileNotFoundError):
                if os.path.samestat(status, os.lstat(path)):
                    return file
        except BaseException:
            file.close()
            raise
        file.close()


def digest_of(asset: Gaussians) -> str:
    """What tells an asset from others, wherever it was read from; docs/format.md has the definition."""
    return _digest([[*vars(part).values()] for part in parts_of(asset.numpy())]).hex()


def parts_of(gaussians: Gaussians) -> list[Gaussians]:
    """Pieces of them, sharing their memory."""
    return [gaussians.subset(slice(start, start + PIECE)) for start in range(0, len(gaussians), PIECE)]


def _digest_of_arrays(arrays: Sequence[npt.NDArray[np.float32]]) -> bytes:
    flat = [array.reshape(-1) for array in arrays]
    return _digest([[a[i : i + _FLOATS_AT_ONCE]] for a in flat for i in range(0, len(a), _FLOATS_AT_ONCE)])


def _digest(blocks: Sequence[Sequence[npt.NDArray[np.float32]]]) -> bytes:
    """Of the digests of the blocks, so that all cores share the work."""
    if sum(array.size for block in blocks for array in block) < _FLOATS_AT_ONCE:
        # Less work than starting threads, which Python does not do safely where memory runs out.
        return digest_of_hashes(map(page_hash, blocks))
    with new_pool() as pool:
        return digest_of_hashes(pool.map(page_hash, blocks))


def digest_of_hashes(hashes: Iterable[bytes]) -> bytes:
    return page_hash([np.frombuffer(b"".join(hashes), np.uint8)])


def new_pool() -> ThreadPoolExecutor:
    """Threads to hash and copy with."""
    return ThreadPoolExecutor(min(os.cpu_count() or 1, 16))
