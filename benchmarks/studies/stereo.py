"""Measures the time of pictures for both eyes of a headset: one frame of two pictures
with a shared cut, in comparison with two frames."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from benchmarks.evaluation.assets import read_layout
from benchmarks.evaluation.measure import time_ms
from benchmarks.evaluation.record import write
from v3dg import Bundle, Camera, Renderer, StereoCamera

_FOV = 1.57  # field of view of each eye in radians
_EYE_DISTANCE = 0.064


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
        help=("range of the layout's cameras: the first index, and the index after the last one"),
    )
    parser.add_argument(
        "--side", type=int, default=2160, help=("width and height of the pictures in px")
    )
    parser.add_argument("--tolerances", type=float, nargs="+", default=[9.4, 20.0])
    parser.add_argument("--repeats", type=int, default=11)
    parser.add_argument("--json", type=Path, help="JSON file for the results")
    options = parser.parse_args(arguments)

    scene, cameras = read_layout(options.layout, Bundle.open(options.bundle))
    renderer = Renderer(scene, device="cuda")
    rows = []
    for tolerance in options.tolerances:
        for name, camera in list(cameras.items())[slice(*options.cameras)]:
            stereo = headset(camera, options.side)
            row = measure(renderer, stereo, tolerance, options.repeats)
            rows.append({"tolerance": tolerance, "camera": name, **row})
            print(rows[-1], flush=True)
    result = {"side": options.side, "fov_x": _FOV, "eye_distance": _EYE_DISTANCE, "rows": rows}
    write(options.json, result, "cuda")
    return 0


def headset(camera: Camera, side: int) -> StereoCamera:
    """Return the cameras of two eyes at the position and with the rotation of a
    camera."""
    ahead, top = camera.viewmat[2, :3], -camera.viewmat[1, :3]
    middle = Camera.look_at(
        camera.position, camera.position + ahead, top, _FOV, width=side, height=side
    )
    return StereoCamera.of(middle, _EYE_DISTANCE)


def measure(
    renderer: Renderer, stereo: StereoCamera, tolerance: float, repeats: int
) -> dict[str, Any]:
    """Return the milliseconds from the call to both pictures, for one frame and for two
    frames, and the gaussians of the shared cut."""

    def one_frame() -> list[Any]:
        return [picture.color for picture in renderer.render(stereo, tolerance=tolerance)]

    def two_frames() -> list[Any]:
        return [renderer.render(eye, tolerance=tolerance).color for eye in stereo.eyes]

    return {
        "one_frame_ms": round(time_ms(one_frame, "cuda", repeats).median, 3),
        "two_frames_ms": round(time_ms(two_frames, "cuda", repeats).median, 3),
        "gaussians": renderer.render(stereo, tolerance=tolerance)[0].stats.gaussians_selected,
    }


if __name__ == "__main__":
    sys.exit(main())
