"""The files at URLs that this process has opened. The parts that are used are
downloaded once, into a local file without a name."""

import contextlib
import os
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterable, Iterator
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg._urls.failures import naming_errors, no_room
from v3dg._urls.http import WebSource
from v3dg._urls.names import beside, full, is_url, shown
from v3dg._urls.others import OtherSource

Source: TypeAlias = WebSource | OtherSource

# Size of a block, the smallest unit that is downloaded. Pages are much larger.
_BLOCK_BYTES = 1024
_MOST_BLOCKS = 1 << 12  # number of blocks in a piece, the largest unit of a request
_MOST_PIECES = 8  # number of pieces that are requested at once
# Maximum size of a file if the server does not send the size.
_MOST_UNKNOWN_BYTES = 2 << 30
# Number of bytes that must stay free on the disk of temporary files.
_SPARE_BYTES = 256 << 20
# Number of files that are kept open for later use. Files in use do not count.
_MOST_OPENED = 256
_COPIED_BYTES = 1 << 20  # number of bytes that are copied at once
# The USD library selects the format by the end of the file name.
_NEEDS_NAME = (".usd", ".usda", ".usdc", ".usdz")

_opened: dict[str, "FileAtUrl"] = {}


def in_parts(path: str | os.PathLike[str]) -> "str | os.PathLike[str] | FileAtUrl":
    """Open a file at a URL without downloading it yet. The name of a local file is
    returned unchanged.

    If the server reports that a file has not changed, it is not downloaded again.

    Raises:
        ImportError: The extra `fsspec`, or a package that fsspec needs for this kind of
            URL, is not installed.
        ValueError: The URL does not belong to a file, the file refers to other files,
            or it is inside another file.
        FileNotFoundError, PermissionError, TimeoutError, ConnectionError, OSError: The
            file cannot be downloaded.
    """
    if not is_url(path):
        return path
    url = full(path)
    name = beside(path).name
    expected = "the URL of a bundle, or of an asset in one file"
    check(shown(url), name, f"{expected}, got the URL of a folder; add the file's name")
    check(
        shown(url),
        not name.endswith(".json"),
        f"{expected}, got the URL of a file that refers to other files; download its folder",
    )
    check(
        shown(url), "::" not in url, f"{expected}, got a chain of URLs with '::'; download the file"
    )
    with naming_errors(url):
        source = _source_of(url)
    file = _opened.pop(url, None)
    if file is None or not source.tag or source.tag != file.tag:
        file = FileAtUrl(url, source)
    _opened[url] = file
    while len(_opened) > _MOST_OPENED:
        del _opened[next(iter(_opened))]
    return file


@contextlib.contextmanager
def reading(path: "str | os.PathLike[str] | FileAtUrl") -> Iterator[str | os.PathLike[str]]:
    """Yield a name under which a reader can open the file. A file at a URL is
    downloaded as a whole, and errors inside the context contain its URL."""
    file = path
    if not isinstance(file, FileAtUrl):
        file = in_parts(file)
    if not isinstance(file, FileAtUrl):
        yield file
        return
    with file.named() as local, _renaming(local, shown(file)):
        yield local


@contextlib.contextmanager
def _renaming(local: str, name: str) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        if error.errno is None or os.fspath(error.filename or local) != local:
            raise
        raise OSError(error.errno, os.strerror(error.errno), name) from None
    except ValueError as error:
        raise ValueError(str(error).replace(local, name)) from None


def _source_of(url: str) -> Source:
    file_system, path = _extras.load("fsspec").core.url_to_fs(url)
    if url.partition("://")[0].lower() in ("http", "https"):
        return WebSource(file_system, path)
    return OtherSource(file_system, path)


def _copy(descriptor: int, path: str) -> None:
    """Copy the content of an open file to a new file."""
    offset = 0
    with open(path, "xb") as copy:
        while data := _files.read_bytes_at(descriptor, _COPIED_BYTES, offset):
            copy.write(data)
            offset += len(data)


class FileAtUrl(os.PathLike[str]):
    """A file at a URL. The parts that are used are downloaded once into a local file
    without a name. Nothing of it remains on the disk, however the process ends.

    Attributes:
        file: The local file. Bytes that have not been downloaded yet are 0, or missing
            at the end.
        num_bytes: Size of the file at the URL in bytes.
        tag: Text that changes when the content at the URL changes. It is empty if the
            server sends none.
        needs_name: Whether the reader for this format depends on the end of the name.
    """

    def __init__(self, url: str, source: Source) -> None:
        self._url = url
        self._source = source
        self.tag = source.tag
        self.needs_name = beside(url).suffix.lower() in _NEEDS_NAME
        # The finalizer closes the file.
        self.file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115
        weakref.finalize(self, self.file.close)
        self._lock = threading.Lock()
        self._is_whole = False
        # For each piece, whether each of its blocks has been downloaded.
        self._is_fetched: dict[int, NDArray[np.bool_]] = {}
        self.num_bytes = -1
        if source.num_bytes is None:  # without the size, parts cannot be requested
            self._fetch_whole()
        else:
            self.num_bytes = source.num_bytes

    def __fspath__(self) -> str:
        return self._url

    @contextlib.contextmanager
    def named(self) -> Iterator[str]:
        """Yield the name of a local file with the whole content, which is valid inside
        the context. Raise the errors of `fetch`.

        The name refers to an open file of this process. If the reader depends on the
        end of the name, it is a symbolic link to that file; without /proc, it is a copy
        of the file. The link or the copy is removed afterwards.
        """
        self._fetch_whole()
        name = f"/proc/self/fd/{self.file.fileno()}"
        has_name = os.path.exists(name)
        if has_name and not self.needs_name:
            yield name
            return
        # Windows cannot remove a file that the reader has left open.
        with tempfile.TemporaryDirectory(prefix="v3dg_", ignore_cleanup_errors=True) as folder:
            local = os.path.join(folder, f"file{beside(self._url).suffix}")
            if has_name:
                os.symlink(name, local)
            else:
                _copy(self.file.fileno(), local)
            yield local

    def fetch(self, parts: Iterable[tuple[int, int]]) -> None:
        """Download the bytes of all parts. A part has the offset of its first byte, and
        the offset after its last byte. Any thread may call this.

        Raises:
            OSError: The bytes cannot be downloaded, or the disk is full.
            ValueError: A part is outside the file, or the file has changed.
        """
        if self._is_whole:
            return
        runs = self._missing(parts)
        for start in range(0, len(runs), _MOST_PIECES):
            batch = runs[start : start + _MOST_PIECES]
            places = [
                (first * _BLOCK_BYTES, min(last * _BLOCK_BYTES, self.num_bytes))
                for first, last in batch
            ]
            with naming_errors(self._url):
                self._check_room(sum(last - first for first, last in places))
                is_whole = self._source.read_parts(places, self._write)
            if is_whole:
                self._is_whole = True
                return
            for first, last in batch:
                piece = first // _MOST_BLOCKS
                is_fetched = self._is_fetched.setdefault(piece, np.zeros(_MOST_BLOCKS, np.bool_))
                is_fetched[first - piece * _MOST_BLOCKS : last - piece * _MOST_BLOCKS] = True

    def _missing(self, parts: Iterable[tuple[int, int]]) -> list[tuple[int, int]]:
        """Return the runs of blocks that the parts need and that have not been
        downloaded yet. No run is longer than a piece."""
        is_needed: dict[int, NDArray[np.bool_]] = {}
        for first, last in parts:
            expected = f"a part within its {self.num_bytes} bytes, got {first} to {last}"
            check(shown(self), 0 <= first <= last <= self.num_bytes, expected)
            first_block = first // _BLOCK_BYTES
            last_block = -(-last // _BLOCK_BYTES)
            for piece in range(first_block // _MOST_BLOCKS, -(-last_block // _MOST_BLOCKS)):
                start = piece * _MOST_BLOCKS
                blocks = is_needed.setdefault(piece, np.zeros(_MOST_BLOCKS, np.bool_))
                blocks[max(first_block - start, 0) : last_block - start] = True
        runs: list[tuple[int, int]] = []
        for piece in sorted(is_needed):
            is_missing = is_needed[piece]
            if piece in self._is_fetched:
                is_missing = is_missing & ~self._is_fetched[piece]
            numbers = np.flatnonzero(is_missing) + piece * _MOST_BLOCKS
            cuts = np.flatnonzero(np.diff(numbers) > 1) + 1
            runs += [(int(run[0]), int(run[-1]) + 1) for run in np.split(numbers, cuts) if len(run)]
        return runs

    def _fetch_whole(self) -> None:
        with self._lock:
            if self._is_whole:
                return
            max_bytes = self.num_bytes
            if max_bytes < 0:
                max_bytes = _MOST_UNKNOWN_BYTES
            with naming_errors(self._url):
                self._check_room(max(self.num_bytes, 0))
                self.num_bytes = self._source.read_all(max_bytes, self._write)
            self._is_whole = True

    def _write(self, data: bytes, offset: int) -> None:
        self._check_room(len(data))
        try:
            _files.write_at(self.file.fileno(), data, offset)
        except OSError as error:
            raise no_room(tempfile.gettempdir(), error) from None

    def _check_room(self, num_bytes: int) -> None:
        free = shutil.disk_usage(tempfile.gettempdir()).free
        if num_bytes + _SPARE_BYTES > free:
            raise no_room(tempfile.gettempdir())
