"""Makes fades.webp: a slow drift, hard cut and fade, and below what changes beside the motion."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.evaluation.steadiness import paths_from, true_picture
from v3dg import DEFAULT_FADE, Bundle, Camera, Gaussians, render
from v3dg.cleaning import ball_of_most

SIDE, SCALE, FRAMES, GAIN = 160, 5, 48, 24.0
WINDOW = slice(52, 108), slice(44, 116)  # that the object is in


def main(path: str) -> None:
    bundle = Bundle.open(path)
    level: Gaussians = bundle.level_gaussians(0)
    center, radius = ball_of_most(level.means)
    eye = center + 3 * 2 * radius * np.array([np.cos(0.45), 0, np.sin(0.45)])
    first = Camera.look_at(eye, center, width=SIDE, height=SIDE, near=1e-3 * radius)
    cameras = paths_from(first, center, FRAMES)[0].cameras
    last: dict[str, np.ndarray] = {}
    frames = []
    for camera in cameras:
        truth, columns = true_picture(bundle, camera, "cpu"), []
        for name, fade in (("hard", None), ("fade", DEFAULT_FADE)):
            color = render(bundle, camera, fade=fade, device="cpu").color.clip(0, 1)
            error = color - truth
            change = 0.5 + GAIN * (error - last.get(name, error))
            last[name] = error
            columns.append(np.concatenate([color[WINDOW], change[WINDOW].clip(0, 1)]))
        pixels = (255 * np.concatenate(columns, axis=1)).astype(np.uint8)
        picture = Image.fromarray(pixels)
        size = SCALE * picture.width, SCALE * picture.height
        frames.append(picture.resize(size, Image.Resampling.BICUBIC))
    frames[1].save(
        Path(__file__).with_name("fades.webp"),
        save_all=True,
        append_images=frames[2:],
        duration=1000 // 15,
        loop=0,
        quality=60,
    )


if __name__ == "__main__":
    main(sys.argv[1])
