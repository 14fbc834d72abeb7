"""Shows the cut of a view: assigns to each instance the data block of its cut."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

import v3dg

from . import splats, views, world
from .cuts import Cut, distinct_cuts

if TYPE_CHECKING:
    from collections.abc import Sequence

    import bpy


@dataclass(frozen=True)
class Shown:
    """Counts of the instances, gaussians and data blocks that a view shows."""

    num_instances: int = 0
    num_gaussians: int = 0
    num_blocks: int = 0
    tolerance_px2: float = 0.0


class _Choice(NamedTuple):
    """The cut of each object that shows something, and counts of the whole view."""

    cuts: dict[bpy.types.Object, Cut]
    counts: Shown


def show(
    placed: Sequence[world.Placed],
    camera: v3dg.Camera,
    *,
    tolerance_px2: float,
    budget: int | None,
    culls: bool,
) -> Shown:
    """Choose one cut for all instances, and show it.

    An object has one data block. So all of its copies by collections and geometry nodes
    show the finest cut that any of them needs, and count with it in the budget.

    Raises:
        ValueError: The coarsest cut exceeds the budget.
        OSError: A bundle cannot be read.
    """
    allowed = budget
    while True:
        choice = _choose(placed, camera, tolerance_px2, allowed, culls=culls)
        if budget is None or choice.counts.num_gaussians <= budget:
            break
        # Copies show more than they need, so the next selection has a smaller budget.
        assert allowed is not None
        allowed = allowed * budget // choice.counts.num_gaussians
    blocks = splats.ensure_blocks({cut.digest: cut for cut in choice.cuts.values()}.values())
    for source in {item.source for item in placed}:
        digest = splats.EMPTY
        if source in choice.cuts:
            digest = choice.cuts[source].digest
        if source.data != blocks[digest]:
            source.data = blocks[digest]
    splats.drop_unused()
    return choice.counts


def _choose(
    placed: Sequence[world.Placed],
    camera: v3dg.Camera,
    tolerance_px2: float,
    budget: int | None,
    *,
    culls: bool,
) -> _Choice:
    selection = v3dg.select(
        _scene_of(placed), camera, budget=budget, tolerance=tolerance_px2, cull=culls
    )
    cuts = distinct_cuts(selection)
    result = {placed[number].source: cut for number, cut in cuts.items()}
    num_placements = Counter(item.source for item in placed)
    num_in_view = Counter(placed[number].source for number in cuts)
    # A cluster outside the view of one copy may be in the view of another.
    copied = [placed[number] for number in cuts if num_placements[placed[number].source] > 1]
    whole = v3dg.select(_scene_of(copied), camera, tolerance=selection.tolerance, cull=False)
    finest = {item.source: 0 for item in copied}
    for number, cut in distinct_cuts(whole).items():
        source = copied[number].source
        if cut.num_gaussians > finest[source]:
            finest[source] = cut.num_gaussians
            result[source] = cut
    counts = Shown(
        num_instances=len(cuts),
        num_gaussians=sum(cut.num_gaussians * num_in_view[item] for item, cut in result.items()),
        num_blocks=len({cut.digest for cut in result.values()}),
        tolerance_px2=selection.tolerance,
    )
    return _Choice(result, counts)


def _scene_of(placed: Sequence[world.Placed]) -> v3dg.Scene:
    scene = v3dg.Scene()
    matrices = np.array([item.matrix for item in placed]).reshape(-1, 4, 4)
    world.add_instances(
        scene, [item.source for item in placed], world.nearest_similarities(matrices)
    )
    return scene


def show_coarsest(placed: Sequence[world.Placed]) -> Shown:
    """Show the coarsest cluster of every instance, wherever it is."""
    camera = v3dg.Camera.look_at((0, -1, 0), (0, 0, 0), width=1, height=1)
    return show(placed, camera, tolerance_px2=np.inf, budget=None, culls=False)


def show_render(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> Shown:
    """Show the cut of the camera of a render.

    Raises:
        ValueError: The scene has no camera, or one that is not supported; or see
            `show`.
        OSError: A bundle cannot be read.
    """
    placed = world.rendered(scene, depsgraph)
    if not placed:
        return Shown()
    if scene.camera is None:
        raise ValueError("camera: the scene has none; add one, or make one active (Ctrl 0)")
    camera = views.render_camera(scene, scene.camera, depsgraph)
    settings = scene.v3dg
    return show(
        placed,
        camera,
        tolerance_px2=settings.tolerance_px2,
        budget=settings.render_budget,
        culls=settings.culls,
    )


def show_viewport(
    scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph, camera: v3dg.Camera
) -> Shown:
    """Show the cut of a viewport; see `show`."""
    placed = world.visible(scene, depsgraph)
    settings = scene.v3dg
    return show(
        placed,
        camera,
        tolerance_px2=settings.tolerance_px2,
        budget=settings.viewport_budget,
        culls=settings.culls,
    )
