"""Scenes: bundles placed many times by similarity transforms."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle
from v3dg.cameras import Floats
from v3dg.rotations import rotation_from_quaternion

_NO_ROTATION = (1.0, 0.0, 0.0, 0.0)


class Scene:
    """Instances of bundles: each bundle is stored once, an instance takes p to scale * rotation p + position.

    Instances are numbered from 0 in the order in which they were added; `remove` closes the gaps. What is
    added, removed or moved counts from the next picture on.

    Poses may be given as NumPy arrays, or as torch tensors on the host or on a CUDA device. Those of a device
    stay there, without a look at their values: an instance whose pose is not finite, or of no size, is not
    drawn.
    """

    def __init__(self) -> None:
        self._bundles: list[Bundle] = []
        self._bundle: npt.NDArray[np.int32] = np.zeros(0, np.int32)
        self._importance: npt.NDArray[np.float32] = np.zeros(0, np.float32)
        # NumPy arrays or tensors on a CUDA device.
        self._poses: dict[str, Any] = {
            "positions": np.zeros((0, 3)),
            "quaternions": np.zeros((0, 4)),
            "scales": np.zeros(0),
        }
        self._num_changes = self._num_moves = 0

    @classmethod
    def of(cls, subject: Scene | Bundle) -> Scene:
        """Return a scene as it is, and a bundle as a scene of one instance at the origin."""
        if isinstance(subject, Scene):
            return subject
        scene = cls()
        scene.add(subject)
        return scene

    def add(
        self,
        bundle: Bundle,
        positions: Any = (0.0, 0.0, 0.0),
        quaternions: Any = None,
        scales: Any = None,
        importance: npt.ArrayLike = 1.0,
    ) -> range:
        """Place a bundle I times and return the ids of the new instances.

        Args:
            positions: (I, 3), or (3,) for one instance; world units.
            quaternions: (I, 4) or (4,) w x y z of any length but zero; no rotation if None.
            scales: (I,) or one number for all, > 0; 1 if None.
            importance: (I,) or one number for all, > 0. An instance of importance 4 is drawn as if the
                tolerance were a quarter.

        Raises:
            TypeError: ``bundle`` is not a bundle.
            ValueError: A shape or a value is not as above.
        """
        if not isinstance(bundle, Bundle):
            raise TypeError(f"bundle: expected a Bundle, got {type(bundle).__name__}")
        if not hasattr(positions, "shape"):
            positions = _finite(positions, "positions")
        if len(positions.shape) == 1:
            positions = positions[None]
        if len(positions.shape) != 2 or positions.shape[1] != 3:
            raise ValueError(f"positions: expected shape (I, 3), got {tuple(positions.shape)}")
        count = len(positions)
        new = {
            "positions": _rows(positions, "positions", count),
            "quaternions": _rows(_NO_ROTATION if quaternions is None else quaternions, "quaternions", count),
            "scales": _rows(1.0 if scales is None else scales, "scales", count),
        }
        weights = _importances(importance, count)

        index = next((b for b, known in enumerate(self.bundles) if known is bundle), len(self.bundles))
        if index == len(self.bundles):
            self._bundles.append(bundle)
        first = len(self)
        self._bundle = np.concatenate([self._bundle, np.full(count, index, np.int32)])
        self._importance = np.concatenate([self._importance, weights])
        for name, rows in new.items():
            self._poses[name] = _joined(self._poses[name], rows)
        self._num_changes += 1
        return range(first, first + count)

    def remove(self, ids: Any) -> None:
        """Take instances away; those that follow move down, as `numpy.delete` does it."""
        keep = np.ones(len(self), bool)
        keep[self._ids(ids)] = False
        self._bundle, self._importance = self._bundle[keep], self._importance[keep]
        for name, rows in self._poses.items():
            self._poses[name] = rows[keep if isinstance(rows, np.ndarray) else _like(rows, keep)]
        self._num_changes += 1

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
        rows = None if ids is None else self._ids(ids)
        count = len(self) if rows is None else len(rows)
        given = {"positions": positions, "quaternions": quaternions, "scales": scales}
        checked = {name: _rows(values, name, count) for name, values in given.items() if values is not None}
        for name, values in checked.items():
            if rows is None:
                self._poses[name] = values
                continue
            here = self._poses[name]
            if isinstance(here, np.ndarray) and isinstance(values, np.ndarray):
                here = here.copy()
                here[rows] = values
            else:  # on a device, where one of them is
                there = values if isinstance(here, np.ndarray) else here
                here = _like(there, here).clone()
                here[_like(there, rows)] = _like(there, values)
            self._poses[name] = here
        self._num_moves += 1

    def set_importance(self, importance: npt.ArrayLike, ids: Any = None) -> None:
        """Give instances another importance, as in `add`; all of them if ``ids`` is None."""
        rows = np.arange(len(self)) if ids is None else self._ids(ids)
        changed = self._importance.copy()
        changed[rows] = _importances(importance, len(rows))
        self._importance = changed
        self._num_changes += 1

    @property
    def bundles(self) -> tuple[Bundle, ...]:
        """The bundles, in the order in which they were first added."""
        return tuple(self._bundles)

    @property
    def revision(self) -> tuple[int, int]:
        """Counted up when instances come, go or get another importance, and when they move.

        Whoever keeps a copy of the scene knows by it when to look again.
        """
        return self._num_changes, self._num_moves

    @property
    def instance_bundle(self) -> npt.NDArray[np.int32]:
        """(I,) int32, which bundle an instance shows; not to be written to."""
        return _read_only(self._bundle)

    @property
    def importance(self) -> npt.NDArray[np.float32]:
        """(I,) float32; not to be written to."""
        return _read_only(self._importance)

    @property
    def positions(self) -> Floats:
        """(I, 3) float64, world units; a copy if they are on a device. Use `move` to change them."""
        return self._on_host("positions")

    @property
    def quaternions(self) -> Floats:
        """(I, 4) float64, w x y z, unit length."""
        quaternions = self._on_host("quaternions")
        if isinstance(self._poses["quaternions"], np.ndarray):
            return quaternions
        with np.errstate(invalid="ignore"):  # what is no rotation becomes no number, and is not drawn
            return np.asarray(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))

    @property
    def scales(self) -> Floats:
        """(I,) float64."""
        return self._on_host("scales")

    @property
    def rotations(self) -> Floats:
        """(I, 3, 3) float64, of the quaternions."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def poses(self) -> tuple[Any, Any, Any]:
        """Positions, quaternions and scales where they are: NumPy arrays, or tensors on a CUDA device."""
        return self._poses["positions"], self._poses["quaternions"], self._poses["scales"]

    @property
    def core(self) -> _core.Instances:
        """The same instances as the compiled operations take them, on the host."""
        return _core.Instances(
            bundle=self.instance_bundle,
            positions=self.positions,
            quaternions=self.quaternions,
            scales=self.scales,
            importance=self.importance,
        )

    def _on_host(self, name: str) -> Floats:
        rows = self._poses[name]
        return _read_only(rows if isinstance(rows, np.ndarray) else rows.cpu().numpy())

    def _ids(self, ids: Any) -> npt.NDArray[np.int64]:
        if hasattr(ids, "detach"):
            ids = ids.detach().cpu().numpy()
        rows = np.atleast_1d(np.asarray(ids if len(np.shape(ids)) == 0 else np.array(ids)))
        if rows.size == 0:
            return np.zeros(0, np.int64)
        if rows.ndim != 1 or not np.issubdtype(rows.dtype, np.integer):
            raise ValueError(f"ids: expected whole numbers (M,), got {rows.dtype} of shape {rows.shape}")
        wrong = (rows < 0) | (rows >= len(self))
        if wrong.any():
            raise IndexError(f"ids: expected 0 to {len(self) - 1}, got {rows[wrong][0]}")
        return rows.astype(np.int64)

    def __len__(self) -> int:
        return len(self._bundle)

    def __repr__(self) -> str:
        return f"Scene({len(self)} instances of {len(self.bundles)} bundles)"


_ROW = {"positions": (3,), "quaternions": (4,), "scales": ()}


def _rows(values: Any, name: str, count: int) -> Any:
    """(count, ...) in double precision, contiguous, ours alone; one row stands for all but of positions."""
    row = _ROW[name]
    is_on_device = getattr(values, "is_cuda", False)
    if is_on_device:
        import torch

        array = values.detach().to(torch.float64, copy=True)
    else:
        array = _finite(values.detach().numpy() if hasattr(values, "detach") else values, name)
    if name != "positions" and tuple(array.shape) == row:
        array = array.expand(count, *row) if is_on_device else np.broadcast_to(array, (count, *row))
    if tuple(array.shape) != (count, *row):
        shown = ", ".join(str(length) for length in (count, *row)) + ("," if not row else "")
        raise ValueError(f"{name}: expected shape ({shown}), got {tuple(array.shape)}")
    if is_on_device:
        return array.contiguous()
    if name == "scales" and (array <= 0).any():
        raise ValueError(f"scales: expected positive numbers, got {array[array <= 0][0]:g}")
    if name == "quaternions":
        array = _unit(array)
    return np.ascontiguousarray(array)


def _unit(quaternions: Floats) -> Floats:
    length2 = np.einsum("ij,ij->i", quaternions, quaternions)
    if not ((length2 > 1e-200) & (length2 < 1e200)).all():  # squares overflow or vanish
        largest = np.abs(quaternions).max(axis=1, keepdims=True)
        if (largest == 0).any():
            raise ValueError("quaternions: expected a rotation, got a quaternion of zeros")
        quaternions = quaternions / largest
        length2 = np.einsum("ij,ij->i", quaternions, quaternions)
    return np.asarray(quaternions / np.sqrt(length2)[:, None])


def _finite(values: npt.ArrayLike, name: str) -> Floats:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {type(values).__name__}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)][0]}")
    return array


def _importances(importance: npt.ArrayLike, count: int) -> npt.NDArray[np.float32]:
    weights = _finite(importance, "importance").astype(np.float32)
    if weights.ndim == 0:
        weights = np.full(count, weights)
    if weights.shape != (count,):
        raise ValueError(f"importance: expected shape ({count},), got {weights.shape}")
    if not ((weights > 0) & np.isfinite(weights)).all():
        raise ValueError(f"importance: expected positive numbers, got {weights[~(weights > 0)][:1]}")
    return weights


def _like(tensor: Any, values: Any) -> Any:
    """The values as a tensor on the device of another."""
    import torch

    return torch.as_tensor(values, device=tensor.device)


def _joined(first: Any, second: Any) -> Any:
    """One after the other; on a device where one of them is."""
    if isinstance(first, np.ndarray) and isinstance(second, np.ndarray):
        return np.concatenate([first, second])
    import torch

    there = second if isinstance(first, np.ndarray) else first
    return torch.cat([_like(there, first), _like(there, second)])


def _read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    view: npt.NDArray[Any] = array.view()
    view.flags.writeable = False
    return view
