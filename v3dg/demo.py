"""A demonstration without a download: it builds a bundle, places it 2,000 times, and
draws it from near to far.

The result is one picture with a column per distance: the full asset above, the selected
cut below. Every panel states the number of gaussians, the time, and the error against
the full asset at twice the resolution.
"""

import math
import os
import time
from typing import NamedTuple

from v3dg import _device
from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._progress import Progress, counted
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.donut import make_donut, place_field
from v3dg.levels import build_bundle
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, check_picture_path, contact_sheet, to_8bit, write_picture
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

# Distance from the eye to the central donut, in radii of a donut, and elevation in
# radians.
VIEWS = ((3.3, 0.36), (8.0, 0.36), (20.0, 0.36), (46.0, 0.38), (95.0, 0.42))
_AZIMUTH = 0.80  # radians; the sun is then behind the camera
_SKY = (0.6, 0.73, 0.85)


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
) -> JsonObject:
    """Make an asset, build and place it, draw and measure it at every distance, and
    write the picture.

    Args:
        num_gaussians: Number of gaussians in the asset.
        size: Width and height of one panel in px.
        views: Distance and elevation of every column.
        device: The device that builds and draws: "auto", "cpu" or "cuda".

    Returns:
        Sizes, times and errors, as JSON values.

    Raises:
        ValueError: The picture cannot be written to ``output``, or an argument is out
            of range.
    """
    path = check_picture_path(output)
    chosen_device = _device.resolve(device)
    start = time.perf_counter()
    asset = make_donut(num_gaussians, seed=seed)
    bundle = build_bundle(asset, seed=seed, progress=progress, device=chosen_device)
    build_seconds = time.perf_counter() - start
    scene = _field(bundle, instances, seed)
    columns: list[JsonObject] = []
    rows: list[list[tuple[str, Picture]]] = [[], []]
    for distance, elevation in counted(views, len(views), "draw", progress):
        camera = _camera(distance, elevation, size)
        full, selected = _panels(scene, camera, tolerance, chosen_device)
        rows[0].append((f"full, distance {distance:g}: {full.text}", full.picture))
        rows[1].append((f"bundle, distance {distance:g}: {selected.text}", selected.picture))
        columns.append({"distance": distance, "full": full.numbers, "bundle": selected.numbers})
    write_picture(path, contact_sheet(rows))
    return {
        "picture": str(path),
        "asset_gaussians": len(asset),
        "instances": instances,
        "levels": bundle.num_levels,
        "bundle_gaussians": bundle.num_gaussians,
        "tolerance": tolerance,
        "device": str(chosen_device),
        "build_seconds": build_seconds,
        "seconds": time.perf_counter() - start,
        "columns": columns,
    }


def _field(bundle: Bundle, count: int, seed: int) -> Scene:
    positions, quaternions, scales = place_field(count, seed=seed)
    scene = Scene()
    scene.add(bundle, positions=positions, quaternions=quaternions, scales=scales)
    return scene


def _camera(distance: float, elevation: float, size: tuple[int, int]) -> Camera:
    """Return a camera that looks at the middle of the field: at one donut from near, at
    the whole hill from far."""
    horizontal = distance * math.cos(elevation)
    target = 0.42 / (1 + (distance / 12) ** 2)
    x = math.sin(_AZIMUTH) * horizontal
    y = -math.cos(_AZIMUTH) * horizontal
    z = distance * math.sin(elevation)
    return Camera.look_at((x, y, target + z), (0, 0, target), width=size[0], height=size[1])


class _Panel(NamedTuple):
    """One panel of the result, with its measurements."""

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
