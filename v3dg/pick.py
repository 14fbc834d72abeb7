"""Picking: finds the gaussian that a pixel shows."""

import copy
from dataclasses import dataclass

import numpy as np

from v3dg import _core
from v3dg._device import CPU
from v3dg._numbers import check, check_type, refuse, whole
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, Floats
from v3dg.gaussians import Gaussians
from v3dg.opening import File, opened
from v3dg.render import Renderer
from v3dg.residency import residency
from v3dg.scene import Scene
from v3dg.select import rule_of, select


@dataclass(frozen=True)
class Pick:
    """The gaussian with the largest weight in a pixel, and the cluster and instance
    that contain it.

    Attributes:
        instance: Index of the instance.
        cluster: Index of the cluster in the instance's bundle.
        level: The cluster's level.
        weight: Blend weight of the gaussian in the pixel, 0 to 1.
        depth: Depth of the gaussian along the camera's axis, in world units.
        position: (3,) float64, the point at that depth on the pixel's ray, in the
            world.
    """

    instance: int
    cluster: int
    level: int
    weight: float
    depth: float
    position: Floats


def pick(
    subject: Scene | Bundle | File,
    camera: Camera,
    x: int,
    y: int,
    *,
    tolerance: float | None = None,
    budget: int | None = None,
    min_level: int = 0,
    renderer: Renderer | None = None,
) -> Pick | None:
    """Return the gaussian with the largest weight in pixel (x, y) of the picture that
    `v3dg.render` draws. Return None if the pixel is empty. The position of the gaussian
    is NaN if the lens shows no direction at the pixel, but a gaussian next to it
    reaches the pixel.

    Only this pixel is computed, on the CPU. The cut is the same on every device.

    Args:
        subject: The subject of the picture, or its file.
        x: Column, from 0 at the left.
        y: Row, from 0 at the top.
        tolerance, budget, min_level: The same values as for the picture.
        renderer: A renderer of the same scene with a pool on the CPU. If it is given,
            only gaussians in its pool are considered, and no pages are read.

    Raises:
        ValueError: The pixel is not in the image, or another argument is invalid for
            `v3dg.render`.
    """
    check_type("camera", camera, Camera, "a Camera")
    x = whole(x, "x", "a column index of at least 0", 0)
    y = whole(y, "y", "a row index of at least 0", 0)
    is_inside = x < camera.width and y < camera.height
    check("x, y", is_inside, f"a pixel inside {camera.width} x {camera.height}, got ({x}, {y})")
    # Other threads may change the scene meanwhile.
    scene = copy.copy(Scene.of(opened(subject)))
    if budget is not None:  # the budget is for the whole picture, not for one pixel
        cut = select(
            scene, camera, tolerance=tolerance, budget=budget, min_level=min_level, device=CPU
        )
        tolerance = cut.tolerance
    rule = rule_of(tolerance, None, min_level)
    pixel = camera.core.window(x, y, x + 1, y + 1)
    if renderer is not None:
        hit = _pick_from_pool(renderer, scene, pixel, rule)
    else:
        hit = _pick_from_scene(scene, pixel, rule)
    if hit is None:
        return None
    bundle = scene.bundles[scene.instance_bundle[hit.instance]]
    level = int(bundle.clusters.level[hit.cluster])
    ray = camera.directions([[x + 0.5, y + 0.5]])[0]
    position = camera.position + hit.depth * ray @ camera.viewmat[:3, :3]
    return Pick(hit.instance, hit.cluster, level, hit.weight, hit.depth, position)


def _pick_from_scene(scene: Scene, pixel: _core.Camera, rule: _core.Rule) -> _core.Pick | None:
    """Pick from all gaussians of a scene."""
    resident = residency.scene(scene, CPU)
    frame = _core.SceneFrame(CPU.number)
    residency.set_models(frame, resident.bundles, CPU, "appearance")
    return frame.pick(resident.core, _core.FrameRequest(pixel, rule))


def _pick_from_pool(
    renderer: Renderer, scene: Scene, pixel: _core.Camera, rule: _core.Rule
) -> _core.Pick | None:
    """Pick from the gaussians that are resident in the renderer's pool.

    Raises:
        TypeError: ``renderer`` is not a Renderer.
        ValueError: The renderer draws another scene, or has no pool on the CPU.
    """
    check_type("renderer", renderer, Renderer, "a Renderer")
    expected = (
        "a renderer of this subject, got one of another subject; create a renderer for this one"
    )
    check("renderer", _draws(renderer, scene), expected)
    pool = renderer.pool_frame
    if pool is None or pool.device.is_cuda:
        refuse("renderer", f"a renderer with a pool on the CPU, got {renderer}")
    return pool.pick(renderer.subject, pixel, rule)


def _draws(renderer: Renderer, scene: Scene) -> bool:
    """Return whether a renderer draws the same instances as this scene, from the same
    bundles or from the same files."""
    if isinstance(renderer.subject, Gaussians):
        return False
    drawn = Scene.of(renderer.subject)
    if not np.array_equal(drawn.instance_bundle, scene.instance_bundle):
        return False
    if len(drawn.bundles) != len(scene.bundles):
        return False
    return all(map(_is_same_bundle, drawn.bundles, scene.bundles))


def _is_same_bundle(first: Bundle, second: Bundle) -> bool:
    if first is second:
        return True
    return first.path is not None and first.path == second.path
