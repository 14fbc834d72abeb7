"""Finished levels of a build, kept in a file so that it can be gone on with."""

from __future__ import annotations

import errno
import fcntl
import json
import math
import os
import stat
from collections.abc import Iterator, Sequence
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
from v3dg.build.plan import LevelPlan, Plan
from v3dg.build.simplify import Level, LevelTables
from v3dg.bundle.format import HASH_BYTES, page_hash
from v3dg.gaussians import Gaussians

_FLOATS_AT_ONCE = 4 << 20
_GAUSSIANS_AT_ONCE = 1 << 16  # of this the digest of an asset depends


class Checkpoint:
    """Finished levels in a file that grows by one after each; the first, the leaves, is quicker to make anew.

    A level whose writing was cut off does not count; one that is whole but damaged is an error. The file is
    locked while a build uses it, and is gone after one that finished no level.

    Args:
        made_with: What the bundle will say of how it was built, its asset's digest with it.
    """

    def __init__(
        self,
        path: str | os.PathLike[str] | None,
        plan: Plan,
        sh_degree: int,
        made_with: dict[str, Any],
        device: Device,
    ) -> None:
        self.num_levels = 0  # that are in the file, beside the leaves
        self._path = None if path is None else Path(path)
        self._levels = plan.levels
        what = json.dumps([made_with, _device.describe(device), __version__], sort_keys=True).encode()
        self._head = b"v3dg levels 3\n" + page_hash([np.frombuffer(what, np.uint8)])
        self._num_bases = (sh_degree + 1) ** 2
        self._num_bytes = 0  # of the file that are good

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
            except BaseException:
                self._file.close()
                raise
        return self

    def __exit__(self, *_: object) -> None:
        if self._path is not None:
            if os.fstat(self._file.fileno()).st_size == 0:
                self._path.unlink(missing_ok=True)
            self._file.close()

    def load(self) -> Iterator[Level]:
        """The finished levels but the leaves, one after another."""
        if self._path is None:
            return
        for plan in self._levels[1:]:
            with self._reading():
                level = self._read(plan)
            if level is None:
                return
            self._num_bytes = self._file.tell()
            self.num_levels += 1
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

    def _read(self, plan: LevelPlan) -> Level | None:
        """The next level; None where the file ends before it does."""
        n, clusters, groups = plan.num_gaussians, plan.num_clusters, plan.num_groups
        shapes: list[tuple[int, ...]] = [(n, 3), (n, 4), (n, 3), (n,), (n, self._num_bases, 3)]
        shapes += [(clusters, 2, 3), (groups, 4), (groups, 2)]
        left = os.fstat(self._file.fileno()).st_size - self._file.tell()
        if HASH_BYTES + 4 * sum(map(math.prod, shapes)) > left:
            return None
        digest = self._file.read(HASH_BYTES)
        arrays = [np.fromfile(self._file, np.float32, math.prod(shape)).reshape(shape) for shape in shapes]
        if _digest_of_arrays(arrays) != digest:
            raise ValueError("a level is damaged")
        return Level(Gaussians(*arrays[:5]), LevelTables(*arrays[5:]))

    def save(self, level: Level) -> None:
        """Add a level that is on the host; what a full disk cuts off is removed again."""
        if self._path is None:
            return
        arrays = [*vars(level.gaussians).values(), *vars(level.tables).values()]
        descriptor, end = self._file.fileno(), self._num_bytes
        os.ftruncate(descriptor, end)
        with _files.naming_errors(self._path):
            try:
                head = (self._head if end == 0 else b"") + _digest_of_arrays(arrays)
                pieces = [memoryview(head), *(array.reshape(-1).view(np.uint8).data for array in arrays)]
                for data in pieces:
                    _files.write_at(descriptor, data, end)
                    end += len(data)
            except OSError:
                os.ftruncate(descriptor, self._num_bytes)
                raise
        self._num_bytes = end
        self.num_levels += 1


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
            _lock(file)
            # The build that had the lock before may have removed the file.
            with suppress(FileNotFoundError):
                if os.path.samestat(status, os.lstat(path)):
                    return file
        except BaseException:
            file.close()
            raise
        file.close()


def _lock(file: FileIO) -> None:
    try:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RuntimeError(
            f"{os.fspath(file.name)}: another build is using it; wait for it, or write to another place"
        ) from None
    except OSError as error:
        # Some network file systems have no locks; there, two builds of one output are the user's to avoid.
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            raise


def digest_of(asset: Gaussians) -> str:
    """What tells an asset from others, wherever it was read from; docs/format.md has the definition."""
    host = asset.numpy()
    starts = range(0, len(host), _GAUSSIANS_AT_ONCE)
    return _digest([[*vars(host.subset(slice(i, i + _GAUSSIANS_AT_ONCE))).values()] for i in starts]).hex()


def _digest_of_arrays(arrays: Sequence[npt.NDArray[np.float32]]) -> bytes:
    flat = [array.reshape(-1) for array in arrays]
    return _digest([[a[i : i + _FLOATS_AT_ONCE]] for a in flat for i in range(0, len(a), _FLOATS_AT_ONCE)])


def _digest(blocks: Sequence[Sequence[npt.NDArray[np.float32]]]) -> bytes:
    """Of the digests of the blocks, so that all cores share the work."""
    if sum(array.size for block in blocks for array in block) < _FLOATS_AT_ONCE:
        # Less work than starting threads, which Python does not do safely where memory runs out.
        return page_hash([np.frombuffer(b"".join(map(page_hash, blocks)), np.uint8)])
    with ThreadPoolExecutor(min(os.cpu_count() or 1, 16)) as pool:
        return page_hash([np.frombuffer(b"".join(pool.map(page_hash, blocks)), np.uint8)])
