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


def chunk_order(means: np.ndarray, chunk_size: int) -> list[int]:
    """Indices by chunks: halve between whole chunks along the longest axis."""
    return _chunked(means, list(range(len(means))), chunk_size)


def _chunked(means: np.ndarray, indices: list[int], chunk_size: int) -> list[int]:
    if len(indices) <= chunk_size:
        return sorted(indices)
    ranked = _ranked(means, indices)
    num_chunks = -(-len(indices) // chunk_size)
    num_left = (num_chunks + 1) // 2 * chunk_size
    left = _chunked(means, ranked[:num_left], chunk_size)
    return left + _chunked(means, ranked[num_left:], chunk_size)


def _halves(means: np.ndarray, indices: list[int]) -> tuple[list[int], list[int]]:
    if not indices:
        return [], []
    ranked = _ranked(means, indices)
    num_left = (len(ranked) + 1) // 2
    return ranked[:num_left], ranked[num_left:]


def _ranked(means: np.ndarray, indices: list[int]) -> list[int]:
    """Indices in order along the longest axis; ties: lower axis, lower index."""
    points = means[indices]
    axis = int(np.argmax(points.max(axis=0) - points.min(axis=0)))  # the first of equals
    return sorted(indices, key=lambda i: (float(means[i, axis]), i))
