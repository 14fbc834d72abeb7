"""Few values for many: tables of 256 numbers, and palettes of vectors."""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from v3dg.formats._packing import Floats, blocks

_TABLE = 256
_BINS = 4096
_ROUNDS = 16
# Of the table's entries, the share that is spread evenly over the range: rare values keep a neighbour.
_EVEN = 0.25


def table_of(values: Floats) -> Floats:
    """256 ascending numbers near the values, by Lloyd's algorithm.

    Where there are no more than 256 different values, these are the table.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    if not len(ordered):
        return np.zeros(_TABLE)
    distinct = ordered[np.flatnonzero(np.diff(ordered, prepend=-np.inf))][: _TABLE + 1]
    if len(distinct) <= _TABLE:
        return np.concatenate([distinct, np.full(_TABLE - len(distinct), distinct[-1])])
    table = _first_guess(ordered)
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        edges = np.concatenate([[0], np.searchsorted(ordered, _middles(table)), [len(ordered)]])
        counts = np.diff(edges)
        means = np.diff(sums[edges]) / np.maximum(counts, 1)
        table = np.sort(np.where(counts > 0, means, table))
    return table


def nearest(table: Floats, values: Floats) -> NDArray[np.uint8]:
    """Index of the entry of an ascending table that is nearest to each value."""
    return np.searchsorted(_middles(table), values).astype(np.uint8)


def _middles(table: Floats) -> Floats:
    return np.asarray((table[1:] + table[:-1]) / 2)


def _first_guess(ordered: Floats) -> Floats:
    """Entries as dense as the cube root of the values' density: best for many entries (Panter and Dite)."""
    counts, edges = np.histogram(ordered, _BINS)
    density = np.cbrt(counts)
    weight = (1 - _EVEN) * density / density.sum() + _EVEN / _BINS
    share = np.concatenate([[0.0], np.cumsum(weight)])
    return np.asarray(np.interp((np.arange(_TABLE) + 0.5) / _TABLE, share, edges))


def palette_of(vectors: Floats, size: int) -> tuple[Floats, NDArray[np.uint32]]:
    """At most `size` vectors (K, D) that stand for many (N, D), and which of them for each (N,).

    The set with the largest squared error is cut in two, at its mean along its widest axis, until there are
    enough sets or all are exact: no search for the nearest of tens of thousands is needed, so it takes
    N D log K steps, and the same input gives the same palette.
    """
    rows = np.arange(len(vectors))
    heap = [(-_spread(vectors).sum(), 0, rows)] if len(rows) else []
    number = 0
    while heap and len(heap) < size and heap[0][0] < 0:
        _, _, rows = heapq.heappop(heap)
        chosen = vectors[rows]
        axis = int(_spread(chosen).argmax())
        column = chosen[:, axis]
        above = column > column.mean(dtype=np.float64)
        if above.all() or not above.any():  # differences that rounding hides
            above = np.arange(len(rows)) < len(rows) // 2
        for part in (rows[~above], rows[above]):
            number += 1
            heapq.heappush(heap, (-_spread(vectors[part]).sum(), number, part))
    palette = np.zeros((max(1, len(heap)), vectors.shape[1]))
    labels = np.zeros(len(vectors), np.uint32)
    for entry, (_, _, rows) in enumerate(sorted(heap, key=lambda item: item[2][0])):
        palette[entry] = vectors[rows].mean(axis=0, dtype=np.float64)
        labels[rows] = entry
    return palette, labels


def _spread(vectors: Floats) -> Floats:
    """(D,) squared distances to the mean, summed; 0 for one vector."""
    mean = vectors.mean(axis=0, dtype=np.float64)
    total = np.zeros(vectors.shape[1])
    for block in blocks(len(vectors)):
        total += np.square(vectors[block] - mean).sum(axis=0)
    return total
