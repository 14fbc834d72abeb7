"""Frames: the buffers for pictures of one subject on one device. Also chooses the frame
for a subject."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol, get_args

from v3dg import _core
from v3dg._device import Device
from v3dg._numbers import check, one_of
from v3dg.cameras import Camera, StereoCamera
from v3dg.false_color import ColorBy
from v3dg.gaussians import Gaussians
from v3dg.pool import PoolSlot, chosen_bytes
from v3dg.render.asset_frame import AssetFrame
from v3dg.render.picture import Picture
from v3dg.render.pool_frame import PoolFrame
from v3dg.render.request import CutRequest, FrameRequest
from v3dg.render.scene_frame import SceneFrame
from v3dg.render.webgpu.frame import WebGpuFrame, check_subject
from v3dg.residency import ResidentScene, residency

if TYPE_CHECKING:
    import weakref

    from v3dg.bundle import Bundle
    from v3dg.scene import Subject


class Frame(Protocol):
    """The buffers for pictures of one subject. A frame does not keep a scene or a
    bundle alive."""

    def draw(
        self,
        subject: Subject,
        request: FrameRequest,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
    ) -> Picture:
        """Draw what is resident. For a stereo camera, draw one picture per eye.

        Args:
            steps: Pacing state of a sequence of pictures; None for a single picture.
            stop: On the CPU, ends a picture early.
        """

    def draw_settled(self, subject: Subject, request: FrameRequest) -> Picture:
        """Draw a picture in which no page is missing, whatever other threads draw."""

    def settle(
        self, subject: Subject, camera: Camera | StereoCamera, cut: CutRequest, timeout: float
    ) -> None:
        """Wait until everything that a view needs is resident."""


class FrameSource(Protocol):
    """Provides the frame for drawing a subject on one device. The frame can change when
    the subject grows."""

    device: Device

    @property
    def memory(self) -> int | None:
        """The size of the frame's pool in bytes; None if everything is resident."""

    def chosen(self, subject: Subject) -> Frame:
        """Return the frame that currently draws the subject."""


class AutoFrame:
    """Draws with all gaussians resident if they fit, and otherwise from a pool.

    The choice is made on construction, and again when bundles are added. A pool is
    kept, even if everything would fit later.

    Attributes:
        device: The device that draws.
    """

    def __init__(self, color_by: ColorBy, device: Device, slot: PoolSlot) -> None:
        self.device = device
        self._color_by = color_by
        self._slot = slot
        self._frame: SceneFrame | PoolFrame = SceneFrame(color_by, device)
        self._references: tuple[weakref.ref[Bundle], ...] | None = None
        self._resident: ResidentScene | None = None

    @property
    def memory(self) -> int | None:
        return self._frame.memory

    def chosen(self, subject: Subject) -> SceneFrame | PoolFrame:
        """Return the frame that currently draws the subject."""
        with residency.turn(self.device):
            if self._resident is None or not self._resident.is_of(subject):
                resident = residency.scene(subject, self.device)
                self._resident = resident
                if self._references is not resident.references:
                    self._choose(resident)
            return self._frame

    def _choose(self, resident: ResidentScene) -> None:
        with residency.lock:
            frame = self._frame
            bundles = resident.bundles
            if isinstance(frame, SceneFrame) and frame.num_bundles < len(bundles):
                num_bytes = self._slot.num_bytes or chosen_bytes(bundles, self.device)
                if num_bytes is not None:
                    self._frame = PoolFrame(self._color_by, self.device, num_bytes, self._slot)
            self._frame.take(resident)
            self._references = resident.references


def frame_of(
    subject: Subject,
    color_by: ColorBy,
    device: Device,
    memory: int | Literal["auto"] | None,
    slot: PoolSlot,
) -> FrameSource:
    """Return a new frame for pictures of a subject.

    Args:
        memory: Bytes of a pool; "auto" and None as in `v3dg.Renderer`.
        slot: Where the frame stores its pool if it has one.

    Raises:
        ValueError: `color_by` or `memory` is invalid; see `v3dg.Renderer`.
    """
    one_of(color_by, "color_by", get_args(ColorBy))
    if device.is_webgpu:
        check_subject(subject, color_by, memory)
        return WebGpuFrame()
    if isinstance(subject, Gaussians):
        is_without = memory is None or memory == "auto"
        check(
            "memory",
            is_without,
            f"None for an asset, which has no pages, got {memory}; leave it out",
        )
        return AssetFrame(subject, color_by, device)
    frame: SceneFrame | PoolFrame | AutoFrame
    if memory is None:
        frame = SceneFrame(color_by, device)
    elif memory != "auto":
        frame = PoolFrame(color_by, device, memory, slot)
    elif device.is_cuda and color_by != "appearance":  # a pool on a GPU supports no other colours
        frame = SceneFrame(color_by, device)
    else:
        frame = AutoFrame(color_by, device, slot)
    if isinstance(frame, AutoFrame):
        frame.chosen(subject)
        return frame
    with residency.turn(device):
        frame.take(residency.scene(subject, device))
    return frame
