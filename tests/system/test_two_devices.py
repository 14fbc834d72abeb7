"""Two CUDA devices in one process. Work is done on the device of its arrays, whichever
device is current."""

import numpy as np
import pytest

import scenes
import scenes_lod
from devices import host
from v3dg import Camera, Gaussians, Renderer, Scene, _core, _device, rasterize, render, select
from v3dg._device import Device
from v3dg.render import shade_of
from v3dg.residency import residency

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(_core.num_cuda_devices() < 2, reason="expected two CUDA devices"),
]

CAMERA = Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)


def composed_scene(seed):
    rng = np.random.default_rng(seed)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 900, sh_degree=2), 64)
    return scenes_lod.random_scene(rng, bundle, 30, spread=3.0)


def asset(seed, num=3000):
    return scenes_lod.blob(np.random.default_rng(seed), num, sh_degree=2)


def assert_same(image, expected, device=None):
    for name in ("color", "alpha", "depth"):
        plane = getattr(image, name)
        if device is not None:
            assert str(plane.device) == device
        np.testing.assert_array_equal(host(plane), host(getattr(expected, name)))


@pytest.fixture(autouse=True)
def first_device():
    """Make the first device current before and after each test."""
    import torch

    with torch.cuda.device(0):
        yield
        assert torch.cuda.current_device() == 0


@pytest.mark.parametrize("subject", [composed_scene(0), asset(1)], ids=["scene", "asset"])
def test_picture_is_the_same_on_the_other_device(subject):
    here, there = (
        render(subject, CAMERA, depth=True, device=f"cuda:{number}") for number in (0, 1)
    )
    assert_same(here, there)
    assert_same(there, here, "cuda:1")
    assert there.stats.gaussians_in_frustum == here.stats.gaussians_in_frustum


def test_pools_are_on_their_own_devices():
    scene = composed_scene(0)
    renderers = [Renderer(scene, device=f"cuda:{number}", memory="64MB") for number in (0, 1)]
    for renderer in renderers:
        renderer.settle(CAMERA)
    here, there = (renderer.render(CAMERA, depth=True) for renderer in renderers)
    assert_same(here, render(scene, CAMERA, depth=True, device="cuda:0"))
    assert_same(there, here, "cuda:1")


SUBJECTS = {"scene": composed_scene(2), "asset": asset(3), "empty": asset(4, 0)}


@pytest.mark.parametrize("subject", SUBJECTS.values(), ids=SUBJECTS)
def test_renderer_stays_on_its_device(subject):
    import torch

    renderers = [Renderer(subject, device=f"cuda:{number}") for number in (0, 1)]
    with torch.cuda.device(1):
        renderers.append(Renderer(subject, device="cuda"))
    expected = renderers[0].render(CAMERA, depth=True)
    for current in (0, 1, 0):
        with torch.cuda.device(current):
            for renderer, device in zip(renderers, ("cuda:0", "cuda:1", "cuda:1"), strict=True):
                assert_same(renderer.render(CAMERA, depth=True), expected, device)
            assert torch.cuda.current_device() == current


def test_scene_that_moves_is_drawn_on_both():
    """Poses on one device are copied to the other."""
    import torch

    scene = composed_scene(5)
    for number in (0, 1, 0):
        scene.move(positions=torch.tensor(scene.positions + 0.1, device=f"cuda:{number}"))
        pictures = [render(scene, CAMERA, depth=True, device=f"cuda:{other}") for other in (0, 1)]
        assert_same(*pictures)


def test_cut_is_the_same_on_the_other_device():
    scene = composed_scene(6)
    here, there = (
        select(scene, CAMERA, tolerance=0.5, device=f"cuda:{number}") for number in (0, 1)
    )
    np.testing.assert_array_equal(here.instance_ids, there.instance_ids)
    np.testing.assert_array_equal(here.cluster_ids, there.cluster_ids)
    gathered = [there.gaussians(device=f"cuda:{number}") for number in (0, 1)]
    assert [str(g.means.device) for g in gathered] == ["cuda:0", "cuda:1"]
    for name in scenes.NAMES:
        np.testing.assert_array_equal(*(host(getattr(g, name)) for g in gathered))
    images = [
        render(scene, CAMERA, cut=here, depth=True, device=f"cuda:{number}") for number in (0, 1)
    ]
    assert_same(*images)


def test_each_device_has_a_bundle_of_its_own():
    bundle = scenes_lod.lod_bundle(np.random.default_rng(7), asset(7), 64)
    models = [residency.model(bundle, Device(number)) for number in (0, 1)]
    assert models[0] is not models[1]
    assert residency.num_bytes(Device(0)) >= models[0].bytes
    assert residency.num_bytes(Device(1)) >= models[1].bytes


def test_gradients_are_the_same_on_the_other_device():
    gradients = []
    for number in (0, 1):
        there = asset(8).torch(f"cuda:{number}")
        leaves = [getattr(there, name).requires_grad_() for name in scenes.NAMES]
        raster = rasterize(Gaussians(*leaves), CAMERA, filter_px2=0.3)
        raster.color.square().sum().backward()
        assert {str(leaf.grad.device) for leaf in leaves} == {f"cuda:{number}"}
        gradients.append(host([leaf.grad for leaf in leaves]))
    for here, there in zip(*gradients, strict=True):
        np.testing.assert_array_equal(here, there)


def test_operations_work_where_their_arrays_are():
    import torch

    source = asset(9)
    offset, halved = np.array([0, 1000, 3000]), np.array([0, 500, 1500])
    results = []
    for number in (0, 1):
        there = source.torch(f"cuda:{number}")
        spheres = torch.cat([there.means, there.scales[:, :1]], dim=1)
        found = [
            _core.median_split(there.means, offset, 2)[0],
            _core.bound_spheres(spheres, offset),
            _core.bound_by_boxes(there.rows, offset),
            _core.prune(there.rows, offset, halved),
            *_core.merge(there.rows, offset, halved),
        ]
        assert {str(array.device) for array in found} == {f"cuda:{number}"}
        results.append(host(found))
    for here, there in zip(*results, strict=True):
        np.testing.assert_array_equal(here, there)


def test_build_is_the_same_on_the_other_device():
    import v3dg

    if len({_device.describe(Device(number)) for number in (0, 1)}) > 1:
        pytest.skip("expected two devices of one kind")
    config = v3dg.BuildConfig(cluster_size=64, steps=3, num_views=4, image_size=16)
    bundles = [
        v3dg.build_bundle(
            asset(10, 700), config=config, device=f"cuda:{number}", progress=False, quality="draft"
        )
        for number in (0, 1)
    ]
    for name in scenes.NAMES:
        np.testing.assert_array_equal(*(getattr(b.gaussians, name) for b in bundles))


def test_rows_of_two_devices_are_refused():
    here, there = (asset(11, 10).torch(f"cuda:{number}") for number in (0, 1))
    for name in scenes.NAMES[1:]:
        arrays = {n: getattr(here, n) for n in scenes.NAMES} | {name: getattr(there, name)}
        with pytest.raises(
            ValueError, match=f"{name}: expected .*cuda:0 like the other arrays, got .*cuda:1"
        ):
            _core.Rows(**arrays)
        with pytest.raises(
            ValueError, match=f"{name}: expected device cuda:0 like the other arrays, got cuda:1"
        ):
            Gaussians(**arrays)


def test_frame_refuses_what_is_on_the_other_device():
    bundle = scenes_lod.lod_bundle(np.random.default_rng(12), asset(12), 64)
    frame = _core.SceneFrame(0)
    with pytest.raises(
        ValueError, match="models: expected objects on the frame's device, got some on another"
    ):
        frame.set_models([residency.model(bundle, Device(1))], [])
    colors = np.zeros((len(bundle.clusters.level), 3), np.float32)
    palette = _core.Palette(residency.table(bundle), colors, 1)
    with pytest.raises(
        ValueError, match="palettes: expected objects on the frame's device, got some on another"
    ):
        frame.set_models([residency.model(bundle, Device(0))], [palette])
    scene = Scene.of(bundle)
    residency.set_models(frame, [bundle], Device(0), "cluster")
    rule = _core.Rule(
        tolerance_px2=1.0, budget=None, min_level=0, footprint="solid_angle", culls=True
    )
    with pytest.raises(ValueError, match="scene: expected a scene on the frame's device"):
        frame.draw(
            residency.scene(scene, Device(1)).core,
            _core.FrameRequest(
                CAMERA.core, rule, shade_of([0, 0, 0], None, is_asset=False, depth=True)
            ),
        )
