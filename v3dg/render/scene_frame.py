"""The frame of a scene whose gaussians are all resident."""

from __future__ import annotations

from typing import TYPE_CHECKING

from v3dg import _core
from v3dg._device import Device
from v3dg._numbers import check, check_type
from v3dg.bundle import Bundle
from v3dg.cameras import Camera, StereoCamera
from v3dg.false_color import ColorBy
from v3dg.gaussians import Array
from v3dg.image import RenderedImage, Stats
from v3dg.render.batch import BatchRequest, RenderedBatch, draw_batch
from v3dg.render.picture import Picture, picture_of, stats_of
from v3dg.render.request import CutRequest, FrameRequest
from v3dg.render.resident_frame import ResidentFrame
from v3dg.residency import ResidentScene, residency
from v3dg.scene import Scene
from v3dg.select import Selection, over_budget

if TYPE_CHECKING:
    from collections.abc import Sequence

    from v3dg.scene import Subject


class SceneFrame(ResidentFrame):
    """Draws a scene or a bundle on one device, with all gaussians resident.

    The frame does not keep the subject alive.

    Attributes:
        memory: None, because this frame has no pool.
    """

    def __init__(self, color_by: ColorBy, device: Device) -> None:
        super().__init__(device)
        self.memory: int | None = None
        self.core = _core.SceneFrame(device.number)
        self._color_by = color_by

    def _set_models(self, bundles: Sequence[Bundle]) -> None:
        residency.set_models(self.core, bundles, self.device, self._color_by)

    def chosen(self, subject: Subject) -> SceneFrame:
        """Return this frame."""
        return self

    def draw(
        self,
        subject: Subject,
        request: FrameRequest,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
    ) -> Picture:
        """Draw the requested cut."""
        camera, cut, shade, selection, _, sensor = request
        if selection is not None:
            if isinstance(camera, StereoCamera):
                left, right = (
                    self._draw_given(subject, request.of_eye(number), selection, eye, stop)
                    for number, eye in enumerate(camera.eyes)
                )
                return left, right
            return self._draw_given(subject, request, selection, camera, stop)
        rule = cut.rule
        with residency.turn(self.device):
            resident = self._taken(subject)
            core_request = _core.FrameRequest(camera.core, rule, shade, None, None, sensor)
            drawing = self.core.draw(resident.core, core_request, None, steps, stop)
            resident.add_drawing(drawing)

        def finish() -> Stats:
            stats = drawing.finish()
            if cut.budget is None:
                return stats_of(stats, rule.tolerance_px2)
            if stats.exceeds_budget:
                raise over_budget(cut.budget, stats.gaussians)
            return stats_of(stats, stats.tolerance_px2)

        if not self.device.is_cuda:
            finish()
        return picture_of(drawing, camera, finish)

    draw_settled = draw

    def draw_batch(self, subject: Subject, request: BatchRequest) -> RenderedBatch:
        """Draw a picture for each camera of a batch."""
        with residency.turn(self.device):
            resident = self._taken(subject)
            return draw_batch(self.core, resident, self.device, request)

    def settle(
        self, subject: Subject, camera: Camera | StereoCamera, cut: CutRequest, timeout: float
    ) -> None:
        """Return immediately, because everything is resident."""

    def _draw_given(
        self,
        subject: Subject,
        request: FrameRequest,
        cut: Selection,
        eye: Camera,
        stop: _core.Stop | None,
    ) -> RenderedImage:
        """Draw a cut that was selected earlier."""
        with residency.turn(self.device):
            resident = self._taken(subject)
            check_cut(cut, subject, resident, request.cut)
            weights = None
            if cut.given_weights is not None:
                weights = self._on_device(cut.given_weights)
            pairs = _core.GivenCut(
                self._on_device(cut.instance_ids), self._on_device(cut.cluster_ids), weights
            )
            rule = CutRequest(cut.tolerance).rule
            core_request = _core.FrameRequest(
                eye.core, rule, request.shade, pairs, None, request.sensor
            )
            drawing = self.core.draw(resident.core, core_request, None, None, stop)
            resident.add_drawing(drawing)

        def finish() -> Stats:
            return stats_of(drawing.finish(), cut.tolerance)

        if not self.device.is_cuda:
            finish()
        return RenderedImage(drawing, finish)

    def _on_device(self, values: Array) -> Array:
        if not self.device.is_cuda:
            return values
        import torch

        return torch.tensor(values, device=str(self.device))


def check_cut(
    cut: Selection, subject: Subject, resident: ResidentScene, request: CutRequest
) -> None:
    """Raise ValueError if a cut was not selected from the current scene, or if other
    arguments contradict the cut."""
    check_type("cut", cut, Selection, "a Selection of v3dg.select")
    for name, value in request._asdict().items():
        check(name, not value, f"no value together with a cut, got {value}; leave it out")
    is_from_bundle = isinstance(subject, Bundle) and cut.scene.bundles == (subject,)
    check(
        "cut",
        cut.scene is subject or is_from_bundle,
        "a selection from this scene, got one from another scene; select again",
    )
    if isinstance(subject, Scene):
        cut.check(resident.revision)
