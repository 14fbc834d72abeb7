"""Tests the renderer for Isaac Lab with the classes through which Isaac Lab itself
calls it: `RenderContext`, `CameraCfg`, `CameraData` and `ProxyArray`."""

import math

import numpy as np
import pytest

import v3dg
from v3dg.donut import make_donut

pytest.importorskip("isaaclab", reason="isaaclab is not installed")
torch = pytest.importorskip("torch", reason="torch is not installed")
warp = pytest.importorskip("warp", reason="warp is not installed")
renderers = pytest.importorskip(
    "isaaclab.renderers", reason="isaaclab is older than 3.0", exc_type=ImportError
)

from isaaclab.sensors.camera import CameraCfg  # noqa: E402
from isaaclab.sensors.camera.camera_data import CameraData  # noqa: E402
from isaaclab.sim import PinholeCameraCfg  # noqa: E402
from isaaclab.utils.warp import ProxyArray  # noqa: E402

from v3dg.simulators.isaaclab import SplatRenderer, SplatRendererCfg  # noqa: E402

SIZE = 40
NUM_ENVS = 3
FOCAL = 45.0
DEPTHS = ["depth", "distance_to_image_plane", "distance_to_camera"]
IDS = ["semantic_segmentation", "instance_segmentation"]
ALL = ["rgb", "rgba", *DEPTHS, "normals", *IDS]


@pytest.fixture(scope="module")
def path(tmp_path_factory):
    config = v3dg.BuildConfig(steps=0)
    bundle = v3dg.build_bundle(make_donut(1000), config=config, progress=False, device="cpu")
    path = tmp_path_factory.mktemp("isaaclab") / "donut.v3dg"
    bundle.write(path)
    return path


def spec_of(spawn):
    """Return the description of a camera that `Camera` passes to its renderer."""
    settings = CameraCfg(
        prim_path="/World/envs/env_.*/camera",
        width=SIZE,
        height=SIZE,
        data_types=ALL,
        spawn=spawn,
        background_color=(0.2, 0.4, 0.6),
        renderer_cfg=SplatRendererCfg(),
    )
    return renderers.CameraRenderSpec(settings, "cpu", NUM_ENVS, (), NUM_ENVS)


def proxies(eyes, turns):
    """Return poses and intrinsics as cameras of Isaac Lab pass them."""
    K = np.tile([[FOCAL, 0, SIZE / 2], [0, FOCAL, SIZE / 2], [0, 0, 1]], (len(eyes), 1, 1))
    return (
        ProxyArray(warp.array(eyes, dtype=warp.vec3f, device="cpu")),
        ProxyArray(warp.array(turns, dtype=warp.quatf, device="cpu")),
        ProxyArray(warp.array(K, dtype=warp.mat33f, device="cpu")),
    )


def draw(renderer, eyes, turns, *, stage=None, data_types=ALL):
    """Draw as `Camera` does, through Isaac Lab's `RenderContext`."""
    context = renderers.RenderContext([(renderer.cfg, renderer)])
    context.ensure_initialize()
    context.ensure_prepare_stage(stage, NUM_ENVS)
    data = renderer.create_render_data(spec_of(PinholeCameraCfg()))
    camera_data = CameraData.allocate(
        data_types=data_types,
        height=SIZE,
        width=SIZE,
        num_views=NUM_ENVS,
        device="cpu",
        supported_specs=renderer.supported_output_types(),
    )
    renderer.set_outputs(data, camera_data.output)
    renderer.update_camera(data, *proxies(eyes, turns))
    context.render_into_camera(renderer, data, camera_data, 0)
    return {name: array.torch.numpy() for name, array in camera_data.output.items()}


def turn_about_z(angle):
    return (0, 0, math.sin(angle / 2), math.cos(angle / 2))


def test_interface_of_isaac_lab_is_implemented():
    renderer = SplatRenderer(SplatRendererCfg())
    assert isinstance(renderer, renderers.BaseRenderer)
    assert not SplatRenderer.__abstractmethods__
    assert SplatRendererCfg().class_type == "v3dg.simulators.isaaclab:SplatRenderer"
    assert SplatRendererCfg(path="a") == SplatRendererCfg(path="a")
    assert SplatRendererCfg(path="a") != SplatRendererCfg(path="b")


def test_outputs_are_pictures_of_the_environments(path):
    renderer = SplatRenderer(SplatRendererCfg(path=str(path)))
    angles = (0.0, math.pi / 2, 1.0)
    eyes = [(-4 * math.cos(angle), -4 * math.sin(angle), 0.5) for angle in angles]
    outputs = draw(renderer, eyes, [turn_about_z(angle) for angle in angles])
    scene = v3dg.Scene()
    scene.add(str(path))
    for number, (eye, angle) in enumerate(zip(eyes, angles, strict=True)):
        target = np.add(eye, (math.cos(angle), math.sin(angle), 0))
        fov = 2 * math.atan(0.5 * SIZE / FOCAL)
        camera = v3dg.Camera.look_at(eye, target, fov_x=fov, width=SIZE, height=SIZE)
        channels = ("depth", "normal", "instance")
        image = v3dg.render(
            scene, camera, channels=channels, background=(0.2, 0.4, 0.6), device="cpu"
        )
        # Poses are in single precision here.
        np.testing.assert_allclose(outputs["rgb"][number] / 255, image.color.clip(0, 1), atol=3e-3)
        is_drawn = image.depth > 0
        for name in ("depth", "distance_to_image_plane"):
            depth = outputs[name][number, ..., 0]
            np.testing.assert_allclose(depth[is_drawn], image.depth[is_drawn], rtol=1e-3)
            assert np.isinf(depth[~is_drawn]).all()
        distance = outputs["distance_to_camera"][number, ..., 0]
        rows, columns = np.mgrid[:SIZE, :SIZE] + 0.5
        rays = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
        expected = image.depth * np.linalg.norm(rays, axis=1).reshape(SIZE, SIZE)
        np.testing.assert_allclose(distance[is_drawn], expected[is_drawn], rtol=1e-3)
        in_world = image.normal @ camera.viewmat[:3, :3]
        is_clear = image.alpha > 0.9
        np.testing.assert_allclose(
            outputs["normals"][number][is_clear], in_world[is_clear], atol=0.02
        )
        np.testing.assert_allclose(outputs["rgba"][number, ..., 3] / 255, image.alpha, atol=3e-3)


def test_environments_do_not_see_each_other(path):
    renderer = SplatRenderer(SplatRendererCfg(path=str(path)))
    outputs = draw(renderer, [(-4, 0, 0.5)] * NUM_ENVS, [turn_about_z(0)] * NUM_ENVS)
    for number in range(NUM_ENVS):
        ids = set(np.unique(outputs["instance_segmentation"][number]))
        assert ids == {-1, number}
    np.testing.assert_array_equal(outputs["rgb"][0], outputs["rgb"][1])


def test_environments_stand_at_their_prims(path):
    pxr = pytest.importorskip("pxr", reason="usd-core is not installed")
    from pxr import Usd, UsdGeom

    assert pxr
    stage = Usd.Stage.CreateInMemory()
    for number in range(NUM_ENVS):
        prim = UsdGeom.Xform.Define(stage, f"/World/envs/env_{number}")
        prim.AddTranslateOp().Set((10 * number, 5, 0))
    renderer = SplatRenderer(SplatRendererCfg(path=str(path)))
    renderer.prepare_stage(stage, NUM_ENVS)
    np.testing.assert_array_equal(renderer.scene.positions, [(0, 5, 0), (10, 5, 0), (20, 5, 0)])
    assert renderer.scene.environments.tolist() == [0, 1, 2]
    with pytest.raises(ValueError, match="environment_prims: expected a prim /World/envs/env_3"):
        SplatRenderer(SplatRendererCfg(path=str(path))).prepare_stage(stage, 4)


def test_instances_of_the_scene_can_be_moved_and_have_labels(path):
    renderer = SplatRenderer(SplatRendererCfg(depth_background=0.0))
    ids = renderer.scene.add(
        v3dg.Bundle.open(path), np.zeros((3, 3)), environment=range(3), label=[7, 8, 9]
    )
    positions = torch.tensor([[0.0, 0, 0], [0, 1, 0], [50, 0, 0]])
    renderer.scene.move(ids, positions=positions)
    outputs = draw(renderer, [(-4, 0, 0.5)] * NUM_ENVS, [turn_about_z(0)] * NUM_ENVS)
    labels = outputs["semantic_segmentation"][..., 0]
    assert set(np.unique(labels[0])) == {-1, 7}
    assert set(np.unique(labels[1])) == {-1, 8}
    # y is to the left of a camera that looks along x.
    assert np.nonzero(labels[1] == 8)[1].mean() < np.nonzero(labels[0] == 7)[1].mean() - 5
    assert (labels[2] == 9).sum() < 10
    assert (outputs["depth"][0][labels[0] == -1] >= 0).all()
    assert np.isfinite(outputs["depth"]).all()


def test_intrinsics_can_change(path):
    renderer = SplatRenderer(SplatRendererCfg(path=str(path)))
    data = renderer.create_render_data(spec_of(PinholeCameraCfg()))
    *_, intrinsics = proxies([(0, 0, 0)] * NUM_ENVS, [turn_about_z(0)] * NUM_ENVS)
    renderer.update_camera_intrinsics(data, intrinsics.warp, None)
    np.testing.assert_array_equal(data.K.numpy(), intrinsics.torch.numpy())


def test_assets_without_levels_are_refused(tmp_path):
    path = tmp_path / "donut.ply"
    v3dg.write_asset(path, make_donut(1000))
    with pytest.raises(ValueError, match="path: expected a bundle or a scene, got an asset"):
        SplatRenderer(SplatRendererCfg(path=str(path))).prepare_stage(None, 1)


def test_near_plane_is_that_of_the_camera():
    renderer = SplatRenderer(SplatRendererCfg())
    spec = spec_of(PinholeCameraCfg(clipping_range=(0.25, 10.0)))
    assert renderer.create_render_data(spec).near == 0.25


def test_lens_distortion_is_refused():
    spec = spec_of(PinholeCameraCfg())
    spec.cfg.spawn.distortion = object()
    with pytest.raises(ValueError, match=r"spawn\.distortion: expected a pinhole camera"):
        SplatRenderer(SplatRendererCfg()).create_render_data(spec)
