"""The record of an export: the files and folders that it wrote, with the hashes of the
files.

The record is in the folder of the export, so any program may have changed it.
Therefore, only names that an export can write are accepted, all of which are below the
folder; and a file counts as written by an export only if its size and its hash match.
"""

import hashlib
import io
import json
import os
import re
import stat
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from v3dg._json import Node, parse_json
from v3dg._numbers import check
from v3dg.export._below import Folder

RECORD = "v3dg-export.json"
_FORMAT = "v3dg-export"
_VERSION = 1
_MOST_BYTES = 64 << 20  # bytes; the size of a record of a million files
_PIECE_BYTES = 1 << 20
_HASH_BYTES = 16
_FOLDER_NAME = re.compile(r"[A-Za-z0-9_]{1,100}(/[A-Za-z0-9_]{1,100})?")
_FILE_NAME = re.compile(
    r"([A-Za-z0-9_]{1,100}/){0,2}[A-Za-z0-9_][A-Za-z0-9_-]{0,99}(\.[a-z]{1,20}){0,2}\."
    r"(html|json|mjs|webp|glb|v3dg|js|ts|css|wgsl|wasm)"
)
_HASH = re.compile(f"[0-9a-f]{{{2 * _HASH_BYTES}}}")


class Stamp(NamedTuple):
    """The identity of a file. A different file, or a file that was written to, has a
    different stamp."""

    inode: int
    num_bytes: int
    modified_ns: int
    changed_ns: int


@dataclass(frozen=True)
class Content:
    """The size and the hash of a file."""

    num_bytes: int
    digest: str


@dataclass(frozen=True)
class Record:
    """The files of an export, by names relative to its folder, and the folders that
    were created for them."""

    files: dict[str, Content]
    folders: list[str]

    @classmethod
    def of_files_below(cls, path: Path) -> "Record":
        """Return the record of all files below a folder to which no other program
        writes; without folders.

        Files are sorted so that those in subfolders come first, because the other files
        refer to those in subfolders.
        """
        names = [file.relative_to(path).as_posix() for file in path.rglob("*") if not file.is_dir()]
        assert all(_FILE_NAME.fullmatch(name) and name != RECORD for name in names), names
        names.sort(key=lambda name: (-name.count("/"), name))
        return cls({name: _content_of_path(path / name) for name in names}, [])

    def encode(self) -> bytes:
        files = {name: [content.num_bytes, content.digest] for name, content in self.files.items()}
        document = {"format": _FORMAT, "version": _VERSION, "folders": self.folders, "files": files}
        return json.dumps(document, separators=(",", ":")).encode("ascii")

    def unchanged(self, root: Folder, prefix: str = "") -> dict[str, Stamp]:
        """Return the stamps of the files below `prefix` whose content is still the
        recorded one."""
        stamps: dict[str, Stamp] = {}
        for name, content in self.files.items():
            stamp = stamp_of_content(root, f"{prefix}{name}", content)
            if stamp is not None:
                stamps[name] = stamp
        return stamps


def read_record(root: Folder, name: str, display_path: Path) -> Record | None:
    """Read a record; return None if it does not exist.

    Args:
        root: The folder of the export.
        name: The name of the record, relative to `root`.
        display_path: The path of the record in error messages.

    Raises:
        ValueError: The file is not a record, or contains a name that no export writes.
        OSError: The record cannot be read.
    """
    status = root.status(name)
    if status is None:
        return None
    expected = "the record of an export, got a folder, a link or a device; move it elsewhere"
    check(display_path, is_file(status), expected)
    with open(root.open_file(name), "rb") as file:
        text = file.read(_MOST_BYTES + 1)
    check(
        display_path,
        len(text) <= _MOST_BYTES,
        f"a record of at most {_MOST_BYTES >> 20} MiB, got more; remove the file",
    )
    try:
        document = Node(parse_json(text), str(display_path), "")
    except ValueError as error:
        raise ValueError(
            f"{display_path}: expected the record of an export, got an unreadable file ({error}); "
            "remove it"
        ) from None
    fields = document.fields(("format", "version", "folders", "files"))
    if fields["format"].value != _FORMAT or fields["version"].value != _VERSION:
        raise document.problem(
            f"expected {_FORMAT} version {_VERSION}, got another format or version; remove the file"
        )
    folders = [_checked_name(node, _FOLDER_NAME) for node in fields["folders"].items()]
    files: dict[str, Content] = {}
    for key, node in fields["files"].some_fields(()).items():
        files[_checked_name(Node(key, node.file, "files"), _FILE_NAME)] = _content_of_node(node)
    return Record(files, folders)


def _checked_name(node: Node, pattern: re.Pattern[str]) -> str:
    """Return a name that an export can write; raise ValueError for any other name,
    which could be outside the folder or belong to another program."""
    name = node.value
    if not isinstance(name, str) or not pattern.fullmatch(name) or name == RECORD:
        raise node.error(
            "the name of a file that an export writes", "remove the record to start again"
        )
    return name


def _content_of_node(node: Node) -> Content:
    size, digest = node.items("the size of a file in bytes and its hash", 2, 2)
    is_size = isinstance(size.value, int) and not isinstance(size.value, bool) and size.value >= 0
    if not is_size:
        raise size.error("an integer of at least 0")
    if not (isinstance(digest.value, str) and _HASH.fullmatch(digest.value)):
        raise digest.error(f"a hash of {2 * _HASH_BYTES} hexadecimal digits")
    return Content(size.value, digest.value)


def stamp_of_content(root: Folder, name: str, content: Content) -> Stamp | None:
    """Return the stamp of a file with exactly this content; None for other content, or
    if the file cannot be read."""
    try:
        descriptor = root.open_file(name)
    except (OSError, ValueError):
        return None
    with open(descriptor, "rb", buffering=0) as file:
        status = os.fstat(descriptor)
        if status.st_size != content.num_bytes or _digest_of(file) != content.digest:
            return None
    return stamp_of_status(status)


def stamp_of_status(status: os.stat_result) -> Stamp:
    return Stamp(status.st_ino, status.st_size, status.st_mtime_ns, status.st_ctime_ns)


def is_file(status: os.stat_result) -> bool:
    """Return whether a status is that of a regular file; links are not."""
    return stat.S_ISREG(status.st_mode)


def _content_of_path(path: Path) -> Content:
    with open(path, "rb", buffering=0) as file:
        return Content(os.fstat(file.fileno()).st_size, _digest_of(file))


def _digest_of(file: io.FileIO) -> str:
    """Return the hash of the remaining content of a file."""
    state = hashlib.blake2b(digest_size=_HASH_BYTES)
    while piece := file.read(_PIECE_BYTES):
        state.update(piece)
    return state.hexdigest()


def folders_of(names: Iterable[str]) -> list[str]:
    """Return the folders that contain files with these names, the outermost first."""
    return sorted(
        {name[:end] for name in names for end, letter in enumerate(name) if letter == "/"}
    )
