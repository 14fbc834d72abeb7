"""The visibility of pops during a slow drift: ColorVideoVDP of the hard cut and of a
fade.

Frames at 30 per second, as on a screen of 1920 x 1080 px, are compared with two
references. The reference "truth" has all gaussians with 4 x 4 samples per pixel, so a
cut differs from it everywhere and in all frames. The reference "frozen" draws the same
path with the cut of its middle frame, so a cut differs from it only by changes of
levels while the camera moves. The study needs the package `cvvdp`, and a GPU for large
pictures. docs/fades.md discusses the results.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.evaluation.evaluation import resized
from benchmarks.evaluation.record import write
from benchmarks.evaluation.steadiness import SUPERSAMPLING, paths_from
from v3dg import DEFAULT_FADE, Bundle, Renderer, Scene, read_scene, select
from v3dg.cameras import Camera

_FRAMES_A_SECOND = 30
_DISPLAY = "standard_fhd"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--bundle", type=Path, required=True, help=".v3dg file of the layout's asset"
    )
    parser.add_argument(
        "--layout", type=Path, required=True, help="scene file with instances and cameras"
    )
    parser.add_argument(
        "--cameras", nargs="+", help=("names of the layout's cameras from which paths begin")
    )
    parser.add_argument("--frames", type=int, default=60, help="number of frames of each path")
    parser.add_argument(
        "--size",
        type=int,
        nargs=2,
        default=[1920, 1080],
        help=("width and height of the pictures in px"),
    )
    parser.add_argument(
        "--references", nargs="+", default=["truth", "frozen"], choices=["truth", "frozen"]
    )
    parser.add_argument("--device", default="cuda", choices=["cpu", "cuda"])
    parser.add_argument("--tolerances", type=float, nargs="+", default=[3.0, 9.4])
    parser.add_argument("--paths", nargs="+", default=["drift in", "drift out"])
    parser.add_argument("--json", type=Path, help="JSON file for the results")
    options = parser.parse_args(arguments)

    asset = json.loads(options.layout.read_text(encoding="utf-8"))["asset"]
    scene, cameras = read_scene(options.layout, bundles={asset: Bundle.open(options.bundle)})
    rows = []
    for name in options.cameras:
        first = resized(cameras[name], tuple(options.size))
        middle = np.mean(scene.positions, axis=0)
        upwards = -first.viewmat[1, :3]
        aimed = Camera.look_at(
            first.position, middle, upwards, width=first.width, height=first.height
        )
        for path in paths_from(replace(first, viewmat=aimed.viewmat), middle, options.frames):
            if path.name in options.paths:
                of = {"camera": name, "path": path.name}
                rows += [{**of, **row} for row in measure(scene, path.cameras, options)]
    result = {"frames": options.frames, "size": options.size, "display": _DISPLAY, "rows": rows}
    write(options.json, result, options.device)
    return 0


def measure(
    scene: Scene, cameras: list[Camera], options: argparse.Namespace
) -> list[dict[str, Any]]:
    """Measure one path.

    Returns:
        Rows with ColorVideoVDP's quality in JOD (just-objectionable differences; 10
        means no visible difference) and gaussians per frame.
    """
    import pycvvdp

    metric = pycvvdp.cvvdp(display_name=_DISPLAY, device=torch.device(options.device), quiet=True)
    renderer = Renderer(scene, device=options.device)
    truth = None
    if "truth" in options.references:
        truth = video(renderer, cameras, SUPERSAMPLING, tolerance=0.0)[0]
    rows: list[dict[str, Any]] = []
    for tolerance in [*([] if truth is None else [0.0]), *options.tolerances]:
        references, cut = {"truth": truth}, None
        if tolerance > 0 and "frozen" in options.references:
            middle = cameras[len(cameras) // 2]
            cut = select(scene, middle, tolerance=tolerance, cull=False, device=options.device)
        for fade in [None, DEFAULT_FADE] if tolerance > 0 else [None]:
            # The reference is drawn like the frames, with or without weights, so that
            # only pops differ.
            if cut is not None:
                weights = None if fade is None else np.ones(len(cut), np.float32)
                still = replace(cut, given_weights=weights)
                references["frozen"] = video(renderer, cameras, 1, cut=still)[0]
            frames, gaussians = video(renderer, cameras, 1, tolerance=tolerance, fade=fade)
            row = {"tolerance": tolerance, "fade": fade, "gaussians": gaussians}
            for name, reference in references.items():
                if reference is not None:
                    order = {"dim_order": "FHWC", "frames_per_second": _FRAMES_A_SECOND}
                    row[f"jod_{name}"] = round(
                        float(metric.predict(frames, reference, **order)[0]), 4
                    )
            rows.append(row)
            print(row, flush=True)
    return rows


def video(renderer: Renderer, cameras: list[Camera], samples: int, **cut: Any) -> tuple[Any, float]:
    """Draw frames whose pixels are means of `samples` x `samples` samples.

    Returns:
        (F, H, W, 3) bytes, and the mean number of gaussians per frame.
    """
    frames, gaussians = [], 0
    for camera in cameras:
        image = renderer.render(camera.scaled(samples), **cut)
        color = torch.as_tensor(image.color).clamp(0, 1).movedim(-1, 0)
        mean = torch.nn.functional.avg_pool2d(color, samples).movedim(0, -1)
        frames.append((255 * mean).round().byte().cpu())
        gaussians += image.stats.gaussians_selected
    return torch.stack(frames).numpy(), gaussians / len(cameras)


if __name__ == "__main__":
    sys.exit(main())
