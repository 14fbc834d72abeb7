"""Measures how even the frame times of a flight are: percentiles over 5,000 frames, and
the number of frames that were drawn twice."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.evaluation.assets import read_layout
from benchmarks.evaluation.record import write
from v3dg import Bundle, Camera, Renderer, Scene

# The first frames of a new renderer, whose buffers are still growing, are reported
# separately.
_FIRST_FRAMES = 50
_NUM_WORST = 10
# A frame is compared with the median of this many frames around it.
_NUM_NEIGHBOURS = 101


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
        "--cameras",
        type=int,
        nargs=2,
        default=(40, 60),
        help="range of the layout's cameras, whose distances the flight covers",
    )
    parser.add_argument("--frames", type=int, default=5000)
    parser.add_argument("--tolerances", type=float, nargs="+", default=[3.0, 9.4])
    parser.add_argument("--fade", type=float, default=1.02)
    parser.add_argument(
        "--memory",
        nargs="+",
        default=["none"],
        help=('sizes of page pools, such as 2GB; "none" keeps everything resident'),
    )
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--json", type=Path, help="JSON file for the results")
    options = parser.parse_args(arguments)

    scene, cameras = read_layout(options.layout, Bundle.open(options.bundle))
    chosen = list(cameras.values())[slice(*options.cameras)]
    rows = []
    for memory in options.memory:
        for tolerance in options.tolerances:
            views = flight(scene, chosen, options.frames)
            size = None if memory == "none" else memory
            renderer = Renderer(scene, device=options.device, memory=size)
            row = measure(renderer, views, {"tolerance": tolerance, "fade": options.fade})
            rows.append({"memory": memory, "tolerance": tolerance, "fade": options.fade, **row})
            print(rows[-1], flush=True)
    write(options.json, {"frames": options.frames, "rows": rows}, options.device)
    return 0


def flight(scene: Scene, cameras: list[Camera], count: int) -> list[Camera]:
    """Return cameras that circle the middle of the scene twice, from the distance of
    the farthest camera to that of the nearest camera and back."""
    middle = scene.positions.mean(axis=0)
    offsets = np.array([camera.position - middle for camera in cameras])
    distances = np.linalg.norm(offsets, axis=1)
    top = -np.mean([camera.viewmat[1, :3] for camera in cameras], axis=0)
    top /= np.linalg.norm(top)
    first = cameras[int(distances.argmax())]
    start = first.position - middle
    height = float(start @ top) / float(np.linalg.norm(start))
    along = start - (start @ top) * top
    along /= np.linalg.norm(along)
    across = np.cross(top, along)
    fov_x = 2 * float(np.arctan(first.width / (2 * first.fx)))
    views = []
    for k in range(count):
        angle = 4 * np.pi * k / count
        share = 0.5 + 0.5 * np.cos(2 * np.pi * k / count)
        distance = distances.min() * (distances.max() / distances.min()) ** share
        flat = np.sqrt(1 - height**2)
        direction = height * top + flat * (np.cos(angle) * along + np.sin(angle) * across)
        views.append(
            Camera.look_at(
                middle + distance * direction,
                middle,
                top,
                fov_x,
                width=first.width,
                height=first.height,
                near=first.near,
            )
        )
    return views


def measure(renderer: Renderer, views: list[Camera], options: dict[str, float]) -> dict[str, Any]:
    """Draw the views; return the milliseconds from the call to the finished picture,
    and the number of frames that were drawn again."""
    milliseconds = np.empty(len(views))
    draws = np.empty(len(views), np.int64)
    bytes_in = np.empty(len(views), np.int64)
    for k, camera in enumerate(views):
        start = time.perf_counter()
        image = renderer.render(camera, **options)
        stats = image.stats
        milliseconds[k] = 1e3 * (time.perf_counter() - start)
        draws[k] = image._drawing.finish().num_draws
        bytes_in[k] = stats.bytes_in
    later = slice(_FIRST_FRAMES, None)
    worst = _FIRST_FRAMES + np.argsort(-milliseconds[later])[:_NUM_WORST]
    return {
        **percentiles(milliseconds[later]),
        "of_neighbours": percentiles(of_neighbours(milliseconds[later])),
        "drawn_again": int((draws[later] > 1).sum()),
        "drawn_again_ms": [round(float(ms), 3) for ms in milliseconds[later][draws[later] > 1]][
            :_NUM_WORST
        ],
        "first_frames_ms": [round(float(ms), 3) for ms in milliseconds[:3]],
        "first_frames_drawn_again": int((draws[:_FIRST_FRAMES] > 1).sum()),
        "worst": [
            {
                "frame": int(k),
                "ms": round(float(milliseconds[k]), 3),
                "draws": int(draws[k]),
                "bytes_in": int(bytes_in[k]),
            }
            for k in worst
        ],
    }


def of_neighbours(milliseconds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return each frame's time divided by the median of the frames around it.

    The time of a frame changes with the number of gaussians along a flight. The ratio
    is independent of this. It shows how much longer than its neighbours a frame takes.
    """
    window = min(_NUM_NEIGHBOURS, len(milliseconds) // 2 * 2 - 1)
    padded = np.pad(milliseconds, window // 2, mode="reflect")
    medians = np.median(np.lib.stride_tricks.sliding_window_view(padded, window), axis=1)
    return milliseconds / medians


def percentiles(milliseconds: NDArray[np.float64]) -> dict[str, float]:
    shares = {"p50": 50, "p95": 95, "p99": 99, "most": 100}
    values = np.percentile(milliseconds, list(shares.values()))
    result = {name: round(float(value), 3) for name, value in zip(shares, values, strict=True)}
    return result | {"p99_of_median": round(result["p99"] / result["p50"], 3)}


if __name__ == "__main__":
    sys.exit(main())
