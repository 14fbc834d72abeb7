"""The viewer's web server: it serves the page, and connects every browser tab
separately."""

from __future__ import annotations

import asyncio
import contextlib
import http
import io
import logging
import threading
import time
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from v3dg import _extras
from v3dg._numbers import check, color
from v3dg._version import __version__
from v3dg.cameras import Camera, VectorLike, check_cameras
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.view import View

if TYPE_CHECKING:
    from websockets.asyncio.server import ServerConnection
    from websockets.http11 import Request, Response

    from v3dg.viewer.answers import Hello
    from v3dg.viewer.tab import Tab

# The end of the server does not wait longer than this for threads.
_CLOSE_SECONDS = 1.0
# The largest longer side of photographs, by the folder in which the page requests them.
_PHOTOGRAPH_PIXELS = {"photograph": 1600, "thumbnail": 240}
# Errors of a connection are caused by its client: they are logged, and not printed in
# the terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())
# Media types of the files that are served; other files in the page's folder are not
# served.
_MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
# Headers of every answer, including refusals and errors. No other page can frame this
# page; it runs only its own files and talks to no other server. Other pages cannot show
# what is served, nor get access to the window.
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
        photographs: Files of the cameras' photographs, by the cameras' names.
        host, port: As for `Gate`.
        tolerance, budget, background: Initial settings of a tab.
        up: (3,) direction in the world that is up.
        asks_up: Whether ``up`` is only assumed, so that the page asks the user.
        edits_folder: Folder that pages may write new assets to, never over a file that
            exists; if None, or if other machines can connect, browsers save them.

    Attributes:
        port, url, is_secret: See `Gate`.

    Raises:
        ImportError: The extra is not installed.
        TypeError: ``cameras`` is not a mapping of names to cameras.
        ValueError: See `Gate`.
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
        background: Sequence[float] = (0.0, 0.0, 0.0),
        up: VectorLike = (0.0, 0.0, 1.0),
        asks_up: bool = False,
        edits_folder: Path | None = None,
    ) -> None:
        _load_extras()
        from v3dg.viewer.gate import Gate

        self._scene_view = scene_view
        self._name = name
        cameras = cameras or {}
        check_cameras(cameras)
        self._photographs = [dict(photographs or {}).get(camera) for camera in cameras]
        shade = _checked_color(background)
        settings = Settings(tolerance=tolerance, budget=budget, background=shade)
        self._greeting = _greeting(
            cameras,
            self._photographs,
            settings=settings,
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
        """Return the folder that pages may write to; None if other machines can
        connect."""
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
        """End all tabs and the server within about two seconds; return whether all
        their threads have ended."""
        with contextlib.suppress(RuntimeError):  # the loop is already closed
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
            compression=None,  # pictures are already compressed
            close_timeout=0.5,  # an unresponsive client must not delay the end
            server_header=None,  # clients need not know versions
            process_request=self._answer,
            process_response=_add_headers,
        )
        async with server:
            is_serving.set()
            await self._closing.wait()
        await asyncio.to_thread(self._end_tabs)

    def _end_tabs(self) -> None:
        """End the threads of all tabs, including those whose connection is closed."""
        end = time.monotonic() + _CLOSE_SECONDS
        self._tabs = {tab for tab in self._tabs if not tab.close(max(end - time.monotonic(), 0.0))}

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve one tab while it is open."""
        from v3dg.viewer.answers import encode
        from v3dg.viewer.tab import Tab

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

        tab = Tab(self._scene_view, self._name, send, moved, self._greeting.up, self._edits_folder)
        self._tabs.add(tab)
        try:
            await connection.send(encode(self._greeting))
            await connection.send(encode(tab.describe_scene()))
            async for data in connection:
                # An invalid message is ignored, for whatever reason.
                with contextlib.suppress(Exception):
                    tab.take(data)
        finally:
            if tab.close(0.0):
                self._tabs.discard(tab)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request for a file of the page; None for a request
        that opens a connection."""
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
        """Return the photograph of the camera with that number as JPEG; None if there
        is none, or if it cannot be read."""
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
        except Exception:  # for damaged files, Pillow raises errors of many kinds
            return None


def _checked_color(values: Sequence[float]) -> tuple[float, float, float]:
    red, green, blue = color(values, "background")
    fits = all(0 <= part <= 1 for part in (red, green, blue))
    check("background", fits, f"three numbers from 0 to 1, got {(red, green, blue)}")
    return red, green, blue


def _load_extras() -> None:
    for module in ("msgspec", "websockets.asyncio.server"):
        _extras.load(module)


def _greeting(
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
    """Add the headers that all answers have."""
    response.headers.update(_HEADERS)


def start_view(scene_view: SceneView, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the initial view of a tab: that of `v3dg.first_camera`."""
    return scene_view.first_view(up, aspect)[0]
