"""Whether an asset is smooth: its gaussians as wide as they are far apart, so that no filter is needed."""

from dataclasses import replace

from v3dg import _device
from v3dg._device import Device
from v3dg.build.config import BuildConfig
from v3dg.build.leaves import Leaves
from v3dg.build.plan import Plan
from v3dg.build.simplify import LevelBuilder
from v3dg.bundle.codec import Codec
from v3dg.gaussians import Gaussians

# How many groups of level 1, spread evenly, are fitted with a filter and without it, in half of the steps,
# and how much larger their loss is without it where an asset needs it (docs/levels.md).
_GROUPS, _FILTER_PX2, _NEEDED = 32, 0.05, 1.4


def settled(
    config: BuildConfig, plan: Plan, leaves: Leaves, seed: int, codec: Codec, where: Device
) -> BuildConfig:
    """The config with which levels are built: what it leaves to a measurement is measured."""
    smooth = replace(config, smooth="yes", filter_px2=0.0)
    if config.smooth != "measured" or config.steps == 0 or len(plan.levels) == 1:
        return smooth if config.smooth == "yes" else config
    level = plan.levels[1]
    count, size = min(_GROUPS, level.num_groups), leaves.num_gaussians // level.num_groups
    first = level.leaf_offset[: -1 : level.num_groups // count].tolist()
    asset = Gaussians.concatenate([_device.place(leaves.read(i, i + size), where) for i in first])
    tried = replace(config, first_steps=config.steps_at(1) // 2, min_clusters=1, min_gaussians=1)
    sample, losses = Plan(Plan.of(len(asset), tried).levels[:2]), []
    for filter_px2 in (_FILTER_PX2, 0.0):
        builder = LevelBuilder(sample, replace(tried, filter_px2=filter_px2), seed, codec)
        *_, made = builder.levels(asset)
        losses.append(made.tables.error.mean(axis=0) @ (config.loss_l1, config.loss_alpha))
    return smooth if losses[1] < _NEEDED * losses[0] else config
