"""Instances in a scene of Blender, and the scene of v3dg that they are.

An instance is an object whose `v3dg.bundle` names a file. Its pose is that of the
object, applied to a bundle that stands upright: an object without a rotation shows its
asset with z up. Lengths are Blender's units.
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

# In Blender, a sensor is this many mm wide unless the camera says otherwise.
_SENSOR_MM = 36.0
# Largest relative deviation of an object's matrix from a similarity.
_SIMILAR = 1e-4


class Placed(NamedTuple):
    """A bundle's instance in the world: an object, or a copy of it that another object
    makes."""

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
    """Return the bundle in a file. It is opened again when the file has changed.

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


def instances(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the objects that show a bundle."""
    return [item for item in scene.objects if item.v3dg.bundle and item.type != "EMPTY"]


def rendered(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the instances that renders show."""
    return [item for item in instances(scene) if not item.hide_render]


def visible(scene: bpy.types.Scene) -> list[bpy.types.Object]:
    """Return the instances that viewports show."""
    return [item for item in instances(scene) if item.visible_get()]


def poses(items: Sequence[bpy.types.Object], depsgraph: bpy.types.Depsgraph) -> Floats:
    """Return (I, 4, 4) the matrices of objects at the time of a dependency graph."""
    matrices = [item.evaluated_get(depsgraph).matrix_world for item in items]
    result: Floats = np.array(matrices, np.float64).reshape(-1, 4, 4)
    return result


def add_instances(
    scene: v3dg.Scene, items: Sequence[bpy.types.Object], matrices: npt.ArrayLike
) -> None:
    """Add objects to a scene of v3dg, at similarities (I, 4, 4)."""
    if not items:
        return
    scene.add(
        [open_bundle(bundle_path(item)) for item in items],
        matrix=matrices,
        importance=[item.v3dg.importance for item in items],
        opacity=[item.v3dg.opacity for item in items],
        tint=[tuple(item.v3dg.tint) for item in items],
        environment=[item.v3dg.environment for item in items],
        up="z",
    )


def nearest_similarities(matrices: Floats) -> Floats:
    """Return (I, 4, 4) similarities that are as large as the longest axis of each
    matrix. Blender may stretch and mirror an object, which v3dg's cuts need not know:
    they are then a little finer than necessary."""
    linear = matrices[:, :3, :3]
    left, sizes, right = np.linalg.svd(linear)
    left[:, :, 2] *= np.sign(np.linalg.det(left @ right))[:, None]
    result: Floats = matrices.copy()
    result[:, :3, :3] = left @ right * np.maximum(sizes[:, :1, None], 1e-20)
    return result


def similarity_problem(matrix: Floats) -> str | None:
    """Return in what a matrix (4, 4) is not a similarity, or None."""
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
    """Add an object for each instance of a scene, whose `up` (else z) becomes z."""
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
        item = new_instance(path, matrix, collection)
        item.v3dg.importance = float(upright.importance[number])
        item.v3dg.opacity = float(upright.opacity[number])
        item.v3dg.tint = upright.tint[number].tolist()
        item.v3dg.environment = int(upright.environments[number])
        items.append(item)
    return items


def turn_upright(scene: v3dg.Scene) -> Floats:
    """Return the rotation (3, 3) of a scene's `up` (else z) to z."""
    quaternion = mathutils.Quaternion(turn_between(scene.up or "z", "z"))
    result: Floats = np.array(quaternion.to_matrix(), np.float64)
    return result


def set_camera(camera: bpy.types.Object, source: v3dg.Camera, turn: Floats) -> None:
    """Give a camera object of Blender the pose and the lens of a pinhole, after a
    rotation (3, 3) of the world. Blender has one focal length for both axes, so pixels
    that are not square become square."""
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
    """Return the rotation from a bundle that stands upright to the bundle."""
    scene = v3dg.Scene()
    scene.add(bundle, up="z")
    return mathutils.Quaternion(scene.quaternions[0]).inverted()


def placed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> list[Placed]:
    """Return what a scene file holds: all instances that are rendered, empties with a
    bundle, and copies that collections and geometry nodes make."""
    items = [item for item in scene.objects if item.v3dg.bundle and not item.hide_render]
    result = [
        Placed(item, matrix) for item, matrix in zip(items, poses(items, depsgraph), strict=True)
    ]
    for copy in depsgraph.object_instances:
        source = copy.object.original
        # Copies that an instance makes of itself are parts of its picture.
        is_copy = copy.is_instance and copy.parent is not None and copy.parent.original != source
        if is_copy and source.v3dg.bundle:
            result.append(Placed(source, np.array(copy.matrix_world, np.float64)))
    return result


def as_scene(items: Iterable[Placed]) -> v3dg.Scene:
    """Return the scene that v3dg writes.

    Raises:
        ValueError: An instance is stretched, sheared or mirrored.
        OSError: A bundle cannot be read.
    """
    items = list(items)
    for item in items:
        problem = similarity_problem(item.matrix)
        if problem is not None:
            raise ValueError(
                f"{item.source.name}: expected a rotation, a translation and one positive scale, "
                f"got {problem}; scale it alike along all axes"
            )
    scene = v3dg.Scene()
    scene.up = "z"
    add_instances(scene, [item.source for item in items], [_exact(item.matrix) for item in items])
    return scene


def _exact(matrix: Floats) -> Floats:
    """Return a similarity without the rounding of single precision."""
    result: Floats = nearest_similarities(matrix[None])[0]
    return result
