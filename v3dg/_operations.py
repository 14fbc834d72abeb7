"""Operations of the core on whichever device their arrays are: NumPy's on the CPU, torch tensors on CUDA.

Offsets are NumPy arrays on the host in any case.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg.gaussians import Array, Gaussians
from v3dg.rasterize import rows_of

Offsets = npt.NDArray[np.int64]


def median_split(means: Array, cluster_size: int) -> tuple[Array, Offsets]:
    """Order points so that each cluster of a perfect binary tree, of at most `cluster_size`, is contiguous.

    Returns:
        The index (N,) int64 at each position, and where the clusters begin (C + 1,).
    """
    count = len(means)
    return split_segments(means, np.array([0, count]), _core.num_halvings(count, cluster_size))


def split_segments(means: Array, offset: Offsets, depth: int) -> tuple[Array, Offsets]:
    """Do the same for each segment of points, all of them halved `depth` times."""
    if isinstance(means, np.ndarray):
        return _core.median_split(means, offset, depth)
    with _stream_of(means) as stream:
        order = _empty_like(means, (len(means),), np.int64)
        return order, _core.median_split_cuda(means, offset, depth, order, stream)


def bound_spheres(spheres: Array, offset: Offsets) -> Array:
    """Bound each segment of spheres (N, 4) by a ball: (S, 4), with the margin that keeps balls nested."""
    if isinstance(spheres, np.ndarray):
        return _core.bound_spheres(spheres, offset)
    with _stream_of(spheres) as stream:
        ball = _empty_like(spheres, (len(offset) - 1, 4))
        _core.bound_spheres_cuda(spheres, offset, ball, stream)
        return ball


def prune(gaussians: Gaussians, in_offset: Offsets, out_offset: Offsets) -> Array:
    """Choose the gaussians of each segment that survive: their rows (M,) int64, ascending."""
    means, scales, opacities = gaussians.means, gaussians.scales, gaussians.opacities
    if isinstance(means, np.ndarray):
        return _core.prune(means, scales, opacities, in_offset, out_offset)
    with _stream_of(means) as stream:
        kept = _empty_like(means, (int(out_offset[-1]),), np.int64)
        _core.prune_cuda(means, scales, opacities, in_offset, out_offset, kept, stream)
        return kept


def merge(gaussians: Gaussians, in_offset: Offsets, out_offset: Offsets) -> Gaussians:
    """Join pairs of gaussians in each segment until as many are left as wanted."""
    rows = rows_of(gaussians)
    if isinstance(rows[0], np.ndarray):
        return Gaussians(*_core.merge(*rows, in_offset, out_offset))
    with _stream_of(rows[0]) as stream:
        merged = [_empty_like(column, (int(out_offset[-1]), *column.shape[1:])) for column in rows]
        arguments: list[Any] = [*rows, in_offset, out_offset, *merged, stream]
        _core.merge_cuda(*arguments)
        return Gaussians(*merged)


def bound_by_boxes(gaussians: Gaussians, offset: Offsets) -> Array:
    """Bound what each cluster draws: (C, 2, 3) lower and upper corner."""
    rows = gaussians.means, gaussians.quats, gaussians.scales
    if isinstance(rows[0], np.ndarray):
        return _core.bound_by_boxes(*rows, offset)
    with _stream_of(rows[0]) as stream:
        box = _empty_like(rows[0], (len(offset) - 1, 2, 3))
        _core.bound_by_boxes_cuda(*rows, offset, box, stream)
        return box


def fit_target(gaussians: Gaussians) -> Any:
    """What `fit_level` takes as its target: on the CPU the gaussians as the core lays them out."""
    return _core.Model(*rows_of(gaussians)) if isinstance(gaussians.means, np.ndarray) else gaussians


def fit_level(
    config: _core.FitConfig,
    target: Any,
    target_filter_px2: float,
    target_compensate: bool,
    target_range: npt.NDArray[np.int64],
    own_range: npt.NDArray[np.int64],
    ball: npt.NDArray[np.float32],
    gaussians: Gaussians,
    error: npt.NDArray[np.float32],
    progress: _core.FitProgress,
) -> None:
    """Fit groups of gaussians, in place, to look like groups of the target inside their balls (G, 4)."""
    stream_of_group = np.arange(len(own_range), dtype=np.int64)  # of random numbers
    look = (target_filter_px2, target_compensate)
    groups = (target_range, own_range, ball, stream_of_group)
    rows = rows_of(gaussians)
    arguments: list[Any] = [*look, *groups, *rows, error, progress]
    if isinstance(rows[0], np.ndarray):
        _core.fit_level(config, target, *arguments)
        return
    with _stream_of(rows[0]) as stream:
        _core.fit_level_cuda(config, *[*rows_of(target), *arguments, stream])


def gather(bundles: list[Gaussians], num_bases: int, **tables: npt.NDArray[Any]) -> Gaussians:
    """Bring clusters of instances into the world (csrc/gather/gather.h), on the device of the bundles."""
    rows = [rows_of(gaussians) for gaussians in bundles]
    if not rows or isinstance(rows[0][0], np.ndarray):
        return Gaussians(*_core.gather(rows, num_bases=num_bases, **tables))
    with _stream_of(rows[0][0]) as stream:
        count = int(tables["offset"][-1])
        means, quats, scales, opacities = (
            _empty_like(rows[0][0], shape) for shape in ((count, 3), (count, 4), (count, 3), (count,))
        )
        gathered = (means, quats, scales, opacities, _empty_like(rows[0][0], (count, num_bases, 3)))
        _core.gather_cuda(rows, num_bases=num_bases, rows=gathered, stream=stream, **tables)
        return Gaussians(*gathered)


@contextmanager
def _stream_of(tensor: Any) -> Iterator[int]:
    """The stream that torch works on, where `tensor` is; its device is the current one meanwhile.

    Too little memory for the results is a MemoryError, as it is for the core's scratch.
    """
    import torch

    with torch.cuda.device(tensor.device), _device.memory_errors():
        yield _device.current_stream()


def _empty_like(tensor: Any, shape: tuple[int, ...], dtype: type[np.generic] = np.float32) -> Any:
    import torch

    return torch.empty(shape, dtype=getattr(torch, dtype.__name__), device=tensor.device)
