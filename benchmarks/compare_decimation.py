"""Our levels against splat-transform's decimation, at equal counts, with our renderer.

Each count is drawn at two sizes: where selection takes that level (a footprint of one px² per gaussian, tolerance
1), and at a fixed size that is far larger than the coarse levels are meant for. The truth is the whole asset at
twice the resolution, box-averaged. Levels of the bundle halve, so a count that is not a level takes the next
level below it: ours never has more gaussians.

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
from v3dg.metrics import box_downsample, flip, psnr


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


def main(config: Config) -> None:
    asset = v3dg.load(config.asset)
    start = time.perf_counter()
    bundle = v3dg.Bundle.open(config.bundle) if config.bundle else v3dg.build_bundle(asset)
    build_seconds = time.perf_counter() - start
    counts = [len(bundle.level_gaussians(level)) for level in range(bundle.num_levels)]
    reach = np.linalg.norm(asset.means - asset.means.mean(axis=0), axis=1)
    box = np.stack([asset.means.min(axis=0), asset.means.max(axis=0)])
    center = box.mean(axis=0)
    radius = float(np.linalg.norm(asset.means - center, axis=1).max())
    ball = np.array([*center, radius])
    del reach

    rows: list[dict[str, Any]] = []
    for percent in config.percent:
        theirs = v3dg.load(config.decimated / f"{config.asset.stem}_{percent}.ply")
        level = next(k for k, count in enumerate(counts) if count <= max(len(theirs), counts[-1]))
        ours = bundle.level_gaussians(level)
        first = bundle.level_range(level)[0]
        own_filter = float(bundle.clusters.filter_px2[first]), bool(bundle.clusters.antialiased[first])
        for where, footprint in (("selected", float(len(theirs))), ("large", None)):
            scores: dict[str, list[float]] = {"ours_psnr": [], "ours_flip": [], "theirs_psnr": [], "theirs_flip": []}
            for view in range(config.views):
                camera = camera_at(config, ball, view, footprint)
                truth = box_downsample(draw(asset, camera.scaled(2), 0.0, False), 2)
                # Theirs as the asset is drawn, or with our filter if that suits it better.
                theirs_best = max(
                    (draw(theirs, camera, *options) for options in ((0.0, False), own_filter)),
                    key=lambda image: psnr(truth, image),  # noqa: B023
                )
                for who, image in (("ours", draw(ours, camera, *own_filter)), ("theirs", theirs_best)):
                    scores[who + "_psnr"].append(psnr(truth, image))
                    scores[who + "_flip"].append(flip(truth, image))
            rows.append(
                {
                    "percent": float(percent),
                    "where": where,
                    "size_px": camera.width,
                    "ours_gaussians": len(ours),
                    "theirs_gaussians": len(theirs),
                }
                | {key: float(np.mean(values)) for key, values in scores.items()}
            )
    if config.json:
        print(json.dumps({"asset": config.asset.name, "build_seconds": build_seconds, "rows": rows}))
        return
    print(f"{config.asset.name}: {len(asset)} gaussians, {config.views} views; levels of {counts}")
    print("   %  where      px | ours: count  PSNR dB    FLIP | splat-transform: count  PSNR dB    FLIP | wins")
    for r in rows:
        wins = (r["ours_psnr"] > r["theirs_psnr"]) + (r["ours_flip"] < r["theirs_flip"])
        print(
            f"{r['percent']:5g}  {r['where']:8s} {r['size_px']:4d} | {r['ours_gaussians']:11d}  "
            f"{r['ours_psnr']:7.2f}  {r['ours_flip']:.4f} | {r['theirs_gaussians']:22d}  {r['theirs_psnr']:7.2f}  "
            f"{r['theirs_flip']:.4f} | {('no', 'one of two', 'yes')[wins]}"
        )


if __name__ == "__main__":
    main(tyro.cli(Config))
