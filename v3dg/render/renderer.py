"""`v3dg.Renderer`: sequences of pictures of one subject."""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import real
from v3dg.camera_batch import CameraBatch
from v3dg.cameras import Camera, StereoCamera, check_camera
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage
from v3dg.levels.memory import in_mib, pool_bytes
from v3dg.opening import File, opened
from v3dg.pool import PoolSlot
from v3dg.render.batch import BatchPlanes, BatchRequest, RenderedBatch, check_planes
from v3dg.render.frame import frame_of
from v3dg.render.pool_frame import PoolFrame
from v3dg.render.request import BLACK, CutRequest, FrameRequest, shade_of
from v3dg.render.scene_frame import SceneFrame
from v3dg.render.sensor import Channel, Meshes, sensor_of
from v3dg.scene import Subject
from v3dg.select import CutOptions, Selection

if TYPE_CHECKING:
    from collections.abc import Sequence

    from typing_extensions import Unpack


class _Options(CutOptions, total=False):
    cut: Selection | None
    background: Sequence[float]
    min_transmittance: float | None
    depth: bool
    channels: Sequence[Channel]
    mesh: Meshes | None


class Renderer:
    """Draws one scene, bundle or asset on one device, with its own buffers.

    On a CUDA device, pictures are enqueued on torch's current stream without waiting.
    So pictures can be drawn ahead, and captured in a CUDA graph. Before a capture, draw
    everything that the graph will draw, so that it is on the device. Otherwise the
    capture of `render` raises RuntimeError. Keep the renderer as long as the graph, and
    capture again after changes of the scene. When a scene changes, pictures in progress
    are finished first.

    With a budget and a fade, pictures count as a sequence. The tolerance approaches, in
    steps, the value at which a part of the budget is free, so that slow motion is
    steady. It is never below that of `v3dg.render`. When the camera stops, it arrives
    after eight pictures (docs/fades.md). Without a fade, pictures equal those of
    `v3dg.render`.

    With a pool, only a part of the bundles is resident, so the bundles may be far
    larger than memory. Other threads read pages from the files as views need them. A
    picture does not wait for pages. Where one is missing, the coarser clusters above it
    are drawn. With a fade, pages fade in. Use `settle` for a picture in which no page
    is missing. If a view needs more pages than fit, the tolerance is raised until they
    fit.

    Args:
        subject: As in `v3dg.render`.
        color_by: As in `v3dg.render`. With a pool on a CUDA device, only "appearance"
            is allowed.
        device: As in `v3dg.render`. The renderer keeps using this device if torch's
            current device changes.
        memory: Size of a pool for gaussians on the device, as bytes or text like "2GB".
            None keeps all gaussians resident. "auto" means None if all of them fit into
            the free memory, minus a reserve of a quarter of that memory, but at most 1
            GiB. If they do not fit, it means half of the free memory.

    Raises:
        RuntimeError: The device is not available; for "webgpu", this is raised when the
            first picture is drawn.
        ValueError: `memory` has no room for the coarsest level, or the coarsest page of
            a file is damaged.
    """

    def __init__(
        self,
        subject: Subject | File,
        *,
        color_by: ColorBy = "appearance",
        device: str | Device = "auto",
        memory: int | str | None = "auto",
    ) -> None:
        self._subject: Subject = opened(subject)
        self._frame = frame_of(
            self._subject,
            color_by,
            _device.resolve_for_drawing(device),
            pool_bytes(memory),
            PoolSlot(),
        )
        self._steps = _core.BudgetSteps()
        self._has_drawn_batch = False

    @property
    def memory(self) -> int | None:
        """The size of the renderer's pool in bytes; None if everything is resident."""
        return self._frame.memory

    def __repr__(self) -> str:
        memory = "all is resident"
        if self.memory is not None:
            memory = f"a pool of {in_mib(self.memory)}"
        return f"Renderer({self._subject!r}, {self._frame.device}, {memory})"

    @property
    def subject(self) -> Subject:
        """The subject of the pictures."""
        return self._subject

    @property
    def pool_frame(self) -> PoolFrame | None:
        """The renderer's frame if it has a pool, else None. This is not part of the
        public interface."""
        frame = self._frame.chosen(self._subject)
        if isinstance(frame, PoolFrame):
            return frame
        return None

    @overload
    def render(self, camera: Camera, **options: Unpack[_Options]) -> RenderedImage: ...
    @overload
    def render(
        self, camera: StereoCamera, **options: Unpack[_Options]
    ) -> tuple[RenderedImage, RenderedImage]: ...
    def render(
        self,
        camera: Camera | StereoCamera,
        *,
        tolerance: float | None = None,
        budget: int | None = None,
        min_level: int = 0,
        fade: float | None = None,
        cut: Selection | None = None,
        background: Sequence[float] = BLACK,
        min_transmittance: float | None = None,
        depth: bool = False,
        channels: Sequence[Channel] = (),
        mesh: Meshes | None = None,
    ) -> RenderedImage | tuple[RenderedImage, RenderedImage]:
        """Draw a picture with what is resident. The arguments are those of
        `v3dg.render`."""
        check_camera(camera)
        subject = self._subject
        is_asset = isinstance(subject, Gaussians)
        device = self._frame.device
        with_depth, sensor = sensor_of(channels, mesh, depth=depth, device=device)
        shade = shade_of(background, min_transmittance, is_asset=is_asset, depth=with_depth)
        cut_request = CutRequest(tolerance, budget, min_level, fade)
        request = FrameRequest(camera, cut_request, shade, cut, sensor=sensor)
        return self._frame.chosen(subject).draw(subject, request, self._steps)

    def render_batch(
        self,
        cameras: CameraBatch | Sequence[Camera],
        *,
        tolerance: float | None = None,
        min_level: int = 0,
        fade: float | None = None,
        background: Sequence[float] = BLACK,
        min_transmittance: float | None = None,
        depth: bool = False,
        channels: Sequence[Channel] = (),
        mesh: Meshes | None = None,
        out: BatchPlanes | None = None,
    ) -> RenderedBatch:
        """Draw a picture for each of many cameras of one size, in one call. Cuts and
        pixels equal those of pictures that are drawn one by one.

        On a CUDA device, the number of kernels does not depend on the number of
        cameras. Nothing is copied to the host, and the call returns when its work is
        queued on torch's current stream. If the tensors of the cameras are on the
        device, they are read when the work runs. Therefore a captured CUDA graph draws
        the values that they have when it is replayed. A batch that does not fit into
        the memory is drawn in parts. On the CPU, each thread draws one camera at a
        time.

        Buffers grow to the size that batches need. If they were too small for a batch,
        its pictures are NaN until it is drawn again by `wait`, or by reading an
        attribute of the result. The first batch of a renderer waits for that itself.

        Args:
            cameras: The cameras; `Camera`s of one size and one near plane are also
                accepted.
            tolerance: As in `v3dg.select`; so are `min_level` and `fade`. A batch has
                no budget.
            background: As in `v3dg.render`; so are `min_transmittance` and `depth`.
            channels: As in `v3dg.render`. Channels without planes in `out` are new
                arrays.
            mesh: As in `v3dg.render` for a list of cameras.
            out: Where to write colour and, if it has planes for them, alpha, depth and
                channels. The planes belong to the caller. They are valid after the
                result was read or, on the same stream, as soon as the buffers are large
                enough. None creates new arrays of colour, alpha and, if requested,
                depth.

        Raises:
            ValueError: An argument is invalid (for a camera, the message has its
                index), or the renderer draws an asset or uses a pool.
        """
        if not isinstance(cameras, CameraBatch):
            cameras = CameraBatch.of(cameras)
        device = self._frame.device
        with_depth, sensor = sensor_of(channels, mesh, depth=depth, device=device)
        check_planes(out, with_depth=with_depth)
        subject = self._subject
        shade = shade_of(background, min_transmittance, is_asset=False, depth=with_depth)
        cut = CutRequest(tolerance, None, min_level, fade)
        frame = self._frame.chosen(subject)
        if device.is_webgpu:
            raise ValueError(
                "renderer: a batch is drawn on the CPU or with CUDA, got device='webgpu'; draw "
                "pictures one by one"
            )
        if not isinstance(frame, SceneFrame):
            raise ValueError(
                "renderer: a batch needs a scene or a bundle that is resident as a whole; "
                "give memory=None"
            )
        request = BatchRequest(cameras, cut, shade, out, sensor)
        batch = frame.draw_batch(subject, request)
        if not self._has_drawn_batch:
            batch.wait()
            self._has_drawn_batch = True
        return batch

    def settle(
        self,
        camera: Camera | StereoCamera,
        *,
        tolerance: float | None = None,
        budget: int | None = None,
        min_level: int = 0,
        fade: float | None = None,
        timeout: float = 30.0,
    ) -> None:
        """Wait until everything that a view needs is resident, so that no page is
        missing in its picture.

        The next picture is then the same, bit for bit, as if everything were resident.
        If the pool is too small for that, the next picture has a larger tolerance,
        which its statistics report. On a CUDA device, drawing the next picture waits
        until the GPU has finished it. If everything is resident, this function returns
        immediately. Threads that share a renderer may evict each other's pages between
        `settle` and `render`; `v3dg.render` does both in one step.

        Args:
            timeout: If no page arrives for this many seconds, TimeoutError is raised.

        Raises:
            ValueError: A page is damaged; the message names it.
            OSError: A page cannot be read.
        """
        real(timeout, "timeout", "seconds, at least 0", 0)
        cut = CutRequest(tolerance, budget, min_level, fade)
        cut.rule  # noqa: B018 - the property checks the values
        self._frame.chosen(self._subject).settle(self._subject, camera, cut, timeout)
