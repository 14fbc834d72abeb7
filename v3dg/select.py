"""Selection: which clusters of a scene one view needs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device, _operations
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, Floats, VectorLike
from v3dg.gaussians import Gaussians
from v3dg.scene import Scene

Footprint: TypeAlias = Literal["solid_angle", "paper"]


@dataclass(frozen=True, eq=False)
class Selection:
    """Clusters that one view needs, in ascending order of instance, then cluster.

    Attributes:
        scene: The scene that was selected from.
        instance_ids: (S,) int32.
        cluster_ids: (S,) int32, within the instance's bundle.
        num_gaussians: Gaussians in all selected clusters.
        seconds: Wall time of the selection.
    """

    scene: Scene
    instance_ids: npt.NDArray[np.int32]
    cluster_ids: npt.NDArray[np.int32]
    num_gaussians: int
    seconds: float

    def __len__(self) -> int:
        return len(self.instance_ids)

    def gaussians(self, origin: VectorLike = (0.0, 0.0, 0.0), *, device: str = "cpu") -> Gaussians:
        """Return the selected gaussians in the world, N in the order of the selection, for any rasterizer.

        Spherical harmonics are rotated into the world's frame, which is exact. The degree is the highest of
        the bundles that are selected from.

        Args:
            origin: (3,) point in the world that means are relative to; take the camera's position where the
                scene is so far from zero that float32 would not hold it.
            device: ``"cpu"`` for NumPy arrays, ``"cuda"`` for torch tensors there, ``"auto"`` for the better
                of the two that works. Both hold the same numbers.
        """
        device = _device.resolve(device)
        shift = np.asarray(origin, np.float64)
        if shift.shape != (3,):
            raise ValueError(f"origin: expected shape (3,), got {shift.shape}")
        scene = self.scene
        instances, instance = np.unique(self.instance_ids, return_inverse=True)
        used, bundle = np.unique(scene.instance_bundle[instances], return_inverse=True)
        num_bases = max((scene.bundles[b].sh_degree + 1 for b in used), default=1) ** 2
        sources = [scene.bundles[b].gaussians for b in used]
        world = _operations.gather(
            [source.torch("cuda") for source in sources] if device == "cuda" else sources,
            num_bases,
            bundle=bundle.astype(np.int32),
            positions=scene.positions[instances] - shift,
            rotations=scene.rotations[instances],
            quaternions=scene.quaternions[instances],
            scales=scene.scales[instances],
            bands=_rotations_of_bands(scene.rotations[instances], num_bases),
            instance=instance.astype(np.int32),
            first_row=self._per_pair([table.clusters.offset[:-1] for table in scene.bundles]).astype(
                np.int64
            ),
            offset=self._first(),
        )
        return world.torch("cuda") if device == "cuda" else world

    @property
    def filters_px2(self) -> npt.NDArray[np.float32]:
        """(N,) variance of the screen-space filter that each gaussian is drawn with."""
        return self._per_gaussian([bundle.clusters.filter_px2 for bundle in self.scene.bundles]).astype(
            np.float32
        )

    @property
    def antialiased(self) -> npt.NDArray[np.bool_]:
        """(N,) whether each gaussian's opacity is compensated for its filter."""
        return self._per_gaussian([bundle.clusters.antialiased for bundle in self.scene.bundles]).astype(
            np.bool_
        )

    def _first(self) -> npt.NDArray[np.int64]:
        """(S + 1,) where each selected cluster's gaussians begin."""
        sizes = self._per_pair([np.diff(bundle.clusters.offset) for bundle in self.scene.bundles])
        return np.concatenate([[0], np.cumsum(sizes.astype(np.int64))])

    def _per_pair(self, tables: list[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        """(S,) values of the selected clusters from one (C,) table a bundle."""
        values = np.zeros(len(self), np.result_type(*tables) if tables else np.int64)
        bundle_of_pair = self.scene.instance_bundle[self.instance_ids]
        for b, table in enumerate(tables):
            mine = bundle_of_pair == b
            values[mine] = table[self.cluster_ids[mine]]
        return values

    def _per_gaussian(self, tables: list[npt.NDArray[Any]]) -> npt.NDArray[Any]:
        return np.repeat(self._per_pair(tables), np.diff(self._first()))


def select(
    scene_or_bundle: Scene | Bundle,
    camera: Camera,
    *,
    tolerance: float,
    footprint: Footprint = "solid_angle",
    cull: bool = True,
    device: str = "cpu",
) -> Selection:
    """Choose the clusters that are just detailed enough for one view.

    Exactly one cluster is chosen on every path from a leaf of an instance to its root, and those that lie
    outside the frustum are then left out. Turning the camera or moving it together with the scene changes
    only what is left out.

    Args:
        tolerance: Screen area in px² that one gaussian of a coarser cluster may stand for; 0 chooses the
            full detail wherever it covers anything, infinity the coarsest clusters.
        footprint: ``"solid_angle"``, or ``"paper"`` for the published formula, with which a path can
            have more than one cluster.
        cull: False keeps what lies outside the frustum.
        device: ``"cpu"`` or ``"cuda"``; both choose the same.

    Raises:
        ValueError: ``tolerance`` is negative or not a number, or another argument is not one of the above.
        RuntimeError: ``device`` is ``"cuda"`` and there is none.

    Source: Yang et al., Virtualized 3D Gaussians, SIGGRAPH 2025, online selection.
    """
    tolerance = float(tolerance)
    if not tolerance >= 0:
        raise ValueError(f"tolerance: expected 0 px² or more, got {tolerance}")
    scene = Scene.of(scene_or_bundle)
    start = time.perf_counter()
    instance_ids, cluster_ids, num_gaussians = _core.select(
        **_arguments(scene, camera),
        tolerance=min(tolerance, _LARGEST) if math.isfinite(tolerance) else tolerance,
        footprint=footprint,
        cull=cull,
        device=device,
    )
    return Selection(scene, instance_ids, cluster_ids, num_gaussians, time.perf_counter() - start)


def group_metrics(
    scene_or_bundle: Scene | Bundle, camera: Camera, *, footprint: Footprint = "solid_angle"
) -> list[npt.NDArray[np.float32]]:
    """Return for each instance what tolerance is compared with: its groups' metrics, (G,) in px²."""
    scene = Scene.of(scene_or_bundle)
    metric, offset = _core.group_metrics(**_arguments(scene, camera), footprint=footprint)
    return np.split(metric, offset[1:-1]) if len(scene) else []


_LARGEST = float(np.finfo(np.float32).max)


def _arguments(scene: Scene, camera: Camera) -> dict[str, Any]:
    return {
        "tables": scene.tables,
        "instance_bundle": scene.instance_bundle,
        "positions": scene.positions,
        "rotations": scene.rotations,
        "scales": scene.scales,
        "viewmat": camera.viewmat,
        "eye": camera.position,
        "K": camera.K,
        "width": camera.width,
        "height": camera.height,
        "near": camera.near,
    }


def _basis_of_band(degree: int, directions: Floats) -> Floats:
    """Real spherical harmonics (..., 2 degree + 1) of a band at directions (..., 3), signs as in 3DGS."""
    x, y, z = np.moveaxis(directions, -1, 0)
    xx, yy, zz = x * x, y * y, z * z
    if degree == 1:
        factor = math.sqrt(3 / (4 * math.pi))
        terms = [-y, z, -x]
    elif degree == 2:
        factor = math.sqrt(15 / (4 * math.pi))
        terms = [x * y, -y * z, (2 * zz - xx - yy) / math.sqrt(12), -x * z, (xx - yy) / 2]
    else:
        factor = math.sqrt(35 / (32 * math.pi))
        terms = [
            -y * (3 * xx - yy),
            math.sqrt(24) * x * y * z,
            -math.sqrt(0.6) * y * (4 * zz - xx - yy),
            math.sqrt(0.4) * z * (2 * zz - 3 * xx - 3 * yy),
            -math.sqrt(0.6) * x * (4 * zz - xx - yy),
            math.sqrt(6) * z * (xx - yy),
            -x * (xx - 3 * yy),
        ]
    return factor * np.stack(terms, axis=-1)


def _rotations_of_bands(rotations: Floats, num_bases: int) -> Floats:
    """(I, 83): matrices of bands 1, 2, ..., one after another, that take coefficients into the world.

    A band is closed under rotation, so the matrix follows from the basis at enough directions: the colour
    towards d in the world is the asset's colour towards the direction rotated back.
    """
    flat = np.zeros((len(rotations), sum((2 * degree + 1) ** 2 for degree in (1, 2, 3))))
    # Points on a spiral: many more than the 7 that the largest band needs, for a well-posed solution.
    count = 32
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    in_asset = directions @ rotations  # rows: rotation transposed times direction
    first = 0
    for degree in range(1, math.isqrt(num_bases)):
        size = (2 * degree + 1) ** 2
        band = np.linalg.pinv(_basis_of_band(degree, directions)) @ _basis_of_band(degree, in_asset)
        flat[:, first : first + size] = band.reshape(-1, size)
        first += size
    return flat
