"""Measures whether frames are faster if neighbouring rows of a cluster are also
neighbours in space.

    python -m benchmarks.studies.row_order --asset donut.ply --layout donutsea.json \\
        --device cuda -o row_order_h100.json

The study builds an asset whose clusters keep the order of the asset, and a copy whose
rows are ordered in runs. For both orders it measures the mean diagonal of the box
around 32 consecutive rows; the time of frames of the layout, in alternation, for each
camera and tolerance; and on CUDA the time of each kernel. Builds with and without runs
are also timed in alternation.
"""

from __future__ import annotations

import itertools
import statistics
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal
from unittest import mock

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.levels import simplify
from v3dg.levels.plan import Offsets
from v3dg.levels.rows import RUN_ROWS, in_runs

Row = dict[str, Any]
_LEVELS = range(5)


@dataclass
class Config:
    asset: Path
    """Asset, in any format that v3dg reads."""
    layout: Path
    """Layout of instances of that asset."""
    cameras: tuple[int, ...] = (40, 45, 46, 50, 55, 59)
    """Indices of cameras of the layout."""
    tolerances: tuple[float, ...] = (9.4, 3.0)
    device: Literal["cpu", "cuda"] = "cpu"
    refine: int = 0
    """Number of pictures of a refinement before the comparison; 0 for none."""
    frames: int = 25
    builds: int = 0
    """Number of timed builds of each kind."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results."""


def as_they_come(gaussians: Gaussians, offset: Offsets) -> Gaussians:
    return gaussians


def built(asset: Gaussians, device: str, *, is_ordered: bool) -> v3dg.Bundle:
    order = as_they_come
    if is_ordered:
        order = in_runs
    with mock.patch.object(simplify, "in_runs", order):
        return v3dg.build_bundle(asset, device=device, progress=False, quality="draft")


def ordered(bundle: v3dg.Bundle) -> v3dg.Bundle:
    """Return the same clusters with their rows in runs."""
    gaussians = in_runs(bundle.gaussians, bundle.clusters.offset)
    return v3dg.Bundle(bundle.clusters, bundle.groups, gaussians, bundle.config)


def refined(bundle: v3dg.Bundle, config: Config) -> v3dg.Bundle:
    """Return refined levels whose rows keep their order."""
    from v3dg.levels import refined as refinement

    with mock.patch.object(refinement, "in_runs", as_they_come):
        return v3dg.refine_bundle(bundle, steps=config.refine, device=config.device, progress=False)


def diagonals(bundle: v3dg.Bundle) -> Row:
    """Return the mean diagonal of the boxes around full runs for each level, and of the
    boxes around clusters."""
    means = bundle.gaussians.means
    rows = {}
    for level in _LEVELS:
        of_runs = []
        of_clusters = []
        clusters = bundle.level_range(level)
        offset = bundle.clusters.offset[clusters.start : clusters.stop + 1]
        for first, last in itertools.pairwise(offset.tolist()):
            of_clusters.append(_diagonal(means[first:last]))
            for start in range(first, last - RUN_ROWS + 1, RUN_ROWS):
                of_runs.append(_diagonal(means[start : start + RUN_ROWS]))
        rows[level] = {"run": statistics.fmean(of_runs), "cluster": statistics.fmean(of_clusters)}
    return {f"level {level}": row for level, row in rows.items()}


def _diagonal(means: np.ndarray[Any, Any]) -> float:
    return float(np.linalg.norm(np.ptp(means, axis=0)))


class Drawing:
    """The frames of one order of the rows."""

    def __init__(self, config: Config, bundle: v3dg.Bundle) -> None:
        scene, views = read_layout(config.layout, bundle)
        self.device = config.device
        self.renderer = v3dg.Renderer(scene, device=config.device)
        self.cameras = [list(views.values())[number] for number in config.cameras]

    def frame(self, camera: Camera, tolerance: float) -> tuple[float, float, Any]:
        """Return the wall-clock time of a frame and the CPU time of all threads, in
        milliseconds, and the picture."""
        start = time.perf_counter()
        processors_start = time.process_time()
        image = self.renderer.render(camera, tolerance=tolerance)
        image.stats  # noqa: B018  # waits for the picture
        processors = time.process_time() - processors_start
        return 1e3 * (time.perf_counter() - start), 1e3 * processors, image

    def kernels(self, camera: Camera, tolerance: float) -> dict[str, float]:
        """Return the milliseconds of each kernel of a frame."""
        from benchmarks.studies.frame_kernels import measure

        kernels: dict[str, float] = measure(("", self.renderer, camera, tolerance))["kernels"]
        return kernels


def host(array: Any) -> np.ndarray[Any, Any]:
    if isinstance(array, np.ndarray):
        return array
    return np.asarray(array.detach().cpu().numpy())


def frames(config: Config, drawings: dict[str, Drawing], index: int, tolerance: float) -> Row:
    """Draw frames of one camera with both orders in alternation; return their times."""
    ms: dict[str, list[float]] = {name: [] for name in drawings}
    processor_ms: dict[str, list[float]] = {name: [] for name in drawings}
    pictures = {}
    for _ in range(config.frames + 1):
        for name, drawing in drawings.items():
            wall, processors, image = drawing.frame(drawing.cameras[index], tolerance)
            ms[name].append(wall)
            processor_ms[name].append(processors)
            if name not in pictures:
                pictures[name] = np.array(host(image.color), np.float64)
                count = image.stats.gaussians_in_frustum
    difference = pictures["runs"] - pictures["asset"]
    row: Row = {
        "camera": config.cameras[index],
        "tolerance": tolerance,
        "gaussians_in_frustum": count,
        "largest_difference": float(np.abs(difference).max()),
        "root_mean_square": float(np.sqrt(np.mean(difference**2))),
    }
    for name in drawings:
        row[f"{name}_ms"] = round(statistics.median(ms[name][1:]), 4)
        row[f"{name}_least_ms"] = round(min(ms[name][1:]), 4)
        row[f"{name}_processor_ms"] = round(statistics.median(processor_ms[name][1:]), 4)
    row["ratio"] = round(
        statistics.median(b / a for a, b in zip(ms["asset"][1:], ms["runs"][1:], strict=True)), 4
    )
    if config.device == "cuda":
        for name, drawing in drawings.items():
            row[f"{name}_kernels"] = drawing.kernels(drawing.cameras[index], tolerance)
    return row


def build_seconds(asset: Gaussians, config: Config) -> Row:
    seconds: dict[str, list[float]] = {"asset": [], "runs": []}
    for _ in range(config.builds):
        for name, times in seconds.items():
            start = time.perf_counter()
            built(asset, config.device, is_ordered=name == "runs")
            times.append(time.perf_counter() - start)
    return {name: [round(t, 4) for t in times] for name, times in seconds.items()}


def main(config: Config) -> None:
    asset = replace(v3dg.read_asset(config.asset))
    bundle = built(asset, config.device, is_ordered=False)
    if config.refine > 0:
        bundle = refined(bundle, config)
    bundles = {"asset": bundle, "runs": ordered(bundle)}
    result: Row = {"refine": config.refine, "rows": []}
    result["diagonals"] = {name: diagonals(b) for name, b in bundles.items()}
    print(result["diagonals"], flush=True)
    if config.builds > 0:
        result["build_seconds"] = build_seconds(asset, config)
        print(result["build_seconds"], flush=True)
    drawings = {name: Drawing(config, b) for name, b in bundles.items()}
    for tolerance in config.tolerances:
        for index in range(len(config.cameras)):
            row = frames(config, drawings, index, tolerance)
            print(row, flush=True)
            result["rows"].append(row)
            record.write(config.output, result, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config))
