"""Pictures as results of drawing, and their statistics."""

import os
from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from v3dg import _core
from v3dg.gaussians import Array
from v3dg.pictures import encode_png, write_picture


@dataclass(frozen=True, eq=False)
class ChannelPlanes:
    """The channels of a picture other than colour.

    Each is None unless it was requested.
    """

    median_depth: Array | None
    normal: Array | None
    instance: Array | None
    label: Array | None
    weight: Array | None
    clipped: Array | None


@dataclass(frozen=True, eq=False)
class Planes:
    """The arrays of an `Image`. The depth is None unless it was requested."""

    color: Array
    alpha: Array
    depth: Array | None
    channels: ChannelPlanes | None = None


class Sensed:
    """The requested channels of one picture (H, W) or of a batch (B, H, W).

    docs/sensors.md defines them. A channel that was not requested raises
    AttributeError.

    Attributes:
        median_depth: (...) depth of the first gaussian at which the transmittance falls
            to one half or less; 0 if there is none.
        normal: (..., 3) blended normal in the axes of the camera (x right, y down, z
            forward), of length 1, or 0 where nothing is drawn.
        instance: (...) int32, the instance with the largest weight in the pixel. It is
            -1 where nothing is drawn, and `v3dg.MESH` for a mesh without ids.
        label: (...) int32, the label of that instance, or -1 if it has none.
        weight: (...) the largest weight, 0 to 1.
        clipped: (...) bool, whether a gaussian is missing because its centre is in
            front of the near plane, although its body extends beyond that plane.
    """

    @property
    @abstractmethod
    def _channels(self) -> ChannelPlanes | _core.Channels | None: ...

    @property
    def median_depth(self) -> Array:
        return _requested("median_depth", self._channels and self._channels.median_depth)

    @property
    def normal(self) -> Array:
        return _requested("normal", self._channels and self._channels.normal)

    @property
    def instance(self) -> Array:
        return _requested("instance", self._channels and self._channels.instance)

    @property
    def label(self) -> Array:
        return _requested("label", self._channels and self._channels.label)

    @property
    def weight(self) -> Array:
        return _requested("weight", self._channels and self._channels.weight)

    @property
    def clipped(self) -> Array:
        clipped = _requested("clipped", self._channels and self._channels.clipped)
        if isinstance(clipped, np.ndarray):
            return clipped.view(np.bool_)
        import torch

        return clipped.view(torch.bool)


def _requested(name: str, plane: Array | None) -> Array:
    if plane is None:
        raise AttributeError(
            f"{name}: expected pictures that were drawn with channels=({name!r},), got others"
        )
    return plane


class Image(Sensed):
    """A picture of H x W pixels: NumPy arrays, or torch tensors on the device that drew
    it.

    Attributes:
        color: (H, W, 3) colour of the gaussians over the background. On black, this is
            premultiplied colour.
        alpha: (H, W) opacity of all gaussians together, without the background.
        depth: (H, W) expected depth along the camera's axis, 0 where nothing is drawn.
            Raises AttributeError unless it was requested.
    """

    def __init__(self, color: Array, alpha: Array, depth: Array | None) -> None:
        self._drawn = Planes(color, alpha, depth)

    @property
    def _planes(self) -> Planes | _core.Drawing | _core.Picture:
        return self._drawn

    @property
    def _channels(self) -> ChannelPlanes | _core.Channels | None:
        return self._planes.channels

    def _repr_png_(self) -> bytes:
        """Return the picture as PNG for notebooks."""
        return encode_png(self.color)

    def save(self, path: str | os.PathLike[str], *, transparent: bool = False) -> None:
        """Write the picture as .png or .jpg; its folder is created if needed.

        Args:
            transparent: Whether to write a PNG with straight alpha. The picture must
                have been drawn on black, the default background.

        Raises:
            ValueError: The suffix is unknown, or the background is not black.
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
                "depth: expected a picture that was drawn with depth=True, got one without depth"
            )
        return depth


class Stats(NamedTuple):
    """Costs of drawing a picture.

    Attributes:
        gaussians_selected: Number of gaussians in the selected clusters.
        gaussians_in_frustum: Number of selected gaussians that are beyond the near
            plane and whose extent intersects the image. Some of them may be culled
            later.
        tolerance: Tolerance of the cut, px² per gaussian (see `v3dg.select`). With a
            budget, it is the tolerance that meets the budget. For an asset, it is 0.
        select_ms: Time of the selection in ms.
        draw_ms: Time of drawing in ms.
        levels: Number of selected gaussians of each level. It is empty on CUDA, for an
            asset, and for a cut that the caller passed.
        missing: Number of pages that the picture needs but that are not resident, so
            that coarser ones are drawn instead. It is 0 if everything is resident, and
            after `Renderer.settle`. `missing` and `failed` are counted when drawing
            begins.
        failed: Number of pages that cannot be read.
        bytes_in: Number of bytes of the pages that became resident with this picture.
        memory: Size of the pool in bytes; None if everything is resident.
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
    """An `Image` with statistics about its drawing.

    CUDA may still be drawing the picture. Reading an attribute waits until the picture
    is finished, and raises an error if drawing failed.

    Attributes:
        stats: The costs of drawing the picture.
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
            self._finish()  # raises an error
        if self._is_right:
            return self._drawing.right
        return self._drawing

    @property
    def stats(self) -> Stats:
        return self._finish()


class FinishedImage(RenderedImage):
    """A picture that was drawn without the core."""

    def __init__(self, planes: Planes, stats: Stats) -> None:
        self._drawn = planes
        self._finished_stats = stats

    @property
    def _planes(self) -> Planes | _core.Drawing | _core.Picture:
        return self._drawn

    @property
    def stats(self) -> Stats:
        return self._finished_stats
