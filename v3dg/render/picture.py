"""Pictures that may still be in progress, and their statistics."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

from v3dg import _core
from v3dg.cameras import Camera, StereoCamera
from v3dg.image import RenderedImage, Stats

# One picture for a camera. For a stereo camera, one picture per eye, left first.
Picture: TypeAlias = RenderedImage | tuple[RenderedImage, RenderedImage]


def picture_of(
    drawing: _core.Drawing, camera: Camera | StereoCamera, finish: Callable[[], Stats]
) -> Picture:
    """Return the picture of a drawing. `finish` waits for the picture and returns its
    statistics."""
    left = RenderedImage(drawing, finish)
    if isinstance(camera, Camera):
        return left
    return left, RenderedImage(drawing, finish, is_right=True)


def stats_of(stats: _core.FrameStats, tolerance: float) -> Stats:
    """Return the statistics of a picture for users, with the tolerance of its cut."""
    return Stats(
        stats.gaussians,
        stats.in_frustum,
        tolerance,
        stats.select_ms,
        stats.draw_ms,
        tuple(stats.levels),
    )
