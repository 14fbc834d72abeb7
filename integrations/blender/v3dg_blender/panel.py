"""The panel in the sidebar of the 3D viewport (N), on the tab v3dg."""

from __future__ import annotations

import bpy

from . import watch
from .operators import V3DG_OT_open, V3DG_OT_place, V3DG_OT_save_scene, V3DG_OT_update


class V3DG_PT_world(bpy.types.Panel):
    """Opens, saves, and sets the budget."""

    bl_idname = "V3DG_PT_world"
    bl_label = "World"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "v3dg"

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        settings = context.scene.v3dg
        row = layout.row(align=True)
        row.operator(V3DG_OT_open.bl_idname, text="Open")
        row.operator(V3DG_OT_save_scene.bl_idname, text="Save Scene")
        column = layout.column(heading="Budget in Gaussians")
        column.prop(settings, "viewport_budget")
        column.prop(settings, "render_budget")
        column.prop(settings, "tolerance_px2")
        column.prop(settings, "culls")
        column.prop(settings, "follows")
        layout.operator(V3DG_OT_update.bl_idname)
        if watch.status():
            layout.label(text=watch.status())
        # Other view transforms than Standard change the colours of the asset.
        layout.prop(context.scene.view_settings, "view_transform")


class V3DG_PT_instance(bpy.types.Panel):
    """Sets how the active instance is shown."""

    bl_idname = "V3DG_PT_instance"
    bl_label = "Instance"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "v3dg"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.object is not None

    def draw(self, context: bpy.types.Context) -> None:
        layout = self.layout
        settings = context.object.v3dg
        layout.prop(settings, "bundle")
        if settings.bundle:
            layout.prop(settings, "importance")
            layout.prop(settings, "opacity")
            layout.prop(settings, "tint")
            layout.prop(settings, "environment")
            layout.operator(V3DG_OT_place.bl_idname)


CLASSES = (V3DG_PT_world, V3DG_PT_instance)


def register() -> None:
    for item in CLASSES:
        bpy.utils.register_class(item)


def unregister() -> None:
    for item in reversed(CLASSES):
        bpy.utils.unregister_class(item)
