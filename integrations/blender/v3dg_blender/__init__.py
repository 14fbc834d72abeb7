"""Worlds of Gaussian splats in Blender, under one budget (docs/blender.md).

The add-on needs the package v3dg. Its archive contains the wheel (`pack.py`).
"""

try:
    import v3dg as v3dg
except ImportError as error:
    raise ImportError(
        "v3dg_blender: Blender's Python cannot import the package v3dg; install the add-on from "
        "an archive with its wheels, which integrations/blender/pack.py writes"
    ) from error

from . import operators, panel, properties, watch

_MODULES = (properties, operators, panel, watch)


def register() -> None:
    """Add the properties, operators, panels and handlers to Blender."""
    for module in _MODULES:
        module.register()


def unregister() -> None:
    """Remove from Blender what `register` added."""
    for module in reversed(_MODULES):
        module.unregister()
