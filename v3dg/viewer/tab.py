"""A browser tab: its camera and controls, and the loop that draws what they ask for."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from v3dg.cameras import Camera
from v3dg.viewer.browser_camera import BrowserCamera
from v3dg.viewer.controls import Controls
from v3dg.viewer.exports import Exporter, picture_bytes
from v3dg.viewer.figures import FiguresPanel
from v3dg.viewer.frame import Frame, SceneView, Settings
from v3dg.viewer.pacing import RenderLoop, Request
from v3dg.viewer.path_controls import PathControls
from v3dg.viewer.view import View

if TYPE_CHECKING:
    import viser

_NO_CAMERA = ""
# Pictures that pass by, and those that stay.
_DRAFT_QUALITY, _FINAL_QUALITY = 75, 94


class Tab:
    """One browser tab, until `close`.

    Args:
        name: Of the files that are saved.
        cameras: Named cameras to jump to.
        settings: What the controls begin with.
        home: The view of the button that shows all.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        scene_view: SceneView,
        name: str,
        cameras: Mapping[str, Camera],
        settings: Settings,
        home: View,
    ) -> None:
        self._client, self._scene_view, self._name = client, scene_view, name
        self._camera = BrowserCamera(client, scene_view)
        self._exporter = Exporter(client)
        # The panel shows them in the order in which they are made.
        self._figures = FiguresPanel(client)
        self._controls = Controls(client, scene_view, self._camera, settings, self._ask)
        save = client.gui.add_button("Save picture")
        save.on_click(lambda _: self._exporter.begin(self._save_picture))
        self._add_camera_controls(cameras, home)
        path = PathControls(client, scene_view, name, self._camera, self._controls, self._exporter)
        self._loop = RenderLoop(scene_view, self._show, self._figures.explain)

        async def moved(_: viser.CameraHandle) -> None:  # on the event loop, so in the order of the moves
            path.camera_moved()
            self._ask()

        client.camera.on_update(moved)
        self._ask()

    def close(self) -> None:
        """Stop drawing and saving; returns when the threads have ended."""
        self._exporter.close()
        self._loop.close()

    def _ask(self) -> None:
        self._loop.ask(Request(self._camera.view, self._controls.size, self._controls.settings))

    def _show(self, frame: Frame, is_final: bool) -> None:
        quality = _FINAL_QUALITY if is_final else _DRAFT_QUALITY
        self._client.scene.set_background_image(frame.pixels, format="jpeg", jpeg_quality=quality)
        self._client.flush()  # which viser would wait for a sixtieth of a second with
        self._figures.show(frame, is_final)

    def _add_camera_controls(self, cameras: Mapping[str, Camera], home: View) -> None:
        gui: Any = self._client.gui  # whose types let no value be set
        with gui.add_folder("Camera", expand_by_default=False):
            gui.add_button("Show all").on_click(lambda _: self._camera.look(home))
            if cameras:
                names = gui.add_dropdown("Of the file", (_NO_CAMERA, *cameras))
                names.on_update(lambda _: self._look_from(cameras.get(names.value)))
            gui.add_markdown("Drag to turn, right button to move, wheel to go near, W A S D Q E to fly.")

    def _look_from(self, camera: Camera | None) -> None:
        if camera is not None:
            self._camera.look(View.of_camera(camera))

    def _save_picture(self) -> None:
        frame = self._scene_view.frame(self._camera.view, self._controls.size, self._controls.settings)
        self._exporter.download(f"{self._name}.png", picture_bytes(frame.pixels))
