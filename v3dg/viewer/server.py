"""The viewer's web server: serves the page, and gives every browser tab a connection of
its own."""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import logging
import math
import threading
import time
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from v3dg import _extras
from v3dg._version import __version__
from v3dg.cameras import Camera, VectorLike, check_cameras
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.view import View, look_at

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    from v3dg.viewer.answers import Hello
    from v3dg.viewer.tab import Tab

_FOV_Y = math.radians(45)
# Threads that are still at work after so long are not waited for.
_CLOSE_SECONDS = 1.0
# The longer side of photographs at most, by the folder in which the page asks for them.
_PHOTOGRAPH_PIXELS = {"photograph": 1600, "thumbnail": 240}
# Errors of a connection are its client's fault: they are logged, and not printed in the
# terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())
# Media types of the files that are served; other files of the page's folder are not.
_MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
# Headers of every answer, of refusals and errors too. No other page can frame this one;
# it runs only its own files and talks to no other server. Other pages cannot show what
# is served, nor get hold of the window.
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
    """The viewer as a web server, from its construction until `close`.

    Args:
        name: Title of the tabs, and name of the files that they save.
        cameras: Named cameras to jump to.
        photographs: Files of the pictures that cameras took, by the cameras' names.
        host, port: As for `Gate`.
        tolerance, budget: Settings that a tab begins with.
        up: (3,) direction in the world that is up.
        asks_up: Whether ``up`` is only assumed, so that the page asks.
        edits_folder: Folder that pages may write new assets to, never over a file that
            exists; if None, or if other machines can connect, browsers save them.

    Attributes:
        port, url, is_secret: As of `Gate`.

    Raises:
        ImportError: The extra is not installed.
        TypeError: ``cameras`` is not a mapping of names to cameras.
        ValueError: As of `Gate`.
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
        edits_folder: Path | None = None,
    ) -> None:
        _load_extras()
        from v3dg.viewer.gate import Gate
        from v3dg.viewer.tab import Tab

        self._make_tab = Tab
        self._scene_view = scene_view
        self._name = name
        cameras = cameras or {}
        check_cameras(cameras)
        self._photographs = [dict(photographs or {}).get(camera) for camera in cameras]
        self._greeting = _greeting(
            scene_view,
            cameras,
            self._photographs,
            settings=Settings(tolerance=tolerance, budget=budget),
            up=up,
            asks_up=asks_up,
        )
        self._page = _read_page()
        self._tabs: set[Tab] = set()
        self._gate = Gate(host, port)
        self.port = self._gate.port
        self.url = self._gate.url
        self.is_secret = self._gate.is_secret
        self._edits_folder = self._allowed_folder(edits_folder)
        self._start()

    def _allowed_folder(self, folder: Path | None) -> Path | None:
        """The folder that pages may write to; None if other machines can connect."""
        if folder is None or self.is_secret:
            return None
        return Path(folder).absolute()

    def _start(self) -> None:
        """Start the server's thread, and wait until it accepts connections."""
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
        with contextlib.suppress(RuntimeError):  # the loop is closed already
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
            compression=None,  # pictures are compressed already
            close_timeout=0.5,  # the end does not wait for a client that does not answer
            server_header=None,  # clients are not told versions
            process_request=self._answer,
            process_response=_add_headers,
        )
        async with server:
            is_serving.set()
            await self._closing.wait()
        await asyncio.to_thread(self._end_tabs)

    def _end_tabs(self) -> None:
        """End the threads of all tabs, also of those whose connection is closed."""
        end = time.monotonic() + _CLOSE_SECONDS
        self._tabs = {tab for tab in self._tabs if not tab.close(max(end - time.monotonic(), 0.0))}

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one tab while it is open."""
        from v3dg.viewer.answers import encode

        def send(data: str | bytes) -> None:
            coroutine = connection.send(data)
            try:
                sending = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
            except RuntimeError:  # the server has ended
                coroutine.close()
                raise
            # The server's own thread would wait for itself.
            if threading.current_thread() is not self._thread:
                sending.result()

        def moved(scene_view: SceneView) -> None:
            for open_tab in self._tabs:
                if open_tab.scene_view is scene_view:
                    open_tab.ask_again()

        tab = self._make_tab(self._scene_view, self._name, send, moved, self._edits_folder)
        self._tabs.add(tab)
        try:
            await connection.send(encode(self._greeting))
            await connection.send(encode(tab.describe_scene()))
            async for data in connection:
                # A wrong message is ignored, whatever is wrong with it.
                with contextlib.suppress(Exception):
                    tab.take(data)
        finally:
            if tab.close(0.0):
                self._tabs.discard(tab)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file of the page; None if it opens a connection."""
        refusal = self._gate.refusal(request)
        if refusal is not None:
            return connection.respond(http.HTTPStatus.FORBIDDEN, refusal)
        name = request.path.removeprefix("/") or "index.html"
        if "Upgrade" in request.headers and name == "connection":
            return None
        body = self._page.get(name)
        media_type = _MEDIA_TYPES.get(Path(name).suffix, "text/plain")
        folder, _, place = name.partition("/")
        if folder in _PHOTOGRAPH_PIXELS:
            side = _PHOTOGRAPH_PIXELS[folder]
            body = await asyncio.to_thread(self._photograph, place, side)
            media_type = "image/jpeg"
        if body is None:
            return connection.respond(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        response = connection.respond(http.HTTPStatus.OK, "")
        for header in ("Content-Type", "Content-Length"):
            del response.headers[header]
        response.headers.update({"Content-Type": media_type, "Content-Length": str(len(body))})
        response.body = body
        return response

    def _photograph(self, place: str, side: int) -> bytes | None:
        """Return the photograph of the camera of that number as JPEG; None if there is
        none that can be read."""
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
        except Exception:  # Pillow raises errors of many kinds for damaged files
            return None


def _load_extras() -> None:
    for module in ("msgspec", "websockets.asyncio.server"):
        _extras.load(module)


def _greeting(
    scene_view: SceneView,
    cameras: Mapping[str, Camera],
    photographs: Sequence[Path | None],
    *,
    settings: Settings,
    up: VectorLike,
    asks_up: bool,
) -> Hello:
    from v3dg.viewer.answers import FileCamera, Hello
    from v3dg.viewer.messages import LIMITS

    descriptions: list[FileCamera] = []
    for (name, camera), photograph in zip(cameras.items(), photographs, strict=True):
        view = View.of_camera(camera)
        descriptions.append(FileCamera(name, photograph is not None, view))
    x, y, z = np.asarray(up, np.float64).tolist()
    return Hello(
        version=__version__,
        up=(x, y, z),
        asks_up=asks_up,
        home=start_view(scene_view, up),
        settings=settings,
        defaults=Settings(),
        limits=LIMITS,
        cameras=descriptions,
    )


def _read_page() -> dict[str, bytes]:
    """Return the files of the page by name."""
    folder = files("v3dg.viewer").joinpath("page")
    return {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if Path(path.name).suffix in _MEDIA_TYPES
    }


def _add_headers(_connection: ServerConnection, _request: Request, response: Response) -> None:
    """Give an answer the headers that all answers have."""
    response.headers.update(_HEADERS)


def start_view(scene_view: SceneView, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the view that a tab begins with: all of the scene, from a little above."""
    axis = np.asarray(up, np.float64)
    axis = axis / np.linalg.norm(axis)
    # The world's axis after the one that is nearest to `up`, so that the two are not
    # parallel.
    aside = np.roll(np.eye(3)[int(np.abs(axis).argmax())], 1)
    aside = aside - (aside @ axis) * axis
    direction = math.cos(0.45) * aside / np.linalg.norm(aside) + math.sin(0.45) * axis
    distance = 0.95 * scene_view.radius / math.sin(_FOV_Y / 2)
    return look_at(
        scene_view.center + distance * direction, scene_view.center, axis, _FOV_Y, aspect
    )
