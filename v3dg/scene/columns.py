"""The columns of a scene's instances: checks of shapes, ranges and devices, and
conversions of poses."""

from collections.abc import Sequence
from typing import NamedTuple, cast

import numpy as np
import numpy.typing as npt

from v3dg import _device
from v3dg._numbers import LEAST_FLOAT, MOST_FLOAT, check, floats, one_of
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis
from v3dg.gaussians import Array
from v3dg.rotations import (
    Similarity,
    product,
    product_matrix,
    rotation_from_quaternion,
    similarity_of,
    turn_between,
)


class Columns(NamedTuple):
    """Checked columns of new instances."""

    positions: Array
    quaternions: Array
    scales: Array
    importance: npt.NDArray[np.float32]
    opacity: npt.NDArray[np.float32]
    tint: npt.NDArray[np.float32]
    environments: npt.NDArray[np.int32]
    labels: npt.NDArray[np.int32]


UNLABELLED = -1
MOST_LABEL = (1 << 31) - 1
SHARED = -1  # the environment of instances that all cameras see
MOST_ENVIRONMENT = (1 << 24) - 1
_ROW = {
    "positions": (3,),
    "quaternions": (4,),
    "scales": (),
    "importance": (),
    "opacity": (),
    "tint": (3,),
}
# Columns that are always on the host, as float32, even if poses are on a device.
_ON_HOST = ("importance", "opacity", "tint")
_DEFAULTS: dict[str, Array] = {"quaternions": (1.0, 0.0, 0.0, 0.0), "scales": 1.0}
_RANGES = {
    "scales": (5e-324, np.inf, "positive numbers"),
    "importance": (LEAST_FLOAT, MOST_FLOAT, "positive numbers that a float32 can hold"),
    "opacity": (0.0, 1.0, "numbers from 0 to 1"),
    "tint": (0.0, MOST_FLOAT, "numbers of at least 0 that a float32 can hold"),
}


def columns_of(
    positions: Array | npt.ArrayLike | None,
    quaternions: Array | npt.ArrayLike | None,
    scales: Array | npt.ArrayLike | None,
    *,
    importance: npt.ArrayLike,
    opacity: npt.ArrayLike,
    tint: npt.ArrayLike,
    environment: npt.ArrayLike,
    label: npt.ArrayLike,
) -> Columns:
    """Return checked columns. The number of positions is the number of instances."""
    points = _points_of(positions)
    count = len(points)
    return Columns(
        positions=column(points, "positions", count),
        quaternions=column(quaternions, "quaternions", count),
        scales=column(scales, "scales", count),
        importance=column(importance, "importance", count),
        opacity=column(opacity, "opacity", count),
        tint=column(tint, "tint", count),
        environments=environment_column(environment, count),
        labels=label_column(label, count),
    )


def composed(outer: Columns, inner: Columns) -> Columns:
    """Return the columns of instances after placing all of them together with one outer
    pose."""
    size = outer.scales[0]
    rotation = rotation_from_quaternion(outer.quaternions[0])
    # `columns_of` rejects invalid results.
    with np.errstate(over="ignore", under="ignore"):
        return columns_of(
            positions=size * inner.positions @ rotation.T + outer.positions,
            quaternions=product(outer.quaternions, inner.quaternions),
            scales=size * inner.scales,
            importance=outer.importance * inner.importance,
            opacity=outer.opacity * inner.opacity,
            tint=outer.tint * inner.tint,
            environment=np.where(outer.environments < 0, inner.environments, outer.environments),
            label=np.where(outer.labels < 0, inner.labels, outer.labels),
        )


def _points_of(positions: Array | npt.ArrayLike | None) -> Array:
    """Return positions (I, 3). A single position may be (3,). None means the origin."""
    points: Array = positions
    if positions is None:
        points = (0.0, 0.0, 0.0)
    if not getattr(points, "is_cuda", False):
        points = floats(points, "positions")
    if len(points.shape) == 1:
        points = points[None]
    shape = tuple(points.shape)
    check("positions", shape[1:] == (3,), f"shape (I, 3), got {shape}")
    return points


def parts_of(matrix: Array | npt.ArrayLike, *parts: Array | npt.ArrayLike | None) -> Similarity:
    """Return the positions, quaternions and scales of matrices. Raise ValueError if any
    of these is also passed."""
    if any(part is not None for part in parts):
        raise ValueError(
            "matrix: cannot be combined with positions, quaternions or scales; pass only one of "
            "them"
        )
    return similarity_of(matrix)


def turned(quaternions: Array, bundles: Sequence[Bundle], up: Axis) -> Array:
    """Return the rotations (I, 4) of instances after rotating the up axis of their
    bundles to another axis. `bundles` has one bundle for all instances, or I."""
    one_of(up, "up", AXES)
    turns = {bundle: turn_between(up_of_bundle(bundle), up) for bundle in set(bundles)}
    matrices = product_matrix(np.array([turns[bundle] for bundle in bundles]).reshape(-1, 4))
    return (quaternions[:, None, :] @ on_device_of(quaternions, matrices))[:, 0]


def up_of_bundle(bundle: Bundle) -> Axis:
    """Return the axis of a bundle that points up. If its file does not declare one, it
    is -y, as in most trained assets."""
    recorded = bundle.config.get("up")
    if recorded in AXES:
        return cast(Axis, recorded)
    return "-y"


def column(values: Array | None, name: str, count: int) -> Array:
    """Return a contiguous copy (count, ...) of a column. If `values` is None, return
    its default. Except for positions, a single row applies to all instances."""
    source: Array = values
    if values is None:
        source = _DEFAULTS.get(name)
    row = _ROW[name]
    is_on_device = getattr(source, "is_cuda", False) and name not in _ON_HOST
    if is_on_device:
        import torch

        array = source.detach().to(torch.float64, copy=True)
    else:
        array = floats(source, name)
    if name != "positions" and tuple(array.shape) == row:
        if is_on_device:
            array = array.expand(count, *row)
        else:
            array = np.broadcast_to(array, (count, *row))
    shape = tuple(array.shape)
    check(name, shape == (count, *row), f"shape {(count, *row)}, got {shape}")
    if is_on_device:
        return array.contiguous()
    if name in _RANGES:
        low, high, expected = _RANGES[name]
        wrong = (array < low) | (array > high)
        if wrong.any():
            raise ValueError(f"{name}: expected {expected}, got {array[wrong][0]:g}")
    if name == "quaternions":
        largest = np.abs(array).max(axis=1, keepdims=True)
        check("quaternions", largest.all(), "a nonzero quaternion, got zeros")
        array = array / largest  # prevents overflow and underflow of squares
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    if name in _ON_HOST:
        return np.ascontiguousarray(array, np.float32)
    return np.ascontiguousarray(array, np.float64)


def environment_column(values: npt.ArrayLike, count: int) -> npt.NDArray[np.int32]:
    """Return the environments (count,) of instances.

    A single number applies to all of them.
    """
    return _whole_column(values, "environment", count, SHARED, MOST_ENVIRONMENT)


def label_column(values: npt.ArrayLike, count: int) -> npt.NDArray[np.int32]:
    """Return the labels (count,) of instances.

    A single number applies to all of them.
    """
    return _whole_column(values, "label", count, UNLABELLED, MOST_LABEL)


def _whole_column(
    values: npt.ArrayLike, name: str, count: int, low: int, high: int
) -> npt.NDArray[np.int32]:
    array = np.asarray(values)
    expected = f"whole numbers, one for all or {count}"
    fits = array.dtype.kind in "iu" and array.shape in ((), (count,))
    check(name, fits, f"{expected}, got {array.dtype} of shape {array.shape}")
    wrong = (array < low) | (array > high)
    if wrong.any():
        raise ValueError(f"{name}: expected {low} to {high}, got {array[wrong][0]}")
    return np.array(np.broadcast_to(array, count), np.int32)


def on_device_of(array: Array, values: Array) -> Array:
    """Return the values as a tensor on the device of ``array``. If ``array`` is a NumPy
    array, return them unchanged."""
    if isinstance(array, np.ndarray):
        return values
    import torch

    if isinstance(values, np.ndarray):
        values = np.array(values)  # copied, because torch warns about read-only arrays
    return torch.as_tensor(values, device=array.device)


def _on_one_device(first: Array, second: Array) -> tuple[Array, Array]:
    """If one of two arrays is a tensor, return both on its device. If both are NumPy
    arrays, return both on the host."""
    target = first
    if isinstance(first, np.ndarray):
        target = second
    return on_device_of(target, first), on_device_of(target, second)


def joined(first: Array, second: Array) -> Array:
    """Return the concatenation of two arrays. If either of them is on a device, the
    result is on it."""
    first, second = _on_one_device(first, second)
    return _device.library_of(first).concatenate([first, second])


def replaced(values: Array, rows: Array, row_values: Array) -> Array:
    """Return a copy of an array in which some rows are replaced."""
    values, row_values = _on_one_device(values, row_values)
    if isinstance(values, np.ndarray):
        values = values.copy()
    elif getattr(rows, "is_cuda", False):
        return _replaced_on_device(values, rows, row_values)
    else:
        values = values.clone()
    values[on_device_of(values, rows)] = row_values
    return values


def _replaced_on_device(values: Array, rows: Array, row_values: Array) -> Array:
    """Do the work of `replaced` without waiting for the device. Rows that do not exist
    are ignored, by writing them to an extra last row."""
    import torch

    count = len(values)
    exists = (rows >= 0) & (rows < count)
    padded = torch.cat([values, values.new_zeros((1, *values.shape[1:]))])
    padded.index_copy_(0, torch.where(exists, rows, count).to(torch.int64), row_values)
    return padded[:count]
