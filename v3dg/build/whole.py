"""The build of a whole asset: its units on all devices, then what is above them, into a sink."""

from __future__ import annotations

import operator
import os
import warnings
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, fields
from queue import SimpleQueue
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, cleaning
from v3dg._device import Device
from v3dg.build.assemble import assemble
from v3dg.build.checkpoint import Checkpoint, digest_of
from v3dg.build.config import BuildConfig
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


@dataclass(frozen=True, eq=False)
class Job:
    """An asset to build a bundle of, and how.

    Attributes:
        drawable: (N,) bool, the gaussians that go into the bundle.
        made_with: The config of the bundle.
    """

    asset: Gaussians
    drawable: npt.NDArray[np.bool_]
    config: BuildConfig
    seed: int
    made_with: dict[str, Any]

    @staticmethod
    def of(
        asset: Gaussians, config: BuildConfig | None, seed: int, unusable: Literal["drop", "refuse"]
    ) -> Job:
        """A job, if nothing is wrong; arguments and errors as of `build_bundle`."""
        config = config or BuildConfig()
        seed = operator.index(seed)
        if not 0 <= seed < 2**58:
            raise ValueError(f"seed: expected 0 to 2^58 - 1, got {seed}")
        if str(asset.means.dtype).endswith("64"):
            raise ValueError("asset: expected float32 arrays, got float64; convert them first")
        if unusable not in ("drop", "refuse"):
            raise ValueError(f"unusable: expected 'drop' or 'refuse', got {unusable!r}")
        if len(asset) == 0:
            raise ValueError("asset: expected at least one gaussian, got none")
        with _device.memory_errors():
            findings = cleaning.examine(asset)
        if findings.num_wrong and unusable == "refuse":
            raise ValueError(f"asset: expected gaussians that can be drawn, got others: {findings.text}")
        if not findings.drawable.any():
            raise ValueError(f"asset: expected a gaussian that can be drawn, got none: {findings.text}")
        if findings.num_wrong:
            warnings.warn(f"asset: {findings.text}; they are left out", cleaning.AssetWarning, stacklevel=3)
        made_with = {
            "build": asdict(config),
            "seed": seed,
            "asset_gaussians": len(asset),
            "asset_digest": digest_of(asset),
            "dropped": findings.counts,
        }
        return Job(asset, findings.drawable, config, seed, made_with)


class SplitAsset:
    """An asset's drawable gaussians in the order of the median split: every cluster is contiguous."""

    def __init__(self, job: Job, where: Device) -> None:
        self._asset = job.asset
        self._rows = np.flatnonzero(job.drawable)
        means = _device.place_rows(job.asset.means, job.drawable, where)
        depth = _core.num_halvings(len(means), job.config.cluster_size)
        order, _ = _core.median_split(means, np.array([0, len(means)]), depth)
        self._rows = self._rows[_device.to_host(order)]

    def __len__(self) -> int:
        return len(self._rows)

    def read(self, first: int, last: int) -> Gaussians:
        """A run of the gaussians, where the asset is."""
        return self._asset.subset(self._rows[first:last])


def build_into(
    open_sink: OpenSink,
    job: Job,
    *,
    progress: bool,
    device: str | Device,
    resume_path: str | os.PathLike[str] | None,
) -> None:
    """Build all levels of an asset into a sink; as `build_bundle` for the rest."""
    if not isinstance(progress, bool):
        raise TypeError(f"progress: expected True or False, got {progress!r}")
    where = _device.resolve(device)
    if where.is_cuda and str(device) in ("auto", "cuda") and _device.of(job.asset.means).is_cuda:
        where = _device.of(job.asset.means)
    devices = _device.all_like(where) if str(device) in ("auto", "cuda") else [where]
    with _device.memory_errors():
        leaves = SplitAsset(job, where)
        plan = Plan.of(len(leaves), job.config)
        job.config.check_views(max((np.diff(made.group_offset).max() for made in plan.levels[1:]), default=1))
        units = plan.units(UNIT_LEAVES)
        codec = Codec(job.asset.sh_degree)
        parts = [dict(enumerate(part.levels)) for part in units.plans]
        parts.append({n: level for n, level in enumerate(plan.levels) if n > units.level})
        with (
            Checkpoint(resume_path, parts, job.asset.sh_degree, job.made_with, where) as checkpoint,
            open_sink(plan.layout, codec, job.made_with) as sink,
            Bar(plan, checkpoint.num_gaussians, progress) as bar,
        ):
            build = _Build(job, plan, units, sink, checkpoint, bar)
            tables = build.all_levels(leaves, devices)
            sink.finish(*assemble(plan, tables, job.config))


@dataclass(frozen=True, eq=False)
class _Unit:
    """What is left of a unit when its pages are written: all tables, and what the levels above need."""

    tables: list[LevelTables]
    kept: dict[int, Gaussians]


class _Build:
    """The work on all units of a plan, and on what is above them."""

    def __init__(
        self, job: Job, plan: Plan, units: Units, sink: Sink, checkpoint: Checkpoint, bar: Bar
    ) -> None:
        self._job, self._plan, self._units = job, plan, units
        self._sink, self._checkpoint, self._bar = sink, checkpoint, bar
        self._first_page = plan.first_page
        # Levels of the units that the work above them begins with.
        has_above = units.level + 1 < len(plan.levels)
        first = min(units.level, job.config.target_of(units.level + 1)) if has_above else units.level
        self._kept = range(first, units.level + 1)

    def all_levels(self, leaves: SplitAsset, devices: Sequence[Device]) -> list[LevelTables]:
        """Build all levels; their tables."""
        tables, below = self._join(self._build_units(leaves, devices), devices[0])
        top = len(self._units.plans)
        above = build_above(
            below,
            self._plan,
            self._job.config,
            self._job.seed,
            finished=self._checkpoint.load(top),
            show=self._bar.show_of(top),
        )
        for number, level in enumerate(above, self._units.level + 1):
            host = Level(level.gaussians.numpy(), level.tables)
            self._write(number, host.gaussians)
            self._checkpoint.save(top, number, host)
            tables.append(host.tables)
        return tables

    def _build_units(self, leaves: SplitAsset, devices: Sequence[Device]) -> list[_Unit]:
        units: list[Any] = [None] * len(self._units.plans)
        workers = [device for device in devices for _ in range(_UNITS_ON_GPU if device.is_cuda else 1)]
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
        tables = [
            _joined_tables([unit.tables[number] for unit in units]) for number in range(self._units.level + 1)
        ]
        whole = {n: Gaussians.concatenate([unit.kept[n] for unit in units]) for n in self._kept}
        self._write(self._units.level, whole[self._units.level])
        return tables, {n: Level(_device.place(part, device), tables[n]) for n, part in whole.items()}

    def _unit(self, unit: int, leaves: SplitAsset, device: Device) -> _Unit:
        plan = self._units.plans[unit]
        first = self._plan.levels[0].offset[plan.levels[0].first_group]
        with _device.memory_errors():
            own = _device.place(leaves.read(first, first + plan.levels[0].num_gaussians), device)
            levels = build_levels(
                own,
                plan,
                self._job.config,
                self._job.seed,
                finished=self._checkpoint.load(unit),
                show=self._bar.show_of(unit),
            )
            del own
            tables: list[LevelTables] = []
            kept: dict[int, Gaussians] = {}
            for number, level in enumerate(levels):
                host = Level(level.gaussians.numpy(), level.tables)
                if number < self._units.level:
                    above = plan.levels[number + 1]
                    page = self._first_page[number] + above.first_group
                    self._sink.write(page, page + above.num_groups, host.gaussians)
                if number > 0:
                    self._checkpoint.save(unit, number, host)
                if number in self._kept:
                    kept[number] = host.gaussians
                tables.append(host.tables)
                del level, host  # while the next is made, their memory is free
        return _Unit(tables, kept)

    def _write(self, number: int, gaussians: Gaussians) -> None:
        self._sink.write(self._first_page[number], self._first_page[number + 1], gaussians)

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
                self._bar.stop()
                for future in futures:
                    future.cancel()
                raise


def _joined_tables(parts: Sequence[LevelTables]) -> LevelTables:
    """The tables of a level of which these are the parts."""
    names = [field.name for field in fields(LevelTables)]
    return LevelTables(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))
