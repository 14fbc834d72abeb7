"""Image: what drawing gives."""

from __future__ import annotations

from typing import Any


class Image:
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the device that drew it.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn.
    """

    def __init__(self, color: Any, alpha: Any, depth: Any) -> None:
        self._color, self._alpha, self._depth = color, alpha, depth

    @property
    def color(self) -> Any:
        return self._color

    @property
    def alpha(self) -> Any:
        return self._alpha

    @property
    def depth(self) -> Any:
        return self._depth
