"""The folder of an export: files of an earlier export are replaced, and nothing else is
changed.

New files are written to `new` in a hidden folder inside, so that all moves stay within
one file system. Once they are complete, their record is written beside `new`, the files
that they replace move to `old`, and they move into place; moving the record completes
the export. Until then everything can be moved back: after an error at once, and after a
kill when the next export begins.
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
from v3dg.levels.scratch import lock
from v3dg.scene import Scene

_HIDDEN = re.compile(r"\.v3dg-export\.[0-9a-f]{16}\.tmp")


@dataclass(frozen=True)
class NewFiles:
    """The place of the files of a new export.

    Attributes:
        path: A folder for the new files, which take their place at the end.
        earlier: Files of an earlier export that are as they were written; all others
            stay.
    """

    path: Path
    earlier: Collection[str]


def check_outside(folder: Path, inputs: Iterable[str | os.PathLike[str] | None]) -> None:
    """Refuse, with ValueError, to write to a folder that contains an input."""
    if not folder.is_dir():
        return
    status = folder.stat()
    for path in inputs:
        if path is None or is_url(path):
            continue
        parents = [parent for parent in Path(os.path.realpath(path)).parents if parent.exists()]
        if any(os.path.samestat(parent.stat(), status) for parent in parents):
            raise ValueError(
                f"{folder}: the input {os.fspath(path)} is in it; choose another folder"
            )


@contextlib.contextmanager
def replacing_export(
    folder: Path, scene: Scene, certain: Iterable[str] = (), *, overwrite: bool = False
) -> Iterator[NewFiles]:
    """Give a folder to fill; at the end its files take the place of those of an earlier
    export.

    The folder itself stays, with its permissions. After an error, its content is as
    before; a folder that did not exist is removed again.

    Args:
        folder: The folder to write; a link to a folder stays a link.
        scene: The exported scene, whose files must not be in the folder.
        certain: Names of files that will be written, so that it is known at once
            whether they may.
        overwrite: Whether files of the same names may be replaced that are not of an
            earlier export. All others stay in any case.

    Raises:
        ValueError: An input is in the folder, ``folder`` is not a folder, a file must
            not be replaced, or the record of the earlier export is invalid.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.
    """
    is_free = folder.is_dir() or not os.path.lexists(os.path.realpath(folder))
    check(folder, is_free, "a new folder, or one with an earlier export, got a file")
    check_outside(folder, (bundle.path for bundle in scene.bundles))
    with _made(folder) as target, _naming_errors(folder, target), Folder(target, folder) as root:
        lock(root.descriptor, folder, "export")
        place = _Place(folder, target, root, overwrite=overwrite)
        place.check(certain)
        try:
            os.mkdir(place.hidden, 0o700, dir_fd=root.descriptor)
            os.mkdir(f"{place.hidden}/new", dir_fd=root.descriptor)
            path = target / place.hidden / "new"
            yield NewFiles(path, place.earlier.keys())
            place.put(Record.of_files_below(path), path.parent / RECORD)
        finally:
            _restore_and_remove(root, place.hidden, target)


def _restore_and_remove(root: Folder, hidden: str, folder: Path) -> None:
    """Bring back what an export moved that did not end, and remove its hidden folder,
    which is its alone."""
    with contextlib.suppress(OSError, ValueError):  # the first error is reported
        if _restore(root, hidden, folder):
            _remove_unused_folders(root, hidden, folder)
            try:
                shutil.rmtree(folder / hidden, ignore_errors=True)
            except KeyboardInterrupt:
                shutil.rmtree(folder / hidden, ignore_errors=True)
                raise


@contextlib.contextmanager
def _made(folder: Path) -> Iterator[Path]:
    """Make the folder and those above it, and yield its path without links. After an
    error, those that were made are removed if they are empty."""
    target = Path(os.path.realpath(folder))
    missing = [path for path in (target, *target.parents) if not path.exists()]  # the lowest first
    try:
        target.mkdir(parents=True, exist_ok=True)
        yield target
    except BaseException:
        for path in missing:
            with contextlib.suppress(OSError):  # somebody else has put something there
                path.rmdir()
        raise


@contextlib.contextmanager
def _naming_errors(folder: Path, target: Path) -> Iterator[None]:
    """Have the system's errors name files as they will be called, outside of the hidden
    folder."""
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
    """A folder that an export is written to, and what an earlier one wrote there."""

    def __init__(self, folder: Path, target: Path, root: Folder, *, overwrite: bool) -> None:
        self._folder = folder
        self._root = root
        self._overwrite = overwrite
        self.hidden = f".v3dg-export.{secrets.token_hex(8)}.tmp"
        unfinished = [name for name in os.listdir(root.descriptor) if _HIDDEN.fullmatch(name)]
        for name in unfinished:
            _clear_up(root, name, folder)
        record = read_record(root, RECORD, folder / RECORD)
        is_empty = not set(os.listdir(root.descriptor)) - set(unfinished)
        advice = (
            "choose another, or overwrite, which replaces files of the same names and removes none"
        )
        expected = (
            f"a new folder, or one with an earlier export, got one without {RECORD}; {advice}"
        )
        check(folder, overwrite or is_empty or record is not None, expected)
        self._record = record or Record({}, [])
        self.earlier: dict[str, Stamp] = self._record.unchanged(root)
        if record is not None:
            self.earlier[RECORD] = _stamp(root, RECORD)

    def check(self, names: Iterable[str]) -> None:
        """Refuse, with ValueError, to write files of these names where something has
        them that may not go."""
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
                "a file of an earlier export, got one that was changed, or that no export wrote"
            )
            advice = "move it elsewhere, or overwrite"
            check(self._folder / name, self._overwrite, f"{expected}; {advice}")

    def put(self, record: Record, path: Path) -> None:
        """Have the new files take the place of the earlier ones; `path` is for the new
        record until then."""
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
    """Bring all back that was moved for an export that did not end; returns whether all
    is in its place."""
    record = read_record(root, f"{hidden}/{RECORD}", folder / hidden / RECORD)
    if record is None:  # it had not begun to move anything, or has ended
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
            except OSError:  # somebody else has put something there
                is_whole = False
    for name in reversed(record.folders):
        if name not in earlier.folders:
            root.remove_empty_folder(name)
    return is_whole


def _remove_unused_folders(root: Folder, hidden: str, folder: Path) -> None:
    """Remove what an earlier export made, if it is empty and the one that replaced it
    does not use it."""
    earlier = read_record(root, f"{hidden}/old/{RECORD}", folder / hidden / "old" / RECORD)
    later = read_record(root, RECORD, folder / RECORD)
    if earlier is not None and later is not None:
        for name in sorted(set(earlier.folders) - set(later.folders), reverse=True):
            root.remove_empty_folder(name)


def _clear_up(root: Folder, hidden: str, folder: Path) -> None:
    """After an export that was killed: bring back what it moved, and remove what
    records say that it wrote.

    Files that it wrote before its record stay.
    """
    with contextlib.suppress(OSError, ValueError):
        if not _restore(root, hidden, folder):
            return
        _remove_unused_folders(root, hidden, folder)
        # It went back and has a record, or it ended, and that of the earlier one is
        # left.
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
