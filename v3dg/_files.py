"""Files that are complete or not there, and the first step of reading files of strangers."""

from __future__ import annotations

import contextlib
import errno
import hashlib
import os
import secrets
import stat
from collections.abc import Iterator
from pathlib import Path

_PIECE_BYTES = 16 << 20


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str], *, is_locked: bool = False) -> Iterator[str]:
    """Give a name beside `path` to write to; at the end it replaces `path`, on failure it is removed.

    What is written is on the disk before it gets its name. A link stays a link, to the new file. Where the
    caller sees to it that no other writes to `path` meanwhile, the name is always the same, and what a killed
    program left there is removed.

    Raises:
        IsADirectoryError: `path` is a folder.
        ValueError: `path` is a device or a pipe.
        OSError: As writing raised it, with `path` for the file's name.
    """
    target = os.path.realpath(path)
    if os.path.isdir(target):
        raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), os.fspath(path))
    if os.path.exists(target) and not os.path.isfile(target):
        raise ValueError(f"{os.fspath(path)}: expected the path of a file, got a device or a pipe")
    folder, name = os.path.split(target)
    own = hashlib.blake2b(os.fsencode(os.path.abspath(path)), digest_size=8).hexdigest()
    # The start of the name only: a name may have 255 bytes, and a character up to four.
    temporary = os.path.join(folder, f".{name[:40]}.{own if is_locked else secrets.token_hex(8)}.tmp")
    with naming_errors(path, temporary):
        if is_locked:
            with contextlib.suppress(FileNotFoundError):
                os.unlink(temporary)
        try:
            yield temporary
            _flush(temporary)
            os.replace(temporary, target)
        except BaseException:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                os.unlink(temporary)
            raise


@contextlib.contextmanager
def naming_errors(path: str | os.PathLike[str], other_name: str | None = None) -> Iterator[None]:
    """Give the system's errors the name of the file: those of an open file have none, or its other name."""
    try:
        yield
    except OSError as error:
        if error.errno is None or error.filename not in (None, other_name):
            raise
        raise OSError(error.errno, os.strerror(error.errno), os.fspath(path)) from error


def _flush(path: str) -> None:
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def write_at(descriptor: int, data: bytes | bytearray | memoryview, offset: int) -> None:
    """Write all of the data to one place of a file; signals are heard now and then."""
    view = memoryview(data)
    while view:
        count = os.pwrite(descriptor, view[:_PIECE_BYTES], offset)
        view, offset = view[count:], offset + count


def check_folder(path: Path) -> None:
    """Refuse a place to write to whose folder is not there.

    Raises:
        ValueError: It is not there.
    """
    if not path.parent.is_dir():
        raise ValueError(f"{path}: expected an existing folder, got {path.parent}; create it first")


def open_regular(path: str | os.PathLike[str]) -> int:
    """Open a file for reading and return its descriptor.

    Raises:
        ValueError: It is a directory, a device or a pipe; nothing was waited for.
        OSError: It cannot be opened (FileNotFoundError, PermissionError, ...).
    """
    # O_NONBLOCK: opening a pipe must not wait for a writer; regular files ignore it.
    descriptor = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{os.fspath(path)}: expected a file, got a directory or a device")
    return descriptor
