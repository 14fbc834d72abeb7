"""Total alpha and colour of cuts relative to those of the asset, from near and far.

    python -m benchmarks.studies.mass donut.ply cloud grass -o mass

Assets are files, or names of assets in `fuzzy`. Each is seen from six sides at
distances of 4 to 128 radii. The focal length is that of 1,024 px for 50 degrees, and
the pictures are as large as the asset's ball. The reference is the asset at 4 x 4
samples per pixel, or 8 x 8 in small pictures. It is compared with the asset at one
sample per pixel, with the cut at the default tolerance and, with `--levels`, with each
level alone. `--stages` adds levels that are merged but not fitted, levels that are
fitted only by differences of single pixels, and levels that are refined.
"""

from __future__ import annotations

import itertools
import math
import statistics
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.studies.mass.fuzzy import FUZZY
from v3dg import _device
from v3dg.image import Image
from v3dg.levels.config import BuildConfig
from v3dg.metrics import MIN_TRANSMITTANCE, box_downsample, flip

Row = dict[str, str | int | float]
Stage = Literal["merged", "by pixels", "fitted", "refined"]

_FOCAL_PX = 512 / math.tan(math.radians(25))
_BALL_SHARE = 0.995  # fraction of the gaussians; the others may be far away
_BORDER_PX = 6
_FEW_PX = 128  # px per side; smaller pictures have a reference with more samples
_LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
# number of rotations of the six sides for small pictures, whose single samples are
# noisy
_TURNS = 4
_SIDES = [*np.eye(3), *-np.eye(3)]


@dataclass
class Config:
    assets: tyro.conf.Positional[tuple[str, ...]]
    """Files, or names of assets in `fuzzy`."""
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File for the results, without suffix."""
    distances: tuple[float, ...] = (4, 8, 16, 32, 64, 128)
    """Distances of the camera in radii."""
    stages: tuple[Stage, ...] = ("fitted",)
    """The stages whose levels are measured."""
    refine: int = 2_000
    """Number of pictures of the refinement."""
    levels: bool = False
    """Whether each level is also measured alone."""
    device: Literal["auto", "cpu", "cuda"] = "auto"


class Totals(NamedTuple):
    """Sums over a picture, and the picture in 8-bit colours."""

    alpha: float
    color: npt.NDArray[np.float64]  # (3,)
    shown: npt.NDArray[np.float32]  # (H, W, 3)


class View(NamedTuple):
    """A camera, and its reference picture of the asset."""

    distance: float
    camera: v3dg.Camera
    truth: Totals


def read(name: str) -> v3dg.Gaussians:
    """Read a file, or make an asset of `fuzzy`."""
    if name in FUZZY:
        return FUZZY[name]()
    return v3dg.read_asset(name)


def cameras_of(asset: v3dg.Gaussians, distance: float) -> Iterator[v3dg.Camera]:
    """Yield views of the ball of nearly all gaussians from six sides, at a distance in
    radii. For small pictures, yield more views."""
    means = asset.means.astype(np.float64)
    center = np.quantile(means, [0.01, 0.99], axis=0).mean(axis=0)
    radius = float(np.quantile(np.linalg.norm(means - center, axis=1), _BALL_SHARE))
    half_px = math.ceil(1.05 * _FOCAL_PX / math.sqrt(distance**2 - 1)) + _BORDER_PX
    fov = 2 * math.atan(half_px / _FOCAL_PX)
    rng = np.random.default_rng(7)
    turns = _TURNS
    if 2 * half_px > _FEW_PX:
        turns = 1
    for _ in range(turns):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        for side in _SIDES:
            eye = center + distance * radius * (turn @ side)
            up = turn @ np.roll(np.abs(side), 1)
            yield v3dg.Camera.look_at(
                eye, center, up, fov, width=2 * half_px, height=2 * half_px, near=0.01 * radius
            )


def totals(image: Image, samples: int = 1) -> Totals:
    """Return the sums of a picture that is drawn `samples` times as large."""
    color = _device.to_host(image.color)
    alpha = _device.to_host(image.alpha)
    shown = box_downsample(color.clip(0, 1), samples)
    scale = samples**-2
    return Totals(
        alpha=scale * float(alpha.sum(dtype=np.float64)),
        color=scale * color.sum(axis=(0, 1), dtype=np.float64),
        shown=np.asarray(shown, np.float32),
    )


def views_of(config: Config, asset: v3dg.Gaussians) -> list[View]:
    """Draw the reference pictures of all views."""
    views = []
    for distance in config.distances:
        for camera in cameras_of(asset, distance):
            samples = 4
            if camera.width <= _FEW_PX:
                samples = 8
            image = v3dg.render(
                asset,
                camera.scaled(samples),
                min_transmittance=MIN_TRANSMITTANCE,
                device=config.device,
            )
            views.append(View(distance, camera, totals(image, samples)))
    return views


def compared(test: Totals, truth: Totals) -> Row:
    """Return the ratios of the sums to those of the reference, and FLIP."""
    ratio = test.color / truth.color
    luminance = float(test.color @ _LUMINANCE) / float(truth.color @ _LUMINANCE)
    return {
        "alpha": test.alpha / truth.alpha,
        "color": luminance,
        **{name: float(value) for name, value in zip("rgb", ratio, strict=True)},
        "flip": flip(truth.shown, test.shown),
    }


def rows_of(
    config: Config, views: list[View], subject: v3dg.Bundle | v3dg.Gaussians, level: int | None
) -> Iterator[Row]:
    """Yield means over the views of each distance, for the whole asset, the cut at the
    default tolerance, or one level alone."""
    for distance, group in itertools.groupby(views, lambda view: view.distance):
        found: list[Row] = []
        for _, camera, truth in group:
            if level is None:
                image = v3dg.render(subject, camera, device=config.device)
            else:
                image = v3dg.render(
                    subject, camera, tolerance=0.0, min_level=level, device=config.device
                )
            row = compared(totals(image), truth)
            found.append({**row, "gaussians": image.stats.gaussians_selected})
        means = {key: statistics.fmean(float(row[key]) for row in found) for key in found[0]}
        yield {"distance": distance, **{key: float(f"{v:.5g}") for key, v in means.items()}}


def bundle_of(config: Config, asset: v3dg.Gaussians, stage: Stage) -> v3dg.Bundle:
    """Return the levels after one of the stages."""
    build = BuildConfig()
    if stage == "merged":
        build = replace(build, steps=0)
    if stage == "by pixels":
        build = replace(build, loss_cells=0.0)
    bundle = v3dg.build_bundle(asset, config=build, device=config.device, progress=False)
    if stage == "refined":
        bundle = v3dg.refine_bundle(
            bundle, steps=config.refine, device=config.device, progress=False
        )
    return bundle


def measure(config: Config, name: str) -> Iterator[Row]:
    """Yield the results for an asset."""
    asset = read(name)
    views = views_of(config, asset)
    about: Row = {"asset": Path(name).name.split(".")[0]}
    for row in rows_of(config, views, asset, None):
        yield {**about, "drawn": "all gaussians", **row}
    for stage in config.stages:
        bundle = bundle_of(config, asset, stage)
        for row in rows_of(config, views, bundle, None):
            yield {**about, "drawn": stage, **row}
        for level in range(1, bundle.num_levels if config.levels else 1):
            for row in rows_of(config, views, bundle, level):
                yield {**about, "drawn": f"{stage}, level {level}", **row}


_COLUMNS = (
    Column("asset", "asset"),
    Column("drawn", "drawn"),
    Column("radii", "distance", "g"),
    Column("alpha", "alpha", ".3f"),
    Column("colour", "color", ".3f"),
    Column("red", "r", ".3f"),
    Column("green", "g", ".3f"),
    Column("blue", "b", ".3f"),
    Column("FLIP", "flip", ".4f"),
    Column("gaussians", "gaussians", "count"),
)


def main(config: Config) -> None:
    rows: list[Row] = []
    for name in config.assets:
        of_asset = list(measure(config, name))
        rows += of_asset
        record.write(config.output, {"rows": rows}, config.device)
        print(markdown(_COLUMNS, of_asset), flush=True)
