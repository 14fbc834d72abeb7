import copy
import math
import pickle
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from v3dg.cameras import Camera, turntable

coordinate = st.floats(-1e3, 1e3)
vector = st.tuples(coordinate, coordinate, coordinate).map(np.array)


def pixel(camera, point):
    view = camera.viewmat @ [*point, 1.0]
    u, v, w = camera.K @ view[:3]
    return np.array([u / w, v / w]), view[2]


@given(eye=vector, direction=vector.filter(lambda v: np.linalg.norm(v) > 1e-3), up=vector)
def test_look_at_centres_the_target(eye, direction, up):
    length = np.linalg.norm(direction)
    if np.linalg.norm(np.cross(direction, up)) < 1e-3 * length * max(np.linalg.norm(up), 1e-3):
        return
    camera = Camera.look_at(eye, eye + direction, up, width=640, height=480)
    np.testing.assert_allclose(camera.position, eye, atol=1e-9)
    uv, depth = pixel(camera, eye + direction)
    np.testing.assert_allclose(uv, [320, 240], atol=1e-6)
    np.testing.assert_allclose(depth, length, rtol=1e-9)
    rotation = camera.viewmat[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) > 0


def test_transposed_matrices_are_taken():
    """The memory of `matrix.T` is in column-major order, but the core reads rows."""
    turned = Camera.look_at((1, 2, 3), (4, 5, 7), width=64, height=48)
    camera = Camera(np.asfortranarray(turned.viewmat), np.asfortranarray(turned.K), 64, 48)
    assert camera.viewmat.flags.c_contiguous
    assert camera.K.flags.c_contiguous
    np.testing.assert_array_equal(camera.viewmat, turned.viewmat)


@pytest.mark.parametrize(
    "again", [copy.copy, copy.deepcopy, lambda c: pickle.loads(pickle.dumps(c))]
)
def test_camera_is_copied_and_pickled_as_it_is(again):
    """This also holds for a camera that has been drawn, which keeps an object of the
    core."""
    camera, drawn = (
        Camera.look_at((3, -4, 2), (0, 0, 0), width=64, height=48, near=0.5) for _ in range(2)
    )
    assert drawn.core is not None
    for source in (camera, drawn):
        other = again(source)
        np.testing.assert_array_equal(other.viewmat, camera.viewmat)
        np.testing.assert_array_equal(other.K, camera.K)
        assert (other.width, other.height, other.near) == (64, 48, 0.5)
        np.testing.assert_array_equal(other.position, drawn.position)


def test_camera_of_the_core_is_made_once():
    camera = Camera.look_at((3, -4, 2), (0, 0, 0), width=64, height=48)
    assert camera.core is camera.core
    wider = replace(camera, width=128)
    assert wider.core is not camera.core
    wider.core.window(64, 0, 128, 48)  # the other camera has no attribute for this


def test_position_of_a_rounded_matrix_is_what_it_brings_to_zero():
    """The rows are orthonormal only up to the precision of float32 text, and the camera
    is far from the origin."""
    exact = Camera.look_at((3e4, -2e4, 5e3), (1, 2, 3), width=64, height=48).viewmat
    viewmat = np.round(exact, 4)
    camera = Camera(viewmat, np.diag([50.0, 50.0, 1.0]), 64, 48)
    assert np.abs(viewmat[:3, :3] @ viewmat[:3, :3].T - np.eye(3)).max() > 1e-6
    np.testing.assert_allclose(viewmat @ [*camera.position, 1.0], [0, 0, 0, 1], atol=1e-9)


def test_look_at_has_up_upwards_and_right_to_the_right():
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), (0, 0, 1), math.pi / 2, width=200, height=100)
    # y points down, so a higher point is in a row with a smaller index.
    np.testing.assert_allclose(pixel(camera, (0, 0, 1))[0], [100, 30])
    np.testing.assert_allclose(pixel(camera, (1, 0, 0))[0], [120, 50])
    np.testing.assert_allclose(pixel(camera, (5, 0, 0))[0], [200, 50])  # half the field of view


def test_blender_camera_looks_along_minus_z():
    matrix = np.eye(4)
    matrix[:3, 3] = (1, 2, 3)
    camera = Camera.from_blender(matrix, math.pi / 2, 200, 100)
    np.testing.assert_allclose(camera.position, (1, 2, 3))
    uv, depth = pixel(camera, (1, 2, 1))
    np.testing.assert_allclose((*uv, depth), (100, 50, 2))
    # In Blender, y of a camera points up.
    np.testing.assert_allclose(pixel(camera, (1, 3, 1))[0], [100, 0], atol=1e-9)
    assert camera.fy == camera.fx
    two_fields = Camera.from_blender(matrix, math.pi / 2, 200, 100, fov_y=math.pi / 2)
    assert two_fields.fy == pytest.approx(50)


@given(eye=vector, seed=st.integers(0, 2**32 - 1))
def test_blender_camera_agrees_with_look_at(eye, seed):
    target = eye + np.random.default_rng(seed).normal(size=3)
    camera = Camera.look_at(eye, target, (0.1, 0.2, 1.0), 0.9, width=64, height=48)
    to_world = np.linalg.inv(camera.viewmat)
    to_world[:3, 1:3] *= -1
    again = Camera.from_blender(to_world.astype(np.float32), 0.9, 64, 48)
    np.testing.assert_allclose(again.viewmat, camera.viewmat, atol=1e-3)
    np.testing.assert_allclose(again.K, camera.K)


def test_scaled_camera_sees_the_same():
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), width=30, height=20)
    double = camera.scaled(2)
    assert (double.width, double.height) == (60, 40)
    np.testing.assert_allclose(
        pixel(double, (0.1, 0.2, 0.3))[0], 2 * pixel(camera, (0.1, 0.2, 0.3))[0]
    )
    np.testing.assert_array_equal(double.viewmat, camera.viewmat)


@given(center=vector, n=st.integers(0, 8), elevation=st.floats(-1.5, 1.5), up=vector)
def test_turntable_keeps_its_distance(center, n, elevation, up):
    if np.linalg.norm(up) < 1e-3:
        return
    cameras = turntable(center, 3.0, n, elevation, up=up)
    assert len(cameras) == n
    axis = up / np.linalg.norm(up)
    for camera in cameras:
        offset = camera.position - center
        np.testing.assert_allclose(np.linalg.norm(offset), 3.0, rtol=1e-6)
        np.testing.assert_allclose(offset @ axis, 3.0 * math.sin(elevation), atol=1e-6)


def test_matrices_are_copied():
    viewmat = np.eye(4)
    camera = Camera(viewmat, np.eye(3), 8, 8)
    viewmat[0, 3] = 5
    assert camera.viewmat[0, 3] == 0


def with_entry(matrix, entry, value):
    matrix = np.array(matrix, dtype=float)
    matrix[entry] = value
    return matrix


GOOD = {"viewmat": np.eye(4), "K": np.eye(3), "width": 8, "height": 8}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"viewmat": np.eye(3)}, r"viewmat: expected shape \(4, 4\), got \(3, 3\)"),
        ({"viewmat": "wide"}, r"viewmat: expected numbers of shape \(4, 4\), got str"),
        (
            {"viewmat": with_entry(np.eye(4), (0, 3), np.nan)},
            "viewmat: expected finite numbers, got nan",
        ),
        ({"viewmat": 2 * np.eye(4)}, "viewmat: expected a rotation"),
        ({"viewmat": np.diag([1.0, 1.0, -1.0, 1.0])}, "viewmat: expected a rotation"),
        (
            {"viewmat": with_entry(np.eye(4), (3, 0), 1)},
            "viewmat: expected the last row 0 0 0 1, got",
        ),
        (
            {"K": with_entry(np.eye(3), (0, 0), -1)},
            "K: expected positive focal lengths, got -1 and 1",
        ),
        ({"K": with_entry(np.eye(3), (0, 1), 1)}, "K: expected .* got a matrix with skew"),
        ({"width": 0}, "width: expected a positive whole number, got 0"),
        ({"width": 8.5}, "width: expected a positive whole number, got 8.5"),
        ({"height": -1}, "height: expected a positive whole number, got -1"),
        ({"near": 0.0}, "near: expected a positive number, got 0.0"),
        ({"near": math.inf}, "near: expected a positive number, got inf"),
    ],
)
def test_camera_refuses_bad_values(change, message):
    with pytest.raises(ValueError, match=message):
        Camera(**{**GOOD, **change})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"target": (1, 1, 1)}, "target: expected a point away from the eye"),
        ({"target": (1e200, 0, 0)}, "target: expected points whose distance a double can hold"),
        ({"up": (2, 2, 2)}, "up: expected a direction that is not along the view"),
        ({"up": (0, 0, 0)}, "up: expected a direction that is not along the view"),
        ({"fov_x": 0.0}, "fov_x: expected radians between 0 and pi, got 0.0"),
        ({"fov_x": 3.2}, "fov_x: expected radians between 0 and pi, got 3.2"),
        ({"fov_x": math.nan}, "fov_x: expected radians between 0 and pi, got nan"),
    ],
)
def test_look_at_refuses_bad_values(change, message):
    good = {"eye": (1, 1, 1), "target": (0, 0, 0), "up": (0, 0, 1), "width": 8, "height": 8}
    with pytest.raises(ValueError, match=message):
        Camera.look_at(**{**good, **change})


@pytest.mark.parametrize("length", [1e-300, 1e300])
def test_up_may_have_any_length(length):
    camera = Camera.look_at((1, 2, 3), (0, 0, 0), (0, 0, length), width=8, height=8)
    np.testing.assert_array_equal(
        camera.viewmat, Camera.look_at((1, 2, 3), (0, 0, 0), width=8, height=8).viewmat
    )


def test_blender_camera_refuses_a_scale():
    with pytest.raises(ValueError, match="transform_matrix: expected a rotation"):
        Camera.from_blender(np.diag([2.0, 2.0, 2.0, 1.0]), 0.8, 8, 8)


def test_matrices_may_be_tensors_but_not_complex():
    torch = pytest.importorskip("torch")
    for dtype in (torch.float32, torch.float64, torch.int64):
        camera = Camera(torch.eye(4, dtype=dtype), torch.eye(3, dtype=dtype), 8, 8)
        np.testing.assert_array_equal(camera.viewmat, np.eye(4))
    learnt = torch.eye(4, requires_grad=True)
    np.testing.assert_array_equal(Camera(learnt, torch.eye(3), 8, 8).K, np.eye(3))
    with pytest.raises(
        ValueError, match=r"viewmat: expected numbers of shape \(4, 4\), got ndarray of complex128"
    ):
        Camera(np.eye(4) + 0j, np.eye(3), 8, 8)
    with pytest.raises(
        ValueError, match=r"K: expected numbers of shape \(3, 3\), got Tensor of torch.complex64"
    ):
        Camera(np.eye(4), torch.eye(3) + 0j, 8, 8)
    with pytest.raises(ValueError, match="viewmat: expected numbers of shape"):
        Camera(torch.eye(4).to_sparse(), np.eye(3), 8, 8)
