"""Scenes: bundles placed many times by similarity transforms."""

import os
import threading
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _device
from v3dg._numbers import LEAST_FLOAT, MOST_FLOAT, Floats, check, check_type, floats, one_of
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis, Camera
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised, rotation_from_quaternion

# Held by whoever changes a scene, and by fork(), so that a child finds it free.
_lock = threading.RLock()
os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)


class _State(NamedTuple):
    """A scene at one moment, which nobody writes to: a change makes another."""

    bundles: tuple[Bundle, ...]
    bundle: npt.NDArray[np.int32]
    importance: npt.NDArray[np.float32]
    positions: Any  # poses are NumPy arrays or tensors on a CUDA device
    quaternions: Any
    scales: Any
    revision: tuple[int, int, int]


class Scene:
    """Instances of bundles: each bundle is stored once, an instance takes p to scale * rotation p + position.

    Instances are numbered from 0 in the order in which they were added; `remove` closes the gaps. What is
    added, removed or moved counts from the next picture on. Any threads may change a scene and draw it: each
    change happens at once. A copy has the same bundles and goes its own way.

    Poses may be given as NumPy arrays, or as torch tensors on the host or on a CUDA device. Those of a device
    stay there, without a look at their values: an instance whose pose is not finite, or of no size, is not
    drawn.
    """

    _up: Axis | None = None

    def __init__(self) -> None:
        poses = np.zeros((0, 3)), np.zeros((0, 4)), np.zeros(0)
        self._state = _State((), np.zeros(0, np.int32), np.zeros(0, np.float32), *poses, (0, 0, 0))
        self._publish()

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)
        self._publish()  # for arrays that were unpickled can be written to

    @classmethod
    def of(cls, subject: "Scene | Bundle") -> "Scene":
        """Return a scene as it is, and a bundle as a scene of one instance at the origin."""
        if isinstance(subject, Scene):
            return subject
        check_type("subject", subject, Bundle, "a Scene or a Bundle")
        scene = cls()
        scene.add(subject)
        return scene

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Scene":
        """Read a scene as `v3dg.read_scene` does, which also has its cameras."""
        from v3dg.scene.file import read_scene

        return read_scene(path)[0]

    def save(self, path: str | os.PathLike[str], cameras: Mapping[str, Camera] | None = None) -> None:
        """Write the scene as `v3dg.write_scene` does; bundles stay in the files they were opened from."""
        from v3dg.scene.file import write_scene

        write_scene(path, self, cameras=cameras)

    def add(
        self,
        bundle: Bundle | str | os.PathLike[str] | Sequence[Bundle],
        positions: Any = (0.0, 0.0, 0.0),
        quaternions: Any = None,
        scales: Any = None,
        importance: npt.ArrayLike = 1.0,
    ) -> range:
        """Place a bundle I times and return the ids of the new instances.

        Args:
            bundle: One for all, also by its file, or a sequence of I.
            positions: (I, 3), or (3,) for one instance; world units.
            quaternions: (I, 4) or (4,) w x y z of any length but zero; no rotation if None.
            scales: (I,) or one number for all, > 0; 1 if None.
            importance: (I,) or one number for all, > 0. An instance of importance 4 is drawn as if the
                tolerance were a quarter.

        Raises:
            TypeError: ``bundle`` is not a bundle.
            ValueError: A shape or a value is not as above.
        """
        if isinstance(bundle, str | os.PathLike):
            bundle = Bundle.open(bundle)
        given = bundle if isinstance(bundle, list | tuple) else [bundle]
        for one in given:
            check_type("bundle", one, Bundle, "a Bundle")
        if not getattr(positions, "is_cuda", False):
            positions = floats(positions, "positions")
        if len(positions.shape) == 1:
            positions = positions[None]
        shape = tuple(positions.shape)
        check("positions", shape[1:] == (3,), f"shape (I, 3), got {shape}")
        count = shape[0]
        fits = len(given) == count or given is not bundle
        check("bundle", fits, f"one for all or {count}, got {len(given)}")
        quaternions = (1.0, 0.0, 0.0, 0.0) if quaternions is None else quaternions
        scales = 1.0 if scales is None else scales
        values = positions, quaternions, scales, importance
        new = {name: _rows(of, name, count) for name, of in zip(_ROW, values, strict=True)}
        with _lock:
            place = {known: b for b, known in enumerate(dict.fromkeys((*self.bundles, *given)))}
            new["bundle"] = np.broadcast_to(np.array([place[one] for one in given], np.int32), count)
            first = len(self)
            joined = {name: _joined(getattr(self._state, name), rows) for name, rows in new.items()}
            self._publish(bundles=tuple(place), changes=1, **joined)
        return range(first, first + count)

    def remove(self, ids: Any) -> None:
        """Take instances away; those that follow move down, as `numpy.delete` does it."""
        with _lock:
            keep = np.ones(len(self), bool)
            keep[self._ids(ids)] = False
            columns = {name: getattr(self._state, name) for name in ("bundle", *_ROW)}
            left = {name: rows[_like(rows, keep)] for name, rows in columns.items()}
            self._publish(changes=1, removals=int(not keep.all()), **left)

    def move(
        self, ids: Any = None, *, positions: Any = None, quaternions: Any = None, scales: Any = None
    ) -> None:
        """Give instances new poses; what is None stays.

        Args:
            ids: (M,) which instances; all if None.
            positions: (M, 3).
            quaternions: (M, 4) or (4,) for all of them.
            scales: (M,) or one number for all of them.

        Raises:
            IndexError: There is no such instance.
            ValueError: A shape or a value is not as in `add`.
        """
        given = {"positions": positions, "quaternions": quaternions, "scales": scales}
        with _lock:
            rows = self._ids(ids)
            moved = {name: _rows(of, name, len(rows)) for name, of in given.items() if of is not None}
            if ids is not None:
                moved = {name: _replaced(getattr(self._state, name), rows, of) for name, of in moved.items()}
            self._publish(moves=1, **moved)

    def set_importance(self, importance: npt.ArrayLike, ids: Any = None) -> None:
        """Give instances another importance, as in `add`; all of them if ``ids`` is None."""
        with _lock:
            rows = self._ids(ids)
            new = _rows(importance, "importance", len(rows))
            self._publish(importance=_replaced(self.importance, rows, new), changes=1)

    def _publish(self, changes: int = 0, moves: int = 0, removals: int = 0, **new: Any) -> None:
        """Put what is new in place of what was, all at once."""
        before = self.revision
        revision = before[0] + changes, before[1] + moves, before[2] + removals
        state = self._state._replace(revision=revision, **new)
        for rows in state:
            if isinstance(rows, np.ndarray):
                rows.flags.writeable = False
        self._state = state

    @property
    def up(self) -> Axis | None:
        """The axis that is up, or None where nobody said: for viewers and exports, which may guess it."""
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
        """Counted up when instances come, go or get another importance; when they move; and when they go.

        Whoever keeps a copy of the scene knows by it when to look again.
        """
        return self._state.revision

    @property
    def instance_bundle(self) -> npt.NDArray[np.int32]:
        """(I,) int32, which bundle an instance shows; not to be written to."""
        return self._state.bundle

    @property
    def importance(self) -> npt.NDArray[np.float32]:
        """(I,) float32; not to be written to."""
        return self._state.importance

    @property
    def positions(self) -> Floats:
        """(I, 3) float64, world units; a copy if they are on a device. Use `move` to change them."""
        return _device.to_host(self._state.positions)

    @property
    def quaternions(self) -> Floats:
        """(I, 4) float64, w x y z, unit length."""
        rows = self._state.quaternions
        if isinstance(rows, np.ndarray):
            return rows
        quaternions = normalised(_device.to_host(rows))
        quaternions[~quaternions.any(axis=1)] = np.nan  # an instance with a zero quaternion is not drawn
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
    def poses(self) -> tuple[Any, Any, Any]:
        """Positions, quaternions and scales where they are: NumPy arrays, or tensors on a CUDA device."""
        state = self._state
        return state.positions, state.quaternions, state.scales

    def _ids(self, ids: Any) -> npt.NDArray[np.int64]:
        """Ids of instances; of all where it is None."""
        count = len(self)
        if ids is None:
            return np.arange(count)
        rows = np.atleast_1d(ids.numpy(force=True) if hasattr(ids, "detach") else np.asarray(ids))
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
        instances, bundles = len(self), len(self.bundles)
        of = f"{bundles} bundle{'s' * (bundles != 1)}"
        return f"Scene({instances} instance{'s' * (instances != 1)} of {of})"


Subject: TypeAlias = Scene | Bundle | Gaussians
"""What can be drawn."""

_ROW = {"positions": (3,), "quaternions": (4,), "scales": (), "importance": ()}
_POSITIVE = {
    "scales": (5e-324, np.inf, "positive numbers"),
    "importance": (LEAST_FLOAT, MOST_FLOAT, "positive numbers that a float32 can hold"),
}


def _rows(values: Any, name: str, count: int) -> Any:
    """(count, ...) as scenes keep them, contiguous, ours alone; one row stands for all but of positions."""
    row = _ROW[name]
    is_on_device = getattr(values, "is_cuda", False) and name != "importance"
    if is_on_device:
        import torch

        array = values.detach().to(torch.float64, copy=True)
    else:
        array = floats(values, name)
    if name != "positions" and tuple(array.shape) == row:
        array = array.expand(count, *row) if is_on_device else np.broadcast_to(array, (count, *row))
    shape, wanted = tuple(array.shape), (count, *row)
    check(name, shape == wanted, f"shape {wanted}, got {shape}")
    if is_on_device:
        return array.contiguous()
    if name in _POSITIVE:
        least, most, expected = _POSITIVE[name]
        wrong = (array < least) | (array > most)
        if wrong.any():
            raise ValueError(f"{name}: expected {expected}, got {array[wrong][0]:g}")
    if name == "quaternions":
        largest = np.abs(array).max(axis=1, keepdims=True)
        check("quaternions", largest.all(), "a rotation, got a quaternion of zeros")
        array = array / largest  # so that squares neither overflow nor vanish
        array /= np.linalg.norm(array, axis=1, keepdims=True)
    return np.ascontiguousarray(array, np.float32 if name == "importance" else np.float64)


def _like(array: Any, values: Any) -> Any:
    """The values on the device of a tensor; as they are, on the host, for an array of NumPy's."""
    if isinstance(array, np.ndarray):
        return values
    import torch

    # Copied, for torch warns of arrays that are not to be written to.
    values = np.array(values) if isinstance(values, np.ndarray) else values
    return torch.as_tensor(values, device=array.device)


def _alike(first: Any, second: Any) -> tuple[Any, Any]:
    """Both as they are on the host, or on a device where one of them is."""
    there = second if isinstance(first, np.ndarray) else first
    return _like(there, first), _like(there, second)


def _joined(first: Any, second: Any) -> Any:
    """One after the other."""
    first, second = _alike(first, second)
    return _device.library_of(first).concatenate([first, second])


def _replaced(values: Any, rows: npt.NDArray[np.int64], new: Any) -> Any:
    """A copy with other values in some rows."""
    values, new = _alike(values, new)
    values = values.copy() if isinstance(values, np.ndarray) else values.clone()
    values[_like(values, rows)] = new
    return values
