"""Shows the cut of a view: gives each instance the data block of its cut."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

import v3dg

from . import splats, views, world
from .cuts import distinct_cuts

if TYPE_CHECKING:
    from collections.abc import Sequence

    import bpy


@dataclass(frozen=True)
class Shown:
    """What a view shows."""

    num_instances: int = 0
    num_gaussians: int = 0
    num_blocks: int = 0
    tolerance_px2: float = 0.0


def show(
    items: Sequence[bpy.types.Object],
    depsgraph: bpy.types.Depsgraph,
    camera: v3dg.Camera,
    *,
    tolerance_px2: float,
    budget: int | None,
    culls: bool,
) -> Shown:
    """Choose one cut for all instances, and show it.

    Raises:
        ValueError: The coarsest cut exceeds the budget.
        OSError: A bundle cannot be read.
    """
    scene = v3dg.Scene()
    matrices = world.nearest_similarities(world.poses(items, depsgraph))
    world.add_instances(scene, items, matrices)
    selection = v3dg.select(scene, camera, budget=budget, tolerance=tolerance_px2, cull=culls)
    cuts = distinct_cuts(selection)
    different = {cut.digest: cut for cut in cuts.values()}
    blocks = splats.ensure_blocks(different.values())
    for number, item in enumerate(items):
        digest = splats.EMPTY
        if number in cuts:
            digest = cuts[number].digest
        if item.data != blocks[digest]:
            item.data = blocks[digest]
    splats.drop_unused()
    return Shown(len(cuts), selection.num_gaussians, len(different), selection.tolerance)


def show_coarsest(items: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph) -> Shown:
    """Show the coarsest cluster of every instance, wherever it is."""
    camera = v3dg.Camera.look_at((0, -1, 0), (0, 0, 0), width=1, height=1)
    return show(items, depsgraph, camera, tolerance_px2=np.inf, budget=None, culls=False)


def show_render(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> Shown:
    """Show the cut of the camera of a render.

    Raises:
        ValueError: The scene has no camera, or one that is not supported; or see
            `show`.
        OSError: A bundle cannot be read.
    """
    items = world.rendered(scene)
    if not items:
        return Shown()
    if scene.camera is None:
        raise ValueError("camera: the scene has none; add one, or make one active (Ctrl 0)")
    camera = views.render_camera(scene, scene.camera, depsgraph)
    settings = scene.v3dg
    return show(
        items,
        depsgraph,
        camera,
        tolerance_px2=settings.tolerance_px2,
        budget=settings.render_budget,
        culls=settings.culls,
    )


def show_viewport(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, camera: v3dg.Camera
) -> Shown:
    """Show the cut of a viewport; see `show`."""
    items = world.visible(scene)
    settings = scene.v3dg
    return show(
        items,
        depsgraph,
        camera,
        tolerance_px2=settings.tolerance_px2,
        budget=settings.viewport_budget,
        culls=settings.culls,
    )
