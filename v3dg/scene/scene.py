"""Scenes: instances of bundles, placed by similarity transforms."""

import copy
import os
import threading
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from v3dg import _device, _system
from v3dg._numbers import Floats, check, check_type, one_of, positive, vector
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis, Camera
from v3dg.gaussians import Array, Gaussians
from v3dg.rotations import normalised, product, rotation_from_quaternion, turn_between
from v3dg.scene.columns import (
    SHARED,
    UNLABELLED,
    Columns,
    column,
    columns_of,
    composed,
    environment_column,
    joined,
    label_column,
    on_device_of,
    parts_of,
    replaced,
    turned,
    up_of_bundle,
)

# This lock is held during every change of a scene, and during fork(), so that it is
# never locked in a child process.
_lock = threading.RLock()
_system.at_fork(prepare=_lock.acquire, in_parent=_lock.release, in_child=_lock.release)


class _State(NamedTuple):
    """The state of a scene. It is immutable: each change of the scene replaces it."""

    bundles: tuple[Bundle, ...]
    bundle: npt.NDArray[np.int32]
    importance: npt.NDArray[np.float32]
    opacity: npt.NDArray[np.float32]
    tint: npt.NDArray[np.float32]
    environments: npt.NDArray[np.int32]
    labels: npt.NDArray[np.int32]
    positions: Array  # poses are NumPy arrays, or tensors on a CUDA device
    quaternions: Array
    scales: Array
    revision: tuple[int, int, int]


class Scene:
    """A set of instances of bundles. Each bundle is stored once. An instance transforms
    its points p to scale * rotation p + position.

    Instances are numbered from 0 in the order in which they were added. After `remove`,
    the remaining ones are renumbered. Changes are visible in the next picture. Several
    threads may change and draw a scene, and each change is atomic. A copy of a scene
    has the same bundles, but later changes of either scene do not affect the other.

    Poses may be NumPy arrays, or torch tensors on the host or on a CUDA device. Poses
    on a device stay there, and their values are not checked. An instance is not drawn
    if its pose is not finite or its scale is not positive.
    """

    _up: Axis | None = None

    def __init__(self) -> None:
        empty = _State(
            bundles=(),
            bundle=np.zeros(0, np.int32),
            importance=np.zeros(0, np.float32),
            opacity=np.zeros(0, np.float32),
            tint=np.zeros((0, 3), np.float32),
            environments=np.zeros(0, np.int32),
            labels=np.zeros(0, np.int32),
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
        """Return a scene unchanged, or a bundle as a scene with one instance at the
        origin."""
        if isinstance(subject, Scene):
            return subject
        check_type("subject", subject, Bundle, "a Scene or a Bundle")
        scene = cls()
        scene.add(subject)
        return scene

    @staticmethod
    def load(path: str | os.PathLike[str]) -> "Scene":
        """Read a scene without its cameras: the result of
        `v3dg.read_scene(path)[0]`."""
        from v3dg.scene.file import read_scene

        return read_scene(path)[0]

    def save(
        self, path: str | os.PathLike[str], cameras: Mapping[str, Camera] | None = None
    ) -> None:
        """Write the scene and named cameras with `v3dg.write_scene`."""
        from v3dg.scene.file import write_scene

        write_scene(path, self, cameras=cameras)

    def add(
        self,
        bundle: Bundle | str | os.PathLike[str] | Sequence[Bundle],
        positions: Array | npt.ArrayLike | None = None,
        quaternions: Array | npt.ArrayLike | None = None,
        scales: Array | npt.ArrayLike | None = None,
        importance: npt.ArrayLike = 1.0,
        *,
        matrix: Array | npt.ArrayLike | None = None,
        up: Axis | None = None,
        opacity: npt.ArrayLike = 1.0,
        tint: npt.ArrayLike = (1.0, 1.0, 1.0),
        environment: npt.ArrayLike = SHARED,
        label: npt.ArrayLike = UNLABELLED,
    ) -> range:
        """Add I instances of a bundle and return their ids.

        Args:
            bundle: A bundle, the path of its file, or a sequence of I bundles, one for
                each instance.
            positions: (I, 3), or (3,) for one instance, in world units. None means the
                origin.
            quaternions: (I, 4), or (4,) for all instances, w x y z. They need not be
                normalised. None means no rotation.
            scales: (I,), or one number for all instances, > 0. None means 1.
            importance: (I,), or one number for all instances, > 0. The cut of an
                instance is selected as if the tolerance were divided by its importance.
            matrix: (I, 4, 4), or (4, 4) for one instance, instead of positions,
                quaternions and scales: transforms of column vectors, composed of
                rotation, translation and uniform scale.
            up: The axis that points up in the scene. The up axis of the bundle
                (declared in its file, otherwise -y) is rotated to this axis before the
                pose is applied. If the scene has no up axis yet, it is set to this
                axis.
            opacity: (I,), or one number for all instances, 0 to 1. It multiplies the
                opacities of gaussians. Instances with opacity 0 are skipped.
            tint: (I, 3), or (3,) for all instances, >= 0. It multiplies red, green and
                blue of the evaluated colours, after these are clamped at 0.
            environment: (I,), or one integer for all instances, 0 to 2^24 - 1. The
                cameras of that environment see the instance (see
                `CameraBatch.environments`). With -1, all cameras see it. Pictures of a
                single `Camera` show all instances.
            label: (I,), or one integer for all instances, >= 0. It is the value in the
                channel `label` of a picture, such as the class of the object. -1 means
                no label.

        Raises:
            TypeError: ``bundle`` is not a Bundle.
            ValueError: A shape or a value is invalid, a matrix is not a similarity
                transform, or ``up`` differs from the scene's `up`.
        """
        bundles = _bundles_of(bundle)
        if matrix is not None:
            positions, quaternions, scales = parts_of(matrix, positions, quaternions, scales)
        rows = columns_of(
            positions,
            quaternions,
            scales,
            importance=importance,
            opacity=opacity,
            tint=tint,
            environment=environment,
            label=label,
        )
        count = len(rows.importance)
        if isinstance(bundle, list | tuple):
            check(
                "bundle",
                len(bundles) == count,
                f"one for all instances or a list of {count}, got {len(bundles)}",
            )
        if up is not None:
            rows = rows._replace(quaternions=turned(rows.quaternions, bundles, up))
        return self._append(bundles, rows, up)

    def add_scene(
        self,
        scene: "Scene",
        position: npt.ArrayLike | None = None,
        quaternion: npt.ArrayLike | None = None,
        scale: float | None = None,
        importance: float = 1.0,
        *,
        matrix: npt.ArrayLike | None = None,
        up: Axis | None = None,
        opacity: float = 1.0,
        tint: npt.ArrayLike = (1.0, 1.0, 1.0),
        environment: int = SHARED,
        label: int = UNLABELLED,
    ) -> range:
        """Add all instances of another scene, placed as a whole, and return their ids
        in this scene.

        Poses are composed, importance, opacity and tint are multiplied, and an
        environment and a label replace those of the other scene. Later changes of the
        other scene have no effect. The arguments are those of `add` for one instance.
        If the other scene has no up axis, z is used.

        Raises:
            TypeError: ``scene`` is not a Scene.
            ValueError: See `add`.
        """
        check_type("scene", scene, Scene, "a Scene")
        if position is not None:
            position = vector(position, "position")
        if quaternion is not None:
            quaternion = vector(quaternion, "quaternion", (4,))
        if scale is not None:
            scale = positive(scale, "scale")
        parts: tuple[Array, Array, Array] = (position, quaternion, scale)
        if matrix is not None:
            parts = parts_of(matrix, *parts)
        outer = columns_of(
            *parts,
            importance=importance,
            opacity=opacity,
            tint=tint,
            environment=environment,
            label=label,
        )
        count = len(outer.importance)
        check("scene", count == 1, f"one pose for the added scene, got {count} poses")
        inner = copy.copy(scene)  # other threads may change the original meanwhile
        if up is not None:
            outer = outer._replace(quaternions=product(outer.quaternions, turn_of(inner, up)))
        bundles = [inner.bundles[number] for number in inner.instance_bundle]
        return self._append(bundles, composed(outer, _columns_of(inner)), up)

    def _append(self, bundles: Sequence[Bundle], rows: Columns, up: Axis | None) -> range:
        """Append instances, and return their ids. `bundles` has one bundle for all of
        them, or one for each."""
        count = len(rows.importance)
        with _lock:
            self._take_up(up)
            state = self._state
            distinct = dict.fromkeys((*state.bundles, *bundles))
            number_of = {item: number for number, item in enumerate(distinct)}
            numbers = np.array([number_of[item] for item in bundles], np.int32)
            first = len(self)
            state = state._replace(
                bundles=tuple(number_of),
                bundle=np.concatenate([state.bundle, np.broadcast_to(numbers, count)]),
                positions=joined(state.positions, rows.positions),
                quaternions=joined(state.quaternions, rows.quaternions),
                scales=joined(state.scales, rows.scales),
                importance=joined(state.importance, rows.importance),
                opacity=joined(state.opacity, rows.opacity),
                tint=joined(state.tint, rows.tint),
                environments=joined(state.environments, rows.environments),
                labels=joined(state.labels, rows.labels),
            )
            self._publish(state, changes=1)
        return range(first, first + count)

    def remove(self, ids: Array | npt.ArrayLike) -> None:
        """Remove instances. Later instances are renumbered, as in `numpy.delete`."""
        with _lock:
            state = self._state
            is_left = np.ones(len(self), bool)
            is_left[self._ids(ids)] = False
            state = state._replace(
                bundle=state.bundle[is_left],
                importance=state.importance[is_left],
                opacity=state.opacity[is_left],
                tint=state.tint[is_left],
                environments=state.environments[is_left],
                labels=state.labels[is_left],
                positions=state.positions[on_device_of(state.positions, is_left)],
                quaternions=state.quaternions[on_device_of(state.quaternions, is_left)],
                scales=state.scales[on_device_of(state.scales, is_left)],
            )
            self._publish(state, changes=1, removals=int(not is_left.all()))

    def move(
        self,
        ids: Array | npt.ArrayLike | None = None,
        *,
        positions: Array | npt.ArrayLike | None = None,
        quaternions: Array | npt.ArrayLike | None = None,
        scales: Array | npt.ArrayLike | None = None,
        matrix: Array | npt.ArrayLike | None = None,
        up: Axis | None = None,
    ) -> None:
        """Change the poses of instances. Arguments that are None leave the
        corresponding values unchanged.

        Args:
            ids: (M,) indices of the instances. None means all. A tensor on the CUDA
                device of the poses is read there without waiting, and is not checked.
                Ids that do not exist are ignored. If an id occurs more than once, any
                of its poses is used.
            positions: (M, 3) new positions.
            quaternions: (M, 4), or (4,) for all of them: new rotations.
            scales: (M,), or one number for all of them: new scales.
            matrix: (M, 4, 4), or (4, 4) for one instance, instead of positions,
                quaternions and scales.
            up: As in `add`. Requires new quaternions or matrices. The up axis of the
                bundles is rotated to this axis before the new rotation is applied.

        Raises:
            IndexError: There is no such instance.
            ValueError: A shape or a value is invalid; see `add`.
        """
        if matrix is not None:
            positions, quaternions, scales = parts_of(matrix, positions, quaternions, scales)
        if up is not None:
            check(
                "up",
                quaternions is not None,
                "quaternions or a matrix together with up, got neither",
            )
        parts = {"positions": positions, "quaternions": quaternions, "scales": scales}
        with _lock:
            state = self._state
            rows = self._rows(ids)
            _check_rows_for_up(rows, up)
            self._take_up(up)
            for name, part in parts.items():
                if part is None:
                    continue
                values = column(part, name, len(rows))
                if up is not None and name == "quaternions":
                    bundles = [state.bundles[number] for number in state.bundle[rows]]
                    values = turned(values, bundles, up)
                if ids is not None:
                    values = replaced(getattr(state, name), rows, values)
                state = state._replace(**{name: values})
            self._publish(state, moves=1)

    def set_importance(
        self, importance: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None
    ) -> None:
        """Change the importance of instances (see `add`). If ``ids`` is None, all
        instances are changed."""
        self._set("importance", importance, ids)

    def set_opacity(self, opacity: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None) -> None:
        """Change the opacity of instances (see `add`). If ``ids`` is None, all
        instances are changed."""
        self._set("opacity", opacity, ids)

    def set_environment(
        self, environment: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None
    ) -> None:
        """Move instances to other environments (see `add`). If ``ids`` is None, all
        instances are moved."""
        with _lock:
            rows = self._ids(ids)
            environments = self._state.environments.copy()
            environments[rows] = environment_column(environment, len(rows))
            self._publish(self._state._replace(environments=environments), changes=1)

    def set_label(self, label: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None) -> None:
        """Change the labels of instances (see `add`). If ``ids`` is None, all instances
        are changed."""
        with _lock:
            rows = self._ids(ids)
            labels = self._state.labels.copy()
            labels[rows] = label_column(label, len(rows))
            self._publish(self._state._replace(labels=labels), changes=1)

    def set_tint(self, tint: npt.ArrayLike, ids: Array | npt.ArrayLike | None = None) -> None:
        """Change the tint of instances (see `add`). If ``ids`` is None, all instances
        are changed."""
        self._set("tint", tint, ids)

    def _set(self, name: str, values: npt.ArrayLike, ids: Array | npt.ArrayLike | None) -> None:
        with _lock:
            rows = self._ids(ids)
            changed = replaced(getattr(self._state, name), rows, column(values, name, len(rows)))
            self._publish(self._state._replace(**{name: changed}), changes=1)

    def _take_up(self, up: Axis | None) -> None:
        """Set the up axis. Raise ValueError if the scene has a different one. The
        caller must hold the lock."""
        if up is None:
            return
        is_same = self._up in (None, up)
        check("up", is_same, f"{self._up}, the up axis of this scene, got {up}")
        self._up = up

    def _publish(self, state: _State, changes: int = 0, moves: int = 0, removals: int = 0) -> None:
        """Replace the state atomically, and increase the revision. The caller must hold
        the lock."""
        num_changes, num_moves, num_removals = self.revision
        revision = (num_changes + changes, num_moves + moves, num_removals + removals)
        self._state = _read_only(state._replace(revision=revision))

    @property
    def up(self) -> Axis | None:
        """The axis that points up. If it is None, viewers and exports guess it."""
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
        """Three counts of changes so far: changes other than of poses, changes of
        poses, and removals. A removal also counts as a change of the first kind.

        Programs can use the revision to detect that data derived from the scene is
        outdated.
        """
        return self._state.revision

    @property
    def instance_bundle(self) -> npt.NDArray[np.int32]:
        """(I,) int32, the index of each instance's bundle in `bundles`; read-only."""
        return self._state.bundle

    @property
    def importance(self) -> npt.NDArray[np.float32]:
        """(I,) float32, the importance of each instance; read-only."""
        return self._state.importance

    @property
    def opacity(self) -> npt.NDArray[np.float32]:
        """(I,) float32, the opacity of each instance, 0 to 1; read-only."""
        return self._state.opacity

    @property
    def tint(self) -> npt.NDArray[np.float32]:
        """(I, 3) float32, the tint of each instance; read-only."""
        return self._state.tint

    @property
    def environments(self) -> npt.NDArray[np.int32]:
        """(I,) int32, the environment of each instance, or -1 if all cameras see it;
        read-only."""
        return self._state.environments

    @property
    def labels(self) -> npt.NDArray[np.int32]:
        """(I,) int32, the label of each instance, or -1 if it has none; read-only."""
        return self._state.labels

    @property
    def factors(self) -> npt.NDArray[np.float32] | None:
        """(I, 4) float32, factors of red, green, blue and opacity. None if all factors
        are 1."""
        state = self._state
        if (state.opacity == 1).all() and (state.tint == 1).all():
            return None
        return np.concatenate([state.tint, state.opacity[:, None]], axis=1)

    @property
    def positions(self) -> Floats:
        """(I, 3) float64 in world units. If the poses are on a device, this is a copy.
        Use `move` to change positions."""
        return _device.to_host(self._state.positions)

    @property
    def quaternions(self) -> Floats:
        """(I, 4) float64, w x y z, unit length."""
        rows = self._state.quaternions
        if isinstance(rows, np.ndarray):
            return rows
        quaternions = normalised(_device.to_host(rows))
        # Instances with a zero quaternion are not drawn.
        quaternions[~quaternions.any(axis=1)] = np.nan
        return quaternions

    @property
    def scales(self) -> Floats:
        """(I,) float64, the scale of each instance."""
        return _device.to_host(self._state.scales)

    @property
    def rotations(self) -> Floats:
        """(I, 3, 3) float64, the rotation matrices of the quaternions."""
        return rotation_from_quaternion(self.quaternions)

    @property
    def poses(self) -> tuple[Array, Array, Array]:
        """Positions, quaternions and scales without copying, as NumPy arrays or as
        tensors on a CUDA device."""
        state = self._state
        return state.positions, state.quaternions, state.scales

    def _rows(self, ids: Array | npt.ArrayLike | None) -> Array:
        """Return ids of instances for `move`. They are checked, unless they and the
        poses are on a CUDA device."""
        if getattr(ids, "is_cuda", False) and getattr(self._state.positions, "is_cuda", False):
            tensor: Array = ids
            kind = str(tensor.dtype)
            fits = tensor.ndim == 1 and kind in ("torch.int32", "torch.int64")
            shape = tuple(tensor.shape)
            check("ids", fits, f"integers of shape (M,), got {kind} of shape {shape}")
            return tensor
        return self._ids(ids)

    def _ids(self, ids: Array | None) -> npt.NDArray[np.int64]:
        """Return checked indices of instances. If `ids` is None, return all indices."""
        count = len(self)
        if ids is None:
            return np.arange(count)
        if hasattr(ids, "detach"):
            ids = ids.numpy(force=True)
        rows = np.atleast_1d(np.asarray(ids))
        if rows.size == 0:
            return np.zeros(0, np.int64)
        fits = rows.ndim == 1 and np.issubdtype(rows.dtype, np.integer)
        check("ids", fits, f"integers of shape (M,), got {rows.dtype} of shape {rows.shape}")
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


def _columns_of(scene: Scene) -> Columns:
    """Return the columns of all instances, on the host."""
    return Columns(
        positions=scene.positions,
        quaternions=scene.quaternions,
        scales=scene.scales,
        importance=scene.importance,
        opacity=scene.opacity,
        tint=scene.tint,
        environments=scene.environments,
        labels=scene.labels,
    )


def _check_rows_for_up(rows: Array, up: Axis | None) -> None:
    """Raise ValueError for rows on a device together with an up axis, because the
    bundles of the rows must be known on the host."""
    is_on_host = isinstance(rows, np.ndarray)
    check("ids", up is None or is_on_host, "ids on the host beside up, got some on a device")


def turn_of(subject: Scene | Bundle, up: Axis) -> Floats:
    """Return the quaternion (4,) w x y z that rotates the up axis of a scene or a
    bundle to another axis. Raise ValueError for an invalid axis."""
    one_of(up, "up", AXES)
    if isinstance(subject, Bundle):
        return turn_between(up_of_bundle(subject), up)
    return turn_between(subject.up or "z", up)


Subject: TypeAlias = Scene | Bundle | Gaussians
"""Anything that can be drawn."""


def _bundles_of(bundle: Bundle | str | os.PathLike[str] | Sequence[Bundle]) -> list[Bundle]:
    """Return the bundles in a list or a tuple. A single bundle, or the path of its
    file, gives one bundle."""
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
    for value in state:
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
    return state
