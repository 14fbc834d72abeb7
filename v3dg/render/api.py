"""`v3dg.render`: single pictures, each with all pages that it needs."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, TypeAlias, cast, get_args, overload

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check, one_of, vector, whole
from v3dg.camera_batch import CameraBatch
from v3dg.cameras import AXES, Axis, Camera, StereoCamera, VectorLike, are_several, check_camera
from v3dg.false_color import ColorBy
from v3dg.framing import frame_subject
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage
from v3dg.levels.memory import pool_bytes
from v3dg.opening import File, open_with_cameras, opened
from v3dg.pool import PoolSlot
from v3dg.render.batch import BatchRequest, are_alike
from v3dg.render.frame import Frame, FrameSource, frame_of
from v3dg.render.rays import RayImage, check_rays, draw_rays
from v3dg.render.request import BLACK, CutRequest, FrameRequest, shade_of
from v3dg.render.scene_frame import SceneFrame
from v3dg.render.sensor import Channel, Meshes, MeshLayer, layers_of, sensor_of
from v3dg.residency import residency
from v3dg.scene import Subject
from v3dg.select import CutOptions, Selection
from v3dg.spherical import EquirectangularCamera
from v3dg.upright import direction_of, up_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Unpack


_MOST_PIXELS_A_CALL = 1 << 22
_Camera: TypeAlias = "Camera | StereoCamera | EquirectangularCamera | Sequence[Camera]"
_Pictures: TypeAlias = RenderedImage | tuple[RenderedImage, RenderedImage] | list[RenderedImage]


class _Options(CutOptions, total=False):
    cut: Selection | None
    background: Sequence[float]
    min_transmittance: float | None
    depth: bool
    channels: Sequence[Channel]
    mesh: Meshes | None
    device: str | Device
    color_by: ColorBy
    memory: int | str | None


@overload
def render(
    subject: Subject | File, camera: Camera | None = None, **options: Unpack[_Options]
) -> RenderedImage: ...
@overload
def render(
    subject: Subject | File, camera: StereoCamera, **options: Unpack[_Options]
) -> tuple[RenderedImage, RenderedImage]: ...
@overload
def render(
    subject: Subject | File, camera: EquirectangularCamera, **options: Unpack[_Options]
) -> RayImage: ...
@overload
def render(
    subject: Subject | File, camera: Sequence[Camera], **options: Unpack[_Options]
) -> list[RenderedImage]: ...
def render(
    subject: Subject | File,
    camera: _Camera | None = None,
    *,
    tolerance: float | None = None,
    budget: int | None = None,
    min_level: int = 0,
    fade: float | None = None,
    cut: Selection | None = None,
    color_by: ColorBy = "appearance",
    background: Sequence[float] = BLACK,
    min_transmittance: float | None = None,
    depth: bool = False,
    channels: Sequence[Channel] = (),
    mesh: Meshes | None = None,
    device: str | Device = "auto",
    memory: int | str | None = "auto",
) -> RayImage | _Pictures:
    """Draw a scene, one bundle or one asset, for one camera or for several.

    Clusters whose gaussians each cover at most `tolerance` px² replace finer ones.
    Level 0 is drawn with the asset's own filter, and coarser levels with the filter
    that they were fitted for (V3DG, section 3.4; docs/levels.md defines the metric). An
    asset is drawn completely and without a filter. An asset that was trained with
    antialiasing (`Gaussians.antialiased`) is drawn as in training, with a filter of 0.3
    px² and compensated opacities.

    Args:
        subject: What to draw, in world space. If it is the path of a file, every call
            opens the file again.
        camera: Camera of any model, or several cameras. Each of several cameras has its
            own cut and its own picture, as if it were drawn alone. Pinhole cameras of
            one size and one near plane are drawn at once, unless there is a budget, a
            cut or a pool (docs/sensors.md). The two eyes of a stereo camera share one
            cut and one frame. Their two pictures have common statistics, which are
            sums, except for the number of selected gaussians. None means the first
            camera of a scene's file, else the camera of `first_camera`. For an
            `EquirectangularCamera`, all gaussians must be resident, and there are no
            statistics. It does not support `budget`, `cut`, `min_transmittance`,
            `mesh`, channels other than "depth", or a number of bytes as `memory`.
        tolerance, budget, min_level: As in `v3dg.select`.
        fade: As in `v3dg.select`. The weight of a cluster multiplies its opacities. Use
            `v3dg.DEFAULT_FADE` for films.
        cut: A cut that was selected earlier from this scene. It is drawn for any
            camera, so that it can be inspected from all sides. It replaces `tolerance`,
            `budget`, `min_level` and `fade`.
        color_by: "level" or "cluster" colours gaussians by their level or cluster;
            "residency" shows where pages are missing.
        background: The colour behind all gaussians, as three numbers.
        min_transmittance: A pixel stops when its transmittance is at most this value, 0
            to 0.99; the remaining light is distributed over the gaussians that were
            blended. So the error of a channel is at most this fraction of the
            difference to the colour behind the last gaussian. None depends on the
            subject. For scenes and bundles, it means 0.0001 up to a tolerance of 3 px²,
            and then a value that grows to 0.001 at 9.5 px², because the errors of
            coarser levels are larger. With a budget, the tolerance that meets the
            budget counts. Assets are drawn as by `v3dg.rasterize`.
        depth: Whether to draw the expected depth, too.
        channels: Names of channels to draw in addition to colour and alpha. They become
            attributes of the picture: "depth" (as `depth=True`), "median_depth",
            "normal", "instance", "label", "weight", "clipped" (docs/sensors.md).
            "clipped" needs a pinhole camera.
        mesh: A picture of meshes, of the same size. Its pixels hide the gaussians
            behind them. Colour, alpha and channels include gaussians and meshes. For
            several cameras, pass a list with a layer for each of them, or one layer
            with planes (B, H, W). For a stereo camera, pass two layers, or one layer
            with planes (2, H, W).
        device: "cpu" draws NumPy arrays. "cuda", or a specific device such as "cuda:1",
            draws torch tensors on that device, on torch's current stream. What the next
            picture of the same scene or bundle needs stays on the device; use a
            `Renderer` to control how long. "auto" means "cuda" if it works, otherwise
            "cpu". "webgpu" draws NumPy arrays on a GPU of any maker, only for pinhole
            cameras, and only colour and alpha (docs/webgpu.md).
        memory: As in `Renderer`. Each picture waits for all pages that it needs.

    Raises:
        ValueError: An argument is invalid, or the coarsest cut has more gaussians than
            the budget. On CUDA, the latter is raised when the picture is used.
        RuntimeError: `device` is "cuda" or "webgpu", and something that it needs is
            missing.
        ImportError: `device` is "webgpu", and the package wgpu is missing.
    """
    opened_subject, camera = _with_camera(subject, camera)
    cut_request = CutRequest(tolerance, budget, min_level, fade)
    if isinstance(camera, EquirectangularCamera):
        with_depth, sensor = sensor_of(channels, mesh, depth=depth, device=_device.CPU)
        check_rays(color_by, cut, sensor, min_transmittance, memory)
        return draw_rays(opened_subject, camera, cut_request, background, device, depth=with_depth)
    chosen_device = _device.resolve_for_drawing(device)
    frame = _still_frame(opened_subject, color_by, chosen_device, pool_bytes(memory))
    is_asset = isinstance(opened_subject, Gaussians)
    with_depth, _ = sensor_of(channels, None, depth=depth)
    shade = shade_of(background, min_transmittance, is_asset=is_asset, depth=with_depth)
    look = _Look(cut_request, shade, cut, channels, chosen_device)
    chosen_frame = frame.chosen(opened_subject)
    if are_several(camera):
        return _draw_several(chosen_frame, opened_subject, list(camera), mesh, look)
    check_camera(camera)
    view = cast("Camera | StereoCamera", camera)
    return chosen_frame.draw_settled(opened_subject, look.picture(view, mesh))


@dataclass(frozen=True)
class _Look:
    """The requests for pictures that differ only in their cameras and their meshes."""

    cut: CutRequest
    shade: _core.Shade
    selection: Selection | None
    channels: Sequence[Channel]
    device: Device

    def picture(self, camera: Camera | StereoCamera, mesh: Meshes | None) -> FrameRequest:
        sensor = self._sensor(mesh)
        return FrameRequest(camera, self.cut, self.shade, self.selection, sensor=sensor)

    def batch(self, cameras: Sequence[Camera], layers: Sequence[MeshLayer]) -> BatchRequest:
        """Return the request for a batch; without layers, it has no meshes."""
        sensor = self._sensor(layers or None)
        return BatchRequest(CameraBatch.of(cameras), self.cut, self.shade, None, sensor)

    def _sensor(self, mesh: Meshes | None) -> _core.Sensor | None:
        return sensor_of(self.channels, mesh, depth=False, device=self.device)[1]


def _draw_several(
    frame: Frame,
    subject: Subject,
    cameras: Sequence[Camera | StereoCamera],
    mesh: Meshes | None,
    look: _Look,
) -> _Pictures:
    """Return the picture of each camera. All of them are checked before the first one
    is drawn."""
    for camera in cameras:
        check_camera(camera)
    layers = layers_of(mesh, cameras)
    is_free = look.selection is None and look.cut.budget is None
    if is_free and isinstance(frame, SceneFrame) and are_alike(cameras):
        return _pictures_at_once(frame, subject, cast("Sequence[Camera]", cameras), layers, look)
    meshes: Sequence[MeshLayer | None] = layers or [None] * len(cameras)
    requests = [look.picture(*pair) for pair in zip(cameras, meshes, strict=True)]
    return cast("_Pictures", [frame.draw_settled(subject, request) for request in requests])


def _pictures_at_once(
    frame: SceneFrame,
    subject: Subject,
    cameras: Sequence[Camera],
    layers: Sequence[MeshLayer],
    look: _Look,
) -> list[RenderedImage]:
    """Return pictures that are drawn as batches. A CUDA device draws all of them in one
    call. The CPU draws a few at a time, so that the program can be interrupted."""
    first = cameras[0]
    size = len(cameras)
    if not frame.device.is_cuda:
        size = max(1, _MOST_PIXELS_A_CALL // (first.width * first.height))
    requests = [
        look.batch(cameras[begin : begin + size], layers[begin : begin + size])
        for begin in range(0, len(cameras), size)
    ]
    pictures: list[RenderedImage] = []
    for request in requests:
        batch = frame.draw_batch(subject, request)
        pictures += [batch[number] for number in range(len(request.cameras))]
    return pictures


def first_camera(
    subject: Subject | File,
    width: int = 800,
    height: int = 800,
    *,
    up: Axis | VectorLike | None = None,
) -> Camera:
    """Return the default camera for a subject, which the viewer and `v3dg render` also
    use. It shows an object completely, from its front and slightly above. It shows a
    room from its middle.

    The field of view across the shorter side is 45 degrees, and 65 degrees inside a
    room.

    Args:
        subject: A scene, a bundle, an asset, or the path of a file with one of them.
        width, height: Size of the picture in px.
        up: The axis or direction that points up. None uses the axis of
            `v3dg.upright.up_of`.

    Raises:
        ValueError: An argument is invalid.
    """
    width = whole(width, "width", "a positive whole number", 1)
    height = whole(height, "height", "a positive whole number", 1)
    content: Subject = opened(subject)
    if up is None:
        up = up_of(content)[0]
    if isinstance(up, str):
        one_of(up, "up", AXES)
        up = direction_of(up)
    direction = vector(up, "up")
    check("up", direction.any(), "a direction other than zero, got (0, 0, 0)")
    return frame_subject(content).camera(direction, width, height)


def _with_camera(subject: Subject | File, camera: _Camera | None) -> tuple[Subject, _Camera]:
    """Return an opened subject and a camera.

    If the camera is None, it is the default camera.
    """
    if camera is None:
        return _with_first_camera(subject)
    return opened(subject), camera


def _with_first_camera(subject: Subject | File) -> tuple[Subject, Camera]:
    """Return a subject and its default camera: the first camera in its file, else the
    camera of `first_camera`."""
    if not isinstance(subject, str | os.PathLike):
        return subject, first_camera(subject)
    path = Path(subject)
    content, cameras = open_with_cameras(path)
    if cameras:
        return content, next(iter(cameras.values()))
    return content, first_camera(content, up=up_of(content)[0])


def _still_frame(
    subject: Subject, color_by: ColorBy, device: Device, memory: int | Literal["auto"] | None
) -> FrameSource:
    """Return the frame for single pictures of a subject. The frame of a scene or of a
    bundle is stored with the subject.

    Frames that differ only in `color_by` share a pool. If the size of the pool is
    given, only the most recent pool is kept.
    """
    one_of(color_by, "color_by", get_args(ColorBy))
    if isinstance(subject, Gaussians):
        return frame_of(subject, color_by, device, memory, PoolSlot())
    is_sized = isinstance(memory, int)
    slot = residency.once(subject, ("pool", device, is_sized), PoolSlot)

    def make() -> FrameSource:
        return frame_of(subject, color_by, device, memory, slot)

    if is_sized:
        return residency.last(subject, ("frame", color_by, device), memory, make)
    return residency.once(subject, ("frame", color_by, device, memory), make)
