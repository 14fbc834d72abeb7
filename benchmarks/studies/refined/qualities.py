"""The time and the gain of each quality of a build.

    python -m benchmarks.studies.refined.qualities --donut donut.ply
    --layout donutsea.json --assets statue.sog -o qualities

Assets are the donut, heaps of 11 and of 44 donuts, and named files. Each asset is built
in each quality. FLIP of cuts is compared with that of the draft at equal counts
(steps.py). With a layout of donuts, the study also measures how many gaussians in the
frustum reach the FLIP that the draft has at a tolerance of 9.4 px². It times frames at
the tolerance of the cut, whose pixels stop at the default transmittance and at 0.001.
"""

from __future__ import annotations

import contextlib
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

import v3dg
from benchmarks.studies.pairs.measure import errors
from benchmarks.studies.refined import steps
from benchmarks.studies.refined.worlds import count_at
from v3dg._json import JsonObject
from v3dg._judges import Judges
from v3dg.levels.quality import Quality
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, to_8bit
from v3dg.scene.file import read_scene

Row = JsonObject

_TOLERANCES = (6.0, 9.4, 13.0, 18.0)
_TOLERANCE = 9.4
_STOPPED = (3.0, 9.4)
_STOP = 1e-3


@dataclass
class Config:
    donut: Path
    """The paper's donut, or another asset of its size."""
    layout: Path | None = None
    """A layout of donuts."""
    assets: tuple[Path, ...] = ()
    """Other assets."""
    heaps: tuple[int, ...] = (11, 44)
    """Numbers of donuts in heaps."""
    cameras: tuple[int, ...] = (41, 47, 53, 59)
    """Cameras of the layout."""
    most_for_best: int = 200_000
    """The largest asset that is built in the best quality."""
    seconds: float = 90
    """Time in seconds after which no further asset is begun."""
    device: Literal["cpu", "cuda"] = "cuda"
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


def qualities_of(config: Config, asset: v3dg.Gaussians) -> list[Quality]:
    if len(asset) > config.most_for_best:
        return ["draft", "standard"]
    return ["draft", "standard", "best"]


def built(
    config: Config, asset: v3dg.Gaussians, quality: Quality | None
) -> tuple[v3dg.Bundle, float]:
    """Return the bundle and the seconds of its build."""
    start = time.perf_counter()
    bundle = v3dg.build_bundle(asset, device=config.device, progress=False, quality=quality)
    return bundle, round(time.perf_counter() - start, 3)


def measured(
    config: Config,
    name: str,
    asset: v3dg.Gaussians,
    folder: Path,
    judges: Judges,
    results: steps.Results,
) -> dict[Quality, v3dg.Bundle]:
    """Record the results of one asset; return its bundles by quality."""
    of_steps = steps.Config(config.donut, views=1, device=config.device)
    study = steps.Study(of_steps, name, asset, folder)
    bundles: dict[Quality, v3dg.Bundle] = {}
    flips: dict[Quality, list[float]] = {}
    for quality in qualities_of(config, asset):
        bundles[quality], seconds = built(config, asset, quality)
        flips[quality] = study.flips(bundles[quality], judges)
        row: Row = {"asset": name, "gaussians": len(asset), "quality": quality}
        row["seconds"] = seconds
        row["refined"] = bundles[quality].config.get("refined")
        results.add(row | steps.compared(flips[quality], flips["draft"]))
    return bundles


def scene_of(layout: Path, donut: v3dg.Bundle) -> tuple[v3dg.Scene, dict[str, v3dg.Camera]]:
    """Return the scene of a layout of donuts, and its cameras."""
    name = json.loads(layout.read_text())["asset"]
    return read_scene(layout, bundles={name: donut})


def scene_pictures(
    config: Config, layout: Path, bundles: dict[Quality, v3dg.Bundle]
) -> Iterator[tuple[Row, Picture, Picture]]:
    for camera_number in config.cameras:
        truth: Picture | None = None
        for quality, bundle in bundles.items():
            scene, cameras = scene_of(layout, bundle)
            camera = list(cameras.values())[camera_number]
            if truth is None:
                truth = draw_truth(scene, camera, config.device)
            for tolerance in _TOLERANCES:
                image = v3dg.render(scene, camera, tolerance=tolerance, device=config.device)
                row: Row = {"camera": camera_number, "quality": quality, "tolerance": tolerance}
                row["gaussians"] = image.stats.gaussians_in_frustum
                yield row, truth, to_8bit(image.color)


def compare_scenes(
    config: Config, layout: Path, bundles: dict[Quality, v3dg.Bundle], judges: Judges
) -> Iterator[Row]:
    """Yield, for each quality, the means over the cameras at each tolerance, and the
    number of gaussians that reach the FLIP of the draft."""
    means: dict[tuple[Quality, float], list[Row]] = {}
    pictures = scene_pictures(config, layout, bundles)
    for (labels, _, _), errors_of_picture in judges.measured(pictures, errors):
        row = labels | errors_of_picture
        means.setdefault((row["quality"], row["tolerance"]), []).append(row)
    rows: dict[Quality, list[Row]] = {}
    for (quality, tolerance), of_cameras in means.items():
        row = {"layout": layout.name, "quality": quality, "tolerance": tolerance}
        for name in ("gaussians", "flip"):
            row[name] = statistics.fmean(of_camera[name] for of_camera in of_cameras)
        rows.setdefault(quality, []).append(row)
        yield row
    flip = next(row["flip"] for row in rows["draft"] if row["tolerance"] == _TOLERANCE)
    for quality, of_quality in rows.items():
        count = round(count_at(flip, of_quality))
        yield {"layout": layout.name, "quality": quality, "flip": flip, "gaussians": count}


def frame_times(config: Config, layout: Path, bundle: v3dg.Bundle) -> Iterator[Row]:
    """Yield the times of frames that stop at a thousandth, and by their tolerance, in
    turn."""
    scene, cameras = scene_of(layout, bundle)
    renderer = v3dg.Renderer(scene, device=config.device)
    of_layout = [list(cameras.values())[number] for number in config.cameras]
    for tolerance in _STOPPED:
        times: dict[float | None, list[float]] = {_STOP: [], None: []}
        for repeat in range(8):
            for camera in of_layout:
                for stop, of_stop in times.items():
                    start = time.perf_counter()
                    image = renderer.render(camera, tolerance=tolerance, min_transmittance=stop)
                    image.stats  # noqa: B018  waits for the picture
                    if repeat > 2:
                        of_stop.append(1e3 * (time.perf_counter() - start))
        for stop, of_stop in times.items():
            milliseconds = round(statistics.median(of_stop), 4)
            yield {"tolerance": tolerance, "stop": stop or "by the cut", "ms": milliseconds}


def measure(config: Config, folder: Path, judges: Judges) -> None:
    results = steps.Results(config.output, config.device, config.seconds, {})
    donut = v3dg.read_asset(config.donut)
    built(config, donut, None)  # a build that loads the kernels first
    bundles = measured(config, "donut", donut, folder, judges, results)
    assets = {path.stem: v3dg.read_asset(path) for path in config.assets}
    for count in config.heaps:
        assets[f"heap of {count}"] = steps.heap_of(donut, count)
    for name, asset in assets.items():
        if results.is_over():
            break
        measured(config, name, asset, folder, judges, results)
    if config.layout is not None:
        for row in frame_times(config, config.layout, bundles["draft"]):
            results.add(row)
        for row in compare_scenes(config, config.layout, bundles, judges):
            results.add(row)


def main(config: Config) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Judges()) as judges:
        measure(config, Path(folder), judges)


if __name__ == "__main__":
    main(tyro.cli(Config))
