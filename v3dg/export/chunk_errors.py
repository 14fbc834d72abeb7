"""Errors of the coarser levels of chunks against the finest, measured in pictures:
`errors` of streamed SOG."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg.cameras import Camera, Floats
from v3dg.cleaning import ball_of_most
from v3dg.gaussians import Gaussians
from v3dg.rasterize import rasterize

_SIDE_PX = 64
_FOV = 0.3  # narrow, so that all of a chunk is about as large
_DIRECTIONS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
_FILTER_PX2 = 0.3  # the filter of viewers of the format


class _Finest(NamedTuple):
    """The cameras of a chunk, and the pictures of its finest level."""

    cameras: list[Camera]
    pictures: NDArray[np.float16]


class ChunkErrors:
    """Errors of chunks whose levels are added from the finest on.

    An error is the mean of the squared differences of colour and alpha from the
    pictures of the finest level, from four sides. It never falls from a level to the
    next. Of each chunk 128 KiB of pictures are kept.

    Attributes:
        of_chunk: The errors by chunk, a number for each level.
    """

    def __init__(self) -> None:
        self.of_chunk: defaultdict[int, list[float]] = defaultdict(list)
        self._finest: dict[int, _Finest] = {}

    def add(self, chunk: int, gaussians: Gaussians) -> None:
        """Add the next level of a chunk, which need not have gaussians."""
        errors = self.of_chunk[chunk]
        error = 0.0
        if len(gaussians) and chunk not in self._finest:
            cameras = _cameras_around(gaussians)
            pictures = _pictures(gaussians, cameras).astype(np.float16)
            self._finest[chunk] = _Finest(cameras, pictures)
        elif len(gaussians):
            finest = self._finest[chunk]
            difference = _pictures(gaussians, finest.cameras) - finest.pictures
            error = float(np.square(difference).mean())
        if errors:
            error = max(error, errors[-1])
        errors.append(error)


def _cameras_around(gaussians: Gaussians) -> list[Camera]:
    """Return cameras on four sides that show most of the gaussians."""
    centre, radius = ball_of_most(gaussians.means.astype(np.float64))
    distance = max(radius, 1e-6) / np.sin(_FOV / 2)
    return [
        Camera.look_at(
            centre + distance * side,
            centre,
            fov_x=_FOV,
            width=_SIDE_PX,
            height=_SIDE_PX,
            near=distance / 100,
        )
        for side in _DIRECTIONS
    ]


def _pictures(gaussians: Gaussians, cameras: list[Camera]) -> Floats:
    drawn = [rasterize(gaussians, camera, filter_px2=_FILTER_PX2) for camera in cameras]
    return np.stack([np.dstack([picture.color, picture.alpha]) for picture in drawn])
