"""Builds a whole asset. Threads or an executor build its units, then this process
builds the levels above them."""

import os
import socket
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from queue import SimpleQueue
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.bundle.codec import codec_of
from v3dg.bundle.file import BundlePlan
from v3dg.bundle.pages import PageRun
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians
from v3dg.levels.assemble import assemble
from v3dg.levels.config import BuildConfig
from v3dg.levels.leaves import Leaves, MemoryLeaves, made_with
from v3dg.levels.plan import Plan
from v3dg.levels.progress import Bar
from v3dg.levels.quality import Quality, refinement_of
from v3dg.levels.refined import RefineRequest
from v3dg.levels.refined_units import refined_bundle
from v3dg.levels.scheduler import Watch, completed, watch_over
from v3dg.levels.simplify import Level, LevelBuilder, LevelTables, Show
from v3dg.levels.smooth import measured_config
from v3dg.levels.unfinished import (
    FinishedLevel,
    MemoryStore,
    PageFile,
    Part,
    Refine,
    Unfinished,
    described,
)
from v3dg.levels.viewpoints import SeenFrom

# Number of leaves in a unit. It is large enough to keep a GPU busy, but needs little
# memory. The last bits of a bundle depend on this number.
UNIT_LEAVES = 1 << 20
# Factor by which the balls of level 1 grow if a smooth asset is too large to be
# measured. Level 1 is then selected at half the size (docs/levels.md).
_UNMEASURED = 2.0
# Number of units that a GPU processes at once. While one unit builds its smallest
# levels, the others keep the GPU busy.
_UNITS_ON_GPU = 4

_Levels = dict[int, FinishedLevel]


def devices_for(device: str | Device, asset: Gaussians | None = None) -> list[Device]:
    """Return the devices of a build. "auto" and "cuda" mean the asset's device or the
    current one, together with all others of its kind."""
    first = _device.resolve(device)
    if not first.is_cuda or str(device) not in ("auto", "cuda"):
        return [first]
    if asset is not None and _device.of(asset.means).is_cuda:
        first = _device.of(asset.means)
    return _device.all_like(first)


def build_into(
    path: str | os.PathLike[str] | None,
    leaves: Leaves,
    config: BuildConfig,
    seed: int,
    devices: Sequence[Device],
    progress: Progress,
    *,
    codec: str,
    quality: Quality,
    seen_from: SeenFrom = "auto",
    bundle_path: Path | None = None,
    most_units: int | None = None,
    executor: Executor | None = None,
    up: Axis | None = None,
) -> Bundle:
    """Build all levels of an asset, in memory or in a file that replaces `bundle_path`;
    see `build_bundle`."""
    plan = Plan.of(leaves.num_gaussians, config)
    config.check_views(
        max((np.diff(level.group_offset).max() for level in plan.levels[1:]), default=1)
    )
    units = plan.units(UNIT_LEAVES)
    page_codec = codec_of(codec, leaves.sh_degree)
    file = BundlePlan(plan.layout, page_codec, made_with(leaves, config, seed, codec, up))
    request = refinement_of(
        quality, leaves.num_gaussians, leaves.sh_degree, file.config["seed"], seen_from
    )
    parts = _parts(plan, units, file)
    opened = _opened(path, file, parts, devices[0], bundle_path)
    with _device.memory_errors(), opened as store:
        if not store.is_whole:
            config = measured_config(config, plan, leaves, seed, page_codec, devices[0])
            num_finished = sum(
                parts[part][number][0].num_gaussians for part, number in store.levels if number > 0
            )
            with Bar(plan, num_finished, progress) as bar:
                build = _Build(config, file.config["seed"], plan, units, parts, file, store, bar)
                tables, hashes = build.all_levels(leaves, devices, most_units, executor)
            store.finish(*assemble(plan, tables, config), hashes)
        return store.bundle(_refine_of(request, devices, progress))


def _refine_of(
    request: RefineRequest | None, devices: Sequence[Device], progress: Progress
) -> Refine | None:
    """Return the function that refines the bundle at the end of a build."""
    if request is None:
        return None
    return lambda bundle, folder: refined_bundle(bundle, request, devices, progress, folder)


def _opened(
    path: str | os.PathLike[str] | None,
    file: BundlePlan,
    parts: Sequence[Part],
    device: Device,
    bundle_path: Path | None,
) -> AbstractContextManager[Unfinished | MemoryStore]:
    """Return the store for the levels of a build: a file, or memory."""
    if path is None:
        return nullcontext(MemoryStore(file))
    return Unfinished(Path(path), file, parts, device, bundle_path)


def _parts(plan: Plan, units: Sequence[Plan], file: BundlePlan) -> list[Part]:
    """Return the parts: the units, followed by the part with the levels above all
    units."""

    def runs(number: int, count: int) -> list[PageRun]:
        first, last = plan.first_page[number : number + 2]
        num_pages = (last - first) // count
        return [file.run(page, page + num_pages) for page in range(first, last, num_pages)]

    num_low = len(units[0].levels)
    pages = [runs(n, len(units)) for n in range(num_low)]
    parts: list[Part] = [
        {n: (level, pages[n][number]) for n, level in enumerate(unit.levels)}
        for number, unit in enumerate(units)
    ]
    return [*parts, {n: (plan.levels[n], runs(n, 1)[0]) for n in range(num_low, len(plan.levels))}]


@dataclass(frozen=True, eq=False)
class _Build:
    """The work on all units of a plan, and on the levels above them."""

    config: BuildConfig
    seed: int
    plan: Plan
    units: Sequence[Plan]
    parts: list[Part]
    file: BundlePlan
    store: Unfinished | MemoryStore
    bar: Bar

    @property
    def num_low(self) -> int:
        """The number of levels in the units."""
        return len(self.units[0].levels)

    def all_levels(
        self,
        leaves: Leaves,
        devices: Sequence[Device],
        most_units: int | None,
        executor: Executor | None,
    ) -> tuple[list[LevelTables], npt.NDArray[np.uint8]]:
        """Build all levels; return their tables, and the hashes of all pages."""
        if executor is None:
            self._build_on_threads(leaves, devices, most_units)
        else:
            self._build_on_executor(leaves, devices[0], executor)
        finished = [self._joined(number) for number in range(self.num_low)]
        top = len(self.units)
        levels = self.store.levels
        pages = self.store.pages
        runs = {number: run for number, (_, run) in self.parts[top].items()}
        saved = (levels[top, n].read(pages, run) for n, run in runs.items() if (top, n) in levels)
        first = self.num_low - 1
        if runs:
            first = self.config.target_of(self.num_low)
        lower_levels: dict[int, Level] = {}
        # The levels above the units start from these levels of the units, and are
        # fitted to them.
        for n in range(first, self.num_low):
            gaussians = _device.place(self._level(n).gaussians, devices[0])
            lower_levels[n] = Level(gaussians, finished[n].tables)
        builder = LevelBuilder(self.plan, self.config, self.seed, self.file.codec)
        upper_levels = builder.levels_above(lower_levels, saved, self.bar.show_of(top))
        for number, level in enumerate(upper_levels, self.num_low):
            if (top, number) not in levels:
                hashes = pages.write(runs[number], level.gaussians)
                self.store.save(top, number, FinishedLevel(level.tables, hashes))
            finished.append(levels[top, number])
        tables = [level.tables for level in finished]
        if self.config.smooth == "yes" and len(tables) > 1:
            tables = self.grown(tables, devices[0])
        return tables, np.concatenate([level.hashes for level in finished])

    def grown(self, tables: Sequence[LevelTables], device: Device) -> list[LevelTables]:
        """Return the tables with larger balls. If the asset is a single unit, the
        growth of level 1 is measured."""
        ball = tables[1].ball
        level_1 = self.plan.levels[1]
        growth = np.full(len(ball), _UNMEASURED, np.float32)
        if len(self.units) == 1:
            leaves, level = (_device.place(self._level(n).gaussians, device).rows for n in (0, 1))
            growth = _core.first_selected(
                leaves,
                level,
                level_1.leaf_offset,
                level_1.group_offset,
                ball,
                *self.config.asset_look,
                self.config.filter_px2,
            )
        balls = _core.grown_balls([table.ball for table in tables], growth)
        return [replace(table, ball=ball) for table, ball in zip(tables, balls, strict=True)]

    def _level(self, n: int) -> Level:
        return self._joined(n).read(
            self.store.pages, self.file.run(*self.plan.first_page[n : n + 2])
        )

    def _build_on_threads(
        self, leaves: Leaves, devices: Sequence[Device], most_units: int | None
    ) -> None:
        workers = [device for _ in range(_UNITS_ON_GPU) for device in devices if device.is_cuda]
        workers = (workers or list(devices))[: min(most_units or len(self.parts), len(self.parts))]
        free: SimpleQueue[Device] = SimpleQueue()
        for device in workers:
            free.put(device)

        def work(unit: int) -> _Levels:
            device = free.get()
            try:
                with _device.own_stream(device), _device.memory_errors():
                    for number, level in self._task(unit, leaves).levels(
                        device, self.bar.show_of(unit)
                    ):
                        self.store.save(unit, number, level)
            finally:
                free.put(device)
            return {}

        if len(workers) == 1:
            for unit in self._todo:
                work(unit)
        else:
            with ThreadPoolExecutor(len(workers)) as executor:
                self._collect(lambda unit: executor.submit(work, unit))

    def _build_on_executor(self, leaves: Leaves, device: Device, executor: Executor) -> None:
        expected_device = WorkerDevice(str(device).partition(":")[0], *described(device))
        nonce = os.urandom(8)

        def submit(unit: int) -> Future[_Levels]:
            task = self._task(unit, leaves)
            # a task for another process contains the leaves of its unit
            if isinstance(leaves, MemoryLeaves):
                task = replace(task, leaves=task.leaves().numpy)
            return executor.submit(build_in_worker, task, expected_device, nonce)

        watch = watch_over(executor)
        try:
            self._collect(submit, watch)
        except (OSError, ValueError, RuntimeError, MemoryError):
            raise
        except Exception as error:
            name = "executor"
            if watch is not None:
                name = watch.name
            reason = f"{type(error).__name__}: {error}".rstrip(": ")
            raise RuntimeError(
                f"{name}: building a unit failed ({reason}); finished units are kept, so build "
                "again to continue"
            ) from error

    def _collect(
        self, submit: Callable[[int], Future[_Levels]], watch: Watch | None = None
    ) -> None:
        """Build the units, and save their levels. After a failure or an interrupt, stop
        the other units."""
        units: dict[Future[_Levels], int] = {}
        try:
            for unit in self._todo:
                units[submit(unit)] = unit
            for future in completed(units, watch):
                for number, level in future.result().items():
                    self.store.save(units[future], number, level)
                    self.bar.add(
                        units[future], number, self.parts[units[future]][number][0].num_gaussians
                    )
        except BaseException:
            self.bar.stop()
            for future in units:
                future.cancel()
            raise

    @property
    def _todo(self) -> list[int]:
        return [n for n in range(len(self.units)) if (n, self.num_low - 1) not in self.store.levels]

    def _task(self, unit: int, leaves: Leaves) -> "UnitTask":
        plan = self.units[unit]
        first = int(self.plan.levels[0].offset[plan.levels[0].first_group])
        finished = {n: level for (part, n), level in self.store.levels.items() if part == unit}
        read = partial(leaves.read, first, first + plan.levels[0].num_gaussians)
        runs = [run for _, run in self.parts[unit].values()]
        builder = LevelBuilder(plan, self.config, self.seed, self.file.codec)
        return UnitTask(read, builder, runs, finished, self.store.pages)

    def _joined(self, number: int) -> FinishedLevel:
        """Return a level of all units together."""
        parts = [self.store.levels[unit, number] for unit in range(len(self.units))]
        columns = zip(*(vars(part.tables).values() for part in parts), strict=True)
        tables = LevelTables(*map(np.concatenate, columns))
        return FinishedLevel(tables, np.concatenate([part.hashes for part in parts]))


@dataclass(frozen=True, eq=False)
class UnitTask:
    """Everything that is needed to build a unit. It can be pickled if its `leaves` and
    `pages` can be."""

    leaves: Callable[[], Gaussians]
    builder: LevelBuilder
    runs: Sequence[PageRun]  # pages of the unit's levels
    finished: Mapping[int, FinishedLevel]  # levels that are already built
    pages: PageFile | MemoryStore

    def levels(self, device: Device, show: Show) -> Iterator[tuple[int, FinishedLevel]]:
        """Build the levels that are not finished, one after another, and write their
        pages."""
        finished = (self.finished[n].read(self.pages, self.runs[n]) for n in sorted(self.finished))
        if self.finished:
            leaves = next(finished).gaussians
        else:
            leaves = self.leaves()
        leaves = _device.place(leaves, device)
        levels = self.builder.levels(leaves, finished, show)
        del leaves
        for number, level in enumerate(levels):
            if number not in self.finished:
                hashes = self.pages.write(self.runs[number], level.gaussians)
                yield number, FinishedLevel(level.tables, hashes)
            del level  # frees its memory while the next one is built


class WorkerDevice(NamedTuple):
    """The device that every worker must have, so that all workers give the same
    bits."""

    kind: str  # "cpu" or "cuda"
    description: str
    version: str  # version of v3dg

    def __str__(self) -> str:
        return f"{self.description} with v3dg {self.version}"


def build_in_worker(task: UnitTask, expected_device: WorkerDevice, _: bytes) -> _Levels:
    """Build a unit in a worker of an executor. Raise an error if the worker's device is
    not the expected one.

    The last argument differs in each build. Otherwise dask would return a cached result
    for the same arguments.
    """
    device = _device.resolve(expected_device.kind)
    worker = f"worker on {socket.gethostname()}"
    worker_device = WorkerDevice(expected_device.kind, *described(device))
    if worker_device != expected_device:
        raise RuntimeError(
            f"{worker}: expected {expected_device} like the main process, got {worker_device}; "
            "results would differ in their last bits, so use workers of the same kind"
        )
    assert isinstance(task.pages, PageFile)
    if not task.pages.path.exists():
        raise RuntimeError(
            f"{worker}: {task.pages.path} does not exist there; put resume_path on a disk that "
            "all workers share"
        )
    with _device.own_stream(device), _device.memory_errors():
        return dict(task.levels(device, lambda *_: None))
