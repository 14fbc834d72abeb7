"""Errors of cuts before and after a refinement of the levels.

    python -m benchmarks.studies.refined --asset donut.ply --layout donutsea.json \\
        -o refined
    python -m benchmarks.studies.refined --asset donut.ply --picture refined.png \\
        --device cpu
    python -m benchmarks.studies.refined --asset room.ply --eyes transforms.json \\
        -o refined

With `--layout`, the study measures FLIP, PSNR and SSIM of cuts of a layout from some of
its cameras, against all gaussians at 3 x 3 samples per pixel. With `--picture`, it
draws the asset and a cut with a sixth of its gaussians at three times the native size,
before and after the refinement. With `--eyes`, a file of cameras in a scene, it
measures errors of cuts with some fractions of the gaussians in the frustum: as built,
refined from all around, and refined from other cameras near the eyes.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from benchmarks.studies import unseen
from benchmarks.studies.pairs.measure import errors
from benchmarks.studies.unseen import others_of
from v3dg import _device
from v3dg._judges import Judges
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, contact_sheet, to_8bit, write_picture

Row = dict[str, Any]
_SAMPLES, _PART, _SIZE = 3, 6, 3


@dataclass
class Config:
    asset: Path
    layout: Path | None = None
    cameras: tuple[int, ...] = (59, 45)
    tolerances: tuple[float, ...] = (3.0, 9.4, 40.0)
    steps: int = 30_000
    device: Literal["auto", "cpu", "cuda"] = "auto"
    eyes: Path | None = None
    shares: tuple[float, ...] = (0.9, 0.7, 0.5, 0.3)
    picture: Path | None = None
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None


def pictures(
    config: Config, bundles: dict[str, v3dg.Bundle]
) -> Iterator[tuple[Row, Picture, Picture]]:
    for number in config.cameras:
        truth = None
        for name, bundle in bundles.items():
            scene, cameras = read_layout(str(config.layout), bundle)
            camera = list(cameras.values())[number]
            if truth is None:
                truth = draw_truth(scene, camera, config.device, _SAMPLES)
            for tolerance in config.tolerances:
                image = v3dg.render(scene, camera, tolerance=tolerance, device=config.device)
                row = {"camera": number, "tolerance": tolerance, "levels": name}
                yield row, truth, to_8bit(image.color)


def seen_from(
    config: Config, bundles: dict[str, v3dg.Bundle], eyes: list[v3dg.Camera]
) -> Iterator[tuple[Row, Picture, Picture]]:
    """Yield the description, reference and picture of each cut, seen by cameras in a
    scene."""
    for number, camera in enumerate(eyes):
        truth = draw_truth(bundles["built"], camera, config.device, _SAMPLES)
        everything = v3dg.select(bundles["built"], camera, tolerance=0, device="cpu").num_gaussians
        for share in (1.0, *config.shares):
            for name, bundle in bundles.items():
                budget = {"budget": round(share * everything)} if share < 1 else {"tolerance": 0.0}
                try:
                    image = v3dg.render(bundle, camera, device=config.device, **budget)
                # The eye is inside the balls of groups, so even the coarsest cut has
                # too many gaussians.
                except ValueError:
                    continue
                yield {"eye": number, "share": share, "levels": name}, truth, to_8bit(image.color)


def sheet(config: Config, asset: v3dg.Gaussians, bundles: dict[str, v3dg.Bundle]) -> Picture:
    """Return a picture with the asset and its cuts side by side."""
    budget = len(asset) // _PART
    side = _SIZE * math.ceil(math.sqrt(2 * budget))
    center = np.median(asset.means, axis=0)
    radius = float(np.quantile(np.linalg.norm(asset.means - center, axis=1), 0.99))
    camera = v3dg.turntable(center, 2.5 * radius, 1, 0.7, width=side, height=side)[0]
    row = [("all gaussians", draw_truth(asset, camera, config.device, 4))]
    for name, bundle in bundles.items():
        image = v3dg.render(bundle, camera, budget=budget, device=config.device)
        row.append((f"{image.stats.gaussians_selected:,}, {name}", to_8bit(image.color)))
    return contact_sheet([row])


def main(config: Config) -> None:
    asset = v3dg.read_asset(config.asset)
    built = v3dg.build_bundle(asset, device=config.device, progress=False)
    start = time.perf_counter()
    refined = v3dg.refine_bundle(built, steps=config.steps, device=config.device, progress=False)
    result: Row = {"steps": config.steps, "refine_seconds": round(time.perf_counter() - start, 1)}
    bundles = {"built": built, "refined": refined}
    eyes = [] if config.eyes is None else list(v3dg.read_cameras(config.eyes).values())
    if eyes:
        beside = others_of(
            unseen.Config(config.asset, others=96, turn=0.5, width=eyes[0].width), eyes
        )
        how: Row = {"steps": config.steps, "device": config.device, "progress": False}
        bundles["refined from beside"] = v3dg.refine_bundle(built, cameras=beside, **how)
    if config.picture is not None:
        write_picture(config.picture, sheet(config, asset, bundles))
    of_layout = () if config.layout is None else pictures(config, bundles)
    shown = itertools.chain(of_layout, seen_from(config, bundles, eyes))
    with contextlib.closing(Judges()) as judges:
        result["rows"] = [row | found for (row, _, _), found in judges.measured(shown, errors)]
    print(result)
    record.write(config.output, result, "cuda" if _device.resolve(config.device).is_cuda else "cpu")
