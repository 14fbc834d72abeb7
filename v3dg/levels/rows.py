"""Defines the order of the gaussians inside a cluster."""

import numpy as np

from v3dg import _core
from v3dg.gaussians import Gaussians
from v3dg.levels.plan import Offsets

RUN_ROWS = 32
"""Number of gaussians in a run. They are close together in space, and a warp of a GPU
processes them at once."""


def in_runs(gaussians: Gaussians, offset: Offsets) -> Gaussians:
    """Order the gaussians of each cluster such that each run of RUN_ROWS gaussians is a
    part of the cluster's median split.

    Gaussians that already have this order keep it.

    Args:
        offset: (C + 1,) boundaries of the clusters' gaussians.

    Returns:
        The gaussians on their device, in the new order.
    """
    largest = int(np.diff(offset).max(initial=0))
    depth = _core.num_halvings(-(-largest // RUN_ROWS), 1)
    if depth == 0:
        return gaussians
    order, _ = _core.median_split(gaussians.means, offset, depth, RUN_ROWS)
    return gaussians.subset(order)
