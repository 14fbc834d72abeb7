"""Files at URLs: each is fetched once, by fsspec, into a folder that goes when the process ends."""

import atexit
import os
import re
import shutil
import tempfile
from pathlib import Path
from urllib.parse import unquote, urlsplit

from v3dg import _extras
from v3dg._numbers import check

# A `Path` of a URL has one slash where there were two.
_URL = re.compile(r"([A-Za-z][A-Za-z0-9+.-]+):/+(?=.)")
_fetched: dict[str, str] = {}


def is_url(path: str | os.PathLike[str]) -> bool:
    """Whether this is the name of a file elsewhere: a file of that name here comes first."""
    return bool(_URL.match(os.fspath(path))) and not os.path.lexists(path)


def beside(path: str | os.PathLike[str]) -> Path:
    """The file; in place of one at a URL, that of its name in the working folder."""
    return Path(os.path.basename(unquote(urlsplit(os.fspath(path)).path)) if is_url(path) else path)


def is_fetched(path: str) -> bool:
    """Whether a file goes when the process ends."""
    return path in _fetched.values()


def local(path: str | os.PathLike[str]) -> str | os.PathLike[str]:
    """A file that is here: the one of that name, or what is fetched from a URL.

    Raises:
        ImportError: The extra `fsspec` is not installed, or what it needs for such URLs.
        ValueError: It is a URL of no file, or of one that names others, which are not fetched.
        OSError: It cannot be fetched.
    """
    if not is_url(path):
        return path
    url = _URL.sub(lambda found: found[1] + ("://" if found[1] != "file" else ":///"), os.fspath(path))
    name = beside(path).name
    expected = "the URL of a bundle, or of an asset in one file"
    check(url, name and not name.endswith(".json"), f"{expected}, got one of a file that names others")
    if url not in _fetched:
        fsspec, folder = _extras.load("fsspec"), tempfile.mkdtemp(prefix="v3dg_")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        target = os.path.join(folder, name)
        try:
            fsspec.open(url).fs.get_file(url, target)
        except (ImportError, ValueError):
            raise
        except Exception as error:  # of whichever package knows such URLs
            raise OSError(f"{url}: expected a file, got {type(error).__name__}: {error}") from error
        _fetched[url] = target
    return _fetched[url]
