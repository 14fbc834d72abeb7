"""The settings of scenes and instances that the add-on stores in a .blend file."""

import bpy

import v3dg

from . import watch


def _expect_change(settings: bpy.types.PropertyGroup, context: bpy.types.Context) -> None:
    watch.expect_change()


class SceneSettings(bpy.types.PropertyGroup):
    """The settings of a scene, `scene.v3dg`."""

    viewport_budget: bpy.props.IntProperty(
        name="Viewport",
        description="Largest number of gaussians of all instances together in the viewport",
        default=500_000,
        min=1,
        soft_max=20_000_000,
    )
    render_budget: bpy.props.IntProperty(
        name="Render",
        description="Largest number of gaussians of all instances together in a render",
        default=2_000_000,
        min=1,
        soft_max=20_000_000,
    )
    tolerance_px2: bpy.props.FloatProperty(
        name="Tolerance",
        description="Largest screen area of a gaussian, in px², up to which coarser gaussians "
        "replace finer ones. It is raised if the cut exceeds the budget",
        default=v3dg.DEFAULT_TOLERANCE,
        min=0.0,
        soft_max=100.0,
    )
    culls: bpy.props.BoolProperty(
        name="Only in View",
        description="Spend the budget on instances that the camera sees. Switch it off if "
        "mirrors or shadows show objects outside the picture",
        default=True,
    )
    follows: bpy.props.BoolProperty(
        name="Follow the Viewport",
        description="Choose a new cut when the view or an instance has moved",
        default=True,
    )


class InstanceSettings(bpy.types.PropertyGroup):
    """The settings of an object, `object.v3dg`. An object without a bundle is not an
    instance."""

    bundle: bpy.props.StringProperty(
        name="Bundle",
        description="File of the bundle that this object shows",
        subtype="FILE_PATH",
    )
    importance: bpy.props.FloatProperty(
        name="Importance",
        description="The instance is shown as if the tolerance were divided by this",
        default=1.0,
        min=0.001,
        soft_max=100.0,
        update=_expect_change,
    )
    opacity: bpy.props.FloatProperty(
        name="Opacity",
        description="Factor of the opacities of all gaussians",
        default=1.0,
        min=0.0,
        max=1.0,
        update=_expect_change,
    )
    tint: bpy.props.FloatVectorProperty(
        name="Tint",
        description="Factors of red, green and blue",
        subtype="COLOR",
        size=3,
        default=(1.0, 1.0, 1.0),
        min=0.0,
        soft_max=1.0,
        update=_expect_change,
    )
    environment: bpy.props.IntProperty(
        name="Environment",
        description="Cameras of this environment see the instance; -1: all do",
        default=-1,
        min=-1,
    )


CLASSES = (SceneSettings, InstanceSettings)


def register() -> None:
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.Scene.v3dg = bpy.props.PointerProperty(type=SceneSettings)
    bpy.types.Object.v3dg = bpy.props.PointerProperty(type=InstanceSettings)


def unregister() -> None:
    del bpy.types.Object.v3dg
    del bpy.types.Scene.v3dg
    for item in reversed(CLASSES):
        bpy.utils.unregister_class(item)
