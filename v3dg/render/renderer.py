"""`v3dg.Renderer`: pictures of one subject that follow each other."""

from __future__ import annotations

from typing import TYPE_CHECKING, overload

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import real
from v3dg.cameras import Camera, StereoCamera, check_camera
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.image import RenderedImage
from v3dg.levels.memory import in_mib, pool_bytes
from v3dg.opening import File, opened
from v3dg.pool import PoolSlot
from v3dg.render.frame import frame_of
from v3dg.render.pool_frame import PoolFrame
from v3dg.render.request import BLACK, CutRequest, FrameRequest, shade_of
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


class Renderer:
    """Draws one scene, bundle or asset on one device, with buffers of its own.

    On a CUDA device, enqueuing a picture on torch's current stream there waits for
    nothing, so pictures can be drawn ahead, and captured in a CUDA graph: draw once
    what the graph will meet, so that it is all on the device, then capture `render`;
    what was not drawn before is a RuntimeError. Keep the renderer as long as the graph,
    and capture again when the scene has changed. A picture that is under way when its
    scene is changed is finished first.

    With a budget and a fade, pictures are taken to follow each other: the tolerance
    goes in steps to the one at which a part of the budget is free, never below that of
    `render`, so that slow motion is steady; at rest it is there after eight pictures
    (docs/fades.md). Without a fade, pictures are those of `render`.

    With a pool, only a part of the bundles is resident, so that they may be far larger
    than memory: pages come in from the files as views need them, read by other threads.
    A picture waits for none of them: where one is missing, the coarser clusters above
    it are drawn; with a fade, pages fade in. Use `settle` for a picture that misses
    nothing. If a view needs more than there is room for, the tolerance is raised until
    it fits.

    Args:
        subject: As in `v3dg.render`.
        color_by: As in `v3dg.render`; with a pool on a CUDA device, "appearance".
        device: As in `v3dg.render`. The renderer stays on it, whichever device is
            torch's current one later.
        memory: Of a pool for gaussians on the device: bytes, or text like "2GB". All
            are resident if None. "auto" is None where all fit into what is free, less a
            quarter of that or 1 GiB; else half of it.

    Raises:
        RuntimeError: Something is missing for the device.
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
            self._subject, color_by, _device.resolve(device), pool_bytes(memory), PoolSlot()
        )
        self._steps = _core.BudgetSteps()

    @property
    def memory(self) -> int | None:
        """Bytes of the pool that it draws from; None where all is resident."""
        return self._frame.memory

    def __repr__(self) -> str:
        memory = "all is resident"
        if self.memory is not None:
            memory = f"a pool of {in_mib(self.memory)}"
        return f"Renderer({self._subject!r}, {self._frame.device}, {memory})"

    @property
    def subject(self) -> Subject:
        """What it draws."""
        return self._subject

    @property
    def pool_frame(self) -> PoolFrame | None:
        """What it draws with where not all is resident; else None. Not part of the
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
    ) -> RenderedImage | tuple[RenderedImage, RenderedImage]:
        """Draw as `v3dg.render` does, of what is resident."""
        check_camera(camera)
        subject = self._subject
        shade = shade_of(background, min_transmittance, isinstance(subject, Gaussians), depth)
        cut_request = CutRequest(tolerance, budget, min_level, fade)
        request = FrameRequest(camera, cut_request, shade, cut)
        return self._frame.chosen(subject).draw(subject, request, self._steps)

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
        """Wait until what a view needs is resident, so that its picture misses nothing.

        The picture is then the same, bit for bit, as if all were resident; or as it is
        at the tolerance that it says, where there is not enough room. That holds for
        the next picture, which is waited for, too, on a CUDA device. Returns at once
        where all is resident. Threads that share a renderer may take each other's pages
        between the two calls; `v3dg.render` settles and draws in one step.

        Args:
            timeout: Seconds after which it gives up if not a single page came in.

        Raises:
            ValueError: A page is damaged; the message says which.
            OSError: A page cannot be read. A TimeoutError if the disk does not answer.
        """
        real(timeout, "timeout", "seconds, at least 0", 0)
        cut = CutRequest(tolerance, budget, min_level, fade)
        cut.rule  # noqa: B018 - which checks it
        self._frame.chosen(self._subject).settle(self._subject, camera, cut, timeout)
