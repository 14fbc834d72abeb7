"""Scenes: bundles placed many times by similarity transforms."""

import os
import threading
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from v3dg import _device
from v3dg._numbers import LEAST_FLOAT, MOST_FLOAT, Floats, check, check_type, floats, one_of
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis, Camera
from v3dg.gaussians import Array, Gaussians
from v3dg.rotations import normalised, rotation_from_quaternion

# Held during every change of a scene. Also held during fork(), so that it is never
# locked in the child.
_lock = threading.RLock()
os.register_at_fork(
    before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release
)


class _State(NamedTuple):
    """A scene at one moment. It is immutable: a change replaces it by another."""

    bundles: tuple[Bundle, ...]
    bundle: npt.NDArray[np.int32]
    importance: npt.NDArray[np.float32]
    positions: Array  # poses are NumPy arrays, or tensors on a CUDA device
    quaternions: Array
    scales: Array
    revision: tuple[int, int, int]


class Scene:
    """Instances of bundles: each bundle is stored once, and an instance maps p to scale
    * rotation p + position.

    Instances are numbered from 0 in the order in which they were added; `remove` closes
    the gaps. Changes are visible in the next picture. Any thread may change a scene and
    draw it: each change is atomic. A copy has the same bundles, and later changes of
    one do not affect the other.

    Poses may be NumPy arrays, or torch tensors on the host or on a CUDA device. Those
    on a device stay there and their values are not checked: an instance whose pose is
    not finite, or whose scale is not positive, is not drawn.
    """

    _up: Axis | None = None

    def __init__(self) -> None:
        empty = _State(
            bundles=(),
            bundle=np.zeros(0, np.int32),
            importance=np.zeros(0, np.float32),
            positions=np.zeros((0, 3)),
            quaternions=np.zeros((0, 4)),
            scales=np.zeros(0),
            revision=(0, 0, 0),
        )
        self._state = _read_only(empty)

    def __setstate__(self, state: dict[str, object]) -> None:
        self.__dict__.update(state)
        self._state = _read_only(self._state)  # unpickled arrays are writable

    @classmethod
    def of(cls, subject: "Scene | Bundle") -> "Scene":
        """Return a scene as it is, and a bundle as a scene of one instance at the
        origin."""
        if isinstance(subject, Scene):
            return subject
        check_type("subject", subject, Bundle, "a Scene or a Bundle")
        scene = cls()
        scene.add(subject)
        return scene

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Scene":
        """Read a scene without its cameras; the same as `v3dg.read_scene(path)[0]`."""
        from v3dg.scene.file import read_scene

        return read_scene(path)[0]

    def save(
        self, path: str | os.PathLike[str], cameras: Mapping[str, Camera] | None = None
    ) -> None:
        """Write the scene; the same as `v3dg.write_scene(path, self,
        cameras=cameras)`."""
        from v3dg.scene.file import write_scene

        write_scene(path, self, cameras=cameras)

    def add(
        self,
        bundle: Bundle | str | os.PathLike[str] | Sequence[Bundle],
        positions: Array | npt.ArrayLike = (0.0, 0.0, 0.0),
        quaternions: Array | npt.ArrayLike | None = None,
        scales: Array | npt.ArrayLike | None = None,
        importance: npt.ArrayLike = 1.0,
    ) -> range:
        """Place a bundle I times and return the ids of the new instances.

        Args:
            bundle: One for all, also by its file, or a sequence of I.
            positions: (I, 3), or (3,) for one instance; world units.
            quaternions: (I, 4) or (4,) w x y z of any length but zero; no rotation if
                None.
            scales: (I,) or one number for all, > 0; 1 if None.
            importance: (I,) or one number for all, > 0. An instance of importance 4 is
                drawn as if the tolerance were a quarter.

        Raises:
            TypeError: ``bundle`` is not a bundle.
            ValueError: A shape or a value is not as above.
        """
        bundles = _bundles_of(bundle)
        points: Array = positions
        if not getattr(points, "is_cuda", False):
            points = floats(points, "positions")
        if len(points.shape) == 1:
            points = points[None]
        shape = tuple(points.shape)
        check("positions", shape[1:] == (3,), f"shape (I, 3), got {shape}")
        count = shape[0]
        if isinstance(bundle, list | tuple):
            check("bundle", len(bundles) == count, f"one for all or {count}, got {len(bundles)}")
        position_rows = _rows(points, "positions", count)
        quaternion_rows = _rows(quaternions, "quaternions", count)
        scale_rows = _rows(scales, "scales", count)
        importance_rows = _rows(importance, "importance", count)
        with _lock:
            state = self._state
            distinct = dict.fromkeys((*state.bundles, *bundles))
            number_of = {item: number for number, item in enumerate(distinct)}
            numbers = np.array([number_of[item] for item in bundles], np.int32)
            first = len(self)
            state = state._replace(
                bundles=tuple(number_of),
                bundle=np.concatenate([state.bundle, np.broadcast_to(numbers, count)]),
                positions=_joined(state.positions, position_rows),
                quaternions=_joined(state.quaternions, quaternion_rows),
                scales=_joined(state.scales, scale_rows),
                importance=_joined(state.importance, importance_rows),
            )
            self._publish(state, changes=1)
        return range(first, first + count)

    def remove(self, ids: Array | npt.ArrayLike) -> None:
        """Remove instances; the ids of those that follow decrease, as in
        `numpy.delete`."""
        with _lock:
            state = self._state
            is_left = np.ones(len(self), bool)
            is_left[self._ids(ids)] = False
            state = state._replace(
                bundle=state.bundle[is_left],
                importance=state.importance[is_left],
                positions=state.positions[_on_device_of(state.positions, is_left)],
                quaternions=state.quaternions[_on_device_of(state.quaternions, is_left)],
                scales=state.scales[_on_device_of(state.scales, is_left)],
            )
            self._publish(state, changes=1, removals=int(not is_left.all()))

    def move(
        self,
        ids: Array | npt.ArrayLike | None = None,
        *,
        positions: Array | npt.ArrayLike | None = None,
        quaternions: Array | npt.ArrayLike | None = None,
        scales: Array | npt.ArrayLike | None = None,
    ) -> None:
        """Give instances new poses; a part that is None does not change.

        Args:
            ids: (M,) which instances; all if None.
            positions: (M, 3).
            quaternions: (M, 4) or (4,) for all of them.
            scales: (M,) or one number for all of them.

        Raises:
            IndexError: There is no such instance.
            ValueError: A shape or a value is not as in `add`.
        """
        parts = {"positions": positions, "quaternions": quaternions, "scales": scales}
        with _lock:
            rows = self._ids(ids)
            state = self._state
            for name, part in parts.items():
                if part is None:
                    continue
                values = _rows(part, name, len(rows))
                if ids is not None:
                    values = _replaced(getattr(state, name), rows, values)
                state = state._replace(**{name: values})
            self._publish(state, moves=1)

    def set_importance(
        self, importance: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None
    ) -> None:
        """Give instances another importance, as in `add`; all of them if ``ids`` is
        None."""
        with _lock:
            rows = self._ids(ids)
            values = _rows(importance, "importance", len(rows))
            state = self._state._replace(importance=_replaced(self.importance, rows, values))
            self._publish(state, changes=1)

    def _publish(self, state: _State, changes: int = 0, moves: int = 0, removals: int = 0) -> None:
        """Replace the state in one step and count the revision up; the lock must be
        held."""
        num_changes, num_moves, num_removals = self.revision
        revision = (num_changes + changes, num_moves + moves, num_removals + removals)
        self._state = _read_only(state._replace(revision=revision))

    @property
    def up(self) -> Axis | None:
        """The axis that is up; None if it is not known, so that viewers and exports may
        guess it."""
        return self._up

    @up.setter
    def up(self, axis: Axis | None) -> None:
        if axis is not None:
            one_of(axis, "up", AXES)
        self._up = axis

    @property
    def bundles(self) -> tuple[Bundle, ...]:
        """The bundles, in the order in which they were first added."""
        return self._state.bundles

    @property
    def revision(self) -> tuple[int, int, int]:
        """Numbers of changes so far: instances added, removed or given another
        importance; moves; removals.

        A program that caches something of the scene compares them to find out when it
        is stale.
        """
        return self._state.revision

    @property
    def instance_bundle(self) -> npt.NDArray[np.int32]:
        """(I,) int32, the number of each instance's bundle; read-only."""
        return self._state.bundle

    @property
    def importance(self) -> npt.NDArray[np.float32]:
        """(I,) float32; read-only."""
        return self._state.importance

    @property
    def positions(self) -> Floats:
        """(I, 3) float64, world units; a copy if they are on a device. Use `move` to
        change them."""
        return _device.to_host(self._state.positions)

    @property
    def quaternions(self) -> Floats:
        """(I, 4) float64, w x y z, unit length."""
        rows = self._state.quaternions
        if isinstance(rows, np.ndarray):
            return rows
        quaternions = normalised(_device.to_host(rows))
        # An instance with a zero quaternion is not drawn.
        quaternions[~quaternions.any(axis=1)] = np.nan
        return quaternions

    @property
    def scales(self) -> Floats:
        """(I,) float64."""
        return _device.to_host(self._state.scales)

    @property
    def rotations(self) -> Floats:
        """(I, 3, 3) float64, of the quaternions."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def poses(self) -> tuple[Array, Array, Array]:
        """Positions, quaternions and scales, not copied: NumPy arrays, or tensors on a
        CUDA device."""
        state = self._state
        return state.positions, state.quaternions, state.scales

    def _ids(self, ids: Array | None) -> npt.NDArray[np.int64]:
        """Checked ids of instances; those of all instances for None."""
        count = len(self)
        if ids is None:
            return np.arange(count)
        if hasattr(ids, "detach"):
            ids = ids.numpy(force=True)
        rows = np.atleast_1d(np.asarray(ids))
        if rows.size == 0:
            return np.zeros(0, np.int64)
        fits = rows.ndim == 1 and np.issubdtype(rows.dtype, np.integer)
        check("ids", fits, f"whole numbers (M,), got {rows.dtype} of shape {rows.shape}")
        wrong = (rows < 0) | (rows >= count)
        if wrong.any():
            raise IndexError(f"ids: expected 0 to {count - 1}, got {rows[wrong][0]}")
        return rows.astype(np.int64)

    def __len__(self) -> int:
        return len(self._state.bundle)

    def __repr__(self) -> str:
        num_bundles = len(self.bundles)
        instances = f"{len(self)} instance{'s' * (len(self) != 1)}"
        return f"Scene({instances} of {num_bundles} bundle{'s' * (num_bundles != 1)})"


Subject: TypeAlias = Scene | Bundle | Gaussians
"""A value that can be drawn."""

_ROW = {"positions": (3,), "quaternions": (4,), "scales": (), "importance": ()}
_DEFAULTS: dict[str, Array] = {"quaternions": (1.0, 0.0, 0.0, 0.0), "scales": 1.0}
_POSITIVE = {
    "scales": (5e-324, np.inf, "positive numbers"),
    "importance": (LEAST_FLOAT, MOST_FLOAT, "positive numbers that a float32 can hold"),
}


def _bundles_of(bundle: Bundle | str | os.PathLike[str] | Sequence[Bundle]) -> list[Bundle]:
    """The bundles of a list or a tuple, or a single one, which may be a file."""
    if isinstance(bundle, str | os.PathLike):
        return [Bundle.open(bundle)]
    bundles: list[Bundle] = []
    if isinstance(bundle, list | tuple):
        bundles.extend(bundle)
    else:
        bundles.append(cast(Bundle, bundle))
    for item in bundles:
        check_type("bundle", item, Bundle, "a Bundle")
    return bundles


def _read_only(state: _State) -> _State:
    for column in state:
        if isinstance(column, np.ndarray):
            column.flags.writeable = False
    return state


def _rows(values: Array | None, name: str, count: int) -> Array:
    """A contiguous (count, ...) copy of a column, or of its default for None; one row
    stands for all, except of positions."""
    column: Array = values
    if values is None:
        column = _DEFAULTS.get(name)
    row = _ROW[name]
    is_on_device = getattr(column, "is_cuda", False) and name != "importance"
    if is_on_device:
        import torch

        array = column.detach().to(torch.float64, copy=True)
    else:
        array = floats(column, name)
    if name != "positions" and tuple(array.shape) == row:
        if is_on_device:
            array = array.expand(count, *row)
        else:
            array = np.broadcast_to(array, (count, *row))
    shape = tuple(array.shape)
    check(name, shape == (count, *row), f"shape {(count, *row)}, got {shape}")
    if is_on_device:
        return array.contiguous()
    if name in _POSITIVE:
        low, high, expected = _POSITIVE[name]
        wrong = (array < low) | (array > high)
        if wrong.any():
            raise ValueError(f"{name}: expected {expected}, got {array[wrong][0]:g}")
    if name == "quaternions":
        largest = np.abs(array).max(axis=1, keepdims=True)
        check("quaternions", largest.all(), "a rotation, got a quaternion of zeros")
        array = array / largest  # so that squares neither overflow nor underflow
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    if name == "importance":
        return np.ascontiguousarray(array, np.float32)
    return np.ascontiguousarray(array, np.float64)


def _on_device_of(array: Array, values: Array) -> Array:
    """The values as a tensor on the device of ``array``; unchanged if that is a NumPy
    array."""
    if isinstance(array, np.ndarray):
        return values
    import torch

    if isinstance(values, np.ndarray):
        values = np.array(values)  # a copy, because torch warns of arrays that are read-only
    return torch.as_tensor(values, device=array.device)


def _on_one_device(first: Array, second: Array) -> tuple[Array, Array]:
    """Both arrays on the device of either that is a tensor; on the host if neither
    is."""
    target = first
    if isinstance(first, np.ndarray):
        target = second
    return _on_device_of(target, first), _on_device_of(target, second)


def _joined(first: Array, second: Array) -> Array:
    """The concatenation, on the device of either."""
    first, second = _on_one_device(first, second)
    return _device.library_of(first).concatenate([first, second])


def _replaced(values: Array, rows: npt.NDArray[np.int64], row_values: Array) -> Array:
    """A copy with other values in some rows."""
    values, row_values = _on_one_device(values, row_values)
    if isinstance(values, np.ndarray):
        values = values.copy()
    else:
        values = values.clone()
    values[_on_device_of(values, rows)] = row_values
    return values
