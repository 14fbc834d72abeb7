"""Exports a scene as a web page: each bundle as streamed SOG, the instances, cameras,
and a page that draws them.

The page only needs a static web server and PlayCanvas's engine, which is one file of
its npm package.
"""

import math
import os
import shutil
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from v3dg import _files
from v3dg._numbers import check
from v3dg._progress import Bar, Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Axis, Camera, Floats
from v3dg.export import _common
from v3dg.export._folder import NewFiles, replacing_export
from v3dg.export.streamed_sog import DEFAULT_CHUNK, INDEX, SETTINGS, Export, Plan, write_levels
from v3dg.framing import frame_subject
from v3dg.opening import File
from v3dg.rotations import turn_upright
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.upright import direction_of, up_of

SITE = "site.json"
ENGINE = "playcanvas.min.mjs"
# Aspect ratios of windows for which first views are computed.
_START_ASPECTS = (0.4, 0.5, 0.6, 0.75, 1.0, 4 / 3, 16 / 9, 2.4)
SITE_NEEDS = "npm install playcanvas@2.23.3", f"cp node_modules/playcanvas/build/{ENGINE} {{}}/"
"""Commands that put PlayCanvas's engine into a folder, in the version with which the
page is tested."""


@dataclass(frozen=True)
class Site:
    """A finished export.

    Attributes:
        bundles: Number of distinct bundles.
        instances: Number of instances.
        gaussians: Number of gaussians in the finest level of all instances together.
        coarsest: Number of gaussians in the coarsest level of all instances together:
            the fewest that a viewer can draw.
        bytes: Total size of the written files.
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
    """Write a scene or a bundle as a web page. The files of an earlier export are
    replaced when all new files are complete.

    The levels of a single bundle are written to the folder itself, and those of a
    scene's bundles to one subfolder each. Opacity and tint of instances are left out
    with a warning. If PlayCanvas's engine is not in the folder yet, it is copied from
    `node_modules` in the working directory or above.

    Args:
        subject: A scene or a bundle, or the path of its file. The file of a scene may
            also contain cameras.
        folder: The folder to write. It may be new, empty, or contain an earlier export.
            Missing parent folders are created. `v3dg-export.json` in it lists the
            written files, and only those are replaced or removed by a later export.
        cameras: Cameras that the page offers, by name. The page starts with the first
            one.
        chunk: See `write_streamed_sog`.
        up: The axis that points up in the world; None uses the axis of
            `v3dg.upright.up_of`.
        progress: See `v3dg.build_bundle`.
        overwrite: See `write_streamed_sog`.

    Raises:
        TypeError: `cameras` is not a mapping from names to cameras.
        ValueError: The scene has no instances; or see `write_streamed_sog`.
        RuntimeError: Another export is using the folder.
        OSError: A file cannot be written.
    """
    content, cameras = _common.opened_with_cameras(subject, Path(folder), cameras)
    scene = Scene.of(content)  # rejects anything else
    scene = _common.exported(scene, "the web page")
    is_scene = isinstance(content, Scene)
    axes = _axes(up or up_of(content, cameras)[0], is_scene=is_scene)
    turn = turn_upright(axes.asset)
    check("scene", len(scene), "at least one instance to export, got none; add an instance")
    plans = [Plan.of(bundle, chunk) for bundle in scene.bundles]
    names = ["."]
    certain = [SITE, "index.html", INDEX, SETTINGS]
    if is_scene:
        names = _common.names_of(scene)
        certain = [SITE, "index.html"]
    with replacing_export(Path(folder), scene, certain, overwrite=overwrite) as new:
        levels = _write_bundles(plans, names, new.path, turn, progress)
        bundles = list(map(_bundle, names, plans, levels))
        _common.write_document(new.path / SITE, _document(scene, bundles, axes, cameras))
        _common.write_page(new.path, "site.html")
        has_engine = _bring_engine(Path(folder), new)
        num_bytes = _common.bytes_below(new.path)
    counts = np.array([(export.counts[0], export.counts[-1]) for export in levels])
    finest, coarsest = counts[scene.instance_bundle].sum(axis=0).tolist()
    return Site(len(levels), len(scene), finest, coarsest, num_bytes, has_engine)


class _Axes(NamedTuple):
    """The axes that point up."""

    asset: Axis  # up in the asset, which is rotated so that this axis becomes -y
    files: Axis  # up in the world of the written files, after that rotation
    cameras: Axis


def _axes(up: Axis, *, is_scene: bool) -> _Axes:
    """Return the up axes. A single bundle is rotated to the up axis that viewers
    expect. The bundles of a scene are not rotated, because its instances place them."""
    if is_scene:
        return _Axes(asset="-y", files=up, cameras=up)
    return _Axes(asset=up, files="-y", cameras=up)


def _write_bundles(
    plans: list[Plan], names: list[str], folder: Path, turn: Floats, progress: Progress
) -> list[Export]:
    """Write the levels of each bundle to the folder with its name, which is created
    unless it is `.`."""
    levels: list[Export] = []
    with Bar(sum(plan.num_gaussians for plan in plans), "export", progress) as bar:
        for name, plan in zip(names, plans, strict=True):
            (folder / name).mkdir(exist_ok=True)
            levels.append(write_levels(plan, folder / name, turn, bar.update))
    return levels


def _document(
    scene: Scene, bundles: list[dict[str, object]], axes: _Axes, cameras: Mapping[str, Camera]
) -> dict[str, object]:
    """Return the document that the page loads first."""
    return {
        "version": 1,
        "tolerance": DEFAULT_TOLERANCE,
        # Rotations, column by column, from the worlds of the files and of the cameras
        # to a world with y up.
        "rotation": _common.rotation_to(axes.files, "y").T.tolist(),
        "camera_rotation": _common.rotation_to(axes.cameras, "y").T.tolist(),
        "bundles": bundles,
        "instances": _instances(scene),
        "cameras": [_camera(name, camera) for name, camera in cameras.items()],
        "start": _start_views(scene, axes.cameras),
    }


def _start_views(scene: Scene, up: Axis) -> list[dict[str, object]]:
    """Return the first views for a page without cameras, for windows from narrow to
    wide."""
    framing = frame_subject(scene)
    views = []
    for aspect in _START_ASPECTS:
        camera = framing.camera(direction_of(up), round(1000 * aspect), 1000)
        views.append({"aspect": aspect, **_camera("start", camera)})
    return views


def _bundle(name: str, plan: Plan, levels: Export) -> dict[str, object]:
    url = INDEX
    if name != ".":
        url = f"{name}/{INDEX}"
    detail = _common.detail_of(plan.bundle)
    if plan.bundle.num_levels == 1:
        detail["reach"] = _reach_of_half(plan.bundle)
    return {"url": url, "counts": levels.counts, **detail}


def _reach_of_half(bundle: Bundle) -> float:
    """Return the `reach` of `detail_of` for a bundle of one level, whose single chunk
    is halved."""
    corners = bundle.clusters.box[np.diff(bundle.clusters.offset) > 0].reshape(-1, 3)
    radius = float(np.linalg.norm(corners.max(axis=0) - corners.min(axis=0))) / 2
    return radius * math.sqrt(math.pi * 2 / (bundle.num_gaussians + 1))


def _instances(scene: Scene) -> dict[str, list[int] | list[float]]:
    """Return the columns of the instances, with nine significant digits: float32 needs
    no more."""
    columns: dict[str, list[int] | list[float]] = {"bundle": scene.instance_bundle.tolist()}
    for name in ("positions", "quaternions", "scales", "importance"):
        values = getattr(scene, name).ravel().tolist()
        columns[name] = [float(f"{value:.9g}") for value in values]
    return columns


def _camera(name: str, camera: Camera) -> dict[str, object]:
    return {
        "name": name,
        "position": camera.position.tolist(),
        "axes": camera.viewmat[:3, :3].tolist(),  # right, down, forward
        "fov_y": 2 * math.atan(camera.height / 2 / camera.fy),
        "near": camera.near,
    }


def _bring_engine(folder: Path, new: NewFiles) -> bool:
    """Put PlayCanvas's engine beside the page; return whether it was found, in the
    folder or in `node_modules`.

    If an earlier export copied the engine, it becomes part of the new export. If a user
    put it there, it stays.
    """
    present = folder / ENGINE
    if present.is_file() and ENGINE not in new.earlier:
        return True
    start = Path.cwd()
    modules = [
        parent / "node_modules" / "playcanvas" / "build" for parent in (start, *start.parents)
    ]
    for place in (folder, *modules):
        engine = place / ENGINE
        if engine.is_file():
            with _files.naming_errors(engine):
                shutil.copyfile(engine, new.path / ENGINE)
            return True
    return False
