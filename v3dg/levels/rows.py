"""The order of the gaussians inside a cluster."""

import numpy as np

from v3dg import _core
from v3dg.gaussians import Gaussians
from v3dg.levels.plan import Offsets

RUN_ROWS = 32
"""Neighbouring gaussians that stand one after another, counted from the first one of a
cluster: as many as a warp of a GPU works on at once."""


def in_runs(gaussians: Gaussians, offset: Offsets) -> Gaussians:
    """Return the gaussians of clusters, with boundaries `offset` (C + 1,), such that
    each run of RUN_ROWS of a cluster is a part of its median split; on the device of
    the gaussians.

    Gaussians that are in this order already keep it.
    """
    largest = int(np.diff(offset).max(initial=0))
    depth = _core.num_halvings(-(-largest // RUN_ROWS), 1)
    if depth == 0:
        return gaussians
    order, _ = _core.median_split(gaussians.means, offset, depth, RUN_ROWS)
    return gaussians.subset(order)
