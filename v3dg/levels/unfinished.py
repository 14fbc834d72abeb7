"""The unfinished bundle, from which an interrupted build continues.

It is the file of the bundle, with the finished pages at their final positions. The
journal begins behind the end of the finished file: a record for each finished level of
each part, with its tables and the hashes of its pages. The first bytes distinguish it
from a bundle: a header of length 0, and the digest of the asset and the settings.
"""

import json
import os
import re
import stat
import struct
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from io import FileIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v3dg import _device, _files
from v3dg._device import Device
from v3dg._numbers import check
from v3dg._version import __version__
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.bundle.codec import Codec
from v3dg.bundle.file import BundlePlan, read_pages, write_pages
from v3dg.bundle.format import HASH_BYTES, page_hash
from v3dg.bundle.pages import PageRun
from v3dg.gaussians import Gaussians, put
from v3dg.levels.plan import LevelPlan
from v3dg.levels.simplify import Level, LevelTables

# A record begins with the number of its part, the number of its level, and the hash of
# the arrays that follow.
_RECORD = struct.Struct("<II16s")
_MAGIC = bytes(8) + b"unfinished v3dg 1\n"
# Names in the folder of refined units: a bundle for each unit, and the incomplete files
# of a killed process.
_UNIT_NAME = re.compile(r"\d+\.v3dg|\.\d+\.v3dg\.[0-9a-f]+\.tmp")


@dataclass(frozen=True, eq=False)
class FinishedLevel:
    """A level of a part whose pages are written."""

    tables: LevelTables
    hashes: npt.NDArray[np.uint8]  # (n, 16) hashes of the pages

    def read(self, pages: "PageFile | MemoryStore", run: PageRun) -> Level:
        """Return the level, read from its pages."""
        return Level(pages.read(run, self.hashes), self.tables)


Part = Mapping[int, tuple[LevelPlan, PageRun]]
"""The levels of a unit, or of the part above all units: the plan and the pages of each
level, by the level's number."""

Refine = Callable[[Bundle, Path | None], Bundle]
"""Returns a bundle with refined levels. Units are stored in the folder, if there is
one, and the result may read its pages from there."""


@dataclass(frozen=True)
class PageFile:
    """The pages of an unfinished bundle, for every process on any machine that can open
    its file."""

    path: Path
    head: bytes
    codec: Codec

    def write(self, run: PageRun, gaussians: Gaussians) -> npt.NDArray[np.uint8]:
        """Write the gaussians of a run of pages, on any device; return (n, 16) their
        hashes."""
        with self._opened(os.O_RDWR) as descriptor:
            hashes = write_pages(self.path, descriptor, run, self.codec, gaussians)
            first, last = run.places[[0, -1]].tolist()
            _files.start_flush(descriptor, first, last - first)
            return hashes

    def read(self, run: PageRun, hashes: npt.NDArray[np.uint8]) -> Gaussians:
        """Return the gaussians of a run of pages that have these hashes."""
        with self._opened(os.O_RDONLY) as descriptor:
            return read_pages(self.path, descriptor, run, self.codec, hashes)

    @contextmanager
    def _opened(self, flags: int) -> Iterator[int]:
        """Open the file anew, so that on a network file system this machine and others
        see each other's writes."""
        with _files.naming_errors(self.path):
            descriptor = os.open(self.path, flags | _files.OPEN_SAFELY)
            try:
                head = _files.read_bytes_at(descriptor, len(self.head), 0)
                check(
                    self.path,
                    head == self.head,
                    "the unfinished bundle of this build, got another file; build again",
                )
                yield descriptor
            finally:
                os.close(descriptor)


class Unfinished:
    """A bundle in progress. Its file replaces `bundle_path` at the end, or stays where
    it is if `bundle_path` is None.

    A truncated record is ignored; a damaged record or page is an error. The file is
    locked while a build uses it. It is removed if the build ends before a level above
    the leaves is finished.
    """

    def __init__(
        self,
        path: Path,
        plan: BundlePlan,
        parts: Sequence[Part],
        device: Device,
        bundle_path: Path | None,
    ) -> None:
        self._path = path
        self._bundle_path = bundle_path
        self._plan = plan
        self._parts = parts
        description = [plan.header.decode("latin-1"), *described(device), len(parts)]
        digest = page_hash([np.frombuffer(json.dumps(description).encode(), np.uint8)])
        self.pages = PageFile(Path(os.path.abspath(path)), _MAGIC + digest, plan.codec)
        self.levels: dict[tuple[int, int], FinishedLevel] = {}
        self.is_whole = False
        self._end = plan.num_bytes  # end of the journal
        self._lock = threading.Lock()

    def __enter__(self) -> "Unfinished":
        check(
            "resume_path",
            self._path.parent.is_dir(),
            f"a file in an existing folder, got {self._path}; create the folder",
        )
        self._file = _open_locked(self._path)
        try:
            with _files.naming_errors(self._path):
                self._continue(self._file.fileno(), self.pages.head)
        except BaseException:
            self._file.close()
            raise
        return self

    def _continue(self, descriptor: int, magic: bytes) -> None:
        """Read the levels that an interrupted build of the same bundle has finished, or
        begin an empty file."""
        head = _files.read_bytes_at(descriptor, len(self._plan.header), 0)
        if head == self._plan.header:
            os.ftruncate(descriptor, self._plan.num_bytes)
            with self._reading():
                Bundle.open(self._path)
            self.is_whole = True
        elif head.startswith(magic):
            with self._reading():
                self._read_journal()
        elif magic.startswith(head):
            try:
                _files.write_at(descriptor, magic, 0)
            except OSError:
                _files.close_to_move(self._file)
                self._path.unlink()
                raise
        else:
            raise ValueError(
                f"{self._path}: expected levels of this build, got another file, or levels of "
                "another asset, config, seed, device or version; remove it to start again"
            )

    def __exit__(self, *_: object) -> None:
        _files.close_to_move(self._file)
        if not self.is_whole and not any(number > 0 for _, number in self.levels):
            self._path.unlink(missing_ok=True)
        self._file.close()

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except (OSError, ValueError) as error:
            raise ValueError(
                f"{self._path}: expected levels of an interrupted build, got an unreadable file "
                f"({error}); remove it to start again"
            ) from error

    def _read_journal(self) -> None:
        """Read all complete records, and check the pages of their levels."""
        descriptor = self._file.fileno()
        head = np.empty(_RECORD.size, np.uint8)
        while _files.read_at(descriptor, head, self._end):
            part, number, digest = _RECORD.unpack(head.tobytes())
            if not (part < len(self._parts) and number in self._parts[part]):
                raise ValueError("a finished level is damaged")
            plan, run = self._parts[part][number]
            tables = LevelTables(
                box=np.empty((plan.num_clusters, 2, 3), np.float32),
                ball=np.empty((plan.num_groups, 4), np.float32),
                fit_ball=np.empty((plan.num_groups, 4), np.float32),
                error=np.empty((plan.num_groups, 2), np.float32),
            )
            hashes = np.empty((len(run), HASH_BYTES), np.uint8)
            arrays = [*vars(tables).values(), hashes]
            end = self._end + _RECORD.size
            for array in arrays:
                if not _files.read_at(descriptor, array, end):
                    return
                end += array.nbytes
            if page_hash(arrays) != digest:
                raise ValueError("a finished level is damaged")
            level = FinishedLevel(tables, hashes)
            level.read(self.pages, run)  # checks the hashes of the pages
            self.levels[part, number] = level
            self._end = end

    def save(self, part: int, number: int, level: FinishedLevel) -> None:
        """Append a level to the journal; a record that is truncated by a full disk is
        ignored later."""
        arrays = [*vars(level.tables).values(), level.hashes]
        record = _RECORD.pack(part, number, page_hash(arrays))
        with self._lock, _files.naming_errors(self._path):
            descriptor = self._file.fileno()
            end = self._end
            os.ftruncate(descriptor, end)
            for data in (record, *(array.reshape(-1).view(np.uint8).data for array in arrays)):
                _files.write_at(descriptor, data, end)
                end += len(data)
            self.levels[part, number] = level
            self._end = end

    def finish(self, clusters: Clusters, groups: Groups, hashes: npt.NDArray[np.uint8]) -> None:
        """Complete the bundle. If the process is killed at any moment, the file is
        either complete or can be continued by another build."""
        descriptor = self._file.fileno()
        with _files.naming_errors(self._path):
            self._plan.write_tables(descriptor, clusters, groups, hashes)
            os.fsync(descriptor)  # the header must reach the disk after everything else
            try:
                self._plan.write_header(descriptor)
            except OSError:
                # Writing the head works on a full disk, because it overwrites existing
                # bytes.
                _files.write_at(descriptor, self.pages.head, 0)
                raise
            self.is_whole = True
            os.ftruncate(descriptor, self._plan.num_bytes)

    def bundle(self, refine: Refine | None = None) -> Bundle:
        """Return the complete bundle, moved to its final path.

        With `refine`, the refined bundle is written to the final path instead. Until
        then, this file keeps the unrefined levels, so a build that is killed only has
        to refine again. Without a final path, this file stays and the refined bundle is
        in memory.
        """
        _files.close_to_move(self._file)
        if refine is not None:
            bundle = Bundle.open(self._path)
            if self._bundle_path is None:
                return refine(bundle, None)
            with locked_units(units_folder(self._path)) as folder:
                refine(bundle, folder).write(self._bundle_path)
                discard_units(self._path)
            self._path.unlink()
        elif self._bundle_path is not None:
            discard_units(self._path)  # of a refinement that was killed earlier
            _files.put_in_place(self._path, self._bundle_path)
        return Bundle.open(self._bundle_path or self._path)


class MemoryStore:
    """The finished levels of a build and their pages, in memory. It has the interfaces
    of `Unfinished` and of `PageFile`."""

    is_whole = False

    def __init__(self, plan: BundlePlan) -> None:
        self._plan = plan
        self.codec = plan.codec
        self._gaussians = plan.codec.empty(int(plan.layout.offset[-1]))
        self.pages = self
        self.levels: dict[tuple[int, int], FinishedLevel] = {}

    def write(self, run: PageRun, gaussians: Gaussians) -> npt.NDArray[np.uint8]:
        put(gaussians.numpy(), self._gaussians, run.rows.start)
        return np.empty((0, HASH_BYTES), np.uint8)

    def read(self, run: PageRun, hashes: npt.NDArray[np.uint8]) -> Gaussians:
        return self._gaussians.subset(run.rows)

    def save(self, part: int, number: int, level: FinishedLevel) -> None:
        self.levels[part, number] = level

    def finish(self, clusters: Clusters, groups: Groups, hashes: npt.NDArray[np.uint8]) -> None:
        self._clusters = clusters
        self._groups = groups

    def bundle(self, refine: Refine | None = None) -> Bundle:
        bundle = Bundle(
            self._clusters, self._groups, self._gaussians, self._plan.config, self.codec.name
        )
        if refine is None:
            return bundle
        return refine(bundle, None)


def units_folder(levels_path: str | os.PathLike[str]) -> Path:
    """Return the folder for refined units of the bundle, or of the unfinished levels,
    at a path."""
    return Path(levels_path).with_suffix(".units")


@contextmanager
def locked_units(folder: Path) -> Iterator[Path]:
    """Create a folder for refined units, and lock it against other refinements. At the
    end it is removed if it is empty."""
    while True:
        folder.mkdir(mode=0o700, exist_ok=True)
        created = os.lstat(folder)
        with _files.locked_folder(folder, folder, "refinement"):
            # The process that held the lock before may have removed the folder. In this
            # case another one is created.
            is_there = False
            with suppress(FileNotFoundError):
                is_there = os.path.samestat(created, os.lstat(folder))
            if is_there:
                try:
                    yield folder
                finally:
                    with suppress(OSError):
                        folder.rmdir()
                return


def discard_units(levels_path: str | os.PathLike[str]) -> None:
    """Remove the folder of refined units, if there is one. Other files in it stay."""
    folder = units_folder(levels_path)
    if folder.is_symlink() or not folder.is_dir():
        return
    for name in os.listdir(folder):
        if _UNIT_NAME.fullmatch(name):
            (folder / name).unlink(missing_ok=True)
    with suppress(OSError):
        folder.rmdir()


def described(device: Device) -> tuple[str, str]:
    """Return the description of a device and the version of v3dg; the last bits of a
    build depend on both."""
    return _device.describe(device), __version__


def discard_levels(resume_path: str | os.PathLike[str]) -> None:
    """Remove the levels that an interrupted build has left at this path, and its
    refined units, if there are any.

    Raises:
        ValueError: The file is of another kind; it is not removed.
        RuntimeError: A build is using the file.
        OSError: The file cannot be removed.
    """
    if os.path.lexists(resume_path):
        with _open_locked(resume_path) as file:
            head = _files.read_bytes_at(file.fileno(), len(_MAGIC), 0)
            is_ours = _MAGIC.startswith(head) or _is_bundle(resume_path)
            expected = "levels of an interrupted build, got another file; move it elsewhere"
            check(resume_path, is_ours, expected)
            discard_units(resume_path)
            _files.close_to_move(file)
            os.unlink(resume_path)


def _is_bundle(path: str | os.PathLike[str]) -> bool:
    """Return whether a build was killed after the bundle was complete and before it was
    moved."""
    try:
        Bundle.open(path)
    except (OSError, ValueError):
        return False
    return True


def _open_locked(path: str | os.PathLike[str]) -> FileIO:
    """Open or create a file for reading and writing, locked against other builds until
    it is closed."""
    flags = os.O_RDWR | os.O_CREAT | _files.OPEN_SAFELY
    while True:
        check(
            path, not os.path.islink(path), "an ordinary file, got a symbolic link; remove the link"
        )
        # Other users cannot read the unfinished file. The finished file gets the
        # permissions of the bundle that it replaces.
        file = FileIO(path, "r+", opener=lambda name, _: os.open(name, flags, 0o600))
        try:
            status = os.fstat(file.fileno())
            check(
                path,
                stat.S_ISREG(status.st_mode),
                "an ordinary file, got a device or a pipe; choose another path",
            )
            _files.lock(file.fileno(), path)
            # The process that held the lock before may have removed the file. In this
            # case it is opened again.
            with suppress(FileNotFoundError):
                if os.path.samestat(status, os.lstat(path)):
                    return file
        except BaseException:
            file.close()
            raise
        file.close()
