"""The viewer under a mouse: milliseconds from a camera's move to the picture that answers it.

A client of our own speaks the browser's protocol over a socket of this machine, so all but the browser's own
work is measured. Each drag orbits the scene, and begins while the picture at rest is being refined.
"""

from __future__ import annotations

import io
import math
import statistics
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
import tyro
import viser
import zstandard
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from v3dg.bench import record
from v3dg.scene_file import read_scene
from v3dg.viewer.frame import Stage
from v3dg.viewer.page import Site
from v3dg.viewer.view import View, look_at

MOVES_A_SECOND = 60


@dataclass
class Config:
    scene: Path
    cameras: tuple[int, ...] = (3, 10, 19, 59)
    """Places in the file of the cameras to drag from."""
    drags: int = 8
    """From each camera."""
    seconds: float = 1.5
    """Length of a drag."""
    size: tuple[int, int] = (1600, 900)
    """Of the browser's window, px."""
    device: str = "cpu"
    output: str | None = None
    """JSON file for the result."""


def main(config: Config) -> None:
    scene, cameras = read_scene(config.scene)
    stage = Stage(scene, device=config.device)
    site = Site(stage, port=0)
    rng = np.random.default_rng(0)
    rows = []
    try:
        with connect(
            f"ws://127.0.0.1:{site.port}",
            subprotocols=[f"viser-v{viser.__version__}"],  # type: ignore[list-item]
            compression=None,
            max_size=None,
        ) as browser:
            for place in config.cameras:
                name, camera = list(cameras.items())[place]
                view = View.of_camera(camera)
                rows.append({"camera": name, **drag_around(browser, view, stage.center, config, rng)})
                print(rows[-1], flush=True)
    finally:
        site.close()
    record.write(config.output, {"size": config.size, "cameras": rows}, config.device)


def drag_around(
    browser: ClientConnection, view: View, target: np.ndarray, config: Config, rng: np.random.Generator
) -> dict:
    """Answers to drags around the target."""
    eye, angle = np.array(view.position), 0.0
    answers, gaps, widths = [], [], []
    send(browser, view, config.size)
    settle(browser, config.size)
    for _ in range(config.drags):
        send(browser, turned(eye, target, angle, view), config.size)  # whose refinement the drag interrupts
        until = time.perf_counter() + rng.uniform(0.3, 1.5)
        drain(browser, until)
        begin = last = time.perf_counter()
        answered = False
        for move in range(round(config.seconds * MOVES_A_SECOND)):
            angle += 0.01
            send(browser, turned(eye, target, angle, view), config.size)
            for at, width in drain(browser, begin + (move + 1) / MOVES_A_SECOND):
                if width > 0.8 * config.size[0] and not answered:
                    continue  # was under way when the drag began
                (gaps if answered else answers).append(1e3 * (at - (last if answered else begin)))
                answered, last = True, at
                widths.append(width)
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


def axis_of(view: View) -> np.ndarray:
    return view.camera(1, 1, 0.01).viewmat[2, :3]


def turned(eye: np.ndarray, target: np.ndarray, angle: float, view: View) -> View:
    """The view from the eye turned about the upright line through the target."""
    x, y, z = eye - target
    c, s = math.cos(angle), math.sin(angle)
    moved = target + np.array([c * x - s * y, s * x + c * y, z])
    return look_at(moved, target, (0, 0, 1), view.fov_y, view.aspect)


def send(browser: ClientConnection, view: View, size: tuple[int, int]) -> None:
    message = {
        "type": "ViewerCameraMessage",
        "wxyz": view.wxyz,
        "position": view.position,
        "fov": view.fov_y,
        "near": 0.01,
        "far": 1000.0,
        "image_height": size[1],
        "image_width": size[0],
        "look_at": (np.array(view.position) + axis_of(view)).tolist(),
        "up_direction": (0.0, 0.0, 1.0),
    }
    browser.send(msgspec.msgpack.encode(message))


def drain(browser: ClientConnection, until: float) -> list[tuple[float, int]]:
    """Time and width of the pictures that come until then."""
    pictures = []
    while (left := until - time.perf_counter()) > 0:
        try:
            data = browser.recv(timeout=left)
        except TimeoutError:
            break
        width = width_of_picture(data)
        if width:
            pictures.append((time.perf_counter(), width))
    return pictures


def settle(browser: ClientConnection, size: tuple[int, int]) -> None:
    while not any(width == size[0] for _, width in drain(browser, time.perf_counter() + 1.0)):
        pass


def width_of_picture(data: bytes) -> int:
    """Width of the last picture among the messages; 0 for none."""
    packed = int.from_bytes(data[8:16], "little")
    envelope = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + packed]))
    width = 0
    for message in envelope["messages"]:
        if message["type"] == "BackgroundImageMessage" and message["rgb_data"]:
            with Image.open(io.BytesIO(message["rgb_data"])) as picture:
                width = picture.width
    return width


if __name__ == "__main__":
    main(tyro.cli(Config))
