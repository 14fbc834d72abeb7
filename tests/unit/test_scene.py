import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from random_bundle import random_bundle
from v3dg import Bundle, Camera, Scene, render, select
from v3dg.cameras import AXES
from v3dg.rotations import rotation_from_quaternion, similarity_of
from v3dg.upright import direction_of

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
    # The rotation leaves this axis in place.
    axis = np.array(quaternion[1:]) / max(map(abs, quaternion))
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
            "quaternions: expected a nonzero quaternion, got zeros",
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
    with pytest.raises(
        ValueError, match="bundle: expected one for all instances or a list of 3, got 2"
    ):
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
    assert (taken.bundles == scene.bundles) == (take is copy.copy)  # the arrays are large
    drawn = render(scene, CAMERA, device="cpu").color
    np.testing.assert_array_equal(render(taken, CAMERA, device="cpu").color, drawn)
    taken.remove([0])
    taken.move(positions=np.ones((2, 3)))
    taken.add(random_bundle(3))
    assert_same(scene, same)
    scene.move(scales=0.1)
    np.testing.assert_array_equal(taken.scales, 1)

    cut_taken = take(cut)  # together with its scene
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
    """This holds even if instances of other bundles took their places; adding or moving
    instances is no reason."""
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


def with_up(up):
    """Return a bundle whose file says which axis is up."""
    return Bundle(OTHER.clusters, OTHER.groups, OTHER.gaussians, {"up": up}, OTHER.codec)


@pytest.mark.parametrize("up", AXES)
def test_up_turns_what_is_up_in_a_bundle_to_the_axis(up):
    scene = Scene()
    scene.add(BUNDLE, up=up)
    scene.add(with_up("z"), up=up)
    scene.add([with_up("x"), BUNDLE], np.zeros((2, 3)), up=up)
    assert scene.up == up
    for rotation, bundle_up in zip(scene.rotations, ("-y", "z", "x", "-y"), strict=True):
        np.testing.assert_allclose(rotation @ direction_of(bundle_up), direction_of(up), atol=1e-12)


def test_up_keeps_what_is_right_and_applies_before_the_pose():
    scene = Scene()
    quarter = (np.sqrt(0.5), 0, 0, np.sqrt(0.5))  # about z: x becomes y
    scene.add(BUNDLE, (1, 2, 3), quarter, 2.0, up="z")
    np.testing.assert_allclose(scene.rotations[0] @ (1, 0, 0), (0, 1, 0), atol=1e-12)
    np.testing.assert_allclose(scene.rotations[0] @ (0, -1, 0), (0, 0, 1), atol=1e-12)
    before = scene.rotations
    scene.move(quaternions=quarter, up="z")
    np.testing.assert_allclose(scene.rotations, before, atol=1e-12)
    with pytest.raises(ValueError, match="up: expected quaternions or a matrix together with up"):
        scene.move(positions=[(0, 0, 0)], up="z")


def test_a_scene_has_one_axis_that_is_up():
    scene = Scene()
    scene.up = "y"
    with pytest.raises(ValueError, match="up: expected y, the up axis of this scene, got z"):
        scene.add(BUNDLE, up="z")
    assert len(scene) == 0
    with pytest.raises(ValueError, match="up: expected 'x' or 'y'"):
        scene.add(BUNDLE, up="w")


@given(
    quaternion=st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: np.linalg.norm(q) > 1e-3),
    position=st.tuples(*[st.floats(-1e9, 1e9)] * 3),
    scale=st.floats(1e-100, 1e100),
)
def test_a_matrix_is_the_pose_that_it_is_made_of(quaternion, position, scale):
    scene = Scene()
    scene.add(BUNDLE, position, quaternion, scale)
    matrix = np.eye(4)
    matrix[:3, :3] = scene.rotations[0] * scale
    matrix[:3, 3] = position
    scene.add(BUNDLE, matrix=matrix)
    scene.add(BUNDLE)
    scene.move([2], matrix=matrix[None])
    for row in (1, 2):
        np.testing.assert_array_equal(scene.positions[row], position)
        np.testing.assert_allclose(scene.scales[row], scale, rtol=1e-12)
        np.testing.assert_allclose(scene.rotations[row], scene.rotations[0], atol=1e-12)


def matrix_with(row, column, value):
    matrix = np.eye(4)
    matrix[row, column] = value
    return matrix


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (
            np.diag([1.0, 1, 2, 1]),
            r"matrix: .*, got different scales: 1 1 2; instances cannot",
        ),
        (np.diag([1.0, 1, -1, 1]), "matrix: .*, got a reflection"),
        (np.diag([-2.0, -2, -2, 1]), "matrix: .*, got a reflection"),
        (matrix_with(0, 1, 0.3), "matrix: .*, got a shear"),
        (np.diag([0.0, 0, 0, 1]), "matrix: .*, got a scale of 0;"),
        (np.diag([1.0, 1, 0, 1]), "matrix: .*, got a scale of 0 along an axis"),
        (matrix_with(3, 0, 0.5), "matrix: .*, got the last row 0.5 0 0 1"),
        (np.stack([np.eye(4), np.diag([1.0, 1, -1, 1])]), r"matrix\[1\]: .*, got a reflection"),
        (np.eye(3), r"matrix: expected shape \(4, 4\)"),
        (matrix_with(0, 0, np.nan), "matrix: expected finite numbers"),
    ],
)
def test_a_matrix_that_is_no_similarity_is_explained(matrix, message):
    with pytest.raises(ValueError, match=message):
        Scene().add(BUNDLE, matrix=matrix)


def test_rounded_matrices_are_similarities():
    rotation = rotation_from_quaternion(np.array([0.5, 0.5, -0.5, 0.5]))
    noisy = np.eye(4)
    noisy[:3, :3] = 3 * rotation + 1e-5
    pose = similarity_of(noisy)
    np.testing.assert_allclose(rotation_from_quaternion(pose.quaternions)[0], rotation, atol=1e-4)
    np.testing.assert_allclose(pose.scales, 3, rtol=1e-4)
    with pytest.raises(ValueError, match="matrix: cannot be combined with positions"):
        Scene().add(BUNDLE, (0, 0, 0), matrix=noisy)


def test_opacity_and_tint_are_columns_like_others():
    scene = Scene()
    scene.add(BUNDLE, np.zeros((2, 3)), opacity=[0.25, 1], tint=(1, 0.5, 0))
    assert scene.factors.tolist() == [[1, 0.5, 0, 0.25], [1, 0.5, 0, 1]]
    revision = scene.revision
    scene.set_opacity(0.5, [1])
    scene.set_tint((2, 2, 2), [0])
    assert scene.revision[0] == revision[0] + 2
    assert scene.opacity.tolist() == [0.25, 0.5]
    scene.remove([0])
    assert scene.factors.tolist() == [[1, 0.5, 0, 0.5]]
    scene.set_opacity(1)
    scene.set_tint((1, 1, 1))
    assert scene.factors is None
    assert pickle.loads(pickle.dumps(scene)).opacity.tolist() == [1]


@pytest.mark.parametrize(
    ("factors", "message"),
    [
        ({"opacity": 1.5}, "opacity: expected numbers from 0 to 1, got 1.5"),
        ({"opacity": -0.1}, "opacity: expected numbers from 0 to 1, got -0.1"),
        ({"opacity": np.nan}, "opacity: expected finite numbers"),
        ({"tint": (1, 1)}, "tint: expected shape"),
        ({"tint": (1, -1, 1)}, "tint: expected numbers of at least 0"),
        ({"tint": (1, 1e39, 1)}, "tint: expected numbers of at least 0 that a float32 can hold"),
    ],
)
def test_wrong_factors_are_named(factors, message):
    with pytest.raises(ValueError, match=message):
        Scene().add(BUNDLE, **factors)


def test_a_scene_is_placed_as_a_whole():
    inner = Scene()
    inner.add(BUNDLE, [(1, 0, 0), (0, 2, 0)], (1, 0.2, 0.3, 0.4), [1, 3], 2.0, opacity=0.5)
    inner.add(OTHER, tint=(0.5, 1, 1))
    scene = Scene()
    scene.add(OTHER)
    quarter = (1, 0, 0, 1)
    ids = scene.add_scene(inner, (10, 0, 0), quarter, 2.0, 4.0, opacity=0.5, tint=(1, 0.5, 1))
    assert ids == range(1, 4)
    assert scene.bundles == (OTHER, BUNDLE)
    turn = rotation_from_quaternion(np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)]))
    expected = 2 * inner.positions @ turn.T + (10, 0, 0)
    np.testing.assert_allclose(scene.positions[1:], expected, atol=1e-12)
    np.testing.assert_allclose(scene.rotations[1:], turn @ inner.rotations, atol=1e-12)
    np.testing.assert_array_equal(scene.scales[1:], 2 * inner.scales)
    np.testing.assert_array_equal(scene.importance[1:], 4 * inner.importance)
    np.testing.assert_array_equal(scene.opacity[1:], 0.5 * inner.opacity)
    np.testing.assert_array_equal(scene.tint[1:], inner.tint * (1, 0.5, 1))
    inner.remove([0])
    assert len(scene) == 4


def test_a_placed_scene_is_turned_from_its_own_up():
    inner = Scene()
    inner.add(BUNDLE, up="y")
    scene = Scene()
    scene.add_scene(inner, up="z")
    np.testing.assert_allclose(scene.rotations[0] @ (0, -1, 0), (0, 0, 1), atol=1e-12)
    with pytest.raises(ValueError, match="scale: expected a positive number"):
        scene.add_scene(inner, scale=0)
    with pytest.raises(TypeError, match="scene: expected a Scene"):
        scene.add_scene(BUNDLE)
