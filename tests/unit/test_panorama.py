"""Tests equirectangular pictures: the positions of directions, and the absence of
seams."""

import numpy as np
import pytest

import v3dg
from v3dg.image import Image

CAMERA = v3dg.Camera.look_at((0, 0, 0), (0, 5, 0), (0, 0, 1), width=8, height=8)


def directions(camera):
    """Return the directions (H, W, 3) of a camera's pixels in the world."""
    columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    local = np.stack(
        [
            (columns - camera.cx) / camera.fx,
            (rows - camera.cy) / camera.fy,
            np.ones_like(rows),
        ],
        axis=-1,
    )
    world = local @ camera.viewmat[:3, :3]
    return world / np.linalg.norm(world, axis=-1, keepdims=True)


def draw_directions(camera):
    """Return a picture whose colours are directions."""
    color = (0.5 + 0.5 * directions(camera)).astype(np.float32)
    return Image(color, np.ones(color.shape[:2], np.float32), None)


def test_every_direction_is_in_its_place():
    width = 128
    image = v3dg.draw_panorama(draw_directions, CAMERA, (0, 0, 1), width)
    assert image.color.shape == (64, width, 3)
    assert image.alpha.min() == pytest.approx(1.0)
    longitudes = ((np.arange(width) + 0.5) / width - 0.5) * 2 * np.pi
    latitudes = (0.5 - (np.arange(64)[:, None] + 0.5) / 64) * np.pi
    # The camera looks along y, with x to the right and z up.
    expected = np.stack(
        [
            np.cos(latitudes) * np.sin(longitudes),
            np.cos(latitudes) * np.cos(longitudes),
            np.sin(latitudes) + 0 * longitudes,
        ],
        axis=-1,
    )
    # The error of bilinear interpolation in a smooth picture is of this size.
    np.testing.assert_allclose(2 * image.color - 1, expected, atol=2e-3)


def test_only_the_azimuth_of_the_camera_counts():
    tilted = v3dg.Camera.look_at((0, 0, 0), (0, 5, 3), (0.2, 0, 1), width=8, height=8)
    level = v3dg.draw_panorama(draw_directions, CAMERA, (0, 0, 1), 32)
    image = v3dg.draw_panorama(draw_directions, tilted, (0, 0, 1), 32)
    np.testing.assert_allclose(image.color, level.color, atol=1e-6)


def test_wrong_arguments_are_refused():
    with pytest.raises(ValueError, match="width: expected an even number"):
        v3dg.draw_panorama(draw_directions, CAMERA, (0, 0, 1), 33)
    with pytest.raises(
        ValueError, match="up, camera: expected a camera that does not look along `up`"
    ):
        v3dg.draw_panorama(draw_directions, CAMERA, (0, 1, 0), 32)
