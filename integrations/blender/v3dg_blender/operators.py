"""Operators that open, update, place and save. Blender reports their errors."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from typing import ClassVar, TypeAlias

import bpy
import mathutils
from bpy_extras.io_utils import ExportHelper, ImportHelper

import v3dg

from . import ellipsoids, show, views, watch, world

Result: TypeAlias = set[str]

FINISHED = {"FINISHED"}
CANCELLED = {"CANCELLED"}
# Number of transparent surfaces through which Cycles follows a ray. Its default of 8
# leaves holes in clouds of gaussians.
_TRANSPARENT_BOUNCES = 256


def reported(operator: bpy.types.Operator, work: Callable[[], list[str]]) -> Result:
    """Do the work of an operator. Report its warnings, and errors that a user can
    cause."""
    try:
        warnings = work()
    except (OSError, ValueError, ImportError) as error:
        operator.report({"ERROR"}, str(error))
        return CANCELLED
    for warning in warnings:
        operator.report({"WARNING"}, warning)
    return FINISHED


def _absolute(path: str) -> str:
    """Return the absolute path for a path of a file selector or a script, which may be
    relative to the .blend file."""
    absolute: str = bpy.path.abspath(path)
    return os.path.abspath(absolute)


class V3DG_OT_open(bpy.types.Operator, ImportHelper):
    """Open a bundle (.v3dg), or a scene (.json) with its instances and cameras"""

    bl_idname = "v3dg.open"
    bl_label = "Open v3dg"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    filename_ext = ".v3dg"
    filter_glob: bpy.props.StringProperty(default="*.v3dg;*.json", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> Result:
        return reported(self, lambda: open_file(context, _absolute(self.filepath)))


def open_file(context: bpy.types.Context, path: str) -> list[str]:
    """Open a bundle at the 3D cursor, or a scene. Return warnings.

    Raises:
        ValueError: The file is neither of these, or it is invalid.
        OSError: The file cannot be read.
    """
    name = os.path.basename(path)
    warnings: list[str] = []
    if name.endswith(".v3dg"):
        items = [_open_bundle(context, path)]
    elif name.endswith(".json"):
        items = _open_scene(context, path, warnings)
    else:
        raise ValueError(
            f"{name}: expected a bundle (.v3dg) or a scene (.json); make a bundle of an asset "
            "with `v3dg build`"
        )
    for item in context.selected_objects:
        item.select_set(state=False)
    for item in items:
        item.select_set(state=True)
    context.view_layer.objects.active = next(iter(items), None)
    prepare(context.scene)
    context.view_layer.update()
    depsgraph = context.evaluated_depsgraph_get()
    show.show_coarsest(world.visible(context.scene, depsgraph))
    watch.expect_change()
    return warnings


def prepare(scene: bpy.types.Scene) -> None:
    """Change the settings of a scene for renders of gaussians."""
    # Cuts are chosen in the render thread. Meanwhile, the interface must not draw.
    scene.render.use_lock_interface = True
    cycles = getattr(scene, "cycles", None)
    if cycles is not None:
        cycles.transparent_max_bounces = max(cycles.transparent_max_bounces, _TRANSPARENT_BOUNCES)


def _open_bundle(context: bpy.types.Context, path: str) -> bpy.types.Object:
    world.open_bundle(os.path.realpath(path))
    matrix = mathutils.Matrix.Translation(context.scene.cursor.location)
    return world.new_instance(path, matrix, context.collection)


def _open_scene(
    context: bpy.types.Context, path: str, warnings: list[str]
) -> list[bpy.types.Object]:
    scene, cameras = v3dg.read_scene(path)
    name = os.path.splitext(os.path.basename(path))[0]
    collection = bpy.data.collections.new(name)
    context.collection.children.link(collection)
    items = world.add_scene(scene, collection)
    turn = world.turn_upright(scene)
    for name, camera in cameras.items():
        _add_camera(context, name, camera, turn, collection)
        if camera.is_distorted or not math.isclose(camera.fx, camera.fy, rel_tol=1e-4):
            warnings.append(f"{name}: lens distortion and oblong pixels are left out")
    return items


def _add_camera(
    context: bpy.types.Context,
    name: str,
    camera: v3dg.Camera,
    turn: world.Floats,
    collection: bpy.types.Collection,
) -> None:
    """Add a camera of a scene file. The first one becomes the active camera."""
    item = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    collection.objects.link(item)
    world.set_camera(item, camera, turn)
    if context.scene.camera is None:
        context.scene.camera = item
        context.scene.render.resolution_x = camera.width
        context.scene.render.resolution_y = camera.height


class V3DG_OT_update(bpy.types.Operator):
    """Choose a new cut for the viewport, or for the active camera if there is none"""

    bl_idname = "v3dg.update"
    bl_label = "Update the Cut"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context: bpy.types.Context) -> Result:
        return reported(self, lambda: self._update(context))

    def _update(self, context: bpy.types.Context) -> list[str]:
        context.view_layer.update()
        depsgraph = context.evaluated_depsgraph_get()
        viewport = watch.current_viewport()
        if viewport is None:
            counts = show.show_render(context.scene, depsgraph)
        else:
            counts = show.show_viewport(context.scene, depsgraph, viewport.camera())
        watch.set_status(counts)
        self.report({"INFO"}, watch.status())
        return []


class V3DG_OT_place(bpy.types.Operator):
    """Add an instance of the active object's bundle at each selected empty"""

    bl_idname = "v3dg.place"
    bl_label = "Place at Empties"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.object is not None and bool(context.object.v3dg.bundle)

    def execute(self, context: bpy.types.Context) -> Result:
        source = context.object
        empties = [item for item in context.selected_objects if item.type == "EMPTY"]
        if not empties:
            self.report({"ERROR"}, "selection: no empty is selected; add and select some")
            return CANCELLED
        for empty in empties:
            world.new_instance(
                source.v3dg.bundle, empty.matrix_world.copy(), empty.users_collection[0]
            )
        context.view_layer.update()
        depsgraph = context.evaluated_depsgraph_get()
        show.show_coarsest(world.visible(context.scene, depsgraph))
        watch.expect_change()
        return FINISHED


class V3DG_OT_save_scene(bpy.types.Operator, ExportHelper):
    """Write all rendered instances and cameras to a scene file of v3dg"""

    bl_idname = "v3dg.save_scene"
    bl_label = "Save v3dg Scene"

    filename_ext = ".json"
    filter_glob: bpy.props.StringProperty(default="*.json", options={"HIDDEN"})

    def execute(self, context: bpy.types.Context) -> Result:
        return reported(self, lambda: save_scene(context, _absolute(self.filepath)))


def save_scene(context: bpy.types.Context, path: str) -> list[str]:
    """Write the instances and cameras of the scene. Return warnings.

    Raises:
        ValueError: An instance or a camera cannot be written.
        OSError: The file cannot be written, or a bundle cannot be read.
    """
    with ellipsoids.hidden(world.sources()):
        context.view_layer.update()
        depsgraph = context.evaluated_depsgraph_get()
        scene = world.as_scene(world.placed(context.scene, depsgraph))
    depsgraph = context.evaluated_depsgraph_get()
    items = [
        item for item in context.scene.objects if item.type == "CAMERA" and not item.hide_render
    ]
    cameras = {
        item.name: views.render_camera(context.scene, item, depsgraph)
        for item in items
        if item.data.type == "PERSP"
    }
    v3dg.write_scene(path, scene, cameras=cameras)
    return [
        f"{item.name}: left out, because scene files support only perspective cameras"
        for item in items
        if item.name not in cameras
    ]


class V3DG_FH_open(bpy.types.FileHandler):
    """Opens bundles that are dropped onto a viewport."""

    bl_idname = "V3DG_FH_open"
    bl_label = "v3dg bundle"
    bl_import_operator = "v3dg.open"
    bl_file_extensions = ".v3dg"

    @classmethod
    def poll_drop(cls, context: bpy.types.Context) -> bool:
        return context.area is not None and context.area.type == "VIEW_3D"


def draw_import(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(V3DG_OT_open.bl_idname, text="v3dg (.v3dg, .json)")


def draw_export(menu: bpy.types.Menu, context: bpy.types.Context) -> None:
    menu.layout.operator(V3DG_OT_save_scene.bl_idname, text="v3dg scene (.json)")


CLASSES = (V3DG_OT_open, V3DG_OT_update, V3DG_OT_place, V3DG_OT_save_scene, V3DG_FH_open)


def register() -> None:
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.TOPBAR_MT_file_import.append(draw_import)
    bpy.types.TOPBAR_MT_file_export.append(draw_export)


def unregister() -> None:
    bpy.types.TOPBAR_MT_file_export.remove(draw_export)
    bpy.types.TOPBAR_MT_file_import.remove(draw_import)
    for item in reversed(CLASSES):
        bpy.utils.unregister_class(item)
