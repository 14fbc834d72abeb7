"""Boxes around the drawn extents of gaussians."""

from __future__ import annotations

import numpy as np

from . import project

# sqrt(2 ln 255), the distance at which the alpha of an opaque gaussian falls below
# 1/255
REACH_SIGMAS = 3.33


def bound_by_boxes(means: np.ndarray, quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return (2, 3) the lower and upper corner of all boxes, without a margin for
    rounding."""
    axes = project.rotation(quats) * scales[:, None, :].astype(np.float64)
    reach = REACH_SIGMAS * np.sqrt((axes**2).sum(axis=2))
    return np.stack([(means - reach).min(axis=0), (means + reach).max(axis=0)])
