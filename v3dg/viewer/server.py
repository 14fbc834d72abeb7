"""The viewer's web server, viser's, which gives every browser tab a camera and settings of its own."""

from __future__ import annotations

import contextlib
import io
import logging
import math
import socket
import threading
import warnings
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from v3dg.cameras import Camera, VectorLike
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.tab import Tab
from v3dg.viewer.view import View, look_at

if TYPE_CHECKING:
    import viser

_FOV_Y = math.radians(45)


class Site:
    """The viewer as a web server, from when it is made until `close`.

    Args:
        scene_view: What to show.
        name: Title of the tabs, and of the files that they save.
        cameras: Named cameras to jump to.
        host: Address to listen at; ``"0.0.0.0"`` lets anyone in who reaches this machine.
        port: Where to listen; the next free one where it is taken.
        tolerance, budget: What a tab begins with.
        up: (3,) direction in the world.

    Attributes:
        port: The one that was free.

    Raises:
        ImportError: The extra is not installed.
        ValueError: ``host`` is not an address of this machine.
    """

    def __init__(
        self,
        scene_view: SceneView,
        *,
        name: str = "v3dg",
        cameras: Mapping[str, Camera] | None = None,
        host: str = "127.0.0.1",
        port: int = 8080,
        tolerance: float = DEFAULT_TOLERANCE,
        budget: int | None = None,
        up: VectorLike = (0.0, 0.0, 1.0),
    ) -> None:
        try:
            import viser
        except ImportError as error:
            raise ImportError(
                "the viewer needs viser, which is not installed; pip install 'v3dg[viewer]'"
            ) from error
        _require_own_address(host)
        # A tab may be closed while a picture is on its way to it.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._tabs: dict[int, Tab] = {}
        self._lock = threading.Lock()
        logging.getLogger("websockets.server").addFilter(_is_news)
        with _quiet():
            self._server = viser.ViserServer(host=host, port=port, label=name, verbose=False)
        self.port = self._server.get_port()
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()  # beside the picture, not over it
        self._server.scene.set_up_direction(_three(up))
        start = start_view(scene_view, up)
        first = self._server.initial_camera
        first.position, first.look_at = start.position, _three(scene_view.center)
        first.up, first.fov = _three(up), _FOV_Y

        def connect(client: viser.ClientHandle) -> None:
            tab = Tab(
                client, scene_view, name, cameras or {}, Settings(tolerance=tolerance, budget=budget), start
            )
            with self._lock:
                self._tabs[client.client_id] = tab

        def disconnect(client: viser.ClientHandle) -> None:
            with self._lock:
                tab = self._tabs.pop(client.client_id, None)
            if tab is not None:
                tab.close()

        self._server.on_client_connect(connect)
        self._server.on_client_disconnect(disconnect)

    def close(self) -> None:
        """End all tabs and the server; returns when their threads have ended."""
        with self._lock:
            tabs = list(self._tabs.values())
            self._tabs.clear()
        for tab in tabs:
            tab.close()
        with _quiet():
            self._server.stop()


def start_view(scene_view: SceneView, up: VectorLike, aspect: float = 16 / 9) -> View:
    """Return the view that a tab begins with: all of the scene, from a little above."""
    axis = np.asarray(up, np.float64)
    axis = axis / np.linalg.norm(axis)
    # Of the world's axes the one that comes after the upright one, so that no two are parallel.
    aside = np.roll(np.eye(3)[int(np.abs(axis).argmax())], 1)
    aside = aside - (aside @ axis) * axis
    direction = math.cos(0.45) * aside / np.linalg.norm(aside) + math.sin(0.45) * axis
    distance = 0.95 * scene_view.radius / math.sin(_FOV_Y / 2)
    return look_at(scene_view.center + distance * direction, scene_view.center, axis, _FOV_Y, aspect)


def _require_own_address(host: str) -> None:
    """Refuse another machine's address, of which viser would try a thousand ports and then wait for ever."""
    try:
        family, kind, *_ = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind) as probe:
            probe.bind((host, 0))
    except OSError as error:
        raise ValueError(
            f"host: expected an address of this machine, got {host} ({error.strerror})"
        ) from error


def _three(vector: VectorLike) -> tuple[float, float, float]:
    x, y, z = (float(v) for v in vector)
    return x, y, z


def _is_news(record: logging.LogRecord) -> bool:
    """Not that somebody connected and said nothing, as browsers and forwarded ports do ahead of time."""
    return record.getMessage() != "opening handshake failed"


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Keep what viser prints when it starts and stops: the command says where the viewer is."""
    with contextlib.redirect_stdout(io.StringIO()):
        yield
