"""Scans of spinning LiDARs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np

from v3dg._numbers import Floats, check_type, floats
from v3dg.opening import File, opened
from v3dg.render.rays import cast_rays, check_rays_device
from v3dg.render.request import CutRequest
from v3dg.spherical import Lidar, checked_pose

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from v3dg._device import Device
    from v3dg.cameras import MatrixLike
    from v3dg.scene import Subject


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a LiDAR; `Lidar` defines its returns.

    Attributes:
        lidar: The sensor.
        pose: (4, 4) sensor to world.
        range: (H, W) float32 distance of the first return along the ray, in world
            units; infinite where there is none.
        intensity: (H, W) float32 intensity of the first return; 0 where there is none.
        second_range, second_intensity: The same for the second return.
        alpha: (H, W) float32 share of the light that does not pass the scene.
        gaussians: Number of gaussians in the selected clusters.
    """

    lidar: Lidar
    pose: Floats
    range: NDArray[np.float32]
    intensity: NDArray[np.float32]
    second_range: NDArray[np.float32]
    second_intensity: NDArray[np.float32]
    alpha: NDArray[np.float32]
    gaussians: int

    def points(self) -> Floats:
        """Return (N, 3) the places of the first returns in the world, row by row: those
        where ``np.isfinite(scan.range)``."""
        return self._places(self.range)

    def second_points(self) -> Floats:
        """Return (M, 3) the places of the second returns in the world."""
        return self._places(self.second_range)

    def _places(self, ranges: NDArray[np.float32]) -> Floats:
        is_hit = np.isfinite(ranges)
        places = self.lidar.directions[is_hit] * ranges[is_hit].astype(np.float64)[:, None]
        return np.asarray(places @ self.pose[:3, :3].T + self.pose[:3, 3])


@overload
def scan(
    subject: Subject | File,
    lidar: Lidar,
    pose: MatrixLike,
    *,
    tolerance: float | None = None,
    min_level: int = 0,
    device: str | Device = "auto",
) -> Scan: ...
@overload
def scan(
    subject: Subject | File,
    lidar: Lidar,
    pose: Sequence[MatrixLike],
    *,
    tolerance: float | None = None,
    min_level: int = 0,
    device: str | Device = "auto",
) -> list[Scan]: ...
def scan(
    subject: Subject | File,
    lidar: Lidar,
    pose: MatrixLike | Sequence[MatrixLike],
    *,
    tolerance: float | None = None,
    min_level: int = 0,
    device: str | Device = "auto",
) -> Scan | list[Scan]:
    """Scan a scene, a bundle or an asset with a LiDAR at a pose, or at each of several.

    All rays of a scan start at the same place at the same time. Gaussians are evaluated
    on the rays and not projected.

    Args:
        subject: What to scan, in world space; or its file, which every call opens
            again.
        pose: (4, 4) sensor to world, a rotation and a translation; or (B, 4, 4). The
            sensor has x forward (azimuth 0), y left and z up.
        tolerance, min_level: As in `v3dg.select`, with `Lidar.spacing` as the size of a
            pixel.
        device: "cpu" or "auto". A CUDA device is an error, because scans are made on
            the CPU only.

    Raises:
        ValueError: An argument is invalid.
    """
    check_type("lidar", lidar, Lidar, "a Lidar")
    check_rays_device(device)
    content: Subject = opened(subject)
    cut = CutRequest(tolerance=tolerance, min_level=min_level)
    matrices = floats(pose, "pose")
    if matrices.ndim != 3:
        return _scan(content, lidar, checked_pose(matrices, "pose"), cut)
    poses = [checked_pose(matrix, f"pose[{number}]") for number, matrix in enumerate(matrices)]
    return [_scan(content, lidar, matrix, cut) for matrix in poses]


def _scan(subject: Subject, lidar: Lidar, pose: Floats, cut: CutRequest) -> Scan:
    cast = cast_rays(subject, lidar.core_at(pose), cut, (lidar.detection, lidar.gap))
    returns = lidar.table.in_order(cast.returns)
    return Scan(
        lidar=lidar,
        pose=pose,
        range=np.ascontiguousarray(returns[:, :, 0, 0]),
        intensity=np.ascontiguousarray(returns[:, :, 0, 2]),
        second_range=np.ascontiguousarray(returns[:, :, 1, 0]),
        second_intensity=np.ascontiguousarray(returns[:, :, 1, 2]),
        alpha=lidar.table.in_order(cast.alpha),
        gaussians=cast.gaussians,
    )
