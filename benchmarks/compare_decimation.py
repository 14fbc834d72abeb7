"""Our levels against splat-transform's decimation, at equal counts, with our renderer.

Each count is drawn at three sizes, of which the first two have px² in proportion to the count:
ball: one px² per gaussian of the footprint of the ball around the whole asset; one level of ours.
cut: where the cut at the default tolerance, cluster by cluster, has that many gaussians; that cut of ours.
    This is the size at which the levels are selected.
large: a fixed size, far larger than the coarse levels are meant for; one level of ours.

The truth is the whole asset at twice the resolution, box-averaged; beside it stands what the asset itself
reaches at one sample a pixel. Levels halve, rounding up cluster by cluster, so a count is met by the largest
level that has at most 1 % more gaussians.

Make the decimated files first (splat-transform 3.7.0; names as below, in one directory):

    splat-transform -g cpu -w donut.ply -d 50% donut_50.ply      and 25, 12.5, 6.25, 1
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

import v3dg
from v3dg.build import build_bundle
from v3dg.metrics import box_downsample, flip, psnr
from v3dg.render import render


@dataclass
class Config:
    asset: Annotated[Path, tyro.conf.Positional]
    """A .ply file."""
    decimated: Path
    """Directory of splat-transform's files, <asset>_<percent>.ply."""
    bundle: Path | None = None
    """A bundle of the asset; built with the defaults if not given."""
    percent: tuple[str, ...] = ("50", "25", "12.5", "6.25", "1")
    size: int = 400
    """Side of the large pictures in px."""
    fov: float = 50.0
    """Of the large pictures, in degrees."""
    views: int = 8
    json: bool = False


def camera_at(config: Config, ball: np.ndarray, view: int, footprint_px2: float | None) -> v3dg.Camera:
    """A camera around the ball: the large picture, or one in which the ball covers so many px²."""
    # Directions spread over the sphere between 50 degrees below and above the horizon, a spiral.
    z = 0.77 * (2 * (view + 0.5) / config.views - 1)
    angle = 2.399963229728653 * view
    side = math.sqrt(1 - z * z)
    direction = np.array([side * math.cos(angle), side * math.sin(angle), z])
    center, radius = ball[:3].astype(np.float64), float(ball[3])
    fov = math.radians(config.fov)
    distance = 1.05 * radius / math.sin(fov / 2)
    size = config.size
    if footprint_px2 is not None:
        x2 = (radius / distance) ** 2
        solid_angle = 2 * math.pi * x2 / (1 + math.sqrt(1 - x2))
        focal = math.sqrt(footprint_px2 / solid_angle)
        # As many pixels as the ball needs; the field of view follows, for the focal length is exact.
        size = math.ceil(2 * focal * math.tan(fov / 2))
        fov = 2 * math.atan(size / (2 * focal))
    return v3dg.Camera.look_at(
        center + distance * direction, center, (0.0, 0.0, 1.0), fov, width=size, height=size
    )


def draw(gaussians: v3dg.Gaussians, camera: v3dg.Camera, filter_px2: float, antialiased: bool) -> np.ndarray:
    raster = v3dg.rasterize(gaussians, camera, filter_px2=filter_px2, antialiased=antialiased)
    return np.clip(raster.color, 0, 1)


def footprint_of_cut(config: Config, bundle: v3dg.Bundle, ball: np.ndarray, count: int) -> float:
    """Footprint of the ball at which the default cut has `count` gaussians, averaged over views."""
    low, high = 1.0, 64.0 * count
    for _ in range(24):
        middle = math.sqrt(low * high)
        cameras = [camera_at(config, ball, view, middle) for view in range(config.views)]
        mean = np.mean(
            [v3dg.select(bundle, c, tolerance=v3dg.DEFAULT_TOLERANCE).num_gaussians for c in cameras]
        )
        low, high = (middle, high) if mean <= count else (low, middle)
    return low


def main(config: Config) -> None:
    asset = v3dg.load(config.asset)
    start = time.perf_counter()
    bundle = v3dg.Bundle.open(config.bundle) if config.bundle else build_bundle(asset)
    build_seconds = time.perf_counter() - start
    counts = [len(bundle.level_gaussians(level)) for level in range(bundle.num_levels)]
    center = (asset.means.min(axis=0) + asset.means.max(axis=0)) / 2
    ball = np.array([*center, np.linalg.norm(asset.means - center, axis=1).max()])

    rows: list[dict[str, Any]] = []
    for percent in config.percent:
        theirs = v3dg.load(config.decimated / f"{config.asset.stem}_{percent}.ply")
        num = len(theirs)
        level = next(k for k, count in enumerate(counts) if count <= max(1.01 * num, counts[-1]))
        ours = bundle.level_gaussians(level)
        first = bundle.level_range(level)[0]
        own_filter = float(bundle.clusters.filter_px2[first]), bool(bundle.clusters.antialiased[first])
        footprints = {"ball": float(num), "cut": footprint_of_cut(config, bundle, ball, num), "large": None}
        for where, footprint in footprints.items():
            scores: dict[str, list[float]] = {}
            for view in range(config.views):
                camera = camera_at(config, ball, view, footprint)
                truth = box_downsample(draw(asset, camera.scaled(2), 0.0, False), 2)
                images = {
                    "asset": draw(asset, camera, 0.0, False),
                    "theirs": draw(theirs, camera, 0.0, False),
                }
                # Theirs as the asset is drawn, or with our filter where that suits it better.
                filtered = draw(theirs, camera, *own_filter)
                if psnr(truth, filtered) > psnr(truth, images["theirs"]):
                    images["theirs"] = filtered
                if where == "cut":
                    drawn = render(bundle, camera)
                    images["ours"] = np.clip(drawn.color, 0, 1)
                    scores.setdefault("ours_gaussians", []).append(drawn.stats.gaussians_selected)
                else:
                    images["ours"] = draw(ours, camera, *own_filter)
                    scores.setdefault("ours_gaussians", []).append(len(ours))
                for who, image in images.items():
                    scores.setdefault(who + "_psnr", []).append(psnr(truth, image))
                    scores.setdefault(who + "_flip", []).append(flip(truth, image))
            row = {
                "percent": float(percent),
                "where": where,
                "size_px": camera.width,
                "theirs_gaussians": num,
            }
            rows.append(row | {key: float(np.mean(values)) for key, values in scores.items()})
    if config.json:
        print(json.dumps({"asset": config.asset.name, "build_seconds": build_seconds, "rows": rows}))
        return
    print(f"{config.asset.name}: {len(asset)} gaussians, {config.views} views; levels of {counts}")
    print(
        "    % where   px |  ours: count      dB    FLIP | theirs: count     dB    FLIP | asset: dB    FLIP"
    )
    for r in rows:
        text = f"{r['percent']:5g} {r['where']:5s} {r['size_px']:4d} "
        for who in ("ours", "theirs"):
            text += f"| {r[who + '_gaussians']:12.0f}  {r[who + '_psnr']:6.2f}  {r[who + '_flip']:.4f} "
        wins = (r["ours_psnr"] > r["theirs_psnr"]) + (r["ours_flip"] < r["theirs_flip"])
        text += f"|    {r['asset_psnr']:6.2f}  {r['asset_flip']:.4f} "
        print(text + f"| ours wins: {('no', 'one of two', 'yes')[wins]}")


if __name__ == "__main__":
    main(tyro.cli(Config))
