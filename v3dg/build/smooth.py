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

# Groups of level 1 that are fitted with a filter and without it, the filter, and the most leaves of one; and
# how much larger the loss of an asset that needs the filter is without it (docs/levels.md).
_GROUPS, _FILTER_PX2, _MOST_LEAVES, _NEEDED = 32, 0.05, 1 << 15, 1.4


def measured_config(
    config: BuildConfig, plan: Plan, leaves: Leaves, seed: int, codec: Codec, where: Device
) -> BuildConfig:
    """The config with which levels are built: what it leaves to a measurement is measured."""
    smooth, steps = replace(config, smooth="yes", filter_px2=0.0), config.steps_at(1)
    level = plan.levels[:2][-1]
    count, size = min(_GROUPS, level.num_groups), leaves.num_gaussians // level.num_groups
    is_fitted = steps > 0 and config.filter_px2 > 0 and len(plan.levels) > 1
    if config.smooth != "measured" or not is_fitted or size > _MOST_LEAVES:
        return smooth if config.smooth == "yes" else config
    stride = level.num_groups // count
    first = level.leaf_offset[stride // 2 : -1 : stride].tolist()
    asset = Gaussians.concatenate([_device.place(leaves.read(i, i + size), where) for i in first])
    # As many groups again, of two clusters, whatever those of the build have.
    tried = replace(config, init="merge", cluster_size=max(2, -(-size // 2)), group_size=2)
    tried = replace(tried, min_clusters=1, min_gaussians=1, first_steps=max(1, steps // 2))
    sample, losses = Plan(Plan.of(len(asset), tried).levels[:2]), []
    for px2 in (_FILTER_PX2, 0.0):
        *_, made = LevelBuilder(sample, replace(tried, filter_px2=px2), seed, codec).levels(asset)
        losses.append(made.tables.error.mean(axis=0) @ (config.loss_l1, config.loss_alpha))
    return smooth if losses[1] < _NEEDED * losses[0] else config
