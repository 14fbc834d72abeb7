"""Batches of cameras: the pictures, decisions and counts equal those of each camera
alone; environments, planes of the caller, and refused values."""

import dataclasses

import numpy as np
import pytest

import frames
import scenes_lod
import v3dg
from devices import host, on
from frames import composed_scene, tensors_of
from v3dg import BatchPlanes, Camera, CameraBatch, Scene
from v3dg.donut import make_donut
from v3dg.residency import residency

WIDTH = 45
HEIGHT = 37


@pytest.fixture(scope="module")
def scene():
    return composed_scene(np.random.default_rng(3))


@pytest.fixture(scope="module")
def tinted_scene():
    rng = np.random.default_rng(4)
    scene = frames.tinted_scene(rng)
    scene.set_importance(np.exp(rng.normal(0, 0.5, len(scene))))
    return scene


def cameras_around(count, seed=0, width=WIDTH, height=HEIGHT):
    """Return cameras near, far and inside, each with its own intrinsics."""
    rng = np.random.default_rng(seed)
    cameras = []
    for _ in range(count):
        eye = rng.normal(size=3) * rng.choice([0.5, 4.0, 15.0])
        view = Camera.look_at(eye, rng.normal(size=3), (0, 0, 1), 0.9, width=width, height=height)
        K = view.K * rng.uniform(0.6, 1.6)
        K[:, 2] = [*(rng.uniform(0.2, 0.8, 2) * [width, height]), 1]
        cameras.append(Camera(view.viewmat, K, width, height, 0.01))
    return cameras


def one_by_one(scene, cameras, device, **options):
    return [v3dg.render(scene, camera, device=device, **options) for camera in cameras]


def assert_same(batch, pictures, *, depth=False):
    for number, (got, wanted) in enumerate(zip(batch, pictures, strict=True)):
        planes = ["color", "alpha"]
        if depth:
            planes.append("depth")
        for plane in planes:
            np.testing.assert_array_equal(
                host(getattr(got, plane)), host(getattr(wanted, plane)), f"{plane} of {number}"
            )
        assert got.stats.gaussians_selected == wanted.stats.gaussians_selected
        assert got.stats.gaussians_in_frustum == wanted.stats.gaussians_in_frustum
        assert got.stats.tolerance == wanted.stats.tolerance
        assert got.stats.levels == wanted.stats.levels


OPTIONS = [
    {},
    {"tolerance": 0.0},
    {"tolerance": 6.0, "fade": 1.5, "depth": True},
    {"tolerance": 1.0, "min_level": 1, "background": (0.2, 0.5, 1.0)},
    {"tolerance": 2.0, "min_transmittance": 0.0},
    {"tolerance": np.inf},
]


@pytest.mark.parametrize("options", OPTIONS)
def test_pictures_are_those_of_each_camera_alone(scene, device, options):
    cameras = cameras_around(13)
    batch = v3dg.Renderer(scene, device=device).render_batch(CameraBatch.of(cameras), **options)
    pictures = one_by_one(scene, cameras, device, **options)
    assert_same(batch, pictures, depth=options.get("depth", False))
    assert any(host(picture.alpha).max() > 0.5 for picture in pictures)


@pytest.mark.parametrize("options", OPTIONS[:3])
def test_instances_keep_their_factors(tinted_scene, device, options):
    cameras = cameras_around(9, seed=1)
    batch = v3dg.Renderer(tinted_scene, device=device).render_batch(cameras, **options)
    assert_same(batch, one_by_one(tinted_scene, cameras, device, **options))


def test_a_list_of_cameras_is_drawn_at_once(scene, device):
    cameras = cameras_around(7, seed=2)
    pictures = v3dg.render(scene, cameras, device=device, depth=True)
    assert_same(pictures, one_by_one(scene, cameras, device, depth=True), depth=True)
    other = Camera.look_at((0, -6, 1), (0, 0, 0), width=20, height=10)
    mixed = v3dg.render(scene, [*cameras, other], device=device)
    assert_same(mixed, one_by_one(scene, [*cameras, other], device))


def test_cameras_with_lenses_are_drawn_one_by_one(scene, device):
    cameras = [
        dataclasses.replace(camera, distortion=(0.1, 0.01, 0.0, 0.0), model="OPENCV")
        for camera in v3dg.turntable((0, 0, 0), 6.0, 3, width=WIDTH, height=HEIGHT)
    ]
    pictures = v3dg.render(scene, cameras, device=device)
    assert_same(pictures, one_by_one(scene, cameras, device))
    pinholes = v3dg.render(scene, [camera.pinhole for camera in cameras], device=device)
    assert not np.array_equal(host(pictures[0].color), host(pinholes[0].color))


@pytest.mark.parametrize("color_by", ["level", "cluster"])
def test_a_list_of_cameras_keeps_false_colors(scene, device, color_by):
    cameras = cameras_around(3, seed=5)
    pictures = v3dg.render(scene, cameras, device=device, color_by=color_by)
    assert_same(pictures, one_by_one(scene, cameras, device, color_by=color_by))


def test_many_random_cameras_choose_the_same(tinted_scene, device):
    """The counts of selected gaussians agree for 64 x 90 random pairs of camera and
    instance."""
    cameras = cameras_around(64, seed=6, width=16, height=16)
    renderer = v3dg.Renderer(tinted_scene, device=device)
    for fade in (None, 1.3):
        stats = renderer.render_batch(cameras, tolerance=0.7, fade=fade).stats
        for number, camera in enumerate(cameras):
            cut = v3dg.select(tinted_scene, camera, tolerance=0.7, fade=fade, device="cpu")
            assert stats.gaussians_selected[number] == cut.num_gaussians


@pytest.mark.gpu
@pytest.mark.slow
def test_a_million_random_pairs_choose_the_same():
    rng = np.random.default_rng(9)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 500), 16)
    scene = scenes_lod.random_scene(rng, bundle, 1000, spread=8.0)
    cameras = CameraBatch.of(cameras_around(1000, seed=10, width=8, height=8))
    cpu, cuda = (
        v3dg.Renderer(scene, device=device).render_batch(cameras, tolerance=0.3).stats
        for device in ("cpu", "cuda")
    )
    np.testing.assert_array_equal(cpu.gaussians_selected, cuda.gaussians_selected)
    assert cpu.gaussians_selected.min() < cpu.gaussians_selected.max()


def test_planes_of_the_caller_are_written(scene, device):
    cameras = CameraBatch.of(cameras_around(4, seed=7))
    renderer = v3dg.Renderer(scene, device=device)
    wanted = renderer.render_batch(cameras, depth=True)
    shape = (4, HEIGHT, WIDTH)

    def plane(*more):
        return on(device, np.full((*shape, *more), 7.0, np.float32))

    planes = BatchPlanes(plane(3), plane(), plane())
    batch = renderer.render_batch(cameras, out=planes)
    assert batch.color is planes.color
    for name in ("color", "alpha", "depth"):
        np.testing.assert_array_equal(host(getattr(batch, name)), host(getattr(wanted, name)))
    four = BatchPlanes(plane(4))
    batch = renderer.render_batch(cameras, out=four)
    np.testing.assert_array_equal(host(batch.color)[..., :3], host(wanted.color))
    np.testing.assert_array_equal(host(batch.color)[..., 3], host(wanted.alpha))
    np.testing.assert_array_equal(host(batch.alpha), host(wanted.alpha))
    only_color = BatchPlanes(plane(3))
    batch = renderer.render_batch(cameras, out=only_color)
    np.testing.assert_array_equal(host(batch.color), host(wanted.color))
    with pytest.raises(AttributeError, match="alpha"):
        batch.alpha  # noqa: B018
    with pytest.raises(AttributeError, match="depth"):
        batch.depth  # noqa: B018


def test_distances_are_those_along_rays(scene, device):
    cameras = cameras_around(4, seed=8)
    batch = v3dg.Renderer(scene, device=device).render_batch(cameras, depth=True)
    depth = host(batch.depth).astype(np.float64)
    distance = host(batch.distance)
    assert distance.shape == depth.shape
    for number, camera in enumerate(cameras):
        for y, x in ((0, 0), (HEIGHT - 1, 3), (HEIGHT // 2, WIDTH // 2)):
            ray = [(x + 0.5 - camera.cx) / camera.fx, (y + 0.5 - camera.cy) / camera.fy, 1.0]
            expected = depth[number, y, x] * np.linalg.norm(ray)
            np.testing.assert_allclose(distance[number, y, x], expected, rtol=1e-6)
    assert (distance[depth == 0] == 0).all()
    assert depth.max() > 0


def test_one_lens_may_serve_all_cameras(scene, device):
    cameras = v3dg.turntable((0, 0, 0), 6.0, 5, width=WIDTH, height=HEIGHT)
    batch = CameraBatch.of(cameras)
    one_lens = CameraBatch(batch.viewmats, batch.K[0], WIDTH, HEIGHT)
    renderer = v3dg.Renderer(scene, device=device)
    np.testing.assert_array_equal(
        host(renderer.render_batch(one_lens).color), host(renderer.render_batch(batch).color)
    )


def worlds(num_environments=5, seed=11):
    """Return a scene with shared instances and with environments, one of which is
    empty."""
    rng = np.random.default_rng(seed)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300), 32)
    scene = Scene()
    count = 40
    environment = rng.integers(-1, num_environments, count)
    environment[environment == 2] = 1
    scene.add(
        bundle,
        positions=rng.normal(0, 3, (count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        environment=environment,
    )
    return scene


def part_of(scene, environment):
    """Return the instances that a camera of an environment sees, first the shared
    ones."""
    shared = np.flatnonzero(scene.environments == -1)
    own = np.flatnonzero((scene.environments == environment) & (environment >= 0))
    rows = np.concatenate([shared, own])
    part = Scene()
    part.add(
        [scene.bundles[number] for number in scene.instance_bundle[rows]],
        scene.positions[rows],
        scene.quaternions[rows],
        scene.scales[rows],
    )
    return part


def test_a_camera_sees_its_environment_and_what_is_shared(device):
    scene = worlds()
    cameras = cameras_around(12, seed=12)
    environments = np.array([0, 4, 2, -1, 1, 1, 3, 0, -1, 2, 4, 3])
    renderer = v3dg.Renderer(scene, device=device)
    batch = renderer.render_batch(CameraBatch.of(cameras, environments=environments))
    parts = {environment: part_of(scene, environment) for environment in range(-1, 5)}
    alone = [
        v3dg.render(parts[environment], camera, device=device)
        for camera, environment in zip(cameras, environments.tolist(), strict=True)
    ]
    assert_same(batch, alone)
    everything = renderer.render_batch(cameras)
    assert_same(everything, one_by_one(scene, cameras, device))


def test_environments_follow_the_scene(device):
    scene = worlds()
    cameras = CameraBatch.of(cameras_around(2, seed=13), environments=[1, 3])
    renderer = v3dg.Renderer(scene, device=device)
    before = host(renderer.render_batch(cameras, tolerance=0.5).color).copy()
    scene.set_environment(np.where(scene.environments == 1, 3, scene.environments))
    scene.set_environment(-1, [0])
    scene.remove([1])
    assert scene.environments[0] == -1
    after = host(renderer.render_batch(cameras, tolerance=0.5).color)
    assert not np.array_equal(before, after)
    alone = v3dg.render(part_of(scene, 3), cameras_around(2, seed=13)[1], device=device)
    np.testing.assert_array_equal(host(renderer.render_batch(cameras).color)[1], host(alone.color))


def test_environments_are_read_and_written(tmp_path):
    scene = worlds()
    scene.bundles[0].write(tmp_path / "a.v3dg")
    opened = Scene()
    bundle = v3dg.Bundle.open(tmp_path / "a.v3dg")
    opened.add(bundle, scene.positions, environment=scene.environments)
    opened.save(tmp_path / "scene.json")
    np.testing.assert_array_equal(
        Scene.load(tmp_path / "scene.json").environments, scene.environments
    )
    outer = Scene()
    outer.add_scene(opened, environment=7)
    np.testing.assert_array_equal(outer.environments, np.full(len(scene), 7))


def test_an_empty_batch_and_an_empty_scene_are_legal(scene, device):
    renderer = v3dg.Renderer(scene, device=device)
    none = renderer.render_batch(CameraBatch(np.zeros((0, 4, 4)), np.eye(3), 8, 8))
    assert host(none.color).shape == (0, 8, 8, 3)
    empty = Scene()
    cameras = cameras_around(2, width=8, height=8)
    batch = v3dg.Renderer(empty, device=device).render_batch(cameras, background=(0.5, 0.25, 1))
    np.testing.assert_array_equal(host(batch.color)[1, 2, 3], [0.5, 0.25, 1])
    assert host(batch.alpha).max() == 0


def test_what_is_no_camera_is_named(scene):
    cameras = CameraBatch.of(cameras_around(1000, width=4, height=4))
    for number, row, column, value, expected in (
        (613, 0, 3, np.nan, "finite"),
        (17, 0, 0, 2.0, "rotation"),
        (999, 3, 3, 2.0, "last row"),
    ):
        viewmats = cameras.viewmats.copy()
        viewmats[number, row, column] = value
        with pytest.raises(ValueError, match=f"camera {number}: expected .*{expected}"):
            CameraBatch(viewmats, cameras.K, 4, 4)
    K = cameras.K.copy()
    K[5, 1, 1] = -1
    with pytest.raises(ValueError, match="camera 5: expected positive focal lengths"):
        CameraBatch(cameras.viewmats, K, 4, 4)
    K = cameras.K.copy()
    K[6, 0, 1] = 1
    with pytest.raises(ValueError, match=r"camera 6: expected .*fx, 0, cx"):
        CameraBatch(cameras.viewmats, K, 4, 4)
    with pytest.raises(ValueError, match=r"viewmats: expected shape \(B, 4, 4\), got \(4, 4\)"):
        CameraBatch(np.eye(4), np.eye(3), 4, 4)
    with pytest.raises(ValueError, match="K: expected 1000 cameras, got 3"):
        CameraBatch(cameras.viewmats, K[:3], 4, 4)
    with pytest.raises(ValueError, match="viewmats: expected numbers"):
        CameraBatch([["a"]], np.eye(3), 4, 4)
    with pytest.raises(ValueError, match="width"):
        CameraBatch(cameras.viewmats, K, 0, 4)
    with pytest.raises(ValueError, match=r"environments\[2\]: expected -1 or more"):
        CameraBatch.of(cameras_around(3), environments=[0, 1, -2])
    with pytest.raises(ValueError, match="environments: expected 3 whole numbers"):
        CameraBatch.of(cameras_around(3), environments=[0.0, 1, 2])
    with pytest.raises(ValueError, match=r"cameras\[1\]: expected the size and the near plane"):
        CameraBatch.of([*cameras_around(1), *cameras_around(1, width=3)])
    with pytest.raises(ValueError, match="cameras: expected at least one"):
        CameraBatch.of([])


def test_wrong_arguments_of_a_batch_are_refused(scene, device):
    renderer = v3dg.Renderer(scene, device=device)
    cameras = CameraBatch.of(cameras_around(3), environments=[0, -1, 1])
    if device == "cpu":
        with pytest.raises(ValueError, match=r"environments\[0\]: expected -1 to -1"):
            renderer.render_batch(cameras)
    cameras = CameraBatch.of(cameras_around(3))
    wrong = on(device, np.zeros((3, HEIGHT, WIDTH, 2), np.float32))
    with pytest.raises(ValueError, match="color: expected shape"):
        renderer.render_batch(cameras, out=BatchPlanes(wrong))
    fits = on(device, np.zeros((3, HEIGHT, WIDTH, 4), np.float32))
    with pytest.raises(ValueError, match="alpha: colour has alpha"):
        renderer.render_batch(cameras, out=BatchPlanes(fits, fits[..., 0]))
    with pytest.raises(ValueError, match="out: expected planes with depth"):
        renderer.render_batch(cameras, depth=True, out=BatchPlanes(fits))
    with pytest.raises(TypeError, match="cameras: expected a CameraBatch or a sequence"):
        renderer.render_batch(3)
    with pytest.raises(TypeError, match="out: expected a BatchPlanes"):
        renderer.render_batch(cameras, out=fits)
    with pytest.raises(ValueError, match="tolerance"):
        renderer.render_batch(cameras, tolerance=-1)
    with pytest.raises(ValueError, match="environment: expected -1 to"):
        Scene().add(scene.bundles[0], environment=-2)
    asset = scene.bundles[0].gaussians
    with pytest.raises(ValueError, match="resident as a whole"):
        v3dg.Renderer(asset, device=device).render_batch(cameras)
    with pytest.raises(ValueError, match="resident as a whole"):
        v3dg.Renderer(scene, device=device, memory="64MB").render_batch(cameras)


def test_pictures_of_a_batch_are_indexed(scene, device):
    batch = v3dg.Renderer(scene, device=device).render_batch(cameras_around(3))
    assert len(batch) == 3
    np.testing.assert_array_equal(host(batch[-1].color), host(batch.color)[2])
    with pytest.raises(IndexError, match="picture: expected 0 to 2, got 3"):
        batch[3]


@pytest.mark.gpu
def test_tensors_are_read_where_they_are(scene):
    import torch

    cameras = cameras_around(6, seed=14)
    renderer = v3dg.Renderer(scene, device="cuda")
    batch = tensors_of(cameras)
    assert_same(renderer.render_batch(batch), one_by_one(scene, cameras, "cuda"))
    others = cameras_around(6, seed=15)
    batch.viewmats.copy_(torch.tensor(np.stack([camera.viewmat for camera in others])))
    batch.K.copy_(torch.tensor(np.stack([camera.K for camera in others])))
    assert_same(renderer.render_batch(batch), one_by_one(scene, others, "cuda"))
    single = CameraBatch(batch.viewmats.float(), batch.K.float(), WIDTH, HEIGHT)
    rounded = [
        Camera(view, K, WIDTH, HEIGHT)
        for view, K in zip(host(single.viewmats), host(single.K), strict=True)
    ]
    assert_same(renderer.render_batch(single), one_by_one(scene, rounded, "cuda"))


@pytest.mark.gpu
def test_what_is_no_camera_on_a_device_sees_nothing():
    import torch

    scene = worlds()
    cameras = cameras_around(8, seed=16)
    environments = torch.tensor([0, 1, 5, 3, -1, -2, 4, 1 << 40], device="cuda")
    batch = tensors_of(cameras, environments=environments)
    batch.viewmats[0, 1, 2] = np.nan
    batch.viewmats[1, :3, :3] *= 1.1
    batch.K[3, 0, 0] = -1
    renderer = v3dg.Renderer(scene, device="cuda")
    pictures = renderer.render_batch(batch, background=(0.25, 0.5, 0.75))
    for number in (0, 1, 2, 3, 5, 7):
        assert host(pictures.alpha[number]).max() == 0
        np.testing.assert_array_equal(host(pictures.color[number])[4, 5], [0.25, 0.5, 0.75])
    for number, environment in ((4, -1), (6, 4)):
        alone = v3dg.render(
            part_of(scene, environment),
            cameras[number],
            device="cuda",
            background=(0.25, 0.5, 0.75),
        )
        np.testing.assert_array_equal(host(pictures.color[number]), host(alone.color))


@pytest.mark.gpu
@pytest.mark.parametrize("options", OPTIONS[:3])
def test_a_graph_draws_what_its_tensors_contain(scene, options):
    import torch

    options = {name: value for name, value in options.items() if name != "depth"}
    cameras = cameras_around(6, seed=17)
    batch = tensors_of(cameras)
    renderer = v3dg.Renderer(scene, device="cuda")
    planes = BatchPlanes(torch.empty(6, HEIGHT, WIDTH, 4, device="cuda"))

    def see(others):
        batch.viewmats.copy_(torch.tensor(np.stack([camera.viewmat for camera in others])))
        batch.K.copy_(torch.tensor(np.stack([camera.K for camera in others])))

    for seed in (18, 19, 17):  # the buffers grow to the needed sizes
        see(cameras_around(6, seed=seed))
        renderer.render_batch(batch, out=planes, **options).wait()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = renderer.render_batch(batch, out=planes, **options)
    for seed in (18, 19):
        others = cameras_around(6, seed=seed)
        see(others)
        alone = one_by_one(scene, others, "cuda", **options)
        graph.replay()
        torch.cuda.synchronize()
        captured.wait()
        for number, picture in enumerate(alone):
            np.testing.assert_array_equal(host(planes.color[number])[..., :3], host(picture.color))


@pytest.mark.gpu
def test_a_batch_waits_for_nothing(scene):
    """A batch copies nothing to the host, so a kernel that sleeps before it does not
    delay the call."""
    import torch

    batch = tensors_of(cameras_around(6, seed=20))
    renderer = v3dg.Renderer(scene, device="cuda")
    planes = BatchPlanes(torch.empty(6, HEIGHT, WIDTH, 3, device="cuda"))
    for _ in range(3):
        renderer.render_batch(batch, out=planes).wait()
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(2_000_000_000)
        done = torch.cuda.Event()
        renderer.render_batch(batch, out=planes)
        done.record()
        assert not done.query()
        done.synchronize()


@pytest.mark.gpu
def test_a_batch_that_is_too_small_is_marked_and_drawn_again(scene):
    import torch

    near = [Camera.look_at((0, -2, 0.5), (0, 0, 0), width=WIDTH, height=HEIGHT) for _ in range(24)]
    far = [Camera.look_at((0, -500, 0.5), (0, 0, 0), width=WIDTH, height=HEIGHT) for _ in range(24)]
    renderer = v3dg.Renderer(scene, device="cuda")
    renderer.render_batch(far).wait()
    planes = BatchPlanes(torch.zeros(24, HEIGHT, WIDTH, 3, device="cuda"))
    batch = renderer.render_batch(near, tolerance=0.0, out=planes)
    torch.cuda.synchronize()
    assert torch.isnan(planes.color).all()
    alone = v3dg.render(scene, near[0], tolerance=0.0, device="cuda")
    for number in (0, 23):
        np.testing.assert_array_equal(host(batch.color)[number], host(alone.color))


@pytest.mark.gpu
def test_buffers_grow_for_callers_that_ignore_results(scene):
    import torch

    near = Camera.look_at((0, -2, 0.5), (0, 0, 0), width=WIDTH, height=HEIGHT)
    far = Camera.look_at((0, -500, 0.5), (0, 0, 0), width=WIDTH, height=HEIGHT)
    renderer = v3dg.Renderer(scene, device="cuda")
    renderer.render_batch([far] * 24)
    planes = BatchPlanes(torch.zeros(24, HEIGHT, WIDTH, 3, device="cuda"))
    for _ in range(4):  # first items and gaussians are counted, then entries, then long lists
        renderer.render_batch([near] * 24, tolerance=0.0, out=planes)
        torch.cuda.synchronize()
    alone = v3dg.render(scene, near, tolerance=0.0, device="cuda")
    np.testing.assert_array_equal(host(planes.color)[17], host(alone.color))


@pytest.mark.gpu
def test_a_large_batch_is_drawn_in_parts(scene):
    cameras = cameras_around(40, seed=21, width=512, height=512)
    batch = v3dg.Renderer(scene, device="cuda").render_batch(cameras, tolerance=2.0)
    assert batch.stats.num_parts == 2
    for number in (0, 31, 32, 39):
        alone = v3dg.render(scene, cameras[number], tolerance=2.0, device="cuda")
        np.testing.assert_array_equal(host(batch.color[number]), host(alone.color))
        assert batch.stats.gaussians_selected[number] == alone.stats.gaussians_selected


@pytest.mark.gpu
@pytest.mark.slow
def test_more_gaussians_than_a_frame_can_have_are_drawn_in_parts():
    bundle = v3dg.build_bundle(make_donut(45_000), quality="draft", progress=False, device="cuda")
    scene = Scene()
    scene.add(bundle, np.random.default_rng(0).uniform(-2, 2, (100, 3)))
    cameras = v3dg.turntable((0, 0, 0), 12.0, 64, width=16, height=16)
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    batch = renderer.render_batch(cameras, tolerance=0.0)
    assert batch.stats.gaussians_in_frustum.sum() > 1 << 28
    assert batch.stats.num_parts > 1
    alone = v3dg.render(scene, cameras[63], tolerance=0.0, device="cuda")
    np.testing.assert_array_equal(host(batch.color[63]), host(alone.color))
    again = renderer.render_batch(cameras[:2], tolerance=0.0)  # has no error of the parts before
    np.testing.assert_array_equal(host(again.color[0]), host(batch.color[0]))
    # Batches that fit are soon drawn as a whole.
    parts = [renderer.render_batch(cameras, tolerance=50.0).stats.num_parts for _ in range(16)]
    assert parts == sorted(parts, reverse=True)
    assert parts[0] > 1
    assert parts[-1] == 1
    once_more = renderer.render_batch(cameras, tolerance=0.0)
    assert once_more.stats.num_parts > 1
    np.testing.assert_array_equal(host(once_more.color), host(batch.color))


@pytest.mark.gpu
def test_a_subset_moves_on_the_device():
    import torch

    scene = worlds()
    rows = torch.tensor([3, 39, 7, 1000, -1], device="cuda")
    positions = torch.randn(5, 3, device="cuda", dtype=torch.float64)
    scene.move(positions=torch.tensor(scene.positions, device="cuda"))
    before = scene.positions
    scene.move(rows, positions=positions)
    after = scene.positions
    np.testing.assert_array_equal(after[[3, 39, 7]], host(positions)[:3])
    still = np.delete(np.arange(40), [3, 39, 7])
    np.testing.assert_array_equal(after[still], before[still])
    cameras = cameras_around(3, seed=22)
    batch = v3dg.Renderer(scene, device="cuda").render_batch(cameras)
    assert_same(batch, one_by_one(scene, cameras, "cuda"))
    with pytest.raises(ValueError, match="ids: expected integers"):
        scene.move(rows.float(), positions=positions)


@pytest.mark.gpu
def test_wrong_tensors_are_refused():
    import torch

    cameras = tensors_of(cameras_around(3))
    with pytest.raises(ValueError, match="viewmats: expected shape"):
        CameraBatch(cameras.viewmats[0], cameras.K, 4, 4)
    with pytest.raises(ValueError, match=r"viewmats: expected torch.float32 or torch.float64"):
        CameraBatch(cameras.viewmats.half(), cameras.K, 4, 4)
    with pytest.raises(ValueError, match="viewmats: expected a contiguous tensor"):
        CameraBatch(cameras.viewmats.transpose(1, 2), cameras.K, 4, 4)
    with pytest.raises(ValueError, match=r"K: expected shape"):
        CameraBatch(cameras.viewmats, cameras.K[:2], 4, 4)
    with pytest.raises(ValueError, match=r"environments: expected torch.int32 or torch.int64"):
        CameraBatch(cameras.viewmats, cameras.K, 4, 4, environments=torch.zeros(3, device="cuda"))
    with pytest.raises(ValueError, match="cameras: expected tensors on cpu"):
        v3dg.Renderer(Scene(), device="cpu").render_batch(cameras)
    residency.clear()
