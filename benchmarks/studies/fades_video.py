"""What an eye makes of a slow drift: ColorVideoVDP of the hard cut and of a fade, beside all gaussians.

Frames of 1920 x 1080 px at 30 a second, as on a screen of that size, against frames of 4 x 4 samples of all
gaussians. Needs a GPU and the package `cvvdp`; docs/fades.md is about the result.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

from benchmarks.evaluation.evaluation import resized
from benchmarks.evaluation.record import write
from benchmarks.evaluation.steadiness import SUPERSAMPLING, paths_from
from v3dg import DEFAULT_FADE, Bundle, Renderer, read_scene
from v3dg.cameras import Camera

_SIZE = (1920, 1080)
_FRAMES_A_SECOND = 30
_DISPLAY = "standard_fhd"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--bundle", type=Path, required=True, help=".v3dg file of the layout's asset")
    parser.add_argument("--layout", type=Path, required=True, help="scene file of instances and cameras")
    parser.add_argument("--cameras", nargs="+", help="names of those from which paths begin")
    parser.add_argument("--frames", type=int, default=60, help="of each path")
    parser.add_argument("--tolerances", type=float, nargs="+", default=[3.0, 9.4])
    parser.add_argument("--paths", nargs="+", default=["drift in", "drift out"])
    parser.add_argument("--json", type=Path, help="write the result there")
    options = parser.parse_args(arguments)

    asset = json.loads(options.layout.read_text(encoding="utf-8"))["asset"]
    scene, cameras = read_scene(options.layout, bundles={asset: Bundle.open(options.bundle)})
    renderer = Renderer(scene, device="cuda")
    rows = []
    for name in options.cameras:
        first = resized(cameras[name], _SIZE)
        for path in paths_from(first, np.mean(scene.positions, axis=0), options.frames):
            if path.name in options.paths:
                rows += measure(
                    renderer, path.cameras, options.tolerances, {"camera": name, "path": path.name}
                )
    result = {"frames": options.frames, "size": _SIZE, "display": _DISPLAY, "rows": rows}
    write(options.json, result, "cuda")
    return 0


def measure(
    renderer: Renderer, cameras: list[Camera], tolerances: list[float], of: dict[str, Any]
) -> list[dict[str, Any]]:
    """Rows of one path: just objectionable differences, 10 where there is none, and gaussians a frame."""
    import pycvvdp

    metric = pycvvdp.cvvdp(display_name=_DISPLAY, device=torch.device("cuda"), quiet=True)
    truth = video(renderer, cameras, SUPERSAMPLING, tolerance=0.0)[0]
    cuts: list[dict[str, Any]] = [{"tolerance": 0.0}]
    for tolerance in tolerances:
        cuts += [{"tolerance": tolerance}, {"tolerance": tolerance, "fade": DEFAULT_FADE}]
    rows = []
    for cut in cuts:
        frames, gaussians = video(renderer, cameras, 1, **cut)
        order = {"dim_order": "FHWC", "frames_per_second": _FRAMES_A_SECOND}
        jod = float(metric.predict(frames, truth, **order)[0])
        rows.append({**of, **cut, "jod": round(jod, 4), "gaussians": gaussians})
        print(rows[-1], flush=True)
    return rows


def video(renderer: Renderer, cameras: list[Camera], samples: int, **cut: Any) -> tuple[Any, float]:
    """(F, H, W, 3) bytes of the frames, each pixel the mean of so many samples squared; gaussians a frame."""
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
