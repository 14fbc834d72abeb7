"""The response time of the viewer to mouse drags in Chromium: milliseconds from a mouse
move to its answer.

The answer is the browser's frame that shows the first picture of the new camera. Server
and browser share the cores of one machine; the server is a separate process, `v3dg
view`. Drags begin while the still picture is being refined, or just after it has
arrived. The benchmark needs playwright, and Chromium in PATH.
"""

from __future__ import annotations

import itertools
import re
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro

from benchmarks.evaluation import record

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

import chromium

# A script for the page that records events with the times of the page's clock.
_NOTE = """() => {
    window.log = [];
    const show = viewer.picture.show.bind(viewer.picture);
    viewer.picture.show = async (message, bytes) => {
        await show(message, bytes);
        requestAnimationFrame(() => log.push([performance.now(), message.number, message.size[0]]));
    };
    addEventListener(
        "pointermove",
        () => (window.first ??= [performance.now(), viewer.requests.number]), true);
}"""
_MOVES = 45


@dataclass
class Config:
    scene: Path
    cameras: tuple[int, ...] = (3, 10, 19, 59)
    """Indices of the cameras in the file from which drags begin."""
    drags: int = 8
    """Number of drags per camera."""
    webgl: bool = False
    """Whether Chromium composes the page with WebGL in software; by default it uses no
    WebGL."""
    output: str | None = None
    """JSON file for the results."""


def main(config: Config) -> None:
    from playwright.sync_api import sync_playwright

    without = ["--disable-gpu", *(flag for flag in chromium.ARGUMENTS if "swiftshader" not in flag)]
    command = [
        sys.executable,
        "-m",
        "v3dg",
        "view",
        str(config.scene),
        "--no-browser",
        "--port",
        "0",
    ]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server,
        sync_playwright() as play,
    ):
        try:
            arguments = chromium.ARGUMENTS if config.webgl else without
            browser = play.chromium.launch(executable_path=chromium.PROGRAM, args=arguments)
            page = browser.new_context(viewport={"width": 1600, "height": 900}).new_page()
            told = next(
                found for line in server.stdout or [] if (found := re.search(r"http://\S+", line))
            )
            page.goto(told[0])
            page.wait_for_selector("body[data-state=ready]", timeout=60_000)
            page.evaluate(_NOTE)
            rows = []
            for camera in config.cameras:
                rows.append({"camera": camera, **drags_from(page, camera, config.drags)})
                print(rows[-1], flush=True)
            browser.close()
        finally:
            server.terminate()
    record.write(config.output, {"webgl": config.webgl, "cameras": rows}, "cpu")


def drags_from(page: Any, camera: int, drags: int) -> dict[str, Any]:
    """Drag from a camera of the file.

    Returns:
        Milliseconds of the answers to drags, gaps between later pictures, and widths of
        the first pictures.
    """
    page.evaluate(f"viewer.fileCameras.lookThrough({camera})")
    page.wait_for_timeout(2500)
    answers, gaps, widths = [], [], []
    for drag in range(drags):
        page.wait_for_timeout(900 + 137 * drag)
        page.mouse.move(500, 450)
        page.evaluate("[window.log, window.first] = [[], null]")
        page.mouse.down()
        for move in range(1, _MOVES + 1):
            page.mouse.move(500 + 6 * move, 450 + move % 3)
            page.wait_for_timeout(16)
        page.mouse.up()
        (start, number), log = page.evaluate("[window.first, window.log]")
        shown = [(at, width) for at, of, width in log if of > number]
        answers.append(shown[0][0] - start)
        widths.append(shown[0][1])
        gaps += [after[0] - before[0] for before, after in itertools.pairwise(shown)]
    return {
        "answer_ms": {
            "median": round(statistics.median(answers)),
            "most": round(max(answers)),
            "count": drags,
        },
        "between_pictures_ms": round(statistics.median(gaps)),
        "width_px": sorted(set(widths)),
    }


if __name__ == "__main__":
    main(tyro.cli(Config))
