"""Files at URLs, by fsspec: what is needed of one, or all, comes to files that go with the process."""

import atexit
import contextlib
import os
import re
import shutil
import tempfile
import threading
import weakref
from collections.abc import Iterable, Iterator
from functools import cached_property
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import numpy as np

from v3dg import _extras, _files
from v3dg._numbers import check

# A `Path` of a URL has one slash where there were two.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(?=.)")
_BLOCK_BYTES = 1024  # that come together; pages have far more
_MOST_BLOCKS, _MOST_PIECES = 1 << 12, 8  # of a piece, and that are asked for at once
_opened: dict[tuple[str, str], "FileAtUrl"] = {}


def is_url(path: str | os.PathLike[str]) -> bool:
    """Whether this is the name of a file elsewhere: a file of that name here comes first."""
    return bool(_URL.match(os.fspath(path))) and not os.path.lexists(path)


def shown(path: str | os.PathLike[str]) -> str:
    """The name of a file as it was given: a URL has lost a slash as a `Path`."""
    url = _URL.sub(lambda found: found[1] + ("://" if found[1] != "file" else ":///"), os.fspath(path))
    return url if is_url(path) else os.fspath(path)


def beside(path: str | os.PathLike[str]) -> Path:
    """The file; in place of one at a URL, that of its name in the working folder."""
    return Path(os.path.basename(unquote(urlsplit(os.fspath(path)).path)) if is_url(path) else path)


def local(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """A file that is here: the one of that name, or what is fetched from a URL; errors as `in_parts`."""
    found = in_parts(path)
    return found.whole if isinstance(found, FileAtUrl) else found


def in_parts(path: str | os.PathLike[str]) -> "str | os.PathLike[str] | FileAtUrl":
    """A file that is here, or one at a URL, as it is there now, of which nothing is fetched yet.

    Raises:
        ImportError: The extra `fsspec` is not installed, or what it needs for such URLs.
        ValueError: It is a URL of no file, or of one that names others, which are not fetched.
        OSError: It cannot be had.
    """
    if not is_url(path):
        return path
    url, name = shown(path), beside(path).name
    expected = "the URL of a bundle, or of an asset in one file"
    check(url, name and not name.endswith(".json"), f"{expected}, got one of a file that names others")
    with _naming_errors(url):
        there, place = _extras.load("fsspec").core.url_to_fs(url)
        info = there.info(place)
        key = url, str(info)  # which mostly has a tag or a time, besides the size
        if key not in _opened:
            _opened[key] = FileAtUrl(url, there, place, info["size"], name)
    return _opened[key]


@contextlib.contextmanager
def _naming_errors(url: str) -> Iterator[None]:
    """Make an OSError of what goes wrong in whichever package knows such URLs."""
    try:
        yield
    except (ImportError, ValueError):
        raise
    except Exception as error:
        raise OSError(f"{url}: expected a file, got {type(error).__name__}: {error}") from error


class FileAtUrl(os.PathLike[str]):
    """A file at a URL, and one of its size here, without a name, to which comes what is needed, once.

    Attributes:
        file: The file here.
    """

    def __init__(self, url: str, there: Any, place: str, num_bytes: int | None, name: str) -> None:
        self._url, self._there, self._place, self._name = url, there, place, name
        self.file = tempfile.TemporaryFile(buffering=0)  # noqa: SIM115  # as long as this lives
        weakref.finalize(self, self.file.close)
        if num_bytes is None:  # no parts without it
            shutil.copyfileobj(there.open(place), self.file)
        self._num_bytes = num_bytes or self.file.tell()
        self.file.truncate(self._num_bytes)
        self._is_here = np.full(-(-self._num_bytes // _BLOCK_BYTES), num_bytes is None)  # each block
        # Only those of the asynchronous kind are for several threads.
        self._lock: Any = contextlib.nullcontext() if there.async_impl else threading.Lock()

    def __fspath__(self) -> str:
        return self._url

    @cached_property
    def whole(self) -> str:
        """A file here that has all of it, and its name."""
        folder = tempfile.mkdtemp(prefix="v3dg_")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        with self._lock, _naming_errors(self._url):
            self._there.get_file(self._place, os.path.join(folder, self._name))
        return os.path.join(folder, self._name)

    def fetch(self, parts: Iterable[tuple[int, int]]) -> None:
        """Have the bytes from each first to each last here; on any thread.

        Raises:
            OSError: They cannot be had.
            ValueError: There are fewer than there were.
        """
        wanted = np.zeros_like(self._is_here)
        for first, last in parts:
            wanted[first // _BLOCK_BYTES : -(-last // _BLOCK_BYTES)] = True
        blocks = np.flatnonzero(wanted & ~self._is_here)
        cuts = np.flatnonzero((np.diff(blocks) > 1) | (blocks[1:] % _MOST_BLOCKS == 0)) + 1
        pieces = [(piece[0], piece[-1] + 1) for piece in np.split(blocks, cuts) if len(piece)]
        for k in range(0, len(pieces), _MOST_PIECES):
            ends = _BLOCK_BYTES * np.array(pieces[k : k + _MOST_PIECES])
            firsts, lasts = np.minimum(ends, self._num_bytes).T.tolist()
            with self._lock, _naming_errors(self._url):
                found = self._there.cat_ranges([self._place] * len(firsts), firsts, lasts)
                for first, last, data in zip(firsts, lasts, found, strict=True):
                    if isinstance(data, Exception):
                        raise data
                    if len(data) == self._num_bytes:  # its server knows no parts
                        first, last = 0, self._num_bytes
                    got = f"{len(data)}; it has changed, open it again"
                    check(self._url, len(data) == last - first, f"{last - first} bytes at {first}, got {got}")
                    _files.write_at(self.file.fileno(), data, first)
                    self._is_here[first // _BLOCK_BYTES : -(-last // _BLOCK_BYTES)] = True
