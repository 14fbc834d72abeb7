"""Makes the levels above the leaves, for a whole asset or a subtree."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg.bundle.codec import Codec
from v3dg.gaussians import Array, Gaussians, empty, put
from v3dg.levels.config import BuildConfig
from v3dg.levels.fit import fit_config, run_fit
from v3dg.levels.plan import LevelPlan, Offsets, Plan
from v3dg.levels.rows import in_runs

# Number of groups that are initialised together. This takes about a second, during
# which Ctrl-C has no effect.
_GROUPS_AT_ONCE = 256

Show = Callable[[range, int, int, _core.FitProgress], None]
"""Progress callback: levels, number of groups, number of gaussians, state."""


@dataclass(frozen=True, eq=False)
class LevelTables:
    """The measured values of a level, on the host. All other values in the tables of a
    bundle follow from the plan."""

    box: npt.NDArray[np.float32]  # (C, 2, 3), boxes around the drawn clusters
    # (G, 4) balls for selection; each contains the balls of the groups below
    ball: npt.NDArray[np.float32]
    # (G, 4) smallest balls around groups, which the views of the fit show
    fit_ball: npt.NDArray[np.float32]
    # (G, 2) remaining errors of the fits: colour and alpha
    error: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Level:
    """A finished level; its gaussians may be on any device."""

    gaussians: Gaussians
    tables: LevelTables


@dataclass(frozen=True, eq=False)
class LevelBuilder:
    """Makes the levels of a plan for a whole asset or for any subtree of it.

    The result for a group depends only on the leaves under it, the config, the seed,
    its level, and its index in the level. Therefore, on the CPU, a group has the same
    bits in every plan. On CUDA, the number of groups that are fitted together decides
    how many blocks fit a group, which can change the last bits.
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
        """Yield all levels in ascending order, beginning with the leaves as level 0.
        `finished` has levels above 0 that need not be built again."""
        plan = self.plan.levels[0]
        leaves = in_runs(self.codec.rounded(leaves, plan.offset), plan.offset)
        ball = _device.to_host(_core.bound_spheres(_spheres(leaves), plan.leaf_offset))
        tables = LevelTables(
            box=_device.to_host(_core.bound_by_boxes(leaves.rows, plan.offset)),
            ball=ball,
            fit_ball=ball,
            error=np.zeros((plan.num_groups, 2), np.float32),
        )
        lower_levels = {0: Level(leaves, tables)}
        del leaves
        yield lower_levels[0]
        yield from self.levels_above(lower_levels, finished, show)

    def levels_above(
        self, lower_levels: dict[int, Level], finished: Iterable[Level], show: Show
    ) -> Iterator[Level]:
        """Yield the levels above `lower_levels`, which maps numbers to levels. New
        levels are added to it, and levels are removed when no later level is fitted to
        them."""
        saved = iter(finished)
        num_levels = len(self.plan.levels)
        last = max(lower_levels)
        device = _device.of(lower_levels[last].gaussians.means)
        while last + 1 < num_levels:
            numbers = self.config.levels_at_once(last + 1, num_levels)
            levels = list(islice(saved, len(numbers)))
            if len(levels) < len(numbers):
                levels = self._simplify(lower_levels, numbers, show)
            for number, level in zip(numbers, levels, strict=True):
                lower_levels[number] = Level(_device.place(level.gaussians, device), level.tables)
            last = numbers[-1]
            first_needed = min(last, self.config.target_of(last + 1))
            for number in [number for number in lower_levels if number < first_needed]:
                del lower_levels[number]
            # The caller, and not this function, decides how long a level is kept.
            while levels:
                yield levels.pop(0)

    def _simplify(
        self, lower_levels: Mapping[int, Level], numbers: range, show: Show
    ) -> list[Level]:
        """Make the next levels, whose groups are fitted together."""
        config = self.config
        plans = [self.plan.levels[number] for number in numbers]
        gaussians = self._starts(lower_levels[numbers[0] - 1].gaussians, numbers)
        targets = range(config.target_of(numbers[0]), config.target_of(numbers[-1]) + 1)
        target_sizes = [len(lower_levels[number].gaussians) for number in targets]
        views = [
            _view(lower_levels[config.target_of(number)], self.plan, number, config)
            for number in numbers
        ]
        target_offsets = [offset for offset, _ in views]
        fit_balls = [ball for _, ball in views]
        first_row = np.cumsum([0, *(plan.num_gaussians for plan in plans)])
        first_group = np.cumsum([0, *(plan.num_groups for plan in plans)])
        device = _device.of(gaussians.means)
        _device.spare_memory(device)
        error = run_fit(
            lambda progress: _core.fit_level(
                fit_config(config, self.seed, numbers[0]),
                _target(lower_levels, targets, config),
                _ranges(target_offsets, target_sizes),
                gaussians.rows,  # the fit overwrites these arrays with its result
                _ranges([plan.group_offset for plan in plans], np.diff(first_row)),
                np.concatenate(fit_balls),
                np.concatenate([_streams(*level) for level in zip(numbers, plans, strict=True)]),
                progress,
            ),
            device,
            lambda state: show(numbers, int(first_group[-1]), len(gaussians), state),
        )
        levels: list[Level] = []
        ball = lower_levels[numbers[0] - 1].tables.ball
        for i, number in enumerate(numbers):
            ball = _core.bound_spheres(ball, _children(self.plan, number - 1, number))
            part = gaussians.subset(slice(int(first_row[i]), int(first_row[i + 1])))
            part_error = error[first_group[i] : first_group[i + 1]]
            levels.append(_level(part, plans[i], self.codec, ball, fit_balls[i], part_error))
        return levels

    def _starts(self, gaussians: Gaussians, numbers: range) -> Gaussians:
        """Return the initial gaussians of the groups of some levels. Each level is made
        by halving the one below."""
        starts: list[Gaussians] = []
        for number in numbers:
            plan = self.plan.levels[number]
            lower = self.plan.levels[number - 1]
            offset = np.ascontiguousarray(lower.offset[:: lower.num_clusters // plan.num_groups])
            gaussians = _start(gaussians, offset, plan.group_offset, self.config)
            starts.append(gaussians)
        return _joined(starts)


def _streams(number: int, plan: LevelPlan) -> npt.NDArray[np.int64]:
    """Return (G,) seeds of random numbers, which differ between all groups of the
    asset."""
    return (number << 40) + np.arange(
        plan.first_group, plan.first_group + plan.num_groups, dtype=np.int64
    )


def _joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Return the gaussians of all parts.

    If there is only one part, it is not copied.
    """
    if len(parts) == 1:
        return parts[0]
    return Gaussians.concatenate(parts)


def _level(
    gaussians: Gaussians,
    plan: LevelPlan,
    codec: Codec,
    ball: npt.NDArray[np.float32],
    fit_ball: npt.NDArray[np.float32],
    error: npt.NDArray[np.float32],
) -> Level:
    """Return a level of fitted groups, each of which is split into its clusters."""
    clusters_made = plan.num_clusters // plan.num_groups
    if clusters_made > 1:
        order, _ = _core.median_split(
            gaussians.means, plan.group_offset, clusters_made.bit_length() - 1
        )
        gaussians = gaussians.subset(order)
    gaussians = in_runs(codec.rounded(gaussians, plan.offset), plan.offset)
    box = _device.to_host(_core.bound_by_boxes(gaussians.rows, plan.offset))
    return Level(gaussians, LevelTables(box=box, ball=ball, fit_ball=fit_ball, error=error))


def _view(
    target: Level, plan: Plan, number: int, config: BuildConfig
) -> tuple[Offsets, npt.NDArray[np.float32]]:
    """Return the target of each group of a level: (G + 1,) offsets of the target's
    gaussians, and (G, 4) balls that the views show."""
    source = config.target_of(number)
    leaf_offset = plan.levels[number].leaf_offset
    if source == 0:
        ball = _core.bound_spheres(_spheres(target.gaussians), leaf_offset)
        return leaf_offset, _device.to_host(ball)
    children = _children(plan, source, number)
    return plan.levels[source].group_offset[children], _core.bound_spheres(
        target.tables.fit_ball, children
    )


def _children(plan: Plan, lower: int, number: int) -> Offsets:
    """Return (G + 1,) offsets of the groups of level `lower` under each group of level
    `number`."""
    num_groups = plan.levels[number].num_groups
    return np.arange(num_groups + 1, dtype=np.int64) * (plan.levels[lower].num_groups // num_groups)


def _spheres(gaussians: Gaussians) -> Array:
    library = _device.library_of(gaussians.means)
    radius = library.amax(gaussians.scales, axis=1, keepdims=True)
    return library.concatenate([gaussians.means, radius], axis=1)


def _target(
    lower_levels: Mapping[int, Level], numbers: range, config: BuildConfig
) -> _core.FitTarget:
    """Return the gaussians that groups are fitted to. Their appearance is the one with
    which they are drawn.

    The asset's own filter is omitted. It widens gaussians without reducing their
    opacity, most of all at small sizes, so coarser levels would become too opaque.
    """
    rows = _joined([lower_levels[number].gaussians for number in numbers]).rows
    if numbers[0] == 0:
        return _core.FitTarget(rows, filter_px2=0.0, antialiased=False)
    return _core.FitTarget(rows, filter_px2=config.filter_px2, antialiased=True)


def _start(
    gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig
) -> Gaussians:
    """Return the initial gaussians of groups. The gaussians at `offset` are reduced to
    the numbers that `out_offset` allows."""
    if _device.of(gaussians.means).is_cuda:
        return _halved(gaussians, offset, out_offset, config)
    result = empty(int(out_offset[-1]), gaussians.sh_degree)
    for first in range(0, len(offset) - 1, _GROUPS_AT_ONCE):
        part_offset = offset[first : first + _GROUPS_AT_ONCE + 1]
        part_out_offset = out_offset[first : first + _GROUPS_AT_ONCE + 1]
        part = gaussians.subset(slice(part_offset[0], part_offset[-1]))
        halved = _halved(
            part, part_offset - part_offset[0], part_out_offset - part_out_offset[0], config
        )
        put(halved, result, part_out_offset[0])
    return result


def _halved(
    gaussians: Gaussians, offset: Offsets, out_offset: Offsets, config: BuildConfig
) -> Gaussians:
    if config.init == "merge":
        return Gaussians(*_core.merge(gaussians.rows, offset, out_offset))
    pruned = gaussians.subset(_core.prune(gaussians.rows, offset, out_offset))
    return replace(pruned, scales=pruned.scales * np.float32(config.prune_growth))


def _ranges(offsets: Sequence[Offsets], counts: Sequence[int] | Offsets) -> npt.NDArray[np.int64]:
    """Return (S, 2) start and end of S segments after the arrays are concatenated.
    `offsets` has the boundaries of the segments in each array, and `counts` the lengths
    of the arrays."""
    first = np.cumsum([0, *counts])
    moved = [offset + start for offset, start in zip(offsets, first[:-1], strict=True)]
    return np.concatenate([np.stack([offset[:-1], offset[1:]], axis=1) for offset in moved])
