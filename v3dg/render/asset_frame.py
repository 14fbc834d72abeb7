"""The frame of an asset.

An asset has no levels and no pages, so it is drawn completely.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check
from v3dg.cameras import Camera, StereoCamera
from v3dg.false_color import ColorBy
from v3dg.gaussians import TRAINED_FILTER_PX2
from v3dg.image import RenderedImage, Stats
from v3dg.render.picture import Picture, stats_of
from v3dg.render.request import CutRequest, FrameRequest

if TYPE_CHECKING:
    from v3dg.gaussians import Gaussians
    from v3dg.scene import Subject


class AssetFrame:
    """Draws one asset on one device. It keeps the asset's arrays on that device. An
    asset that was trained with antialiasing is drawn as in training.

    Attributes:
        device: The device that draws.
        memory: None, because an asset needs no pool.
    """

    def __init__(self, asset: Gaussians, color_by: ColorBy, device: Device) -> None:
        expected = f"'appearance' for an asset, which has no levels, got {color_by!r}"
        check("color_by", color_by == "appearance", expected)
        self.device = device
        self.memory: int | None = None
        filter_px2 = 0.0
        if asset.antialiased:
            filter_px2 = TRAINED_FILTER_PX2
        self._core = _core.AssetFrame(
            _core.Model(_device.place(asset, device).rows),
            filter_px2=filter_px2,
            antialiased=bool(asset.antialiased),
        )

    def chosen(self, subject: Subject) -> AssetFrame:
        """Return this frame."""
        return self

    def draw(
        self,
        subject: Subject,
        request: FrameRequest,
        steps: _core.BudgetSteps | None = None,
        stop: _core.Stop | None = None,
    ) -> Picture:
        """Draw the asset. Raise ValueError if the request needs levels."""
        is_selected = request.selection is None
        check("cut", is_selected, "no cut for an asset, which has no levels, got one; leave it out")
        check_request(request.cut)
        camera = request.camera
        if isinstance(camera, StereoCamera):
            left, right = (
                self._draw_eye(eye, request.of_eye(number), stop)
                for number, eye in enumerate(camera.eyes)
            )
            return left, right
        return self._draw_eye(camera, request, stop)

    draw_settled = draw

    def settle(
        self, subject: Subject, camera: Camera | StereoCamera, cut: CutRequest, timeout: float
    ) -> None:
        """Return immediately, because an asset is always resident."""

    def _draw_eye(
        self, camera: Camera, request: FrameRequest, stop: _core.Stop | None
    ) -> RenderedImage:
        drawing = self._core.draw(camera.core, request.shade, stop, request.sensor)

        def finish() -> Stats:
            return stats_of(drawing.finish(), 0.0)

        if not self.device.is_cuda:
            finish()
        return RenderedImage(drawing, finish)


def check_request(request: CutRequest) -> None:
    """Raise ValueError for a request that needs levels. A tolerance and a fade are
    accepted, but have no effect."""
    if request.is_plain:
        _check_known(*request)
    else:
        _check(*request)


def _check(tolerance: float | None, budget: int | None, min_level: int, fade: float | None) -> None:
    for name, value in (("budget", budget), ("min_level", min_level)):
        check(name, not value, "no value for an asset, which has no levels, got one; leave it out")
    CutRequest(tolerance=tolerance, fade=fade).rule  # noqa: B018 - the property checks the values


_check_known = lru_cache(64, typed=True)(_check)
