"""Pictures of all directions from one point, in the equirectangular projection.

Twenty-six pinhole pictures that overlap are resampled with bilinear interpolation and
blended where they overlap, so that no seam shows where the projections of a gaussian
differ from one picture to the next.
"""

import itertools
import math
from collections.abc import Callable

import numpy as np

from v3dg._device import to_host
from v3dg._numbers import Floats, check, vector, whole
from v3dg.cameras import Camera, VectorLike, rigid
from v3dg.image import Image
from v3dg.pictures import MOST_SIDE

# Tangents of half a side's field of view, 64 degrees, and of the angle from which on a
# side is blended with its neighbours.
_REACH = 0.625
_UNBLENDED = 0.325
# Pixels of a side for one of the panorama, in the middle of the side.
_DENSITY = 1.4
_ROWS = 256  # that are resampled at once

# Longitudes and latitudes, in degrees, to which the middles of the sides point. The
# projection of a gaussian is exact in the middle of a side only, so many narrow sides
# are far nearer to the truth than the six of a cube.
_MIDDLES = [(0, 90), (0, -90), *itertools.product(range(0, 360, 45), (-45, 0, 45))]


def draw_panorama(
    draw: Callable[[Camera], Image], camera: Camera, up: VectorLike, width: int
) -> Image:
    """Draw all directions around a camera as an equirectangular picture.

    Columns are longitudes: the middle is where the camera looks, the right end half a
    turn to its right. Rows are latitudes, from `up` in the first to the opposite in the
    last.

    The projection of a gaussian is exact in the middle of a pinhole picture and off
    towards its borders, most for wide gaussians close by. In a captured and a made
    room, PSNR is 32 and 34 dB against pictures of 15 degrees each, and would be 22 and
    30 dB with the six sides of a cube.

    Args:
        draw: Draws the picture of a pinhole camera, such as a `Renderer`'s `render`.
        camera: Its position, its direction, of which only the azimuth counts, and its
            near plane are used.
        up: (3,) direction in the world.
        width: Of the picture in px, even and at least 8; it is half as high.

    Returns:
        An image of NumPy arrays, without depth.

    Raises:
        ValueError: The width is odd or below 8, or the camera looks along `up`.
    """
    width = whole(width, "width", "an even number of px from 8 to 65,500", 8, MOST_SIDE)
    check("width", width % 2 == 0, f"an even number of px from 8 to 65,500, got {width}")
    height = width // 2
    frame = _level_frame(camera, vector(up, "up"))
    focal = _DENSITY * width / (2 * math.pi)
    side_px = 2 * math.ceil(_REACH * focal)
    K = np.array([[focal, 0, side_px / 2], [0, focal, side_px / 2], [0, 0, 1.0]])
    planes = np.zeros((height, width, 4))
    weights = np.zeros((height, width))
    for longitude, latitude in _MIDDLES:
        side = _side(math.radians(longitude), math.radians(latitude))
        face = Camera(rigid(side @ frame, camera.position), K, side_px, side_px, camera.near)
        image = draw(face)
        pixels = np.concatenate([to_host(image.color), to_host(image.alpha)[..., None]], axis=2)
        for first in range(0, height, _ROWS):
            rows = slice(first, min(first + _ROWS, height))
            _add(planes[rows], weights[rows], pixels, side, focal, (first, height, width))
    planes /= weights[..., None]
    result = planes.astype(np.float32)
    return Image(np.ascontiguousarray(result[..., :3]), np.ascontiguousarray(result[..., 3]), None)


def _side(longitude: float, latitude: float) -> Floats:
    """Return (3, 3) the right, down and forward axes of a side, in the frame of the
    panorama."""
    sine = math.sin(longitude)
    cosine = math.cos(longitude)
    right = np.array([cosine, 0.0, -sine])
    forward = np.array(
        [math.cos(latitude) * sine, -math.sin(latitude), math.cos(latitude) * cosine]
    )
    return np.stack([right, np.cross(forward, right), forward])


def _level_frame(camera: Camera, up: Floats) -> Floats:
    """Return the (3, 3) rotation from the world to the panorama's frame: -y is up, and
    z is the camera's direction, made horizontal."""
    check("up", up.any(), "a direction, got (0, 0, 0)")
    axis = up / np.abs(up).max()  # squares neither overflow nor underflow
    axis /= np.linalg.norm(axis)
    forward = camera.viewmat[2, :3] - axis * (camera.viewmat[2, :3] @ axis)
    length = np.linalg.norm(forward)
    check("up, camera", length > 1e-6, "directions that are not parallel, got parallel ones")
    forward = forward / length
    return np.stack([np.cross(forward, axis), -axis, forward])


def _add(
    planes: Floats,
    weights: Floats,
    pixels: Floats,
    side: Floats,
    focal: float,
    place: tuple[int, int, int],
) -> None:
    """Add what a side shows to some rows of a panorama; `place` is the first of them,
    and the panorama's height and width."""
    first, height, width = place
    longitudes = ((np.arange(width) + 0.5) / width - 0.5) * 2 * math.pi
    rows = first + np.arange(len(planes))
    latitudes = (0.5 - (rows[:, None] + 0.5) / height) * math.pi
    x = np.cos(latitudes) * np.sin(longitudes)
    y = np.broadcast_to(-np.sin(latitudes), x.shape)
    z = np.cos(latitudes) * np.cos(longitudes)
    right, down, depth = (axis[0] * x + axis[1] * y + axis[2] * z for axis in side)
    distance = np.maximum(np.abs(right), np.abs(down))
    is_seen = depth > distance / _REACH
    depth = depth[is_seen]
    weight = np.clip((_REACH - distance[is_seen] / depth) / (_REACH - _UNBLENDED), 0, 1)
    middle = pixels.shape[0] / 2
    column = middle + focal * right[is_seen] / depth - 0.5
    row = middle + focal * down[is_seen] / depth - 0.5
    planes[is_seen] += weight[:, None] * _interpolated(pixels, column, row)
    weights[is_seen] += weight


def _interpolated(pixels: Floats, column: Floats, row: Floats) -> Floats:
    """Return (N, C) the bilinear interpolation of a picture (H, W, C) at places in
    px."""
    last = pixels.shape[0] - 2
    left = np.clip(np.floor(column), 0, last).astype(np.int64)
    top = np.clip(np.floor(row), 0, last).astype(np.int64)
    across = np.clip(column - left, 0, 1)[:, None]
    downwards = np.clip(row - top, 0, 1)[:, None]
    upper = pixels[top, left] * (1 - across) + pixels[top, left + 1] * across
    lower = pixels[top + 1, left] * (1 - across) + pixels[top + 1, left + 1] * across
    return np.asarray(upper * (1 - downwards) + lower * downwards)
