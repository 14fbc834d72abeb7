"""Streamed SOG, of PlayCanvas: `lod-meta.json` and folders of SOG; v3dg.export writes it.

The leaves of a tree say for each level which gaussians of which folder stand for what is in their bounds.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

import numpy as np

from v3dg._json import Node, parse_json
from v3dg.formats import sog
from v3dg.formats._packing import problem, read_bytes
from v3dg.gaussians import Gaussians


def read(path: str | os.PathLike[str]) -> Gaussians:
    """Read the finest level of each leaf, and the environment, of a `lod-meta.json`.

    Raises:
        ValueError: It is none, or incomplete.
        OSError: A file cannot be read.
    """
    path = Path(path)
    content = read_bytes(path)
    try:
        index = Node(parse_json(content.decode("utf-8")), os.fspath(path), "")
    except ValueError as error:
        raise problem(path, f"expected JSON, got a file that does not parse: {error}") from None
    fields = index.some_fields(("filenames", "tree"))
    if "version" in fields and fields["version"].value != 1:
        raise fields["version"].error("streamed SOG version 1")
    names = [_inside(item) for item in fields["filenames"].items()]
    finest = _finest(fields["tree"], len(names))
    has_environment = "environment" in fields and fields["environment"].value is not None
    environment = _inside(fields["environment"]) if has_environment else None
    if not finest and environment is None:
        raise problem(path, "expected gaussians in the tree, got none")
    parts = []
    for file, rows in sorted(finest.items()):
        gaussians = sog.read(path.parent / names[file])
        # No more than it has: else a small file could ask for any number.
        if sum(len(r) for r in rows) > len(gaussians) or max(r.stop for r in rows) > len(gaussians):
            raise problem(path, f"expected at most {len(gaussians)} gaussians of {names[file]!a}, got more")
        parts.append(gaussians.subset(np.concatenate([np.arange(r.start, r.stop) for r in rows])))
    if environment is not None:
        parts.append(sog.read(path.parent / environment))
    degrees = sorted({part.sh_degree for part in parts})
    if len(degrees) > 1:
        raise problem(path, f"expected one SH degree in all folders, got {degrees}")
    return Gaussians.concatenate(parts)


def _inside(node: Node) -> str:
    """The path of a file in the folder of the index, or below it."""
    name = node.text()
    if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name:
        raise node.error("a path below that of lod-meta.json")
    return name


def _finest(tree: Node, num_files: int) -> dict[int, list[range]]:
    """For each file, the runs of gaussians that are the finest level of a leaf."""
    found: dict[int, list[range]] = {}
    todo = [tree]
    while todo:
        fields = todo.pop().some_fields(())
        if "children" in fields:
            todo += fields["children"].items()
        if "lods" not in fields:
            continue
        levels = fields["lods"].some_fields(())
        if not all(level.isdecimal() for level in levels):
            raise fields["lods"].error("levels by number")
        used = [levels[level] for level in sorted(levels, key=int)]
        for lod in used:
            run = lod.some_fields(("file", "offset", "count"))
            file, offset, count = (_whole(run[name]) for name in ("file", "offset", "count"))
            if file >= num_files:
                raise run["file"].error(f"0 to {num_files - 1}")
            if count:
                found.setdefault(file, []).append(range(offset, offset + count))
                break
    return found


def _whole(node: Node) -> int:
    if not isinstance(node.value, int) or isinstance(node.value, bool) or not 0 <= node.value < 1 << 32:
        raise node.error("a whole number, 0 or more")
    return node.value
