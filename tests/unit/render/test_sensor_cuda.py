"""Tests channels and meshes on a CUDA device. They are compared with the CPU, and bit
for bit between batches, single pictures, planes of the caller and graphs. Also tests
meshes as tensors."""

import dataclasses

import numpy as np
import pytest

import frames
import scenes_lod
import v3dg
from devices import host, on
from frames import composed_scene, tensors_of
from random_bundle import random_bundle
from v3dg import BatchPlanes, Camera, CameraBatch, MeshLayer, Scene
from v3dg.donut import make_donut

pytestmark = pytest.mark.gpu

WIDTH = 45
HEIGHT = 70
CHANNELS = ("depth", "median_depth", "normal", "instance", "label", "weight")
PLANES = ("color", "alpha", *CHANNELS)
OPTIONS = [
    {},
    {"tolerance": 8.0, "fade": 1.5, "background": (0.2, 0.5, 1.0)},
    {"tolerance": 0.0, "min_transmittance": 0.0},
    {"tolerance": 1.0, "min_level": 1, "min_transmittance": 0.2},
]


@pytest.fixture(scope="module")
def scene():
    scene = composed_scene(np.random.default_rng(3))
    scene.set_label(np.arange(len(scene)) % 5 + 10)
    return scene


@pytest.fixture(scope="module")
def tinted_scene():
    return frames.tinted_scene(np.random.default_rng(4))


def camera_at(eye=(0, -6, 1)):
    return Camera.look_at(eye, (0, 0, 0), (0, 0, 1), 0.9, width=WIDTH, height=HEIGHT)


def cameras_around(count, radius=6.0):
    return v3dg.turntable((0, 0, 0), radius, count, width=WIDTH, height=HEIGHT)


def mesh_of(shape, seed=0, **planes):
    """Return a mesh in front of, between and behind the gaussians of the scene."""
    rng = np.random.default_rng(seed)
    coverage = rng.choice([0.0, 0.4, 1.0], shape)
    normal = rng.normal(size=(*shape, 3))
    depth = np.exp(rng.uniform(np.log(0.03), np.log(30), shape))
    return MeshLayer(rng.uniform(0, 1, (*shape, 3)), depth, coverage, normal, **planes)


def part_of(mesh, number):
    """Return the mesh of one camera of a batch."""
    planes = {}
    for name in ("color", "depth", "coverage", "normal", "instance", "label"):
        plane = getattr(mesh, name)
        if plane is not None:
            planes[name] = plane[number]
    return dataclasses.replace(mesh, **planes)


def on_cuda(mesh):
    """Return a mesh whose planes are float32 and int32 tensors on the device."""
    import torch

    planes = {}
    for field in dataclasses.fields(mesh):
        plane = getattr(mesh, field.name)
        if isinstance(plane, np.ndarray):
            dtype = torch.float32 if plane.dtype.kind == "f" else torch.int32
            planes[field.name] = torch.tensor(plane, dtype=dtype, device="cuda")
    return dataclasses.replace(mesh, **planes)


def planes_of(count, height=HEIGHT, width=WIDTH):
    """Return planes of the caller for all channels, with alpha in the colour."""
    import torch

    def plane(*axes, dtype=torch.float32):
        return torch.full((count, height, width, *axes), 7, dtype=dtype, device="cuda")

    return BatchPlanes(
        plane(4),
        depth=plane(),
        median_depth=plane(),
        normal=plane(3),
        instance=plane(dtype=torch.int32),
        label=plane(dtype=torch.int32),
        weight=plane(),
    )


def assert_same(image, other, planes=PLANES):
    for plane in planes:
        np.testing.assert_array_equal(
            host(getattr(image, plane)), host(getattr(other, plane)), plane
        )


def assert_same_but_for_rounded_normals(image, other):
    """Compare pictures of meshes on the host with those of meshes on the device. Only
    normals on the host are normalised in double precision first."""
    assert_same(image, other, tuple(plane for plane in PLANES if plane != "normal"))
    np.testing.assert_allclose(host(image.normal), host(other.normal), atol=1e-5)


def assert_like_cpu(image, expected, planes=PLANES, share=0.01):
    """Compare channels with those of the CPU.

    Pixels near a cut-off may differ, as may ids of nearly equal weights.
    """
    for plane in planes:
        got = host(getattr(image, plane))
        wanted = getattr(expected, plane)
        assert got.dtype == wanted.dtype
        error = np.abs(got.astype(np.float64) - wanted) / np.maximum(1, np.abs(wanted))
        assert (error > 2e-3).mean() < share, plane
    differs = host(image.instance) != expected.instance
    ties = np.abs(host(image.weight) - expected.weight) < 1e-3
    assert (differs & ~ties).mean() < 0.003


def assert_devices_agree(subject, camera, **options):
    """Compare all channels of both devices, and return the picture of the CPU."""
    image, expected = (
        v3dg.render(subject, camera, channels=CHANNELS, device=device, **options)
        for device in ("cuda", "cpu")
    )
    assert_like_cpu(image, expected)
    return expected


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.parametrize("light", [None, "display", "linear"])
def test_scenes_have_the_channels_of_the_cpu(scene, options, light):
    mesh = None if light is None else mesh_of((HEIGHT, WIDTH), light=light)
    for eye in ((0, -6, 1), (0.4, 0.2, 0.1), (0, -30, 5)):
        assert_devices_agree(scene, camera_at(eye), mesh=mesh, **options)


def test_instances_with_factors_have_the_channels_of_the_cpu(tinted_scene):
    """Instances that are far away share items."""
    for eye in ((0, -16, 1), (0, -60, 5)):
        drawn = assert_devices_agree(tinted_scene, camera_at(eye))
        assert len(np.unique(drawn.instance)) > 5


@pytest.mark.parametrize("options", OPTIONS)
def test_colours_do_not_change_with_channels(scene, tinted_scene, options):
    for subject in (scene, tinted_scene):
        for eye in ((0, -6, 1), (0, -60, 5), (0.4, 0.2, 0.1)):
            camera = camera_at(eye)
            plain = v3dg.render(subject, camera, depth=True, device="cuda", **options)
            image = v3dg.render(subject, camera, channels=CHANNELS, device="cuda", **options)
            assert_same(image, plain, ("color", "alpha", "depth"))
            assert image.stats.gaussians_selected == plain.stats.gaussians_selected
            assert image.stats.gaussians_in_frustum == plain.stats.gaussians_in_frustum
            mesh = mesh_of((HEIGHT, WIDTH))
            among = v3dg.render(subject, camera, mesh=mesh, depth=True, device="cuda", **options)
            is_bare = mesh.coverage == 0
            for plane in ("color", "alpha", "depth"):
                got = host(getattr(among, plane))
                np.testing.assert_array_equal(
                    got[is_bare], host(getattr(plain, plane))[is_bare], plane
                )


def test_long_lists_keep_their_order():
    """Without channels, long lists of tiles are blended in parts, by several blocks."""
    rng = np.random.default_rng(1)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 400, size=0.2), 64)
    scene = Scene()
    count = 3000
    scene.add(bundle, rng.normal(size=(count, 3)), rng.normal(size=(count, 4)))
    camera = Camera.look_at((0, -9, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)
    options = {"tolerance": 0.0, "min_transmittance": 0.0}
    plain = v3dg.render(scene, camera, depth=True, device="cuda", **options)
    image = v3dg.render(scene, camera, channels=CHANNELS, device="cuda", **options)
    assert_same(image, plain, ("color", "alpha", "depth"))
    assert_like_cpu(
        image, v3dg.render(scene, camera, channels=CHANNELS, device="cpu", **options), share=0.02
    )


def test_each_channel_alone_is_that_of_all_together(scene):
    mesh = mesh_of((HEIGHT, WIDTH))
    for layer in (None, mesh):
        together = v3dg.render(scene, camera_at(), channels=CHANNELS, mesh=layer, device="cuda")
        for channel in CHANNELS:
            alone = v3dg.render(scene, camera_at(), channels=[channel], mesh=layer, device="cuda")
            assert_same(alone, together, (channel, "color"))
            for other in set(CHANNELS) - {channel}:
                with pytest.raises(AttributeError, match=f"{other}: expected"):
                    getattr(alone, other)


@pytest.mark.parametrize("options", OPTIONS)
def test_a_batch_has_the_channels_of_each_camera_alone(scene, tinted_scene, options):
    mesh = mesh_of((5, HEIGHT, WIDTH), instance=None)
    for subject in (scene, tinted_scene):
        for radius in (6.0, 60.0):
            cameras = cameras_around(5, radius)
            renderer = v3dg.Renderer(subject, device="cuda", memory=None)
            batch = renderer.render_batch(cameras, channels=CHANNELS, mesh=mesh, **options)
            plain = renderer.render_batch(cameras, channels=CHANNELS, **options)
            for number, camera in enumerate(cameras):
                layer = part_of(mesh, number)
                alone = v3dg.render(
                    subject, camera, channels=CHANNELS, mesh=layer, device="cuda", **options
                )
                assert_same(batch[number], alone)
                alone = renderer.render(camera, channels=CHANNELS, **options)
                assert_same(plain[number], alone)
            if "tolerance" not in options:
                at_once = v3dg.render(subject, cameras, channels=CHANNELS, device="cuda")
                assert_same(at_once[3], plain[3])


def test_cameras_of_an_environment_name_the_instances_of_the_scene():
    rng = np.random.default_rng(4)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300), 32)
    scene = Scene()
    scene.add(
        bundle, positions=[[9, 0, 0], [0, 0, 0], [0, 0, 0]], environment=[0, 1, 0], label=[4, 5, 6]
    )
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    views = [camera_at(), camera_at()]
    on_host = CameraBatch.of(views, environments=[0, 1])
    for cameras in (on_host, tensors_of(views, environments=on("cuda", np.array([0, 1])))):
        batch = renderer.render_batch(cameras, channels=("instance", "label"))
        for number, instance, label in ((0, 2, 6), (1, 1, 5)):
            ids = host(batch.instance)[number]
            seen = ids >= 0
            assert seen.any()
            assert set(ids[seen]) == {instance}
            assert set(host(batch.label)[number][seen]) == {label}
    scene.set_label(8)
    batch = renderer.render_batch(cameras, channels=("label",))
    assert set(np.unique(host(batch.label))) == {-1, 8}


def test_pools_given_cuts_and_quantized_gaussians_have_channels(scene):
    camera = camera_at()
    expected = v3dg.render(scene, camera, channels=CHANNELS, device="cuda", memory=None)
    pooled = v3dg.render(scene, camera, channels=CHANNELS, device="cuda", memory=1 << 26)
    assert_same(pooled, expected, ("color", "instance", "label", "weight", "median_depth"))
    # With a pool, normals are computed from covariances.
    np.testing.assert_allclose(host(pooled.normal), host(expected.normal), atol=2e-3)
    cut = v3dg.select(scene, camera, device="cuda")
    image = v3dg.render(scene, camera, cut=cut, channels=CHANNELS, device="cuda")
    assert_same(image, expected)
    coded = random_bundle(1, num_levels=3, sh_degree=1, codec="quantized")
    view = v3dg.first_camera(coded, WIDTH, HEIGHT)
    drawn = assert_devices_agree(coded, view, tolerance=0.0)
    assert drawn.normal.any()


def test_stereo_cameras_and_lenses_have_channels(scene):
    stereo = v3dg.StereoCamera.of(camera_at(), 0.06)
    eyes = v3dg.render(scene, stereo, channels=CHANNELS, device="cuda")
    for eye, expected in zip(
        eyes, v3dg.render(scene, stereo, channels=CHANNELS, device="cpu"), strict=True
    ):
        assert_like_cpu(eye, expected)
    lens = dataclasses.replace(camera_at(), distortion=(0.1, 0.01, 0.0, 0.0), model="OPENCV")
    assert_devices_agree(scene, lens, mesh=mesh_of((HEIGHT, WIDTH)))


@pytest.fixture(scope="module")
def clipped_scenes():
    """Return scenes of small objects, of which the second has factors."""
    rng = np.random.default_rng(6)
    bundle = scenes_lod.lod_bundle(rng, make_donut(1500), 32)
    scenes = []
    for factors in ({}, {"opacity": rng.uniform(0.1, 1, 24)}):
        scene = Scene()
        positions = rng.uniform(-3, 3, (24, 3))
        scales = rng.uniform(0.3, 0.7, 24)
        scene.add(bundle, positions, rng.normal(size=(24, 4)), scales, **factors)
        scenes.append(scene)
    return scenes


def near_camera(seed):
    """Return a camera among the objects, before whose near plane some of them are."""
    rng = np.random.default_rng(seed)
    eye = rng.uniform(-1, 1, 3)
    target = eye + rng.normal(size=3)
    return Camera.look_at(eye, target, (0, 0, 1), 0.9, width=WIDTH, height=HEIGHT, near=1.0)


def inside_camera():
    """Return a camera in the middle of a blob."""
    return Camera.look_at(
        (0, 0, 0), (0, 1, 0), (0, 0, 1), 0.9, width=WIDTH, height=HEIGHT, near=0.4
    )


def assert_clipped_as_on_the_cpu(subject, camera, **options):
    """Compare the channel `clipped` of both devices, and return the share of clipped
    pixels. Only pixels at the borders of bodies may differ."""
    made = [
        v3dg.render(subject, camera, channels=("clipped",), device=device, **options)
        for device in ("cuda", "cpu")
    ]
    pictures = [picture if isinstance(picture, tuple) else (picture,) for picture in made]
    for picture, expected in zip(*pictures, strict=True):
        got = host(picture.clipped)
        assert got.dtype == np.bool_
        assert (got != expected.clipped).mean() < 0.003
    return expected.clipped.mean()


@pytest.mark.parametrize(
    "options",
    [*OPTIONS, {"budget": 3000}, {"memory": 1 << 26, "tolerance": 1.0}],
)
def test_clipped_pixels_are_those_of_the_cpu(clipped_scenes, options):
    for subject in clipped_scenes:
        shares = [
            assert_clipped_as_on_the_cpu(subject, near_camera(seed), **options) for seed in range(6)
        ]
        assert 0.01 < np.mean(shares) < 0.9


def test_clipped_pixels_of_other_subjects_are_those_of_the_cpu(clipped_scenes):
    for seed in range(3):
        stereo = v3dg.StereoCamera.of(near_camera(seed), 0.1)
        assert_clipped_as_on_the_cpu(clipped_scenes[0], stereo)
    rng = np.random.default_rng(2)
    asset = scenes_lod.blob(rng, 700)
    view = inside_camera()
    assert assert_clipped_as_on_the_cpu(asset, view) > 0.01
    bundle = scenes_lod.lod_bundle(rng, asset, 64)
    assert assert_clipped_as_on_the_cpu(bundle, view) > 0.01
    cut = v3dg.select(bundle, view, tolerance=2.0, fade=1.5, cull=False, device="cpu")
    assert assert_clipped_as_on_the_cpu(bundle, view, cut=cut) > 0.01
    coded = random_bundle(1, num_levels=3, sh_degree=1, codec="quantized")
    shown = v3dg.first_camera(coded, WIDTH, HEIGHT)
    means = coded.level_gaussians(0).means
    depths = means @ shown.viewmat[2, :3] + shown.viewmat[2, 3]
    inside = dataclasses.replace(shown, near=float(np.percentile(depths, 25)))
    assert assert_clipped_as_on_the_cpu(coded, inside, tolerance=0.0) > 0.01


def test_a_batch_marks_the_clipped_pixels_of_each_camera_alone(clipped_scenes):
    import torch

    scene = clipped_scenes[1]
    cameras = [near_camera(seed) for seed in range(7)]
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    batch = renderer.render_batch(cameras, channels=("clipped", "depth"))
    assert host(batch.clipped).any()
    for number, camera in enumerate(cameras):
        alone = renderer.render(camera, channels=("clipped",))
        np.testing.assert_array_equal(host(batch.clipped[number]), host(alone.clipped))
    plain = renderer.render_batch(cameras, channels=("depth",))
    assert torch.equal(batch.color, plain.color)
    assert torch.equal(batch.depth, plain.depth)
    there = tensors_of(cameras, near=1.0)
    planes = BatchPlanes(torch.zeros(7, HEIGHT, WIDTH, 3, device="cuda"))
    renderer.render_batch(there, channels=("clipped",), out=planes).wait()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = renderer.render_batch(there, channels=("clipped",), out=planes)
    for clipped in (batch.clipped, batch.clipped.flip(0)):
        graph.replay()
        torch.cuda.synchronize()
        assert torch.equal(captured.clipped, clipped)
        there.viewmats.copy_(there.viewmats.flip(0).clone())


def test_cameras_of_an_environment_are_clipped_by_its_instances():
    rng = np.random.default_rng(4)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300), 32)
    scene = Scene()
    scene.add(bundle, positions=[[9, 0, 0], [0, 0, 0]], environment=[0, 1])
    view = Camera.look_at(
        (0, 0, 0), (0, 1, 0), (0, 0, 1), 0.9, width=WIDTH, height=HEIGHT, near=0.4
    )
    cameras = CameraBatch.of([view, view], environments=[0, 1])
    batch = v3dg.Renderer(scene, device="cuda").render_batch(cameras, channels=("clipped",))
    assert not host(batch.clipped[0]).any()
    assert host(batch.clipped[1]).any()


def test_lists_and_eyes_have_meshes_of_their_own(scene):
    cameras = cameras_around(3)
    layers = [mesh_of((HEIGHT, WIDTH), seed=seed) for seed in range(3)]
    there = [on_cuda(layer) for layer in layers]
    expected = [
        v3dg.render(scene, camera, mesh=layer, channels=CHANNELS, device="cuda")
        for camera, layer in zip(cameras, there, strict=True)
    ]
    comparisons = [
        (there, assert_same),
        (layers, assert_same_but_for_rounded_normals),
        (MeshLayer.joined(there), assert_same),
    ]
    for mesh, compare in comparisons:
        drawn = v3dg.render(scene, cameras, mesh=mesh, channels=CHANNELS, device="cuda")
        for image, alone in zip(drawn, expected, strict=True):
            compare(image, alone)
    stereo = v3dg.StereoCamera.of(camera_at(), 0.06)
    eyes = v3dg.render(scene, stereo, mesh=there[:2], channels=CHANNELS, device="cuda")
    for eye, wanted in zip(
        eyes,
        v3dg.render(scene, stereo, mesh=layers[:2], channels=CHANNELS, device="cpu"),
        strict=True,
    ):
        assert_like_cpu(eye, wanted)


def test_tensors_of_8_bits_are_colours_of_images(scene):
    import torch

    mesh = on_cuda(mesh_of((HEIGHT, WIDTH)))
    colors = torch.randint(0, 256, (HEIGHT, WIDTH, 3), dtype=torch.uint8, device="cuda")
    pictures = [
        v3dg.render(scene, camera_at(), mesh=dataclasses.replace(mesh, color=color), device="cuda")
        for color in (colors, colors.float() / 255)
    ]
    assert torch.equal(pictures[0].color, pictures[1].color)
    wrong = dataclasses.replace(mesh, color=colors.int())
    with pytest.raises(ValueError, match=r"mesh.color: expected floats .white is 1. or uint8"):
        v3dg.render(scene, camera_at(), mesh=wrong, device="cuda")


def test_planes_of_the_caller_are_written(scene):
    cameras = cameras_around(5)
    mesh = mesh_of((5, HEIGHT, WIDTH))
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    expected = renderer.render_batch(cameras, channels=CHANNELS, mesh=mesh)
    planes = planes_of(5)
    batch = renderer.render_batch(cameras, mesh=mesh, out=planes)
    batch.wait()
    for channel in CHANNELS:
        assert getattr(batch, channel) is getattr(planes, channel)
        assert getattr(batch.planes, channel) is getattr(planes, channel)
        np.testing.assert_array_equal(
            host(getattr(planes, channel)), host(getattr(expected, channel)), channel
        )
    np.testing.assert_array_equal(host(planes.color)[..., :3], host(expected.color))
    np.testing.assert_array_equal(host(planes.color)[..., 3], host(expected.alpha))
    only = BatchPlanes(planes.color, label=planes.label)
    other = renderer.render_batch(cameras, channels=("weight",), mesh=mesh, out=only)
    np.testing.assert_array_equal(host(other.weight), host(expected.weight))
    assert other.label is planes.label
    with pytest.raises(AttributeError, match="normal: expected"):
        other.normal  # noqa: B018 - which raises


def test_meshes_on_the_device_are_those_on_the_host(scene):
    import torch

    shape = (5, HEIGHT, WIDTH)
    mesh = mesh_of(shape, instance=np.full(shape, 99), label=np.full(shape, 3))
    cameras = cameras_around(5)
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    expected = renderer.render_batch(cameras, channels=CHANNELS, mesh=mesh)
    there = on_cuda(mesh)
    drawn = renderer.render_batch(cameras, channels=CHANNELS, mesh=there)
    assert_same_but_for_rounded_normals(drawn, expected)
    assert 3 in host(expected.label)
    # Where the numbers are not valid for a mesh, there is none.
    wrong = on_cuda(mesh)
    wrong.depth[0] = -1.0
    wrong.depth[1] = torch.nan
    wrong.depth[2] = torch.inf
    wrong.coverage[3] = torch.nan
    batch = renderer.render_batch(cameras, channels=CHANNELS, mesh=wrong)
    plain = renderer.render_batch(cameras, channels=CHANNELS)
    for number in range(4):
        assert_same(batch[number], plain[number])
    assert_same(batch[4], drawn[4])
    # Without a coverage, there is a mesh where the depth is positive and finite.
    full = dataclasses.replace(there, coverage=None)
    ones = dataclasses.replace(there, coverage=torch.ones(shape, device="cuda"))
    assert_same(
        renderer.render_batch(cameras, channels=CHANNELS, mesh=full),
        renderer.render_batch(cameras, channels=CHANNELS, mesh=ones),
    )
    on_host = v3dg.render(scene, camera_at(), mesh=part_of(there, 0), device="cpu")
    assert isinstance(on_host.color, np.ndarray)


@pytest.mark.parametrize("options", OPTIONS[:2])
def test_a_graph_draws_what_its_tensors_contain(scene, options):
    import torch

    batch = tensors_of(cameras_around(5))
    mesh = on_cuda(mesh_of((5, HEIGHT, WIDTH)))
    planes = planes_of(5)
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)

    def see(cameras, seed):
        batch.viewmats.copy_(torch.tensor(np.stack([camera.viewmat for camera in cameras])))
        batch.K.copy_(torch.tensor(np.stack([camera.K for camera in cameras])))
        other = on_cuda(mesh_of((5, HEIGHT, WIDTH), seed))
        for plane in ("color", "depth", "coverage", "normal"):
            getattr(mesh, plane).copy_(getattr(other, plane))

    views = [cameras_around(5, radius) for radius in (5.0, 9.0, 6.0)]
    for seed, view in enumerate(views):  # the buffers grow to the needed sizes
        see(view, seed)
        renderer.render_batch(batch, mesh=mesh, out=planes, **options).wait()
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        captured = renderer.render_batch(batch, mesh=mesh, out=planes, **options)
    for seed, view in enumerate(views[:2]):
        see(view, seed)
        graph.replay()
        torch.cuda.synchronize()
        captured.wait()
        for number, camera in enumerate(view):
            layer = part_of(on_cuda(mesh_of((5, HEIGHT, WIDTH), seed)), number)
            alone = v3dg.render(
                scene, camera, channels=CHANNELS, mesh=layer, device="cuda", **options
            )
            for channel in CHANNELS:
                np.testing.assert_array_equal(
                    host(getattr(planes, channel)[number]), host(getattr(alone, channel)), channel
                )
            np.testing.assert_array_equal(host(planes.color[number])[..., :3], host(alone.color))


def test_a_batch_with_channels_waits_for_nothing(scene):
    import torch

    batch = tensors_of(cameras_around(5))
    mesh = on_cuda(mesh_of((5, HEIGHT, WIDTH)))
    planes = planes_of(5)
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    for _ in range(3):
        renderer.render_batch(batch, mesh=mesh, out=planes).wait()
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        torch.cuda._sleep(2_000_000_000)
        done = torch.cuda.Event()
        renderer.render_batch(batch, mesh=mesh, out=planes)
        done.record()
        assert not done.query()
        done.synchronize()


def test_a_batch_that_is_too_small_is_marked_and_drawn_again(scene):
    import torch

    near = [camera_at((0, -2, 0.5))] * 24
    far = [camera_at((0, -500, 0.5))] * 24
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    renderer.render_batch(far, channels=CHANNELS).wait()
    planes = planes_of(24)
    batch = renderer.render_batch(near, tolerance=0.0, out=planes)
    torch.cuda.synchronize()
    for plane in (planes.color, planes.depth, planes.median_depth, planes.normal, planes.weight):
        assert torch.isnan(plane).all()
    for ids in (planes.instance, planes.label):
        assert (ids == -1).all()
    alone = v3dg.render(scene, near[0], tolerance=0.0, channels=CHANNELS, device="cuda")
    for number in (0, 23):
        assert_same(batch[number], alone, CHANNELS)


def test_a_large_batch_is_drawn_in_parts(scene):
    cameras = v3dg.turntable((0, 0, 0), 6.0, 36, width=512, height=512)
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    batch = renderer.render_batch(cameras, tolerance=2.0, channels=CHANNELS)
    assert batch.stats.num_parts == 2
    for number in (0, 31, 32, 35):
        alone = v3dg.render(scene, cameras[number], tolerance=2.0, channels=CHANNELS, device="cuda")
        assert_same(batch[number], alone)


def test_nothing_drawn_has_no_channels():
    scene = Scene()
    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    batch = renderer.render_batch(cameras_around(3), channels=CHANNELS)
    for plane in (batch.normal, batch.weight, batch.median_depth):
        assert not host(plane).any()
    for plane in (batch.instance, batch.label):
        assert (host(plane) == -1).all()


def test_a_device_refuses_what_it_cannot_draw(scene):
    import torch

    renderer = v3dg.Renderer(scene, device="cuda", memory=None)
    mesh = on_cuda(mesh_of((HEIGHT, WIDTH)))
    cases = [
        ({"color": host(mesh.color)}, "mesh.color: expected a tensor on cuda:0"),
        ({"coverage": mesh.coverage[:3]}, r"mesh.coverage: expected shape \(70, 45\)"),
        ({"instance": mesh.coverage}, "mesh.instance: expected numbers for int32"),
        ({"depth": mesh.depth[0]}, "mesh.depth: expected shape"),
    ]
    for planes, text in cases:
        with pytest.raises(ValueError, match=text):
            renderer.render(camera_at(), mesh=dataclasses.replace(mesh, **planes))
    with pytest.raises(ValueError, match=r"mesh: expected planes of shape \(1, 70, 45\)"):
        renderer.render_batch([camera_at()], mesh=mesh)
    color = torch.zeros(1, HEIGHT, WIDTH, 3, device="cuda")
    wrong = [
        ({"normal": torch.zeros(1, HEIGHT, WIDTH, device="cuda")}, "normal: expected"),
        ({"instance": torch.zeros(1, HEIGHT, WIDTH, device="cuda")}, "instance: expected"),
        ({"weight": torch.zeros(1, HEIGHT, WIDTH)}, "weight: expected"),
    ]
    for planes, text in wrong:
        with pytest.raises((ValueError, TypeError), match=text):
            renderer.render_batch([camera_at()], out=BatchPlanes(color, **planes))
