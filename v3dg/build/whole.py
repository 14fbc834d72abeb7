"""The build of a whole asset: level after level, from the checkpoint or anew, into a sink."""

from __future__ import annotations

import operator
import os
import warnings
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from dataclasses import asdict
from typing import Any, Literal, Protocol, TypeAlias

import numpy as np

from v3dg import _core, _device, cleaning
from v3dg._device import Device
from v3dg.build.assemble import assemble
from v3dg.build.checkpoint import Checkpoint
from v3dg.build.config import BuildConfig
from v3dg.build.plan import Plan
from v3dg.build.progress import Bar
from v3dg.build.simplify import Level, LevelTables, build_levels
from v3dg.bundle import Clusters, Groups
from v3dg.bundle.codec import Codec, Float32Codec
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


def build_into(
    open_sink: OpenSink,
    asset: Gaussians,
    *,
    config: BuildConfig,
    seed: int,
    progress: bool,
    device: str | Device,
    resume_path: str | os.PathLike[str] | None,
    unusable: Literal["drop", "refuse"],
) -> None:
    """Build all levels of an asset into a sink; as `build_bundle` for the rest."""
    where = _device.resolve(device)
    if where.is_cuda and str(device) in ("auto", "cuda") and _device.of(asset.means).is_cuda:
        where = _device.of(asset.means)
    seed = _checked(asset, seed, progress, unusable)
    with _device.memory_errors():
        placed, dropped = _drawable_part(_device.place(asset, where), unusable)
        made_with = {"build": asdict(config), "seed": seed, "asset_gaussians": len(asset), "dropped": dropped}
        plan = Plan.of(len(placed), config)
        checkpoint = Checkpoint(resume_path, placed, plan, config, seed, where)
        leaves = _in_split_order(placed, config)
        del placed  # twice is enough: the caller's, and in the order of the leaves
        codec = Float32Codec(leaves.sh_degree)
        bar = Bar(plan, progress)
        with checkpoint, open_sink(plan.layout, codec, made_with) as sink:
            levels = build_levels(leaves, plan, config, seed, finished=checkpoint.load(), show=bar.show)
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


def _checked(asset: Gaussians, seed: int, progress: bool, unusable: str) -> int:
    """The seed, if nothing is wrong."""
    if not isinstance(progress, bool):
        raise TypeError(f"progress: expected True or False, got {progress!r}")
    seed = operator.index(seed)
    if not 0 <= seed < 2**58:
        raise ValueError(f"seed: expected 0 to 2^58 - 1, got {seed}")
    if str(asset.means.dtype).endswith("64"):
        raise ValueError("asset: expected float32 arrays, got float64; convert them first")
    if unusable not in ("drop", "refuse"):
        raise ValueError(f"unusable: expected 'drop' or 'refuse', got {unusable!r}")
    return seed


def _drawable_part(asset: Gaussians, unusable: str) -> tuple[Gaussians, dict[str, int]]:
    """The gaussians that can be drawn, and how many of each kind could not."""
    if len(asset) == 0:
        raise ValueError("asset: expected at least one gaussian, got none")
    findings = cleaning.examine(asset)
    if findings.num_wrong and unusable == "refuse":
        raise ValueError(f"asset: expected gaussians that can be drawn, got others: {findings.text}")
    if not findings.drawable.any():
        raise ValueError(f"asset: expected a gaussian that can be drawn, got none: {findings.text}")
    if findings.num_wrong:
        warnings.warn(f"asset: {findings.text}; they are left out", cleaning.AssetWarning, stacklevel=4)
    if findings.num_dropped:
        asset = asset.subset(findings.drawable)
    return asset, findings.counts
