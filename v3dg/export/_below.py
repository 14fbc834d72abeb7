"""Access to files below a folder by relative names, without following links."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

from v3dg import _files

_FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | _files.PLAIN
_FILE = os.O_RDONLY | _files.OPEN_SAFELY


def folders_above(name: str) -> list[str]:
    """Return the folders in a relative name, from the outermost to the innermost."""
    parts = name.split("/")[:-1]
    return ["/".join(parts[: count + 1]) for count in range(len(parts))]


@contextmanager
def _opened_below(descriptor: int, folders: list[str]) -> Iterator[int]:
    """Yield a descriptor of a folder below an open one.

    The folders on the way are opened one by one.
    """
    inner = os.dup(descriptor)
    try:
        for folder in folders:
            subfolder = os.open(folder, _FOLDER | _files.NO_LINK, dir_fd=inner)
            os.close(inner)
            inner = subfolder
        yield inner
    finally:
        os.close(inner)


class Folder(AbstractContextManager["Folder"]):
    """An open folder. All names are relative to this folder and use `/` as separator.
    No link is followed. If the system cannot open folders, links are refused when a
    name is used; this does not protect from programs that replace a folder in between.

    If a folder in a name is a link or a file, OSError is raised. Errors contain
    `display_path` instead of the real path.
    """

    def __init__(self, path: Path, display_path: Path) -> None:
        self._path = path
        self._display_path = display_path
        self._descriptor: int | None = None
        if _files.HAS_FOLDER_DESCRIPTORS:
            self._descriptor = os.open(path, _FOLDER)

    def __exit__(self, *_: object) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)

    @contextmanager
    def _folder_of(self, name: str) -> Iterator[tuple[int | None, str]]:
        """Yield a descriptor of the folder that contains a file or folder, and the last
        part of the name. Without descriptors of folders, yield None and the whole
        path."""
        *folders, last = name.split("/")
        try:
            if self._descriptor is None:
                yield None, os.path.join(self._checked_folder(folders), last)
            else:
                with _opened_below(self._descriptor, folders) as descriptor:
                    yield descriptor, last
        except OSError as error:
            if error.errno is None:
                raise
            path = os.fspath(self._display_path / name)
            raise OSError(error.errno, os.strerror(error.errno), path) from error

    def _checked_folder(self, folders: list[str]) -> Path:
        path = self._path
        for folder in folders:
            path = path / folder
            if not stat.S_ISDIR(os.lstat(path).st_mode):
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR))
        return path

    def names(self) -> list[str]:
        """Return the names of all files and folders in this folder."""
        if self._descriptor is None:
            return os.listdir(self._path)
        return os.listdir(self._descriptor)

    def make_private_folder(self, name: str) -> None:
        """Create a folder that other users cannot read. Raise FileExistsError if the
        name exists."""
        with self._folder_of(name) as (folder, last):
            os.mkdir(last, 0o700, dir_fd=folder)

    def status(self, name: str) -> os.stat_result | None:
        """Return the status of a file, a folder or a link. Return None if the name does
        not exist."""
        try:
            with self._folder_of(name) as (folder, last):
                return os.stat(last, dir_fd=folder, follow_symlinks=False)
        except FileNotFoundError:
            return None

    def open_file(self, name: str) -> int:
        """Open a file for reading, and return its descriptor. Raise OSError for a link,
        and ValueError for a folder or a device."""
        with self._folder_of(name) as (folder, last):
            if folder is None and os.path.islink(last):
                raise OSError(errno.ELOOP, os.strerror(errno.ELOOP))
            descriptor = os.open(last, _FILE, dir_fd=folder)
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise ValueError(
                f"{self._display_path / name}: expected a file, got a folder or a device"
            )
        return descriptor

    def make_folder(self, name: str) -> None:
        """Create a folder, unless the name already exists."""
        with self._folder_of(name) as (folder, last), suppress(FileExistsError):
            os.mkdir(last, dir_fd=folder)

    def move(self, source: str, target: str) -> None:
        """Rename a file, and create the folders of its new name. Raise FileExistsError
        if the new name exists."""
        for parent in folders_above(target):
            self.make_folder(parent)
        with (
            self._folder_of(source) as (folder, last),
            self._folder_of(target) as (new_folder, new_last),
        ):
            with suppress(FileNotFoundError):
                os.stat(new_last, dir_fd=new_folder, follow_symlinks=False)
                raise FileExistsError(errno.EEXIST, os.strerror(errno.EEXIST), target)
            os.rename(last, new_last, src_dir_fd=folder, dst_dir_fd=new_folder)

    def remove_file(self, name: str) -> None:
        with self._folder_of(name) as (folder, last):
            os.unlink(last, dir_fd=folder)

    def remove_empty_folder(self, name: str) -> None:
        """Remove an empty folder. Do nothing if it is missing or not empty."""
        with suppress(OSError), self._folder_of(name) as (folder, last):
            os.rmdir(last, dir_fd=folder)
