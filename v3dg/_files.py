"""Writing files that are either complete or absent, and safe access to untrusted
files."""

import contextlib
import errno
import os
import re
import secrets
import stat
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v3dg._numbers import check

_PIECE_BYTES = 16 << 20
_MASK_LOCK = threading.Lock()
_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[str]:
    """Yield the name of an empty file beside `path`. The file replaces `path` at the
    end, or is removed on failure.

    The content is on the disk before the file gets its final name. The file gets the
    permissions of the file that it replaces, and the owner and group if the system
    allows it. If `path` is a link, it stays a link and its target is replaced; a link
    at the temporary name is not followed.

    Raises:
        IsADirectoryError: `path` is a folder.
        PermissionError: Writing to `path` is not permitted.
        ValueError: `path` is a device or a pipe.
        OSError: Writing failed; the error names `path`.
    """
    # Raises for integers, which open() would accept as file descriptors.
    path = os.fspath(path)
    status_of_replaced(path)
    folder, name = os.path.split(os.path.realpath(path))
    # The temporary name contains at most 40 characters of the name: names are limited
    # to 255 bytes, and a character has up to four bytes.
    temporary = os.path.join(folder, f".{name[:40]}.{secrets.token_hex(8)}.tmp")
    with naming_errors(path, temporary):
        # The file is private until it gets the permissions of the file that it
        # replaces.
        os.close(os.open(temporary, _NEW_FILE, 0o600))
        try:
            yield temporary
            put_in_place(temporary, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                os.unlink(temporary)
            raise


def put_in_place(private: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Flush a private file to the disk and move it to `path`, with the permissions of
    the replaced file."""
    replaced = status_of_replaced(path)
    with naming_errors(path, os.fspath(private)):
        with open(private, "rb") as file:
            descriptor = file.fileno()
            if replaced is None:
                os.fchmod(descriptor, 0o666 & ~file_mode_mask())
            else:
                with contextlib.suppress(OSError):
                    os.fchown(descriptor, -1, replaced.st_gid)
                with contextlib.suppress(OSError):
                    os.fchown(descriptor, replaced.st_uid, -1)
                os.fchmod(descriptor, stat.S_IMODE(replaced.st_mode) & 0o777)
            os.fsync(descriptor)
        os.replace(private, os.path.realpath(path))


def file_mode_mask(status_path: str = "/proc/self/status") -> int:
    """Return the umask: the permission bits that this process removes from new
    files."""
    with contextlib.suppress(OSError):
        status = Path(status_path).read_text(encoding="ascii", errors="replace")
        match = re.search(r"^Umask:\s*([0-7]+)$", status, re.MULTILINE)
        if match:
            return int(match[1], 8)
    # Without /proc, the umask can be read only by setting it. Files that other threads
    # create at that moment are private.
    with _MASK_LOCK:
        mask = os.umask(0o077)
        os.umask(mask)
    return mask


def status_of_replaced(path: str | os.PathLike[str]) -> os.stat_result | None:
    """Return the status of the file that will be replaced; None if it does not exist.
    Raises the errors of `replacing`."""
    try:
        status = os.stat(path)
    except FileNotFoundError:
        return None
    if stat.S_ISDIR(status.st_mode):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    check(
        path,
        stat.S_ISREG(status.st_mode),
        "the path of a file, got a device or a pipe; choose another path",
    )
    # Renaming checks only the permissions of the folder. Opening the file checks the
    # permissions of the file itself.
    os.close(os.open(path, os.O_WRONLY | os.O_CLOEXEC))
    return status


@contextlib.contextmanager
def naming_errors(path: str | os.PathLike[str], other_name: str | None = None) -> Iterator[None]:
    """Add `path` to system errors that contain no file name, or contain
    `other_name`."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, other_name):
            raise
        raise OSError(error.errno, os.strerror(error.errno), os.fspath(path)) from error


@contextlib.contextmanager
def value_errors(path: str | os.PathLike[str], expected: str) -> Iterator[None]:
    """Convert every exception to ValueError, because libraries do not document what
    they raise for damaged content."""
    try:
        yield
    except MemoryError:
        raise
    except Exception as error:
        text = " ".join(str(error).split()) or type(error).__name__
        raise ValueError(
            f"{os.fspath(path)}: expected {expected}, got {ascii(text[:200])[1:-1]}"
        ) from None


def write_at(descriptor: int, data: bytes | bytearray | memoryview, offset: int) -> None:
    """Write all data to a file at an offset. The data is written in pieces, so that
    signals are handled in between."""
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view[:_PIECE_BYTES], offset)
        view = view[count:]
        offset += count


def read_at(descriptor: int, out: npt.NDArray[np.generic], offset: int) -> bool:
    """Fill an array with the bytes of a file at an offset; return False if the file is
    too short."""
    view = out.reshape(-1).view(np.uint8).data
    while view:
        count = os.preadv(descriptor, [view[:_PIECE_BYTES]], offset)
        if count == 0:
            return False
        view = view[count:]
        offset += count
    return True


def make_folder(path: str | os.PathLike[str]) -> None:
    """Create the folder of an output file and the folders above it, if they do not
    exist.

    Raises:
        OSError: The folder cannot be created. NotADirectoryError: part of the path is a
            file.
    """
    folder = Path(path).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(
            errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(folder)
        ) from None


def check_bundle_name(path: str | os.PathLike[str]) -> None:
    """Raise ValueError for a file name that `v3dg.open` would not recognise as that of
    a bundle."""
    check(
        path,
        Path(path).suffix == ".v3dg",
        "a file name ending in .v3dg, by which v3dg.open recognises bundles",
    )


def open_regular(path: str | os.PathLike[str]) -> int:
    """Open a file for reading and return its descriptor; raise ValueError for a
    directory, a device or a pipe."""
    # With O_NONBLOCK, opening a pipe does not wait for a writer. The flag has no effect
    # on regular files.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{os.fspath(path)}: expected a file, got a directory, a device or a pipe")
    return descriptor
