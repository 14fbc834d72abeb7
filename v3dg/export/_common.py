"""Shared code of the exports: the axis that is up, rotations, names of bundles,
documents."""

import copy
import json
import math
import re
import warnings
from collections.abc import Collection, Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Floats
from v3dg.formats import _axes
from v3dg.scene import Scene

_MIN_OPACITY = float(np.float32(_core.min_alpha))
"""Instances of a smaller opacity are not drawn."""


class ExportWarning(UserWarning):
    """A property of instances is left out, because a format cannot hold it."""


_OTHER_LETTERS = re.compile("[^A-Za-z0-9]")  # than names of folders have

# The axes of a world of which this axis is up: y as in WebGL, z as on a globe.
_WORLDS = {"y": _axes.GLTF, "z": _axes.Z_UP}


def rotation_to(up: Axis, frame: Literal["y", "z"]) -> Floats:
    """Return the (3, 3) rotation that turns the axis that is up to another axis."""
    return _axes.turn(_axes.axes_of_up(up), _WORLDS[frame])


def exported(scene: Scene, format_name: str) -> Scene:
    """Return the instances of a scene that are drawn, for a format without opacity and
    tint; warn if any has one."""
    if scene.factors is None:
        return scene
    visible = copy.copy(scene)
    visible.remove(np.flatnonzero(visible.opacity < _MIN_OPACITY))
    factors = visible.factors
    if factors is not None:
        count = int((factors != 1).any(axis=1).sum())
        warnings.warn(
            f"{format_name} cannot hold the opacity and tint of instances; those of {count:,} are "
            "left out",
            ExportWarning,
            stacklevel=3,
        )
    return visible


def names_of(scene: Scene, reserved: Collection[str] = ()) -> list[str]:
    """Return a folder name for each bundle, made from the name of its file; no reserved
    name is used."""
    stems = [beside(bundle.path or "bundle").stem[:80] for bundle in scene.bundles]
    return distinct([_OTHER_LETTERS.sub("_", stem) for stem in stems], reserved)


def distinct(names: Iterable[str], reserved: Collection[str] = ()) -> list[str]:
    """Return the names, with a number added to each that is reserved or repeats an
    earlier one in upper or lower case."""
    results: list[str] = []
    used = {name.casefold() for name in reserved}
    for number, name in enumerate(names):
        result = name
        while result.casefold() in used:
            result = f"{name}_{number}"
            number += 1
        used.add(result.casefold())
        results.append(result)
    return results


def rows_by(numbers: NDArray[np.int32] | NDArray[np.int64], count: int) -> list[NDArray[np.intp]]:
    """Return for each number from 0 to `count` - 1 the rows that have it, in ascending
    order."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def detail_of(bundle: Bundle) -> dict[str, float]:
    """Return from which distances levels are fine enough: for level 1 it is `reach`
    times the focal length in px, divided by √tolerance.

    Each further level is enough from `ratio` times the distance of the one before it.
    """
    groups = bundle.groups
    radius = groups.ball[:, 3].astype(np.float64) * np.sqrt(
        math.pi * groups.weight.astype(np.float64)
    )
    reach = [
        float(np.median(radius[groups.level == level])) for level in range(1, bundle.num_levels)
    ]
    if not reach:
        return {"reach": 0.0, "ratio": math.sqrt(2)}
    ratio = (reach[-1] / reach[0]) ** (1 / max(1, len(reach) - 1))
    return {"reach": reach[0], "ratio": max(ratio, 1.2)}  # the engine takes no less


def write_document(path: Path, document: Mapping[str, object]) -> None:
    """JSON without spaces, into a folder that is not in its place yet."""
    path.write_text(json.dumps(document, separators=(",", ":")), encoding="utf-8")


def write_page(folder: Path, name: str) -> None:
    """Write the page of an export, a copy of the package's file of that name."""
    (folder / "index.html").write_bytes(files("v3dg.export").joinpath(name).read_bytes())


def bytes_below(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
