"""Tests the viewpoints of a refinement's pictures, which are found without
photographs."""

import functools

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from rooms import house, room, street, terrain
from v3dg import BuildConfig
from v3dg.donut import make_donut
from v3dg.levels.viewpoints import viewpoints_of

UNFITTED = BuildConfig(steps=0)
ROOM = np.array([[-3, -2.6, -2], [3, 0, 2]])


@functools.cache
def bundle_of(make):
    asset = make()
    return v3dg.build_bundle(asset, config=UNFITTED, device="cpu", progress=False)


def donut():
    return make_donut(3000)


def figure():
    return make_asset(num_gaussians=4000, seed=0)


def eyes_of(viewpoints):
    eyes = np.array([camera.position for camera in viewpoints.cameras[::4]])
    return eyes[: viewpoints.num_eyes]


@pytest.fixture(scope="module")
def inside():
    return viewpoints_of(bundle_of(room), "auto")


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (room, "seen from inside: 96 eyes"),
        (house, "seen from outside and from inside: 96 eyes"),
        (street, "seen from outside and from inside: 96 eyes"),
        (terrain, ""),
        (donut, ""),
        (figure, ""),
    ],
    ids=["room", "house", "street", "terrain", "donut", "figure"],
)
def test_places_are_told_from_objects(make, text):
    assert viewpoints_of(bundle_of(make), "auto").text == text


def test_eyes_stand_in_the_room_and_apart(inside):
    eyes = eyes_of(inside)
    low, high = ROOM
    assert (eyes > low + 0.2).all()
    assert (eyes < high - 0.2).all()
    distances = np.linalg.norm(eyes[:, None] - eyes[None], axis=2)
    np.fill_diagonal(distances, np.inf)
    assert distances.min() > 0.25


def test_the_cameras_of_an_eye_look_all_around(inside):
    directions = np.random.default_rng(0).normal(size=(2000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions = directions[np.abs(directions[:, 1]) < np.sin(np.radians(25))]
    for first in (0, 40, 200):
        is_seen = np.zeros(len(directions), bool)
        for camera in inside.cameras[first : first + 4]:
            local = directions @ camera.viewmat[:3, :3].T
            is_ahead = local[:, 2] > 0
            is_seen |= is_ahead & (np.abs(local[:, :2]) <= local[:, 2:]).all(axis=1)
        assert is_seen.mean() > 0.95


def test_no_camera_of_a_room_is_behind_its_walls(inside):
    for camera in inside.cameras[::50]:
        small = v3dg.Camera(camera.viewmat, camera.K * [[0.125], [0.125], [1]], 64, 64, camera.near)
        assert v3dg.rasterize(room(), small).alpha.mean() > 0.9
    assert len(inside.cameras) == 4 * inside.num_eyes


def test_half_of_the_cameras_of_a_house_see_all_of_it():
    bundle = bundle_of(house)
    viewpoints = viewpoints_of(bundle, "auto")
    around = viewpoints.cameras[4 * viewpoints.num_eyes :]
    assert len(around) == 4 * viewpoints.num_eyes
    means = bundle.level_gaussians(0).means.astype(float)
    for camera in around[::50]:
        local = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
        pixels = local[:, :2] / local[:, 2:] * camera.fx + camera.cx
        is_shown = (local[:, 2] > camera.near) & ((pixels > 0) & (pixels < camera.width)).all(
            axis=1
        )
        assert is_shown.mean() > 0.98


def test_a_user_may_say_from_where(inside):
    bundle = bundle_of(room)
    assert viewpoints_of(bundle, "outside").cameras == ()
    assert viewpoints_of(bundle, "inside").text == inside.text
    both = viewpoints_of(bundle, "both")
    assert both.text == "seen from outside and from inside: 96 eyes"
    again = viewpoints_of(bundle, "auto")
    for camera, other in zip(inside.cameras, again.cameras, strict=True):
        np.testing.assert_array_equal(camera.viewmat, other.viewmat)


def test_an_object_is_not_seen_from_inside():
    bundle = bundle_of(donut)
    with pytest.raises(ValueError, match="seen_from: expected outside or auto, got inside"):
        viewpoints_of(bundle, "inside")
    with pytest.raises(ValueError, match="seen_from: expected"):
        viewpoints_of(bundle, "above")


def test_cameras_and_a_side_exclude_each_other():
    bundle = bundle_of(donut)
    camera = v3dg.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), width=64, height=64)
    with pytest.raises(ValueError, match="seen_from: expected auto with cameras, got outside"):
        v3dg.refine_bundle(bundle, cameras=[camera], seen_from="outside", device="cpu")
