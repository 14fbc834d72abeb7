"""Image: the result of drawing."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from v3dg import _core
from v3dg.gaussians import Array
from v3dg.pictures import encode_png, write_picture


@dataclass(frozen=True, eq=False)
class Planes:
    """The arrays of an `Image`; depth is None unless it was requested."""

    color: Array
    alpha: Array
    depth: Array | None


class Image:
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the device that drew
    it.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn;
            an AttributeError unless it was requested.
    """

    def __init__(self, color: Array, alpha: Array, depth: Array | None) -> None:
        self._drawn = Planes(color, alpha, depth)

    @property
    def _planes(self) -> Planes | _core.Drawing | _core.Picture:
        return self._drawn

    def _repr_png_(self) -> bytes:
        """The picture, for notebooks."""
        return encode_png(self.color)

    def save(self, path: str | os.PathLike[str], *, transparent: bool = False) -> None:
        """Write the picture as .png or .jpg; its folder is created if needed.

        Args:
            transparent: Write a PNG with straight alpha, of a picture that was drawn on
                black, which is the default background.

        Raises:
            ValueError: The suffix is another one, or the background is not black.
            OSError: The file cannot be written.
        """
        alpha = None
        if transparent:
            alpha = self.alpha
        write_picture(path, self.color, alpha=alpha)

    @property
    def color(self) -> Array:
        return self._planes.color

    @property
    def alpha(self) -> Array:
        return self._planes.alpha

    @property
    def depth(self) -> Array:
        depth = self._planes.depth
        if depth is None:
            raise AttributeError(
                "depth: expected a picture that was drawn with depth=True, got one without"
            )
        return depth


class Stats(NamedTuple):
    """Costs of drawing a picture.

    Attributes:
        gaussians_selected: Gaussians of the selected clusters.
        gaussians_in_frustum: Selected gaussians in front of the near plane whose extent
            meets the image, before any finer culling.
        tolerance: Largest screen area, px², that one gaussian of a coarser cluster
            stands for; with a budget, the area at which the budget is met; 0 for an
            asset.
        select_ms: Time of the selection.
        draw_ms: Time of drawing.
        levels: Selected gaussians by level; empty on CUDA, for an asset, and for a cut
            that the caller passed.
        missing: Pages that the picture needs and that are not resident, so that coarser
            ones are drawn instead; 0 where everything is resident, or the renderer has
            settled. `missing` and `failed` count what is known when the picture is
            drawn.
        failed: Pages that cannot be read.
        bytes_in: Bytes of pages that came in with this picture.
        memory: Size of the pool in bytes; None where everything is resident.
    """

    gaussians_selected: int
    gaussians_in_frustum: int
    tolerance: float
    select_ms: float
    draw_ms: float
    levels: tuple[int, ...] = ()
    missing: int = 0
    failed: int = 0
    bytes_in: int = 0
    memory: int | None = None


class RenderedImage(Image):
    """An `Image` with the costs of drawing it.

    CUDA may still be drawing it; reading an attribute waits for the end, and raises the
    error of the drawing.

    Attributes:
        stats: The costs of drawing it.
    """

    def __init__(
        self, drawing: _core.Drawing, finish: Callable[[], Stats], *, is_right: bool = False
    ) -> None:
        self._drawing = drawing
        self._finish = finish
        self._is_right = is_right

    @property
    def _planes(self) -> Planes | _core.Drawing | _core.Picture:
        if self._drawing.finish().exceeds_budget:
            self._finish()  # raises the error
        if self._is_right:
            return self._drawing.right
        return self._drawing

    @property
    def stats(self) -> Stats:
        return self._finish()
