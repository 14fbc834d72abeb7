"""The viewer's web server: it hands out the page, and gives every browser tab a
connection of its own."""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import json
import logging
import math
import threading
import time
from collections.abc import Mapping
from dataclasses import asdict
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from v3dg import _extras
from v3dg._version import __version__
from v3dg.cameras import Camera, VectorLike, check_cameras
from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE
from v3dg.viewer.frame import SceneView
from v3dg.viewer.view import View, look_at

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    from v3dg.viewer.tab import Tab

_FOV_Y = math.radians(45)
# What is still at work after so long is left behind.
_CLOSE_SECONDS = 1.0
# Of the longer side of photographs, at most, by the folder that the page asks for them
# in.
_PHOTOGRAPH_PIXELS = {"photograph": 1600, "thumbnail": 240}
# What goes wrong in a connection is its client's fault: for those who set up logging,
# not for the terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())
_KINDS = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
# Of every answer, refusals and errors too. The page is shown in no other page, runs
# nothing but its own files, and talks to no other server; other pages show nothing of
# it, and have no handle on its window.
_HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "img-src 'self' blob:; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
    "Cache-Control": "no-store",
}


class Site:
    """The viewer as a web server, from when it is made until `close`.

    Args:
        name: Title of the tabs, and of the files that they save.
        cameras: Named cameras to jump to.
        photographs: Files of the pictures that cameras took, by the cameras' names.
        host, port: As of its `Gate`, whose port and URL it has, and whose errors it
            raises.
        tolerance, budget: What a tab begins with.
        up: (3,) direction in the world.
        asks_up: Whether that is but assumed, so that the page asks.

    Raises:
        ImportError: The extra is not installed.
        TypeError: Cameras are none, or without names.
    """

    def __init__(
        self,
        scene_view: SceneView,
        *,
        name: str = "v3dg",
        cameras: Mapping[str, Camera] | None = None,
        photographs: Mapping[str, Path] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        tolerance: float = DEFAULT_TOLERANCE,
        budget: int | None = None,
        up: VectorLike = (0.0, 0.0, 1.0),
        asks_up: bool = False,
    ) -> None:
        for module in ("msgspec", "websockets.asyncio.server"):
            _extras.load(module)
        from v3dg.viewer.gate import Gate
        from v3dg.viewer.tab import Tab

        self._make_tab = Tab
        self._scene_view = scene_view
        self._name = name
        cameras = cameras or {}
        check_cameras(cameras)
        self._photographs = [dict(photographs or {}).get(camera) for camera in cameras]
        self._greeting = {
            "type": "hello",
            "version": __version__,
            "up": np.asarray(up, np.float64).tolist(),
            "asks_up": asks_up,
            "home": asdict(start_view(scene_view, up)),
            "settings": {"tolerance": tolerance, "budget": budget, "fade": DEFAULT_FADE},
            "cameras": self._describe_cameras(cameras),
        }
        self._page = _read_page()
        self._tabs: set[Tab] = set()
        self._gate = Gate(host, port)
        self.port = self._gate.port
        self.url = self._gate.url
        self.is_secret = self._gate.is_secret
        self._start()

    def _describe_cameras(self, cameras: Mapping[str, Camera]) -> list[dict[str, object]]:
        result: list[dict[str, object]] = []
        for (name, camera), photograph in zip(cameras.items(), self._photographs, strict=True):
            view = asdict(View.of_camera(camera))
            result.append({"name": name, "photograph": photograph is not None, "view": view})
        return result

    def _start(self) -> None:
        """Start the thread of the server, and wait until that accepts connections."""
        self._closing = asyncio.Event()
        is_serving = threading.Event()
        serving = self._serve(is_serving)
        self._thread = threading.Thread(
            target=asyncio.run, args=(serving,), name="v3dg viewer", daemon=True
        )
        self._thread.start()
        is_serving.wait()

    def close(self) -> bool:
        """End all tabs and the server in about two seconds; returns whether all their
        threads have ended."""
        with contextlib.suppress(RuntimeError):  # it is closed already
            self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join(3 * _CLOSE_SECONDS)
        return not self._thread.is_alive() and not self._tabs

    async def _serve(self, is_serving: threading.Event) -> None:
        from websockets.asyncio.server import serve

        from v3dg.viewer.messages import MOST_BYTES

        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(
            lambda _, context: _LOG.error(context["message"], exc_info=context.get("exception"))
        )
        server = serve(
            self._talk,
            sock=self._gate.socket,
            logger=_LOG,
            max_size=MOST_BYTES,
            compression=None,  # pictures are compressed
            close_timeout=0.5,  # a client that does not answer does not hold up the end
            server_header=None,  # it would tell clients which versions answer
            process_request=self._answer,
            process_response=_add_headers,
        )
        async with server:
            is_serving.set()
            await self._closing.wait()
        await asyncio.to_thread(self._end_tabs)

    def _end_tabs(self) -> None:
        """Have the threads of all tabs end, of those that are gone, too."""
        end = time.monotonic() + _CLOSE_SECONDS
        self._tabs = {tab for tab in self._tabs if not tab.close(max(end - time.monotonic(), 0.0))}

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one tab for as long as it is open."""

        def send(data: str | bytes) -> None:
            coroutine = connection.send(data)
            try:
                sending = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
            except RuntimeError:  # the server has ended
                coroutine.close()
                raise
            if threading.current_thread() is not self._thread:  # which would wait for itself
                sending.result()

        def moved(scene_view: SceneView) -> None:
            for open_tab in self._tabs:
                if open_tab.scene_view is scene_view:
                    open_tab.ask_again()

        tab = self._make_tab(self._scene_view, self._name, send, moved)
        self._tabs.add(tab)
        try:
            await connection.send(json.dumps(self._greeting))
            await connection.send(json.dumps(tab.describe_scene()))
            async for data in connection:
                with contextlib.suppress(Exception):  # whatever is wrong with what it says
                    tab.take(data)
        finally:
            if tab.close(0.0):
                self._tabs.discard(tab)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a part of the page; None where a connection begins."""
        refusal = self._gate.refusal(request)
        if refusal is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, refusal)
        name = request.path.removeprefix("/") or "index.html"
        if "Upgrade" in request.headers and name == "connection":
            return None
        body = self._page.get(name)
        kind = _KINDS.get(Path(name).suffix, "text/plain")
        folder, _, place = name.partition("/")
        if folder in _PHOTOGRAPH_PIXELS:
            side = _PHOTOGRAPH_PIXELS[folder]
            body = await asyncio.to_thread(self._photograph, place, side)
            kind = "image/jpeg"
        if body is None:
            return connection.respond(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        response = connection.respond(http.HTTPStatus.OK, "")
        for header in ("Content-Type", "Content-Length"):
            del response.headers[header]
        response.headers.update({"Content-Type": kind, "Content-Length": str(len(body))})
        response.body = body
        return response

    def _photograph(self, place: str, side: int) -> bytes | None:
        """JPEG of what the camera at that place took, if that can be read."""
        try:
            if not place.isdecimal():
                return None
            path = self._photographs[int(place)]
            if path is None:
                return None
            with Image.open(path) as picture:
                picture.thumbnail((side, side))
                file = io.BytesIO()
                picture.convert("RGB").save(file, "jpeg", quality=85)
                return file.getvalue()
        except Exception:  # of whatever kind Pillow raises for a damaged file
            return None


def _read_page() -> dict[str, bytes]:
    """The files of the page by name."""
    folder = files("v3dg.viewer").joinpath("page")
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def _add_headers(_connection: ServerConnection, _request: Request, response: Response) -> None:
    """Give an answer of any kind the headers that all have."""
    response.headers.update(_HEADERS)


def start_view(scene_view: SceneView, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the view that a tab begins with: all of the scene, from a little above."""
    axis = np.asarray(up, np.float64)
    axis = axis / np.linalg.norm(axis)
    # Of the world's axes the one that comes after the upright one, so that no two are
    # parallel.
    aside = np.roll(np.eye(3)[int(np.abs(axis).argmax())], 1)
    aside = aside - (aside @ axis) * axis
    direction = math.cos(0.45) * aside / np.linalg.norm(aside) + math.sin(0.45) * axis
    distance = 0.95 * scene_view.radius / math.sin(_FOV_Y / 2)
    return look_at(
        scene_view.center + distance * direction, scene_view.center, axis, _FOV_Y, aspect
    )
