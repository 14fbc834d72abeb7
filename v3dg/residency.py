"""Residency: what of which bundle and scene is on which device. The only cache of the package.

What is there is freed with its bundle or scene, or by `residency.clear()`.
"""

import atexit
import copy
import os
import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import Any, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._device import CPU, Device
from v3dg._urls import is_url
from v3dg.bundle import Bundle
from v3dg.bundle.codec import Codec
from v3dg.false_color import ColorBy, palette_of
from v3dg.gaussians import Gaussians, gaussian_bytes
from v3dg.scene import Scene, Subject

_Kept = TypeVar("_Kept")

# A GPU decodes quantised bundles once, rather than in each frame and for each instance, up to so many bytes:
# about what its second-level cache holds. Above, codes are as fast, and take a seventh of the memory.
MOST_DECODED_BYTES = 48 << 20
_PACKED_BYTES = 64  # of a gaussian, which frames of a GPU read besides its rows
_TOO_MANY_BYTES = 1 << 62  # what no memory holds, so that pages come one by one


# What a child of a fork makes anew, because threads that it does not have may have been at work on it.
_NOT_INHERITED = ("frame", "pool", "scene")


_NOTHING = object()


class _LastOne:
    """What is kept of the last value that was asked for."""

    def __init__(self) -> None:
        self.value: Hashable = _NOTHING
        self.kept: object = None


class ResidentScene:
    """What selection and frames read of a scene on one device. On the CPU it stays as it is.

    Attributes:
        core: The compiled module's part.
        references: To the bundles, another tuple where they have changed.
        revision: The scene's that is there.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.core = _core.ResidentScene(device.number)
        # Weak, for a bundle that is drawn by itself would else keep itself alive.
        self.references: tuple[weakref.ref[Bundle], ...] = ()
        self._drawings: weakref.WeakSet[_core.Drawing] = weakref.WeakSet()  # that may be under way
        self._lock = threading.Lock()  # of that set
        self.revision = (-1, -1, -1)

    @property
    def bundles(self) -> tuple[Bundle, ...]:
        """The bundles whose tables are there."""
        return tuple(bundle for reference in self.references if (bundle := reference()) is not None)

    def is_of(self, subject: Subject) -> bool:
        """Whether the subject is there as it is now; a bundle stays as it is."""
        return self.revision == subject.revision if isinstance(subject, Scene) else self.revision[0] >= 0

    def update(self, scene: Scene, tables: list[_core.ClusterTable]) -> None:
        """Take over what has changed since the last time: the poses, or all instances.

        Frames under way are finished first: one that found a buffer too small will be drawn again. It is a
        RuntimeError while a CUDA graph is captured.
        """
        if self.device.is_cuda:
            import torch

            if torch.cuda.is_current_stream_capturing():
                expected = "no change while a CUDA graph is captured, got a new or changed scene"
                raise RuntimeError(f"scene: expected {expected}; draw it once before the capture")
        with self._lock:
            under_way = list(self._drawings)
            self._drawings.clear()
        for drawing in under_way:
            drawing.finish()
        if self.bundles != scene.bundles:
            self.core.set_bundles(tables)
            self.references = tuple(map(weakref.ref, scene.bundles))
        if self.device.is_cuda:
            poses = tuple(self._here(rows) for rows in scene.poses)
        else:
            poses = scene.positions, scene.quaternions, scene.scales
        if self.revision[0] == scene.revision[0]:
            self.core.set_poses(*poses)
        else:
            self.core.set_instances(scene.instance_bundle, scene.importance, *poses)
        self.revision = scene.revision

    def add_drawing(self, drawing: _core.Drawing) -> None:
        """Remember a frame that may be under way."""
        if self.device.is_cuda:
            with self._lock:
                self._drawings.add(drawing)

    def _here(self, rows: Any) -> Any:
        is_elsewhere = getattr(rows, "is_cuda", False) and rows.device.index != self.device.number
        return rows.to(str(self.device)) if is_elsewhere else rows


class Residency:
    """What is on which device, as long as its bundle or scene lives.

    Whatever is asked for and is not there is made; several devices may hold the same bundle at once. Adding a
    bundle to a scene leaves the gaussians of the others where they are.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._kept = weakref.WeakKeyDictionary[Scene | Bundle, dict[Hashable, Any]]()
        self._abandoned: list[Any] = []
        os.register_at_fork(after_in_child=self._after_fork)

    def table(self, bundle: Bundle) -> _core.ClusterTable:
        """What selection and drawing read of the bundle's clusters, on the host."""
        groups = bundle.groups
        of_groups = {"ball": groups.ball, "weight": groups.weight, "level": groups.level}
        columns: dict[str, Any] = vars(bundle.clusters) | of_groups  # the level is that of the groups
        return self.once(bundle, "table", lambda: _core.ClusterTable(**columns))

    def turn(self, device: Device) -> AbstractContextManager[Any]:
        """Meanwhile a scene that is on the device stays as it is, for which on CUDA other threads wait."""
        return self.lock if device.is_cuda else nullcontext()

    def scene(self, subject: Subject, device: Device, last: ResidentScene | None = None) -> ResidentScene:
        """The scene on a device as it is now; a bundle as a scene of one.

        Mostly it is what it was the last time, which is found sooner where that is given.
        """
        if last is not None and last.is_of(subject):
            return last
        if isinstance(subject, Gaussians):
            raise TypeError("subject: expected a Scene or a Bundle, got Gaussians; build a bundle of them")
        with self.lock:
            resident = self.once(subject, ("scene", device), lambda: ResidentScene(device))
            if resident.is_of(subject):
                return resident
            scene = copy.copy(Scene.of(subject))
            if resident.revision[0] >= 0 and not device.is_cuda:  # on the CPU it stays as it is
                resident = ResidentScene(device)
            resident.update(scene, [self.table(bundle) for bundle in scene.bundles])
            self._kept[subject]["scene", device] = resident
            return resident

    def rows(
        self, bundle: Bundle, clusters: NDArray[np.int32], device: Device
    ) -> tuple[_core.Rows, NDArray[np.int64]]:
        """Gaussians of the bundle on a device, and where those of (S,) clusters begin among them: (S,)."""
        if not self._draws_codes(bundle, device):
            return self.gaussians(bundle, device).rows, bundle.clusters.offset[clusters]
        ids, place = np.unique(clusters, return_inverse=True)
        first = np.concatenate([[0], np.cumsum(np.diff(bundle.clusters.offset)[ids])])
        return Gaussians(*self.model(bundle, device).decode(ids)).rows, first[place]

    def model(self, bundle: Bundle, device: Device) -> _core.Model:
        """The bundle's gaussians, or their codes, as frames of a device read them."""

        def make() -> _core.Model:
            codes = bundle.codes
            if codes is not None and self._draws_codes(bundle, device):
                return _core.Model(codes, device.number)
            return _core.Model(self.gaussians(bundle, device).rows)

        return self.once(bundle, ("model", device), make)

    def gaussians(self, bundle: Bundle, device: Device) -> Gaussians:
        """All gaussians of the bundle on a device."""
        if not device.is_cuda:
            return bundle.gaussians
        return self.once(bundle, ("gaussians", device), lambda: bundle.gaussians.torch(str(device)))

    def set_models(
        self, frame: _core.SceneFrame, bundles: Sequence[Bundle], device: Device, color_by: ColorBy
    ) -> None:
        """Have a frame of a device draw these bundles, their gaussians or clusters in these colours."""
        palettes = [
            _core.Palette(self.table(bundle), sh, device.number)
            for bundle in bundles
            if (sh := self.palette(bundle, color_by)) is not None
        ]
        frame.set_models([self.model(bundle, device) for bundle in bundles], palettes)

    def palette(self, bundle: Bundle, color_by: ColorBy) -> NDArray[np.float32] | None:
        """As `palette_of`."""
        return self.once(bundle, ("palette", color_by), lambda: palette_of(bundle, color_by))

    def bytes_to_add(self, bundles: Sequence[Bundle], device: Device) -> dict[Device, int]:
        """What it takes, on the device and on the host, to have all gaussians there that are not yet.

        Those at URLs take more than there is: their pages are fetched as pictures need them."""
        add = {device: 0, CPU: 0}
        for bundle in bundles:
            if ("model", device) in self._kept.get(bundle, {}):
                continue
            is_coded = bundle.codec != Codec.name
            of_pages = bundle.page_bytes if not is_url(bundle.path or "") else _TOO_MANY_BYTES
            add[CPU] += 0 if bundle.is_in_memory else of_pages
            if device.is_cuda or not is_coded:  # the CPU draws codes where they are
                add[device] += bundle.page_bytes
            if device.is_cuda and not is_coded:
                add[device] += _PACKED_BYTES * bundle.num_gaussians
        return add

    def num_bytes(self, device: Device) -> int:
        """Memory that gaussians and tables of all bundles take on a device beside the bundles themselves."""
        with self.lock:
            kept = list(self._kept.values())
        models: list[_core.Model] = [of["model", device] for of in kept if ("model", device) in of]
        tables: list[_core.ClusterTable] = [of["table"] for of in kept if "table" in of]
        return sum(m.bytes for m in models) + sum(t.bytes_on(device.number) for t in tables)

    def clear(self) -> None:
        """Give everything back; what is asked for later is made again."""
        with self.lock:
            self._kept.clear()

    def _draws_codes(self, bundle: Bundle, device: Device) -> bool:
        """Whether a bundle's gaussians are codes on the device, and not rows."""
        if bundle.codes is None or not device.is_cuda:
            return bundle.codes is not None

        def decoded_bytes() -> int:
            size = bundle.num_gaussians * (_PACKED_BYTES + gaussian_bytes(bundle.sh_degree))
            taken = sum(of.get(("decoded", device), 0) for of in self._kept.values())
            return size if size + taken <= MOST_DECODED_BYTES else 0

        return self.once(bundle, ("decoded", device), decoded_bytes) == 0

    def once(self, owner: Scene | Bundle, key: Hashable, make: Callable[[], _Kept]) -> _Kept:
        """What is kept for a bundle or scene, made where it is not there."""
        with self.lock:
            owner = owner if isinstance(owner, Bundle) else Scene.of(owner)  # which refuses others
            kept = self._kept.setdefault(owner, {})
            if key not in kept:
                kept[key] = make()
            return cast(_Kept, kept[key])

    def last(self, owner: Scene | Bundle, key: Hashable, value: Hashable, make: Callable[[], _Kept]) -> _Kept:
        """What was made for this value; what was made for another value is given up first."""
        with self.lock:
            value_and_kept = self.once(owner, key, _LastOne)
            if value_and_kept.value != value:
                value_and_kept.kept = None
                value_and_kept.value = _NOTHING
                value_and_kept.kept = make()
                value_and_kept.value = value
            return cast(_Kept, value_and_kept.kept)

    def _after_fork(self) -> None:
        """In the child of a fork: another thread of the parent may have held a lock, or been at work."""
        self.lock = threading.RLock()
        for kept in self._kept.values():
            for key in [key for key in kept if isinstance(key, tuple) and key[0] in _NOT_INHERITED]:
                # Not destroyed: that would wait for threads that the child does not have.
                self._abandoned.append(kept.pop(key))


residency = Residency()
atexit.register(residency.clear)  # while the driver is there
