"""The response time of the viewer to mouse drags: milliseconds from a move of the
camera to the picture that answers it.

A client in Python speaks the protocol of the viewer's page over a local socket, so
everything except the browser's own work is measured. Each drag orbits the scene, and
begins while the still picture is being refined.
"""

from __future__ import annotations

import math
import statistics
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro

from benchmarks.evaluation import record
from v3dg.scene.file import read_scene
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site
from v3dg.viewer.view import View, look_at

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from viewer_client import Tab

MOVES_A_SECOND = 60


@dataclass
class Config:
    scene: Path
    cameras: tuple[int, ...] = (3, 10, 19, 59)
    """Indices of the cameras in the file from which drags begin."""
    drags: int = 8
    """Number of drags per camera."""
    seconds: float = 1.5
    """Duration of a drag in seconds."""
    size: tuple[int, int] = (1600, 900)
    """Width and height of the browser's window in px."""
    device: str = "cpu"
    output: str | None = None
    """JSON file for the results."""


def main(config: Config) -> None:
    scene, cameras = read_scene(config.scene)
    scene_view = SceneView(scene, device=config.device)
    site = Site(scene_view, port=0)
    rng = np.random.default_rng(0)
    rows = []
    try:
        with Tab(site.port) as browser:
            for place in config.cameras:
                name, camera = list(cameras.items())[place]
                view = View.of_camera(camera)
                rows.append(
                    {"camera": name, **drag_around(browser, view, scene_view.center, config, rng)}
                )
                print(rows[-1], flush=True)
    finally:
        site.close()
    record.write(config.output, {"size": config.size, "cameras": rows}, config.device)


def drag_around(
    browser: Tab, view: View, target: np.ndarray, config: Config, rng: np.random.Generator
) -> dict:
    """Drag around the target; return the times of answers, gaps between pictures, and
    widths of the first pictures."""
    eye, angle = np.array(view.position), 0.0
    answers, gaps, widths = [], [], []
    browser.look(view, config.size)
    settle(browser, config.size)
    for _ in range(config.drags):
        # The drag interrupts the refinement of the picture of this view.
        browser.look(turned(eye, target, angle, view), config.size)
        until = time.perf_counter() + rng.uniform(0.3, 1.5)
        browser.pictures(until)
        begin = last = time.perf_counter()
        answered = False
        for move in range(round(config.seconds * MOVES_A_SECOND)):
            angle += 0.01
            browser.look(turned(eye, target, angle, view), config.size)
            for at, picture in browser.pictures(begin + (move + 1) / MOVES_A_SECOND):
                if picture.width > 0.8 * config.size[0] and not answered:
                    continue  # this picture was in progress when the drag began
                (gaps if answered else answers).append(1e3 * (at - (last if answered else begin)))
                answered, last = True, at
                widths.append(picture.width)
    return {
        "answer_ms": summary(answers),
        "between_pictures_ms": summary(gaps),
        "width_px": round(statistics.median(widths)),
    }


def summary(values: list[float]) -> dict[str, float]:
    ordered = sorted(values)
    return {
        "median": round(statistics.median(ordered), 1),
        "ninth_of_ten": round(ordered[math.ceil(0.9 * len(ordered)) - 1], 1),
        "most": round(ordered[-1], 1),
        "count": len(ordered),
    }


def turned(eye: np.ndarray, target: np.ndarray, angle: float, view: View) -> View:
    """Return the view after rotating its position by an angle about the vertical line
    through the target."""
    x, y, z = eye - target
    c, s = math.cos(angle), math.sin(angle)
    moved = target + np.array([c * x - s * y, s * x + c * y, z])
    return look_at(moved, target, (0, 0, 1), view.fov_y, view.aspect)


def settle(browser: Tab, size: tuple[int, int]) -> None:
    while not any(
        picture.width == size[0] for _, picture in browser.pictures(time.perf_counter() + 1.0)
    ):
        pass


if __name__ == "__main__":
    main(tyro.cli(Config))
