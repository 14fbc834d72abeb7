"""A demonstration that needs no data: it builds a bundle, places 2,000 instances, and
draws them at several distances.

The result is one picture with a column for each distance. The upper row shows the full
asset, and the lower row the selected cut. Every panel shows the number of gaussians,
the time, and the error compared with the full asset at twice the resolution.
"""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from v3dg import _device, _files
from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import check
from v3dg._progress import Progress, counted
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.donut import make_donut, place_field
from v3dg.gaussians import Gaussians
from v3dg.io import write_asset
from v3dg.levels import build_bundle
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, check_picture_path, contact_sheet, to_8bit, write_picture
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.scene.file import write_scene
from v3dg.select import DEFAULT_TOLERANCE

# For each column: the distance from the eye to the central donut, in radii of a donut,
# and the elevation in radians.
VIEWS = ((3.3, 0.36), (8.0, 0.36), (20.0, 0.36), (46.0, 0.38), (95.0, 0.42))
_AZIMUTH = 0.80  # radians; the sun is behind the camera
_SKY = (0.6, 0.73, 0.85)


def _output(path: str | os.PathLike[str]) -> Path:
    """Return the path of the picture, after creating its folder."""
    output = check_picture_path(path)
    _files.make_folder(output)
    return output


def run_demo(
    output: str | os.PathLike[str] = "v3dg_demo.png",
    *,
    num_gaussians: int = 50_000,
    instances: int = 2000,
    size: tuple[int, int] = (380, 440),
    tolerance: float = DEFAULT_TOLERANCE,
    seed: int = 0,
    views: tuple[tuple[float, float], ...] = VIEWS,
    progress: Progress = True,
    device: str = "auto",
    keep: str | os.PathLike[str] | None = None,
) -> JsonObject:
    """Make an asset, build its bundle, place instances, draw and measure them at every
    distance, and write the picture.

    Args:
        num_gaussians: Number of gaussians in the asset.
        size: Width and height of one panel in px.
        views: Distance and elevation for each column, as in `VIEWS`.
        device: The device that builds and draws: "auto", "cpu" or "cuda".
        keep: Folder for the asset, its bundle, and the scene with the cameras of the
            columns. It is created if needed. With None, these files are not stored.

    Returns:
        Sizes, times and errors as a JSON object.

    Raises:
        ValueError: The picture cannot be written to ``output``, or an argument is out
            of range.
    """
    path = _output(output)
    files = _Files.new(keep)
    chosen_device = _device.resolve(device)
    start = time.perf_counter()
    asset = make_donut(num_gaussians, seed=seed)
    bundle = build_bundle(asset, seed=seed, progress=progress, device=chosen_device)
    build_seconds = time.perf_counter() - start
    scene = _field(bundle, instances, seed)
    if files is not None:
        scene = files.write(asset, scene, views, size)
    panels = []
    for camera in counted(_cameras(views, size), len(views), "draw", progress):
        panels.append(_panels(scene, camera, tolerance, chosen_device))
    write_picture(path, contact_sheet(_rows(views, panels)))
    return {
        "picture": str(path),
        "kept": list(map(str, files or ())),
        "asset_gaussians": len(asset),
        "instances": instances,
        "levels": bundle.num_levels,
        "bundle_gaussians": bundle.num_gaussians,
        "tolerance": tolerance,
        "device": str(chosen_device),
        "build_seconds": build_seconds,
        "seconds": time.perf_counter() - start,
        "columns": _columns(views, panels),
    }


def _columns(
    views: Sequence[tuple[float, float]], panels: Sequence[tuple["_Panel", "_Panel"]]
) -> list[JsonObject]:
    columns: list[JsonObject] = []
    for (distance, _), (full, selected) in zip(views, panels, strict=True):
        columns.append({"distance": distance, "full": full.numbers, "bundle": selected.numbers})
    return columns


def _rows(
    views: Sequence[tuple[float, float]], panels: Sequence[tuple["_Panel", "_Panel"]]
) -> list[list[tuple[str, Picture]]]:
    """Return the rows of the picture: the full asset above, the selected cut below."""
    rows: list[list[tuple[str, Picture]]] = [[], []]
    for (distance, _), pair in zip(views, panels, strict=True):
        for row, kind, panel in zip(rows, ("full", "bundle"), pair, strict=True):
            row.append((f"{kind}, distance {distance:g}: {panel.text}", panel.picture))
    return rows


def _cameras(views: Sequence[tuple[float, float]], size: tuple[int, int]) -> list[Camera]:
    """Return the cameras of the columns."""
    return [_camera(distance, elevation, size) for distance, elevation in views]


class _Files(NamedTuple):
    """The files that are kept."""

    asset: Path
    bundle: Path
    scene: Path

    @classmethod
    def new(cls, keep: str | os.PathLike[str] | None) -> "_Files | None":
        """Create a folder, and return the paths of its files. The files must not exist
        yet. Return None if `keep` is None."""
        if keep is None:
            return None
        folder = Path(keep)
        files = cls(folder / "donut.ply", folder / "donut.v3dg", folder / "donuts.json")
        for file in files:
            check(
                file,
                not os.path.lexists(file),
                "a new file, got an existing one; remove it or choose another folder",
            )
        _files.make_folder(files.asset)
        return files

    def write(
        self,
        asset: Gaussians,
        scene: Scene,
        views: Sequence[tuple[float, float]],
        size: tuple[int, int],
    ) -> Scene:
        """Write the asset, its bundle, and the scene with the cameras of the columns.
        Return the scene that is described by the file."""
        write_asset(self.asset, asset)
        scene.bundles[0].write(self.bundle)
        placed = Scene()
        placed.add(
            Bundle.open(self.bundle),
            positions=scene.positions,
            quaternions=scene.quaternions,
            scales=scene.scales,
        )
        cameras = {}
        for number, (camera, (distance, _)) in enumerate(
            zip(_cameras(views, size), views, strict=True)
        ):
            cameras[f"{number}, distance {distance:g}"] = camera
        write_scene(self.scene, placed, cameras=cameras)
        return placed


def _field(bundle: Bundle, count: int, seed: int) -> Scene:
    positions, quaternions, scales = place_field(count, seed=seed)
    scene = Scene()
    scene.add(bundle, positions=positions, quaternions=quaternions, scales=scales)
    return scene


def _camera(distance: float, elevation: float, size: tuple[int, int]) -> Camera:
    """Return a camera that looks at the middle of the field. From a small distance it
    sees one donut, and from a large one the whole hill."""
    horizontal = distance * math.cos(elevation)
    target = 0.42 / (1 + (distance / 12) ** 2)
    x = math.sin(_AZIMUTH) * horizontal
    y = -math.cos(_AZIMUTH) * horizontal
    z = distance * math.sin(elevation)
    return Camera.look_at((x, y, target + z), (0, 0, target), width=size[0], height=size[1])


class _Panel(NamedTuple):
    """A panel of the picture, with its measurements."""

    numbers: JsonObject
    text: str
    picture: Picture


def _panels(
    scene: Scene, camera: Camera, tolerance: float, device: Device
) -> tuple[_Panel, _Panel]:
    """Return the pictures of the full asset and of the selected cut."""
    truth = draw_truth(scene, camera, device, background=_SKY)
    full = _drawn(scene, camera, 0.0, truth, device)
    selected = _drawn(scene, camera, tolerance, truth, device)
    return full, selected


def _drawn(
    scene: Scene, camera: Camera, tolerance: float, truth: Picture, device: Device
) -> _Panel:
    image = render(scene, camera, tolerance=tolerance, background=_SKY, device=device)
    picture = to_8bit(image.color)
    stats = image.stats
    errors = errors_of(truth, picture)
    numbers = {
        "gaussians_selected": stats.gaussians_selected,
        "select_ms": stats.select_ms,
        "draw_ms": stats.draw_ms,
        "gaussians": stats.gaussians_in_frustum,
        **errors,
    }
    name = "FLIP"
    if errors["flip"] is None:
        name = "SSIM"
    cost = f"{stats.gaussians_in_frustum:,} gaussians, {stats.select_ms + stats.draw_ms:,.0f} ms"
    return _Panel(numbers, f"{cost}, {name} {errors[name.lower()]:.3f}", picture)
