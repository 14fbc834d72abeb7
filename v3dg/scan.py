"""Scans of spinning LiDARs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias, cast, overload

import numpy as np
import numpy.typing as npt

from v3dg import _device
from v3dg._device import CPU
from v3dg._numbers import Floats, check, check_type, doubles
from v3dg.camera_batch import environment_numbers
from v3dg.opening import File, opened
from v3dg.render.rays import cast_rays
from v3dg.render.request import CutRequest
from v3dg.scene import Scene
from v3dg.spherical import Lidar, checked_pose

if TYPE_CHECKING:
    from v3dg._core import Cast
    from v3dg._device import Device
    from v3dg.cameras import MatrixLike
    from v3dg.gaussians import Array
    from v3dg.scene import Subject

    _Poses: TypeAlias = MatrixLike | Sequence[MatrixLike]


@dataclass(frozen=True, eq=False)
class Scan:
    """One turn of a LiDAR; `Lidar` defines its returns. The arrays are NumPy arrays, or
    torch tensors on the CUDA device that made the scan.

    Attributes:
        lidar: The sensor.
        pose: (4, 4) from sensor to world.
        range: (H, W) float32 distance of the first return along the ray, in world
            units; infinite where there is none.
        intensity: (H, W) float32 intensity of the first return; 0 where there is none.
        second_range, second_intensity: Range and intensity of the second return.
        alpha: (H, W) float32 fraction of the light that the scene stops.
        gaussians: Number of gaussians in the selected clusters.
    """

    lidar: Lidar
    pose: Array
    range: Array
    intensity: Array
    second_range: Array
    second_intensity: Array
    alpha: Array
    gaussians: int

    def points(self) -> Array:
        """Return the points of the first returns in the world, (N, 3), row by row. Rays
        without a finite range are left out. The points are in double precision, on the
        device of the scan."""
        return self._places(self.range)

    def second_points(self) -> Array:
        """Return (M, 3) the points of the second returns in the world."""
        return self._places(self.second_range)

    def _places(self, ranges: Array) -> Array:
        directions: Array = self.lidar.directions
        pose = self.pose
        is_hit: Array
        if isinstance(ranges, np.ndarray):
            is_hit = np.isfinite(ranges)
            distances = ranges[is_hit].astype(np.float64)
        else:
            import torch

            is_hit = torch.isfinite(ranges)
            distances = ranges[is_hit].double()
            directions = torch.as_tensor(directions, device=ranges.device)
            pose = torch.as_tensor(pose, dtype=torch.float64, device=ranges.device)
        places = directions[is_hit] * distances[:, None]
        return places @ pose[:3, :3].T + pose[:3, 3]


class ScanBatch(Sequence[Scan]):
    """Scans at B poses. This is a sequence of `Scan`, whose arrays are views of the
    arrays of the batch.

    Attributes:
        lidar: The sensor.
        poses: (B, 4, 4) from sensor to world.
        range, intensity, second_range, second_intensity, alpha: (B, H, W) as in `Scan`.
        gaussians: Number of gaussians in the selected clusters at each pose.
    """

    def __init__(self, lidar: Lidar, poses: Array, casts: Sequence[Cast]) -> None:
        self.lidar = lidar
        self.poses = poses
        self.range = _joined([cast.range for cast in casts])
        self.intensity = _joined([cast.intensity for cast in casts])
        self.second_range = _joined([cast.second_range for cast in casts])
        self.second_intensity = _joined([cast.second_intensity for cast in casts])
        self.alpha = _joined([cast.alpha for cast in casts])
        self.gaussians = [count for cast in casts for count in cast.gaussians]

    def __len__(self) -> int:
        return len(self.gaussians)

    def __repr__(self) -> str:
        rows, columns = self.alpha.shape[1:]
        return f"ScanBatch({len(self)} scans of {rows} x {columns} rays)"

    @overload
    def __getitem__(self, number: int) -> Scan: ...
    @overload
    def __getitem__(self, number: slice) -> list[Scan]: ...
    def __getitem__(self, number: int | slice) -> Scan | list[Scan]:
        if isinstance(number, slice):
            return [self[index] for index in range(*number.indices(len(self)))]
        if not -len(self) <= number < len(self):
            raise IndexError(f"number: expected one of {len(self)} scans, got {number}")
        return Scan(
            lidar=self.lidar,
            pose=self.poses[number],
            range=self.range[number],
            intensity=self.intensity[number],
            second_range=self.second_range[number],
            second_intensity=self.second_intensity[number],
            alpha=self.alpha[number],
            gaussians=self.gaussians[number],
        )


@overload
def scan(
    subject: Subject | File,
    lidar: Lidar,
    pose: MatrixLike,
    *,
    environment: Array | npt.ArrayLike | None = None,
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
    environment: Array | npt.ArrayLike | None = None,
    tolerance: float | None = None,
    min_level: int = 0,
    device: str | Device = "auto",
) -> ScanBatch: ...
def scan(
    subject: Subject | File,
    lidar: Lidar,
    pose: _Poses,
    *,
    environment: Array | npt.ArrayLike | None = None,
    tolerance: float | None = None,
    min_level: int = 0,
    device: str | Device = "auto",
) -> Scan | ScanBatch:
    """Scan a scene, a bundle or an asset with a LiDAR, at one pose or at several.

    All rays of a scan start at the same point at the same time. Gaussians are evaluated
    on the rays; they are not projected.

    On a CUDA device, all gaussians are resident. Buffers are stored with the scene or
    the bundle, and reused by its next scans. The call waits once for each group of
    poses whose gaussians are cast together. When it returns, the rest of its work may
    be in progress on torch's current stream.

    Args:
        subject: What to scan, in world space. If it is the path of a file, every call
            opens the file again.
        pose: (4, 4) or (B, 4, 4) from sensor to world, a rotation and a translation.
            The sensor has x forward (azimuth 0), y left and z up. A float32 or float64
            torch tensor on the CUDA device that scans stays there and is not checked.
            If such a pose is not a rigid motion, its rays hit nothing.
        environment: The environment of the sensor (see `Scene.environments`), or (B,)
            of the sensors. A sensor sees the instances of its environment and the
            shared ones, for -1 only the shared ones. None: it sees all instances. An
            int32 or int64 tensor on the CUDA device stays there and is not checked. If
            the scene does not have such an environment, its rays hit nothing.
        tolerance, min_level: As in `v3dg.select`, with `Lidar.spacing` as the size of a
            pixel.
        device: As in `v3dg.render`.

    Raises:
        ValueError: An argument is invalid.
        RuntimeError: `device` is "cuda", and something that CUDA needs is missing; or a
            CUDA graph is being captured.
    """
    check_type("lidar", lidar, Lidar, "a Lidar")
    chosen_device = _device.resolve(device)
    content: Subject = opened(subject)
    cut = CutRequest(tolerance=tolerance, min_level=min_level)
    poses, is_one = _poses_of(pose, chosen_device)
    environments = _environments_of(environment, content, len(poses), chosen_device)
    casts = _cast_parts(content, lidar, _viewmats(poses), environments, cut, chosen_device)
    batch = ScanBatch(lidar, poses, casts)
    if is_one:
        return batch[0]
    return batch


def _cast_parts(
    subject: Subject,
    lidar: Lidar,
    viewmats: Array,
    environments: Array | None,
    cut: CutRequest,
    device: Device,
) -> list[Cast]:
    """Return the casts of all poses: on the CPU one for each pose, so that the program
    can be interrupted between them."""
    count = max(1, len(viewmats))
    size = count
    if not device.is_cuda:
        size = 1
    casts = []
    for first in range(0, count, size):
        part = slice(first, first + size)
        environments_of_part = None
        if environments is not None:
            environments_of_part = environments[part]
        casts.append(
            cast_rays(
                subject,
                lidar.core,
                viewmats[part],
                cut,
                device,
                environments=environments_of_part,
                returns=(lidar.detection, lidar.gap),
            )
        )
    return casts


def _poses_of(pose: _Poses, device: Device) -> tuple[Array, bool]:
    """Return (B, 4, 4) poses, and whether a single pose was given."""
    if not getattr(pose, "is_cuda", False):
        matrices = doubles(pose, "pose")
        if matrices.ndim != 3:
            return checked_pose(matrices, "pose")[None], True
        for number, matrix in enumerate(matrices):
            checked_pose(matrix, f"pose[{number}]")
        return matrices, False
    tensor = cast("Array", pose).detach()
    shape = tuple(tensor.shape)
    expected = f"shape (4, 4) or (B, 4, 4), got {shape}"
    check("pose", shape[-2:] == (4, 4) and len(shape) in (2, 3), expected)
    _check_tensor(tensor, "pose", ("float32", "float64"), device)
    return tensor.reshape(-1, 4, 4), len(shape) == 2


def _environments_of(
    environment: Array | npt.ArrayLike | None, subject: Subject, count: int, device: Device
) -> Array | None:
    """Return (count,) the environments of sensors on the device."""
    if environment is None:
        return None
    if not getattr(environment, "is_cuda", False):
        values = np.asarray(environment)
        if values.ndim == 0:
            values = np.full(count, values)
        numbers = environment_numbers(values, "environment", count)
        _check_environments(numbers, subject)
        if not device.is_cuda:
            return numbers
        import torch

        return torch.as_tensor(numbers, device=str(device))
    tensor = cast("Array", environment).detach()
    expected = f"shape () or ({count},), got {tuple(tensor.shape)}"
    check("environment", tuple(tensor.shape) in ((), (count,)), expected)
    _check_tensor(tensor, "environment", ("int32", "int64"), device)
    return tensor.expand(count).contiguous()


def _check_tensor(tensor: Array, name: str, dtypes: tuple[str, str], device: Device) -> None:
    """Raise ValueError for a tensor of another dtype, or on another device than the one
    that scans."""
    fits = str(tensor.dtype).removeprefix("torch.") in dtypes
    check(name, fits, f"{' or '.join(dtypes)}, got {tensor.dtype}")
    of_tensor = _device.of(tensor)
    expected = f"a tensor on {device}, which scans, got one on {of_tensor}"
    check(name, of_tensor == device and device != CPU, expected)


def _check_environments(numbers: npt.NDArray[np.int32], subject: Subject) -> None:
    """Raise ValueError for an environment that the subject does not have."""
    last = -1
    if isinstance(subject, Scene) and len(subject.environments):
        last = int(subject.environments.max())
    for number, value in enumerate(numbers.tolist()):
        expected = f"-1 to {last}, as the scene has, got {value}"
        check(f"environment[{number}]", value <= last, expected)


def _joined(planes: list[Array]) -> Array:
    if len(planes) == 1:
        return planes[0]
    return np.concatenate(planes)


def _viewmats(poses: Array) -> Array:
    """Return (B, 4, 4) the inverses of poses, in double precision."""
    if isinstance(poses, np.ndarray):
        viewmats: Floats = poses.copy()
        viewmats[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
        viewmats[:, :3, 3] = -np.einsum("bij,bj->bi", viewmats[:, :3, :3], poses[:, :3, 3])
        return viewmats
    viewmats_on_device = poses.double().clone()
    rotations = viewmats_on_device[:, :3, :3].mT.clone()
    places = viewmats_on_device[:, :3, 3:].clone()
    viewmats_on_device[:, :3, :3] = rotations
    viewmats_on_device[:, :3, 3:] = -(rotations * places.mT).sum(2, keepdim=True)
    return viewmats_on_device
