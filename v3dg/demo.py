"""The main job without a download: build a bundle, place it 2,000 times, draw it from near to far.

The result is one picture: the full asset above, the selected cut below, a column a distance, each with the
gaussians drawn, the time, and the error to the full asset at twice the resolution.
"""

import math
import os
import time
from typing import Any

from v3dg import _device
from v3dg._device import Device
from v3dg._progress import Progress, counted
from v3dg.build import build_bundle
from v3dg.cameras import Camera
from v3dg.donut import make_donut, place_field
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, check_picture_path, contact_sheet, to_8bit, write_picture
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

# Distance from the eye to the donut in the middle, in radii of a donut, and height of the view in radians.
VIEWS = ((3.3, 0.36), (8.0, 0.36), (20.0, 0.36), (46.0, 0.38), (95.0, 0.42))
_AZIMUTH = 0.80  # rad; the sun is then behind the camera
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
) -> dict[str, Any]:
    """Make an asset, build and place it, draw and measure every distance, and write the picture.

    Args:
        num_gaussians: Of the asset.
        size: Width and height of one panel in px.
        views: Distance and elevation of every column.
        device: Where to build and draw: "auto", "cpu" or "cuda".

    Returns:
        What was made and measured, as JSON values.

    Raises:
        ValueError: The picture cannot be written to ``output``, or an argument is out of range.
    """
    path = check_picture_path(output)
    where = _device.resolve(device)
    start = time.perf_counter()
    asset = make_donut(num_gaussians, seed=seed)
    bundle = build_bundle(asset, seed=seed, progress=progress, device=where)
    build_seconds = time.perf_counter() - start
    positions, quaternions, scales = place_field(instances, seed=seed)
    scene = Scene()
    scene.add(bundle, positions=positions, quaternions=quaternions, scales=scales)
    columns: list[dict[str, Any]] = []
    rows: tuple[list[tuple[str, Picture]], ...] = ([], [])
    for distance, elevation in counted(views, len(views), "draw", progress):
        # Of the middle of the field: from near a donut, from far the whole hill.
        across, target = distance * math.cos(elevation), 0.42 / (1 + (distance / 12) ** 2)
        x, y, z = math.sin(_AZIMUTH) * across, -math.cos(_AZIMUTH) * across, distance * math.sin(elevation)
        camera = Camera.look_at((x, y, target + z), (0, 0, target), width=size[0], height=size[1])
        truth = draw_truth(scene, camera, where, background=_SKY)
        columns.append({"distance": distance})
        for name, row, px2 in (("full", rows[0], 0.0), ("bundle", rows[1], tolerance)):
            columns[-1][name], text, picture = _drawn(scene, camera, px2, truth, where)
            row.append((f"{name}, distance {distance:g}: {text}", picture))
    write_picture(path, contact_sheet(rows))
    result = {"picture": str(path), "asset_gaussians": len(asset), "instances": instances}
    result |= {"levels": bundle.num_levels, "bundle_gaussians": bundle.num_gaussians}
    result |= {"tolerance": tolerance, "device": str(where), "build_seconds": build_seconds}
    return result | {"seconds": time.perf_counter() - start, "columns": columns}


def _drawn(
    scene: Scene, camera: Camera, tolerance: float, truth: Picture, device: Device
) -> tuple[dict[str, Any], str, Picture]:
    """Numbers and text of one picture, and the picture."""
    image = render(scene, camera, tolerance=tolerance, background=_SKY, device=device)
    picture, stats = to_8bit(image.color), image.stats
    numbers = {name: getattr(stats, name) for name in ("gaussians_selected", "select_ms", "draw_ms")}
    numbers |= {"gaussians": stats.gaussians_in_frustum, **errors_of(truth, picture)}
    name = "SSIM" if numbers["flip"] is None else "FLIP"
    cost = f"{stats.gaussians_in_frustum:,} gaussians, {stats.select_ms + stats.draw_ms:,.0f} ms"
    return numbers, f"{cost}, {name} {numbers[name.lower()]:.3f}", picture
