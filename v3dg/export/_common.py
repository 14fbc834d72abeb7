"""Code that the exports share: the up axis, rotations, names of bundles, and
documents."""

import copy
import json
import math
import os
import re
import warnings
from collections.abc import Collection, Iterable, Mapping
from importlib.resources import files
from pathlib import Path
from typing import Literal, cast

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera, Floats, check_cameras
from v3dg.export._folder import check_outside
from v3dg.formats import _axes
from v3dg.opening import File, open_with_cameras
from v3dg.scene import Scene

_MIN_OPACITY = float(np.float32(_core.min_alpha))
"""Instances with a smaller opacity are not drawn."""


class ExportWarning(UserWarning):
    """Emitted when a property of instances is left out because the format cannot store
    it."""


# Characters that must not occur in names of folders.
_OTHER_LETTERS = re.compile("[^A-Za-z0-9]")

# The axes of a world by its up axis: y as in WebGL, z as on a globe.
_WORLDS = {"y": _axes.GLTF, "z": _axes.Z_UP}


def rotation_to(up: Axis, frame: Literal["y", "z"]) -> Floats:
    """Return the (3, 3) rotation that maps the up axis of a world to the up axis of a
    format."""
    return _axes.turn(_axes.axes_of_up(up), _WORLDS[frame])


def opened_with_cameras(
    subject: Scene | Bundle | File, folder: Path, cameras: Mapping[str, Camera] | None
) -> tuple[Scene | Bundle, Mapping[str, Camera]]:
    """Return the subject and the cameras of an export to a folder. If no cameras are
    given, they are those of the subject's file.

    Raises:
        TypeError: `cameras` is not a mapping from names to cameras.
        ValueError: The folder contains the file of the subject.
    """
    content: object = subject
    if isinstance(subject, str | os.PathLike):
        check_outside(folder, [subject])
        content, file_cameras = open_with_cameras(Path(subject))
        cameras = cameras or file_cameras
    cameras = cameras or {}
    check_cameras(cameras)
    return cast(Scene | Bundle, content), cameras


def exported(scene: Scene, format_name: str) -> Scene:
    """Return the visible instances of a scene, for a format without opacity and tint.
    Emit a warning if any instance has an opacity or a tint."""
    if scene.factors is None:
        return scene
    visible = copy.copy(scene)
    visible.remove(np.flatnonzero(visible.opacity < _MIN_OPACITY))
    factors = visible.factors
    if factors is not None:
        count = int((factors != 1).any(axis=1).sum())
        warnings.warn(
            f"{format_name} cannot store the opacity and tint of instances; those of {count:,} "
            "instances are left out",
            ExportWarning,
            stacklevel=3,
        )
    return visible


def names_of(scene: Scene, reserved: Collection[str] = ()) -> list[str]:
    """Return a folder name for each bundle. It is derived from the name of the bundle's
    file. Reserved names are not used."""
    stems = [beside(bundle.path or "bundle").stem[:80] for bundle in scene.bundles]
    return distinct([_OTHER_LETTERS.sub("_", stem) for stem in stems], reserved)


def distinct(names: Iterable[str], reserved: Collection[str] = ()) -> list[str]:
    """Return distinct names. A number is appended to each name that is reserved, or
    that equals an earlier one if case is ignored."""
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
    """Return, for each number from 0 to `count` - 1, the ascending indices of the rows
    with that number."""
    order = np.argsort(numbers, kind="stable")
    return np.split(order, np.searchsorted(numbers[order], np.arange(count + 1)))[1:-1]


def detail_of(bundle: Bundle) -> dict[str, float]:
    """Return the distances from which on levels are fine enough. For level 1, the
    distance is `reach` times the focal length in px, divided by √tolerance.

    For each further level, the distance is `ratio` times that of the level before.
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
    # The engine of the web page accepts no smaller ratio.
    return {"reach": reach[0], "ratio": max(ratio, 1.2)}


def write_document(path: Path, document: Mapping[str, object]) -> None:
    """Write JSON without spaces. The file need not be replaced atomically, because its
    folder is moved to its final place later."""
    path.write_text(json.dumps(document, separators=(",", ":")), encoding="utf-8")


def write_page(folder: Path, name: str) -> None:
    """Write the web page of an export, which is a copy of the package's file with this
    name."""
    (folder / "index.html").write_bytes(files("v3dg.export").joinpath(name).read_bytes())


def bytes_below(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
