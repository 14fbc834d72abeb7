"""The viewer's web server, viser's, which gives every browser tab a camera and settings of its own."""

from __future__ import annotations

import contextlib
import io
import math
import time
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from v3dg.cameras import Camera, VectorLike
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.controls import BrowserCamera
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.tab import Tab
from v3dg.viewer.view import View, look_at

if TYPE_CHECKING:
    import viser

_FOV_Y = math.radians(45)
# What is still at work after so long is left behind.
_CLOSE_SECONDS = 1.0


class Site:
    """The viewer as a web server, from when it is made until `close`.

    Args:
        name: Title of the tabs, and of the files that they save.
        cameras: Named cameras to jump to.
        host, port: As of its `Gate`, whose port and URL it has, and whose errors it raises.
        tolerance, budget: What a tab begins with.
        up: (3,) direction in the world.

    Raises:
        ImportError: The extra is not installed.
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

            from v3dg.viewer.gate import Gate
        except ImportError as error:
            raise ImportError(
                "the viewer needs viser, which is not installed; pip install 'v3dg[viewer]'"
            ) from error
        # A tab may be closed while a picture is on its way to it.
        warnings.filterwarnings("ignore", "Queued a .* on a closed connection", UserWarning)
        self._tabs: dict[int, Tab] = {}
        self._ending: list[Tab] = []
        self._gate = Gate(host, port)
        self.port, self.url = self._gate.port, self._gate.url
        with contextlib.redirect_stdout(io.StringIO()), self._gate.guarding():  # who tells it where to listen
            self._server = viser.ViserServer(host="127.0.0.1", port=0, label=name, verbose=False)
        self._server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        self._server.gui.main_panel.dock_right()  # beside the picture, not over it
        start, upwards = start_view(scene_view, up), np.asarray(up, np.float64)
        self._server.scene.set_up_direction(upwards)
        first = self._server.initial_camera
        first.position, first.look_at = start.position, scene_view.center
        first.up, first.fov = upwards, _FOV_Y
        settings = Settings(tolerance=tolerance, budget=budget)

        # Both are called on the event loop, one after the other.
        async def connect(client: viser.ClientHandle) -> None:
            camera = BrowserCamera(client, scene_view)
            self._tabs[client.client_id] = Tab(camera, name, cameras or {}, settings, start)

        async def disconnect(client: viser.ClientHandle) -> None:
            tabs = (*self._ending, self._tabs.pop(client.client_id))
            self._ending = [tab for tab in tabs if not tab.close(0.0)]

        self._server.on_client_connect(connect)
        self._server.on_client_disconnect(disconnect)

    def close(self) -> bool:
        """End all tabs and the server in about two seconds; returns whether all their threads have ended."""
        for tab in tuple(self._tabs.values()):
            tab.close(0.0)
        with contextlib.redirect_stdout(io.StringIO()):  # the command says what there is to say
            self._server.stop()
        end = time.monotonic() + _CLOSE_SECONDS
        tabs = (*self._tabs.values(), *self._ending)
        return all([tab.close(max(end - time.monotonic(), 0.0)) for tab in tabs])


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
