"""The time of a frame on a CPU, for several bundles of one asset.

    taskset -c 0,1 python -m benchmarks.studies.cpu_frames \\
        --layout donutsea.json --bundles draft.v3dg standard.v3dg -o cpu_frames

Each bundle has a renderer, and the renderers draw one camera by turns. The times are
milliseconds of the frames after the first; the least, and the median. The time of the
processor, of all threads together, depends less on what else the machine does.
"""

from __future__ import annotations

import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg._json import JsonObject
from v3dg.cameras import Camera


@dataclass
class Config:
    layout: Path
    bundles: tuple[Path, ...]
    """Bundles of the layout's asset."""
    camera: int = 59
    """Index of a camera of the layout."""
    tolerance: float = v3dg.DEFAULT_TOLERANCE
    repeats: int = 6
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


@dataclass
class Subject:
    """A renderer, and the times and the size of its frames."""

    name: str
    renderer: v3dg.Renderer
    camera: Camera
    milliseconds: list[float]
    processor_milliseconds: list[float]
    num_gaussians: int = 0

    def draw(self, tolerance: float) -> None:
        start = time.perf_counter()
        processor_start = time.process_time()
        image = self.renderer.render(self.camera, tolerance=tolerance)
        self.num_gaussians = image.stats.gaussians_in_frustum
        self.processor_milliseconds.append(1e3 * (time.process_time() - processor_start))
        self.milliseconds.append(1e3 * (time.perf_counter() - start))


def subject_of(config: Config, bundle: Path) -> Subject:
    scene, cameras = read_layout(config.layout, v3dg.Bundle.open(bundle))
    camera = list(cameras.values())[config.camera]
    return Subject(bundle.name, v3dg.Renderer(scene, device="cpu"), camera, [], [])


def main(config: Config) -> None:
    subjects = [subject_of(config, bundle) for bundle in config.bundles]
    for _ in range(1 + config.repeats):
        for subject in subjects:
            subject.draw(config.tolerance)
    rows: list[JsonObject] = []
    for subject in subjects:
        times = subject.milliseconds[1:]
        row: JsonObject = {"bundle": subject.name, "camera": config.camera}
        row["tolerance"] = config.tolerance
        row["gaussians_in_frustum"] = subject.num_gaussians
        row["least_ms"] = round(min(times), 1)
        row["median_ms"] = round(statistics.median(times), 1)
        processor_times = subject.processor_milliseconds[1:]
        row["least_processor_ms"] = round(min(processor_times), 1)
        row["median_processor_ms"] = round(statistics.median(processor_times), 1)
        rows.append(row)
        print(row, flush=True)
    record.write(config.output, {"rows": rows})


if __name__ == "__main__":
    main(tyro.cli(Config))
