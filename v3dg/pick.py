"""Picking: the object that a pixel shows."""

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
    """The gaussian with the largest weight in a pixel, and what it belongs to.

    Attributes:
        instance: The gaussian's instance.
        cluster: Its cluster, as an index in the instance's bundle.
        level: The cluster's level.
        weight: Its blend weight in the pixel, 0 to 1.
        depth: Its depth along the camera's axis, world units.
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
    `v3dg.render` draws; None if the pixel is empty. Its position is NaN where the lens
    shows no direction, and a gaussian beside it reaches the pixel.

    Computes only this pixel, on the CPU; the cut is the same on every device.

    Args:
        subject: The subject of the picture, or its file.
        x: Column, from 0 at the left.
        y: Row, from 0 at the top.
        tolerance: As for the picture; so are `budget` and `min_level`.
        renderer: A renderer of the same scene with a pool on the CPU: use only what is
            resident there, and read nothing.

    Raises:
        ValueError: The pixel is not in the image, or another argument is invalid for
            `v3dg.render`.
    """
    check_type("camera", camera, Camera, "a Camera")
    x = whole(x, "x", "a column", 0)
    y = whole(y, "y", "a row", 0)
    is_inside = x < camera.width and y < camera.height
    check("x, y", is_inside, f"a pixel of {camera.width} x {camera.height}, got ({x}, {y})")
    scene = copy.copy(Scene.of(opened(subject)))  # another thread may change the scene meanwhile
    if budget is not None:  # the budget applies to the whole picture
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
        TypeError: This is not a renderer.
        ValueError: The renderer draws another scene, or has no pool on the CPU.
    """
    check_type("renderer", renderer, Renderer, "a Renderer")
    expected = "one of this subject, got one of another; make a renderer of what is picked from"
    check("renderer", _draws(renderer, scene), expected)
    pool = renderer.pool_frame
    if pool is None or pool.device.is_cuda:
        refuse("renderer", f"a renderer with a pool on the CPU, got {renderer}")
    return pool.pick(renderer.subject, pixel, rule)


def _draws(renderer: Renderer, scene: Scene) -> bool:
    """Return whether a renderer draws the instances of this scene, from the same
    bundles or the same files."""
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
