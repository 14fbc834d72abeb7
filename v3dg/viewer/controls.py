"""A tab's camera, and the controls that say what its pictures show, and how finely."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE
from v3dg.viewer.frame import SceneView, Settings, Shows
from v3dg.viewer.pacing import Size, scaled
from v3dg.viewer.view import View

if TYPE_CHECKING:
    import viser

_SHOWS: dict[str, Shows] = {
    "Colour": "appearance",
    "Level": "level",
    "Cluster": "cluster",
    "Depth": "depth",
    "Alpha": "alpha",
    "Gaussians per pixel": "count",
    "Difference to all gaussians": "difference",
}
_WANTS_LEVELS = ("level", "difference")
# Of a picture's longer side, however large a window the page claims to have.
_MOST_PIXELS = 4096


def value_of(slider: Any) -> float:
    """What a slider is at; within its range, to which a page need not keep."""
    return float(max(slider.min, min(slider.max, slider.value)))  # the upper end for NaN, in this order


def in_order(act: Callable[[], None]) -> Callable[[Any], Coroutine[Any, Any, None]]:
    """A callback that viser calls on its event loop, so that a tab's changes follow each other."""

    async def called(_: Any) -> None:
        act()

    return called


def add_button(gui: Any, label: str, act: Callable[[], None]) -> None:
    gui.add_button(label).on_click(in_order(act))


class BrowserCamera:
    """What a browser tab, its client, looks from at a scene; both its user and the viewer move it."""

    def __init__(self, client: viser.ClientHandle, scene_view: SceneView) -> None:
        self.client, self.scene_view = client, scene_view

    @property
    def view(self) -> View:
        camera = self.client.camera
        wxyz, position = tuple(camera.wxyz.tolist()), tuple(camera.position.tolist())
        return View(wxyz, position, float(camera.fov), float(camera.aspect))

    def size(self, scale: float) -> Size:
        """Width and height of the tab's picture in px, multiplied by ``scale`` or what keeps it drawable."""
        width, height = self.client.camera.image_width, self.client.camera.image_height
        return scaled((width, height), min(scale, _MOST_PIXELS / max(width, height)))

    def look(self, view: View) -> None:
        """Move to a view, to turn about what is in its middle, as far away as the scene."""
        camera, eye = self.client.camera, np.asarray(view.position)
        forward = view.camera(1, 1, self.scene_view.near).viewmat[2, :3]
        distance = max(float((self.scene_view.center - eye) @ forward), 0.05 * self.scene_view.radius)
        # From where a page claims to be there may be no way.
        with contextlib.suppress(ValueError), self.client.atomic():
            camera.position = eye
            camera.look_at = eye + distance * forward
            camera.wxyz = np.asarray(view.wxyz)  # whose roll the point alone leaves open
            camera.fov = view.fov_y


class Controls:
    """Adds the controls to the tab's panel, and tells what they are set to, and that it has ``changed``."""

    def __init__(self, camera: BrowserCamera, settings: Settings, changed: Callable[[], None]) -> None:
        self.camera, self._changed = camera, changed
        self._frozen: View | None = None
        self._gui: Any = camera.client.gui  # whose types let no value be set
        has_levels = camera.scene_view.num_levels > 1
        names = [name for name, shows in _SHOWS.items() if has_levels or shows not in _WANTS_LEVELS]
        self._shows = self._gui.add_dropdown("Show", names)
        self._shows.on_update(in_order(self._choose_shows))
        self._gain = self._slider("Amplify", 1, 50, 1, round(settings.gain), visible=False)
        self._add_cut_controls(settings, has_levels)
        hint = "Of the window, at rest; while moving it follows the speed."
        self._resolution = self._slider("Resolution %", 10, 100, 5, 100, hint=hint)

    @property
    def settings(self) -> Settings:
        return Settings(
            shows=_SHOWS.get(self._shows.value, "appearance"),
            tolerance=value_of(self._tolerance),
            budget=round(1e6 * value_of(self._budget)) if self._limits.value else None,
            min_level=round(value_of(self._min_level)),
            fade=DEFAULT_FADE if self._fades.value else None,
            gain=value_of(self._gain),
            split=value_of(self._split),
            frozen=self._frozen,
        )

    @property
    def size(self) -> Size:
        """Width and height of the picture at rest, px."""
        return self.camera.size(value_of(self._resolution) / 100)

    def _slider(self, *args: Any, **options: Any) -> Any:
        """As viser's; its values are of the type of the first."""
        slider = self._gui.add_slider(*args, **options)
        slider.on_update(in_order(self._changed))
        return slider

    def _add_cut_controls(self, settings: Settings, visible: bool) -> None:
        """Add those that choose among levels."""
        tolerance, budget = float(settings.tolerance), settings.budget
        hint = "Screen area that one gaussian of a coarser cluster may stand for; 0 draws all."
        most = max(32.0, tolerance)
        self._tolerance = self._slider(
            "Tolerance px²", 0.0, most, 0.25, tolerance, visible=visible, hint=hint
        )
        hint = "The tolerance is raised until no more than so many are selected."
        limits = budget is not None
        self._limits = self._gui.add_checkbox("Limit gaussians", limits, visible=visible, hint=hint)
        self._limits.on_update(in_order(self._choose_limits))
        millions = 2.0 if budget is None else budget / 1e6
        least, most = min(0.01, millions), max(20.0, millions)
        self._budget = self._slider("Millions", least, most, 0.01, millions, visible=visible and limits)
        last_level = max(self.camera.scene_view.num_levels - 1, 1)
        self._min_level = self._slider("Finest level", 0, last_level, 1, 0, visible=visible)
        hint = "A level comes as the other goes, so that nothing pops while the camera moves."
        self._fades = self._gui.add_checkbox("Fade", settings.fade is not None, visible=visible, hint=hint)
        self._fades.on_update(in_order(self._changed))
        hint = "All gaussians on the left, the cut on the right."
        self._split = self._slider("Split", 0.0, 1.0, 0.01, 0.0, visible=visible, hint=hint)
        hint = "Keep what this camera needs, and fly around it."
        self._freeze = self._gui.add_checkbox("Freeze the cut", False, visible=visible, hint=hint)
        self._freeze.on_update(in_order(self._choose_freeze))

    def _choose_shows(self) -> None:
        self._gain.visible = self.settings.shows == "difference"
        self._changed()

    def _choose_limits(self) -> None:
        self._budget.visible = self._limits.value
        if self._limits.value:
            self._tolerance.value = 0.0
        elif self._tolerance.value == 0.0:
            self._tolerance.value = DEFAULT_TOLERANCE
        self._changed()

    def _choose_freeze(self) -> None:
        self._frozen = self.camera.view if self._freeze.value else None
        if self._frozen is None:
            self.camera.client.scene.remove_by_name("/frozen")
        else:
            self.camera.client.scene.add_camera_frustum(
                "/frozen",
                self._frozen.fov_y,
                self._frozen.aspect,
                scale=0.05 * self.camera.scene_view.radius,
                thickness=2.0,
                thickness_units="screen",
                color=(255, 190, 60),
                wxyz=self._frozen.wxyz,
                position=self._frozen.position,
            )
        self._changed()
