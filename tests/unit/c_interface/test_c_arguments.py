"""Wrong arguments of the C library raise errors that name them."""

import contextlib
import ctypes
import math
from ctypes import byref, c_uint32, c_uint64

import numpy as np
import pytest

import c_library
from c_library import Camera, CScene, Failure, Instance, Rule, c_camera, c_rule, call
from random_bundle import random_bundle
from v3dg import Camera as PythonCamera

pytestmark = pytest.mark.slow  # slow, because the library is compiled first
CAMERA = PythonCamera.look_at((0, -3, 0), (0, 0, 0), width=64, height=48)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("arguments") / "a.v3dg"
    random_bundle(1).write(path)
    with CScene(path) as opened:
        yield opened


@contextlib.contextmanager
def refused(expected):
    """Expect an argument error whose message begins with a text."""
    with pytest.raises(Failure, match=expected) as failure:
        yield
    assert failure.value.status == c_library.ARGUMENT


def instance(**change):
    made = Instance((0, 0, 0), (1, 0, 0, 0), 1, 0, -1, 1, 1, (1, 1, 1))
    for name, value in change.items():
        setattr(made, name, value)
    return made


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": -1}, r"instances\[1\].scale: expected a positive number, got -1"),
        ({"scale": math.nan}, r"instances\[1\].scale: expected a positive number, got nan"),
        ({"scale": math.inf}, r"instances\[1\].scale: expected a positive number, got inf"),
        ({"quaternion": (0, 0, 0, 0)}, r"instances\[1\].quaternion: expected a nonzero quat"),
        ({"quaternion": (math.inf, 0, 0, 0)}, r"instances\[1\].quaternion: expected finite"),
        ({"position": (0, math.nan, 0)}, r"instances\[1\].position: expected finite numbers"),
        ({"importance": 0}, r"instances\[1\].importance: expected a positive number"),
        ({"opacity": 1.5}, r"instances\[1\].opacity: expected a number from 0 to 1, got 1.5"),
        ({"tint": (0, -1, 0)}, r"instances\[1\].tint: expected 3 numbers of at least 0"),
        ({"environment": -2}, r"instances\[1\].environment: expected a whole number from -1"),
        ({"bundle": 1}, r"instances\[1\].bundle: expected an index below 1, got 1"),
    ],
)
def test_wrong_instances_are_named_and_change_nothing(scene, change, message):
    before = [bytes(item) for item in scene.instances()]
    with refused(message):
        scene.set_instances([instance(), instance(**change)])
    assert [bytes(item) for item in scene.instances()] == before


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tolerance_px2": -1.0}, "tolerance: expected a number of px² of at least 0, got -1.0"),
        ({"tolerance_px2": math.nan}, "tolerance: expected a number of px²"),
        ({"fade": 0.5}, "fade: expected a factor from 1 to 1000, got 0.5"),
        ({"fade": math.nan}, "fade: expected a factor from 1 to 1000, got nan"),
        ({"budget": 1 << 63}, "budget: expected at most 9223372036854775807"),
        ({"min_level": -1}, "min_level: expected the index of a level, at least 0, got -1"),
    ],
)
def test_wrong_rules_are_named(scene, change, message):
    rule = Rule(3.0, 1.0, c_library.NO_BUDGET, 0, 1)
    for name, value in change.items():
        setattr(rule, name, value)
    with refused(message), scene.cut(c_camera(CAMERA), rule=rule):
        pass


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": 0}, "K: expected positive focal lengths, got 0 and"),
        ({"cx": math.nan}, "K: expected finite numbers, got nan"),
        ({"width": 0}, "width: expected a positive whole number, got 0"),
        ({"height": 65536}, "width, height: expected 1 to 65535 px, got 64 x 65536"),
        ({"near_depth": 0}, "near: expected a positive number, got 0"),
        ({"lens": 3}, "lens: expected V3DG_PINHOLE, V3DG_OPENCV or V3DG_FISHEYE, got 3"),
        ({"distortion": (0.1,)}, "distortion: expected 0 coefficients of this lens and then"),
        ({"viewmat": (2,)}, "viewmat: expected a rotation in the upper left 3x3"),
        ({"viewmat": (math.inf,)}, "viewmat: expected finite numbers, got inf"),
    ],
)
def test_wrong_cameras_are_named(scene, change, message):
    camera = c_camera(CAMERA)
    for name, value in change.items():
        if isinstance(value, tuple):
            getattr(camera, name)[: len(value)] = value
        else:
            setattr(camera, name, value)
    with refused(message), scene.cut(camera):
        pass


def test_eyes_that_cannot_share_a_cut_are_refused(scene):
    other = PythonCamera.look_at((1, -3, 0), (0, 0, 0), width=64, height=48)
    eyes = (c_camera(CAMERA), c_camera(other))
    with refused("right: expected a camera of the same rotation"), scene.cut(*eyes):
        pass
    with refused("num_eyes: expected 1 or 2, got 3"), scene.cut(*eyes, eyes[0]):
        pass


def test_look_at_is_that_of_python():
    rng = np.random.default_rng(0)
    for _ in range(50):
        eye, target, up = rng.normal(size=(3, 3))
        expected = PythonCamera.look_at(eye, target, up, 1.1, width=640, height=480, near=0.1)
        camera = Camera()
        points = [(ctypes.c_double * 3)(*point) for point in (eye, target, up)]
        call("v3dg_look_at", *points, 1.1, 640, 480, 0.1, byref(camera))
        np.testing.assert_allclose(
            np.array(camera.viewmat).reshape(4, 4), expected.viewmat, atol=1e-13
        )
        numbers = (camera.fx, camera.fy, camera.cx, camera.cy, camera.near_depth)
        np.testing.assert_allclose(numbers, (expected.fx, expected.fy, 320, 240, 0.1))


def test_residency_needs_the_pages_above(scene):
    count = scene.bundle_info().num_pages
    with refused("is_resident: expected the last page, got it as missing"):
        scene.set_resident(0, np.zeros(count))
    with refused(f"num_pages: expected {count}, got 1"):
        scene.set_resident(0, np.ones(1))
    child = next(p for p in range(count) if scene.page_info(p).parent not in (-1, count - 1))
    flags = np.zeros(count)
    flags[[child, -1]] = 1
    parent = scene.page_info(child).parent
    with refused(f"is_resident: expected page {parent} above page {child}, got it as missing"):
        scene.set_resident(0, flags)


def test_a_cut_of_other_instances_is_refused(scene):
    with scene.cut(c_camera(CAMERA), rule=c_rule(0.0)) as cut:
        scene.read_cut(cut)
        scene.set_instances([instance()])
        with refused("cut: expected a cut of the scene's current instances, got another"):
            scene.read_cut(cut)


def test_memory_that_is_too_small_is_named_and_not_written(scene):
    size = scene.page_info(0).num_bytes
    memory = ctypes.create_string_buffer(b"x" * size, size)
    with refused(f"capacity: expected room for {size} bytes, got {size - 1}"):
        call("v3dg_read_page", scene.handle, c_uint32(0), c_uint32(0), memory, c_uint64(size - 1))
    assert memory.raw == b"x" * size
    rows = c_library.empty_rows(scene.page_info(0).num_gaussians, 0)
    out = c_library.memory_of(rows)
    out.capacity -= 1
    with refused("gaussians.capacity: expected room for"):
        call("v3dg_read_gaussians", scene.handle, c_uint32(0), c_uint32(0), byref(out))
    out.sh_degree = 4
    with refused("gaussians.sh_degree: expected 0 to 3, got 4"):
        call("v3dg_read_gaussians", scene.handle, c_uint32(0), c_uint32(0), byref(out))
    assert all(np.isnan(values).all() for values in rows)


def test_arrays_that_are_not_wanted_are_left_out(scene):
    with scene.cut(c_camera(CAMERA), rule=c_rule(0.0)) as cut:
        expected = scene.read_cut(cut)
        rows = c_library.empty_rows(cut.num_gaussians, 0)
        memory = c_library.memory_of(rows)
        memory.quaternions = None
        memory.sh = None
        call("v3dg_read_cut", scene.handle, byref(cut), None, byref(memory))
    for index in (0, 2, 3):
        np.testing.assert_array_equal(rows[index], expected[index])
    assert np.isnan(rows[1]).all()


def test_indices_and_pointers_are_checked(scene):
    info = c_library.PageInfo()
    count = scene.bundle_info().num_pages
    with refused("bundle: expected an index below 1, got 7"):
        scene.bundle_info(7)
    with refused(f"page: expected an index below {count}, got {count}"):
        scene.page_info(count)
    with refused("index: expected an index below 0, got 0"):
        scene.camera(0)
    with refused("scene: expected a pointer, got NULL"):
        call("v3dg_get_page_info", None, c_uint32(0), c_uint32(0), byref(info))
    with refused("info: expected a pointer, got NULL"):
        call("v3dg_get_page_info", scene.handle, c_uint32(0), c_uint32(0), None)
    with refused("path: expected a pointer, got NULL"):
        call("v3dg_open", None, byref(ctypes.c_void_p()))
    c_library.library().v3dg_close(None)
    c_library.library().v3dg_free_cut(None)


@pytest.mark.parametrize("name", ["missing.v3dg", "missing.json"])
def test_files_that_are_not_there_are_errors_of_the_system(tmp_path, name):
    with pytest.raises(Failure, match="No such file or directory") as failure:
        CScene(tmp_path / name)
    assert failure.value.status == c_library.SYSTEM


@pytest.mark.parametrize("name", ["folder.v3dg", "folder.json"])
def test_folders_are_refused(tmp_path, name):
    (tmp_path / name).mkdir()
    with pytest.raises(Failure, match="expected a file, got a directory, a device or a pipe"):
        CScene(tmp_path / name)
