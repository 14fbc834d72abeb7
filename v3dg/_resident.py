"""What selection reads of a scene, kept on a CUDA device from call to call."""

from __future__ import annotations

import atexit
import threading
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
    """

    def __init__(self, scene: Scene) -> None:
        self.device = _device.current_device()
        self.num_bundles = len(scene.bundles)
        tables = [
            (table, bundle.clusters.filter_px2, bundle.clusters.antialiased)
            for table, bundle in zip(scene.tables, scene.bundles, strict=True)
        ]
        self.core = _core.DeviceScene(tables, _device.current_stream())
        self._drawings: weakref.WeakSet[Any] = weakref.WeakSet()  # that may be under way
        self._lock = threading.Lock()  # of that set
        self._poses: tuple[Any, Any, Any] | None = None
        self._seen = (-1, -1)

    def update(self, scene: Scene) -> None:
        """Upload what has changed since the last time: nothing, the poses, or all instances.

        Frames under way are finished first: one that found a buffer too small will be drawn again.

        Raises:
            RuntimeError: Something has changed, and a CUDA graph is being captured.
        """
        if self._seen == (scene.num_changes, scene.num_moves):
            return
        if _device.is_capturing():
            raise RuntimeError(
                "scene: expected no change while a CUDA graph is captured, got a new or changed scene; "
                "draw as much once before"
            )
        self._finish_drawings()
        stream = _device.current_stream()
        if self._seen[0] != scene.num_changes:
            self.core.set_instances(scene.instance_bundle, scene.importance, stream)
        # What is on the device is read there, and so has to stay.
        positions, quaternions, scales = (self._here(rows) for rows in scene.poses_anywhere())
        self._poses = (positions, quaternions, scales)
        self.core.set_poses(positions, quaternions, scales, stream)
        self._seen = (scene.num_changes, scene.num_moves)

    def add_drawing(self, drawing: Any) -> None:
        """Remember a frame that may be under way."""
        with self._lock:
            self._drawings.add(drawing)

    def _finish_drawings(self) -> None:
        with self._lock:
            under_way = list(self._drawings)
            self._drawings.clear()
        for drawing in under_way:
            drawing.finish()

    def _here(self, rows: Any) -> Any:
        is_elsewhere = getattr(rows, "is_cuda", False) and rows.device.index != self.device
        return rows.to(self.device) if is_elsewhere else rows


def instances_on_host(scene: Scene) -> tuple[Any, ...]:
    """The instances as the CPU's half takes them."""
    return (scene.instance_bundle, scene.positions, scene.quaternions, scene.scales, scene.importance)


# Of scenes and bundles, as long as those live.
_residents: weakref.WeakKeyDictionary[Scene | Bundle, ResidentScene] = weakref.WeakKeyDictionary()
atexit.register(_residents.clear)  # while the driver is there


def resident_of(subject: Scene | Bundle) -> ResidentScene:
    """The scene as it is now, on the current device; a bundle as a scene of one."""
    known = _residents.get(subject)
    if known is not None and known.device != _device.current_device():
        known = None
    if known is not None and isinstance(subject, Bundle):
        return known  # a bundle stays as it is
    scene = Scene.of(subject)
    if known is None or known.num_bundles != len(scene.bundles):
        known = _residents[subject] = ResidentScene(scene)
    known.update(scene)
    return known
