import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from random_bundle import random_bundle
from v3dg import Scene

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
        ({"quaternions": [[1, 0, 0, 0]] * 2}, r"quaternions: expected shape \(1, 4\), got \(2, 4\)"),
        ({"quaternions": [0, 0, 0, 0]}, "quaternions: expected a rotation, got a quaternion of zeros"),
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
    with pytest.raises(TypeError, match="bundle: expected a Bundle, got Scene"):
        Scene().add(Scene())
