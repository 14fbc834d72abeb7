"""The build of a whole asset: level after level, from the checkpoint or anew, into a sink."""

from __future__ import annotations

import operator
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, cleaning
from v3dg._device import Device
from v3dg.build.assemble import assemble
from v3dg.build.checkpoint import Checkpoint, digest_of
from v3dg.build.config import BuildConfig
from v3dg.build.plan import Plan
from v3dg.build.progress import Bar
from v3dg.build.simplify import Level, LevelTables, build_levels
from v3dg.bundle import Clusters, Groups
from v3dg.bundle.codec import Codec
from v3dg.bundle.pages import PageLayout
from v3dg.gaussians import Gaussians


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
    asset, config = job.asset, job.config
    where = _device.resolve(device)
    if where.is_cuda and str(device) in ("auto", "cuda") and _device.of(asset.means).is_cuda:
        where = _device.of(asset.means)
    with _device.memory_errors():
        placed = _device.place(asset, where)
        if not job.drawable.all():
            placed = placed.subset(job.drawable)
        plan = Plan.of(len(placed), config)
        checkpoint = Checkpoint(resume_path, plan, asset.sh_degree, job.made_with, where)
        leaves = _in_split_order(placed, config)
        del placed  # twice is enough: the caller's, and in the order of the leaves
        codec = Codec(leaves.sh_degree)
        bar = Bar(plan, progress)
        with checkpoint, open_sink(plan.layout, codec, job.made_with) as sink:
            levels = build_levels(leaves, plan, config, job.seed, finished=checkpoint.load(), show=bar.show)
            del leaves
            try:
                tables = _drain(levels, plan, sink, checkpoint)
            finally:
                bar.close()
            sink.finish(*assemble(plan, tables, config))


def _drain(levels: Iterator[Level], plan: Plan, sink: Sink, checkpoint: Checkpoint) -> list[LevelTables]:
    """Take all levels to the sink, and new ones to the checkpoint; their tables."""
    tables = []
    first_page = plan.first_page
    for number in range(len(plan.levels)):
        level = next(levels)
        level = Level(level.gaussians.numpy(), level.tables)
        sink.write(first_page[number], first_page[number + 1], level.gaussians)
        if number > checkpoint.num_levels:
            checkpoint.save(level)
        tables.append(level.tables)
        del level  # while the next is made, its memory is free
    return tables


def _in_split_order(asset: Gaussians, config: BuildConfig) -> Gaussians:
    """The gaussians so that every cluster of a perfect binary tree is contiguous."""
    depth = _core.num_halvings(len(asset), config.cluster_size)
    order, _ = _core.median_split(asset.means, np.array([0, len(asset)]), depth)
    return asset.subset(order)
