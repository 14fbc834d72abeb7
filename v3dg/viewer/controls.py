"""The controls of a tab that say what its pictures show, and how finely."""

from __future__ import annotations

from collections.abc import Callable, Coroutine
from typing import TYPE_CHECKING, Any

from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.browser_camera import BrowserCamera
from v3dg.viewer.frame import SceneView, Settings, Shows
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


class Controls:
    """Adds the controls to the tab's panel, and tells what they are set to.

    Args:
        settings: What they begin with.
        changed: Called after each change.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        scene_view: SceneView,
        camera: BrowserCamera,
        settings: Settings,
        changed: Callable[[], None],
    ) -> None:
        self._client, self._scene_view, self._camera, self._changed = client, scene_view, camera, changed
        self._frozen: View | None = None
        gui: Any = client.gui  # whose types let no value be set
        has_levels = scene_view.num_levels > 1
        names = [name for name, shows in _SHOWS.items() if has_levels or shows not in _WANTS_LEVELS]
        self._shows = gui.add_dropdown("Show", names)
        self._shows.on_update(in_order(self._choose_shows))
        self._gain = gui.add_slider("Amplify", 1, 50, 1, round(settings.gain), visible=False)
        self._gain.on_update(in_order(changed))
        self._add_cut_controls(gui, settings, has_levels)
        self._resolution = gui.add_slider(
            "Resolution %", 10, 100, 5, 100, hint="Of the window, at rest; while moving it follows the speed."
        )
        self._resolution.on_update(in_order(changed))

    @property
    def settings(self) -> Settings:
        return Settings(
            shows=_SHOWS.get(self._shows.value, "appearance"),
            tolerance=value_of(self._tolerance),
            budget=round(1e6 * value_of(self._budget)) if self._limits.value else None,
            min_level=round(value_of(self._min_level)),
            gain=value_of(self._gain),
            split=value_of(self._split),
            frozen=self._frozen,
        )

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture at rest, px."""
        return self._camera.size(value_of(self._resolution) / 100)

    def _add_cut_controls(self, gui: Any, settings: Settings, visible: bool) -> None:
        """Add those that choose among levels."""
        tolerance = float(settings.tolerance)  # a slider's values are of the type of its first
        self._tolerance = gui.add_slider(
            "Tolerance px²",
            0.0,
            max(32.0, tolerance),
            0.25,
            tolerance,
            visible=visible,
            hint="Screen area that one gaussian of a coarser cluster may stand for; 0 draws all.",
        )
        self._limits = gui.add_checkbox(
            "Limit gaussians",
            settings.budget is not None,
            visible=visible,
            hint="The tolerance is raised until no more than so many are selected.",
        )
        millions = 2.0 if settings.budget is None else settings.budget / 1e6
        self._budget = gui.add_slider(
            "Millions",
            min(0.01, millions),
            max(20.0, millions),
            0.01,
            millions,
            visible=visible and settings.budget is not None,
        )
        last_level = max(self._scene_view.num_levels - 1, 1)
        self._min_level = gui.add_slider("Finest level", 0, last_level, 1, 0, visible=visible)
        hint = "All gaussians on the left, the cut on the right."
        self._split = gui.add_slider("Split", 0.0, 1.0, 0.01, 0.0, visible=visible, hint=hint)
        for slider in (self._tolerance, self._budget, self._min_level, self._split):
            slider.on_update(in_order(self._changed))
        self._limits.on_update(in_order(self._choose_limits))
        hint = "Keep what this camera needs, and fly around it."
        self._freeze = gui.add_checkbox("Freeze the cut", False, visible=visible, hint=hint)
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
        self._frozen = self._camera.view if self._freeze.value else None
        if self._frozen is None:
            self._client.scene.remove_by_name("/frozen")
        else:
            self._client.scene.add_camera_frustum(
                "/frozen",
                self._frozen.fov_y,
                self._frozen.aspect,
                scale=0.05 * self._scene_view.radius,
                thickness=2.0,
                thickness_units="screen",
                color=(255, 190, 60),
                wxyz=self._frozen.wxyz,
                position=self._frozen.position,
            )
        self._changed()
