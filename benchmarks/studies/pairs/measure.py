"""Errors of levels at equal numbers of gaussians and at several picture sizes: our
levels, merging alone, levels of other tools, and levels by the authors of the assets.

    python -m benchmarks.studies.pairs measure ASSETS -o pairs --device cuda
    python -m benchmarks.studies.pairs report pairs/pairs.json \\
        -o docs/notes/pairs.md --plots docs/images

ASSETS is a folder with assets.json, which maps the names of assets to objects with
these fields:

- `file` is an asset that v3dg reads.
- `up` is the vertical axis of an object, which is drawn from four sides.
- `cameras` is the transforms.json of a scene, and `views` are names of the cameras that
  are measured. `refined_from` is a file with other cameras, from which the scene is
  refined.
- `published` maps names to levels by the asset's authors, each with a `file` and its
  number of `gaussians`.

Levels of other tools are ASSETS/peers/NAME/TOOL_PERCENT, in any format that v3dg reads,
or packed by `subject.pack_level` into .npz files. They are made by commands such as

    splat-transform -g cpu -w NAME.ply -d 50% d_50.ply
    splat-transform -g cpu -w NAME.ply --decimate-adaptive 50% adaptive_50.ply

A pair is a number of gaussians and a picture size. A level has its native size if there
are 2 px² for each of its gaussians. For an object, the px² are those of the footprint
of its ball; for a scene, those of the picture, multiplied by the fraction of the
asset's gaussians that are in the picture. Every level is drawn at `factors` times the
native length of a side. The methods "ours" and "merged" are the finest cuts with at
most as many gaussians as the other level, drawn with the filter that the bundle
requires. With `--refine`, "refined" is measured in the same way. Levels of other tools
are drawn completely and without a filter.

For a scene, only gaussians whose means are in the picture count, separately for each
picture. Levels of other tools distribute their gaussians unevenly, so each of these
levels forms a separate pair. Cuts consist of whole groups. If a cut has fewer than 97 %
of the allowed gaussians, its error and the error of the next finer cut are interpolated
in the logarithm of the number of gaussians. If the eye is inside the balls of groups,
these groups are refined at any tolerance; a smaller number of gaussians is then reached
with the smallest sufficient `min_level`.

The reference picture has every gaussian at 4 x 4 samples per pixel. If a picture is
wider than `widest`, only a window is compared. The window is around a gaussian that is
drawn at random, with a preference for large and opaque gaussians.
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
_FULL_ENOUGH = 0.97  # minimum fraction of a budget that a single cut must use
_FINEST_PX2, _COARSEST_PX2 = 1e-9, 1e30
# Cuts whose tolerances differ by a smaller factor count as neighbours.
_STEP = 2 ** (-1.5 / 2048)
_LEAST_PX = 8  # minimum px per side; SSIM needs 6, and smaller pictures show nothing


@dataclass
class Measure:
    """Build, draw and compare levels; write OUTPUT/pairs.json."""

    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("pairs")
    only: tuple[str, ...] = ()
    """Names of the assets to measure; by default all."""
    methods: tuple[Literal["all", "ours", "refined", "merged", "peers"], ...] = (
        "all",
        "ours",
        "refined",
        "merged",
        "peers",
    )
    """Methods to measure; "all" draws every gaussian with one sample per pixel."""
    known: tuple[Path, ...] = ()
    """Files with recorded results, whose rows are kept if their methods are not
    measured now."""
    percents: tuple[float, ...] = PERCENTS
    """Numbers of gaussians, in percent of the asset's."""
    factors: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Lengths of picture sides, as multiples of each level's native length."""
    widest: int = 512
    """Maximum width and height in px of the compared pictures."""
    views: int = 4
    device: Literal["auto", "cpu", "cuda"] = "auto"
    build: v3dg.BuildConfig = field(default_factory=v3dg.BuildConfig)
    """Settings of the builds; "merged" uses the same settings with no steps of the
    fit."""
    refine: int = 0
    """Steps of the refinement for the method "refined"; 0 skips this method."""


@dataclass(frozen=True)
class Shown:
    """What a picture shows: all gaussians or a cut of a bundle, and the weight of the
    picture in the mean error of its method."""

    method: str
    subject: v3dg.Gaussians | v3dg.Bundle
    gaussians: int
    cut: Row
    weight: float = 1.0


@dataclass(frozen=True)
class Level:
    """The gaussians of a level, and the method that made them."""

    method: str
    gaussians: v3dg.Gaussians
    counts: list[int]
    """For each view, the number of gaussians that count."""


def errors(item: tuple[Row, Picture, Picture]) -> Row:
    """Return FLIP, PSNR and SSIM of a (description, reference, picture)."""
    return errors_of(item[1], item[2])


@dataclass(frozen=True)
class Target:
    """A number of gaussians for our cuts, and the levels of other tools with that
    number."""

    label: float | str
    count: int
    counts: list[int]
    """For each view, the number of gaussians that count."""
    levels: list[Level]


class Study:
    """Measures the methods and pairs that the settings request."""

    def __init__(self, config: Measure) -> None:
        self._config = config
        self.device = "cuda" if _device.resolve(config.device).is_cuda else "cpu"
        self.builds: dict[str, Row] = {}

    def rows(self, subject: Subject, judges: Judges) -> list[Row]:
        """Return the mean over the views for each method, number of gaussians and
        size."""
        views: dict[tuple[Any, ...], list[Row]] = {}
        for (about, _, _), found in judges.measured(self._drawn(subject), errors):
            key = tuple(
                about[name] for name in ("asset", "method", "level", "count", "factor", "width")
            )
            views.setdefault(key, []).append({**about, **found})
        names = ("asset", "method", "level", "count", "factor", "width")
        return [dict(zip(names, key, strict=True)) | weighted(rows) for key, rows in views.items()]

    def _drawn(self, subject: Subject) -> Iterator[tuple[Row, Picture, Picture]]:
        """Yield the pictures to compare: description, reference and picture."""
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
        """Return a target per percentage for an object. A scene has a target per level
        of another tool, because the levels have different numbers of gaussians in a
        picture."""
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
        """Build the bundle of a method. The method "refined" refines `ours` if it was
        built, else a new bundle."""
        config = replace(self._config.build, steps=0) if name == "merged" else self._config.build
        start = time.perf_counter()
        if name == "refined" and ours is not None:
            bundle = ours
        else:
            bundle = v3dg.build_bundle(
                subject.asset, config=config, device=self.device, progress=False
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
    """Return (C,) the number of gaussians of each cluster; with a camera, only
    gaussians whose means are in its picture count."""
    offset = bundle.clusters.offset
    if camera is None:
        return np.diff(offset)
    is_in = pairs_subject.places(bundle.gaussians.means, camera)[1]
    return np.add.reduceat(is_in, offset[:-1], dtype=int)


def cuts_of(
    name: str, bundle: v3dg.Bundle, camera: v3dg.Camera, count: int, sizes: Any = None
) -> list[Shown]:
    """Return the finest cut with at most `count` gaussians, and the next finer cut if
    the first one has far fewer.

    `sizes` is the number of gaussians of each cluster that count; by default all
    gaussians count.
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
    """Return the weighted means of the rows' measurements."""
    means: Row = {}
    for name in ("gaussians", "tolerance", "flip", "psnr", "ssim"):
        known = [row for row in rows if row[name] is not None]
        values, weights = [row[name] for row in known], [row["weight"] for row in known]
        # Errors are interpolated in the logarithm of the number.
        if name == "gaussians":
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
    """Read recorded results, which must have the same settings.

    Returns:
        The rows, the records of builds, and the changed build settings.
    """
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
    """Run the command "measure" or "report" of the command line."""
    commands: dict[str, Callable[..., Measure | pairs_report.Report]]
    commands = {"measure": Measure, "report": pairs_report.Report}
    options = tyro.extras.subcommand_cli_from_dict(commands)
    if isinstance(options, Measure):
        measure(options)
    else:
        pairs_report.report(options)
