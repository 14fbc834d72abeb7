"""Cameras, bodies and geoms of MuJoCo in a scene of gaussians."""

import os
import sys
from ctypes.util import find_library
from pathlib import Path

import numpy as np
import pytest

import v3dg
from v3dg.donut import make_donut


def opengl_here():
    """Return a library for OpenGL without a display, by its name in MUJOCO_GL."""
    for name, library in (("egl", "EGL"), ("osmesa", "OSMesa")):
        if find_library(library) is not None:
            return name
    return "disable"


os.environ.setdefault("MUJOCO_GL", opengl_here())
mujoco = pytest.importorskip("mujoco", reason="mujoco is not installed")

import OpenGL.error  # noqa: E402

from v3dg.simulators.mujoco import (  # noqa: E402
    FIRST_GEOM,
    Attachments,
    MeshRenderer,
    SplatRenderer,
    camera_of,
    cameras_of,
)

sys.path.append(str(Path(__file__).parents[3] / "examples"))
import mujoco_among_splats  # noqa: E402

WIDTH = 160
HEIGHT = 120
CAMERAS = ("plain", "lens", "on_body", -1)
MODEL = """
<mujoco>
  <visual><map znear="0.02"/></visual>
  <statistic extent="2" center="0 0 0.5"/>
  <worldbody>
    <light pos="0 -1 3"/>
    <camera name="plain" pos="0.2 -3 1" xyaxes="1 0.1 0 0 0.3 1" fovy="50"/>
    <camera name="lens" pos="-0.3 -3 1" xyaxes="1 0 0 0 0.2 1" resolution="160 120"
      sensorsize="0.016 0.012" focal="0.012 0.012" principal="0.002 -0.001"/>
    <geom name="marker" type="sphere" pos="0.5 0.1 0.9" size="0.06"/>
    <geom name="other" type="sphere" pos="-0.4 0.3 0.4" size="0.06"/>
    <body name="cart" pos="0 0 0.5">
      <joint name="slide" type="slide" axis="1 0 0"/>
      <joint name="turn" axis="0 0 1"/>
      <geom name="box" type="box" size="0.25 0.25 0.25" rgba="0 0 1 1" group="1"/>
      <camera name="on_body" pos="0.3 -2.5 0.4" xyaxes="1 0 0 0 0 1" fovy="60"/>
    </body>
  </worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def model():
    return mujoco.MjModel.from_xml_string(MODEL)


@pytest.fixture
def data(model):
    state = mujoco.MjData(model)
    state.qpos[:] = (0.15, 0.2)
    mujoco.mj_forward(model, state)
    return state


@pytest.fixture(scope="module")
def drawable(model):
    """Return the model.

    Skip the test if MuJoCo has no library or context of OpenGL here.
    """
    if not hasattr(mujoco, "GLContext"):
        pytest.skip("MuJoCo cannot draw here: it has no library for OpenGL")
    try:
        mujoco.GLContext(8, 8).free()
    except (ImportError, RuntimeError, OpenGL.error.Error) as error:
        pytest.skip(f"MuJoCo cannot draw here: {error}")
    return model


@pytest.fixture(scope="module")
def donut():
    config = v3dg.BuildConfig(steps=0)
    return v3dg.build_bundle(make_donut(2000), config=config, progress=False, device="cpu")


def geom_id(model, name):
    return mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, name)


@pytest.mark.parametrize("name", CAMERAS)
def test_cameras_see_geoms_where_mujoco_draws_them(drawable, data, name):
    camera = camera_of(drawable, data, name, width=WIDTH, height=HEIGHT)
    with MeshRenderer(drawable, width=WIDTH, height=HEIGHT, samples=4) as meshes:
        layer = meshes.draw(data, name)
    for geom in ("marker", "other"):
        number = geom_id(drawable, geom)
        point = camera.viewmat[:3, :3] @ data.geom_xpos[number] + camera.viewmat[:3, 3]
        expected = (camera.K @ point)[:2] / point[2]
        weight = layer.coverage * (layer.instance == FIRST_GEOM + number)
        rows, columns = np.mgrid[:HEIGHT, :WIDTH] + 0.5
        middle = np.array([(weight * columns).sum(), (weight * rows).sum()]) / weight.sum()
        # A sphere is drawn as polygons, and slightly larger away from the axis.
        np.testing.assert_allclose(middle, expected, atol=0.3)
        nearest = layer.depth[layer.instance == FIRST_GEOM + number].min()
        np.testing.assert_allclose(nearest, point[2] - 0.06, atol=0.004)


def test_camera_has_the_near_plane_of_the_model(model, data):
    camera = camera_of(model, data, "plain", width=WIDTH, height=HEIGHT)
    np.testing.assert_allclose(camera.near, 0.04, rtol=1e-6)


def test_cameras_of_the_model_are_a_batch(model, data):
    other = mujoco.MjData(model)
    mujoco.mj_forward(model, other)
    batch = cameras_of(model, [data, other], width=WIDTH, height=HEIGHT)
    assert batch.environments.tolist() == [0, 0, 0, 1, 1, 1]
    for number, name in enumerate(("plain", "lens", "on_body")):
        camera = camera_of(model, other, name, width=WIDTH, height=HEIGHT)
        np.testing.assert_array_equal(batch.viewmats[3 + number], camera.viewmat)
        np.testing.assert_array_equal(batch.K[3 + number], camera.K)
    # this camera is on a body that moved
    assert not np.allclose(batch.viewmats[2], batch.viewmats[5])
    alone = cameras_of(model, data, ["lens"], width=WIDTH, height=HEIGHT)
    assert len(alone) == 1
    assert alone.environments is None


def test_attached_instances_move_with_the_body(model, data, donut):
    scene = v3dg.Scene()
    scene.add(donut, (5, 5, 5))
    ids = scene.add(donut, np.zeros((2, 3)), scales=(0.2, 0.3))
    attachments = Attachments(model, scene)
    attachments.attach(ids, "cart", (0.1, 0, 0.4), (0, 0, 0, 2))
    attachments.move(data)
    angle = 0.2
    middle = (0.15 + 0.1 * np.cos(angle), 0.1 * np.sin(angle), 0.9)
    np.testing.assert_allclose(scene.positions[1:], [middle, middle], atol=1e-12)
    np.testing.assert_array_equal(scene.positions[0], (5, 5, 5))
    np.testing.assert_array_equal(scene.scales[1:], (0.2, 0.3))
    cosine = np.cos(angle)
    sine = np.sin(angle)
    half_turn = np.diag([-1.0, -1, 1])
    expected = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1]]) @ half_turn
    np.testing.assert_allclose(scene.rotations[1], expected, atol=1e-12)


@pytest.mark.parametrize(("y", "is_hidden"), [(0.8, True), (-0.8, False)])
def test_geoms_hide_gaussians_behind_them(drawable, data, donut, y, is_hidden):
    camera = camera_of(drawable, data, "plain", width=WIDTH, height=HEIGHT)
    box = np.array([0.15, 0, 0.5])
    away = box - camera.position
    place = box + away / np.linalg.norm(away) * y
    scene = v3dg.Scene()
    scene.add(donut, place, scales=0.08, label=4)
    labels = np.arange(drawable.ngeom) + 10
    with SplatRenderer(
        drawable, scene, width=WIDTH, height=HEIGHT, labels=labels, device="cpu"
    ) as renderer:
        image = renderer.render(data, "plain", channels=("instance", "label", "depth"))
    number = geom_id(drawable, "box")
    assert ((image.instance == 0).sum() == 0) == is_hidden
    assert (image.instance == FIRST_GEOM + number).sum() > 300
    assert (image.label[image.instance == FIRST_GEOM + number] == 10 + number).all()
    assert (image.label[image.instance == 0] == 4).all()
    is_box = image.instance == FIRST_GEOM + number
    color = image.color[is_box].mean(axis=0)
    assert color[2] > 3 * color[0]


def test_groups_that_are_not_visible_are_not_drawn(drawable, data):
    option = mujoco.MjvOption()
    option.geomgroup[1] = 0
    with MeshRenderer(drawable, width=WIDTH, height=HEIGHT, option=option) as meshes:
        layer = meshes.draw(data, "plain")
    assert not (layer.instance == FIRST_GEOM + geom_id(drawable, "box")).any()
    assert (layer.instance == FIRST_GEOM + geom_id(drawable, "marker")).any()


def test_edges_have_partial_coverage_and_no_sky(drawable, data):
    with MeshRenderer(drawable, width=WIDTH, height=HEIGHT, samples=4) as meshes:
        layer = meshes.draw(data, "plain")
    is_edge = (layer.coverage > 0) & (layer.coverage < 1)
    is_box = layer.instance == FIRST_GEOM + geom_id(drawable, "box")
    assert (is_edge & is_box).sum() > 50
    assert layer.color[is_edge & is_box][:, 0].max() < 0.1  # the box is blue


def test_large_pictures_leave_the_model_as_it_was(drawable, data):
    screen = drawable.vis.global_
    before = (screen.offwidth, screen.offheight, drawable.vis.quality.offsamples)
    with MeshRenderer(drawable, width=700, height=20, samples=2) as meshes:
        assert meshes.draw(data, "plain").coverage.shape == (20, 700)
    assert (screen.offwidth, screen.offheight, drawable.vis.quality.offsamples) == before


def test_wrong_arguments_are_errors(model, data, donut):
    with pytest.raises(ValueError, match="camera: expected one of 'plain', 'lens', 'on_body'"):
        camera_of(model, data, "side", width=8, height=8)
    with pytest.raises(ValueError, match="camera: expected at most 2, got 3"):
        camera_of(model, data, 3, width=8, height=8)
    scene = v3dg.Scene()
    scene.add(donut)
    attachments = Attachments(model, scene)
    with pytest.raises(ValueError, match="body: expected one of 'world', 'cart', got 'car'"):
        attachments.attach(0, "car")
    with pytest.raises(ValueError, match="instances: expected ids from 0 to 0, got \\[1\\]"):
        attachments.attach(1, "cart")
    attachments.attach(0, "cart")
    with pytest.raises(ValueError, match="instances: expected instances without a body"):
        attachments.attach([0], "world")
    with pytest.raises(ValueError, match="samples: expected 1 to 8"):
        MeshRenderer(model, width=8, height=8, samples=0)
    with pytest.raises(ValueError, match="labels: expected 3 whole numbers, got shape"):
        MeshRenderer(model, width=8, height=8, labels=[1, 2])
    with pytest.raises(TypeError, match="scene: expected a Scene"):
        Attachments(model, donut)


def test_sensors_that_mujoco_draws_otherwise_are_refused(model, data):
    with pytest.raises(ValueError, match=r"aspect 8:8 of the picture, got .* aspect 1\.333"):
        camera_of(model, data, "lens", width=8, height=8)
    text = MODEL.replace('focal="0.012 0.012"', 'focal="0.012 0.015"')
    other = mujoco.MjModel.from_xml_string(text)
    state = mujoco.MjData(other)
    mujoco.mj_forward(other, state)
    with pytest.raises(ValueError, match="camera: expected a sensor with square pixels"):
        camera_of(other, state, "lens", width=WIDTH, height=HEIGHT)


def test_orthographic_cameras_are_refused():
    model = mujoco.MjModel.from_xml_string(MODEL)
    column = "cam_projection"
    if not hasattr(model, column):
        column = "cam_orthographic"  # the name in older versions
    getattr(model, column)[0] = 1
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with pytest.raises(ValueError, match="camera: expected a perspective projection, got 'plain'"):
        camera_of(model, data, "plain", width=8, height=8)


def test_example_pushes_the_donut():
    _, before = mujoco_among_splats.simulate(0)
    _, after = mujoco_among_splats.simulate(2)
    shift = after.body("donut").xpos - before.body("donut").xpos
    assert np.linalg.norm(shift[:2]) > 0.05
    assert abs(shift[2]) < 0.02


def test_example_draws_an_arm_that_moves_a_donut(drawable, tmp_path):
    path = tmp_path / "arm.png"
    config = mujoco_among_splats.Config(output=path, gaussians=1000, size=(160, 90), seconds=2.0)
    image = mujoco_among_splats.main(config)
    assert path.stat().st_size > 10_000
    assert (image.instance == 0).sum() > 30
    assert (image.instance >= FIRST_GEOM).mean() > 0.3
