"""The folder *Path* of a tab: a camera path is made there, played, and saved."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from v3dg.cameras import Camera
from v3dg.viewer.browser_camera import BrowserCamera
from v3dg.viewer.controls import Controls
from v3dg.viewer.exports import Exporter, cameras_bytes, film_bytes, scene_bytes
from v3dg.viewer.frame import Pixels, SceneView, Settings
from v3dg.viewer.path import CameraPath
from v3dg.viewer.view import View

if TYPE_CHECKING:
    import viser

_FILM_SIZES = {"1280 x 720": (1280, 720), "1920 x 1080": (1920, 1080), "as the window": None}
_FPS = 30


class PathControls:
    """Adds the controls of a path to the tab's panel; each tab has a path of its own.

    Args:
        name: Of the files that are saved.
        controls: What films show.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        scene_view: SceneView,
        name: str,
        camera: BrowserCamera,
        controls: Controls,
        exporter: Exporter,
    ) -> None:
        self._scene_view, self._name = scene_view, name
        self._camera, self._controls, self._exporter = camera, controls, exporter
        self._path, self._recording, self._lock = CameraPath(), False, threading.Lock()
        with client.gui.add_folder("Path", expand_by_default=False):
            self._add_controls(client.gui)
        self._tell()

    def camera_moved(self) -> None:
        """Keep the view if views are recorded; to be called in the order of the moves."""
        if self._recording:
            with self._lock:
                self._path.record(self._camera.view, time.monotonic())

    def _add_controls(self, gui: Any) -> None:
        self._text = gui.add_markdown("")
        self._pause = gui.add_slider("Seconds a view", 0.5, 10.0, 0.5, 2.0)
        gui.add_button("Add this view").on_click(lambda _: self._add())
        self._record = gui.add_checkbox("Record", False, hint="Keep every view while you fly.")
        self._record.on_update(lambda _: self._choose_record())
        gui.add_button("Clear").on_click(lambda _: self._clear())
        begin = self._exporter.begin
        gui.add_button("Play").on_click(lambda _: begin(self._play))
        self._film_size = gui.add_dropdown("Size", tuple(_FILM_SIZES))
        gui.add_button("Save film (.mp4)").on_click(lambda _: begin(self._save_film))
        gui.add_button("Save cameras (transforms.json)").on_click(lambda _: begin(self._save_cameras))
        if all(bundle.path is not None for bundle in self._scene_view.scene.bundles):
            gui.add_button("Save scene (.json)").on_click(lambda _: begin(self._save_scene))
        self._progress = gui.add_progress_bar(0.0, visible=False)
        gui.add_button("Stop").on_click(lambda _: self._exporter.stopped.set())

    def _tell(self) -> None:
        with self._lock:
            count, seconds = len(self._path), self._path.seconds
        self._text.content = f"{count} views, {seconds:.1f} s" if count else "no views yet"

    def _add(self) -> None:
        with self._lock:
            self._path.add(self._camera.view, float(self._pause.value))
        self._tell()

    def _choose_record(self) -> None:
        self._recording = self._record.value
        with self._lock:
            now, view = time.monotonic(), self._camera.view
            if self._recording:
                self._path = CameraPath([now], [view])
            elif len(self._path) and self._path.views[-1] != view:
                self._path.add(view, now - self._path.times[-1])  # to end where the camera rests
        self._tell()

    def _clear(self) -> None:
        with self._lock:
            self._path = CameraPath()
        self._tell()

    def _copy(self) -> CameraPath:
        with self._lock:
            if not len(self._path):
                raise ValueError("path: expected at least one view; add this one, or record while you fly")
            return CameraPath(list(self._path.times), list(self._path.views))

    def _play(self) -> None:
        path = self._copy()
        start = time.monotonic()
        while not self._exporter.stopped.wait(1 / _FPS):
            seconds = time.monotonic() - start
            self._camera.look(path.at(seconds))
            if seconds >= path.seconds:
                return

    def _save_film(self) -> None:
        views = self._copy().views_at(_FPS)
        width, height = _FILM_SIZES[self._film_size.value] or self._controls.size
        size = width // 2 * 2, height // 2 * 2  # as H.264 wants it
        self._progress.value, self._progress.visible = 0.0, True
        try:
            content = film_bytes(self._film(views, size, self._controls.settings), _FPS)
        finally:
            self._progress.visible = False
        self._exporter.download(f"{self._name}.mp4", content)

    def _film(self, views: list[View], size: tuple[int, int], settings: Settings) -> Iterator[Pixels]:
        """The pictures of a film, each drawn when it is asked for."""
        for place, view in enumerate(views):
            if self._exporter.stopped.is_set():
                raise ValueError("the film was stopped")
            view = replace(view, aspect=size[0] / size[1])
            yield self._scene_view.frame(view, size, settings).pixels
            self._progress.value = 100 * (place + 1) / len(views)

    def _cameras(self) -> dict[str, Camera]:
        width, height = self._controls.size
        return self._copy().cameras(_FPS, width, height, self._scene_view.near)

    def _save_cameras(self) -> None:
        self._exporter.download("transforms.json", cameras_bytes(self._cameras()))

    def _save_scene(self) -> None:
        content = scene_bytes(self._scene_view.scene, self._cameras())
        self._exporter.download(f"{self._name}.json", content)
