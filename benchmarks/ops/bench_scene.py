"""A layout of many instances of a bundle: number of gaussians, time and error of a
frame, for several tolerances.

Pictures are compared with the picture `truth` or, without one, with the full asset
drawn at twice the size and averaged over 2 x 2 pixels.
"""

from __future__ import annotations

import statistics
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg import metrics
from v3dg.bundle import Bundle
from v3dg.render import render


@dataclass
class Config:
    bundle: Path
    layout: Path
    camera: int = 59
    """Index of the camera in the layout."""
    tolerances: tuple[float, ...] = (8.0, 4.4, 3.0, 2.0)
    truth: Path | None = None
    repeats: int = 3
    pictures: Path | None = None
    """Folder for the pictures; by default they are not saved."""
    output: str | None = None
    """JSON file for the results."""
    tags: dict[str, str] = field(default_factory=dict)


def main(config: Config) -> None:
    bundle = Bundle.open(config.bundle)
    scene, cameras = read_layout(config.layout, bundle)
    name, camera = list(cameras.items())[config.camera]
    if config.truth is not None:
        truth = np.asarray(Image.open(config.truth).convert("RGB"), np.float32) / 255
    else:
        truth = metrics.box_downsample(
            np.clip(render(scene, camera.scaled(2), tolerance=0, device="cpu").color, 0, 1), 2
        )
    rows = []
    for tolerance in config.tolerances:
        frames = [
            render(scene, camera, tolerance=tolerance, device="cpu")
            for _ in range(config.repeats + 1)
        ]
        stats = [frame.stats for frame in frames[1:]]
        color = np.round(np.clip(frames[-1].color, 0, 1) * 255) / np.float32(255)
        row = {
            "tolerance": tolerance,
            "gaussians_selected": stats[0].gaussians_selected,
            "gaussians_in_frustum": stats[0].gaussians_in_frustum,
            "select_ms": round(statistics.median(s.select_ms for s in stats), 1),
            "draw_ms": round(statistics.median(s.draw_ms for s in stats), 1),
            "flip": round(metrics.flip(truth, color), 4),
            "psnr": round(metrics.psnr(truth, color), 2),
        }
        rows.append(row)
        print(row, flush=True)
        if config.pictures is not None:
            config.pictures.mkdir(parents=True, exist_ok=True)
            Image.fromarray((color * 255).astype(np.uint8)).save(
                config.pictures / f"{name}_tolerance{tolerance:g}.png"
            )
    record.write(
        config.output,
        {
            "camera": name,
            "width": camera.width,
            "height": camera.height,
            "build": bundle.config,
            "frames": rows,
        },
    )


if __name__ == "__main__":
    main(tyro.cli(Config))
