"""Selection: which clusters of a scene one view needs."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, Floats, VectorLike
from v3dg.gaussians import Gaussians
from v3dg.scene import Scene

Footprint: TypeAlias = Literal["solid_angle", "paper"]

# Gaussians brought into the world at a time, to bound the memory of double precision temporaries.
CHUNK = 1 << 16


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

    def gaussians(self, origin: VectorLike = (0.0, 0.0, 0.0)) -> Gaussians:
        """Return the selected gaussians in the world, N in the order of the selection, for any rasterizer.

        Spherical harmonics are rotated into the world's frame, which is exact. The degree is the highest of
        the bundles that are selected from.

        Args:
            origin: (3,) point in the world that means are relative to; take the camera's position where the
                scene is so far from zero that float32 would not hold it.
        """
        shift = np.asarray(origin, np.float64)
        if shift.shape != (3,):
            raise ValueError(f"origin: expected shape (3,), got {shift.shape}")
        scene, first = self.scene, self._first()
        bundle_of_pair = scene.instance_bundle[self.instance_ids]
        used = np.unique(bundle_of_pair)
        num_sh = max((scene.bundles[b].sh_degree + 1 for b in used), default=1) ** 2
        count = self.num_gaussians
        means, quats = np.empty((count, 3), np.float32), np.empty((count, 4), np.float32)
        scales, opacities = np.empty((count, 3), np.float32), np.empty(count, np.float32)
        sh = np.zeros((count, num_sh, 3), np.float32)

        for b in used:
            source = scene.bundles[b].gaussians
            offset = scene.bundles[b].clusters.offset
            instances, bands = np.unique(self.instance_ids[bundle_of_pair == b]), []
            if source.sh.shape[1] > 1:
                bands = _rotations_of_bands(scene.rotations[instances], source.sh.shape[1])
            for chunk in _chunks(np.flatnonzero(bundle_of_pair == b), np.diff(first)):
                sizes = np.diff(first)[chunk]
                within = np.arange(sizes.sum()) - np.repeat(np.cumsum(sizes) - sizes, sizes)
                read = np.repeat(offset[self.cluster_ids[chunk]], sizes) + within
                write = np.repeat(first[chunk], sizes) + within
                i = np.repeat(self.instance_ids[chunk], sizes)
                rotated = np.einsum("nij,nj->ni", scene.rotations[i], np.asarray(source.means)[read])
                means[write] = scene.scales[i, None] * rotated + (scene.positions[i] - shift)
                quats[write] = _product(scene.quaternions[i], np.asarray(source.quats, np.float64)[read])
                scales[write] = scene.scales[i, None] * np.asarray(source.scales)[read]
                opacities[write] = np.asarray(source.opacities)[read]
                sh[write, 0] = np.asarray(source.sh)[read, 0]
                known = np.searchsorted(instances, i)
                for degree, band in enumerate(bands, start=1):
                    rows = slice(degree**2, (degree + 1) ** 2)
                    sh[write, rows] = band[known] @ np.asarray(source.sh)[read, rows]
        return Gaussians(means=means, quats=quats, scales=scales, opacities=opacities, sh=sh)

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


def _chunks(pairs: npt.NDArray[np.int64], sizes: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    """The pairs in runs of about CHUNK gaussians."""
    if len(pairs) == 0:
        return []
    run = np.cumsum(sizes[pairs]) // CHUNK
    return np.split(pairs, np.flatnonzero(np.diff(run)) + 1)


def _product(a: Floats, b: Floats) -> Floats:
    """Quaternion products (N, 4) w x y z: first b, then a."""
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


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


def _rotations_of_bands(rotations: Floats, num_sh: int) -> list[Floats]:
    """For bands 1, 2, ...: matrices (I, 2l + 1, 2l + 1) that take an asset's coefficients into the world.

    A band is closed under rotation, so the matrix follows from the basis at enough directions: the colour
    towards d in the world is the asset's colour towards the direction rotated back.
    """
    # Points on a spiral: many more than the 7 that the largest band needs, for a well-posed solution.
    count = 32
    z = 1 - (2 * np.arange(count) + 1) / count
    turn = np.arange(count) * math.pi * (3 - math.sqrt(5))
    directions = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=1)
    in_asset = directions @ rotations  # rows: rotation transposed times direction
    return [
        np.linalg.pinv(_basis_of_band(degree, directions)) @ _basis_of_band(degree, in_asset)
        for degree in range(1, math.isqrt(num_sh))
    ]
