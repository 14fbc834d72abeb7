"""Lets donuts fall into a pile, and films them. The instances move, and a new cut is
selected in every frame.

The example needs the extra `video`:

    pip install '.[video]'
    python examples/falling_donuts.py
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tyro
from tqdm import tqdm

import v3dg

# The checkout is on the path, so that `benchmarks` can be imported.
sys.path.append(str(Path(__file__).resolve().parents[1]))
from benchmarks.worlds import donut_shower
from benchmarks.worlds.procedural import make_donut
from v3dg.video import write_video

FPS = 30
STEPS_PER_FRAME = 2  # number of steps of the physics, each 1/60 s long
BACKGROUND = (0.80, 0.86, 0.90)


@dataclass
class Config:
    """Let donuts fall into a pile, and film them."""

    output: Path = Path("falling_donuts.mp4")
    """Film to write, an .mp4 file."""
    donuts: int = 240
    """Number of donuts that fall."""
    gaussians: int = 15_000
    """Number of gaussians of each kind of donut."""
    icings: int = 3
    """Number of kinds of donuts, which differ in their icing; at most 4."""
    seconds: float = 4.0
    """Length of the film in seconds."""
    size: tuple[int, int] = (1280, 720)
    """Width and height of the film in px, even numbers."""
    tolerance: float = v3dg.DEFAULT_TOLERANCE
    """Maximum screen area in px² for each gaussian of a coarser cluster."""
    steps: int = v3dg.BuildConfig.steps
    """Number of steps of the fit of each level; fewer steps build faster."""
    seed: int = 0
    device: Literal["auto", "cpu", "cuda"] = "auto"


def main(config: Config) -> None:
    """Build the bundles, simulate the fall, draw the frames and write the film."""
    pile = donut_shower(config.donuts, seed=config.seed, layers=12)
    pile.positions[:, 2] += 0.3  # the lowest donuts are in the air when the film begins
    scene, order = make_scene(config, pile.positions, pile.quaternions, pile.scales)
    num_frames = round(config.seconds * FPS)

    def frames() -> Iterator[Any]:
        for frame in tqdm(range(num_frames), unit="frame"):
            scene.move(positions=pile.positions[order], quaternions=pile.quaternions[order])
            camera = camera_at(frame / num_frames, config)
            yield v3dg.render(
                scene,
                camera,
                tolerance=config.tolerance,
                fade=v3dg.DEFAULT_FADE,
                background=BACKGROUND,
                device=config.device,
            ).color
            for _ in range(STEPS_PER_FRAME):
                pile.step(1 / (FPS * STEPS_PER_FRAME))

    write_video(config.output, frames(), fps=FPS)


def make_scene(
    config: Config, positions: Any, quaternions: Any, scales: Any
) -> tuple[v3dg.Scene, np.ndarray[Any, Any]]:
    """Make the scene, with donuts of several kinds in turn.

    Returns:
        The scene, and for each of its instances the index of a donut in the pile.
    """
    build = v3dg.BuildConfig(steps=config.steps)
    scene, order = v3dg.Scene(), []
    for icing in range(config.icings):
        asset = make_donut(config.gaussians, seed=icing)
        bundle = v3dg.build_bundle(asset, config=build, seed=config.seed, device=config.device)
        chosen = np.arange(icing, config.donuts, config.icings)
        scene.add(bundle, positions[chosen], quaternions[chosen], scales[chosen])
        order.append(chosen)
    return scene, np.concatenate(order)


def camera_at(time: float, config: Config) -> v3dg.Camera:
    """Return a camera that slowly circles the pile and moves down; ``time`` is in
    [0,1]."""
    azimuth, elevation = 0.5 + 0.9 * time, 0.42 - 0.12 * time
    reach = 0.10 * math.sqrt(config.donuts / 12) + 0.25
    away = np.array(
        [
            math.cos(elevation) * math.sin(azimuth),
            -math.cos(elevation) * math.cos(azimuth),
            math.sin(elevation),
        ]
    )
    target = np.array([0.0, 0.0, 0.25 - 0.12 * time])
    width, height = config.size
    return v3dg.Camera.look_at(target + 5.0 * reach * away, target, width=width, height=height)


if __name__ == "__main__":
    main(tyro.cli(Config))
