"""Levels at equal counts and several sizes: ours, merging alone, and what other tools and makers left.

    python -m benchmarks.studies.pairs measure ASSETS -o pairs --device cuda
    python -m benchmarks.studies.pairs report pairs/pairs.json -o docs/notes/pairs.md --plots docs/images

ASSETS is a folder with assets.json: for each asset by its name a `file` that v3dg reads; `up` for an object,
which is drawn from four sides, or `cameras`, a transforms.json, and `views`, names of some of them, for a
scene; and `published`, by their names the `file` and number of `gaussians` of the levels that its makers gave
it. Levels of other tools are
ASSETS/peers/NAME/TOOL_PERCENT.npz, which `pack_level` makes of what

    splat-transform -g cpu -w NAME.ply -d 50% d_50.ply
    splat-transform -g cpu -w NAME.ply --decimate-adaptive 50% adaptive_50.ply

wrote, or of any format that v3dg reads.

A pair is a count and a size. The size at which a level is at home is 2 px² for each of its gaussians: of the
footprint of the object's ball, or of a scene's picture for those of the level that are in it. Every level is
drawn at `factors` times that, measured along a side. Ours and merging alone are the cut with a budget of as
many gaussians, so never more, drawn with the filter that the bundle asks for; others are drawn whole and
plain. The truth is every gaussian at four by four samples a pixel. Of a picture wider than `widest` a window
is compared, around a gaussian drawn at random from those that are large and opaque.
"""

from __future__ import annotations

import json
import math
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.measure import tolerance_for
from benchmarks.studies import pairs_report
from v3dg import _device
from v3dg._judges import Judges, mean_of
from v3dg.metrics import draw_truth, errors_of
from v3dg.pictures import Picture, to_8bit

Row = dict[str, Any]

PERCENTS = (50.0, 25.0, 12.5, 6.25, 3.0, 1.5, 0.7)
OUR_STEPS = {"ours": None, "merged": 0}
HOME_PX2 = 2.0
_SAMPLES = 4
_BALL_SHARE = 0.995  # of the gaussians; the rest may float far away
_LEAST_PX = 8  # of a side: SSIM needs 6, and below that there is nothing to see
_DISTANCE = 2.5  # of the camera from an object's centre, in radii


@dataclass
class Measure:
    """Build, draw and compare; writes OUTPUT/pairs.json."""

    assets: tyro.conf.Positional[Path]
    """Folder with assets.json."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("pairs")
    only: tuple[str, ...] = ()
    """Names of assets; all by default."""
    methods: tuple[Literal["all", "ours", "merged", "peers"], ...] = ("all", "ours", "merged", "peers")
    """What is measured; "all" is every gaussian at one sample a pixel."""
    known: tuple[Path, ...] = ()
    """Recorded results, from which rows are taken that are not measured here."""
    percents: tuple[float, ...] = PERCENTS
    """Counts, in percent of the asset's."""
    factors: tuple[float, ...] = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)
    """Sizes, in those at which a level is at home."""
    widest: int = 512
    """px of a side of the pictures that are compared."""
    views: int = 4
    device: Literal["auto", "cpu", "cuda"] = "auto"


@dataclass(frozen=True)
class Level:
    """Gaussians that stand for an asset, and who made them."""

    method: str
    gaussians: v3dg.Gaussians
    count: int


@dataclass(frozen=True)
class Size:
    """How large a view of a subject is drawn: the camera of the whole picture, and of the part compared."""

    camera: v3dg.Camera
    window: v3dg.Camera


class Subject:
    """An asset, from where it is looked at, and how large."""

    def __init__(self, folder: Path, name: str, about: dict[str, Any], views: int) -> None:
        self.name, self._folder, self._about = name, folder, about
        self.asset = v3dg.read_asset(folder / about["file"])
        self._cameras = self._scene_views(views) if "cameras" in about else self._object_views(views)

    def _scene_views(self, views: int) -> list[v3dg.Camera]:
        cameras = v3dg.read_cameras(self._folder / self._about["cameras"])
        return [cameras[name] for name in self._about.get("views", list(cameras))[:views]]

    def _object_views(self, views: int) -> list[v3dg.Camera]:
        """Square pictures around the ball of nearly all gaussians."""
        means = self.asset.means.astype(np.float64)
        center = np.quantile(means, [0.01, 0.99], axis=0).mean(axis=0)
        radius = float(np.quantile(np.linalg.norm(means - center, axis=1), _BALL_SHARE))
        fov, up = 2 * math.asin(1 / _DISTANCE), self._about["up"]
        return v3dg.turntable(center, _DISTANCE * radius, views, up=up, fov_x=fov, width=1024, height=1024)

    @cached_property
    def _is_seen(self) -> list[Any]:
        """(N,) for each view, whether a gaussian's mean is in the picture."""
        return [self._places(camera)[1] for camera in self._cameras]

    def _places(self, camera: v3dg.Camera) -> tuple[Any, Any]:
        """(N, 2) px and (N,) whether they are in the picture."""
        seen = self.asset.means.astype(np.float64) @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        is_before = seen[:, 2] > camera.near
        depth = np.where(is_before, seen[:, 2], 1)
        px = np.stack(
            [camera.fx * seen[:, 0] / depth + camera.cx, camera.fy * seen[:, 1] / depth + camera.cy], 1
        )
        return px, is_before & ((px >= 0) & (px < [camera.width, camera.height])).all(axis=1)

    def budget(self, count: int, view: int) -> int:
        """Of a level of so many gaussians, those that count for a view: of a scene those in the picture."""
        return round(count * float(self._is_seen[view].mean())) if "cameras" in self._about else count

    def sizes(self, count: int, factor: float, widest: int) -> list[Size]:
        """Each view, at a factor times the size at which a level of so many gaussians is at home."""
        if "cameras" in self._about:
            wanted = HOME_PX2 * count * float(np.mean([seen.mean() for seen in self._is_seen]))
            scales = [math.sqrt(wanted / (c.width * c.height)) for c in self._cameras]
        else:
            solid_angle = 2 * math.pi * (1 - math.sqrt(1 - _DISTANCE**-2))
            scales = [math.sqrt(HOME_PX2 * count / solid_angle) / c.fx for c in self._cameras]
        rng = np.random.default_rng([zlib.crc32(self.name.encode()), count, round(64 * factor)])
        return [
            self._size(scaled(c, factor * s), widest, rng) for c, s in zip(self._cameras, scales, strict=True)
        ]

    def _size(self, camera: v3dg.Camera, widest: int, rng: np.random.Generator) -> Size:
        if max(camera.width, camera.height) <= widest:
            return Size(camera, camera)
        px, is_seen = self._places(camera)
        ids = np.flatnonzero(is_seen)
        largest = np.sort(self.asset.scales[ids].astype(np.float64), axis=1)[:, 1:].prod(axis=1)
        # Of a scene the sky would always be taken: what is twice as large counts twice, whatever the rest.
        weights = self.asset.opacities[ids] * np.sqrt(largest)
        target = px[rng.choice(ids, p=weights / weights.sum())]
        size = np.minimum([camera.width, camera.height], widest)
        corner = np.clip(np.round(target - size / 2), 0, np.array([camera.width, camera.height]) - size)
        K = camera.K.copy()
        K[:2, 2] -= corner
        return Size(camera, replace(camera, K=K, width=int(size[0]), height=int(size[1])))

    @property
    def published_counts(self) -> dict[str, int]:
        """Gaussians of the levels of the asset's makers."""
        return {label: level["gaussians"] for label, level in self._about.get("published", {}).items()}

    def peers(self, percents: tuple[float, ...]) -> Iterator[tuple[float | str, str, v3dg.Gaussians]]:
        """Levels of others: at which percent, or which published one, made by whom, and its gaussians."""
        for path in sorted((self._folder / "peers" / self.name).glob("*_*")):
            tool, _, percent = path.name.removesuffix(path.suffix).rpartition("_")
            if float(percent) in percents:
                yield float(percent), tool, read_level(path)
        for label, level in self._about.get("published", {}).items():
            yield f"published {label}", "published", v3dg.read_asset(self._folder / level["file"])


def scaled(camera: v3dg.Camera, scale: float) -> v3dg.Camera:
    """The camera with that many times the resolution, its sides rounded up to whole px."""
    width, height = (math.ceil(scale * side) for side in (camera.width, camera.height))
    K = camera.K * np.array([[scale], [scale], [1.0]])
    K[:2, 2] += (np.array([width, height]) - scale * np.array([camera.width, camera.height])) / 2
    return replace(camera, K=K, width=width, height=height)


def pack_level(path: Path, gaussians: v3dg.Gaussians) -> None:
    """Write gaussians in about 27 bytes each and half a byte for each coefficient of higher degree or more.

    Means have 17 bits of mantissa, and coefficients of higher degrees a byte of their square root, so that
    small ones are kept: pictures differ from the gaussians' by far less than levels do from the asset.
    """
    sh = gaussians.sh.reshape(len(gaussians), -1)
    base, rest = sh[:, :3], sh[:, 3:]
    top = np.float32(np.abs(rest).max(initial=1e-9))
    bits = (np.ascontiguousarray(gaussians.means).view(np.uint32) + 64) & np.uint32(0xFFFFFF80)
    norms = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    np.savez_compressed(
        path,
        means=bits.view(np.float32),
        log_scales=np.log(gaussians.scales.clip(1e-30)).astype(np.float16),
        quats=np.round(2047 * gaussians.quats / norms).astype(np.int16),
        opacities=np.round(65535 * gaussians.opacities).astype(np.uint16),
        sh0=base.astype(np.float16),
        rest_root=np.round(127 * np.sign(rest) * np.sqrt(np.abs(rest) / top)).astype(np.int8),
        rest_top=top,
    )


def read_level(path: Path) -> v3dg.Gaussians:
    """Read what `pack_level` wrote, or any asset."""
    if path.suffix != ".npz":
        return v3dg.read_asset(path)
    with np.load(path) as file:
        parts = {name: file[name] for name in file.files}
    root = parts["rest_root"].astype(np.float32) / 127
    sh = np.concatenate([parts["sh0"].astype(np.float32), parts["rest_top"] * root * np.abs(root)], axis=1)
    quats = parts["quats"].astype(np.float32)
    return v3dg.Gaussians(
        means=parts["means"],
        quats=quats / np.linalg.norm(quats, axis=1, keepdims=True),
        scales=np.exp(parts["log_scales"].astype(np.float32)),
        opacities=parts["opacities"].astype(np.float32) / 65535,
        sh=np.ascontiguousarray(sh.reshape(len(sh), -1, 3)),
    )


def errors(item: tuple[Row, Picture, Picture]) -> Row:
    """FLIP, PSNR and SSIM of (what it is, truth, picture)."""
    return errors_of(item[1], item[2])


class Study:
    """What is measured, where."""

    def __init__(self, config: Measure) -> None:
        self._config = config
        self.device = "cuda" if _device.resolve(config.device).is_cuda else "cpu"
        self.builds: dict[str, Row] = {}

    def rows(self, subject: Subject, judges: Judges) -> list[Row]:
        """Means over the views of each method, count and size."""
        views: dict[tuple[Any, ...], list[Row]] = {}
        for (about, _, _), found in judges.measured(self._drawn(subject), errors):
            key = tuple(about[name] for name in ("asset", "method", "level", "count", "factor", "width"))
            views.setdefault(key, []).append({**about, **found})
        names = ("asset", "method", "level", "count", "factor", "width")
        measured = ("gaussians", "tolerance", "flip", "psnr", "ssim")
        return [dict(zip(names, key, strict=True)) | mean_of(rows, *measured) for key, rows in views.items()]

    def _drawn(self, subject: Subject) -> Iterator[tuple[Row, Picture, Picture]]:
        """What is to be compared: what it is, the truth, the picture."""
        bundles = {
            name: self._built(subject, name, steps)
            for name, steps in OUR_STEPS.items()
            if name in set[str](self._config.methods)
        }
        self._asset = self._placed(subject.asset)
        targets: dict[float | str, tuple[int, list[Level]]] = {
            percent: (round(len(subject.asset) * percent / 100), []) for percent in self._config.percents
        }
        targets |= {f"published {label}": (count, []) for label, count in subject.published_counts.items()}
        if "peers" in self._config.methods:
            for wanted, method, level in subject.peers(self._config.percents):
                targets[wanted][1].append(Level(method, self._placed(level), len(level)))
        for wanted, (count, levels) in targets.items():
            for factor in self._config.factors:
                yield from self._compared(subject, wanted, count, factor, levels, bundles)

    def _placed(self, gaussians: v3dg.Gaussians) -> v3dg.Gaussians:
        return gaussians.torch("cuda") if self.device == "cuda" else gaussians

    def _built(self, subject: Subject, name: str, steps: int | None) -> v3dg.Bundle:
        config = v3dg.BuildConfig() if steps is None else v3dg.BuildConfig(steps=steps)
        start = time.perf_counter()
        bundle = v3dg.build_bundle(subject.asset, config=config, device=self.device, progress=False)
        seconds = round(time.perf_counter() - start, 2)
        self.builds.setdefault(subject.name, {})[f"{name}_seconds"] = seconds
        return bundle

    def _compared(
        self,
        subject: Subject,
        wanted: float | str,
        count: int,
        factor: float,
        levels: list[Level],
        bundles: dict[str, v3dg.Bundle],
    ) -> Iterator[tuple[Row, Picture, Picture]]:
        about: Row = {"asset": subject.name, "level": wanted, "count": count, "factor": factor}
        sizes = subject.sizes(count, factor, self._config.widest)
        if min(min(size.window.width, size.window.height) for size in sizes) < _LEAST_PX:
            return
        for view, size in enumerate(sizes):
            truth = draw_truth(self._asset, size.window, self.device, _SAMPLES)
            budget = subject.budget(count, view)
            for method, shown, gaussians, tolerance in self._shown(levels, bundles, size.camera, budget):
                image = v3dg.render(shown, size.window, tolerance=tolerance, device=self.device)
                row = {**about, "width": size.camera.width, "method": method}
                yield row | {"gaussians": gaussians, "tolerance": tolerance}, truth, to_8bit(image.color)

    def _shown(
        self, levels: list[Level], bundles: dict[str, v3dg.Bundle], camera: v3dg.Camera, budget: int
    ) -> Iterator[tuple[str, v3dg.Gaussians | v3dg.Bundle, int, float | None]]:
        """Each method, what of it is drawn, of how many gaussians, and the tolerance of a cut."""
        if "all" in self._config.methods:
            yield "all", self._asset, len(self._asset), None
        for level in levels:
            yield level.method, level.gaussians, level.count, None
        for name, bundle in bundles.items():
            scene = v3dg.Scene.of(bundle)
            tolerance = tolerance_for(scene, camera, budget)
            cut = v3dg.select(scene, camera, tolerance=tolerance, device="cpu")
            yield name, bundle, cut.num_gaussians, tolerance


def measure(config: Measure) -> None:
    about = json.loads((config.assets / "assets.json").read_text(encoding="utf-8"))
    missing = [name for name in config.only if name not in about]
    if missing:
        raise SystemExit(f"--only: expected some of {', '.join(about)}, got {missing[0]}")
    settings = {"factors": list(config.factors), "widest": config.widest, "views": config.views}
    rows = known_rows(config.known, settings)
    config.output.mkdir(parents=True, exist_ok=True)
    study, judges = Study(config), Judges()
    try:
        for name in config.only or about:
            start = time.perf_counter()
            subject = Subject(config.assets, name, about[name], config.views)
            rows = rows | by_key(study.rows(subject, judges))
            print(f"{name}: {len(subject.asset)} gaussians, {time.perf_counter() - start:.0f} s", flush=True)
            result = {"settings": settings, "builds": study.builds, "rows": list(rows.values())}
            record.write(config.output / "pairs.json", result, study.device)
    finally:
        judges.close()
    print(pairs_report.overview(list(rows.values())))


def by_key(rows: list[Row]) -> dict[tuple[Any, ...], Row]:
    return {(row["asset"], row["method"], row["level"], row["factor"]): row for row in rows}


def known_rows(paths: tuple[Path, ...], settings: Row) -> dict[tuple[Any, ...], Row]:
    """Rows of recorded results, which must have been measured alike."""
    rows: dict[tuple[Any, ...], Row] = {}
    for path in paths:
        recorded = json.loads(path.read_text(encoding="utf-8"))
        if recorded["settings"] != settings:
            raise SystemExit(f"{path}: expected results of {settings}, got {recorded['settings']}")
        rows |= by_key(recorded["rows"])
    return rows


if __name__ == "__main__":
    commands: dict[str, Callable[..., Measure | pairs_report.Report]]
    commands = {"measure": Measure, "report": pairs_report.Report}
    options = tyro.extras.subcommand_cli_from_dict(commands)
    measure(options) if isinstance(options, Measure) else pairs_report.report(options)
