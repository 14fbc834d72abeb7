"""Tests a camera sensor for models of Newton: worlds, bodies, images, and Newton's own
pictures of the same gaussians."""

import numpy as np
import pytest

import v3dg
from v3dg.donut import make_donut

newton = pytest.importorskip("newton", reason="newton is not installed")
warp = pytest.importorskip("warp", reason="warp is not installed")
pytest.importorskip("torch", reason="torch is not installed")

from v3dg.simulators.newton import (  # noqa: E402
    FIRST_SHAPE,
    NO_SHAPE,
    SplatCamera,
    gaussians_of,
    mesh_layer,
)

SIZE = 48
FOV = 0.8
EYE = (0.0, -2.0, 0.5)
# A camera that looks along the world's y axis: its -z is the world's y, and its y is
# the world's z.
TURN = (np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))
CONFIG = v3dg.BuildConfig(steps=0)


def make_gaussian(degree):
    asset = v3dg.to_degree(make_donut(1000), degree)
    rest = asset.sh[:, 1:].transpose(0, 2, 1).reshape(len(asset.means), -1)
    return newton.Gaussian(
        asset.means,
        np.roll(asset.quats, -1, axis=1),
        asset.scales,
        asset.opacities,
        np.concatenate([asset.sh[:, 0], rest], axis=1),
    )


@pytest.fixture(scope="module")
def gaussian():
    return make_gaussian(1)


def make_model(gaussian, *, num_worlds=3, is_shared=False, scale=(0.3, 0.3, 0.3)):
    builder = newton.ModelBuilder()
    part = newton.ModelBuilder()
    body = part.add_body(xform=warp.transform((0, 0, 0.5), warp.quat_identity()))
    place = warp.transform((0.1, 0, 0), warp.quat_identity())
    part.add_shape_gaussian(body, xform=place, gaussian=gaussian, scale=scale)
    if is_shared:
        place = warp.transform((-0.5, 0, 0.9), warp.quat_identity())
        builder.add_shape_gaussian(-1, xform=place, gaussian=gaussian, scale=(0.1, 0.1, 0.1))
    builder.replicate(part, num_worlds)
    return builder.finalize(device="cpu")


def make_camera(model):
    return SplatCamera(model, width=SIZE, height=SIZE, camera_fov=FOV, config=CONFIG)


def views_of(count):
    return warp.array([(*EYE, *TURN)] * count, dtype=warp.transformf, device="cpu")


def our_view():
    return v3dg.Camera.look_at(EYE, (0, 0, 0.5), fov_x=FOV, width=SIZE, height=SIZE)


def test_gaussians_are_those_of_newton(gaussian):
    expected = make_donut(1000)
    asset = gaussians_of(gaussian)
    for name in ("means", "scales", "sh"):
        np.testing.assert_array_equal(getattr(asset, name), getattr(expected, name))
    np.testing.assert_allclose(asset.quats, expected.quats, atol=1e-6)
    np.testing.assert_allclose(asset.opacities, expected.opacities, atol=1e-6)


def test_views_show_the_gaussians_of_their_world_where_the_bodies_are(gaussian):
    model = make_model(gaussian)
    state = model.state()
    poses = state.body_q.numpy()
    poses[1] = (0.2, 0.1, 0.4, 0, 0, np.sin(0.3), np.cos(0.3))
    state.body_q.assign(poses)
    pictures = make_camera(model).update(state, views_of(3))
    bundle = v3dg.build_bundle(gaussians_of(gaussian), config=CONFIG, progress=False, device="cpu")
    middle = np.array((0.2, 0.1, 0.4)) + 0.1 * np.array((np.cos(0.6), np.sin(0.6), 0))
    for number, (place, turn) in enumerate(
        [((0.1, 0, 0.5), (1, 0, 0, 0)), (middle, (np.cos(0.3), 0, 0, np.sin(0.3)))]
    ):
        scene = v3dg.Scene()
        scene.add(bundle, place, turn, 0.3)
        expected = v3dg.render(scene, our_view(), device="cpu").color
        assert expected.max() > 0.3
        # Poses are in single precision here, which moves edges by a fraction of a
        # pixel.
        np.testing.assert_allclose(pictures.color[number], expected, atol=2e-3)


def test_shapes_of_no_world_are_in_all_and_worlds_can_be_chosen(gaussian):
    model = make_model(gaussian, is_shared=True)
    state = model.state()
    poses = state.body_q.numpy()
    poses[2, 0] = 0.3
    state.body_q.assign(poses)
    worlds = warp.array([2, 0, 2, -1], dtype=warp.int32, device="cpu")
    shapes = warp.zeros((4, SIZE, SIZE), dtype=warp.uint32, device="cpu")
    pictures = make_camera(model).update(
        state, views_of(4), world_indices=worlds, shape_index_image=shapes
    )
    np.testing.assert_array_equal(pictures.color[0], pictures.color[2])
    assert not np.allclose(pictures.color[0], pictures.color[1])
    seen = [set(np.unique(picture).tolist()) for picture in shapes.numpy()]
    types = model.shape_type.numpy()
    gaussians = np.flatnonzero(types == int(newton.GeoType.GAUSSIAN)).tolist()
    assert len(gaussians) == 4
    assert seen == [
        {gaussians[0], gaussians[3], NO_SHAPE},
        {gaussians[0], gaussians[1], NO_SHAPE},
        {gaussians[0], gaussians[3], NO_SHAPE},
        {gaussians[0], NO_SHAPE},
    ]


def test_images_are_written_as_newton_does(gaussian):
    model = make_model(gaussian, num_worlds=1)
    color = warp.zeros((1, SIZE, SIZE), dtype=warp.uint32, device="cpu")
    depth = warp.zeros((1, SIZE, SIZE), dtype=warp.float32, device="cpu")
    forward = warp.zeros((1, SIZE, SIZE), dtype=warp.float32, device="cpu")
    normal = warp.zeros((1, SIZE, SIZE), dtype=warp.vec3f, device="cpu")
    pictures = make_camera(model).update(
        model.state(),
        views_of(1),
        color_image=color,
        depth_image=depth,
        forward_depth_image=forward,
        normal_image=normal,
    )
    np.testing.assert_array_equal(forward.numpy(), pictures.depth)
    np.testing.assert_array_equal(depth.numpy(), pictures.distance)
    assert (depth.numpy() >= forward.numpy()).all()
    parts = color.numpy().view(np.uint8).reshape(1, SIZE, SIZE, 4)
    np.testing.assert_allclose(parts[..., :3] / 255, pictures.color.clip(0, 1), atol=0.5 / 255)
    np.testing.assert_allclose(parts[..., 3] / 255, pictures.alpha, atol=0.5 / 255)
    # Visible surfaces face the eye, which looks along y.
    is_drawn = pictures.alpha[0] > 0.9
    assert (normal.numpy()[0][is_drawn][:, 1] < 0.3).mean() > 0.9


def test_attached_instances_move_with_bodies(gaussian):
    model = make_model(gaussian, num_worlds=1)
    camera = make_camera(model)
    ids = camera.scene.add(camera.scene.bundles[0], scales=0.1, environment=0)
    camera.attach(ids, 0, (0, 0, 0.25, 0, 0, 0, 1))
    camera.update(model.state(), views_of(1))
    np.testing.assert_allclose(camera.scene.positions, [(0.1, 0, 0.5), (0, 0, 0.75)], atol=1e-6)


def test_wrong_arguments_are_errors(gaussian):
    model = make_model(gaussian, num_worlds=2)
    camera = make_camera(model)
    with pytest.raises(ValueError, match="camera_transforms: expected at most 2 views"):
        camera.update(model.state(), views_of(3))
    small = warp.zeros((2, 8, 8), dtype=warp.float32, device="cpu")
    with pytest.raises(ValueError, match="depth_image: expected shape \\(2, 48, 48\\)"):
        camera.update(model.state(), views_of(2), depth_image=small)
    real = warp.zeros((2, SIZE, SIZE), dtype=warp.float32, device="cpu")
    with pytest.raises(ValueError, match=r"color_image: expected values like torch\.int64"):
        camera.update(model.state(), views_of(2), color_image=real)
    with pytest.raises(ValueError, match="bodies: expected indices from -1 to 1, got \\[2\\]"):
        camera.attach(camera.scene.add(camera.scene.bundles[0]), 2)
    with pytest.raises(ValueError, match="instances: expected instances without a body"):
        camera.attach([0], 1)
    with pytest.raises(ValueError, match="camera_fov, K: expected one of them"):
        SplatCamera(model, width=8, height=8)
    stretched = make_model(gaussian, num_worlds=1, scale=(1, 1, 2))
    with pytest.raises(ValueError, match=r"model\.shape_scale\[0\]: expected a uniform"):
        make_camera(stretched)


@pytest.mark.slow
def test_pictures_resemble_those_that_newton_traces():
    """Newton evaluates gaussians on the ray, and only draws degree 0."""
    model = make_model(make_gaussian(0), num_worlds=1)
    state = model.state()
    camera = make_camera(model)
    forward = warp.zeros((1, SIZE, SIZE), dtype=warp.float32, device="cpu")
    pictures = camera.update(state, views_of(1), forward_depth_image=forward)
    sensor_type = newton.sensors.SensorCamera
    sensor = sensor_type(model)
    rays = sensor_type.compute_camera_rays_pinhole(SIZE, SIZE, camera_fov=FOV, device="cpu")
    color = sensor.allocate_image_color(1, SIZE, SIZE)
    traced_depth = sensor.allocate_image_depth_forward(1, SIZE, SIZE)
    settings = sensor_type.RenderConfig(
        gaussians_mode=sensor_type.GaussianRenderMode.QUALITY, gaussians_min_transmittance=0.01
    )
    sensor.update(
        state,
        views_of(1),
        rays,
        color_image=color,
        forward_depth_image=traced_depth,
        render_config=settings,
    )
    traced = mesh_layer(color, traced_depth)
    is_both = (pictures.alpha[0] > 0.9) & (traced.depth[0] > 0)
    assert is_both.sum() > 100
    # Newton only shows pixels in which the transmittance is less than a hundredth.
    is_clear = traced.depth[0] > 0
    assert (is_clear & (pictures.alpha[0] < 0.8)).sum() < 0.05 * is_clear.sum()
    assert np.median(np.abs(traced.depth[0] - forward.numpy()[0])[is_both]) < 0.05
    assert np.median(np.abs(traced.color[0] - pictures.color[0])[is_both]) < 0.06


@pytest.mark.slow
def test_shapes_of_newton_hide_gaussians(gaussian):
    builder = newton.ModelBuilder()
    hidden = newton.ModelBuilder.ShapeConfig(is_visible=False)
    place = warp.transform((0, 0, 0.5), warp.quat_identity())
    builder.begin_world()
    builder.add_shape_gaussian(-1, xform=place, gaussian=gaussian, scale=(0.3,) * 3, cfg=hidden)
    wall = warp.transform((0.5, -0.5, 0.5), warp.quat_identity())
    builder.add_shape_box(-1, xform=wall, hx=0.5, hy=0.02, hz=1)
    builder.end_world()
    model = builder.finalize(device="cpu")
    state = model.state()
    sensor = newton.sensors.SensorCamera(model)
    rays = sensor.compute_camera_rays_pinhole(SIZE, SIZE, camera_fov=FOV, device="cpu")
    color = sensor.allocate_image_color(1, SIZE, SIZE)
    depth = sensor.allocate_image_depth_forward(1, SIZE, SIZE)
    shapes = sensor.allocate_image_shape_index(1, SIZE, SIZE)
    sensor.update(
        state,
        views_of(1),
        rays,
        color_image=color,
        forward_depth_image=depth,
        shape_index_image=shapes,
    )
    layer = mesh_layer(color, depth, shape_index_image=shapes)
    image = warp.zeros((1, SIZE, SIZE), dtype=warp.uint32, device="cpu")
    pictures = make_camera(model).update(state, views_of(1), shape_index_image=image, mesh=layer)
    left = pictures.instance[0, :, : SIZE // 2 - 1]
    right = pictures.instance[0, :, SIZE // 2 + 1 :]
    assert (left == 0).sum() > 50
    assert (left >= FIRST_SHAPE).sum() == 0
    assert (right == FIRST_SHAPE + 1).all()
    assert (image.numpy()[0, :, SIZE // 2 + 1 :] == NO_SHAPE).all()
