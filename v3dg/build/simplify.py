"""The unit of work: from the leaves of an asset or of a subtree of it to the levels above them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg.build.config import BuildConfig
from v3dg.build.fit import fit_config, run_fit
from v3dg.build.plan import LevelPlan, Offsets, Plan
from v3dg.bundle.codec import Codec
from v3dg.gaussians import Array, Gaussians

# Groups of which the start is made at once: a second or so in which Ctrl-C has to wait.
_GROUPS_AT_ONCE = 256

Show = Callable[[int, _core.FitProgress], None]
"""Is told now and then how far the fit of a level, given by its number, has come."""


@dataclass(frozen=True, eq=False)
class LevelTables:
    """What was measured of a level, on the host; all else follows from the plan.

    Attributes:
        box: (C, 2, 3) float32, of what the clusters draw.
        ball: (G, 4) float32, nested, for selection.
        error: (G, 2) float32, residual of the fits.
    """

    box: npt.NDArray[np.float32]
    ball: npt.NDArray[np.float32]
    error: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Level:
    """A finished level; its gaussians may be on any device."""

    gaussians: Gaussians
    tables: LevelTables


def build_levels(
    leaves: Gaussians,
    plan: Plan,
    config: BuildConfig,
    seed: int,
    *,
    finished: Iterable[Level] = (),
    show: Show = lambda level, state: None,
) -> Iterator[Level]:
    """Yield all levels of a plan, one after another: the leaves first, as level 0.

    What a group becomes depends on the leaves under it, the config, the seed, its level and its number in
    the level, and on nothing else. So the plan may be of the whole asset or of any subtree: on the CPU, the
    same groups get the same bits. On CUDA, how many groups are fitted at once can change how a group is
    spread over the GPU, and thereby the last bits.

    Args:
        leaves: The gaussians of level 0 in the order of the median split, where the work is to be done.
        finished: Levels from 1 on that need not be built again.
    """
    where = _device.of(leaves.means)
    target = _Leaves(leaves, config)
    level = target.level(leaves, plan.levels[0])
    del leaves  # in which memory they are from now on is for `level` and `target` to say
    yield level
    saved = iter(finished)
    for number in range(1, len(plan.levels)):
        known = next(saved, None)
        if known is None:
            below = Level(_device.place(level.gaussians, where), level.tables)
            del level
            known = _simplify(below, target, plan, number, config, seed, show)
            del below
        level = known
        yield level


class _Leaves:
    """The gaussians of level 0, as those that groups are made to look like and that their balls hold."""

    def __init__(self, leaves: Gaussians, config: BuildConfig) -> None:
        library = _device.library_of(leaves.means)
        radius = library.amax(leaves.scales, axis=1, keepdims=True)
        self._spheres: Array = library.concatenate([leaves.means, radius], axis=1)
        self.target = _target(leaves, config, is_asset=True) if config.targets == "leaves" else None
        self._last_balls: tuple[Offsets, npt.NDArray[np.float32]] | None = None

    def level(self, leaves: Gaussians, plan: LevelPlan) -> Level:
        """Level 0."""
        box = _device.to_host(_core.bound_by_boxes(leaves.rows, plan.offset))
        error = np.zeros((plan.num_groups, 2), np.float32)
        return Level(leaves, LevelTables(box, self.balls(plan.leaf_offset), error))

    def balls(self, leaf_offset: Offsets) -> npt.NDArray[np.float32]:
        """Balls around the leaves under each group, which are what the fit looks at."""
        # Past the root, every level stands for all leaves.
        if self._last_balls is None or not np.array_equal(self._last_balls[0], leaf_offset):
            balls = _device.to_host(_core.bound_spheres(self._spheres, leaf_offset))
            self._last_balls = leaf_offset, balls
        return self._last_balls[1]


def _simplify(
    below: Level, leaves: _Leaves, plan: Plan, number: int, config: BuildConfig, seed: int, show: Show
) -> Level:
    """Make a level from the one below."""
    under, here = plan.levels[number - 1], plan.levels[number]
    offset = np.ascontiguousarray(under.offset[:: under.num_clusters // here.num_groups])
    gaussians = _start(below.gaussians, offset, here.group_offset, config)
    where = _device.of(gaussians.means)
    from_leaves = config.targets == "leaves"
    ball = leaves.balls(here.leaf_offset)
    target = leaves.target or _target(below.gaussians, config, is_asset=number == 1)
    _device.spare_memory(where)
    error = run_fit(
        lambda progress: _core.fit_level(
            fit_config(config, seed, number),
            target,
            _ranges(here.leaf_offset if from_leaves else offset),
            gaussians.rows,
            _ranges(here.group_offset),
            ball,
            np.arange(here.first_group, here.first_group + here.num_groups, dtype=np.int64),
            progress,
        ),
        where,
        lambda state: show(number, state),
    )
    clusters_made = here.num_clusters // here.num_groups
    if clusters_made > 1:
        depth = clusters_made.bit_length() - 1
        order, _ = _core.median_split(gaussians.means, here.group_offset, depth)
        gaussians = gaussians.subset(order)
    box = _device.to_host(_core.bound_by_boxes(gaussians.rows, here.offset))
    children = np.arange(here.num_groups + 1, dtype=np.int64) * (under.num_groups // here.num_groups)
    return Level(gaussians, LevelTables(box, _core.bound_spheres(below.tables.ball, children), error))


def _target(gaussians: Gaussians, config: BuildConfig, *, is_asset: bool) -> _core.FitTarget:
    """What groups are to look like, drawn as it is drawn when it is selected."""
    if is_asset:
        return _core.FitTarget(gaussians.rows, config.asset_filter_px2, config.asset_antialiased)
    return _core.FitTarget(gaussians.rows, config.filter_px2, True)


def _start(gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig) -> Gaussians:
    """What groups start from: their gaussians halved, from `offset` to `out_offset`."""
    if _device.of(gaussians.means).is_cuda:
        return _halved(gaussians, offset, out_offset, config)
    result = Codec(gaussians.sh_degree).empty(int(out_offset[-1]))
    for first in range(0, len(offset) - 1, _GROUPS_AT_ONCE):
        cuts, out_cuts = (o[first : first + _GROUPS_AT_ONCE + 1] for o in (offset, out_offset))
        part = gaussians.subset(slice(cuts[0], cuts[-1]))
        part = _halved(part, cuts - cuts[0], out_cuts - out_cuts[0], config)
        for field in fields(Gaussians):
            getattr(result, field.name)[out_cuts[0] : out_cuts[-1]] = getattr(part, field.name)
    return result


def _halved(gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig) -> Gaussians:
    if config.init == "merge":
        return Gaussians(*_core.merge(gaussians.rows, offset, out_offset))
    kept = gaussians.subset(_core.prune(gaussians.rows, offset, out_offset))
    return replace(kept, scales=kept.scales * np.float32(config.prune_growth))


def _ranges(offset: Offsets) -> npt.NDArray[np.int64]:
    """(S, 2) first and end of each segment."""
    return np.stack([offset[:-1], offset[1:]], axis=1)
