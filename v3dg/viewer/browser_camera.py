"""The camera of a browser tab: where it is, how large its picture is, and how to take it elsewhere."""

from __future__ import annotations

import contextlib
from typing import TYPE_CHECKING

import numpy as np

from v3dg.viewer.frame import SceneView
from v3dg.viewer.pacing import scaled
from v3dg.viewer.view import View

if TYPE_CHECKING:
    import viser

# Of a picture's longer side, however large a window the page claims to have.
_MOST_PIXELS = 4096


class BrowserCamera:
    """What a browser tab looks from, which both its user and the viewer move."""

    def __init__(self, client: viser.ClientHandle, scene_view: SceneView) -> None:
        self._client, self._scene_view = client, scene_view

    @property
    def view(self) -> View:
        camera = self._client.camera
        w, x, y, z = (float(v) for v in camera.wxyz)
        px, py, pz = (float(v) for v in camera.position)
        return View((w, x, y, z), (px, py, pz), float(camera.fov), float(camera.aspect))

    def size(self, scale: float) -> tuple[int, int]:
        """Width and height of the tab's picture in px, multiplied by ``scale`` or what keeps it drawable."""
        width, height = self._client.camera.image_width, self._client.camera.image_height
        return scaled((width, height), min(scale, _MOST_PIXELS / max(width, height)))

    def look(self, view: View) -> None:
        """Move to a view, to turn about what is in its middle, as far away as the scene."""
        camera, eye = self._client.camera, np.asarray(view.position)
        forward = view.camera(1, 1, self._scene_view.near).viewmat[2, :3]
        distance = max(float((self._scene_view.center - eye) @ forward), 0.05 * self._scene_view.radius)
        # From where a page claims to be there may be no way.
        with contextlib.suppress(ValueError), self._client.atomic():
            camera.position = eye
            camera.look_at = eye + distance * forward
            camera.wxyz = np.asarray(view.wxyz)  # whose roll the point alone leaves open
            camera.fov = view.fov_y
