"""Residency: the data of bundles and scenes on devices. This is the only cache of the
package.

Data is freed with its bundle or scene, or by `residency.clear()`. The buffers and pool
slots of a `Renderer` are freed with the renderer. docs/architecture.md, "Memory on the
GPU", lists the owners of all memory.
"""

import atexit
import copy
import threading
import weakref
from collections.abc import Callable, Hashable, Sequence
from contextlib import AbstractContextManager, nullcontext
from typing import TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _system
from v3dg._device import CPU, Device
from v3dg._urls import is_url
from v3dg.bundle import Bundle
from v3dg.bundle.codec import Codec
from v3dg.false_color import ColorBy, palette_of
from v3dg.gaussians import Array, Gaussians, gaussian_bytes
from v3dg.scene import Scene, Subject

_T = TypeVar("_T")

# Quantised bundles up to this size are decoded once on a GPU, instead of in each frame
# for each instance. The limit is about the size of the GPU's second-level cache. For
# larger bundles, drawing the codes is as fast and needs a seventh of the memory.
MOST_DECODED_BYTES = 48 << 20
# Bytes per gaussian that frames on a GPU need in addition to the gaussian's row.
_PACKED_BYTES = 64
# A size that exceeds any memory. With it, pages are only read when pictures need them.
_TOO_MANY_BYTES = 1 << 62

# Kinds of entries that a child after fork() must create anew, because threads that only
# exist in the parent may have been using them.
_NOT_INHERITED = ("frame", "pool", "scene")

_NO_VALUE = object()
# Any number of threads may enter this context at the same time. It is created only
# once, because every frame needs it.
_NO_TURN = nullcontext()


class _LastResult:
    """The result for the most recently requested value."""

    def __init__(self) -> None:
        self.value: Hashable = _NO_VALUE
        self.result: object = None


class ResidentScene:
    """The data of a scene that selection and frames read on one device. On the CPU this
    data never changes.

    Attributes:
        core: The corresponding object of the compiled module.
        references: Weak references to the bundles. Adding bundles replaces this tuple.
        revision: The revision of the scene that this data was made from.
    """

    def __init__(self, device: Device) -> None:
        self.device = device
        self.core = _core.ResidentScene(device.number)
        # The references are weak. Otherwise a bundle that is drawn without a scene
        # would keep itself alive.
        self.references: tuple[weakref.ref[Bundle], ...] = ()
        # Drawings that may still be in progress.
        self._drawings: weakref.WeakSet[_core.Drawing | _core.Batch] = weakref.WeakSet()
        self._lock = threading.Lock()  # guards _drawings
        self.revision = (-1, -1, -1)

    @property
    def bundles(self) -> tuple[Bundle, ...]:
        """The bundles whose tables are on the device."""
        return tuple(bundle for reference in self.references if (bundle := reference()) is not None)

    def is_of(self, subject: Subject) -> bool:
        """Return whether this data belongs to the subject's current revision. A bundle
        never changes."""
        if isinstance(subject, Scene):
            return self.revision == subject.revision
        return self.revision[0] >= 0

    def update(self, scene: Scene, tables: list[_core.ClusterTable]) -> None:
        """Update the data after a change of the scene. If only the poses have changed,
        only these are updated; otherwise, all instances are.

        Frames in progress are finished first, because a frame whose buffers were too
        small is drawn again from this data.

        Raises:
            RuntimeError: A CUDA graph is being captured.
        """
        if self.device.is_cuda:
            import torch

            if torch.cuda.is_current_stream_capturing():
                expected = "no change while a CUDA graph is captured, got a new or a changed scene"
                raise RuntimeError(
                    f"scene: expected {expected}; draw the scene once before the capture"
                )
        with self._lock:
            under_way = list(self._drawings)
            self._drawings.clear()
        for drawing in under_way:
            drawing.finish()
        if self.bundles != scene.bundles:
            self.core.set_bundles(tables)
            self.references = tuple(map(weakref.ref, scene.bundles))
        if self.device.is_cuda:
            poses = tuple(self._on_device(rows) for rows in scene.poses)
        else:
            poses = scene.positions, scene.quaternions, scene.scales
        if self.revision[0] == scene.revision[0]:
            self.core.set_poses(*poses)
        else:
            positions, quaternions, scales = poses
            self.core.set_instances(
                scene.instance_bundle,
                scene.importance,
                positions,
                quaternions,
                scales,
                scene.factors,
                scene.environments,
                scene.labels,
            )
        self.revision = scene.revision

    def add_drawing(self, drawing: _core.Drawing | _core.Batch) -> None:
        """Keep track of a frame that may be in progress."""
        if self.device.is_cuda:
            with self._lock:
                self._drawings.add(drawing)

    def _on_device(self, rows: Array) -> Array:
        """Return the rows on this device if they are on another CUDA device; otherwise
        return them unchanged."""
        if getattr(rows, "is_cuda", False) and rows.device.index != self.device.number:
            return rows.to(str(self.device))
        return rows


class Residency:
    """A cache for the data of bundles and scenes on devices. Data is kept as long as
    its bundle or scene exists.

    Data is created when it is first requested. A bundle may be on several devices at
    once. When a bundle is added to a scene, the gaussians of the other bundles are not
    copied again.
    """

    def __init__(self) -> None:
        self.lock = threading.RLock()
        self._entries = weakref.WeakKeyDictionary[Scene | Bundle, dict[Hashable, object]]()
        self._abandoned: list[object] = []
        _system.at_fork(in_child=self._after_fork)

    def table(self, bundle: Bundle) -> _core.ClusterTable:
        """Return the tables of a bundle's clusters, on the host, for selection and
        drawing."""
        clusters = bundle.clusters
        groups = bundle.groups

        def make() -> _core.ClusterTable:
            return _core.ClusterTable(
                ball=groups.ball,
                weight=groups.weight,
                level=groups.level,
                own_group=clusters.own_group,
                parent_group=clusters.parent_group,
                box=clusters.box,
                filter_px2=clusters.filter_px2,
                antialiased=clusters.antialiased,
                offset=clusters.offset,
            )

        return self.once(bundle, "table", make)

    def turn(self, device: Device) -> AbstractContextManager[object]:
        """Return a context in which scenes on the device do not change. On CUDA, only
        one thread at a time can be inside it."""
        if device.is_cuda:
            return self.lock
        return _NO_TURN

    def scene(
        self, subject: Subject, device: Device, last: ResidentScene | None = None
    ) -> ResidentScene:
        """Return the data of a scene's current revision on a device. A bundle counts as
        a scene with one instance.

        The result is often the same as in the last call. Passing the last result as
        ``last`` makes the call faster.
        """
        if last is not None and last.is_of(subject):
            return last
        if isinstance(subject, Gaussians):
            raise TypeError(
                "subject: expected a Scene or a Bundle, got Gaussians; build a bundle from them"
            )
        with self.lock:
            resident = self.once(subject, ("scene", device), lambda: ResidentScene(device))
            if resident.is_of(subject):
                return resident
            scene = copy.copy(Scene.of(subject))
            # On the CPU, existing data never changes.
            if resident.revision[0] >= 0 and not device.is_cuda:
                resident = ResidentScene(device)
            resident.update(scene, [self.table(bundle) for bundle in scene.bundles])
            self._entries[subject]["scene", device] = resident
            return resident

    def rows(
        self, bundle: Bundle, clusters: NDArray[np.int32], device: Device
    ) -> tuple[_core.Rows, NDArray[np.int64]]:
        """Return the gaussians of a bundle on a device, and the index (S,) of the first
        row of each of S clusters."""
        if not self._draws_codes(bundle, device):
            return self.gaussians(bundle, device).rows, bundle.clusters.offset[clusters]
        ids, place = np.unique(clusters, return_inverse=True)
        first = np.concatenate([[0], np.cumsum(np.diff(bundle.clusters.offset)[ids])])
        return Gaussians(*self.model(bundle, device).decode(ids)).rows, first[place]

    def model(self, bundle: Bundle, device: Device) -> _core.Model:
        """Return a bundle's gaussians, or their codes, in the layout of the frames of a
        device."""

        def make() -> _core.Model:
            codes = bundle.codes
            if codes is not None and self._draws_codes(bundle, device):
                return _core.Model(codes, device.number)
            return _core.Model(self.gaussians(bundle, device).rows)

        return self.once(bundle, ("model", device), make)

    def gaussians(self, bundle: Bundle, device: Device) -> Gaussians:
        """Return all gaussians of the bundle on a device."""
        if not device.is_cuda:
            return bundle.gaussians
        return self.once(bundle, ("gaussians", device), lambda: bundle.gaussians.torch(str(device)))

    def set_models(
        self, frame: _core.SceneFrame, bundles: Sequence[Bundle], device: Device, color_by: ColorBy
    ) -> None:
        """Set the bundles that a frame draws, with the gaussians' own colours or with a
        palette."""
        palettes = [
            _core.Palette(self.table(bundle), sh, device.number)
            for bundle in bundles
            if (sh := self.palette(bundle, color_by)) is not None
        ]
        frame.set_models([self.model(bundle, device) for bundle in bundles], palettes)

    def palette(self, bundle: Bundle, color_by: ColorBy) -> NDArray[np.float32] | None:
        """Return the palette of a bundle; see `palette_of`."""
        return self.once(bundle, ("palette", color_by), lambda: palette_of(bundle, color_by))

    def bytes_to_add(self, bundles: Sequence[Bundle], device: Device) -> dict[Device, int]:
        """Return how many more bytes are needed, on the device and on the host, to make
        all gaussians of these bundles resident on the device.

        A bundle at a URL counts as larger than any memory, so that its pages are only
        downloaded when pictures need them.
        """
        add = {device: 0, CPU: 0}
        for bundle in bundles:
            if ("model", device) in self._entries.get(bundle, {}):
                continue
            is_coded = bundle.codec != Codec.name
            if is_url(bundle.path or "") and not bundle.is_in_memory:
                add[CPU] += _TOO_MANY_BYTES
            elif not bundle.is_in_memory:
                add[CPU] += bundle.page_bytes
            # The CPU draws codes without copying them.
            if device.is_cuda or not is_coded:
                add[device] += bundle.page_bytes
            if device.is_cuda and not is_coded:
                add[device] += _PACKED_BYTES * bundle.num_gaussians
        return add

    def num_bytes(self, device: Device) -> int:
        """Return the memory in bytes that the gaussians and tables of all bundles
        occupy on a device, without the memory of the bundles themselves."""
        with self.lock:
            all_entries = list(self._entries.values())
        num_bytes = 0
        for entries in all_entries:
            model = entries.get(("model", device))
            if isinstance(model, _core.Model):
                num_bytes += model.bytes
            table = entries.get("table")
            if isinstance(table, _core.ClusterTable):
                num_bytes += table.bytes_on(device.number)
        return num_bytes

    def clear(self) -> None:
        """Free all data; it is created again when it is requested."""
        with self.lock:
            self._entries.clear()

    def _draws_codes(self, bundle: Bundle, device: Device) -> bool:
        """Return whether a device draws the codes of a bundle instead of decoded
        gaussians."""
        if bundle.codes is None or not device.is_cuda:
            return bundle.codes is not None

        def decoded_bytes() -> int:
            size = bundle.num_gaussians * (_PACKED_BYTES + gaussian_bytes(bundle.sh_degree))
            total = size
            for entries in self._entries.values():
                total += cast(int, entries.get(("decoded", device), 0))
            if total > MOST_DECODED_BYTES:
                return 0
            return size

        return self.once(bundle, ("decoded", device), decoded_bytes) == 0

    def once(self, owner: Scene | Bundle, key: Hashable, make: Callable[[], _T]) -> _T:
        """Return the entry of a bundle or scene with this key. If it does not exist,
        create it first."""
        with self.lock:
            if not isinstance(owner, Bundle):
                owner = Scene.of(owner)  # raises an error for anything but a scene
            entries = self._entries.setdefault(owner, {})
            if key not in entries:
                entries[key] = make()
            return cast(_T, entries[key])

    def last(
        self, owner: Scene | Bundle, key: Hashable, value: Hashable, make: Callable[[], _T]
    ) -> _T:
        """Return the result of ``make`` for this value. If the last value was the same,
        the result comes from the cache. Otherwise, the last result is freed first."""
        with self.lock:
            last = self.once(owner, key, _LastResult)
            if last.value != value:
                last.result = None
                last.value = _NO_VALUE
                last.result = make()
                last.value = value
            return cast(_T, last.result)

    def _after_fork(self) -> None:
        """Reset the state in a child after fork(), because other threads of the parent
        may have held a lock or used an entry."""
        self.lock = threading.RLock()
        for entries in self._entries.values():
            for key in [
                key for key in entries if isinstance(key, tuple) and key[0] in _NOT_INHERITED
            ]:
                # Entries of the parent are never destroyed in the child, because
                # destroying them would wait for threads that do not exist there.
                self._abandoned.append(entries.pop(key))


residency = Residency()
atexit.register(residency.clear)  # frees device memory before the driver is unloaded
