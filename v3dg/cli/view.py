"""`v3dg view`."""

import contextlib
import importlib
import math
import os
import signal
import sys
import threading
import time
import webbrowser
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from v3dg._system import SIGNALS
from v3dg._urls import is_url, shown
from v3dg.cameras import Axis
from v3dg.cli._common import (
    Color,
    Cut,
    Flag,
    OnPool,
    UsageError,
    check_usage,
    color_of,
    open_subject,
    option,
    print_result,
    require_subject,
    tell,
)
from v3dg.cli._views import CameraFile, lines_of_up
from v3dg.gaussians import Gaussians
from v3dg.io import subject_name
from v3dg.scene import Subject
from v3dg.upright import ASSUMED, direction_of, up_of

if TYPE_CHECKING:
    from v3dg.viewer.server import Site

# Time between two checks for a signal. An endless wait could miss a signal that arrives
# just before it begins.
_SECONDS = 0.1


@dataclass
class View(CameraFile, Cut, OnPool):
    """Show a scene, a bundle or an asset in a web browser."""

    subject: tyro.conf.Positional[Path]
    """A scene (.json), a bundle (.v3dg) or an asset (.ply, .spz, ...)."""
    host: str = "127.0.0.1"
    """Address on which the server listens. By default, only this machine can connect.
    With 0.0.0.0, everybody who knows the URL can connect."""
    port: int = 8080
    """Port of the server. If it is in use, the next free port is used."""
    no_browser: Flag = False
    """Do not open a browser. No browser is opened over ssh either, without a display,
    or if other machines can connect."""
    background: Annotated[Color | str, tyro.conf.arg(metavar="R G B|COLOR")] = (0.0, 0.0, 0.0)
    """Initial background: red, green and blue from 0 to 1, or a colour such as white or
    #87ceeb."""
    up: Annotated[Axis | None, option("{x,y,z,-x,-y,-z}")] = None
    """The axis that points up initially. By default, it is the one in the file, or a
    guess from the gaussians or the cameras."""


def run(options: View) -> None:
    require_subject(options.subject)
    check_usage("--port", 0 <= options.port <= 65535, f"0 to 65535, got {options.port}")
    from v3dg.viewer.frame import SceneView
    from v3dg.viewer.server import Site

    background = _background_of(options)
    tolerance = _tolerance_of(options)
    subject, cameras = open_subject(options.subject, show=not options.quiet)
    cameras = options.read() or cameras
    photographs = _photographs(options.cameras, cameras or {})
    _check_budget(options, subject)
    up = options.up
    reason = ""
    if up is None:
        up, reason = up_of(subject, cameras)
    scene_view = SceneView(subject, device=options.device, memory=options.pool())
    # Import it early, because this takes long. If the import fails, the site reports
    # the error.
    with contextlib.suppress(ImportError):
        importlib.import_module("v3dg.viewer.tab")
    with _interrupts() as interrupts:
        site = Site(
            scene_view,
            name=subject_name(options.subject),
            cameras=cameras,
            photographs=photographs,
            host=options.host,
            port=options.port,
            tolerance=tolerance,
            budget=options.budget,
            background=background,
            up=direction_of(up),
            asks_up=reason == ASSUMED,
            edits_folder=_folder_of(options.subject),
        )
        try:
            _announce(options, site, lines_of_up(options.subject, up, reason))
            while not interrupts:
                time.sleep(_SECONDS)
        finally:
            site.close()
    raise KeyboardInterrupt


def _check_budget(options: View, subject: Subject) -> None:
    """Raise UsageError for a budget with an asset, which is always drawn completely."""
    expected = (
        f"a bundle or a scene, got the asset {shown(options.subject)}; build a bundle from it"
    )
    check_usage("--budget", options.budget is None or not isinstance(subject, Gaussians), expected)


def _background_of(options: View) -> Color:
    background = color_of(options.background)
    if background is None:
        raise UsageError("--background: expected a colour, got none; choose one")
    return background


def _folder_of(subject: Path) -> Path | None:
    """Return the folder of a local file, or None for a URL."""
    if is_url(subject):
        return None
    return subject.absolute().parent


def _tolerance_of(options: View) -> float:
    """Return the initial tolerance. Raise UsageError or ValueError if it is not finite,
    or if the budget is invalid."""
    from v3dg.select import DEFAULT_TOLERANCE, rule_of

    tolerance = options.tolerance
    if tolerance is None:
        tolerance = 0.0
        if options.budget is None:
            tolerance = DEFAULT_TOLERANCE
    rule_of(tolerance, options.budget, 0)
    check_usage("--tolerance", math.isfinite(tolerance), f"a finite number, got {tolerance}")
    return tolerance


def _announce(options: View, site: "Site", notes: list[str]) -> None:
    """Print the address of a site, and open it in a browser."""
    if options.port not in (0, site.port) and not options.quiet:
        tell(f"port {options.port} is taken, listening at {site.port}")
    name = shown(options.subject)
    lines = [f"{site.url} shows {name}; Ctrl-C ends it", *notes]
    print_result({"url": site.url, "subject": name}, lines, as_json=options.json)
    if not options.no_browser and not site.is_secret and _has_browser():
        threading.Thread(target=webbrowser.open, args=(site.url,), daemon=True).start()


def _has_browser() -> bool:
    """Return whether to open a browser. It is not opened over ssh, because it would
    open on the wrong machine, nor without a display, because it could be a text
    browser."""
    if "SSH_CONNECTION" in os.environ:
        return False
    has_display = any(os.environ.get(name) for name in ("BROWSER", "DISPLAY", "WAYLAND_DISPLAY"))
    return has_display or sys.platform in ("darwin", "win32")


def _photographs(cameras: Path | None, names: Iterable[str]) -> dict[str, Path]:
    """Return the paths of photographs by the names of cameras. The photographs are
    searched for next to the file of the cameras, and in folders `images` near it."""
    if cameras is None:
        return {}
    folder = cameras
    if not folder.is_dir():
        folder = folder.parent
    nearby = (folder, *folder.resolve().parents[:2])
    places = [place / part for place in nearby for part in ("", "images")]
    photographs = {}
    for name in names:
        # Names may lack a suffix, as in NeRF's synthetic scenes.
        files = (place / (name + suffix) for place in places for suffix in ("", ".png", ".jpg"))
        with contextlib.suppress(StopIteration, OSError, ValueError):
            photographs[name] = next(file for file in files if file.is_file())
    return photographs


@contextlib.contextmanager
def _interrupts() -> Iterator[list[int]]:
    """Yield a list. The numbers of received signals (Ctrl-C and SIGTERM) are appended
    to it.

    Signals raise no exceptions, which could interrupt the start of a thread. After a
    signal, later ones are ignored at the end, because the process ends anyway. The
    handler must not take a lock, because its thread may already hold it.
    """
    received: list[int] = []
    numbers = (*SIGNALS, signal.SIGTERM)
    old_handlers = {}
    for number in numbers:
        old_handlers[number] = signal.signal(number, lambda number, _: received.append(number))
    try:
        yield received
    finally:
        for number, old_handler in old_handlers.items():
            handler = old_handler
            if received:
                handler = signal.SIG_IGN
            signal.signal(number, handler)
