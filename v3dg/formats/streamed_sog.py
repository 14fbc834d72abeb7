"""Streamed SOG, of PlayCanvas: `lod-meta.json` and folders with a SOG each. v3dg.export
writes this format.

`lod-meta.json` has a tree of boxes. Each leaf lists, for each level of detail, the rows
of gaussians in one of the folders that represent the content of its box.
"""

import os
import re
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import numpy as np

from v3dg._json import Node, parse_json
from v3dg.formats import sog
from v3dg.formats._declared import Declared
from v3dg.formats._reading import (
    AssetFile,
    Claims,
    check,
    integer_of,
    listed,
    value_errors,
    whole_file,
)
from v3dg.gaussians import Gaussians

_FIELDS = (
    "version",
    "asset",
    "count",
    "counts",
    "environment",
    "filenames",
    "lodErrors",
    "lodLevels",
    "tree",
)
_LEVEL = re.compile(r"[0-9]{1,9}")


class _Index(NamedTuple):
    """The content of `lod-meta.json`."""

    tree: Node
    names: list[PurePosixPath]  # the files that the tree refers to by index
    environment: PurePosixPath | None  # the file of gaussians that belong to no leaf
    unread: list[str]  # names of ignored fields


def open_file(path: str | os.PathLike[str]) -> AssetFile:
    """Open a `lod-meta.json`. The first read loads all gaussians."""
    path = Path(path)
    index = _index(path, Claims())
    finest = _used(path, index)
    environment = index.environment
    parts = [sog.open_file(path.parent / name) for name in finest]
    count = sum(len(rows) for runs in finest.values() for rows in runs)
    if environment is not None:
        parts.append(sog.open_file(path.parent / environment))
        count += parts[-1].num_gaussians
    declared = _declared(index, [part.declared for part in parts])
    return whole_file(path, count, parts[0].sh_degree, read, files(path), declared)


def _declared(index: _Index, parts: list[Declared]) -> Declared:
    """Return what the index and all of its parts declare."""
    notes = list(dict.fromkeys(note for part in parts for note in part.notes))
    if index.unread:
        notes.append(f"Fields of lod-meta.json were ignored: {listed(index.unread)}.")
    antialiased = parts[0].antialiased
    if any(part.antialiased != antialiased for part in parts):
        antialiased = None
        notes.append(
            "Some folders were trained with antialiasing, others were not or do not declare it."
        )
    return Declared(antialiased=antialiased, notes=tuple(notes))


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read a `lod-meta.json`: the finest level of each leaf, and the environment."""
    path = Path(path)
    claims = Claims()
    index = _index(path, claims)
    finest = _used(path, index)
    parts = []
    for name, rows in finest.items():
        gaussians = sog.read(path.parent / name, claims)
        # Without this check, a small file could repeat rows any number of times.
        count = len(gaussians)
        fits = sum(len(run) for run in rows) <= count and max(run.stop for run in rows) <= count
        check(path, fits, f"at most {count} gaussians from {str(name)!a}, got more; is it damaged?")
        parts.append(
            gaussians.subset(np.concatenate([np.arange(run.start, run.stop) for run in rows]))
        )
    if index.environment is not None:
        parts.append(sog.read(path.parent / index.environment, claims))
    degrees = sorted({part.sh_degree for part in parts})
    check(path, len(degrees) == 1, f"one SH degree in all folders, got {degrees}")
    return Gaussians.concatenate(parts)


def files(path: Path) -> list[Path]:
    """Return the index and those files of all levels and of the environment that
    exist."""
    index = _index(path, Claims())
    names = dict.fromkeys([*index.names, index.environment])
    parts = [path.parent / name for name in names if name is not None]
    return [path, *(file for part in parts if part.exists() for file in sog.files(part))]


def _used(path: Path, index: _Index) -> dict[PurePosixPath, list[range]]:
    """Return the rows that are read from each file, in the order of the files."""
    finest = _finest(index.tree, index.names)
    has_any = finest or index.environment is not None
    check(path, has_any, "at least one gaussian in the tree, got none")
    # A file that is listed twice is read only once.
    return {name: finest[name] for name in dict.fromkeys(index.names) if name in finest}


def _index(path: Path, claims: Claims) -> _Index:
    text = claims.read(path)
    with value_errors(path, "JSON"):
        index = Node(parse_json(text), os.fspath(path), "")
    if index.has("version") and index.field("version").value != 1:
        raise index.field("version").error("streamed SOG version 1")
    names = [_inside(name) for name in index.field("filenames").items()]
    environment = None
    if index.has("environment") and index.field("environment").value is not None:
        environment = _inside(index.field("environment"))
    unread = [name for name in index.some_fields(()) if name not in _FIELDS]
    return _Index(index.field("tree"), names, environment, unread)


def _inside(node: Node) -> PurePosixPath:
    """Return the path of a file in the folder of the index or below it; raise
    ValueError for other paths."""
    path = PurePosixPath(node.text())
    if path.is_absolute() or ".." in path.parts or "\\" in node.text():
        raise node.error("a path inside the folder of lod-meta.json")
    return path


def _finest(tree: Node, names: list[PurePosixPath]) -> dict[PurePosixPath, list[range]]:
    """Return, for each file, the rows of gaussians that are the finest level of a
    leaf."""
    runs: dict[PurePosixPath, list[range]] = {}
    # A list of a million empty nodes would need as much memory as a scene, so iterators
    # are stacked.
    todo = [iter([tree])]
    while todo:
        node = next(todo[-1], None)
        if node is None:
            todo.pop()
            continue
        if not isinstance(node.value, dict):
            raise node.error("an object")
        if node.has("children"):
            todo.append(node.field("children").items())
        if not node.has("lods"):
            continue
        levels = node.field("lods")
        if not isinstance(levels.value, dict) or not all(map(_LEVEL.fullmatch, levels.value)):
            raise levels.error("levels with integers as names")
        for level in sorted(levels.value, key=int):
            lod = levels.field(level)
            file = integer_of(lod.field("file"), f"0 to {len(names) - 1}", 0, len(names) - 1)
            offset = integer_of(lod.field("offset"), "a whole number, 0 or more", 0, 1 << 32)
            count = integer_of(lod.field("count"), "a whole number, 0 or more", 0, 1 << 32)
            if count:
                runs.setdefault(names[file], []).append(range(offset, offset + count))
                break
    return runs
