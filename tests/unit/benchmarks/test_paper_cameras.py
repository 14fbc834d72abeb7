import numpy as np
import pytest

from benchmarks.worlds.paper_cameras import trajectories
from v3dg import Camera

# Two cameras of the published DonutSea, as camera-to-world matrices in Blender's
# convention with all published digits.
PUBLISHED = {
    "000_camera_0": [
        [-1, 0, 0, 0],
        [0, -0.258819045, 0.965925826, 0.434666622],
        [0, 0.965925826, 0.258819045, 0.11646857],
    ],
    "059_camera_19": [
        [-1, 0, 0, 0],
        [0, -0.707106781, 0.707106781, 6.36396103],
        [0, 0.707106781, 0.707106781, 6.36396103],
    ],
    "127_camera_7": [
        [0, 0.5, -0.866025404, -3.11769145],
        [-1, 0, 0, 0],
        [0, 0.866025404, 0.5, 1.8],
    ],
    "250_camera_10": [
        [1, 0, 0, 0],
        [0, 0.707106781, -0.707106781, -3.50017857],
        [0, 0.707106781, 0.707106781, 3.50017857],
    ],
    "399_camera_19": [
        [0, -0.965925826, 0.258819045, 2.32937141],
        [1, 0, 0, 0],
        [0, 0.258819045, 0.965925826, 8.69333244],
    ],
}
FOV_X, FOV_Y = 0.785398185, 0.457822348


@pytest.fixture(scope="module")
def cameras():
    return trajectories((0, 0, 0), 9.0)


@pytest.mark.parametrize("name", PUBLISHED)
def test_cameras_are_the_published_ones(cameras, name):
    published = Camera.from_blender([*PUBLISHED[name], [0, 0, 0, 1]], FOV_X, 1920, 1080, FOV_Y)
    camera = cameras[name]
    assert np.abs(camera.viewmat - published.viewmat).max() < 1e-6
    assert np.allclose(camera.K, published.K, rtol=1e-6, atol=0)
    assert (camera.width, camera.height) == (1920, 1080)


def test_there_are_400_in_order(cameras):
    names = list(cameras)
    assert len(names) == 400
    assert (names[0], names[19], names[20], names[399]) == (
        *("000_camera_0", "019_camera_19", "020_camera_0", "399_camera_19"),
    )


def test_distances_are_even_and_elevations_as_in_the_paper(cameras):
    eyes = np.array([camera.position for camera in cameras.values()]).reshape(4, 5, 20, 3)
    distances = np.linalg.norm(eyes, axis=-1)
    assert np.allclose(distances, np.arange(1, 21) * 9 / 20)
    elevations = np.degrees(np.arcsin(eyes[..., 2] / distances))
    assert np.allclose(elevations, np.array([15, 30, 45, 60, 75])[:, None])
    azimuths = np.degrees(np.arctan2(eyes[..., 1], eyes[..., 0]))
    assert np.allclose(azimuths % 360, np.array([90, 180, 270, 0])[:, None, None])


def test_all_look_at_the_centre():
    centre = np.array([3.0, -2.0, 1.0])
    for camera in trajectories(centre, 5.0, width=64, height=48).values():
        x, y, z = camera.viewmat[:3, :3] @ centre + camera.viewmat[:3, 3]
        assert abs(x) < 1e-12
        assert abs(y) < 1e-12
        assert z > 0


def test_radius_is_checked():
    with pytest.raises(ValueError, match="radius: expected a positive number, got -1"):
        trajectories((0, 0, 0), -1)
