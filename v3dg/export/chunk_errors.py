"""How far the coarser levels of chunks are from the finest, in pictures of them: `errors` of streamed SOG."""

from collections import defaultdict

import numpy as np

from v3dg.cameras import Camera, Floats
from v3dg.cleaning import ball_of_most
from v3dg.gaussians import Gaussians
from v3dg.rasterize import rasterize

_SIDE_PX = 64
_FOV = 0.3  # narrow, so that all of a chunk is about as large
_DIRECTIONS = np.array([(1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)]) / np.sqrt(3.0)
_FILTER_PX2 = 0.3  # with which viewers of the format draw


class ChunkErrors:
    """Errors of chunks whose levels are added from the finest on.

    An error is the mean of the squared differences of colour and alpha from the pictures of the finest level,
    from four sides. It never falls from a level to the next. Of each chunk 128 KiB of pictures are kept.

    Attributes:
        of_chunk: The errors by chunk, a number for each level.
    """

    def __init__(self) -> None:
        self.of_chunk: defaultdict[int, list[float]] = defaultdict(list)
        self._finest: dict[int, tuple[list[Camera], Floats]] = {}

    def add(self, chunk: int, gaussians: Gaussians) -> None:
        """Add the next level of a chunk, which need not have gaussians."""
        errors, error = self.of_chunk[chunk], 0.0
        if len(gaussians) and chunk not in self._finest:
            middle, radius = ball_of_most(gaussians.means.astype(np.float64))
            far = max(radius, 1e-6) / np.sin(_FOV / 2)
            how = {"fov_x": _FOV, "width": _SIDE_PX, "height": _SIDE_PX, "near": far / 100}
            cameras = [Camera.look_at(middle + far * side, middle, **how) for side in _DIRECTIONS]
            self._finest[chunk] = cameras, _pictures(gaussians, cameras).astype(np.float16)
        elif len(gaussians):
            cameras, finest = self._finest[chunk]
            error = float(np.square(_pictures(gaussians, cameras) - finest).mean())
        errors.append(max(error, *errors[-1:]) if errors else error)


def _pictures(gaussians: Gaussians, cameras: list[Camera]) -> Floats:
    drawn = [rasterize(gaussians, camera, filter_px2=_FILTER_PX2) for camera in cameras]
    return np.stack([np.dstack([picture.color, picture.alpha]) for picture in drawn])
