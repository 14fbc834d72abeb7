"""Files that are complete or not there, and the first step of reading files of strangers."""

import contextlib
import errno
import os
import re
import secrets
import stat
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg._numbers import check

_PIECE_BYTES = 16 << 20
_MASK_LOCK = threading.Lock()
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[str]:
    """Give an empty file beside `path` to write to; at the end it replaces `path`, on failure it is removed.

    What is written is on the disk before it gets its name, and has the permissions of what it replaces, and
    the owner and group where the system allows it. A link at `path` stays a link, to the new file; at the
    name beside it, none is followed.

    A folder is an IsADirectoryError, what may not be written to a PermissionError, a device or a pipe a
    ValueError; an OSError of writing has `path` for the file's name.
    """
    path = os.fspath(path)  # a number would stand for an open file
    status_of_replaced(path)
    folder, name = os.path.split(os.path.realpath(path))
    # The start of the name only: a name may have 255 bytes, and a character up to four.
    temporary = os.path.join(folder, f".{name[:40]}.{secrets.token_hex(8)}.tmp")
    with naming_errors(path, temporary):
        # Nobody may read what replaces a private file before it has the permissions of that.
        os.close(os.open(temporary, _NEW_FILE, 0o600))
        try:
            yield temporary
            put_in_place(temporary, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                os.unlink(temporary)
            raise


def put_in_place(private: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Bring a file that only its owner may read to the disk and to `path`, with what is permitted there."""
    replaced = status_of_replaced(path)
    with naming_errors(path, os.fspath(private)):
        with open(private, "rb") as file:
            descriptor = file.fileno()
            if replaced is None:
                os.fchmod(descriptor, 0o666 & ~file_mode_mask())
            else:
                for owner, group in ((-1, replaced.st_gid), (replaced.st_uid, -1)):
                    with contextlib.suppress(OSError):
                        os.fchown(descriptor, owner, group)
                os.fchmod(descriptor, stat.S_IMODE(replaced.st_mode) & 0o777)
            os.fsync(descriptor)
        os.replace(private, os.path.realpath(path))


def file_mode_mask(status_path: str = "/proc/self/status") -> int:
    """The permissions that new files of this process do not get (umask)."""
    with contextlib.suppress(OSError):
        status = Path(status_path).read_text(encoding="ascii", errors="replace")
        if found := re.search(r"^Umask:\s*([0-7]+)$", status, re.MULTILINE):
            return int(found[1], 8)
    # Without /proc it can be read by setting it alone. What another thread makes meanwhile is private.
    with _MASK_LOCK:
        mask = os.umask(0o077)
        os.umask(mask)
    return mask


def status_of_replaced(path: str | os.PathLike[str]) -> os.stat_result | None:
    """Of what is to be replaced, if there is something and it may be; errors as `replacing`."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    check(path, stat.S_ISREG(status.st_mode), "the path of a file, got a device or a pipe")
    # Renaming asks the folder alone; that the file itself may be written to, opening it finds out.
    os.close(os.open(path, os.O_WRONLY | os.O_CLOEXEC))
    return status


@contextlib.contextmanager
def naming_errors(path: str | os.PathLike[str], other_name: str | None = None) -> Iterator[None]:
    """Give the system's errors the name of the file: those of an open file have none, or its other name."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, other_name):
            raise
        raise OSError(error.errno, os.strerror(error.errno), os.fspath(path)) from error


@contextlib.contextmanager
def telling(path: str | os.PathLike[str], expected: str) -> Iterator[None]:
    """Turn all that a library raises for damaged content, which none documents, into one error."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(f"{os.fspath(path)}: expected {expected}, got {ascii(text[:200])[1:-1]}") from None


def write_at(descriptor: int, data: bytes | bytearray | memoryview, offset: int) -> None:
    """Write all of the data to one place of a file; signals are heard now and then."""
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view[:_PIECE_BYTES], offset)
        view, offset = view[count:], offset + count


def read_at(descriptor: int, out: npt.NDArray[Any], offset: int) -> bool:
    """Fill an array with the bytes at one place of a file; False where the file ends before."""
    view = out.reshape(-1).view(np.uint8).data
    while view:
        count = os.preadv(descriptor, [view[:_PIECE_BYTES]], offset)
        if count == 0:
            return False
        view, offset = view[count:], offset + count
    return True


def check_folder(path: Path) -> None:
    """Refuse, with ValueError, a place to write to whose folder is not there."""
    check(path, path.parent.is_dir(), f"an existing folder, got {path.parent}; create it first")


def check_bundle_name(path: str | os.PathLike[str]) -> None:
    """Refuse, with ValueError, a name by which `v3dg.open` would not know a bundle."""
    check(path, Path(path).suffix == ".v3dg", "a file name ending in .v3dg; v3dg.open goes by it")


def open_regular(path: str | os.PathLike[str]) -> int:
    """A descriptor of a file to read; a directory, a device or a pipe is a ValueError, without waiting."""
    # O_NONBLOCK: opening a pipe must not wait for a writer; regular files ignore it.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{os.fspath(path)}: expected a file, got a directory or a device")
    return descriptor
