"""Scenes: bundles placed many times by similarity transforms."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle
from v3dg.cameras import Floats


class Scene:
    """Instances of bundles: each bundle is stored once, an instance takes p to scale * rotation p + position.

    Attributes:
        bundles: The bundles, in the order in which they were first added.
        instance_bundle: (I,) int32, which bundle an instance shows.
        positions: (I, 3) float64, world units.
        quaternions: (I, 4) float64, w x y z, unit length.
        rotations: (I, 3, 3) float64.
        scales: (I,) float64.
    """

    def __init__(self) -> None:
        self.bundles: list[Bundle] = []
        self.tables: list[_core.ClusterTable] = []
        self.instance_bundle: npt.NDArray[np.int32] = np.zeros(0, np.int32)
        self.positions: Floats = np.zeros((0, 3))
        self.quaternions: Floats = np.zeros((0, 4))
        self.rotations: Floats = np.zeros((0, 3, 3))
        self.scales: Floats = np.zeros(0)

    @classmethod
    def of(cls, scene_or_bundle: Scene | Bundle) -> Scene:
        """Return a scene as it is, and a bundle as a scene of one instance at the origin."""
        if isinstance(scene_or_bundle, Scene):
            return scene_or_bundle
        scene = cls()
        scene.add(scene_or_bundle)
        return scene

    def add(
        self,
        bundle: Bundle,
        positions: npt.ArrayLike = (0.0, 0.0, 0.0),
        quaternions: npt.ArrayLike | None = None,
        scales: npt.ArrayLike | None = None,
    ) -> range:
        """Place a bundle I times and return the ids of the new instances.

        Args:
            positions: (I, 3), or (3,) for one instance; world units.
            quaternions: (I, 4) or (4,) w x y z of any length but zero; no rotation if None.
            scales: (I,) or one number for all, > 0; 1 if None.

        Raises:
            TypeError: ``bundle`` is not a bundle.
            ValueError: A shape or a value is not as above.
        """
        if not isinstance(bundle, Bundle):
            raise TypeError(f"bundle: expected a Bundle, got {type(bundle).__name__}")
        position = np.atleast_2d(_finite(positions, "positions"))
        count = len(position)
        if position.shape != (count, 3):
            raise ValueError(f"positions: expected shape (I, 3), got {position.shape}")
        if quaternions is None:
            quaternion = np.tile([1.0, 0.0, 0.0, 0.0], (count, 1))
        else:
            quaternion = np.atleast_2d(_finite(quaternions, "quaternions"))
        if quaternion.shape != (count, 4):
            raise ValueError(f"quaternions: expected shape ({count}, 4), got {quaternion.shape}")
        scale = _finite(1.0 if scales is None else scales, "scales")
        if scale.ndim == 0:
            scale = np.full(count, float(scale))
        if scale.shape != (count,):
            raise ValueError(f"scales: expected shape ({count},), got {scale.shape}")
        if (scale <= 0).any():
            raise ValueError(f"scales: expected positive numbers, got {scale[scale <= 0][0]:g}")
        largest = np.abs(quaternion).max(axis=1, initial=0.0, keepdims=True)
        if (largest == 0).any():
            raise ValueError("quaternions: expected a rotation, got a quaternion of zeros")
        quaternion = quaternion / largest  # so that squares neither overflow nor vanish
        quaternion = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)

        index = next((b for b, known in enumerate(self.bundles) if known is bundle), len(self.bundles))
        if index == len(self.bundles):
            self.tables.append(_table_of(bundle))
            self.bundles.append(bundle)
        first = len(self)
        self.instance_bundle = np.concatenate([self.instance_bundle, np.full(count, index, np.int32)])
        self.positions = np.concatenate([self.positions, position])
        self.quaternions = np.concatenate([self.quaternions, quaternion])
        self.rotations = np.concatenate([self.rotations, rotation_from_quaternion(quaternion)])
        self.scales = np.concatenate([self.scales, scale])
        return range(first, first + count)

    def __len__(self) -> int:
        return len(self.scales)

    def __repr__(self) -> str:
        return f"Scene({len(self)} instances of {len(self.bundles)} bundles)"


def rotation_from_quaternion(quaternions: Floats) -> Floats:
    """Rotation matrices (I, 3, 3) of unit quaternions (I, 4) w x y z."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def _table_of(bundle: Bundle) -> _core.ClusterTable:
    clusters, groups = bundle.clusters, bundle.groups
    return _core.ClusterTable(
        groups.ball,
        groups.weight,
        clusters.own_group,
        clusters.parent_group,
        clusters.box,
        clusters.filter_px2,
        clusters.offset,
    )


def _finite(values: npt.ArrayLike, name: str) -> Floats:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: expected numbers, got {type(values).__name__}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)][0]}")
    return array
