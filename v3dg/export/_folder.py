"""Replaces the files of an earlier export in a folder, and changes nothing else in it.

New files are written to `new` in a hidden subfolder, so that all moves stay inside one
file system. When they are complete, their record is written next to `new`. Then the
files that they replace are moved to `old`, and the new files are moved into place.
Moving the record completes the export. Until then, everything can be moved back. This
is done immediately after an error, or by the next export if the process was killed.
"""

import contextlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from v3dg import _files
from v3dg._numbers import check
from v3dg._urls import is_url
from v3dg.export._below import Folder, folders_above
from v3dg.export._record import (
    RECORD,
    Record,
    Stamp,
    folders_of,
    is_file,
    read_record,
    stamp_of_content,
    stamp_of_status,
)
from v3dg.scene import Scene

_HIDDEN = re.compile(r"\.v3dg-export\.[0-9a-f]{16}\.tmp")


@dataclass(frozen=True)
class NewFiles:
    """The folder for the files of a new export.

    Attributes:
        path: A folder for the new files. At the end, they are moved into place.
        earlier: Names of files of an earlier export that are unchanged. They are
            replaced or removed at the end; all other files are kept.
    """

    path: Path
    earlier: Collection[str]


def check_outside(folder: Path, inputs: Iterable[str | os.PathLike[str] | None]) -> None:
    """Raise ValueError if a folder contains an input of the export."""
    if not folder.is_dir():
        return
    status = folder.stat()
    for path in inputs:
        if path is None or is_url(path):
            continue
        parents = [parent for parent in Path(os.path.realpath(path)).parents if parent.exists()]
        if any(os.path.samestat(parent.stat(), status) for parent in parents):
            raise ValueError(
                f"{folder}: contains the input {os.fspath(path)}; choose another folder"
            )


@contextlib.contextmanager
def replacing_export(
    folder: Path, scene: Scene, certain: Iterable[str] = (), *, overwrite: bool = False
) -> Iterator[NewFiles]:
    """Yield a folder for the new files. At the end, they replace the files of an
    earlier export.

    The folder itself is kept, with its permissions. After an error, its content is as
    before; if the folder did not exist, it is removed.

    Args:
        folder: The folder to write. If it is a link to a folder, the link is kept.
        scene: The exported scene, whose files must not be in the folder.
        certain: Names of files that will be written in any case. Whether they may be
            replaced is checked at the beginning.
        overwrite: Whether files with the same names may be replaced even if they are
            not from an earlier export. All other files are kept in any case.

    Raises:
        ValueError: An input is in the folder, ``folder`` is not a folder, a file must
            not be replaced, or the record of the earlier export is invalid.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.
    """
    is_free = folder.is_dir() or not os.path.lexists(os.path.realpath(folder))
    check(
        folder,
        is_free,
        "a new folder or one with an earlier export, got a file; choose another name",
    )
    check_outside(folder, (bundle.path for bundle in scene.bundles))
    with (
        _made(folder) as target,
        _naming_errors(folder, target),
        _files.locked_folder(target, folder, "export"),
        Folder(target, folder) as root,
    ):
        place = _Place(folder, target, root, overwrite=overwrite)
        place.check(certain)
        try:
            root.make_private_folder(place.hidden)
            root.make_folder(f"{place.hidden}/new")
            path = target / place.hidden / "new"
            yield NewFiles(path, place.earlier.keys())
            place.put(Record.of_files_below(path), path.parent / RECORD)
        finally:
            _restore_and_remove(root, place.hidden, target)


def _restore_and_remove(root: Folder, hidden: str, folder: Path) -> None:
    """Move the files of an export that did not finish back, and remove its hidden
    folder."""
    # Errors of moving files back are ignored, because the error of the export is
    # reported.
    with contextlib.suppress(OSError, ValueError):
        if _restore(root, hidden, folder):
            _remove_unused_folders(root, hidden, folder)
            try:
                shutil.rmtree(folder / hidden, ignore_errors=True)
            except KeyboardInterrupt:
                shutil.rmtree(folder / hidden, ignore_errors=True)
                raise


@contextlib.contextmanager
def _made(folder: Path) -> Iterator[Path]:
    """Create a folder and the folders above it, and yield its path without links. After
    an error, remove the created folders if they are empty."""
    target = Path(os.path.realpath(folder))
    # The missing folders, from the innermost outwards.
    missing = [path for path in (target, *target.parents) if not path.exists()]
    try:
        target.mkdir(parents=True, exist_ok=True)
        yield target
    except BaseException:
        for path in missing:
            # If another program has written to a folder, it is not empty and is kept.
            with contextlib.suppress(OSError):
                path.rmdir()
        raise


@contextlib.contextmanager
def _naming_errors(folder: Path, target: Path) -> Iterator[None]:
    """In system errors, replace paths in the hidden folder by their final paths."""
    try:
        yield
    except OSError as error:
        name = error.filename
        if (
            error.errno is None
            or not isinstance(name, str)
            or not Path(name).is_relative_to(target)
        ):
            raise
        parts = Path(name).relative_to(target).parts
        if parts and _HIDDEN.fullmatch(parts[0]):
            parts = parts[2:]
        raise OSError(
            error.errno, os.strerror(error.errno), os.fspath(folder.joinpath(*parts))
        ) from error


class _Place:
    """The folder of an export, with the record of an earlier export in it."""

    def __init__(self, folder: Path, target: Path, root: Folder, *, overwrite: bool) -> None:
        self._folder = folder
        self._root = root
        self._overwrite = overwrite
        self.hidden = f".v3dg-export.{secrets.token_hex(8)}.tmp"
        unfinished = [name for name in root.names() if _HIDDEN.fullmatch(name)]
        for name in unfinished:
            _clear_up(root, name, folder)
        record = read_record(root, RECORD, folder / RECORD)
        is_empty = not set(root.names()) - set(unfinished)
        advice = (
            "choose another folder, or overwrite, which replaces files with the same names and "
            "removes none"
        )
        expected = f"a new folder or one with an earlier export, got one without {RECORD}; {advice}"
        check(folder, overwrite or is_empty or record is not None, expected)
        self._record = record or Record({}, [])
        self.earlier: dict[str, Stamp] = self._record.unchanged(root)
        if record is not None:
            self.earlier[RECORD] = _stamp(root, RECORD)

    def check(self, names: Iterable[str]) -> None:
        """Raise ValueError if files with these names would replace anything that must
        not be replaced."""
        for name in names:
            for parent in folders_above(name):
                status = self._root.status(parent)
                is_ready = status is None or stat.S_ISDIR(status.st_mode)
                expected = "a folder, got a file or a link, which an export does not replace"
                check(self._folder / parent, is_ready, f"{expected}; move it elsewhere")
            status = self._root.status(name)
            if status is None or self.earlier.get(name) == stamp_of_status(status):
                continue
            expected = "a file, got a folder, a link or a device, which an export does not replace"
            check(self._folder / name, is_file(status), f"{expected}; move it elsewhere")
            expected = (
                "a file of an earlier export, got one that was changed or not written by an export"
            )
            advice = "move it elsewhere, or overwrite"
            check(self._folder / name, self._overwrite, f"{expected}; {advice}")

    def put(self, record: Record, path: Path) -> None:
        """Replace the files of the earlier export by the new files. `path` is the
        temporary path of the new record."""
        root = self._root
        hidden = self.hidden
        self.check([*record.files, RECORD])
        earlier = self._record.folders
        folders = [
            name
            for name in folders_of(record.files)
            if name in earlier or root.status(name) is None
        ]
        path.write_bytes(Record(record.files, folders).encode())
        for name in dict.fromkeys((*self.earlier, *record.files)):
            status = root.status(name)
            is_earlier = status is not None and self.earlier.get(name) == stamp_of_status(status)
            if status is not None and (is_earlier or name in record.files):
                root.move(name, f"{hidden}/old/{name}")
        for name in record.files:
            root.move(f"{hidden}/new/{name}", name)
        root.move(f"{hidden}/{RECORD}", RECORD)


def _stamp(root: Folder, name: str) -> Stamp:
    status = root.status(name)
    assert status is not None
    return stamp_of_status(status)


def _restore(root: Folder, hidden: str, folder: Path) -> bool:
    """Move all files that an unfinished export has moved back. Return whether all files
    are in place again."""
    record = read_record(root, f"{hidden}/{RECORD}", folder / hidden / RECORD)
    # either the export has not moved anything yet, or it has finished
    if record is None:
        return True
    earlier = read_record(root, f"{hidden}/old/{RECORD}", folder / hidden / "old" / RECORD)
    earlier = earlier or read_record(root, RECORD, folder / RECORD) or Record({}, [])
    for name, content in record.files.items():
        is_moved = root.status(f"{hidden}/new/{name}") is None
        if is_moved and stamp_of_content(root, name, content) is not None:
            root.move(name, f"{hidden}/new/{name}")
    is_whole = True
    for name in dict.fromkeys((*record.files, *earlier.files, RECORD)):
        if root.status(f"{hidden}/old/{name}") is not None:
            try:
                root.move(f"{hidden}/old/{name}", name)
            except OSError:  # another program has written a file with this name
                is_whole = False
    for name in reversed(record.folders):
        if name not in earlier.folders:
            root.remove_empty_folder(name)
    return is_whole


def _remove_unused_folders(root: Folder, hidden: str, folder: Path) -> None:
    """Remove the folders that an earlier export created, if they are empty and the new
    export does not use them."""
    earlier = read_record(root, f"{hidden}/old/{RECORD}", folder / hidden / "old" / RECORD)
    later = read_record(root, RECORD, folder / RECORD)
    if earlier is not None and later is not None:
        for name in sorted(set(earlier.folders) - set(later.folders), reverse=True):
            root.remove_empty_folder(name)


def _clear_up(root: Folder, hidden: str, folder: Path) -> None:
    """Clean up after an export that was killed. Move back the files that it moved, and
    remove the files that records list.

    Files that were written before the record are kept.
    """
    with contextlib.suppress(OSError, ValueError):
        if not _restore(root, hidden, folder):
            return
        _remove_unused_folders(root, hidden, folder)
        # If the killed export was undone, the record in the hidden folder is its own.
        # Otherwise, it is that of the earlier export.
        present = read_record(root, RECORD, folder / RECORD)
        folders: set[str] = set()
        if present is not None:
            folders.update(folders_of(present.files))
        for part, name in (("new", f"{hidden}/{RECORD}"), ("old", f"{hidden}/old/{RECORD}")):
            record = read_record(root, name, folder / name)
            if record is not None:
                for file in record.unchanged(root, f"{hidden}/{part}/"):
                    root.remove_file(f"{hidden}/{part}/{file}")
                folders.update(folders_of(record.files))
                root.remove_file(name)
        for subfolder in sorted(folders, reverse=True):
            for part in ("new", "old"):
                root.remove_empty_folder(f"{hidden}/{part}/{subfolder}")
        for name in (f"{hidden}/new", f"{hidden}/old", hidden):
            root.remove_empty_folder(name)
