"""The time and the benefit of ways to refine: windows per step, cuts for each picture
of the asset, step sizes, and numbers of pictures.

    python -m benchmarks.studies.refined.steps --donut donut.ply --old OLD -o steps

Each way refines two assets: a donut, and a heap of eleven donuts that hide each other.
OLD is a folder with the package of an older version, which refines the same bundles
with a third of the steps. Cuts with several fractions of the gaussians are drawn at
several sizes. Their FLIP is compared with the levels as built at equal numbers of
gaussians, and with the other ways of the same run. The most important ways come first;
no way begins after `--seconds`.
"""

from __future__ import annotations

import contextlib
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.studies.pairs.measure import cluster_sizes, cuts_of, errors, weighted
from benchmarks.studies.pairs.subject import Size, Subject
from v3dg import _device
from v3dg._json import JsonObject
from v3dg._judges import Judges
from v3dg.levels.refined import Cuts, RefineSteps, without_unseen
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, to_8bit

Row = JsonObject

_DONUTS = 11
_PERCENTS = (50.0, 12.5, 3.0)
_FACTORS = (0.5, 1.0, 2.0, 4.0)
_WINDOWS = (8, 16)
_OLD_PROGRAM = """
import sys, time
import v3dg
bundle = v3dg.Bundle.open(sys.argv[1])
def refine(steps, drop):
    start = time.perf_counter()
    refined = v3dg.refine_bundle(bundle, steps=steps, drop=drop, device=sys.argv[3], progress=False)
    return refined, time.perf_counter() - start
refine(200, 0.02)
refined, seconds = refine(int(sys.argv[4]), 0.02)
refined.write(sys.argv[2])
print(seconds)
"""


@dataclass
class Config:
    donut: Path
    """The paper's donut, or another asset of about the same size."""
    old: Path | None = None
    """Folder with the compiled package `v3dg` of an older version; by default no older
    version is measured."""
    seconds: float = 140
    assets: tuple[Literal["donut", "heap"], ...] = ("heap", "donut")
    pictures: int = 30_000
    """Number of pictures of a refinement; `share` of a way multiplies it."""
    rate_pictures: int = 4_000
    """Number of pictures from which the time per picture is measured."""
    views: int = 2
    """Number of sides from which cuts are compared."""
    device: Literal["cpu", "cuda"] = "cuda"
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


@dataclass(frozen=True)
class Way:
    """The settings of a refinement that are compared."""

    windows: int = 8
    cuts_per_view: int = 8
    rate: float = 1.0
    """Factor of the default step sizes."""
    share: float = 1.0
    """Factor of the number of pictures."""

    def steps(self) -> RefineSteps:
        return RefineSteps(
            windows=self.windows,
            cuts_per_view=self.cuts_per_view,
            rate=self.rate * RefineSteps.rate,
        )


# The ways in the order of their importance.
_WAYS = (
    Way(),
    Way(cuts_per_view=4),
    Way(windows=16, cuts_per_view=4),
    Way(windows=16, cuts_per_view=4, share=1.5),
    Way(cuts_per_view=2),
    Way(cuts_per_view=4, share=1.5),
    Way(windows=16),
    Way(windows=16, cuts_per_view=2),
    Way(cuts_per_view=4, rate=1.4),
    Way(windows=16, share=1.5),
    Way(share=1.5),
)


def heap_of(donut: v3dg.Gaussians, count: int = _DONUTS) -> v3dg.Gaussians:
    """Return donuts at random positions in a ball, with random rotations."""
    rng = np.random.default_rng(0)
    center = np.median(donut.means, axis=0)
    radius = float(np.quantile(np.linalg.norm(donut.means - center, axis=1), 0.99))
    parts = []
    for _ in range(count):
        outwards = rng.normal(size=3)
        outwards *= (
            2
            * radius
            * (count / _DONUTS) ** (1 / 3)
            * rng.random() ** (1 / 3)
            / np.linalg.norm(outwards)
        )
        parts.append(donut.transform(rng.normal(size=4), outwards, 1.0))
    return v3dg.Gaussians.concatenate(parts)


@dataclass(frozen=True)
class View:
    """A number of gaussians and a picture size, seen from one side."""

    labels: Row
    count: int
    size: Size
    truth: Picture


class Study:
    """One asset with its bundle as built, and the reference pictures for all ways."""

    def __init__(self, config: Config, name: str, asset: v3dg.Gaussians, folder: Path) -> None:
        self.name = name
        self._config = config
        self._device = _device.resolve(config.device)
        v3dg.write_asset(folder / f"{name}.ply", asset)
        subject = Subject(folder, name, {"file": f"{name}.ply", "up": (0, 0, 1)}, config.views)
        start = time.perf_counter()
        self.built = v3dg.build_bundle(asset, device=config.device, progress=False, quality="draft")
        self.build_seconds = time.perf_counter() - start
        self.path = folder / f"{name}.v3dg"
        self.built.write(self.path)
        placed = asset
        if self._device.is_cuda:
            placed = asset.torch("cuda")
        self._views = [
            View(
                {"percent": percent, "factor": factor, "view": number},
                count,
                size,
                draw_truth(placed, size.window, config.device, 4),
            )
            for percent in _PERCENTS
            for count in [round(len(asset) * percent / 100)]
            for factor in _FACTORS
            for number, size in enumerate(subject.sizes(count, factor, 512))
        ]

    def pictures(self, bundle: v3dg.Bundle) -> Iterator[tuple[Row, Picture, Picture]]:
        sizes = cluster_sizes(bundle)
        for view in self._views:
            for cut in cuts_of("cut", bundle, view.size.camera, view.count, sizes):
                image = v3dg.render(
                    cut.subject, view.size.window, device=self._config.device, **cut.cut
                )
                row = {"gaussians": cut.gaussians, "weight": cut.weight}
                row["tolerance"] = cut.cut["tolerance"]
                yield view.labels | row, view.truth, to_8bit(image.color)

    def flips(self, bundle: v3dg.Bundle, judges: Judges) -> list[float]:
        """Return the FLIP at each number of gaussians and size, averaged over the
        views."""
        rows: dict[tuple[float, float], list[Row]] = {}
        for (labels, _, _), measured in judges.measured(self.pictures(bundle), errors):
            row = labels | measured
            rows.setdefault((row["percent"], row["factor"]), []).append(row)
        return [weighted(of_pair)["flip"] for of_pair in rows.values()]

    def milliseconds(self, way: Way) -> float:
        """Return the milliseconds per picture of a refinement that drops no
        gaussians."""
        steps = way.steps()
        self._cuts(self.built).refined(8 * way.windows, steps)
        cuts = self._cuts(self.built)
        start = time.perf_counter()
        cuts.refined(self._config.rate_pictures, steps)
        return 1e3 * (time.perf_counter() - start) / self._config.rate_pictures

    def refined(self, way: Way, num_pictures: int) -> tuple[v3dg.Bundle, Row]:
        """Return the refined bundle, and the seconds of dropping gaussians and of
        moving them."""
        start = time.perf_counter()
        dropped = without_unseen(self.built, [], 0.02, 0, self._device, False)
        after_drop = time.perf_counter()
        cuts = self._cuts(dropped)
        gaussians = cuts.refined(num_pictures, way.steps())
        end = time.perf_counter()
        clusters = dropped.clusters.around(gaussians)
        bundle = v3dg.Bundle(clusters, dropped.groups, gaussians, dropped.config, dropped.codec)
        return bundle, {"drop_seconds": after_drop - start, "move_seconds": end - after_drop}

    def _cuts(self, bundle: v3dg.Bundle) -> Cuts:
        return Cuts(bundle, [], 0, self._device, False)


def refined_by_old(config: Config, study: Study, folder: Path) -> tuple[v3dg.Bundle, Row]:
    """Refine the bundle with an older version; return the bundle, and a row with the
    number of steps and the seconds."""
    num_steps = config.pictures // 3
    output = folder / f"{study.name}_old.v3dg"
    words = [study.path, output, config.device, num_steps]
    paths = [str(config.old), *filter(None, [os.environ.get("PYTHONPATH")])]
    process = subprocess.run(
        [sys.executable, "-P", "-c", _OLD_PROGRAM, *map(str, words)],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        check=False,
    )
    if process.returncode != 0:
        raise RuntimeError(f"{config.old}: the older version failed: {process.stderr[-2000:]}")
    row: Row = {"asset": study.name, "way": "old", "pictures": num_steps}
    return v3dg.Bundle.open(output), row | {"seconds": float(process.stdout)}


def compared(flips: list[float], built: list[float]) -> Row:
    """Return the geometric mean and the range of FLIP relative to the levels as
    built."""
    ratios = [a / max(b, 1e-9) for a, b in zip(flips, built, strict=True)]
    mean = math.exp(statistics.fmean(math.log(max(ratio, 1e-9)) for ratio in ratios))
    return {"ratio": round(mean, 4), "best": round(min(ratios), 4), "worst": round(max(ratios), 4)}


class Results:
    """Writes all rows to a file again whenever a row is added, with the settings of the
    study and the time that it has taken."""

    def __init__(self, output: str | None, device: str, most_seconds: float, about: Row) -> None:
        self._output = output
        self._device = device
        self._most_seconds = most_seconds
        self._about = about
        self._start = time.perf_counter()
        self._rows: list[Row] = []

    def is_over(self) -> bool:
        """Return whether the time is over in which a measurement may begin."""
        return self._seconds() > self._most_seconds

    def add(self, row: Row) -> None:
        self._rows.append(row)
        print(row, flush=True)
        settings = self._about | {"seconds": round(self._seconds(), 1)}
        record.write(self._output, settings | {"rows": self._rows}, self._device)

    def _seconds(self) -> float:
        return time.perf_counter() - self._start


def measure(config: Config, folder: Path, judges: Judges) -> None:
    settings: Row = {"pictures": config.pictures, "percents": _PERCENTS, "factors": _FACTORS}
    results = Results(config.output, config.device, config.seconds, settings)
    donut = v3dg.read_asset(config.donut)
    assets = {"donut": donut, "heap": heap_of(donut)}
    studies = [Study(config, name, assets[name], folder) for name in config.assets]
    built = {}
    for study in studies:
        flips = study.flips(study.built, judges)
        built[study.name] = flips
        row: Row = {"asset": study.name, "gaussians": len(assets[study.name])}
        results.add(row | {"build_seconds": study.build_seconds, "flips": flips})
        rates = {number: study.milliseconds(Way(windows=number)) for number in _WINDOWS}
        results.add({"asset": study.name, "ms_a_picture": rates})
        if config.old is not None:
            bundle, row = refined_by_old(config, study, folder)
            flips = study.flips(bundle, judges)
            results.add(row | compared(flips, built[study.name]) | {"flips": flips})
    for way in _WAYS:
        for study in studies:
            if results.is_over():
                return
            num_pictures = round(way.share * config.pictures)
            bundle, seconds = study.refined(way, num_pictures)
            flips = study.flips(bundle, judges)
            row = {"asset": study.name, "way": asdict(way), "pictures": num_pictures}
            results.add(row | seconds | compared(flips, built[study.name]) | {"flips": flips})


def main(config: Config) -> None:
    with tempfile.TemporaryDirectory() as folder, contextlib.closing(Judges()) as judges:
        measure(config, Path(folder), judges)


if __name__ == "__main__":
    main(tyro.cli(Config))
