"""Makes donutsea.jpg: a window of a layout as reference picture, with all gaussians,
and with two of our cuts."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import tyro
from PIL import Image, ImageDraw, ImageFont

import v3dg
from v3dg.metrics import box_downsample, flip


@dataclass
class Config:
    bundle: Path
    layout: Path
    output: Path
    camera: int = 59
    window: tuple[int, int, int, int] = (800, 380, 360, 270)
    """Left, top, width and height of the window in px."""
    zoom: int = 2
    tolerances: tuple[float, float] = (3.0, 8.0)


def main(config: Config) -> None:
    name = json.loads(config.layout.read_text())["asset"]
    scene, cameras = v3dg.read_scene(config.layout, bundles={name: v3dg.Bundle.open(config.bundle)})
    whole = list(cameras.values())[config.camera]
    left, top, width, height = config.window
    intrinsics = whole.K.copy()
    intrinsics[:2, 2] -= (left, top)
    camera = replace(whole, K=intrinsics, width=width, height=height)

    truth = box_downsample(
        np.clip(v3dg.render(scene, camera.scaled(2), tolerance=0, device="cpu").color, 0, 1), 2
    )
    panels = [("truth: all gaussians, twice the size, box-averaged", truth)]
    for tolerance in (0.0, *config.tolerances):
        image = v3dg.render(scene, camera, tolerance=tolerance, device="cpu")
        color = np.clip(image.color, 0, 1)
        millions = image.stats.gaussians_in_frustum / 1e6
        count = f"{millions:.2f} M gaussians, FLIP {flip(truth, color):.3f}"
        panels.append(
            (f"{'all' if tolerance == 0 else f'tolerance {tolerance:g}'}: {count}", color)
        )

    font = ImageFont.load_default(size=20)
    w, h, bar = width * config.zoom, height * config.zoom, 36
    sheet = Image.new("RGB", (2 * w + 6, 2 * (h + bar)), "#101214")
    for i, (title, color) in enumerate(panels):
        x, y = i % 2 * (w + 6), i // 2 * (h + bar)
        picture = Image.fromarray((color * 255 + 0.5).astype(np.uint8)).resize(
            (w, h), Image.Resampling.NEAREST
        )
        sheet.paste(picture, (x, y + bar))
        ImageDraw.Draw(sheet).text((x + 8, y + 6), title, fill="#e8e8e8", font=font)
    sheet.save(config.output, quality=85)


if __name__ == "__main__":
    main(tyro.cli(Config))
