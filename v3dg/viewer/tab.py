"""A browser tab: its camera and controls, and the loop that draws what they ask for."""

from __future__ import annotations

import html
import time
from collections.abc import Mapping
from typing import Any

from PIL import Image

from v3dg import _core
from v3dg.cameras import Camera
from v3dg.viewer.controls import BrowserCamera, Controls, add_button, in_order
from v3dg.viewer.exports import Exporter
from v3dg.viewer.figures import box, figures_html
from v3dg.viewer.frame import Frame, Settings
from v3dg.viewer.pacing import RenderLoop, Request
from v3dg.viewer.path_controls import PathControls
from v3dg.viewer.view import View

_NO_CAMERA = ""
# Pictures that pass by, and those that stay.
_DRAFT_QUALITY, _FINAL_QUALITY = 75, 94
_SECONDS_BETWEEN_FIGURES = 0.2


class Tab:
    """One browser tab of a `Site`, until `close`; ``home`` is the view of the button that shows all."""

    def __init__(
        self, camera: BrowserCamera, name: str, cameras: Mapping[str, Camera], settings: Settings, home: View
    ) -> None:
        self._camera, self._name = camera, name
        self._client, self._scene_view = client, scene_view = camera.client, camera.scene_view
        self._exporter = Exporter(camera)
        # The panel shows them in the order in which they are made.
        self._figures, self._last_figures = client.gui.add_html(box("drawing ...")), 0.0
        self._controls = Controls(camera, settings, self._ask)
        add_button(client.gui, "Save picture", lambda: self._exporter.begin(self._save_picture))
        self._add_camera_controls(cameras, home)
        path = PathControls(name, self._controls, self._exporter)
        self._loop = RenderLoop(scene_view, self._show, self._fail)
        client.camera.on_update(in_order(path.camera_moved))
        client.camera.on_update(in_order(self._ask))
        self._ask()

    def close(self, seconds: float) -> bool:
        """Stop drawing and saving; returns whether the threads have ended, waiting so long for each."""
        return all([self._loop.close(seconds), self._exporter.close(seconds)])

    def _wanted(self) -> Request:
        return Request(self._camera.view, self._controls.size, self._controls.settings)

    def _ask(self) -> None:
        self._loop.ask(self._wanted())

    def _show(self, frame: Frame, is_final: bool) -> None:
        quality = _FINAL_QUALITY if is_final else _DRAFT_QUALITY
        self._client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=quality)
        self._client.flush()  # which viser would wait for a sixtieth of a second with
        now = time.monotonic()
        if is_final or now - self._last_figures > _SECONDS_BETWEEN_FIGURES:
            self._figures.content, self._last_figures = figures_html(frame), now

    def _fail(self, error: Exception) -> None:
        reason = html.escape(self._scene_view.explain(error))
        self._figures.content = box(f"<b>Not drawn.</b> {reason}")

    def _add_camera_controls(self, cameras: Mapping[str, Camera], home: View) -> None:
        gui: Any = self._client.gui  # whose types let no value be set
        with gui.add_folder("Camera", expand_by_default=False):
            add_button(gui, "Show all", lambda: self._camera.look(home))
            if cameras:
                names = gui.add_dropdown("Of the file", (_NO_CAMERA, *cameras))
                names.on_update(in_order(lambda: self._look_from(cameras.get(names.value))))
            gui.add_markdown("Drag to turn, right button to move, wheel to go near, W A S D Q E to fly.")

    def _look_from(self, camera: Camera | None) -> None:
        if camera is not None:
            self._camera.look(View.of_camera(camera))

    def _save_picture(self, stop: _core.Stop) -> None:
        frame = self._scene_view.frame(*self._wanted(), stop)
        self._exporter.save(f"{self._name}.png", Image.fromarray(frame.pixels).save)
