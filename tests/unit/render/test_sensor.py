"""Tests channels of scenes: ids, labels and weights against `v3dg.pick`, batches,
pools, stereo cameras, meshes, and wrong arguments."""

import dataclasses

import numpy as np
import pytest

import scenes_lod
import v3dg
from frames import composed_scene
from random_bundle import random_bundle
from v3dg import BatchPlanes, Camera, MeshLayer, Scene, _core
from v3dg._device import CPU
from v3dg.render import api, shade_of
from v3dg.residency import residency

WIDTH = 45
HEIGHT = 70
CHANNELS = ("depth", "median_depth", "normal", "instance", "label", "weight", "clipped")
PLANES = ("color", "alpha", *CHANNELS)


@pytest.fixture(scope="module")
def scene():
    scene = composed_scene(np.random.default_rng(3))
    scene.set_label(np.arange(len(scene)) % 5 + 10)
    return scene


def camera_at(eye=(0, -6, 1)):
    return Camera.look_at(eye, (0, 0, 0), (0, 0, 1), 0.9, width=WIDTH, height=HEIGHT)


def mesh_of(shape, seed=0, **planes):
    """Return a mesh in front of, between and behind the gaussians of the scene."""
    rng = np.random.default_rng(seed)
    coverage = rng.choice([0.0, 0.4, 1.0], shape)
    depth = np.exp(rng.uniform(np.log(0.03), np.log(30), shape))
    return MeshLayer(rng.uniform(0, 1, (*shape, 3)), depth, coverage, **planes)


def assert_same(image, other, planes=PLANES):
    for plane in planes:
        np.testing.assert_array_equal(getattr(image, plane), getattr(other, plane), plane)


@pytest.mark.parametrize("options", [{}, {"tolerance": 8.0, "fade": 1.5}, {"tolerance": 0.0}])
def test_ids_and_weights_are_those_of_the_picked_gaussian(scene, options):
    """`pick` is an independent implementation: scalar code that never stops early."""
    camera = camera_at()
    image = v3dg.render(
        scene,
        camera,
        channels=("instance", "label", "weight"),
        min_transmittance=0.0,
        device="cpu",
        **options,
    )
    options.pop("fade", None)
    num_compared = 0
    for y, x in np.random.default_rng(0).integers(0, (HEIGHT, WIDTH), (25, 2)):
        hit = v3dg.pick(scene, camera, x, y, **options)
        if hit is None:
            assert image.instance[y, x] == -1
            assert image.weight[y, x] == 0
            continue
        if hit.instance != image.instance[y, x]:
            continue  # the two largest weights are nearly equal, or a fade is drawn
        num_compared += 1
        assert image.label[y, x] == scene.labels[hit.instance]
        if "tolerance" not in options or options["tolerance"] != 8.0:
            np.testing.assert_allclose(image.weight[y, x], hit.weight, rtol=1e-3)
    assert num_compared > 6


def test_colours_do_not_change_with_channels(scene):
    plain = v3dg.render(scene, camera_at(), depth=True, device="cpu")
    image = v3dg.render(scene, camera_at(), channels=CHANNELS, device="cpu")
    assert_same(image, plain, ("color", "alpha", "depth"))
    assert image.stats.gaussians_selected == plain.stats.gaussians_selected


def test_each_channel_alone_is_that_of_all_together(scene):
    together = v3dg.render(scene, camera_at(), channels=CHANNELS, device="cpu")
    for channel in CHANNELS:
        alone = v3dg.render(scene, camera_at(), channels=[channel], device="cpu")
        assert_same(alone, together, (channel,))
        for other in set(CHANNELS) - {channel}:
            with pytest.raises(AttributeError, match=f"{other}: expected"):
                getattr(alone, other)


def test_a_batch_has_the_channels_of_each_camera_alone(scene):
    cameras = v3dg.turntable((0, 0, 0), 6.0, 5, width=WIDTH, height=HEIGHT)
    mesh = mesh_of((5, HEIGHT, WIDTH), instance=np.full((5, HEIGHT, WIDTH), 99))
    renderer = v3dg.Renderer(scene, device="cpu")
    batch = renderer.render_batch(cameras, channels=CHANNELS, mesh=mesh)
    assert batch.normal.shape == (5, HEIGHT, WIDTH, 3)
    assert 0.1 < (batch.instance == 99).mean() < 0.9
    for number, camera in enumerate(cameras):
        layer = MeshLayer(
            mesh.color[number],
            mesh.depth[number],
            mesh.coverage[number],
            instance=mesh.instance[number],
        )
        alone = v3dg.render(scene, camera, channels=CHANNELS, mesh=layer, device="cpu")
        assert_same(batch[number], alone)
    at_once = v3dg.render(scene, cameras, channels=CHANNELS, device="cpu")
    assert_same(at_once[3], v3dg.render(scene, cameras[3], channels=CHANNELS, device="cpu"))


def test_planes_of_the_caller_are_written(scene):
    cameras = v3dg.turntable((0, 0, 0), 6.0, 5, width=WIDTH, height=HEIGHT)
    mesh = mesh_of((5, HEIGHT, WIDTH))
    renderer = v3dg.Renderer(scene, device="cpu")
    expected = renderer.render_batch(cameras, channels=CHANNELS, mesh=mesh)
    shape = (5, HEIGHT, WIDTH)
    planes = BatchPlanes(
        np.full((*shape, 4), 7, np.float32),
        median_depth=np.full(shape, 7, np.float32),
        normal=np.full((*shape, 3), 7, np.float32),
        instance=np.full(shape, 7, np.int32),
        label=np.full(shape, 7, np.int32),
        weight=np.full(shape, 7, np.float32),
    )
    batch = renderer.render_batch(cameras, channels=["clipped"], mesh=mesh, out=planes)
    assert_same(batch, expected, CHANNELS[1:])
    np.testing.assert_array_equal(planes.color[..., :3], expected.color)
    for channel in CHANNELS[1:-1]:
        assert getattr(batch, channel) is getattr(planes, channel)
        assert getattr(batch.planes, channel) is getattr(planes, channel)
    with pytest.raises(AttributeError, match="depth: expected"):
        batch.depth  # noqa: B018 - which raises


def test_wrong_planes_of_channels_are_refused(scene):
    color = np.zeros((1, HEIGHT, WIDTH, 3), np.float32)
    renderer = v3dg.Renderer(scene, device="cpu")
    cases = [
        ({"normal": np.zeros((1, HEIGHT, WIDTH), np.float32)}, ValueError, "normal: expected"),
        ({"label": np.zeros((1, HEIGHT, WIDTH), np.float32)}, ValueError, "label: expected"),
        ({"weight": np.zeros((1, HEIGHT, 3), np.float32)}, ValueError, "weight: expected"),
        ({"instance": [[[3]]]}, TypeError, "instance: expected"),
    ]
    for planes, kind, text in cases:
        with pytest.raises(kind, match=text):
            renderer.render_batch([camera_at()], out=BatchPlanes(color, **planes))


def test_cameras_of_an_environment_name_the_instances_of_the_scene():
    rng = np.random.default_rng(4)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300), 32)
    scene = Scene()
    scene.add(
        bundle, positions=[[9, 0, 0], [0, 0, 0], [0, 0, 0]], environment=[0, 1, 0], label=[4, 5, 6]
    )
    cameras = v3dg.CameraBatch.of([camera_at(), camera_at()], environments=[0, 1])
    batch = v3dg.Renderer(scene, device="cpu").render_batch(cameras, channels=("instance", "label"))
    for number, instance, label in ((0, 2, 6), (1, 1, 5)):
        seen = batch.instance[number] >= 0
        assert seen.any()
        assert set(batch.instance[number][seen]) == {instance}
        assert set(batch.label[number][seen]) == {label}


def test_pools_and_given_cuts_have_the_same_channels(scene):
    camera = camera_at()
    expected = v3dg.render(scene, camera, channels=CHANNELS, device="cpu", memory=None)
    pooled = v3dg.render(scene, camera, channels=CHANNELS, device="cpu", memory=1 << 26)
    assert_same(pooled, expected)
    cut = v3dg.select(scene, camera, device="cpu")
    given = v3dg.render(scene, camera, cut=cut, channels=CHANNELS, device="cpu")
    assert_same(given, expected, PLANES[:-1])


def test_quantized_gaussians_have_the_channels_of_what_they_decode_to():
    coded = random_bundle(1, num_levels=3, sh_degree=1, codec="quantized")
    decoded = v3dg.Bundle(coded.clusters, coded.groups, coded.gaussians)
    camera = v3dg.first_camera(decoded, WIDTH, HEIGHT)
    image = v3dg.render(coded, camera, channels=CHANNELS, device="cpu", tolerance=0.0)
    assert_same(image, v3dg.render(decoded, camera, channels=CHANNELS, device="cpu", tolerance=0.0))
    assert image.normal.any()


def test_both_eyes_of_a_stereo_camera_have_channels(scene):
    stereo = v3dg.StereoCamera.of(camera_at(), 0.06)
    left, right = v3dg.render(scene, stereo, channels=("normal", "weight"), device="cpu")
    assert left.normal.any()
    assert not np.array_equal(left.weight, right.weight)


def assert_pictures_among_meshes(subject, cameras, mesh, layers, **options):
    """Compare pictures with those of each camera alone."""
    pictures = v3dg.render(subject, cameras, mesh=mesh, channels=CHANNELS, device="cpu", **options)
    for picture, camera, layer in zip(pictures, cameras, layers, strict=True):
        alone = v3dg.render(subject, camera, mesh=layer, channels=CHANNELS, device="cpu", **options)
        assert_same(picture, alone)


def test_cameras_of_a_list_have_meshes_of_their_own(scene, monkeypatch):
    cameras = [camera_at(), camera_at((0, -5, 2)), camera_at((1, -7, 0))]
    layers = [mesh_of((HEIGHT, WIDTH), seed=seed) for seed in range(3)]
    joined = MeshLayer.joined(layers)
    for mesh in (layers, tuple(layers), joined):
        assert_pictures_among_meshes(scene, cameras, mesh, layers)
        assert_pictures_among_meshes(scene, cameras, mesh, layers, budget=2000)
    monkeypatch.setattr(api, "_MOST_PIXELS_A_CALL", 2 * HEIGHT * WIDTH)
    assert_pictures_among_meshes(scene, cameras, joined, layers)
    batch = v3dg.Renderer(scene, device="cpu").render_batch(cameras, mesh=layers)
    whole = v3dg.Renderer(scene, device="cpu").render_batch(cameras, mesh=joined)
    np.testing.assert_array_equal(batch.color, whole.color)
    sizes = [cameras[0], cameras[1].scaled(2)]
    two = [layers[0], mesh_of((2 * HEIGHT, 2 * WIDTH))]
    assert_pictures_among_meshes(scene, sizes, two, two)


def test_eyes_have_meshes_of_their_own(scene):
    stereo = v3dg.StereoCamera.of(camera_at(), 0.06)
    layers = [mesh_of((HEIGHT, WIDTH), seed=seed) for seed in range(2)]
    cut = v3dg.select(scene, stereo, device="cpu")
    asset = scenes_lod.blob(np.random.default_rng(5), 300)
    for subject, given in ((scene, None), (scene, cut), (asset, None)):
        options = {"channels": CHANNELS[:-1], "device": "cpu"}
        eyes = v3dg.render(subject, stereo, mesh=layers, cut=given, **options)
        if subject is scene:
            options["cut"] = cut
        for eye, camera, layer in zip(eyes, stereo.eyes, layers, strict=True):
            alone = v3dg.render(subject, camera, mesh=layer, **options)
            assert_same(eye, alone, PLANES[:-1])
        with pytest.raises(ValueError, match=r"mesh: expected planes of shape \(2, .*got \(70, 45"):
            v3dg.render(subject, stereo, mesh=layers[0], cut=given, device="cpu")


def test_colours_of_8_bits_are_those_of_images(scene):
    shape = (HEIGHT, WIDTH)
    bytes_of_mesh = np.random.default_rng(0).integers(0, 256, (*shape, 3), dtype=np.uint8)
    depth = np.full(shape, 3.0)
    options = {"device": "cpu", "channels": ("instance",)}
    picture = v3dg.render(scene, camera_at(), mesh=MeshLayer(bytes_of_mesh, depth), **options)
    floats = MeshLayer(bytes_of_mesh / np.float32(255), depth)
    assert_same(picture, v3dg.render(scene, camera_at(), mesh=floats, **options), ("color",))
    for wrong in (bytes_of_mesh.astype(np.int64), bytes_of_mesh > 3):
        with pytest.raises(ValueError, match=r"mesh.color: expected floats .white is 1. or uint8"):
            v3dg.render(scene, camera_at(), mesh=MeshLayer(wrong, depth), **options)


def draw_window(scene, cut, window, mesh):
    """Return the channels of the pixels [x0, x1) x [y0, y1), drawn by a renderer that
    may be stopped."""
    x0, y0, x1, y1 = window
    part = np.s_[y0:y1, x0:x1]
    layer = MeshLayer(mesh.color[part], mesh.depth[part], mesh.coverage[part])
    frame = _core.SceneFrame(CPU.number)
    residency.set_models(frame, scene.bundles, CPU, "appearance")
    request = _core.FrameRequest(
        camera_at().core.window(*window),
        shade=shade_of((0.1, 0.2, 0.3), None, is_asset=False, depth=True),
        cut=_core.GivenCut(cut.instance_ids, cut.cluster_ids),
        sensor=_core.Sensor(["median_depth", "normal", "instance", "weight"], layer.core_on(CPU)),
    )
    drawing = frame.draw(residency.scene(scene, CPU).core, request, None, None, _core.Stop())
    channels = drawing.channels
    return [
        drawing.color,
        drawing.alpha,
        drawing.depth,
        channels.median_depth,
        channels.normal,
        channels.instance,
        channels.weight,
    ]


def test_parts_of_a_picture_have_its_bits():
    """The whole picture has so many gaussians that it is drawn in bands, but each of
    its halves is drawn at once."""
    rng = np.random.default_rng(1)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 400, size=0.2), 64)
    scene = Scene()
    count = 6000
    scene.add(bundle, rng.normal(size=(count, 3)), rng.normal(size=(count, 4)))
    cut = v3dg.select(scene, camera_at(), tolerance=0.0, device="cpu")
    mesh = mesh_of((HEIGHT, WIDTH))
    whole = draw_window(scene, cut, (0, 0, WIDTH, HEIGHT), mesh)
    for window in ((0, 0, WIDTH, 33), (0, 33, WIDTH, HEIGHT), (7, 5, 9, 66)):
        x0, y0, x1, y1 = window
        for plane, part in zip(whole, draw_window(scene, cut, window, mesh), strict=True):
            np.testing.assert_array_equal(part, plane[y0:y1, x0:x1])


def test_labels_follow_instances(tmp_path):
    path = tmp_path / "a.v3dg"
    random_bundle(1, num_levels=3, sh_degree=1).write(path)
    bundle = v3dg.Bundle.open(path)
    scene = Scene()
    scene.add(bundle, positions=np.zeros((3, 3)), label=[3, -1, 7])
    scene.add(bundle)
    assert scene.labels.tolist() == [3, -1, 7, -1]
    scene.set_label(9, [1])
    scene.remove([0])
    assert scene.labels.tolist() == [9, 7, -1]
    outer = Scene()
    outer.add_scene(scene)
    outer.add_scene(scene, label=2)
    assert outer.labels.tolist() == [9, 7, -1, 2, 2, 2]
    outer.save(tmp_path / "scene.json")
    assert Scene.load(tmp_path / "scene.json").labels.tolist() == [9, 7, -1, 2, 2, 2]
    for wrong in (-2, 1 << 31, 0.5, [1, 2]):
        with pytest.raises(ValueError, match="label: expected"):
            scene.add(bundle, label=wrong)


def test_a_window_of_a_mesh_hides_what_is_behind(scene):
    """A mesh in front of all gaussians hides them."""
    shape = (HEIGHT, WIDTH)
    color = np.random.default_rng(0).uniform(0, 1, (*shape, 3)).astype(np.float32)
    layer = MeshLayer(color, np.full(shape, 0.02), normal=np.full((*shape, 3), 2.0))
    image = v3dg.render(scene, camera_at(), channels=CHANNELS, mesh=layer, device="cpu")
    np.testing.assert_array_equal(image.color, color)
    np.testing.assert_allclose(image.depth, 0.02, rtol=1e-6)
    np.testing.assert_allclose(image.normal, 3**-0.5, rtol=1e-6)
    assert (image.instance == v3dg.MESH).all()
    behind = MeshLayer(color, np.full(shape, 1e6), np.zeros(shape))
    assert_same(
        v3dg.render(scene, camera_at(), channels=CHANNELS, mesh=behind, device="cpu"),
        v3dg.render(scene, camera_at(), channels=CHANNELS, device="cpu"),
    )


def replaced(layer, name, index, value):
    plane = np.array(getattr(layer, name))
    plane[index] = value
    return dataclasses.replace(layer, **{name: plane})


@pytest.mark.parametrize(
    ("name", "value", "text"),
    [
        ("depth", np.nan, r"mesh.depth: expected numbers, got nan at \[2, 3\]"),
        ("depth", -1.0, "mesh.depth: expected positive finite depths where there is coverage"),
        ("depth", np.inf, "mesh.depth: expected positive finite depths"),
        ("coverage", -0.5, r"mesh.coverage: expected numbers from 0 to 1, got -0.5 at \[2, 3\]"),
        ("coverage", 1.5, "mesh.coverage: expected numbers from 0 to 1"),
        ("coverage", np.nan, "mesh.coverage: expected numbers, got nan"),
        ("color", np.nan, "mesh.color: expected numbers, got nan"),
        ("color", np.inf, "mesh.color: expected finite numbers, got inf"),
    ],
)
def test_wrong_values_of_meshes_are_named(scene, name, value, text):
    shape = (HEIGHT, WIDTH)
    layer = MeshLayer(np.zeros((*shape, 3)), np.ones(shape), np.ones(shape))
    with pytest.raises(ValueError, match=text):
        v3dg.render(scene, camera_at(), mesh=replaced(layer, name, (2, 3), value), device="cpu")


def test_wrong_meshes_and_channels_are_refused(scene):
    shape = (HEIGHT, WIDTH)
    camera = camera_at()
    small = MeshLayer(np.zeros((4, 5, 3)), np.ones((4, 5)))
    cases = [
        (
            {"mesh": small},
            ValueError,
            r"mesh: expected planes of shape \(70, 45\), .* got \(4, 5\)",
        ),
        ({"mesh": MeshLayer(np.zeros((4, 5, 3)), np.ones(shape))}, ValueError, "mesh.color"),
        ({"mesh": mesh_of(shape, instance=np.zeros(shape))}, ValueError, "mesh.instance: exp"),
        ({"mesh": mesh_of(shape, label=np.zeros(3, int))}, ValueError, "mesh.label: expected"),
        ({"mesh": mesh_of(shape, light="bright")}, ValueError, "mesh.light: expected"),
        ({"mesh": np.zeros(shape)}, TypeError, "mesh: expected a MeshLayer"),
        ({"channels": ("colour",)}, ValueError, "channels: expected 'depth' or"),
        ({"channels": "normal"}, TypeError, "channels: expected a sequence of names"),
        ({"channels": 3}, TypeError, "channels: expected a sequence of names"),
    ]
    for options, kind, text in cases:
        with pytest.raises(kind, match=text):
            v3dg.render(scene, camera, device="cpu", **options)
    lens = dataclasses.replace(camera, distortion=(0.1, 0.01, 0.0, 0.0), model="OPENCV")
    assert v3dg.render(scene, lens, channels=("normal",), device="cpu").normal.any()
    with pytest.raises(ValueError, match="'clipped' needs a pinhole camera"):
        v3dg.render(scene, lens, channels=("clipped",), device="cpu")


def test_wrong_lists_of_meshes_are_refused(scene):
    shape = (HEIGHT, WIDTH)
    camera = camera_at()
    small = MeshLayer(np.zeros((4, 5, 3)), np.ones((4, 5)))
    mesh = mesh_of(shape)
    lists = [
        (mesh, ValueError, r"mesh.depth: expected shape \(B, H, W\) for a list of cameras"),
        ([mesh], ValueError, "mesh: expected a layer for each of 2 cameras, got 1"),
        (mesh_of((3, *shape)), ValueError, "mesh: expected a layer for each of 2 cameras, got 3"),
        ([mesh, small], ValueError, r"mesh\[1\].depth: expected shape \(70, 45\)"),
        ([mesh, camera], TypeError, r"mesh\[1\]: expected a MeshLayer"),
        (3, TypeError, "mesh: expected a MeshLayer, or a list of them"),
        (
            [mesh, dataclasses.replace(mesh, light="linear")],
            ValueError,
            r"mesh\[1\].light: expected 'display' as in the first layer",
        ),
        (
            [mesh, dataclasses.replace(mesh, coverage=None)],
            ValueError,
            r"mesh\[1\].coverage: expected a plane in every layer or in none",
        ),
    ]
    for layers, kind, text in lists:
        with pytest.raises(kind, match=text):
            v3dg.render(scene, [camera, camera], mesh=layers, device="cpu")
