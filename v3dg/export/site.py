"""A scene as a web page: every bundle once as streamed SOG, instances, cameras, and a page that draws them.

The page needs nothing but a static server and PlayCanvas's engine, one file of its npm package.
"""

import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from v3dg import _files
from v3dg._numbers import check
from v3dg._progress import Bar, Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera, check_cameras
from v3dg.export import _common
from v3dg.export._folder import NewFiles, check_outside, replacing_export
from v3dg.export.streamed_sog import DEFAULT_CHUNK, INDEX, SETTINGS, Plan, write_levels
from v3dg.opening import File, open_with_cameras
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.upright import up_of

SITE = "site.json"
ENGINE = "playcanvas.min.mjs"
SITE_NEEDS = "npm install playcanvas@2.23.3", f"cp node_modules/playcanvas/build/{ENGINE} {{}}/"
"""Commands that bring PlayCanvas's engine, in the version that the page is tested with, to a folder."""


@dataclass(frozen=True)
class Site:
    """What was written.

    Attributes:
        bundles: Bundles, each of them once.
        instances: Instances of them.
        gaussians: Of the finest level, of all instances.
        coarsest: Of the coarsest level, of all instances: the least that a viewer can come down to.
        bytes: Of all files that were written.
        has_engine: Whether PlayCanvas's engine is beside the page.
    """

    bundles: int
    instances: int
    gaussians: int
    coarsest: int
    bytes: int
    has_engine: bool


def write_site(
    subject: Scene | Bundle | File,
    folder: str | os.PathLike[str],
    cameras: Mapping[str, Camera] | None = None,
    *,
    chunk: int = DEFAULT_CHUNK,
    up: Axis | None = None,
    progress: Progress = False,
    overwrite: bool = False,
) -> Site:
    """Write a scene or a bundle as a web page, replacing the files of an earlier export once all is written.

    The levels of a bundle alone are in the folder itself, those of a scene's bundles in folders of their own.
    PlayCanvas's engine is that of the folder, or taken from `node_modules` here or above.

    Args:
        subject: Or its file, of which a scene's brings cameras.
        folder: Where to; new, empty, or with an earlier export. Folders above it are made. `v3dg-export.json`
            in it says what was written, and nothing else is replaced or removed.
        cameras: From where to look, by name; the page begins with the first.
        chunk: As in `write_streamed_sog`.
        up: What is up in the world; as `v3dg.upright.up_of` takes it if None.
        progress: As in `v3dg.build_bundle`.
        overwrite: As in `write_streamed_sog`.

    Raises:
        TypeError: Cameras are none, or without names.
        ValueError: As `write_streamed_sog`, or a scene without instances.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.
    """
    if isinstance(subject, str | os.PathLike):
        check_outside(Path(folder), [subject])
        opened: Any
        opened, file_cameras = open_with_cameras(Path(subject))
        cameras = cameras or file_cameras
        return write_site(opened, folder, cameras, chunk=chunk, up=up, progress=progress, overwrite=overwrite)
    check_cameras(cameras := cameras or {})
    folder, is_scene, scene = Path(folder), isinstance(subject, Scene), Scene.of(subject)
    axis = up or up_of(subject, cameras)[0]
    # A bundle alone is turned to what viewers take to be up; a scene's stay as its instances have them.
    turn = _common.turn_upright("-y" if is_scene else axis)
    check("scene", len(scene), "instances to export, got none")
    plans = [Plan.of(bundle, chunk) for bundle in scene.bundles]
    certain = (SITE, "index.html") if is_scene else (SITE, "index.html", INDEX, SETTINGS)
    with replacing_export(folder, scene, certain, overwrite=overwrite) as new:
        place = new.path
        listed, counts = [], []
        with Bar(sum(bundle.num_gaussians for bundle in scene.bundles), "export", progress) as bar:
            for name, plan in zip(_common.names_of(scene) if is_scene else ["."], plans, strict=True):
                (place / name).mkdir(exist_ok=True)
                done = write_levels(plan, place / name, turn, bar.update)
                url = INDEX if name == "." else f"{name}/{INDEX}"
                listed.append({"url": url, "counts": done.counts, **_common.detail_of(plan.bundle)})
                counts.append((done.counts[0], done.counts[-1]))
        document = {
            "version": 1,
            "tolerance": DEFAULT_TOLERANCE,
            # By columns: of the files' world, and of the cameras', to one with y up.
            "rotation": _common.rotation_to(axis if is_scene else "-y", "y").T.tolist(),
            "camera_rotation": _common.rotation_to(axis, "y").T.tolist(),
            "bundles": listed,
            "instances": _instances(scene),
            "cameras": _cameras(cameras),
        }
        _common.write_document(place / SITE, document)
        _common.write_page(place, "site.html")
        has_engine = _bring_engine(folder, new)
        num_bytes = _common.bytes_below(place)
    finest, coarsest = np.array(counts)[scene.instance_bundle].sum(axis=0).tolist()
    return Site(len(listed), len(scene), finest, coarsest, num_bytes, has_engine)


def _instances(scene: Scene) -> dict[str, list[Any]]:
    """Columns, in a few digits more than float32 has."""
    names = ("positions", "quaternions", "scales", "importance")
    columns = {name: getattr(scene, name).ravel().tolist() for name in names}
    short = {name: [float(f"{value:.9g}") for value in values] for name, values in columns.items()}
    return {"bundle": scene.instance_bundle.tolist(), **short}


def _cameras(cameras: Mapping[str, Camera]) -> list[dict[str, Any]]:
    return [
        {
            "name": name,
            "position": camera.position.tolist(),
            "axes": camera.viewmat[:3, :3].tolist(),  # right, down, forward
            "fov_y": 2 * math.atan(camera.height / 2 / camera.fy),
            "near": camera.near,
        }
        for name, camera in cameras.items()
    ]


def _bring_engine(folder: Path, new: NewFiles) -> bool:
    """Have PlayCanvas's engine beside the page, if npm or somebody else has put it anywhere.

    One that an earlier export brought is part of this one, too; one that somebody put there stays.
    """
    present = folder / ENGINE
    if present.is_file() and ENGINE not in new.earlier:
        return True
    start = Path.cwd()
    modules = [parent / "node_modules" / "playcanvas" / "build" for parent in (start, *start.parents)]
    engine = next((file for file in (d / ENGINE for d in (folder, *modules)) if file.is_file()), None)
    if engine is not None:
        with _files.naming_errors(engine):
            shutil.copyfile(engine, new.path / ENGINE)
    return engine is not None
