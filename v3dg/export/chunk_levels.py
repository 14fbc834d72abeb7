"""Makes the coarser levels of chunks, above the level at which each chunk is a single
group.

The higher levels of a bundle have groups that span several chunks. Viewers choose the
level of each chunk independently, so a part of such a group could be empty, or leave
gaps next to a neighbour at another level. Therefore, each chunk is halved separately,
down to one gaussian. Then any choice of levels is a cut.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._device import CPU
from v3dg.bundle.format import offset_of
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.fit import fit_config, run_fit
from v3dg.levels.plan import Offsets

# With a small budget, viewers draw levels larger than their native size. If levels are
# fitted at four times the area, they are up to 1 dB better there, and no worse at the
# native size.
_PX2_PER_GAUSSIAN = 8.0
_STEPS = 150  # four times as many steps do not improve the result
_LEVEL = 9  # a level of a bundle whose targets have the maximum number of samples
# Number of chunks whose levels are fitted together. Ctrl-C is handled between these
# fits.
_CHUNKS_AT_ONCE = 256


class LevelFilter(NamedTuple):
    """The filter with which a level is drawn, as in `v3dg.bundle.tables`."""

    px2: float
    is_compensated: bool


def num_halvings(num_gaussians: int) -> int:
    """Return how often this many gaussians must be halved until one is left."""
    return max(0, num_gaussians - 1).bit_length()


def halved_levels(chunks: Sequence[Gaussians], drawn: LevelFilter) -> list[list[Gaussians]]:
    """Make more levels of chunks. Each has half as many gaussians as the one before,
    down to one gaussian per chunk.

    The levels are drawn with the filter of a bundle's levels. They are fitted to the
    chunks, drawn with the filter `drawn`.

    Args:
        chunks: The gaussians of C chunks at their coarsest level, at least one each.
        drawn: The filter with which the chunks themselves are drawn.

    Returns:
        Levels, each a list of C chunks. A chunk with one gaussian stays the same in all
        higher levels.
    """
    num_levels = num_halvings(max(map(len, chunks), default=0))
    levels: list[list[Gaussians]] = [[] for _ in range(num_levels)]
    for first in range(0, len(chunks), _CHUNKS_AT_ONCE):
        part = chunks[first : first + _CHUNKS_AT_ONCE]
        for level, halved in zip(levels, _halved(part, num_levels, drawn, first), strict=True):
            level += halved
    return levels


def _halved(
    chunks: Sequence[Gaussians], num_levels: int, drawn: LevelFilter, first_chunk: int
) -> list[list[Gaussians]]:
    """Return `num_levels` further levels of some chunks."""
    if num_levels == 0:
        return []
    finest = Gaussians.concatenate(chunks)
    finest_offset = offset_of(np.array([len(chunk) for chunk in chunks], np.int64))
    starts: list[Gaussians] = []
    start = finest
    offset = finest_offset
    sizes = np.diff(finest_offset)
    all_sizes: list[NDArray[np.int64]] = []
    for _ in range(num_levels):
        sizes = (sizes + 1) // 2
        halved_offset = offset_of(sizes)
        start = Gaussians(*_core.merge(start.rows, offset, halved_offset))
        offset = halved_offset
        starts.append(start)
        all_sizes.append(sizes)
    gaussians = Gaussians.concatenate(starts)
    ends = offset_of(np.concatenate(all_sizes))
    _fit(finest, finest_offset, gaussians, ends, drawn, first_chunk)
    parts = [gaussians.subset(slice(int(a), int(b))) for a, b in itertools.pairwise(ends)]
    firsts = range(0, len(parts), len(chunks))
    return [parts[first : first + len(chunks)] for first in firsts]


def _fit(
    finest: Gaussians,
    finest_offset: Offsets,
    gaussians: Gaussians,
    ends: Offsets,
    drawn: LevelFilter,
    first_chunk: int,
) -> None:
    """Fit all levels of all chunks in place. `ends` has the boundaries of their
    gaussians."""
    num_chunks = len(finest_offset) - 1
    num_levels = (len(ends) - 1) // num_chunks
    config = BuildConfig(px2_per_gaussian=_PX2_PER_GAUSSIAN, steps=_STEPS)
    radius = finest.scales.max(axis=1, keepdims=True)
    ball = _core.bound_spheres(np.concatenate([finest.means, radius], axis=1), finest_offset)
    level = np.arange(num_levels, dtype=np.int64)[:, None]
    chunk = np.arange(first_chunk, first_chunk + num_chunks, dtype=np.int64)
    run_fit(
        lambda progress: _core.fit_level(
            fit_config(config, seed=0, level=_LEVEL),
            _core.FitTarget(finest.rows, drawn.px2, drawn.is_compensated),
            np.tile(_ranges(finest_offset), (num_levels, 1)),
            gaussians.rows,  # the fit overwrites these arrays with its result
            _ranges(ends),
            np.tile(ball, (num_levels, 1)),
            ((level << 40) + chunk).ravel(),
            progress,
        ),
        CPU,
        lambda state: None,
    )


def _ranges(offset: Offsets) -> Offsets:
    """Return (N, 2) the start and the end of each of N parts."""
    return np.stack([offset[:-1], offset[1:]], axis=1)
