"""Image: what drawing gives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any


class Image:
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the device that drew it.

    Attributes:
        color: (H, W, 3) premultiplied colour, the background composed last.
        alpha: (H, W) coverage.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing was drawn.
    """

    def __init__(self, color: Any, alpha: Any, depth: Any) -> None:
        self._own = SimpleNamespace(color=color, alpha=alpha, depth=depth)

    @property
    def _planes(self) -> Any:
        return self._own

    @property
    def color(self) -> Any:
        return self._planes.color

    @property
    def alpha(self) -> Any:
        return self._planes.alpha

    @property
    def depth(self) -> Any:
        return self._planes.depth
