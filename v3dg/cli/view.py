"""`v3dg view`."""

from __future__ import annotations

import contextlib
import importlib
import math
import signal
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg._start import SIGNALS
from v3dg.camera_file import read_cameras
from v3dg.cli._common import OnDevice, UsageError, option, print_result, require_subject, tell
from v3dg.cli._views import direction_of
from v3dg.export import Axis
from v3dg.opening import open_with_cameras

# Between looks for a signal: a wait without an end misses one that comes just before it.
_SECONDS = 0.1
_SIZE = (800, 800)  # px, of cameras whose file has none; the page has its own


@dataclass
class View(OnDevice):
    """Look at a scene, a bundle or an asset in a web browser."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply)."""
    host: str = "127.0.0.1"
    """Address to listen at; by default for this machine alone, at 0.0.0.0 for all who have the URL."""
    port: int = 8080
    """Port to listen at; the next free one where it is taken."""
    up: Axis = "z"
    """Which way is up."""
    cameras: Annotated[Path | None, option("PATH")] = None
    """Offer the cameras of this nerfstudio transforms.json, run of nerfstudio, or model of COLMAP."""
    distortion: Literal["refuse", "ignore"] = "refuse"
    """Whether lens distortion of those is an error, or left out of the pictures."""
    tolerance: Annotated[float | None, option("PX2")] = None
    """Screen area in px² that a coarser cluster's gaussian may stand for, at first; 3, or 0 with a budget."""
    budget: Annotated[int | None, option("N")] = None
    """Most gaussians to draw in one picture, at first."""


def run(options: View) -> None:
    require_subject(options.subject)
    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port: expected 0 to 65535, got {options.port}")
    from v3dg.gaussians import Gaussians
    from v3dg.select import DEFAULT_TOLERANCE, rule_of
    from v3dg.viewer.frame import SceneView
    from v3dg.viewer.server import Site

    tolerance = options.tolerance
    if tolerance is None:
        tolerance = DEFAULT_TOLERANCE if options.budget is None else 0.0
    rule_of(tolerance, options.budget, 0, "solid_angle", True)
    if not math.isfinite(tolerance):
        raise UsageError(f"--tolerance: expected a number, got {tolerance}")
    subject, cameras = open_with_cameras(options.subject)
    if options.cameras is not None:
        cameras = read_cameras(options.cameras, size=_SIZE, distortion=options.distortion)
    if isinstance(subject, Gaussians) and options.budget is not None:
        raise UsageError(
            f"--budget: expected a bundle or a scene, got the asset {options.subject}; build a bundle of it"
        )
    scene_view = SceneView(subject, device=options.device)
    with contextlib.suppress(ImportError):  # of which the site tells; it takes long
        importlib.import_module("v3dg.viewer.gate")
    with _interrupts() as interrupts:
        site = Site(
            scene_view,
            name=options.subject.stem,
            cameras=cameras,
            host=options.host,
            port=options.port,
            tolerance=tolerance,
            budget=options.budget,
            up=direction_of(options.up),
        )
        try:
            if options.port not in (0, site.port) and not options.quiet:
                tell(f"port {options.port} is taken, listening at {site.port}")
            told = {"url": site.url, "subject": str(options.subject)}
            print_result(options.json, told, [f"{site.url} shows {options.subject}; Ctrl-C ends it"])
            while not interrupts:
                time.sleep(_SECONDS)
        finally:
            site.close()
    raise KeyboardInterrupt


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Numbers of the signals that came, Ctrl-C and SIGTERM: exceptions would leave threads half started.

    After one they do nothing more, for the process ends. A handler may run inside of any lock's code, so it
    takes none.
    """
    came: list[int] = []
    before = {
        number: signal.signal(number, lambda number, _: came.append(number))
        for number in (*SIGNALS, signal.SIGTERM)
    }
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, signal.SIG_IGN if came else handler)
