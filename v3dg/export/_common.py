"""What exports share: which way is up, turning gaussians, and folders that are complete or not there."""

import contextlib
import json
import math
import os
import secrets
import shutil
from collections.abc import Iterator
from importlib.resources import files
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._numbers import check, one_of
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Floats
from v3dg.rotations import rotation_from_quaternion
from v3dg.scene import Scene

# Quaternions w x y z that turn an axis to -y, which is up where y is down, as viewers take it.
_HALF = math.sqrt(0.5)
_TO_UPRIGHT: dict[Axis, tuple[float, float, float, float]] = {
    "x": (_HALF, 0.0, 0.0, -_HALF),
    "y": (0.0, 1.0, 0.0, 0.0),
    "z": (_HALF, _HALF, 0.0, 0.0),
    "-x": (_HALF, 0.0, 0.0, _HALF),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "-z": (_HALF, -_HALF, 0.0, 0.0),
}
# From there to where y is up, as in WebGL, and z, as on a globe.
_FROM_UPRIGHT = {"y": np.diag([-1.0, -1.0, 1.0]), "z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])}

# The file by which an export is known, of each kind: nothing else is replaced by another export.
MARKS = ("lod-meta.json", "site.json", "tileset.json")


def turn_upright(up: Axis) -> Floats:
    """(4,) w x y z that turns what is up in an asset to -y; ValueError for another name."""
    one_of(up, "up", tuple(_TO_UPRIGHT))
    return np.array(_TO_UPRIGHT[up])


def rotation_to(up: Axis, frame: Literal["y", "z"]) -> Floats:
    """(3, 3) rotation that turns what is up to an axis."""
    return np.asarray(_FROM_UPRIGHT[frame] @ rotation_from_quaternion(turn_upright(up))) + 0.0


def names_of(scene: Scene) -> list[str]:
    """A folder for each bundle, after its file."""
    names: list[str] = []
    for number, bundle in enumerate(scene.bundles):
        stem = beside(bundle.path or "bundle").stem
        name = "".join(c if c.isascii() and c.isalnum() else "_" for c in stem)[:80]
        names.append(f"{name}_{number}" if name in names else name)
    return names


def rows_by(numbers: NDArray[Any], count: int) -> list[NDArray[np.intp]]:
    """The rows that have each of the numbers 0 to `count` - 1, in ascending order."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def detail_of(bundle: Bundle) -> dict[str, float]:
    """How far levels reach: `reach` times focal length in px over √tolerance is where level 1 is enough.

    Each further level is enough from `ratio` times the distance of the one before it.
    """
    groups = bundle.groups
    radius = groups.ball[:, 3].astype(np.float64) * np.sqrt(math.pi * groups.weight.astype(np.float64))
    reach = [float(np.median(radius[groups.level == level])) for level in range(1, bundle.num_levels)]
    if not reach:
        return {"reach": 0.0, "ratio": math.sqrt(2)}
    ratio = (reach[-1] / reach[0]) ** (1 / max(1, len(reach) - 1))
    return {"reach": reach[0], "ratio": max(ratio, 1.2)}  # the engine takes no less


def write_document(path: Path, document: Any) -> None:
    """JSON without spaces, into a folder that is not in its place yet."""
    path.write_text(json.dumps(document, separators=(",", ":")), encoding="utf-8")


def write_page(folder: Path, name: str) -> None:
    """The page of an export, which the package has by that name."""
    (folder / "index.html").write_bytes(files("v3dg.export").joinpath(name).read_bytes())


def bytes_below(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


@contextlib.contextmanager
def replacing_folder(folder: Path, keep: str = "") -> Iterator[Path]:
    """Give a new folder beside `folder` to fill; at the end it takes its place, on failure it is removed.

    What is there by the name `keep` moves along.
    """
    has_mark = any((folder / mark).is_file() for mark in MARKS)
    is_ours = folder.is_dir() and (has_mark or not any(folder.iterdir()))
    expected = "a new folder, or one with an earlier export, got something else"
    check(folder, is_ours or not folder.exists(), expected)
    target = folder.resolve()
    missing = [parent for parent in target.parents if not parent.exists()]  # the lowest first
    hidden = f".{target.name[:40]}.{secrets.token_hex(8)}"
    temporary, old = target.with_name(f"{hidden}.tmp"), target.with_name(f"{hidden}.old")
    with _files.naming_errors(folder, os.fspath(temporary)):
        try:
            temporary.mkdir(parents=True)
            yield temporary
            if target.exists():
                target.rename(old)
            temporary.rename(target)
            if keep and (old / keep).exists():
                (old / keep).rename(target / keep)
            shutil.rmtree(old, ignore_errors=True)
        except BaseException:
            if old.exists() and not target.exists():
                old.rename(target)
            for rest in (temporary, old):
                shutil.rmtree(rest, ignore_errors=True)
            for parent in missing:
                with contextlib.suppress(OSError):  # somebody else has put something there
                    parent.rmdir()
            raise
