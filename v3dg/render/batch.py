"""Batches: pictures of one size for many cameras, drawn in one call."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from v3dg import _core
from v3dg._device import Device
from v3dg._numbers import Floats, check, check_type
from v3dg.camera_batch import CameraBatch, form_of
from v3dg.cameras import Camera, StereoCamera
from v3dg.image import ChannelPlanes, Planes, RenderedImage, Sensed, Stats
from v3dg.render.request import CutRequest

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from v3dg.gaussians import Array
    from v3dg.residency import ResidentScene


@dataclass(frozen=True, eq=False)
class BatchPlanes:
    """The memory for a batch's pictures. The arrays are contiguous and float32 (int32
    for ids). They are NumPy arrays, or torch tensors on the device that draws.

    Attributes:
        color: (B, H, W, 3) premultiplied colour with the background, or (B, H, W, 4)
            with alpha as the fourth channel.
        alpha: (B, H, W) opacity. None if it is not wanted, or is in `color`.
        depth: (B, H, W) expected depth along the camera's axis, 0 where nothing is
            drawn; None if it is not wanted.
        median_depth, weight: (B, H, W) channels (docs/sensors.md). None for each that
            is not wanted.
        normal: (B, H, W, 3), or None.
        instance, label: (B, H, W) int32, or None.
    """

    color: Array
    alpha: Array | None = None
    depth: Array | None = None
    median_depth: Array | None = None
    normal: Array | None = None
    instance: Array | None = None
    label: Array | None = None
    weight: Array | None = None

    @cached_property
    def core(self) -> _core.BatchPlanes:
        """The planes for the compiled operations. Raises ValueError if their sizes or
        devices do not match."""
        return _core.BatchPlanes(
            self.color,
            self.alpha,
            self.depth,
            median_depth=self.median_depth,
            normal=self.normal,
            instance=self.instance,
            label=self.label,
            weight=self.weight,
        )


class BatchStats(NamedTuple):
    """The costs of drawing a batch; see `Stats`.

    Attributes:
        gaussians_selected: (B,) int64.
        gaussians_in_frustum: (B,) int64.
        tolerance: In px², the same for all cameras.
        select_ms, draw_ms: On the CPU, sums over the cameras. On CUDA, 0 while a graph
            is captured.
        num_parts: The number of parts in which the batch was drawn, which depends on
            the memory.
    """

    gaussians_selected: NDArray[np.int64]
    gaussians_in_frustum: NDArray[np.int64]
    tolerance: float
    select_ms: float
    draw_ms: float
    num_parts: int


class RenderedBatch(Sensed):
    """B pictures of H x W pixels.

    CUDA may still be drawing the pictures. Reading an attribute waits until they are
    finished.
    """

    def __init__(self, core: _core.Batch, cameras: CameraBatch, tolerance: float) -> None:
        self._cameras = cameras
        self._core = core
        self._tolerance = tolerance
        self._stats: _core.BatchStats | None = None

    @property
    def planes(self) -> BatchPlanes:
        """The arrays of the attributes, without waiting. Use them for work that is
        queued on the same stream."""
        channels = self._core.channels
        return BatchPlanes(
            self._core.color,
            self._core.alpha,
            self._core.depth,
            median_depth=channels.median_depth,
            normal=channels.normal,
            instance=channels.instance,
            label=channels.label,
            weight=channels.weight,
        )

    def wait(self) -> None:
        """Wait until all pictures are drawn. If the buffers of the renderer were too
        small, draw the batch again. Reading an attribute does the same."""
        self._core.finish()

    @property
    def color(self) -> Array:
        """(B, H, W, 3) premultiplied colour with the background; (B, H, W, 4) if the
        planes have alpha as the fourth channel."""
        self._core.finish()
        return self._core.color

    @property
    def alpha(self) -> Array:
        """(B, H, W) opacity."""
        self._core.finish()
        return self._alpha

    @property
    def _alpha(self) -> Array:
        alpha = self._core.alpha
        if alpha is not None:
            return alpha
        if self._core.color.shape[-1] == 4:
            return self._core.color[..., 3]
        raise AttributeError("alpha: expected planes with alpha, got planes without")

    @property
    def depth(self) -> Array:
        """(B, H, W) expected depth along the axes of the cameras, 0 where nothing is
        drawn."""
        self._core.finish()
        depth = self._core.depth
        if depth is None:
            raise AttributeError(
                "depth: expected pictures that were drawn with depth=True, got others without"
            )
        return depth

    @property
    def distance(self) -> Array:
        """(B, H, W) expected distance from the eye along the ray through each pixel's
        centre, 0 where nothing is drawn. It is computed from the depth, with the
        current K of the cameras."""
        depth = self.depth
        if isinstance(depth, np.ndarray):
            return np.where(depth > 0, depth * ray_lengths(self._cameras), 0).astype(np.float32)
        import torch

        lengths = ray_lengths(self._cameras, depth)
        return torch.where(depth > 0, depth * lengths, 0).to(torch.float32)

    @property
    def _channels(self) -> _core.Channels:
        self._core.finish()
        return self._core.channels

    @property
    def stats(self) -> BatchStats:
        """The costs of drawing the pictures."""
        stats = self._core_stats()
        return BatchStats(
            gaussians_selected=np.array(stats.gaussians, np.int64),
            gaussians_in_frustum=np.array(stats.in_frustum, np.int64),
            tolerance=self._tolerance,
            select_ms=sum(stats.select_ms),
            draw_ms=sum(stats.draw_ms),
            num_parts=stats.num_parts,
        )

    def _core_stats(self) -> _core.BatchStats:
        if self._stats is None:
            self._stats = self._core.stats()
        return self._stats

    def picture_planes(self, number: int) -> Planes:
        """Return the planes of one picture. Waits until it is drawn."""
        self._core.finish()
        depth = self._core.depth
        if depth is not None:
            depth = depth[number]
        color = self._core.color[number][..., :3]
        return Planes(color, self._alpha[number], depth, _channels_of(self._channels, number))

    def picture_stats(self, number: int) -> Stats:
        """Return the costs of one picture. On CUDA, the times are those of the whole
        batch."""
        stats = self._core_stats()
        levels: tuple[int, ...] = ()
        if stats.levels:
            levels = tuple(stats.levels[number])
        times = min(number, len(stats.select_ms) - 1)
        return Stats(
            stats.gaussians[number],
            stats.in_frustum[number],
            self._tolerance,
            stats.select_ms[times],
            stats.draw_ms[times],
            levels,
        )

    def __len__(self) -> int:
        return len(self._core.color)

    def __getitem__(self, number: int) -> RenderedImage:
        """Return one picture."""
        if not -len(self) <= number < len(self):
            raise IndexError(f"picture: expected 0 to {len(self) - 1}, got {number}")
        return _PictureOfBatch(self, number % len(self))

    def __repr__(self) -> str:
        _, height, width = self._core.color.shape[:3]
        return f"RenderedBatch({len(self)} pictures of {width}x{height})"


def _channels_of(channels: _core.Channels, number: int) -> ChannelPlanes:
    """Return the channels of one picture of a batch."""

    def plane(of_all: Array | None) -> Array | None:
        if of_all is None:
            return None
        return of_all[number]

    return ChannelPlanes(
        median_depth=plane(channels.median_depth),
        normal=plane(channels.normal),
        instance=plane(channels.instance),
        label=plane(channels.label),
        weight=plane(channels.weight),
        clipped=plane(channels.clipped),
    )


class _PictureOfBatch(RenderedImage):
    """One picture of a batch."""

    def __init__(self, batch: RenderedBatch, number: int) -> None:
        self._batch = batch
        self._number = number

    @property
    def _planes(self) -> Planes:
        return self._batch.picture_planes(self._number)

    @property
    def stats(self) -> Stats:
        return self._batch.picture_stats(self._number)


class BatchRequest(NamedTuple):
    """Return the request for a batch. Without planes, new ones are created."""

    cameras: CameraBatch
    cut: CutRequest
    shade: _core.Shade
    planes: BatchPlanes | None
    sensor: _core.Sensor | None = None


def draw_batch(
    frame: _core.SceneFrame, resident: ResidentScene, device: Device, request: BatchRequest
) -> RenderedBatch:
    """Draw a batch of a scene whose gaussians are all resident."""
    cameras = request.cameras
    planes = None
    if request.planes is not None:
        planes = request.planes.core
    rule = request.cut.rule
    core_cameras = cameras.core_on(device)
    core = frame.draw_batch(
        resident.core, core_cameras, rule, request.shade, planes, request.sensor
    )
    resident.add_drawing(core)
    return RenderedBatch(core, cameras, rule.tolerance_px2)


def ray_lengths(cameras: CameraBatch, depth: Array | None = None) -> Array:
    """Return the distances from the eyes to depth 1 along the rays through the centres
    of pixels, (B, H, W) or (1, H, W), in double precision. The result is an array on
    the host, or a tensor on the device of `depth`. For a fisheye camera, it is 1,
    because its depth is already a distance."""
    if cameras.lenses is not None:
        return np.stack([_ray_lengths_of_lens(camera) for camera in cameras.lenses])
    K: Array = cameras.K
    columns: Array = np.arange(cameras.width) + 0.5
    rows: Array = np.arange(cameras.height) + 0.5
    if depth is not None:
        import torch

        if isinstance(K, np.ndarray):
            K = np.array(K)  # a copy, because torch warns about read-only arrays
        K, columns, rows = (
            torch.as_tensor(array, dtype=torch.float64, device=depth.device)
            for array in (K, columns, rows)
        )
    K = K.reshape(-1, 3, 3)
    x = (columns[None, :] - K[:, 0, 2, None]) / K[:, 0, 0, None]
    y = (rows[None, :] - K[:, 1, 2, None]) / K[:, 1, 1, None]
    return (x[:, None, :] ** 2 + y[:, :, None] ** 2 + 1) ** 0.5


def _ray_lengths_of_lens(camera: Camera) -> Floats:
    """Return (H, W) distances; 0 outside the image circle of a lens."""
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    directions = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
    lengths = np.nan_to_num(np.linalg.norm(directions, axis=1))
    return np.asarray(lengths.reshape(camera.height, camera.width))


def check_planes(planes: BatchPlanes | None, *, with_depth: bool) -> None:
    """Raise TypeError if planes are not `BatchPlanes`. Raise ValueError if the depth
    was requested and they have no plane for it."""
    if planes is None:
        return
    check_type("out", planes, BatchPlanes, "a BatchPlanes")
    check("out", planes.depth is not None or not with_depth, "planes with depth, got none")


def are_alike(cameras: Sequence[Camera | StereoCamera]) -> bool:
    """Return whether cameras can be drawn as one batch. There must be at least two
    pinhole cameras of one size and one near plane."""
    pinholes = [camera for camera in cameras if type(camera) is Camera and not camera.is_distorted]
    if len(cameras) < 2 or len(pinholes) < len(cameras):
        return False
    return len({form_of(camera) for camera in pinholes}) == 1
