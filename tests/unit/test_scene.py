import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from random_bundle import random_bundle
from v3dg import Camera, Scene, render, select

CAMERA = Camera.look_at((0.5, -9, 4), (3, 4, 5), width=24, height=16)
BUNDLE = random_bundle(1)
OTHER = random_bundle(2)


def test_instances_are_counted_and_composed():
    scene = Scene()
    assert scene.add(BUNDLE, positions=[[1, 2, 3], [4, 5, 6]]) == range(0, 2)
    assert scene.add(OTHER, positions=(7, 8, 9), quaternions=(0, 0, 0, -2), scales=3) == range(2, 3)
    assert scene.add(BUNDLE, positions=np.zeros((0, 3))) == range(3, 3)
    assert scene.add(BUNDLE) == range(3, 4)
    assert len(scene) == 4
    assert scene.bundles == (BUNDLE, OTHER)
    np.testing.assert_array_equal(scene.instance_bundle, [0, 0, 1, 0])
    np.testing.assert_array_equal(scene.positions, [[1, 2, 3], [4, 5, 6], [7, 8, 9], [0, 0, 0]])
    np.testing.assert_array_equal(scene.scales, [1, 1, 3, 1])
    np.testing.assert_array_equal(scene.rotations[0], np.eye(3))
    np.testing.assert_array_equal(scene.rotations[2], np.diag([-1, -1, 1]))
    assert repr(scene) == "Scene(4 instances of 2 bundles)"


def test_revision_tells_what_has_changed():
    scene = Scene()
    seen = [scene.revision]
    for change in (
        lambda: scene.add(BUNDLE, positions=np.zeros((3, 3))),
        lambda: scene.remove([0]),
        lambda: scene.set_importance(2.0),
    ):
        change()
        assert scene.revision[0] > seen[-1][0]
        assert scene.revision[1] == seen[-1][1]
        seen.append(scene.revision)
    scene.move(positions=np.ones((2, 3)))
    assert scene.revision[0] == seen[-1][0]
    assert scene.revision[1] > seen[-1][1]


@given(quaternion=st.tuples(*[st.floats(-1e150, 1e150)] * 4).filter(any))
def test_rotations_are_rotations(quaternion):
    scene = Scene()
    scene.add(BUNDLE, quaternions=quaternion)
    rotation = scene.rotations[0]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0
    axis = np.array(quaternion[1:]) / max(map(abs, quaternion))  # what the rotation leaves in place
    np.testing.assert_allclose(rotation @ axis, axis, atol=1e-12)


def test_quarter_turn_about_z_takes_x_to_y():
    scene = Scene()
    scene.add(BUNDLE, quaternions=(np.sqrt(0.5), 0, 0, np.sqrt(0.5)))
    np.testing.assert_allclose(scene.rotations[0] @ [1, 0, 0], [0, 1, 0], atol=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"positions": np.zeros((2, 2))}, r"positions: expected shape \(I, 3\), got \(2, 2\)"),
        ({"positions": [[0, 0, np.nan]]}, "positions: expected finite numbers, got nan"),
        ({"positions": "here"}, "positions: expected numbers, got str"),
        (
            {"quaternions": [[1, 0, 0, 0]] * 2},
            r"quaternions: expected shape \(1, 4\), got \(2, 4\)",
        ),
        (
            {"quaternions": [0, 0, 0, 0]},
            "quaternions: expected a rotation, got a quaternion of zeros",
        ),
        ({"quaternions": [np.inf, 0, 0, 0]}, "quaternions: expected finite numbers, got inf"),
        ({"scales": [1, 2]}, r"scales: expected shape \(1,\), got \(2,\)"),
        ({"scales": -1}, "scales: expected positive numbers, got -1"),
        ({"scales": 0.0}, "scales: expected positive numbers, got 0"),
        ({"scales": np.inf}, "scales: expected finite numbers, got inf"),
    ],
)
def test_bad_instances_are_refused(arguments, message):
    scene = Scene()
    with pytest.raises(ValueError, match=message):
        scene.add(BUNDLE, **arguments)
    assert len(scene) == 0
    assert scene.bundles == ()


def test_add_refuses_what_is_not_a_bundle():
    for wrong in (Scene(), [BUNDLE, Scene()]):
        with pytest.raises(TypeError, match="bundle: expected a Bundle, got Scene"):
            Scene().add(wrong, positions=np.zeros((2, 3)))
    with pytest.raises(ValueError, match="bundle: expected one for all or 3, got 2"):
        Scene().add([BUNDLE, OTHER], positions=np.zeros((3, 3)))


def test_instances_of_several_bundles_are_added_at_once():
    scene, one_by_one = Scene(), Scene()
    bundles = [OTHER, BUNDLE, BUNDLE, OTHER]
    assert scene.add(bundles, positions=np.ones((4, 3)), scales=[1, 2, 3, 4]) == range(4)
    for bundle, scale in zip(bundles, [1, 2, 3, 4], strict=True):
        one_by_one.add(bundle, (1, 1, 1), scales=scale)
    assert_same(scene, one_by_one)
    assert scene.add([], positions=np.zeros((0, 3))) == range(4, 4)


def assert_same(scene, other):
    assert scene.bundles == other.bundles
    for name in ("instance_bundle", "importance", "positions", "quaternions", "scales"):
        np.testing.assert_array_equal(getattr(scene, name), getattr(other, name))


def small_scene():
    scene = Scene()
    scene.add([BUNDLE, OTHER, BUNDLE], positions=np.arange(9.0).reshape(3, 3), importance=[1, 2, 3])
    return scene


@pytest.mark.parametrize(
    "take", [copy.copy, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_copies_of_scenes_and_cuts_go_their_own_way(take):
    scene, same = small_scene(), small_scene()
    cut = select(scene, CAMERA, tolerance=0.1, device="cpu")
    taken = take(scene)
    assert (taken.bundles == scene.bundles) == (take is copy.copy)  # which are large
    drawn = render(scene, CAMERA, device="cpu").color
    np.testing.assert_array_equal(render(taken, CAMERA, device="cpu").color, drawn)
    taken.remove([0])
    taken.move(positions=np.ones((2, 3)))
    taken.add(random_bundle(3))
    assert_same(scene, same)
    scene.move(scales=0.1)
    np.testing.assert_array_equal(taken.scales, 1)

    cut_taken = take(cut)  # with its scene
    np.testing.assert_array_equal(cut_taken.instance_ids, cut.instance_ids)
    np.testing.assert_array_equal(cut_taken.cluster_ids, cut.cluster_ids)
    of_copy = render(cut_taken.scene, CAMERA, cut=cut_taken, device="cpu")
    np.testing.assert_array_equal(of_copy.color, render(scene, CAMERA, cut=cut, device="cpu").color)


@pytest.mark.parametrize(
    "take", [lambda s: s, copy.deepcopy, lambda s: pickle.loads(pickle.dumps(s))]
)
def test_what_is_handed_out_cannot_be_written_to(take):
    scene = small_scene()
    cut = take(select(scene, CAMERA, tolerance=0.1, device="cpu"))
    scene = take(scene)
    for name in ("instance_bundle", "importance", "positions", "quaternions", "scales"):
        with pytest.raises(ValueError, match="read-only"):
            getattr(scene, name)[0] = 1
    for ids in (cut.instance_ids, cut.cluster_ids):
        with pytest.raises(ValueError, match="read-only"):
            ids[0] = 1


def test_what_was_given_stays_the_users():
    scene, given = Scene(), np.zeros((2, 3))
    scene.add(BUNDLE, given)
    scene.move(positions=given)
    given[:] = 7
    np.testing.assert_array_equal(scene.positions, 0)


def test_cut_of_instances_that_are_gone_is_refused():
    """Though others have come in their places, of other bundles; not because others
    came or they moved."""
    scene = small_scene()
    cut = select(scene, CAMERA, tolerance=0.1, device="cpu")
    num = len(cut.gaussians(device="cpu"))
    scene.add(OTHER)
    scene.move([0], scales=1.5)
    scene.set_importance(2.0)
    assert len(cut.gaussians(device="cpu")) == num
    assert render(scene, CAMERA, cut=cut, device="cpu").stats.gaussians_selected == num
    scene.remove([])
    assert len(cut.filters_px2) == num
    scene.remove([0, 1])
    scene.add([OTHER, OTHER], positions=np.zeros((2, 3)))
    for use in (
        lambda: render(scene, CAMERA, cut=cut, device="cpu"),
        lambda: cut.gaussians(device="cpu"),
        lambda: cut.filters_px2,
        lambda: cut.antialiased,
    ):
        with pytest.raises(
            ValueError, match="cut: instances were removed from the scene after this selection"
        ):
            use()


def test_an_axis_that_is_none_is_refused_where_it_is_set():
    scene = Scene.of(random_bundle(0))
    scene.up = "-y"
    with pytest.raises(ValueError, match=r"^up: expected 'x' or .*, got 'q'"):
        scene.up = "q"
    assert scene.up == "-y"
    scene.up = None
    assert scene.up is None
