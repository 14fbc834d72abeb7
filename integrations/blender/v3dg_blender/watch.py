"""Follows viewports and renders: chooses a new cut when a view or a scene has changed.

A timer polls the viewports, because Blender does not report when a view changes. It
compares the values on which a cut depends with those of the last cut. New data blocks
are not among these values, so showing a cut does not make another one due. Handlers of
renders run in the thread of the render; `operators.prepare` locks the interface for it.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, NamedTuple

import bpy
from bpy.app.handlers import persistent

from . import show, views, world
from .pace import Pace

if TYPE_CHECKING:
    import v3dg

_LOOK_EVERY_S = 0.1


class Viewport(NamedTuple):
    """A 3D viewport on the screen."""

    region: bpy.types.Region
    view: bpy.types.RegionView3D
    near: float

    def key(self) -> tuple[float, ...]:
        """Return numbers that change when the view changes."""
        numbers = [value for row in self.view.perspective_matrix for value in row]
        return (*numbers, self.region.width, self.region.height, self.near)

    def camera(self) -> v3dg.Camera:
        """Return the current camera of the viewport."""
        return views.viewport_camera(self.region, self.view, self.near)


class _State:
    """State of the timer and the handlers between two calls."""

    def __init__(self) -> None:
        self.pace = Pace()
        self.status = ""
        self.is_rendering = False
        self.evaluated_frame = 0
        self.num_changes = 0
        self.keys: dict[int, tuple[float, ...]] = {}
        self.last_moved = 0


_state = _State()


def status() -> str:
    """Return one line: counts of what is shown, or why there is no new cut."""
    return _state.status


def set_status(counts: show.Shown) -> None:
    """Record counts of what is shown."""
    _state.status = (
        f"{counts.num_gaussians:,} gaussians of {counts.num_instances:,} instances in "
        f"{counts.num_blocks:,} data blocks"
    )


def expect_change() -> None:
    """Let the timer choose a new cut."""
    _state.pace.forget()


def viewports() -> list[Viewport]:
    """Return all 3D viewports on the screen."""
    manager = bpy.context.window_manager
    result: list[Viewport] = []
    if manager is None or bpy.app.background:
        return result
    for window in manager.windows:
        for area in window.screen.areas:
            if area.type != "VIEW_3D":
                continue
            space = area.spaces.active
            for region in area.regions:
                view = space.region_3d
                if region.type == "WINDOW" and view is not None:
                    result.append(Viewport(region, view, space.clip_start))
    return result


def current_viewport() -> Viewport | None:
    """Return the viewport that moved last; there is one cut for all of them."""
    by_pointer = {item.region.as_pointer(): item for item in viewports()}
    for pointer, item in by_pointer.items():
        key = item.key()
        if _state.keys.get(pointer) != key:
            _state.last_moved = pointer
        _state.keys[pointer] = key
    if _state.last_moved in by_pointer:
        return by_pointer[_state.last_moved]
    return next(iter(by_pointer.values()), None)


def _look() -> float:
    """Choose a new cut for the viewport if one is due. Return the seconds until the
    next poll."""
    scene = bpy.context.scene
    if scene is None or _state.is_rendering or not scene.v3dg.follows:
        return _LOOK_EVERY_S
    viewport = current_viewport()
    if viewport is None:
        return _LOOK_EVERY_S
    settings = scene.v3dg
    key = (
        viewport.key(),
        _state.num_changes,
        scene.name,
        settings.viewport_budget,
        settings.tolerance_px2,
        settings.culls,
    )
    start_s = time.monotonic()
    if _state.pace.is_due(key, start_s) and world.sources():
        _show(scene, viewport)
        end_s = time.monotonic()
        _state.pace.record(key, end_s, end_s - start_s)
        viewport.region.tag_redraw()
    return _LOOK_EVERY_S


def _show(scene: bpy.types.Scene, viewport: Viewport) -> None:
    depsgraph = bpy.context.evaluated_depsgraph_get()
    try:
        set_status(show.show_viewport(scene, depsgraph, viewport.camera()))
    except (OSError, ValueError) as error:
        _state.status = str(error)


@persistent
def _note_changes(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    """Make a new cut due when an instance or a copy may have been moved, added or
    removed."""
    if any(_may_move_instances(update) for update in depsgraph.updates):
        _state.num_changes += 1


def _may_move_instances(update: bpy.types.DepsgraphUpdate) -> bool:
    item = update.id.original
    if not isinstance(item, bpy.types.Object):
        return isinstance(item, bpy.types.Collection)
    if item.v3dg.bundle:
        # The geometry of an instance changes only with its cut.
        return bool(update.is_updated_transform)
    is_scatter = any(modifier.type == "NODES" for modifier in item.modifiers)
    has_changed = update.is_updated_transform or update.is_updated_geometry
    return bool(has_changed and (is_scatter or item.is_instancer))


@persistent
def _begin_render(scene: bpy.types.Scene, *unused: object) -> None:
    _state.is_rendering = True
    _state.evaluated_frame = scene.frame_current


@persistent
def _end_render(scene: bpy.types.Scene, *unused: object) -> None:
    _state.is_rendering = False
    expect_change()


@persistent
def _show_render(scene: bpy.types.Scene, *unused: object) -> None:
    """Show the cut of the render camera, before each frame of a render."""
    if not world.sources():
        return
    depsgraph = bpy.context.evaluated_depsgraph_get()
    if scene.frame_current != _state.evaluated_frame:
        # A render evaluates the frames of an animation in a separate dependency graph.
        scene.frame_set(scene.frame_current, subframe=scene.frame_subframe)
        _state.evaluated_frame = scene.frame_current
        depsgraph = bpy.context.evaluated_depsgraph_get()
    try:
        set_status(show.show_render(scene, depsgraph))
    except (OSError, ValueError) as error:
        # A handler can neither cancel a render nor report an error. So the message goes
        # to the console and the panel, and the picture shows the previous cut.
        _state.status = str(error)
        print(f"v3dg: {error}")


@persistent
def _forget_file(*unused: object) -> None:
    world.close_bundles()
    _state.keys.clear()
    expect_change()


_HANDLERS = {
    "depsgraph_update_post": _note_changes,
    "render_init": _begin_render,
    "render_pre": _show_render,
    "render_complete": _end_render,
    "render_cancel": _end_render,
    "load_post": _forget_file,
}


def register() -> None:
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).append(handler)
    bpy.app.timers.register(_look, first_interval=_LOOK_EVERY_S, persistent=True)


def unregister() -> None:
    bpy.app.timers.unregister(_look)
    for name, handler in _HANDLERS.items():
        getattr(bpy.app.handlers, name).remove(handler)
    world.close_bundles()
