"""The cost of the codecs of bundles in bytes and in picture quality.

    python -m benchmarks.studies.codecs --up 0 -1 0 --assets angel.sog st-peter.sog

Each asset, or its part that is nearest to its middle, is built with each codec.
Pictures are drawn at the default tolerance from four sides at four distances. `psnr`
compares the float32 bundle with its own conversion to the codec, so it is the error of
the codec alone. `flip` compares 8-bit pictures with pictures of the whole asset with
several samples per pixel, for the bundle built with each codec and for the converted
bundle. docs/notes/experiments/2026-11-22-codecs-error-and-size.md has results.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import v3dg
from v3dg.bundle.codec import CODECS
from v3dg.metrics import box_downsample, flip, psnr
from v3dg.pictures import to_8bit

# Distances of the camera, in radii of the ball with 90 % of the gaussians.
DISTANCES = (1.0, 2.5, 8.0, 25.0)
WIDTH, HEIGHT = 480, 360


@dataclass
class Config:
    assets: tuple[Path, ...]
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    most: int = 100_000
    """Maximum number of gaussians to use of an asset."""
    steps: int = 600
    """Maximum number of steps of a fit."""
    samples: int = 3
    """Samples per side of a pixel of the reference pictures."""


def part_of(asset: v3dg.Gaussians, most: int) -> v3dg.Gaussians:
    """Return the gaussians nearest to the median position, in the order of the
    asset."""
    if len(asset) <= most:
        return asset
    distance = np.linalg.norm(asset.means - np.median(asset.means, axis=0), axis=1)
    return asset.subset(np.sort(np.argsort(distance)[:most]))


def cameras_of(
    asset: v3dg.Gaussians, up: Sequence[float], distance: float, samples: int = 1
) -> list[v3dg.Camera]:
    """Return four cameras around the asset, whose pictures are larger by a factor of
    `samples`."""
    centre = np.median(asset.means, axis=0).astype(np.float64)
    radius = np.quantile(np.linalg.norm(asset.means - centre, axis=1), 0.9)
    axis = np.asarray(up) / np.linalg.norm(up)
    side = np.cross(axis, np.eye(3)[np.abs(axis).argmin()])
    side /= np.linalg.norm(side)
    eyes = (
        centre
        + distance * radius * (np.cos(a) * side + np.sin(a) * np.cross(axis, side) + 0.3 * axis)
        for a in np.pi / 2 * (np.arange(4) + 0.2)
    )
    size = {"width": WIDTH * samples, "height": HEIGHT * samples}
    return [v3dg.Camera.look_at(eye, centre, up=axis, **size) for eye in eyes]


def pictures(subject: Any, cameras: Sequence[v3dg.Camera]) -> list[Any]:
    return [np.clip(image.color, 0, 1) for image in v3dg.render(subject, cameras, device="cpu")]


def mean_psnr(references: Sequence[Any], tests: Sequence[Any]) -> float:
    """Return the PSNR of the squared error averaged over all pictures."""
    errors = [10 ** (-psnr(a, b) / 10) for a, b in zip(references, tests, strict=True)]
    return round(-10 * float(np.log10(np.mean(errors))), 2)


def mean_flip(truths: Sequence[Any], tests: Sequence[Any]) -> float:
    shown = ([to_8bit(picture) / np.float32(255) for picture in pair] for pair in (truths, tests))
    return round(float(np.mean([flip(*pair) for pair in zip(*shown, strict=True)])), 5)


def measure(asset: v3dg.Gaussians, options: Config, folder: Path) -> dict[str, Any]:
    config = v3dg.BuildConfig(steps=options.steps, first_steps=min(options.steps, 150))
    bundles, bytes_a_leaf = {}, {}
    for codec in CODECS:
        bundle = v3dg.build_bundle(asset, config=config, progress=False, codec=codec)
        bundle.write(folder / codec)
        leaves = len(bundle.level_gaussians(0))
        bundles[codec] = bundle
        bytes_a_leaf[codec] = round((folder / codec).stat().st_size / leaves, 2)
    kept = bundles["float32"]
    result: dict[str, Any] = {"leaves": leaves, "sh_degree": asset.sh_degree, "bytes": bytes_a_leaf}
    for distance in DISTANCES:
        cameras = cameras_of(asset, options.up, distance)
        truths = pictures(asset, cameras_of(asset, options.up, distance, options.samples))
        truths = [box_downsample(picture, options.samples) for picture in truths]
        drawn = {codec: pictures(bundle, cameras) for codec, bundle in bundles.items()}
        told: dict[str, Any] = {"psnr": {}}
        for codec in bundles.keys() - {kept.codec}:
            same = v3dg.Bundle(kept.clusters, kept.groups, kept.gaussians, kept.config, codec)
            drawn[f"{codec}, converted"] = pictures(same, cameras)
            told["psnr"][codec] = mean_psnr(drawn[kept.codec], drawn[f"{codec}, converted"])
        told["flip"] = {how: mean_flip(truths, tests) for how, tests in drawn.items()}
        result[f"{distance:g} radii"] = told | {
            "drawn": v3dg.select(kept, cameras[0]).num_gaussians
        }
    return result


def main(options: Config) -> None:
    for path in options.assets:
        asset = part_of(v3dg.read_asset(path), options.most)
        with tempfile.TemporaryDirectory() as folder:
            row = measure(asset, options, Path(folder))
        print(json.dumps({"asset": str(path), **row}), flush=True)


if __name__ == "__main__":
    main(tyro.cli(Config))
