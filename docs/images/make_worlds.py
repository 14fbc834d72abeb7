"""Makes worlds.jpg: the assets and the worlds of benchmarks/worlds, each seen from
near."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tyro
from PIL import Image

import v3dg

# to import benchmarks/ of this checkout
sys.path.append(str(Path(__file__).resolve().parents[2]))
from benchmarks import worlds
from benchmarks.worlds import procedural
from v3dg.metrics import box_downsample
from v3dg.pictures import to_8bit

BACKGROUND = (0.70, 0.78, 0.84)
WIDTH, HEIGHT = 352, 264
# The functions that make assets, each with its view: azimuth, elevation, distance and
# target.
ASSETS: list[tuple[Any, tuple[float, float, float, tuple[float, float, float]]]] = [
    (procedural.make_donut, (0.4, 0.65, 0.40, (0, 0, 0))),
    (lambda: procedural.make_tree(kind="maple"), (0.6, 0.12, 14.5, (0, 0, 3.9))),
    (lambda: procedural.make_temple(700_000), (0.55, 0.20, 46, (0, 0, 4.6))),
    (lambda: procedural.make_person(seed=2), (0.35, 0.10, 2.1, (0, 0, 1.33))),
]
# For each picture: the world, its arguments, and the camera.
WORLDS: list[tuple[str, dict[str, int], str]] = [
    ("donut_sea", {"instances": 500, "num_gaussians": 20_000}, "053_camera_13"),
    ("forest", {"instances": 60, "num_gaussians": 60_000}, "032_camera_12"),
    ("temples", {"instances": 14, "num_gaussians": 200_000}, "031_camera_11"),
    ("crowd", {"instances": 100, "num_gaussians": 40_000, "persons": 8}, "235_camera_15"),
]


@dataclass
class Config:
    output: Path = Path("docs/images/worlds.jpg")


def main(config: Config) -> None:
    top = [picture(make(), look(*view)) for make, view in ASSETS]
    below = []
    for name, arguments, camera in WORLDS:
        world = worlds.WORLDS[name](**arguments)
        # Only level 0 is drawn, so coarser levels need no fit.
        build = v3dg.BuildConfig(steps=0)
        bundles = {
            key: v3dg.build_bundle(asset.make(), config=build, progress=False, quality="draft")
            for key, asset in world.assets.items()
        }
        cameras = world.cameras(width=WIDTH, height=HEIGHT)
        below.append(picture(worlds.scene_of(world, bundles), cameras[camera]))
    sheet = np.concatenate([np.concatenate(row, 1) for row in (top, below)])
    Image.fromarray(to_8bit(sheet)).save(config.output, quality=86)


def look(
    azimuth: float, elevation: float, distance: float, target: tuple[float, float, float]
) -> v3dg.Camera:
    flat = np.cos(elevation)
    away = np.array([flat * np.sin(azimuth), -flat * np.cos(azimuth), np.sin(elevation)])
    return v3dg.Camera.look_at(target + distance * away, target, width=WIDTH, height=HEIGHT)


def picture(subject: Any, camera: v3dg.Camera) -> Any:
    image = v3dg.render(subject, camera.scaled(2), tolerance=0, background=BACKGROUND, device="cpu")
    return box_downsample(np.clip(image.color, 0, 1), 2)


if __name__ == "__main__":
    main(tyro.cli(Config))
