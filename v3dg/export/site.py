"""A scene as a web page: every bundle once as streamed SOG, instances, cameras, and a page that draws them.

The page needs nothing but a static server and PlayCanvas's engine, one file of its npm package.
"""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._numbers import check
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, Floats
from v3dg.cleaning import ball_of_most
from v3dg.export._common import (
    Axis,
    bytes_below,
    replacing_folder,
    rotation_to,
    turn_upright,
    write_document,
)
from v3dg.export.streamed_sog import DEFAULT_CHUNK, INDEX, Plan, write_levels
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

SITE = "site.json"
ENGINE = "playcanvas.min.mjs"
ENGINE_VERSION = "2.23.3"
"""Of PlayCanvas's engine, with which the page is tested."""


@dataclass(frozen=True)
class Site:
    """What was written.

    Attributes:
        bundles: Bundles, each of them once.
        instances: Instances of them.
        gaussians: Of the finest level, of all instances.
        coarsest: Of the coarsest level, of all instances: the least that a viewer can come down to.
        bytes: Of all files.
        has_engine: Whether PlayCanvas's engine is beside the page.
    """

    bundles: int
    instances: int
    gaussians: int
    coarsest: int
    bytes: int
    has_engine: bool


def write_site(
    subject: Scene | Bundle,
    folder: str | os.PathLike[str],
    cameras: Mapping[str, Camera] | None = None,
    *,
    chunk: int = DEFAULT_CHUNK,
    up: Axis | None = None,
    progress: bool = False,
) -> Site:
    """Write a scene or a bundle as a web page, replacing an earlier export once all is written.

    The levels of a bundle alone are in the folder itself, those of a scene's bundles in folders of their own.
    PlayCanvas's engine is taken from an earlier export, or from `node_modules` here or above.

    Args:
        folder: Where to; new, empty, or with an earlier export. Folders above it are made.
        cameras: From where to look, by name; the page begins with the first.
        chunk: As in `write_streamed_sog`.
        up: What is up in the world; z for a scene and -y for a bundle if None.

    Raises:
        ValueError: As `write_streamed_sog`, or a scene without instances.
        OSError: A file cannot be written.
    """
    from tqdm import tqdm

    folder = Path(folder)
    is_scene = isinstance(subject, Scene)
    axis: Axis = up or ("z" if is_scene else "-y")
    # A bundle alone is turned to what viewers take to be up; a scene's stay as its instances have them.
    turn = turn_upright("-y" if is_scene else axis)
    scene = Scene.of(subject)
    check("scene", len(scene), "instances to export, got none")
    plans = [Plan.of(bundle, chunk) for bundle in scene.bundles]
    with replacing_folder(folder) as place:
        total = sum(bundle.num_gaussians for bundle in scene.bundles)
        listed, counts = [], []
        with tqdm(None, "export", total, unit=" gaussians", unit_scale=True, disable=not progress) as bar:
            for name, plan in zip(_names(scene) if is_scene else ["."], plans, strict=True):
                (place / name).mkdir(exist_ok=True)
                done = write_levels(plan, place / name, turn, bar.update)
                index = INDEX if name == "." else f"{name}/{INDEX}"
                listed.append({"url": index, "counts": done.counts, **_detail(plan.bundle)})
                counts.append((done.counts[0], done.counts[-1]))
        document = {
            "version": 1,
            "tolerance": DEFAULT_TOLERANCE,
            "rotation": rotation_to(axis if is_scene else "-y", "y").T.tolist(),  # by columns
            "bundles": listed,
            "instances": _instances(scene),
            "cameras": _cameras(scene, cameras or {}, rotation_to(axis, "y")),
        }
        write_document(place / SITE, document)
        (place / "index.html").write_bytes(files("v3dg.export").joinpath("page.html").read_bytes())
        has_engine = _bring_engine(folder, place)
        size = bytes_below(place)
    finest, coarsest = np.array(counts)[scene.instance_bundle].sum(axis=0).tolist()
    return Site(len(listed), len(scene), finest, coarsest, size, has_engine)


def _names(scene: Scene) -> list[str]:
    """A folder for each bundle, after its file."""
    names: list[str] = []
    for number, bundle in enumerate(scene.bundles):
        stem = Path(bundle.path or "bundle").stem
        name = "".join(c if c.isascii() and c.isalnum() else "_" for c in stem)[:80]
        names.append(f"{name}_{number}" if name in names else name)
    return names


def _detail(bundle: Bundle) -> dict[str, float]:
    """How far levels reach: `reach` times focal length in px over √tolerance is where level 1 is enough.

    Each further level is enough from `ratio` times the distance of the one before it.
    """
    groups = bundle.groups
    radius = groups.ball[:, 3].astype(np.float64) * np.sqrt(math.pi * groups.weight.astype(np.float64))
    levels = range(1, bundle.num_levels)
    reach = [float(np.median(radius[groups.level == level])) for level in levels]
    if not reach:
        return {"reach": 0.0, "ratio": math.sqrt(2)}
    ratio = (reach[-1] / reach[0]) ** (1 / max(1, len(reach) - 1))
    return {"reach": reach[0], "ratio": max(ratio, 1.2)}  # the engine takes no less


def _instances(scene: Scene) -> dict[str, list[Any]]:
    """Columns, in a few digits more than float32 has."""

    def short(values: NDArray[np.floating[Any]]) -> list[float]:
        return [float(f"{value:.9g}") for value in values.ravel().tolist()]

    return {
        "bundle": scene.instance_bundle.tolist(),
        "positions": short(scene.positions),
        "quaternions": short(scene.quaternions),
        "scales": short(scene.scales),
        "importance": short(scene.importance),
    }


def _cameras(scene: Scene, cameras: Mapping[str, Camera], world: Floats) -> list[dict[str, Any]]:
    """Cameras as the page takes them: x right, y up, z backward, in a world with y up."""
    centre, radius = _ball(scene)
    if not cameras:
        height = math.tan(math.radians(25.0))
        eye = centre + (world.T @ [0.4, 0.4, 0.8]) / 0.98 * radius * 1.2 / math.sin(math.atan(height))
        up = world.T @ [0.0, 1.0, 0.0]
        cameras = {"start": Camera.look_at(eye, centre, up, 2 * math.atan(height), width=800, height=800)}
    found = []
    for name, camera in cameras.items():
        axes = world @ camera.viewmat[:3, :3].T @ np.diag([1.0, -1.0, -1.0])
        position = world @ camera.position
        distance = max(float(np.linalg.norm(camera.position - centre)), 1e-3 * radius)
        found.append(
            {
                "name": name,
                "position": position.tolist(),
                "axes": axes.T.tolist(),
                "fov": math.degrees(2 * math.atan(camera.height / 2 / camera.fy)),
                "distance": distance,
                "near": max(camera.near, 1e-4 * distance),
                "far": 4 * (distance + radius),
            }
        )
    return found


def _ball(scene: Scene) -> tuple[NDArray[np.floating[Any]], float]:
    """Around nearly all that there is, in the world before it is turned upright."""
    of_bundle = []
    for bundle in scene.bundles:
        centre, radius = ball_of_most(bundle.level_gaussians(bundle.num_levels - 1).means.astype(np.float64))
        of_bundle.append([*centre, radius])
    balls = np.array(of_bundle)[scene.instance_bundle]
    rotated = np.einsum("nij,nj->ni", scene.rotations, balls[:, :3] * scene.scales[:, None])
    centres, reach = scene.positions + rotated, balls[:, 3:] * scene.scales[:, None]
    return ball_of_most(np.concatenate([centres - reach, centres + reach]))


def _bring_engine(folder: Path, place: Path) -> bool:
    """Copy PlayCanvas's engine beside the page, where npm or somebody else has put it."""
    here = Path.cwd()
    modules = [parent / "node_modules" / "playcanvas" / "build" for parent in (here, *here.parents)]
    found = next((file for file in (d / ENGINE for d in (folder, *modules)) if file.is_file()), None)
    if found is not None:
        with _files.naming_errors(found):
            shutil.copyfile(found, place / ENGINE)
    return found is not None
