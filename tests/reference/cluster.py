"""Median split of points into the leaves of a perfect binary tree, one point at a
time."""

from __future__ import annotations

import numpy as np


def median_split(means: np.ndarray, cluster_size: int) -> list[list[int]]:
    """Indices of each leaf: halve at the median rank of the longest axis; ties: lower
    axis, lower index."""
    leaves = [list(range(len(means)))]
    while max(len(leaf) for leaf in leaves) > cluster_size:
        leaves = [half for leaf in leaves for half in _halves(means, leaf)]
    return [sorted(leaf) for leaf in leaves]


def _halves(means: np.ndarray, indices: list[int]) -> tuple[list[int], list[int]]:
    if not indices:
        return [], []
    points = means[indices]
    axis = int(np.argmax(points.max(axis=0) - points.min(axis=0)))  # the first of equals
    ranked = sorted(indices, key=lambda i: (float(means[i, axis]), i))
    num_left = (len(ranked) + 1) // 2
    return ranked[:num_left], ranked[num_left:]
