"""The median split of more points than fit in memory.

A node that does not fit in memory is split in four passes over its points. The first
finds the longest side of its box. The next two find the median along that axis: one the
upper half of its bits, one the lower half. The last pass moves the points.
"""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.levels.scratch import RowFile

Points = npt.NDArray[np.uint32]
"""(N, 4): the bits of the float32 coordinates x, y and z, and the index of the
point."""

Words = npt.NDArray[np.uint32]
WordFile = RowFile[np.uint32]

FITTING_BYTES = 48
"""Bytes per point of a node that is split in memory."""

# points that are read at a time; this uses 16 MB, with intermediate arrays
_AT_ONCE = 1 << 18


def points_of(means: npt.NDArray[np.float32], index: npt.NDArray[np.integer]) -> Points:
    return np.column_stack([means.view(np.uint32), index.astype(np.uint32)])


def split(
    files: tuple[WordFile, WordFile], count: int, depth: int, num_fitting: int, order: WordFile
) -> None:
    """Write the indices of points to `order`, in the same order as
    `_core.median_split`, bit for bit.

    The first `count` rows of the first file are the points; they must be finite and in
    ascending order of their indices. The second file holds temporary data.
    """
    todo = [(0, count, depth, 0)]
    while todo:
        first, last, left, number = todo.pop()
        file = files[number]
        if left > 0 and last - first > num_fitting:
            middle = first + (last - first + 1) // 2
            _partition(file, first, middle, last, files[1 - number])
            todo += [(first, middle, left - 1, 1 - number), (middle, last, left - 1, 1 - number)]
        elif left > 0:
            order.write(first, _split_in_memory(file.read(first, last), left))
        else:
            for start in range(first, last, _AT_ONCE):
                order.write(start, file.read(start, min(start + _AT_ONCE, last))[:, 3])


def _split_in_memory(points: Points, depth: int) -> Words:
    index = points[:, 3].copy()
    means = np.ascontiguousarray(points[:, :3]).view(np.float32)
    del points
    order, _ = _core.median_split(means, np.array([0, len(means)]), depth)
    return np.asarray(index[order])


def _partition(source: WordFile, first: int, middle: int, last: int, target: WordFile) -> None:
    """Write the lower half of a node from position `first` on, and the upper half from
    position `middle` on. Both keep their order."""
    axis = _longest_axis(source, first, last)
    median, num_ties = _median(source, first, middle, last, axis)
    ends = [first, middle]
    for points in source.blocks(first, last, _AT_ONCE):
        key = _ordered(points[:, axis])
        is_left = key < median
        ties = np.flatnonzero(key == median)[:num_ties]
        num_ties -= len(ties)
        is_left[ties] = True
        for side, half in enumerate((points[is_left], points[~is_left])):
            target.write(ends[side], half)
            ends[side] += len(half)


def _longest_axis(source: WordFile, first: int, last: int) -> int:
    low = np.full(3, np.inf, np.float32)
    high = np.full(3, -np.inf, np.float32)
    for points in source.blocks(first, last, _AT_ONCE):
        means = points[:, :3].view(np.float32)
        low = np.minimum(low, means.min(axis=0))
        high = np.maximum(high, means.max(axis=0))
    # Like the core, compare lengths as float32, and take the first of equal sides.
    return int(np.argmax(high - low))


def _median(source: WordFile, first: int, middle: int, last: int, axis: int) -> tuple[int, int]:
    """Return the largest key of the lower half, as numbered by `_ordered`, and how many
    points of the lower half have this key."""

    def keys() -> Iterator[Words]:
        return (_ordered(points[:, axis]) for points in source.blocks(first, last, _AT_ONCE))

    half = np.uint32(16)
    upper, left = _bin_of(middle - first, (key >> half for key in keys()))
    lower, left = _bin_of(left, (key[key >> half == upper] & np.uint32(0xFFFF) for key in keys()))
    return upper << 16 | lower, left


def _bin_of(rank: int, values: Iterator[Words]) -> tuple[int, int]:
    """Return the 16-bit value with a given rank (from 1) in ascending order, and its
    rank among the equal values."""
    counts = np.zeros(1 << 16, np.int64)
    for block in values:
        counts += np.bincount(block, minlength=1 << 16)
    ends = np.cumsum(counts)
    value = int(np.searchsorted(ends, rank))
    return value, rank - int(ends[value] - counts[value])


def _ordered(bits: Words) -> Words:
    """Return integers that have the same order as the floats with these bits. Zeros of
    both signs are equal."""
    bits = (bits.view(np.float32) + np.float32(0)).view(np.uint32)
    sign = bits >> 31
    return np.asarray(bits ^ ((np.uint32(0) - sign) | np.uint32(1 << 31)))
