"""What selection reads of a scene, kept on a CUDA device from call to call."""

from __future__ import annotations

import weakref
from typing import Any

from v3dg import _core, _device
from v3dg.bundle import Bundle
from v3dg.scene import Scene


class ResidentScene:
    """A scene's tables and instances on torch's current CUDA device.

    Attributes:
        core: The compiled module's part.
        num_bundles: How many of the scene's bundles are there.
        drawings: Frames that may be under way.
    """

    def __init__(self, scene: Scene) -> None:
        self.device = _device.current_device()
        self.num_bundles = len(scene.bundles)
        tables = [
            (table, bundle.clusters.filter_px2, bundle.clusters.antialiased)
            for table, bundle in zip(scene.tables, scene.bundles, strict=True)
        ]
        self.core = _core.DeviceScene(tables, _device.current_stream())
        self.drawings: weakref.WeakSet[Any] = weakref.WeakSet()
        self._seen = (-1, -1)

    def update(self, scene: Scene) -> None:
        """Upload what has changed since the last time: nothing, the poses, or all instances.

        Frames under way are finished first: one that found a buffer too small will be drawn again.
        """
        if self._seen == (scene.num_changes, scene.num_moves):
            return
        for drawing in self.drawings:
            drawing.finish()
        self.drawings.clear()
        stream = _device.current_stream()
        if self._seen[0] != scene.num_changes:
            self.core.set_instances(instances_of(scene), stream)
        else:
            positions, quaternions, scales = _poses(scene)
            self.core.set_poses(positions, quaternions, scales, stream)
        self._seen = (scene.num_changes, scene.num_moves)


def instances_of(scene: Scene, *, on_host: bool = False) -> tuple[Any, ...]:
    """The instances as the core takes them."""
    poses = (scene.positions, scene.quaternions, scene.scales) if on_host else _poses(scene)
    return (scene.instance_bundle, *poses, scene.importance)


def _poses(scene: Scene) -> tuple[Any, ...]:
    """Where they are; on the current device, if they are on another one."""
    poses = scene.poses_anywhere()
    device = _device.current_device()
    return tuple(
        rows.to(device) if getattr(rows, "is_cuda", False) and rows.device.index != device else rows
        for rows in poses
    )


# Of scenes and bundles, as long as those live.
_residents: weakref.WeakKeyDictionary[Scene | Bundle, ResidentScene] = weakref.WeakKeyDictionary()


def resident_of(subject: Scene | Bundle) -> ResidentScene:
    """The scene as it is now, on the current device; a bundle as a scene of one."""
    known = _residents.get(subject)
    scene = Scene.of(subject)
    is_elsewhere = known is not None and known.device != _device.current_device()
    if known is None or is_elsewhere or known.num_bundles != len(scene.bundles):
        known = _residents[subject] = ResidentScene(scene)
        known.update(scene)
    elif scene is subject:  # a bundle stays as it is
        known.update(scene)
    return known
