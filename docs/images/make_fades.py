"""Makes fades.webp of the donut: a slow drift with a hard cut and with a fade, and a
plot of the changes of the error below them.

python docs/images/make_fades.py donut.v3dg
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from benchmarks.evaluation.steadiness import paths_from, true_picture
from v3dg import DEFAULT_FADE, Bundle, Camera, Gaussians, render
from v3dg.cleaning import ball_of_most
from v3dg.pictures import contact_sheet, to_8bit

SIDE, SCALE, FRAMES, GAIN = 160, 5, 48, 24.0
# rows and columns of the picture that contain the object
WINDOW = slice(52, 108), slice(44, 116)


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
        truth, above, below = true_picture(bundle, camera, "cpu"), [], []
        for name, fade in (("hard cut", None), (f"fade of {DEFAULT_FADE}", DEFAULT_FADE)):
            color = render(bundle, camera, fade=fade, device="cpu").color.clip(0, 1)
            error = color - truth
            change = 0.5 + GAIN * (error - last.get(name, error))
            last[name] = error
            above.append((name, enlarged(color)))
            below.append((f"what changes beside the motion, {GAIN:g} times", enlarged(change)))
        frames.append(Image.fromarray(contact_sheet([above, below])))
    frames[1].save(
        Path(__file__).with_name("fades.webp"),
        save_all=True,
        append_images=frames[2:],
        duration=1000 // 15,
        loop=0,
        quality=60,
    )


def enlarged(picture: np.ndarray) -> np.ndarray:
    """Return the enlarged part of a picture that contains the object, in 8-bit
    colours."""
    pixels = Image.fromarray(to_8bit(picture[WINDOW]))
    size = SCALE * pixels.width, SCALE * pixels.height
    return np.asarray(pixels.resize(size, Image.Resampling.BICUBIC))


if __name__ == "__main__":
    main(sys.argv[1])
