"""The build of a whole asset: its units on all devices, then what is above them, into a sink."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any, Protocol, TypeAlias

import numpy as np

from v3dg import _device
from v3dg._device import Device
from v3dg.build.assemble import assemble
from v3dg.build.checkpoint import Checkpoint
from v3dg.build.config import BuildConfig
from v3dg.build.leaves import Leaves, made_with
from v3dg.build.plan import Plan, Units
from v3dg.build.progress import Bar
from v3dg.build.simplify import Level, LevelTables, build_above, build_levels
from v3dg.bundle import Clusters, Groups
from v3dg.bundle.codec import Codec
from v3dg.bundle.pages import PageLayout
from v3dg.gaussians import Gaussians

# Leaves of a unit: enough to keep a GPU busy, and little memory. The last bits of a bundle depend on it.
UNIT_LEAVES = 1 << 20
# Units that a GPU works on at once, so that others fill what the smallest levels of one leave idle.
_UNITS_ON_GPU = 4


class Sink(Protocol):
    """Where finished pages go: `BundleWriter`, or memory."""

    def write(self, first_page: int, last_page: int, gaussians: Gaussians) -> None:
        """Take the gaussians of a run of pages."""

    def finish(self, clusters: Clusters, groups: Groups) -> None:
        """Take the tables, when all pages are there."""


OpenSink: TypeAlias = Callable[[PageLayout, Codec, dict[str, Any]], AbstractContextManager[Sink]]
"""Makes a sink for the pages of this layout and codec; the last argument says how the bundle is built."""


def devices_for(device: str | Device, asset: Gaussians | None = None) -> list[Device]:
    """Where to build: with "auto" and "cuda" also on all devices like the asset's or the current one."""
    where = _device.resolve(device)
    if not where.is_cuda or str(device) not in ("auto", "cuda"):
        return [where]
    if asset is not None and _device.of(asset.means).is_cuda:
        where = _device.of(asset.means)
    return _device.all_like(where)


def build_into(
    open_sink: OpenSink,
    leaves: Leaves,
    config: BuildConfig,
    seed: int,
    devices: Sequence[Device],
    progress: bool,
    resume_path: str | os.PathLike[str] | None,
    most_units: int | None = None,
) -> None:
    """Build all levels of an asset into a sink; as `build_bundle` for the rest.

    Args:
        devices: Of one kind; the units are spread over them.
        most_units: That may be in memory at once.
    """
    if not isinstance(progress, bool):
        raise TypeError(f"progress: expected True or False, got {progress!r}")
    plan = Plan.of(leaves.num_gaussians, config)
    config.check_views(max((np.diff(made.group_offset).max() for made in plan.levels[1:]), default=1))
    units = plan.units(UNIT_LEAVES)
    codec = Codec(leaves.sh_degree)
    how = made_with(leaves, config, seed)
    parts = [dict(enumerate(part.levels)) for part in units.plans]
    parts.append({n: level for n, level in enumerate(plan.levels) if n > units.level})
    with (
        _device.memory_errors(),
        Checkpoint(resume_path, parts, leaves.sh_degree, how, devices[0]) as checkpoint,
        open_sink(plan.layout, codec, how) as sink,
        Bar(plan, checkpoint.num_gaussians, progress) as bar,
    ):
        build = _Build(config, how["seed"], plan, units, sink, checkpoint, bar)
        sink.finish(*assemble(plan, build.all_levels(leaves, devices, most_units), config))


@dataclass(frozen=True, eq=False)
class _Unit:
    """What is left of a unit when its pages are written: all tables, and what the levels above need."""

    tables: list[LevelTables]
    kept: dict[int, Gaussians]


@dataclass(frozen=True, eq=False)
class _Build:
    """The work on all units of a plan, and on what is above them."""

    config: BuildConfig
    seed: int
    plan: Plan
    units: Units
    sink: Sink
    checkpoint: Checkpoint
    bar: Bar

    @property
    def kept(self) -> range:
        """Levels of the units that the work above them begins with."""
        last = self.units.level
        has_above = last + 1 < len(self.plan.levels)
        return range(self.config.target_of(last + 1) if has_above else last, last + 1)

    def all_levels(
        self, leaves: Leaves, devices: Sequence[Device], most_units: int | None
    ) -> list[LevelTables]:
        """Build all levels; their tables."""
        workers = [device for _ in range(_UNITS_ON_GPU) for device in devices if device.is_cuda]
        workers = (workers or list(devices))[:most_units]
        tables, below = self._join(self._build_units(leaves, workers), devices[0])
        top = len(self.units.plans)
        finished, show = self.checkpoint.load(top), self.bar.show_of(top)
        above = build_above(below, self.plan, self.config, self.seed, finished, show)
        for number, level in enumerate(above, self.units.level + 1):
            host = Level(level.gaussians.numpy(), level.tables)
            self._write(number, host.gaussians)
            self.checkpoint.save(top, number, host)
            tables.append(host.tables)
        return tables

    def _build_units(self, leaves: Leaves, workers: Sequence[Device]) -> list[_Unit]:
        units: list[Any] = [None] * len(self.units.plans)
        free: SimpleQueue[Device] = SimpleQueue()
        for device in workers:
            free.put(device)

        def build(number: int) -> None:
            device = free.get()
            try:
                with _device.own_stream(device):
                    units[number] = self._unit(number, leaves, device)
            finally:
                free.put(device)

        self._on_threads(build, len(units), min(len(units), len(workers)))
        return units

    def _join(self, units: list[_Unit], device: Device) -> tuple[list[LevelTables], dict[int, Level]]:
        """The tables of all levels of the units, and the levels that were kept, whole, on the device."""
        by_level = zip(*(unit.tables for unit in units), strict=True)
        arrays = [zip(*(vars(part).values() for part in parts), strict=True) for parts in by_level]
        tables = [LevelTables(*map(np.concatenate, columns)) for columns in arrays]
        whole = {n: Gaussians.concatenate([unit.kept[n] for unit in units]) for n in self.kept}
        self._write(self.units.level, whole[self.units.level])
        return tables, {n: Level(_device.place(part, device), tables[n]) for n, part in whole.items()}

    def _unit(self, unit: int, leaves: Leaves, device: Device) -> _Unit:
        plan = self.units.plans[unit]
        first = self.plan.levels[0].offset[plan.levels[0].first_group]
        with _device.memory_errors():
            own = _device.place(leaves.read(first, first + plan.levels[0].num_gaussians), device)
            finished, show = self.checkpoint.load(unit), self.bar.show_of(unit)
            levels = build_levels(own, plan, self.config, self.seed, finished=finished, show=show)
            del own
            tables: list[LevelTables] = []
            kept: dict[int, Gaussians] = {}
            for number, level in enumerate(levels):
                host = Level(level.gaussians.numpy(), level.tables)
                if number < self.units.level:
                    above = plan.levels[number + 1]
                    page = self.plan.first_page[number] + above.first_group
                    self.sink.write(page, page + above.num_groups, host.gaussians)
                if number > 0:
                    self.checkpoint.save(unit, number, host)
                if number in self.kept:
                    kept[number] = host.gaussians
                tables.append(host.tables)
                del level, host  # while the next is made, their memory is free
        return _Unit(tables, kept)

    def _write(self, number: int, gaussians: Gaussians) -> None:
        self.sink.write(self.plan.first_page[number], self.plan.first_page[number + 1], gaussians)

    def _on_threads(self, work: Callable[[int], None], count: int, num_threads: int) -> None:
        """Do the work for all numbers below the count; what fails on one thread ends it on all."""
        if num_threads == 1:
            for number in range(count):
                work(number)
            return
        with ThreadPoolExecutor(num_threads) as pool:
            futures = [pool.submit(work, number) for number in range(count)]
            try:
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                self.bar.stop()
                for future in futures:
                    future.cancel()
                raise
