"""The unit of work: from the leaves of an asset or of a subtree of it to the levels above them."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg.build.config import BuildConfig
from v3dg.build.fit import fit_config, run_fit
from v3dg.build.plan import LevelPlan, Offsets, Plan
from v3dg.bundle.codec import Codec
from v3dg.gaussians import Array, Gaussians, empty, put

# Groups of which the start is made at once: a second or so in which Ctrl-C has to wait.
_GROUPS_AT_ONCE = 256

Show = Callable[[range, int, int, _core.FitProgress], None]
"""Is told now and then of a fit: its levels, groups and gaussians, and how far it has come."""


@dataclass(frozen=True, eq=False)
class LevelTables:
    """What was measured of a level, on the host; all else follows from the plan."""

    box: npt.NDArray[np.float32]  # (C, 2, 3), of what the clusters draw
    ball: npt.NDArray[np.float32]  # (G, 4), nested, for selection
    fit_ball: npt.NDArray[np.float32]  # (G, 4), as small as is known, which the fit looks at
    error: npt.NDArray[np.float32]  # (G, 2), residual of the fits


@dataclass(frozen=True, eq=False)
class Level:
    """A finished level; its gaussians may be on any device."""

    gaussians: Gaussians
    tables: LevelTables


@dataclass(frozen=True, eq=False)
class LevelBuilder:
    """Makes the levels of a plan: of a whole asset, or of any subtree of it.

    What a group becomes depends on the leaves under it, the config, the seed, its level and its number in
    the level, and on nothing else. So on the CPU the same groups get the same bits, whatever the plan. On
    CUDA, how many groups are fitted at once can change how a group is spread over the GPU, and thereby the
    last bits.
    """

    plan: Plan
    config: BuildConfig
    seed: int
    codec: Codec

    def levels(
        self,
        leaves: Gaussians,
        finished: Iterable[Level] = (),
        show: Show = lambda levels, num_groups, num_gaussians, state: None,
    ) -> Iterator[Level]:
        """Yield all levels, one after another: the leaves first, as level 0; some may be `finished`."""
        here = self.plan.levels[0]
        leaves = self.codec.rounded(leaves, here.offset)
        ball = _device.to_host(_core.bound_spheres(_spheres(leaves), here.leaf_offset))
        box = _device.to_host(_core.bound_by_boxes(leaves.rows, here.offset))
        below = {0: Level(leaves, LevelTables(box, ball, ball, np.zeros((here.num_groups, 2), np.float32)))}
        del leaves
        yield below[0]
        yield from self.levels_above(below, finished, show)

    def levels_above(self, below: dict[int, Level], finished: Iterable[Level], show: Show) -> Iterator[Level]:
        """Yield the levels above those of `below`, which keeps those that the next are fitted to."""
        saved, config, num_levels = iter(finished), self.config, len(self.plan.levels)
        last = max(below)
        where = _device.of(below[last].gaussians.means)
        while last + 1 < num_levels:
            levels = config.levels_at_once(last + 1, num_levels)
            made = list(islice(saved, len(levels)))
            if len(made) < len(levels):
                made = self._simplify(below, levels, show)
            for number, level in zip(levels, made, strict=True):
                below[number] = Level(_device.place(level.gaussians, where), level.tables)
            last = levels[-1]
            for number in [number for number in below if number < min(last, config.target_of(last + 1))]:
                del below[number]
            while made:
                yield made.pop(0)

    def _simplify(self, below: Mapping[int, Level], levels: range, show: Show) -> list[Level]:
        """Make the next levels, whose groups are fitted together."""
        plan, config = self.plan, self.config
        plans = [plan.levels[number] for number in levels]
        starts, chain = [], below[levels[0] - 1].gaussians
        for number, here in zip(levels, plans, strict=True):
            under = plan.levels[number - 1]
            offset = np.ascontiguousarray(under.offset[:: under.num_clusters // here.num_groups])
            chain = _start(chain, offset, here.group_offset, config)
            starts.append(chain)
        gaussians = starts[0] if len(starts) == 1 else Gaussians.concatenate(starts)
        del starts, chain
        targets = range(config.target_of(levels[0]), config.target_of(levels[-1]) + 1)
        target = _target(below, targets, config)
        views = [_view(below[config.target_of(number)], plan, number, config) for number in levels]
        offsets, balls = zip(*views, strict=True)
        rows = np.cumsum([0, *(here.num_gaussians for here in plans)])
        groups = np.cumsum([0, *(here.num_groups for here in plans)])
        where = _device.of(gaussians.means)
        _device.spare_memory(where)
        error = run_fit(
            lambda progress: _core.fit_level(
                fit_config(config, self.seed, levels[0]),
                target,
                _ranges(offsets, [len(below[number].gaussians) for number in targets]),
                gaussians.rows,
                _ranges([here.group_offset for here in plans], np.diff(rows)),
                np.concatenate(balls),
                np.concatenate([_streams(*level) for level in zip(levels, plans, strict=True)]),
                progress,
            ),
            where,
            lambda state: show(levels, int(groups[-1]), len(gaussians), state),
        )
        made: list[Level] = []
        ball = below[levels[0] - 1].tables.ball
        for i, number in enumerate(levels):
            ball = _core.bound_spheres(ball, _children(plan, number - 1, number))
            part = gaussians.subset(slice(int(rows[i]), int(rows[i + 1])))
            made.append(_level(part, plans[i], self.codec, ball, balls[i], error[groups[i] : groups[i + 1]]))
        return made


def _streams(number: int, plan: LevelPlan) -> npt.NDArray[np.int64]:
    """(G,) streams of random numbers: every group of the asset has one of its own."""
    return (number << 40) + np.arange(plan.first_group, plan.first_group + plan.num_groups, dtype=np.int64)


def _level(gaussians: Gaussians, plan: LevelPlan, codec: Codec, *tables: npt.NDArray[np.float32]) -> Level:
    """A level of fitted groups, each split into its clusters."""
    clusters_made = plan.num_clusters // plan.num_groups
    if clusters_made > 1:
        order, _ = _core.median_split(gaussians.means, plan.group_offset, clusters_made.bit_length() - 1)
        gaussians = gaussians.subset(order)
    gaussians = codec.rounded(gaussians, plan.offset)
    box = _device.to_host(_core.bound_by_boxes(gaussians.rows, plan.offset))
    return Level(gaussians, LevelTables(box, *tables))


def _view(
    target: Level, plan: Plan, number: int, config: BuildConfig
) -> tuple[Offsets, npt.NDArray[np.float32]]:
    """Of the groups of a level: (G + 1,) gaussians of their target under each; (G, 4) balls to look at."""
    source, here = config.target_of(number), plan.levels[number]
    if source == 0:
        ball = _core.bound_spheres(_spheres(target.gaussians), here.leaf_offset)
        return here.leaf_offset, _device.to_host(ball)
    under = _children(plan, source, number)
    return plan.levels[source].group_offset[under], _core.bound_spheres(target.tables.fit_ball, under)


def _children(plan: Plan, below: int, number: int) -> Offsets:
    """(G + 1,) groups of a level below that are under each of a level."""
    num_groups = plan.levels[number].num_groups
    return np.arange(num_groups + 1, dtype=np.int64) * (plan.levels[below].num_groups // num_groups)


def _spheres(gaussians: Gaussians) -> Array:
    library = _device.library_of(gaussians.means)
    radius = library.amax(gaussians.scales, axis=1, keepdims=True)
    return library.concatenate([gaussians.means, radius], axis=1)


def _target(below: Mapping[int, Level], numbers: range, config: BuildConfig) -> _core.FitTarget:
    """What groups are to look like, drawn as it is drawn when it is selected.

    But for the filter of the asset: that spreads gaussians without taking from their opacity, the more the
    smaller they are shown, and coarser levels would learn to be too thick.
    """
    parts = [below[number].gaussians for number in numbers]
    rows = (parts[0] if len(parts) == 1 else Gaussians.concatenate(parts)).rows
    if numbers[0] == 0:
        return _core.FitTarget(rows, 0.0, False)
    return _core.FitTarget(rows, config.filter_px2, True)


def _start(gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig) -> Gaussians:
    """What groups start from: their gaussians halved, from `offset` to `out_offset`."""
    if _device.of(gaussians.means).is_cuda:
        return _halved(gaussians, offset, out_offset, config)
    result = empty(int(out_offset[-1]), gaussians.sh_degree)
    for first in range(0, len(offset) - 1, _GROUPS_AT_ONCE):
        cuts, out_cuts = (o[first : first + _GROUPS_AT_ONCE + 1] for o in (offset, out_offset))
        part = gaussians.subset(slice(cuts[0], cuts[-1]))
        put(_halved(part, cuts - cuts[0], out_cuts - out_cuts[0], config), result, out_cuts[0])
    return result


def _halved(gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig) -> Gaussians:
    if config.init == "merge":
        return Gaussians(*_core.merge(gaussians.rows, offset, out_offset))
    kept = gaussians.subset(_core.prune(gaussians.rows, offset, out_offset))
    return replace(kept, scales=kept.scales * np.float32(config.prune_growth))


def _ranges(offsets: Sequence[Offsets], counts: Sequence[int] | Offsets) -> npt.NDArray[np.int64]:
    """(S, 2) first and end of each segment of arrays that lie one after another, with so many elements."""
    first = np.cumsum([0, *counts])
    moved = [offset + start for offset, start in zip(offsets, first[:-1], strict=True)]
    return np.concatenate([np.stack([offset[:-1], offset[1:]], axis=1) for offset in moved])
