"""Splits points at medians into the leaves of a perfect binary tree, one point at a
time."""

from __future__ import annotations

import numpy as np


def median_split(means: np.ndarray, cluster_size: int) -> list[list[int]]:
    """Return the indices of each leaf. Sets are halved at the median rank along the
    longest axis; ties go to the lower axis and the lower index."""
    leaves = [list(range(len(means)))]
    while max(len(leaf) for leaf in leaves) > cluster_size:
        leaves = [half for leaf in leaves for half in _halves(means, leaf, 1)]
    return [sorted(leaf) for leaf in leaves]


def runs(means: np.ndarray, unit: int) -> list[list[int]]:
    """Return the indices of each run. Sets are halved at ranks that are multiples of
    `unit`, until no part has more points than that."""
    parts = [list(range(len(means)))]
    while max(len(part) for part in parts) > unit:
        parts = [half for part in parts for half in _halves(means, part, unit)]
    return [sorted(part) for part in parts if part]


def _halves(means: np.ndarray, indices: list[int], unit: int) -> tuple[list[int], list[int]]:
    if not indices:
        return [], []
    points = means[indices]
    # the lowest of equally long axes
    axis = int(np.argmax(points.max(axis=0) - points.min(axis=0)))
    ranked = sorted(indices, key=lambda i: (float(means[i, axis]), i))
    num_units = -(-len(ranked) // unit)
    num_left = (num_units + 1) // 2 * unit
    return ranked[:num_left], ranked[num_left:]
