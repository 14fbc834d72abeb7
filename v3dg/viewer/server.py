"""The viewer's web server. It serves the web page, and connects each browser tab
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

# Maximum time, in seconds, for which closing the server waits for threads.
_CLOSE_SECONDS = 1.0
# Maximum length, in px, of the longer side of a photograph, by the folder in the
# request.
_PHOTOGRAPH_PIXELS = {"photograph": 1600, "thumbnail": 240}
# Errors of a connection are caused by its client. Therefore they are logged, and not
# printed in the terminal.
_LOG = logging.getLogger(__name__)
_LOG.addHandler(logging.NullHandler())
# Media types of the files that are served. Files with other suffixes in the web page's
# folder are not served.
_MEDIA_TYPES = {
    ".html": "text/html",
    ".css": "text/css",
    ".js": "text/javascript",
    ".svg": "image/svg+xml",
}
# Headers of every answer, including refusals and errors. Other web pages cannot embed
# this one in a frame, show its files, or access its window. This web page only runs its
# own files, and connects to no other server.
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
    """The viewer as a web server, which runs from construction until `close`.

    Args:
        name: Title of the web page, and name of the files that it saves.
        cameras: Cameras by name, to which the user can jump.
        photographs: Files of the cameras' photographs, by the cameras' names.
        host, port: See `Gate`.
        tolerance, budget, background: Initial settings of a tab.
        up: (3,) direction in the world that points up.
        asks_up: Whether ``up`` is only assumed. If so, the web page asks the user.
        edits_folder: Folder to which web pages may write new assets. Existing files are
            never overwritten. If it is None, or if other machines can connect, the
            browser saves new assets.

    Attributes:
        port, url, is_secret: See `Gate`.

    Raises:
        ImportError: The extra `viewer` is not installed.
        TypeError: ``cameras`` is not a mapping from names to cameras.
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
        """Return the folder to which web pages may write. Return None if other machines
        can connect."""
        if folder is None or self.is_secret:
            return None
        return Path(folder).absolute()

    def _start(self) -> None:
        """Start the thread of the server, and wait until it accepts connections."""
        self._closing = asyncio.Event()
        is_serving = threading.Event()
        serving = self._serve(is_serving)
        self._thread = threading.Thread(
            target=asyncio.run, args=(serving,), name="v3dg viewer", daemon=True
        )
        self._thread.start()
        is_serving.wait()

    def close(self) -> bool:
        """Close all tabs and the server within about two seconds. Return whether all
        their threads have ended."""
        with contextlib.suppress(RuntimeError):  # the event loop may already be closed
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
            close_timeout=0.5,  # clients that do not respond must not delay closing
            server_header=None,  # clients do not need to know versions
            process_request=self._answer,
            process_response=_add_headers,
        )
        async with server:
            is_serving.set()
            await self._closing.wait()
        await asyncio.to_thread(self._end_tabs)

    def _end_tabs(self) -> None:
        """End the threads of all tabs, including tabs whose connection is closed."""
        end = time.monotonic() + _CLOSE_SECONDS
        self._tabs = {tab for tab in self._tabs if not tab.close(max(end - time.monotonic(), 0.0))}

    async def _talk(self, connection: ServerConnection) -> None:
        """Serve a tab until its connection is closed."""
        from v3dg.viewer.answers import encode
        from v3dg.viewer.tab import Tab

        def send(data: str | bytes) -> None:
            coroutine = connection.send(data)
            try:
                sending = asyncio.run_coroutine_threadsafe(coroutine, self._loop)
            except RuntimeError:  # the server has been closed
                coroutine.close()
                raise
            # Only other threads wait, because the server's own thread would wait for
            # itself.
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
                # Invalid messages are ignored.
                with contextlib.suppress(Exception):
                    tab.take(data)
        finally:
            if tab.close(0.0):
                self._tabs.discard(tab)

    async def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return the answer to a request for a file of the web page. Return None for a
        request that opens a WebSocket."""
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
            return connection.respond(http.HTTPStatus.NOT_FOUND, "There is no such file.\n")
        response = connection.respond(http.HTTPStatus.OK, "")
        for header in ("Content-Type", "Content-Length"):
            del response.headers[header]
        response.headers.update({"Content-Type": media_type, "Content-Length": str(len(body))})
        response.body = body
        return response

    def _photograph(self, place: str, side: int) -> bytes | None:
        """Return the photograph of a camera, given by its number, as JPEG. Return None
        if there is none, or if it cannot be read."""
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
        except Exception:  # Pillow raises errors of many types for damaged files
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
    """Return the content of the web page's files, by name."""
    folder = files("v3dg.viewer").joinpath("page")
    return {
        path.name: path.read_bytes()
        for path in folder.iterdir()
        if Path(path.name).suffix in _MEDIA_TYPES
    }


def _add_headers(_connection: ServerConnection, _request: Request, response: Response) -> None:
    """Add the headers that every answer has."""
    response.headers.update(_HEADERS)


def start_view(scene_view: SceneView, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the first view of a tab, which is that of `v3dg.first_camera`."""
    return scene_view.first_view(up, aspect)[0]
