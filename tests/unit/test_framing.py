"""First views show the whole object in pictures of any aspect ratio, and a room from
inside."""

import numpy as np
import pytest

import v3dg
from v3dg.framing import frame_subject
from v3dg.pictures import MOST_SIDE
from v3dg.viewer.frame import SceneView

UP = (0.0, -1.0, 0.0)
SIZES = [(300, 300), (120, 480), (480, 120), (200, 90), (90, 200)]


@pytest.fixture
def rng():
    return np.random.default_rng(0)


def box(rng, low, high, density=100.0):
    """Return points that are evenly distributed on the sides of a box."""
    low = np.array(low, float)
    high = np.array(high, float)
    sides = []
    for axis in range(3):
        others = [other for other in range(3) if other != axis]
        count = int(density * np.prod((high - low)[others])) + 4
        for border in (low[axis], high[axis]):
            points = rng.uniform(low, high, (count, 3))
            points[:, axis] = border
            sides.append(points)
    return np.concatenate(sides)


def asset_of(points, scale=0.06):
    count = len(points)
    return v3dg.Gaussians(
        np.ascontiguousarray(points, np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), scale, np.float32),
        np.full(count, 0.95, np.float32),
        np.zeros((count, 1, 3), np.float32),
    )


def room(rng):
    """Return walls, a table and a cupboard."""
    walls = box(rng, (-3, -2.6, -2), (3, 0, 2))
    table = box(rng, (-0.8, -0.8, -0.5), (0.8, -0.7, 0.5), 400)
    cupboard = box(rng, (-2.9, -2, -1.9), (-2.3, 0, 0))
    return asset_of(np.concatenate([walls, table, cupboard]))


def figure(rng):
    """Return a body with a thin rod on its head, three times as high as wide."""
    body = box(rng, (-0.3, -1.8, -0.15), (0.3, 0, 0.15), 2000)
    rod = box(rng, (-0.02, -3.2, -0.02), (0.02, -1.8, 0.02), 500)
    return asset_of(np.concatenate([body, rod]), 0.015)


def town(rng):
    """Return blocks on a ground."""
    blocks = [box(rng, (-60, 0, -60), (60, 0.2, 60), 1)]
    for x in range(-50, 51, 11):
        for z in range(-50, 51, 11):
            blocks.append(box(rng, (x, -rng.uniform(4, 18), z), (x + 7, 0, z + 7), 2))
    return asset_of(np.concatenate(blocks), 0.5)


def in_pixels(camera, points):
    """Return (N, 3) columns, rows and depths."""
    local = points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    columns = camera.fx * local[:, 0] / local[:, 2] + camera.cx
    rows = camera.fy * local[:, 1] / local[:, 2] + camera.cy
    return np.stack([columns, rows, local[:, 2]], axis=1)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("make", [figure, town])
def test_no_picture_of_an_object_is_cut(rng, make, size):
    asset = make(rng)
    framing = frame_subject(asset)
    assert not framing.is_inside
    cameras = [framing.camera(UP, *size), *framing.turntable(UP, 5, *size)]
    for camera in cameras:
        columns, rows, depths = in_pixels(camera, asset.means.astype(float)).T
        assert depths.min() > camera.near
        assert columns.min() > 0
        assert columns.max() < size[0]
        assert rows.min() > 0
        assert rows.max() < size[1]
    # The first view also leaves little space: the subject nearly fills the width or the
    # height of the picture.
    first = in_pixels(cameras[0], asset.means.astype(float))
    filled = max(np.ptp(first[:, 0]) / size[0], np.ptp(first[:, 1]) / size[1])
    assert filled > 0.75


def test_a_far_sky_is_not_what_is_framed(rng):
    directions = rng.normal(size=(500, 3))
    sky = 2000 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    alone = frame_subject(town(np.random.default_rng(1)))
    means = np.concatenate([town(np.random.default_rng(1)).means, sky])
    framing = frame_subject(asset_of(means, 0.5))
    assert framing.radius < 1.2 * alone.radius


def test_a_room_is_seen_from_inside(rng):
    framing = frame_subject(room(rng))
    assert framing.is_inside
    for size in SIZES:
        x, y, z = framing.camera(UP, *size).position
        assert -2.8 < x < 2.8
        assert -2.2 < y < -0.8  # neither at the ceiling nor on the floor
        assert -1.8 < z < 1.8
    places = {tuple(camera.position.round(6)) for camera in framing.turntable(UP, 4, 90, 90)}
    assert len(places) == 1


def test_a_hollow_or_a_filled_object_is_seen_from_outside(rng):
    hollow = asset_of(box(rng, (-1, -1, -1), (1, 1, 1), 600))
    assert not frame_subject(hollow).is_inside
    filled = asset_of(rng.uniform(-1, 1, (20_000, 3)))
    assert not frame_subject(filled).is_inside


def test_first_views_are_the_same_everywhere(rng):
    asset = room(rng)
    camera = v3dg.first_camera(asset, 160, 90, up="-y")
    view, focus = SceneView(asset, device="cpu").first_view(UP, 160 / 90)
    np.testing.assert_allclose(view.position, camera.position, atol=0.2)
    assert (focus - camera.position) @ camera.viewmat[2, :3] > 0
    drawn = v3dg.render(asset, device="cpu")
    square = v3dg.first_camera(asset)
    np.testing.assert_array_equal(drawn.color, v3dg.render(asset, square, device="cpu").color)


def test_near_follows_the_size_of_the_subject(rng):
    points = 1e-4 * rng.normal(size=(500, 3))
    assert v3dg.first_camera(asset_of(points, 1e-5)).near < 1e-5
    assert v3dg.Camera.look_at((0, 0, 1e-3), (0, 0, 0), (0, 1, 0), width=8, height=8).near == 1e-5
    assert v3dg.Camera.look_at((0, 0, 50), (0, 0, 0), (0, 1, 0), width=8, height=8).near == 0.01
    assert v3dg.turntable((0, 0, 0), 0.1, 1)[0].near == pytest.approx(1e-3)


def test_little_and_nothing_have_a_first_view():
    nothing = asset_of(np.zeros((0, 3)))
    assert frame_subject(nothing).radius == 1.0
    for count in (1, 2):
        asset = asset_of(np.arange(3.0 * count).reshape(count, 3), 0.1)
        columns, rows, depths = in_pixels(v3dg.first_camera(asset, 64, 48), asset.means).T
        assert depths.min() > 0
        assert ((columns > 0) & (columns < 64) & (rows > 0) & (rows < 48)).all()
    assert v3dg.first_camera(nothing, MOST_SIDE, 1).width == MOST_SIDE


def test_wrong_directions_are_refused():
    asset = asset_of(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="up: expected a direction"):
        v3dg.first_camera(asset, up=(0, 0, 0))
    with pytest.raises(ValueError, match="up: expected 'x'"):
        v3dg.first_camera(asset, up="up")
