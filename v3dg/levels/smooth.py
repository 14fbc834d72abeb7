"""Measures whether the coarser levels of an asset need a filter. The gaussians of a
smooth asset are about as wide as the distances between them, so it needs none. A faint
asset would lose alpha with a filter."""

from dataclasses import replace

import numpy as np

from v3dg import _device
from v3dg._device import Device
from v3dg.bundle.codec import Codec
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.leaves import Leaves
from v3dg.levels.plan import Plan
from v3dg.levels.simplify import LevelBuilder

# Opacities below this are faint. A filter reduces the opacity of such gaussians, so
# that much of them falls below 1/255, the smallest alpha that is drawn.
_FAINT_OPACITY = 0.1
# Number of groups of level 1 that are fitted twice: with a filter of this variance, and
# without a filter.
_GROUPS = 32
_FILTER_PX2 = 0.05
# Maximum number of leaves of a group that is fitted twice, because fitting larger
# groups would take too long.
_MOST_LEAVES = 1 << 15
# An asset needs the filter if its loss without the filter is at least this many times
# as large (docs/levels.md).
_NEEDED = 1.4


def measured_config(
    config: BuildConfig, plan: Plan, leaves: Leaves, seed: int, codec: Codec, device: Device
) -> BuildConfig:
    """Return the config for building the levels. "measured" becomes "yes" if the asset
    is smooth, and a faint asset gets no filter."""
    smooth = replace(config, smooth="yes", filter_px2=0.0)
    if config.smooth == "yes":
        return smooth
    is_fitted = config.steps_at(1) > 0 and config.filter_px2 > 0 and len(plan.levels) > 1
    if config.smooth == "no" or not is_fitted:
        return config
    level_1 = plan.levels[1]
    size = leaves.num_gaussians // level_1.num_groups
    if size > _MOST_LEAVES:
        return config
    stride = level_1.num_groups // min(_GROUPS, level_1.num_groups)
    first_leaves = level_1.leaf_offset[stride // 2 : -1 : stride].tolist()
    parts = [_device.place(leaves.read(first, first + size), device) for first in first_leaves]
    sample = Gaussians.concatenate(parts)
    if is_faint(sample):
        return replace(config, filter_px2=0.0)
    # The sample consists of the groups that were read. Each is divided into two
    # clusters, whatever the group size of the build.
    sample_config = replace(
        config,
        init="merge",
        cluster_size=max(2, -(-size // 2)),
        group_size=2,
        min_clusters=1,
        min_gaussians=1,
        first_steps=max(1, config.steps_at(1) // 2),
    )
    sample_plan = Plan(Plan.of(len(sample), sample_config).levels[:2])
    losses = []
    for px2 in (_FILTER_PX2, 0.0):
        builder = LevelBuilder(sample_plan, replace(sample_config, filter_px2=px2), seed, codec)
        *_, fitted = builder.levels(sample)
        losses.append(fitted.tables.error.mean(axis=0) @ (config.loss_l1, config.loss_alpha))
    if losses[1] < _NEEDED * losses[0]:
        return smooth
    return config


def is_faint(gaussians: Gaussians) -> bool:
    """Return whether most of the area belongs to faint gaussians.

    The area is weighted by opacity.
    """
    host = gaussians.numpy()
    scales = np.sort(host.scales.astype(np.float64), axis=1)
    weight = scales[:, 1] * scales[:, 2] * host.opacities
    return bool(weight[host.opacities < _FAINT_OPACITY].sum() > weight.sum() / 2)
