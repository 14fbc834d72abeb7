"""Instances in a scene of Blender, and their conversion to and from scenes of v3dg.

An instance is an object whose `v3dg.bundle` names a file. The pose of the object is
applied to the upright bundle, so an object without a rotation shows its asset with z
up. Lengths are in Blender's units.
"""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, NamedTuple

import bpy
import mathutils
import numpy as np

import v3dg
from v3dg.rotations import turn_between

from . import ellipsoids, splats

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    import numpy.typing as npt

    Floats = npt.NDArray[np.float64]

# The default width of a camera's sensor in Blender.
_SENSOR_MM = 36.0
# Largest relative deviation of an object's matrix from a similarity.
_SIMILAR = 1e-4


class Placed(NamedTuple):
    """An instance of a bundle in the world: an object, or a copy of it that another
    object makes."""

    source: bpy.types.Object
    matrix: Floats  # (4, 4)


class _OpenBundle(NamedTuple):
    bundle: v3dg.Bundle
    size: int
    time_ns: int


_open_bundles: dict[str, _OpenBundle] = {}


def bundle_path(instance: bpy.types.Object) -> str:
    """Return the absolute path of an instance's bundle."""
    path: str = bpy.path.abspath(instance.v3dg.bundle, library=instance.library)
    return os.path.realpath(path)


def open_bundle(path: str) -> v3dg.Bundle:
    """Return the bundle in a file, which is reopened if the file has changed.

    Raises:
        OSError: The file cannot be read.
        ValueError: The file is not a bundle.
    """
    if not os.path.exists(path):
        raise FileNotFoundError(
            f"{path}: expected a bundle, got a path that does not exist; choose the file again "
            "(v3dg > Instance > Bundle)"
        )
    status = os.stat(path)
    opened = _open_bundles.get(path)
    if opened is None or (opened.size, opened.time_ns) != (status.st_size, status.st_mtime_ns):
        opened = _OpenBundle(v3dg.Bundle.open(path), status.st_size, status.st_mtime_ns)
        _open_bundles[path] = opened
    return opened.bundle


def close_bundles() -> None:
    """Forget all open bundles."""
    _open_bundles.clear()


def sources() -> list[bpy.types.Object]:
    """Return all objects of the file that show a bundle. Copies in a scene may show
    objects outside of the scene."""
    return [item for item in bpy.data.objects if item.v3dg.bundle and item.type != "EMPTY"]


def instances(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the objects of a scene that show a bundle."""
    return [item for item in scene.objects if item.v3dg.bundle and item.type != "EMPTY"]


def rendered(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return the instances that renders show, and their copies."""
    items = [item for item in instances(scene) if not item.hide_render]
    return [*own_placements(items, depsgraph), *_shown_copies(depsgraph)]


def visible(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return the instances that viewports show, and their copies."""
    items = [item for item in instances(scene) if item.visible_get()]
    return [*own_placements(items, depsgraph), *_shown_copies(depsgraph)]


def own_placements(
    items: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph
) -> list[Placed]:
    """Return objects at their own poses, as evaluated by a dependency graph."""
    return [
        Placed(item, np.array(item.evaluated_get(depsgraph).matrix_world, np.float64))
        for item in items
    ]


def copies(depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return the copies of instances that collections and geometry nodes make."""
    result: list[Placed] = []
    for copy in depsgraph.object_instances:
        if not copy.is_instance or copy.parent is None:
            continue
        source = copy.object.original
        # Copies with the instance itself as parent are its ellipsoids.
        if source.v3dg.bundle and copy.parent.original != source:
            result.append(Placed(source, np.array(copy.matrix_world, np.float64)))
    return result


def _shown_copies(depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return copies for which cuts are chosen. Before Blender 5.3 there are none,
    because copies of ellipsoids cannot be distinguished from copies of objects."""
    if splats.has_splats():
        return copies(depsgraph)
    return []


def add_instances(
    scene: v3dg.Scene, items: Sequence[bpy.types.Object], matrices: npt.ArrayLike
) -> None:
    """Add objects to a scene of v3dg, with similarities (I, 4, 4) as their poses."""
    if not items:
        return
    # Thousands of instances refer to few files, so each file is looked up only once.
    examples = {(item.v3dg.bundle, item.library): item for item in items}
    bundles = {key: open_bundle(bundle_path(item)) for key, item in examples.items()}
    scene.add(
        [bundles[item.v3dg.bundle, item.library] for item in items],
        matrix=matrices,
        importance=[item.v3dg.importance for item in items],
        opacity=[item.v3dg.opacity for item in items],
        tint=[tuple(item.v3dg.tint) for item in items],
        environment=[item.v3dg.environment for item in items],
        up="z",
    )


def nearest_similarities(matrices: Floats) -> Floats:
    """Return (I, 4, 4) similarities whose scales are the largest scales of matrices.
    Blender may stretch and mirror an object, but selection supports only similarities.
    Cuts of such objects are a little finer than necessary."""
    linear = matrices[:, :3, :3]
    left, sizes, right = np.linalg.svd(linear)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    result: Floats = matrices.copy()
    result[:, :3, :3] = left @ right * np.maximum(sizes[:, :1, None], 1e-20)
    return result


def reason_against_similarity(matrix: Floats) -> str | None:
    """Return the reason why a matrix (4, 4) is not a similarity, or None."""
    linear = matrix[:3, :3]
    size = float(np.linalg.norm(linear, axis=0).max())
    gram = linear.T @ linear
    if size == 0:
        return "a scale of 0"
    if np.abs(gram / size**2 - np.eye(3)).max() > _SIMILAR:
        return "a stretch or a shear"
    if np.linalg.det(linear) < 0:
        return "a mirror"
    return None


def new_instance(
    path: str, matrix: mathutils.Matrix, collection: bpy.types.Collection
) -> bpy.types.Object:
    """Add an object that shows a bundle, in a collection. It shows nothing until a cut
    has been chosen."""
    block = splats.ensure_blocks([])[splats.EMPTY]
    name = os.path.splitext(os.path.basename(path))[0]
    result = bpy.data.objects.new(name, block)
    result.v3dg.bundle = path
    if not splats.has_splats():
        ellipsoids.add_modifier(result)
    collection.objects.link(result)
    result.matrix_world = matrix
    return result


def add_scene(scene: v3dg.Scene, collection: bpy.types.Collection) -> list[bpy.types.Object]:
    """Add an object for each instance of a scene. The scene's `up` (else z) becomes z.

    Raises:
        ValueError: A bundle is at a URL.
    """
    upright = v3dg.Scene()
    upright.add_scene(scene, up="z")
    turns = [_turn_back(bundle) for bundle in upright.bundles]
    items: list[bpy.types.Object] = []
    for number, bundle in enumerate(upright.instance_bundle.tolist()):
        rotation = mathutils.Quaternion(upright.quaternions[number]) @ turns[bundle]
        matrix = mathutils.Matrix.LocRotScale(
            mathutils.Vector(upright.positions[number]),
            rotation,
            mathutils.Vector([float(upright.scales[number])] * 3),
        )
        path = upright.bundles[bundle].path
        assert path is not None
        if "://" in path:
            raise ValueError(f"{path}: expected a bundle on this machine, got a URL; download it")
        item = new_instance(path, matrix, collection)
        item.v3dg.importance = float(upright.importance[number])
        item.v3dg.opacity = float(upright.opacity[number])
        item.v3dg.tint = upright.tint[number].tolist()
        item.v3dg.environment = int(upright.environments[number])
        items.append(item)
    return items


def turn_upright(scene: v3dg.Scene) -> Floats:
    """Return the rotation (3, 3) from a scene's `up` (else z) to z."""
    quaternion = mathutils.Quaternion(turn_between(scene.up or "z", "z"))
    result: Floats = np.array(quaternion.to_matrix(), np.float64)
    return result


def set_camera(camera: bpy.types.Object, source: v3dg.Camera, turn: Floats) -> None:
    """Set the pose and the lens of a camera object of Blender to those of a pinhole,
    after a rotation (3, 3) of the world. Blender has one focal length for both axes, so
    pixels that are not square become square."""
    viewmat = np.array(source.viewmat)
    world_from_view = np.linalg.inv(viewmat) @ np.diag([1.0, -1.0, -1.0, 1.0])
    world_from_view[:3] = turn @ world_from_view[:3]
    camera.matrix_world = mathutils.Matrix(world_from_view.tolist())
    lens = camera.data
    lens.sensor_fit = "HORIZONTAL"
    lens.sensor_width = _SENSOR_MM
    lens.lens = source.fx * _SENSOR_MM / source.width
    lens.shift_x = (0.5 * source.width - source.cx) / source.width
    lens.shift_y = (source.cy - 0.5 * source.height) / source.width
    lens.clip_start = source.near


def _turn_back(bundle: v3dg.Bundle) -> mathutils.Quaternion:
    """Return the rotation from the upright bundle to the bundle."""
    scene = v3dg.Scene()
    scene.add(bundle, up="z")
    return mathutils.Quaternion(scene.quaternions[0]).inverted()


def placed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return the instances of a scene file: all instances that are rendered, empties
    with a bundle, and copies that collections and geometry nodes make."""
    items = [item for item in scene.objects if item.v3dg.bundle and not item.hide_render]
    return [*own_placements(items, depsgraph), *copies(depsgraph)]


def as_scene(items: Iterable[Placed]) -> v3dg.Scene:
    """Return a scene of v3dg with these instances.

    Raises:
        ValueError: An instance is stretched, sheared or mirrored.
        OSError: A bundle cannot be read.
    """
    items = list(items)
    for item in items:
        reason = reason_against_similarity(item.matrix)
        if reason is not None:
            raise ValueError(
                f"{item.source.name}: expected a rotation, a translation and one positive scale, "
                f"got {reason}; use the same scale along all axes"
            )
    scene = v3dg.Scene()
    scene.up = "z"
    add_instances(scene, [item.source for item in items], [_exact(item.matrix) for item in items])
    return scene


def _exact(matrix: Floats) -> Floats:
    """Return a similarity without its rounding errors of single precision."""
    result: Floats = nearest_similarities(matrix[None])[0]
    return result
