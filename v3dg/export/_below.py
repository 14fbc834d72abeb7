"""Access to files below a folder by relative names, without following links."""

import errno
import os
import stat
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path

_FOLDER = os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC
# With O_NONBLOCK, opening a pipe does not wait for a writer. The flag has no effect on
# regular files.
_FILE = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK


def folders_above(name: str) -> list[str]:
    """Return the folders in a relative name, from the outermost to the innermost."""
    parts = name.split("/")[:-1]
    return ["/".join(parts[: count + 1]) for count in range(len(parts))]


class Folder(AbstractContextManager["Folder"]):
    """An open folder. All names are relative to this folder and use `/` as separator.
    No link is followed.

    If a folder in a name is a link or a file, OSError is raised. Errors contain
    `display_path` instead of the real path.
    """

    def __init__(self, path: Path, display_path: Path) -> None:
        self._display_path = display_path
        self.descriptor = os.open(path, _FOLDER)

    def __exit__(self, *_: object) -> None:
        os.close(self.descriptor)

    @contextmanager
    def _folder_of(self, name: str) -> Iterator[tuple[int, str]]:
        """Yield a descriptor of the folder that contains a file or folder, and the last
        part of the name."""
        *folders, last = name.split("/")
        descriptor = os.dup(self.descriptor)
        try:
            for folder in folders:
                subfolder = os.open(folder, _FOLDER | os.O_NOFOLLOW, dir_fd=descriptor)
                os.close(descriptor)
                descriptor = subfolder
            yield descriptor, last
        except OSError as error:
            if error.errno is None:
                raise
            path = os.fspath(self._display_path / name)
            raise OSError(error.errno, os.strerror(error.errno), path) from error
        finally:
            os.close(descriptor)

    def status(self, name: str) -> os.stat_result | None:
        """Return the status of a file, a folder or a link; None if the name does not
        exist."""
        try:
            with self._folder_of(name) as (folder, last):
                return os.stat(last, dir_fd=folder, follow_symlinks=False)
        except FileNotFoundError:
            return None

    def open_file(self, name: str) -> int:
        """Open a file for reading and return its descriptor; raise OSError for a link,
        and ValueError for a folder or a device."""
        with self._folder_of(name) as (folder, last):
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
        """Rename a file, creating the folders of its new name; raise FileExistsError if
        the new name exists."""
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
        """Remove an empty folder; do nothing if it is missing or not empty."""
        with suppress(OSError), self._folder_of(name) as (folder, last):
            os.rmdir(last, dir_fd=folder)
