"""Levels at equal counts and several sizes: ours, merging alone, and levels of other
tools and of the assets' authors.

    python -m benchmarks.studies.pairs measure ASSETS -o pairs --device cuda python -m
    benchmarks.studies.pairs report pairs/pairs.json -o docs/notes/pairs.md --plots
    docs/images

ASSETS is a folder with assets.json. For each asset it has, by name: a `file` that v3dg
reads; `up` for an object, which is drawn from four sides; or for a scene `cameras`, a
transforms.json, `views`, names of some of them, and `refined_from`, a file of other
cameras for its refinement; and `published`, by name the `file` and number of
`gaussians` of its authors' levels. Levels of other tools are
ASSETS/peers/NAME/TOOL_PERCENT.npz, which `subject.pack_level` makes from the output of

    splat-transform -g cpu -w NAME.ply -d 50% d_50.ply
    splat-transform -g cpu -w NAME.ply --decimate-adaptive 50% adaptive_50.ply

or from any format that v3dg reads.

A pair is a count and a size. A level has its native size at 2 px² for each of its
gaussians: px² of the footprint of an object's ball, or of a scene's picture multiplied
by the share of the asset's gaussians that are in it. Every level is drawn at `factors`
times that size, measured along a side. "Ours" and "merging alone" are the finest cuts
with at most as many gaussians as the other level, drawn with the filter that the bundle
requires; with `--refine`, so is "refined". Other levels are drawn completely and
without a filter.

For a scene, only gaussians whose means are in the picture count, separately in each
picture: others' levels distribute their gaussians unevenly, so each of these levels
forms its own pair. Cuts consist of whole groups. If a cut has fewer than 97 % of the
count, its error and that of the next finer cut are interpolated in the logarithm of the
count. If the eye is inside of groups, these are refined at any tolerance; a smaller
count is then met with the least `min_level` that suffices.

The true picture has every gaussian at four by four samples per pixel. For a picture
wider than `widest`, a window is compared, around a gaussian drawn at random with a
preference for large and opaque ones.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.studies.pairs import report as pairs_report
from benchmarks.studies.pairs import subject as pairs_subject
from benchmarks.studies.pairs.subject import Subject
from v3dg import _device
from v3dg._judges import Judges
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, to_8bit
from v3dg.refine import refine_bundle

Row = dict[str, Any]

PERCENTS = (50.0, 25.0, 12.5, 6.25, 3.0, 1.5, 0.7)
_OURS = ("ours", "refined", "merged")
_SAMPLES = 4
_FULL_ENOUGH = 0.97  # fraction of a budget
_FINEST_PX2, _COARSEST_PX2 = 1e-9, 1e30
_STEP = 2 ** (-1.5 / 2048)  # cuts whose tolerances are closer count as neighbours
_LEAST_PX = 8  # px per side: SSIM needs 6, and smaller pictures show nothing


@dataclass
class Measure:
    """Build, draw and compare; writes OUTPUT/pairs.json."""

    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("pairs")
    only: tuple[str, ...] = ()
    """Names of assets; all by default."""
    methods: tuple[Literal["all", "ours", "refined", "merged", "peers"], ...] = (
        "all",
        "ours",
        "refined",
        "merged",
        "peers",
    )
    """Methods to measure; "all" draws every gaussian with one sample per pixel."""
    known: tuple[Path, ...] = ()
    """Recorded results, from which rows are taken that are not measured here."""
    percents: tuple[float, ...] = PERCENTS
    """Counts of gaussians, in percent of the asset's count."""
    factors: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Picture sizes, relative to the native size of each level."""
    widest: int = 512
    """px of a side of the pictures that are compared."""
    views: int = 4
    device: Literal["auto", "cpu", "cuda"] = "auto"
    build: v3dg.BuildConfig = field(default_factory=v3dg.BuildConfig)
    """Settings of our levels; "merged" has the same settings, without fitting steps."""
    refine: int = 0
    """Refinement steps of the method "refined"; with 0 steps it is left out."""


@dataclass(frozen=True)
class Shown:
    """The subject of a picture: all gaussians, or a cut of a bundle; and the weight of
    the picture in the error of its method."""

    method: str
    subject: v3dg.Gaussians | v3dg.Bundle
    gaussians: int
    cut: Row
    weight: float = 1.0


@dataclass(frozen=True)
class Level:
    """Gaussians that represent an asset, and their origin."""

    method: str
    gaussians: v3dg.Gaussians
    counts: list[int]
    """Number of gaussians that count, in each view."""


def errors(item: tuple[Row, Picture, Picture]) -> Row:
    """Return FLIP, PSNR and SSIM of (description, truth, picture)."""
    return errors_of(item[1], item[2])


@dataclass(frozen=True)
class Target:
    """A count that our cuts have to meet, and others' levels with that count."""

    label: float | str
    count: int
    counts: list[int]
    """Number of gaussians that count, in each view."""
    levels: list[Level]


class Study:
    """The measured pairs and methods."""

    def __init__(self, config: Measure) -> None:
        self._config = config
        self.device = "cuda" if _device.resolve(config.device).is_cuda else "cpu"
        self.builds: dict[str, Row] = {}

    def rows(self, subject: Subject, judges: Judges) -> list[Row]:
        """Return means over the views of each method, count and size."""
        views: dict[tuple[Any, ...], list[Row]] = {}
        for (about, _, _), found in judges.measured(self._drawn(subject), errors):
            key = tuple(
                about[name] for name in ("asset", "method", "level", "count", "factor", "width")
            )
            views.setdefault(key, []).append({**about, **found})
        names = ("asset", "method", "level", "count", "factor", "width")
        return [dict(zip(names, key, strict=True)) | weighted(rows) for key, rows in views.items()]

    def _drawn(self, subject: Subject) -> Iterator[tuple[Row, Picture, Picture]]:
        """Yield the comparisons: description, truth, picture."""
        wanted_of_ours = set[str](self._config.methods) - (
            {"refined"} if self._config.refine == 0 else set()
        )
        bundles: dict[str, v3dg.Bundle] = {}
        for name in _OURS:
            if name in wanted_of_ours:
                bundles[name] = self._built(subject, name, bundles.get("ours"))
        self._asset = Level("all", self._placed(subject.asset), subject.counts(subject.asset))
        places = subject.cameras if subject.is_scene else [None] * len(subject.cameras)
        sizes = {
            name: [cluster_sizes(bundle, place) for place in places]
            for name, bundle in bundles.items()
        }
        for target in self._targets(subject):
            for factor in self._config.factors:
                yield from self._compared(subject, target, factor, bundles, sizes)

    def _targets(self, subject: Subject) -> list[Target]:
        """Return the targets: for objects each percentage; for a scene each other
        level, because their counts in a picture differ."""
        targets: dict[float | str, Target] = {}
        for percent in self._config.percents:
            counts = [round(count * percent / 100) for count in self._asset.counts]
            targets[percent] = Target(
                percent, round(len(subject.asset) * percent / 100), counts, []
            )
        if not subject.is_scene:
            for label, count in subject.published_counts.items():
                targets[f"published {label}"] = Target(
                    f"published {label}", count, [count] * len(subject.cameras), []
                )
        is_drawn = "peers" in self._config.methods
        if not is_drawn and not subject.is_scene:
            return list(targets.values())
        of_scene: list[Target] = []
        for wanted, method, gaussians in subject.peers(self._config.percents):
            level = Level(method, self._placed(gaussians), subject.counts(gaussians))
            if subject.is_scene:
                label = wanted if isinstance(wanted, str) else f"{wanted:g} %, {method}"
                of_scene.append(
                    Target(label, len(gaussians), level.counts, [level] if is_drawn else [])
                )
            else:
                targets[wanted].levels.append(level)
        return of_scene or list(targets.values())

    def _placed(self, gaussians: v3dg.Gaussians) -> v3dg.Gaussians:
        return gaussians.torch("cuda") if self.device == "cuda" else gaussians

    def _built(self, subject: Subject, name: str, ours: v3dg.Bundle | None) -> v3dg.Bundle:
        """Return the bundle to refine: `ours`, or one that is built for it."""
        config = replace(self._config.build, steps=0) if name == "merged" else self._config.build
        start = time.perf_counter()
        if name == "refined" and ours is not None:
            bundle = ours
        else:
            bundle = v3dg.build_bundle(
                subject.asset, config=config, device=self.device, progress=False, quality="draft"
            )
        if name == "refined":
            options: Row = {"steps": self._config.refine, "device": self.device, "progress": False}
            bundle = refine_bundle(bundle, cameras=subject.refined_from, **options)
        seconds = round(time.perf_counter() - start, 2)
        self.builds.setdefault(subject.name, {})[f"{name}_seconds"] = seconds
        return bundle

    def _compared(
        self,
        subject: Subject,
        target: Target,
        factor: float,
        bundles: dict[str, v3dg.Bundle],
        cluster_sizes_of: dict[str, list[Any]],
    ) -> Iterator[tuple[Row, Picture, Picture]]:
        about: Row = {
            "asset": subject.name,
            "level": target.label,
            "count": target.count,
            "factor": factor,
        }
        sizes = subject.sizes(target.count, factor, self._config.widest)
        if min(min(size.window.width, size.window.height) for size in sizes) < _LEAST_PX:
            return
        levels = [*([self._asset] if "all" in self._config.methods else []), *target.levels]
        for view, size in enumerate(sizes):
            truth = draw_truth(self._asset.gaussians, size.window, self.device, _SAMPLES)
            about["width"] = size.camera.width
            shown = [
                Shown(level.method, level.gaussians, level.counts[view], {}) for level in levels
            ]
            for name, bundle in bundles.items():
                count = max(target.counts[view], 1)
                shown += cuts_of(name, bundle, size.camera, count, cluster_sizes_of[name][view])
            for one in shown:
                image = v3dg.render(one.subject, size.window, device=self.device, **one.cut)
                row = {
                    **about,
                    "method": one.method,
                    "gaussians": one.gaussians,
                    "weight": one.weight,
                }
                tolerance = one.cut.get("tolerance", _COARSEST_PX2)
                row["tolerance"] = tolerance if tolerance < _COARSEST_PX2 else None
                yield row, truth, to_8bit(image.color)


def cluster_sizes(bundle: v3dg.Bundle, camera: v3dg.Camera | None = None) -> Any:
    """Return (C,) the gaussians of each cluster; with a camera, only those whose means
    are in its picture."""
    offset = bundle.clusters.offset
    if camera is None:
        return np.diff(offset)
    is_in = pairs_subject.places(bundle.gaussians.means, camera)[1]
    return np.add.reduceat(is_in, offset[:-1], dtype=int)


def cuts_of(
    name: str, bundle: v3dg.Bundle, camera: v3dg.Camera, count: int, sizes: Any = None
) -> list[Shown]:
    """Return the finest cut with at most this many gaussians, and the next finer one if
    it has far fewer.

    `sizes`: number of gaussians of each cluster that count; by default all.
    """
    scene = v3dg.Scene.of(bundle)
    sizes = cluster_sizes(bundle) if sizes is None else sizes

    def cut(min_level: int, tolerance: float) -> Shown:
        chosen = v3dg.select(scene, camera, min_level=min_level, tolerance=tolerance, device="cpu")
        options = {"tolerance": tolerance, "min_level": min_level}
        return Shown(name, bundle, int(sizes[chosen.cluster_ids].sum()), options)

    finer = None
    for min_level in range(bundle.num_levels):
        within = cut(min_level, _COARSEST_PX2)
        if within.gaussians <= count:
            break
        finer = within
    else:
        return [within]
    finest = cut(min_level, 0.0)
    if finest.gaussians <= count:
        within = finest
    else:
        finer = cut(min_level, _FINEST_PX2)
        if finer.gaussians <= count:
            within, finer = finer, finest
        while 0 < finer.cut["tolerance"] < within.cut["tolerance"] * _STEP:
            between = cut(min_level, math.sqrt(finer.cut["tolerance"] * within.cut["tolerance"]))
            if between.gaussians <= count:
                within = between
            else:
                finer = between
    if within.gaussians >= _FULL_ENOUGH * count or within.gaussians == 0 or finer is None:
        return [within]
    share = math.log(count / within.gaussians) / math.log(finer.gaussians / within.gaussians)
    return [replace(within, weight=1 - share), replace(finer, weight=share)]


def weighted(rows: list[Row]) -> Row:
    """Return weighted means of the measurements."""
    means: Row = {}
    for name in ("gaussians", "tolerance", "flip", "psnr", "ssim"):
        known = [row for row in rows if row[name] is not None]
        values, weights = [row[name] for row in known], [row["weight"] for row in known]
        if name == "gaussians":  # errors are interpolated in its logarithm
            means[name] = round(
                math.exp(np.average(np.log(np.maximum(values, 1)), weights=weights))
            )
        else:
            means[name] = float(f"{np.average(values, weights=weights):.6g}") if known else None
    return means


def measure(config: Measure) -> None:
    about = json.loads((config.assets / "assets.json").read_text(encoding="utf-8"))
    missing = [name for name in config.only if name not in about]
    if missing:
        raise SystemExit(f"--only: expected some of {', '.join(about)}, got {missing[0]}")
    settings = {"factors": list(config.factors), "widest": config.widest, "views": config.views}
    changes = dict(asdict(config.build).items() - asdict(v3dg.BuildConfig()).items())
    changes |= {"refine": config.refine} if config.refine > 0 else {}
    known = known_results(config.known, settings, changes)
    config.output.mkdir(parents=True, exist_ok=True)
    study, judges = Study(config), Judges()
    rows, study.builds, changes = known
    try:
        for name in config.only or about:
            start = time.perf_counter()
            subject = Subject(config.assets, name, about[name], config.views)
            rows = rows | by_key(study.rows(subject, judges))
            print(
                f"{name}: {len(subject.asset)} gaussians, {time.perf_counter() - start:.0f} s",
                flush=True,
            )
            result: Row = {"settings": settings, "changes": changes, "builds": study.builds}
            result |= {"rows": list(rows.values())}
            record.write(config.output / "pairs.json", result, study.device)
    finally:
        judges.close()
    print(pairs_report.overview(list(rows.values())))


def by_key(rows: list[Row]) -> dict[tuple[Any, ...], Row]:
    return {(row["asset"], row["method"], row["level"], row["factor"]): row for row in rows}


def known_results(
    paths: tuple[Path, ...], settings: Row, changes: Row
) -> tuple[dict[tuple[Any, ...], Row], dict[str, Row], Row]:
    """Return rows and builds of recorded results, which must have the same settings,
    and all changes."""
    rows: dict[tuple[Any, ...], Row] = {}
    builds: dict[str, Row] = {}
    for path in paths:
        recorded = json.loads(path.read_text(encoding="utf-8"))
        if recorded["settings"] != settings:
            raise SystemExit(f"{path}: expected results of {settings}, got {recorded['settings']}")
        expected = {"refine": recorded["changes"].get("refine"), **changes}
        if {"refine": expected["refine"], **recorded["changes"]} != expected:
            raise SystemExit(f"{path}: expected levels of {changes}, got {recorded['changes']}")
        changes = {name: value for name, value in expected.items() if value is not None}
        rows |= by_key(pairs_report.rows_of(recorded))
        for name, seconds in recorded["builds"].items():
            builds.setdefault(name, {}).update(seconds)
    return rows, builds, changes


def main() -> None:
    """Read the command line of both parts, and run one."""
    commands: dict[str, Callable[..., Measure | pairs_report.Report]]
    commands = {"measure": Measure, "report": pairs_report.Report}
    options = tyro.extras.subcommand_cli_from_dict(commands)
    if isinstance(options, Measure):
        measure(options)
    else:
        pairs_report.report(options)
