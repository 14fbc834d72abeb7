"""Refines the levels of a bundle: of a small one together, and of a large one in
units.

A unit is a subtree with at most `most_leaves` gaussians of level 0. It is refined
alone, as a bundle of its own, seen from all around or from cameras that see some of it.
The levels above all units are then refined together, by comparison with a level some
levels below them. So memory does not depend on the size of the asset, and a refinement
that was interrupted continues after the last finished unit.
"""

import os
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue

import numpy as np

from v3dg import _device
from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._numbers import Floats
from v3dg._progress import Bar, Progress
from v3dg.bundle import Bundle
from v3dg.bundle.format import config_to_json, page_hash
from v3dg.bundle.parts import Division, ReplacedPart, divided, joined, levels_of_at_most
from v3dg.cameras import Camera
from v3dg.levels.progress import Stopped
from v3dg.levels.refine_sizes import most_leaves
from v3dg.levels.refined import RefineRequest, with_refined_levels
from v3dg.levels.rows import RUN_ROWS
from v3dg.levels.unfinished import described
from v3dg.levels.viewpoints import Viewpoints, cameras_that_see, viewpoints_of


def refined_bundle(
    bundle: Bundle,
    request: RefineRequest,
    devices: Sequence[Device],
    progress: Progress,
    folder: Path | None = None,
) -> Bundle:
    """Return a bundle with refined levels; see `v3dg.refine_bundle`.

    Args:
        devices: Devices of the same kind. Each refines one unit at a time.
        folder: Where finished units are stored, so that another call continues from
            them; None keeps them in memory. The result reads its pages from there. The
            caller has locked it (`locked_units`).
    """
    if bundle.num_levels < 2 or bundle.num_leaves == 0:
        return bundle
    limit = most_leaves(bundle.sh_degree)
    division = divided(bundle, limit)
    if division is None:
        views = _viewpoints(bundle, request)
        refined = with_refined_levels(
            bundle, request, views.cameras, devices[0], progress, text=views.text
        )
    else:
        views = _viewpoints(levels_of_at_most(bundle, limit).of(bundle), request)
        units = _Units(bundle, request, division, views, devices)
        refined = units.refined(progress, folder)
    record = request.record() | views.record
    if division is not None:
        record["units"] = len(division.units)
    refined.config = {**bundle.config, "refined": record, "run_rows": RUN_ROWS}
    return refined


def _viewpoints(bundle: Bundle, request: RefineRequest) -> Viewpoints:
    """Return the viewpoints of the pictures: the cameras of the request, or viewpoints
    that follow from the bundle."""
    if request.cameras:
        return Viewpoints(request.cameras)
    return viewpoints_of(bundle, request.seen_from)


@dataclass(frozen=True, eq=False)
class _Units:
    """The refinement of a bundle in units, and of the part above them."""

    bundle: Bundle
    request: RefineRequest
    division: Division
    views: Viewpoints
    devices: Sequence[Device]

    def refined(self, progress: Progress, folder: Path | None) -> Bundle:
        """Return the bundle with refined levels. Its config is that of this bundle."""
        units = self.division.units
        store: _Store = _MemoryStore()
        if folder is not None:
            store = _FolderStore(folder, self._identity)
        per_part = sum(self.request.num_pictures(self.devices[0]))
        with Bar((len(units) + 1) * per_part, "refine", progress) as bar:
            shared_bar = _SharedBar(bar, per_part, self.views.text)
            finished = self._refined_units(store, shared_bar)
            lower = joined(
                self.bundle, [ReplacedPart(*pair) for pair in zip(units, finished, strict=True)]
            )
            upper = self._refined_upper(lower, store, shared_bar)
        first_level = self.division.top - self.division.upper.first_level
        whole = joined(lower, [ReplacedPart(self.division.upper, upper, first_level)])
        if folder is not None:
            return whole
        return Bundle(whole.clusters, whole.groups, whole.gaussians, whole.config, whole.codec)

    @property
    def _identity(self) -> JsonObject:
        """What the files of this refinement's units have in common."""
        hashes = self.bundle.page_hashes
        text = np.frombuffer(config_to_json(self.bundle.config).encode(), np.uint8)
        return {
            "levels": page_hash([text, hashes]).hex(),
            "refined": self.request.record() | self.views.record,
            "cameras": page_hash([_values_of(camera) for camera in self.views.cameras]).hex(),
            "units": len(self.division.units),
            "device": list(described(self.devices[0])),
        }

    def _refined_units(self, store: "_Store", bar: "_SharedBar") -> list[Bundle]:
        units = self.division.units

        def refined(number: int, device: Device) -> Bundle:
            return self._refined_unit(number, store, bar, device)

        if len(self.devices) == 1:
            return [refined(number, self.devices[0]) for number in range(len(units))]
        free: SimpleQueue[Device] = SimpleQueue()
        for device in self.devices:
            free.put(device)

        def work(number: int) -> Bundle:
            device = free.get()
            try:
                with _device.own_stream(device), _device.memory_errors():
                    return refined(number, device)
            finally:
                free.put(device)

        with ThreadPoolExecutor(len(self.devices)) as executor:
            futures = [executor.submit(work, number) for number in range(len(units))]
            try:
                return [future.result() for future in futures]
            except BaseException:
                bar.stop()
                for future in futures:
                    future.cancel()
                raise

    def _refined_unit(
        self, number: int, store: "_Store", bar: "_SharedBar", device: Device
    ) -> Bundle:
        name = f"unit {number + 1}/{len(self.division.units)}"
        finished = store.find(number)
        if finished is not None:
            bar.skip(name)
            return finished
        part = self.division.units[number].of(self.bundle)
        cameras = cameras_that_see(part, self.views.cameras)
        refined = with_refined_levels(part, self.request, cameras, device, bar.progress_of(name))
        return store.put(number, refined)

    def _refined_upper(self, lower: Bundle, store: "_Store", bar: "_SharedBar") -> Bundle:
        """Refine the levels above all units, by comparison with a refined level of the
        units."""
        number = len(self.division.units)
        finished = store.find(number)
        if finished is not None:
            bar.skip("levels above units")
            return finished
        upper = self.division.upper
        part = upper.of(lower)
        refined = with_refined_levels(
            part,
            self.request,
            self.views.cameras,
            self.devices[0],
            bar.progress_of("levels above units"),
            first_level=self.division.top - upper.first_level,
            target_px2=float(part.clusters.filter_px2[0]),
        )
        return store.put(number, refined)


def _values_of(camera: Camera) -> Floats:
    """Return the values of a pinhole camera as one array."""
    sizes = np.array([camera.width, camera.height, camera.near])
    return np.concatenate([camera.viewmat.ravel(), camera.K.ravel(), sizes])


class _SharedBar:
    """One progress bar for all units, which several threads may advance."""

    def __init__(self, bar: Bar, per_part: int, text: str) -> None:
        self._bar = bar
        self._per_part = per_part
        self._text = text
        self._lock = threading.Lock()
        self._is_stopped = False

    def stop(self) -> None:
        """Make every thread that advances the bar raise `Stopped` from now on."""
        self._is_stopped = True

    def skip(self, name: str) -> None:
        """Count a unit that an interrupted refinement has finished."""
        with self._lock:
            self._bar.update(self._per_part, name)

    def progress_of(self, name: str) -> Callable[[int, int, str], None]:
        """Return the progress callback of a unit, which has several bars of its own,
        one after another."""
        text = ", ".join(filter(None, [name, self._text]))
        last = 0

        def show(num_done: int, _total: int, _text: str) -> None:
            nonlocal last
            if self._is_stopped:
                raise Stopped
            if num_done < last:  # the next bar begins
                last = 0
            with self._lock:
                self._bar.update(num_done - last, text)
            last = num_done

        return show


class _MemoryStore:
    """Keeps finished units in memory."""

    def find(self, _number: int) -> Bundle | None:
        return None

    def put(self, _number: int, refined: Bundle) -> Bundle:
        return refined


class _FolderStore:
    """Stores finished units as bundles in a folder.

    The config of each bundle identifies the input that it was made from. Units of other
    refinements are replaced.
    """

    def __init__(self, folder: Path, identity: JsonObject) -> None:
        self._folder = folder
        self._identity = identity
        folder.mkdir(mode=0o700, exist_ok=True)

    def _path(self, number: int) -> Path:
        return self._folder / f"{number}.v3dg"

    def _config(self, number: int) -> JsonObject:
        return {**self._identity, "unit": number}

    def find(self, number: int) -> Bundle | None:
        path = self._path(number)
        if not os.path.lexists(path):
            return None
        bundle = Bundle.open(path)
        if bundle.config != self._config(number):
            return None
        return bundle

    def put(self, number: int, refined: Bundle) -> Bundle:
        refined.config = self._config(number)
        refined.write(self._path(number))
        return Bundle.open(self._path(number))


_Store = _MemoryStore | _FolderStore
