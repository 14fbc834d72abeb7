"""Measures in pictures how much the coarser levels of chunks differ from the finest
level. These are the `errors` of streamed SOG."""

from collections import defaultdict
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from v3dg.cameras import Camera, Floats
from v3dg.cleaning import ball_of_most
from v3dg.gaussians import Gaussians
from v3dg.rasterize import rasterize

_SIDE_PX = 64
# radians; narrow, so that all parts of a chunk appear at about the same scale
_FOV = 0.3
_DIRECTIONS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
_FILTER_PX2 = 0.3  # px²; viewers of this format use this filter


class _Finest(NamedTuple):
    """The cameras of a chunk, and the pictures of its finest level."""

    cameras: list[Camera]
    pictures: NDArray[np.float16]


class ChunkErrors:
    """Collects the errors of the levels of chunks. The levels are added from the finest
    to the coarsest.

    An error is the mean squared difference of colour and alpha from pictures of the
    finest level, which are taken from four sides. Errors never decrease from one level
    to the next coarser one. The pictures of each chunk need 128 KiB.

    Attributes:
        of_chunk: For each chunk, the errors of its levels.
    """

    def __init__(self) -> None:
        self.of_chunk: defaultdict[int, list[float]] = defaultdict(list)
        self._finest: dict[int, _Finest] = {}

    def add(self, chunk: int, gaussians: Gaussians) -> None:
        """Add the next coarser level of a chunk. It may be empty."""
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
    """Return cameras on four sides of the gaussians.

    Together, they show most of them.
    """
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
