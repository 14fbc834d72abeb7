"""The build of a whole asset: its units on an executor, then what is above them."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor, as_completed
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _device
from v3dg._device import Device
from v3dg.build.assemble import assemble
from v3dg.build.config import BuildConfig
from v3dg.build.leaves import Leaves, made_with
from v3dg.build.plan import Plan, Units
from v3dg.build.progress import Bar
from v3dg.build.simplify import Level, LevelTables, build_above
from v3dg.build.unfinished import FinishedLevel, MemoryStore, Part, Unfinished
from v3dg.build.unit import UnitTask
from v3dg.bundle import Bundle
from v3dg.bundle.codec import Codec
from v3dg.bundle.file import BundlePlan
from v3dg.bundle.pages import PageRun
from v3dg.gaussians import Gaussians

# Leaves of a unit: enough to keep a GPU busy, and little memory. The last bits of a bundle depend on it.
UNIT_LEAVES = 1 << 20
# Units that a GPU works on at once, so that others fill what the smallest levels of one leave idle.
_UNITS_ON_GPU = 4


def devices_for(device: str | Device, asset: Gaussians | None = None) -> list[Device]:
    """Where to build: with "auto" and "cuda" also on all devices like the asset's or the current one."""
    where = _device.resolve(device)
    if not where.is_cuda or str(device) not in ("auto", "cuda"):
        return [where]
    if asset is not None and _device.of(asset.means).is_cuda:
        where = _device.of(asset.means)
    return _device.all_like(where)


def build_into(
    path: str | os.PathLike[str] | None,
    leaves: Leaves,
    config: BuildConfig,
    seed: int,
    devices: Sequence[Device],
    progress: bool,
    *,
    bundle_path: Path | None = None,
    most_units: int | None = None,
) -> Bundle:
    """Build all levels of an asset, in memory or in a file that replaces `bundle_path`; as `build_bundle`."""
    if not isinstance(progress, bool):
        raise TypeError(f"progress: expected True or False, got {progress!r}")
    plan = Plan.of(leaves.num_gaussians, config)
    config.check_views(max((np.diff(made.group_offset).max() for made in plan.levels[1:]), default=1))
    units = plan.units(UNIT_LEAVES)
    file = BundlePlan(plan.layout, Codec(leaves.sh_degree), made_with(leaves, config, seed))
    parts = _parts(plan, units, file)
    with (
        _device.memory_errors(),
        Unfinished(Path(path), file, parts, devices[0], bundle_path)
        if path is not None
        else nullcontext(MemoryStore(file)) as store,
    ):
        if not store.is_whole:
            build = _Build(config, file.config["seed"], plan, units, parts, file, store)
            with Bar(plan, build.num_finished, progress) as bar:
                tables, hashes = build.all_levels(leaves, devices, most_units, bar)
            store.finish(*assemble(plan, tables, config), hashes)
        return store.bundle()


def _parts(plan: Plan, units: Units, file: BundlePlan) -> list[Part]:
    """The units, and last what is above them."""
    first = plan.first_page
    parts: list[Part] = []
    for unit in units.plans:
        pages = [
            file.run(first[n] + above.first_group, first[n] + above.first_group + above.num_groups)
            for n, above in enumerate(unit.levels[1:])
        ]
        parts.append(dict(enumerate(zip(unit.levels, [*pages, None], strict=True))))
    above = range(units.level + 1, len(plan.levels))
    return [*parts, {n: (plan.levels[n], file.run(first[n], first[n + 1])) for n in above}]


@dataclass(frozen=True, eq=False)
class _Build:
    """The work on all units of a plan, and on what is above them."""

    config: BuildConfig
    seed: int
    plan: Plan
    units: Units
    parts: list[Part]
    file: BundlePlan
    store: Unfinished | MemoryStore

    @property
    def num_finished(self) -> int:
        """Gaussians of finished levels but the leaves."""
        return sum(self.parts[part][n][0].num_gaussians for part, n in self.store.levels if n > 0)

    def all_levels(
        self, leaves: Leaves, devices: Sequence[Device], most_units: int | None, bar: Bar
    ) -> tuple[list[LevelTables], npt.NDArray[np.uint8]]:
        """Build all levels; their tables, and the hashes of all pages."""
        self._build_units(leaves, devices, most_units, bar)
        finished = [self._joined(number) for number in range(self.units.level + 1)]
        top, levels, pages = len(self.units.plans), self.store.levels, self.store.pages
        saved = (levels[top, n].read(pages, self._run(n)) for n in self.parts[top] if (top, n) in levels)
        below = self._below(finished, devices[0])
        above = build_above(below, self.plan, self.config, self.seed, saved, bar.show_of(top))
        for number, level in enumerate(above, self.units.level + 1):
            if (top, number) not in levels:
                hashes = pages.write(self._run(number), level.gaussians)
                self.store.save(top, number, FinishedLevel(level.tables, hashes))
            finished.append(levels[top, number])
        return [level.tables for level in finished], np.concatenate([level.hashes for level in finished])

    def _build_units(
        self, leaves: Leaves, devices: Sequence[Device], most_units: int | None, bar: Bar
    ) -> None:
        workers = [device for _ in range(_UNITS_ON_GPU) for device in devices if device.is_cuda]
        workers = (workers or list(devices))[:most_units]
        free: SimpleQueue[Device] = SimpleQueue()
        for device in workers:
            free.put(device)

        def work(unit: int, task: UnitTask) -> None:
            device = free.get()
            try:
                with _device.own_stream(device), _device.memory_errors():
                    for number, level in task.levels(device, bar.show_of(unit)):
                        self.store.save(unit, number, level)
            finally:
                free.put(device)

        last, levels = self.units.level, self.store.levels
        todo = [unit for unit in range(len(self.units.plans)) if (unit, last) not in levels]
        num_threads = min(len(todo), len(workers))
        with ThreadPoolExecutor(num_threads) if num_threads > 1 else _InThisThread() as executor:
            futures: list[Future[None]] = []
            try:
                for unit in todo:
                    futures.append(executor.submit(work, unit, self._task(unit, leaves)))
                for future in as_completed(futures):
                    future.result()
            except BaseException:
                bar.stop()
                for future in futures:
                    future.cancel()
                raise

    def _task(self, unit: int, leaves: Leaves) -> UnitTask:
        plan = self.units.plans[unit]
        first = int(self.plan.levels[0].offset[plan.levels[0].first_group])
        finished = {n: level for (part, n), level in self.store.levels.items() if part == unit}
        read = partial(leaves.read, first, first + plan.levels[0].num_gaussians)
        runs = [run for _, run in self.parts[unit].values()]
        return UnitTask(read, plan, runs, self.config, self.seed, finished, self.store.pages)

    def _joined(self, number: int) -> FinishedLevel:
        """A level of all units; the pages of the last are written now."""
        parts = [self.store.levels[unit, number] for unit in range(len(self.units.plans))]
        columns = zip(*(vars(part.tables).values() for part in parts), strict=True)
        tables = LevelTables(*map(np.concatenate, columns))
        if number < self.units.level:
            return FinishedLevel(tables, np.concatenate([part.hashes for part in parts]))
        gaussians = Gaussians.concatenate([part.gaussians for part in parts if part.gaussians is not None])
        return FinishedLevel(tables, self.store.pages.write(self._run(number), gaussians))

    def _below(self, finished: Sequence[FinishedLevel], device: Device) -> dict[int, Level]:
        """Levels of the units that the work above them begins with, on the device."""
        last = self.units.level
        has_above = last + 1 < len(self.plan.levels)
        numbers = range(self.config.target_of(last + 1) if has_above else last, last + 1)
        levels = {n: finished[n].read(self.store.pages, self._run(n)) for n in numbers}
        return {n: Level(_device.place(level.gaussians, device), level.tables) for n, level in levels.items()}

    def _run(self, number: int) -> PageRun:
        return self.file.run(self.plan.first_page[number], self.plan.first_page[number + 1])


class _InThisThread(Executor):
    """Does work as it comes; what fails is raised at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        done: Future[Any] = Future()
        done.set_result(fn(*args, **kwargs))
        return done
