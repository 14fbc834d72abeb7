"""The folder *Path* of a tab: a camera path is made there, played, and saved."""

from __future__ import annotations

import copy
import functools
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

from v3dg import _core
from v3dg.camera_file import write_cameras
from v3dg.cameras import Camera
from v3dg.scene.file import write_scene
from v3dg.video import write_video
from v3dg.viewer.controls import Controls, add_button, in_order, value_of
from v3dg.viewer.exports import Exporter, bundle_names
from v3dg.viewer.frame import Pixels
from v3dg.viewer.path import CameraPath

_FILM_SIZES = {"1280 x 720": (1280, 720), "1920 x 1080": (1920, 1080), "as the window": None}
_FPS = 30


class PathControls:
    """Adds the controls of a path to the tab's panel; each tab has a path, and films show what it shows."""

    def __init__(self, name: str, controls: Controls, exporter: Exporter) -> None:
        self._name, self._controls, self._exporter = name, controls, exporter
        self._camera, self._scene_view = controls.camera, controls.camera.scene_view
        self._path, self._recording = CameraPath(), False
        gui = self._camera.client.gui
        with gui.add_folder("Path", expand_by_default=False):
            self._add_controls(gui)
        self._tell()

    def camera_moved(self) -> None:
        """Keep the view if views are recorded."""
        if self._recording:
            self._path.record(self._camera.view, time.monotonic())

    def _add_controls(self, gui: Any) -> None:
        self._text = gui.add_markdown("")
        self._pause = gui.add_slider("Seconds a view", 0.5, 10.0, 0.5, 2.0)
        add_button(gui, "Add this view", self._add)
        self._record = gui.add_checkbox("Record", False, hint="Keep every view while you fly.")
        self._record.on_update(in_order(self._choose_record))
        add_button(gui, "Clear", self._clear)
        add_button(gui, "Play", lambda: self._begin(self._play))
        self._film_size = gui.add_dropdown("Size", tuple(_FILM_SIZES))
        add_button(gui, "Save film (.mp4)", lambda: self._begin(self._save_film))
        add_button(gui, "Save cameras (transforms.json)", lambda: self._begin(self._save_cameras))
        if all(bundle.path is not None for bundle in self._scene_view.scene.bundles):
            add_button(gui, "Save scene (.json)", lambda: self._begin(self._save_scene))
        self._progress = gui.add_progress_bar(0.0, visible=False)
        add_button(gui, "Stop", self._exporter.stop)

    def _begin(self, work: Callable[[CameraPath, _core.Stop], None]) -> None:
        """Start work on the path as it is now."""
        self._exporter.begin(functools.partial(work, copy.deepcopy(self._path)))

    def _tell(self) -> None:
        count = len(self._path)
        self._text.content = f"{count} views, {self._path.seconds:.1f} s" if count else "no views yet"

    def _add(self) -> None:
        if not self._recording:
            self._path.add(self._camera.view, value_of(self._pause))
            self._tell()

    def _choose_record(self) -> None:
        self._recording = self._record.value
        now, view = time.monotonic(), self._camera.view
        if self._recording:
            self._path = CameraPath([now], [view])
        elif len(self._path) and self._path.views[-1] != view:
            self._path.add(view, now - self._path.times[-1])  # to end where the camera rests
        self._tell()

    def _clear(self) -> None:
        self._path = CameraPath()
        self._record.value = False
        self._tell()

    def _play(self, path: CameraPath, stop: _core.Stop) -> None:
        start = time.monotonic()
        while not stop.is_requested:
            time.sleep(1 / _FPS)
            seconds = time.monotonic() - start
            self._camera.look(path.at(seconds))
            if seconds >= path.seconds:
                return

    def _save_film(self, path: CameraPath, stop: _core.Stop) -> None:
        width, height = _FILM_SIZES.get(self._film_size.value) or self._controls.size
        size = width // 2 * 2, height // 2 * 2  # as H.264 wants it
        views, settings = path.film(_FPS), self._controls.settings

        def pictures() -> Iterator[Pixels]:
            for place, view in enumerate(views):
                self._progress.value = 100 * place / len(views)
                view = replace(view, aspect=size[0] / size[1])
                yield self._scene_view.frame(view, size, settings, stop).pixels

        self._progress.visible = True
        try:
            self._exporter.save(f"{self._name}.mp4", lambda file: write_video(file, pictures(), fps=_FPS))
        finally:
            self._progress.visible = False

    def _cameras(self, path: CameraPath) -> dict[str, Camera]:
        return path.cameras(_FPS, *self._controls.size, self._scene_view.near)

    def _save_cameras(self, path: CameraPath, _: _core.Stop) -> None:
        cameras = self._cameras(path)
        self._exporter.save("transforms.json", lambda file: write_cameras(file, cameras))

    def _save_scene(self, path: CameraPath, _: _core.Stop) -> None:
        scene, cameras = self._scene_view.scene, self._cameras(path)
        names = bundle_names(scene)
        self._exporter.save(f"{self._name}.json", lambda file: write_scene(file, scene, names, cameras))
