"""Pictures that may still be under way, and what they cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from v3dg import _core
from v3dg.cameras import Camera, StereoCamera
from v3dg.image import RenderedImage, Stats

# Of a camera; or of the eyes of a stereo camera, left first.
Picture: TypeAlias = RenderedImage | tuple[RenderedImage, RenderedImage]


def picture_of(
    drawing: _core.Drawing, camera: Camera | StereoCamera, finish: Callable[[], Stats]
) -> Picture:
    """The picture that a drawing makes; `finish` waits for it and returns what it
    cost."""
    left = RenderedImage(drawing, finish)
    if isinstance(camera, Camera):
        return left
    return left, RenderedImage(drawing, finish, is_right=True)


def stats_of(stats: _core.FrameStats, tolerance: float) -> Stats:
    """What a picture cost, as users see it, with the tolerance that its cut was chosen
    with."""
    return Stats(
        stats.gaussians,
        stats.in_frustum,
        tolerance,
        stats.select_ms,
        stats.draw_ms,
        tuple(stats.levels),
    )
