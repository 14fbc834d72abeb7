"""Writing files that are either complete or absent, safe access to untrusted files, and
locks.

Windows lacks much of POSIX: reads at offsets, permissions, open folders, and moving a
file that is open. All code that depends on the system is in this module and in
`_system`.
"""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import stat
import tempfile
import threading
from collections.abc import Iterator
from io import FileIO
from pathlib import Path

import numpy as np
import numpy.typing as npt

from v3dg._numbers import check

try:
    import fcntl
except ImportError:
    fcntl = None  # type: ignore[assignment]

_PIECE_BYTES = 16 << 20
_MASK_LOCK = threading.Lock()
_POSITION_LOCK = threading.Lock()
# The offset of the byte that a lock on Windows covers. Other processes cannot read a
# locked byte, so it is beyond any content, but below the largest offset of file
# systems.
_LOCKED_BYTE = 1 << 43

PLAIN = getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
"""Flags of every `os.open`. With them, child processes do not inherit the file, and
Windows does not convert line ends."""

NO_LINK = getattr(os, "O_NOFOLLOW", 0)
"""Flag of `os.open`: fail for a symbolic link.

Windows has no such flag and follows the link.
"""

NO_WAIT = getattr(os, "O_NONBLOCK", 0)
"""Flag of `os.open`: opening a pipe does not wait for its other end. For regular files,
the flag has no effect."""

OPEN_SAFELY = NO_LINK | NO_WAIT | PLAIN

HAS_FOLDER_DESCRIPTORS = os.open in os.supports_dir_fd and hasattr(os, "O_DIRECTORY")
"""Whether the system can open folders, and can find files relative to an open
folder."""

_FLUSHED_MODE = "rb"
if fcntl is None:
    _FLUSHED_MODE = "r+b"

_NEW_FILE = os.O_WRONLY | os.O_CREAT | os.O_EXCL | PLAIN


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[str]:
    """Yield the name of an empty file next to `path`. At the end, the file replaces
    `path`; after an error, it is removed.

    The content is on the disk before the file gets its final name. The file gets the
    permissions of the file that it replaces and, if the system allows it, the owner and
    group. If `path` is a link, its target is replaced. A link at the temporary name is
    not followed.

    Raises:
        IsADirectoryError: `path` is a folder.
        PermissionError: Writing to `path` is not permitted.
        ValueError: `path` is a device or a pipe.
        OSError: Writing failed; the error names `path`.
    """
    # This raises for integers, which open() would accept as file descriptors.
    path = os.fspath(path)
    status_of_replaced(path)
    folder, name = os.path.split(os.path.realpath(path))
    # The temporary name contains at most 40 characters of the name, because names are
    # limited to 255 bytes, and a character has up to four bytes.
    temporary = os.path.join(folder, f".{name[:40]}.{secrets.token_hex(8)}.tmp")
    with naming_errors(path, temporary):
        # Only this user may read the file, until it gets the permissions of the file
        # that it replaces.
        os.close(os.open(temporary, _NEW_FILE, 0o600))
        try:
            yield temporary
            put_in_place(temporary, path)
        except BaseException:
            with contextlib.suppress(FileNotFoundError, NotADirectoryError):
                os.unlink(temporary)
            raise


def put_in_place(private: str | os.PathLike[str], path: str | os.PathLike[str]) -> None:
    """Flush a private file to the disk, and move it to `path`. It gets the permissions
    of the file that it replaces."""
    replaced = status_of_replaced(path)
    with naming_errors(path, os.fspath(private)):
        # Windows only flushes files that are open for writing.
        with open(private, _FLUSHED_MODE) as file:
            if hasattr(os, "fchown"):
                _set_permissions(file.fileno(), replaced)
            os.fsync(file.fileno())
        os.replace(private, os.path.realpath(path))


def _set_permissions(descriptor: int, replaced: os.stat_result | None) -> None:
    """Set the permissions, owner and group of a file to those of the file that it
    replaces. Without one, set the permissions of a new file."""
    if replaced is None:
        os.fchmod(descriptor, 0o666 & ~file_mode_mask())
        return
    with contextlib.suppress(OSError):
        os.fchown(descriptor, -1, replaced.st_gid)
    with contextlib.suppress(OSError):
        os.fchown(descriptor, replaced.st_uid, -1)
    os.fchmod(descriptor, stat.S_IMODE(replaced.st_mode) & 0o777)


def file_mode_mask(status_path: str = "/proc/self/status") -> int:
    """Return the umask: the permission bits that this process removes from new
    files."""
    with contextlib.suppress(OSError):
        status = Path(status_path).read_text(encoding="ascii", errors="replace")
        match = re.search(r"^Umask:\s*([0-7]+)$", status, re.MULTILINE)
        if match:
            return int(match[1], 8)
    # Without /proc, the umask can only be read by setting it. Files that other threads
    # create at that moment are private.
    with _MASK_LOCK:
        mask = os.umask(0o077)
        os.umask(mask)
    return mask


def status_of_replaced(path: str | os.PathLike[str]) -> os.stat_result | None:
    """Return the status of the file that will be replaced, or None if it does not
    exist. Raise the errors of `replacing`."""
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
    # Renaming only checks the permissions of the folder. Opening the file checks those
    # of the file itself.
    os.close(os.open(path, os.O_WRONLY | PLAIN))
    return status


@contextlib.contextmanager
def naming_errors(path: str | os.PathLike[str], other_name: str | None = None) -> Iterator[None]:
    """Add `path` to system errors that have no file name, or that have `other_name`."""
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
        count = _write_some(descriptor, view[:_PIECE_BYTES], offset)
        view = view[count:]
        offset += count


def start_flush(descriptor: int, offset: int, num_bytes: int) -> None:
    """Make the system start writing a part of a file to the disk, without waiting.

    Otherwise, Linux starts only when much data is waiting, and the flush at the end
    takes long.
    """
    # On Linux, this call also drops cached data that is already on the disk. New data
    # is not on the disk yet, so it stays in the cache.
    if hasattr(os, "posix_fadvise"):
        os.posix_fadvise(descriptor, offset, num_bytes, os.POSIX_FADV_DONTNEED)


def read_at(descriptor: int, out: npt.NDArray[np.generic], offset: int) -> bool:
    """Fill an array with the bytes of a file at an offset. Return False if the file is
    too short."""
    view = out.reshape(-1).view(np.uint8).data
    while view:
        count = _read_some(descriptor, view[:_PIECE_BYTES], offset)
        if count == 0:
            return False
        view = view[count:]
        offset += count
    return True


def read_bytes_at(descriptor: int, num_bytes: int, offset: int) -> bytes:
    """Return up to `num_bytes` bytes of a file at an offset.

    There are fewer at the end of the file.
    """
    out = bytearray(num_bytes)
    count = _read_some(descriptor, memoryview(out), offset)
    return bytes(out[:count])


def _read_some(descriptor: int, out: memoryview, offset: int) -> int:
    if hasattr(os, "preadv"):
        return os.preadv(descriptor, [out], offset)
    # Reading moves the position of the open file, so only one thread may do it.
    with _POSITION_LOCK:
        os.lseek(descriptor, offset, os.SEEK_SET)
        data = os.read(descriptor, len(out))
    out[: len(data)] = data
    return len(data)


def _write_some(descriptor: int, data: memoryview, offset: int) -> int:
    if hasattr(os, "pwrite"):
        return os.pwrite(descriptor, data, offset)
    with _POSITION_LOCK:
        os.lseek(descriptor, offset, os.SEEK_SET)
        return os.write(descriptor, data)


def lock(descriptor: int, path: str | os.PathLike[str], work: str = "build") -> None:
    """Lock an open file against other processes that do the same work, until it is
    closed."""
    busy = f"{os.fspath(path)}: another {work} is using it; wait for it, or write to another place"
    if fcntl is None:
        import msvcrt

        with _POSITION_LOCK:
            os.lseek(descriptor, _LOCKED_BYTE, os.SEEK_SET)
            try:
                msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1)
            except OSError:
                raise RuntimeError(busy) from None
        return
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise RuntimeError(busy) from None
    except OSError as error:
        # Some network file systems do not support locks. Users must not start two
        # builds with the same output there.
        if error.errno not in (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP):
            raise


@contextlib.contextmanager
def locked_folder(
    folder: Path, path: str | os.PathLike[str], work: str = "build"
) -> Iterator[None]:
    """Lock a folder against other processes that do the same work. Errors name `path`.

    Where folders cannot be opened, the lock is a file in the system's folder for
    temporary files. It only excludes other processes of the same user.
    """
    if HAS_FOLDER_DESCRIPTORS:
        descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | NO_LINK | PLAIN)
    else:
        name = os.path.normcase(os.path.realpath(folder))
        digest = hashlib.blake2b(name.encode("utf-8", "surrogatepass"), digest_size=16).hexdigest()
        lock_path = os.path.join(tempfile.gettempdir(), f"v3dg-{digest}.lock")
        descriptor = os.open(lock_path, os.O_RDWR | os.O_CREAT | PLAIN, 0o600)
    try:
        lock(descriptor, path, work)
        yield
    finally:
        os.close(descriptor)


def close_to_move(file: FileIO) -> None:
    """Close a file that is moved or removed next, on systems that cannot move open
    files. This also unlocks the file."""
    if fcntl is None:
        file.close()


def make_folder(path: str | os.PathLike[str]) -> None:
    """Create the folder of an output file, and the folders above it, if they do not
    exist.

    Raises:
        OSError: The folder cannot be created. It is NotADirectoryError if a part of the
            path is a file.
    """
    folder = Path(path).parent
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileExistsError:
        raise NotADirectoryError(
            errno.ENOTDIR, os.strerror(errno.ENOTDIR), os.fspath(folder)
        ) from None


def check_bundle_name(path: str | os.PathLike[str]) -> None:
    """Raise ValueError for a file name that `v3dg.open` would not recognise as the name
    of a bundle."""
    check(
        path,
        Path(path).suffix == ".v3dg",
        "a file name ending in .v3dg, by which v3dg.open recognises bundles",
    )


def open_regular(path: str | os.PathLike[str]) -> int:
    """Open a file for reading, and return its descriptor. Raise ValueError for a
    directory, a device or a pipe."""
    descriptor = os.open(path, os.O_RDONLY | NO_WAIT | PLAIN)
    if not stat.S_ISREG(os.fstat(descriptor).st_mode):
        os.close(descriptor)
        raise ValueError(f"{os.fspath(path)}: expected a file, got a directory, a device or a pipe")
    return descriptor
