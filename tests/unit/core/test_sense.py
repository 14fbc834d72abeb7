"""Compares the channels of a sensor and the mixing of meshes with float64."""

import numpy as np
import pytest

import scenes
import v3dg
from devices import host
from reference import sense as reference

CHANNELS = ("depth", "median_depth", "normal", "instance", "weight")
# Pixels in which rounding may change a decision are not compared.
BAND = 1e-4
STOPS = (None, 0.0, 1e-3, 0.3)


def with_flat_gaussians(seed, camera, num):
    """Return gaussians of which one axis is clearly the shortest."""
    asset = scenes.random_gaussians(seed, camera, num, size_px=(1.0, 9.0), aspect=1.0)
    rng = np.random.default_rng(seed)
    scales = asset.scales * rng.permuted(
        np.broadcast_to(np.float32([1.0, 0.6, 0.15]), (num, 3)), axis=1
    )
    return scenes.replaced(asset, scales=scales)


def mesh_in(camera, seed, *, with_normals=True):
    """Return a slanted mesh with holes, and with edges of every coverage."""
    rng = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    y, x = np.mgrid[: shape[0], : shape[1]]
    coverage = rng.choice([0.0, 1.0, 0.3, 0.75], shape, p=[0.25, 0.35, 0.2, 0.2])
    depth = np.where(coverage > 0, 1.2 + 2.4 * x / shape[1] + 0.3 * y / shape[0], np.inf)
    normal = rng.normal(size=(*shape, 3))
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    if not with_normals:
        normal = np.zeros_like(normal)
    return reference.Mesh(
        rng.uniform(0, 1, (*shape, 3)).astype(np.float32),
        depth.astype(np.float32),
        coverage.astype(np.float32),
        normal.astype(np.float32),
    )


def layer_of(mesh, light="display"):
    return v3dg.MeshLayer(mesh.color, mesh.depth, mesh.coverage, mesh.normal, light=light)


def drawn(asset, camera, stop=None, mesh=None, light="display", **options):
    layer = None if mesh is None else layer_of(mesh, light)
    return v3dg.render(
        asset,
        camera,
        device="cpu",
        min_transmittance=stop,
        channels=CHANNELS,
        mesh=layer,
        **options,
    )


def assert_channels(image, expected):
    clear = expected.margin > BAND
    assert clear.mean() > 0.8
    np.testing.assert_allclose(
        image.median_depth[clear], expected.median_depth[clear], rtol=2e-5, atol=0
    )
    np.testing.assert_allclose(image.weight[clear], expected.weight[clear], rtol=2e-4, atol=2e-6)
    has_length = clear & (expected.normal_length > 0.05)
    error = np.abs(image.normal - expected.normal).max(axis=-1)
    assert error[has_length].max() < 1e-3
    is_one = clear & (expected.weight - expected.second_weight > 1e-4)
    instance = np.where(expected.strongest >= 0, 0, expected.strongest)
    np.testing.assert_array_equal(image.instance[is_one], instance[is_one])
    assert is_one.mean() > 0.5


def assert_mixed(image, expected):
    clear = expected.margin > BAND
    np.testing.assert_allclose(image.color[clear], expected.color[clear], atol=3e-5)
    np.testing.assert_allclose(image.alpha[clear], expected.alpha[clear], atol=3e-5)
    np.testing.assert_allclose(image.depth[clear], expected.depth[clear], rtol=2e-4, atol=1e-5)


@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("name", ["plain", "off_centre"])
def test_channels_are_those_of_the_reference(name, stop):
    camera = scenes.CAMERAS[name]
    asset = with_flat_gaussians(3, camera, 120)
    image = drawn(asset, camera, stop)
    expected = reference.sense(asset, camera, min_transmittance=stop)
    assert_channels(image, expected)
    assert_mixed(image, expected)
    plain = v3dg.render(asset, camera, device="cpu", min_transmittance=stop, depth=True)
    for plane in ("color", "alpha", "depth"):
        np.testing.assert_array_equal(getattr(image, plane), getattr(plain, plane))


@pytest.mark.parametrize("light", ["display", "linear"])
@pytest.mark.parametrize("stop", STOPS)
def test_meshes_are_mixed_as_in_the_reference(light, stop):
    camera = scenes.CAMERAS["plain"]
    asset = with_flat_gaussians(4, camera, 120)
    mesh = mesh_in(camera, 5)
    background = (0.2, 0.1, 0.6)
    image = drawn(asset, camera, stop, mesh, light, background=background)
    expected = reference.sense(
        asset, camera, mesh=mesh, background=background, min_transmittance=stop, light=light
    )
    assert_channels(image, expected)
    assert_mixed(image, expected)
    assert (expected.strongest == -2).any()
    without = v3dg.render(
        asset, camera, device="cpu", min_transmittance=stop, background=background
    )
    is_bare = mesh.coverage == 0
    np.testing.assert_array_equal(image.color[is_bare], without.color[is_bare])


def three_layers(opacities=(0.5, 0.5, 0.5), depths=(1.0, 2.0, 3.0)):
    """Return wide gaussians on the axis of a camera with one pixel, and the camera."""
    means = [[0, 0, depth] for depth in depths]
    camera = scenes.camera(1, 1, fx=1.0)
    return scenes.gaussians(means, scales=100.0, opacities=np.array(opacities)), camera


def one_pixel(depth, coverage=1.0, **planes):
    full = {name: np.full((1, 1), value) for name, value in planes.items()}
    return v3dg.MeshLayer(
        np.full((1, 1, 3), 0.25), np.full((1, 1), depth), np.full((1, 1), coverage), **full
    )


@pytest.mark.parametrize(
    ("depth", "passed"), [(0.5, 1.0), (1.0, 1.0), (1.0001, 0.5), (2.0, 0.5), (9.0, 0.125)]
)
def test_a_gaussian_is_in_front_if_its_depth_is_smaller(depth, passed):
    asset, camera = three_layers()
    image = v3dg.render(
        asset, camera, device="cpu", channels=("weight", "instance"), mesh=one_pixel(depth)
    )
    front = {1.0: 0, 0.5: 0.5, 0.125: 0.875}[passed]
    np.testing.assert_allclose(image.color[0, 0, 0], front * 0.9 + passed * 0.25, atol=1e-3)
    assert image.alpha[0, 0] == 1
    assert image.instance[0, 0] == (v3dg.MESH if passed == 1 else 0)


def test_of_equal_weights_the_first_wins():
    """The mesh has the weight that a gaussian of opacity 1/2 leaves, which is 1/2."""
    asset, camera = three_layers()
    layer = one_pixel(1.5, instance=np.int32(7), label=np.int32(3))
    channels = ("instance", "label", "weight")
    image = v3dg.render(asset, camera, device="cpu", channels=channels, mesh=layer)
    shares = image.weight[0, 0], 1 - image.weight[0, 0]
    expected = (0, -1) if shares[0] >= shares[1] else (7, 3)
    assert (image.instance[0, 0], image.label[0, 0]) == expected
    layer = one_pixel(0.5, 0.5, instance=np.int32(7), label=np.int32(3))
    image = v3dg.render(asset, camera, device="cpu", channels=channels, mesh=layer)
    assert (image.instance[0, 0], image.label[0, 0], image.weight[0, 0]) == (7, 3, 0.5)
    opaque = scenes.gaussians([[0, 0, 1]], scales=100.0, opacities=1.0)
    image = v3dg.render(opaque, camera, device="cpu", channels=channels, mesh=layer)
    assert image.weight[0, 0] == 0.5
    assert image.instance[0, 0] == 7


def test_median_depth_is_where_at_most_half_of_the_light_is_left():
    asset, camera = three_layers(opacities=(0.4, 0.2, 0.1), depths=(1, 2, 3))
    image = v3dg.render(asset, camera, device="cpu", channels=("median_depth",))
    assert image.median_depth[0, 0] == 2
    thin, _ = three_layers(opacities=(0.1, 0.2, 0.1), depths=(1, 2, 3))
    image = v3dg.render(thin, camera, device="cpu", channels=("median_depth",))
    assert image.median_depth[0, 0] == 0
    among = v3dg.render(
        thin, camera, device="cpu", channels=("median_depth",), mesh=one_pixel(1.5, 0.5)
    )
    assert among.median_depth[0, 0] == 1.5


def test_normals_face_the_camera():
    """A disc seen from both sides."""
    disc = scenes.gaussians([[0, 0, 2.0]], scales=[[0.5, 0.5, 0.01]], opacities=0.9)
    camera = scenes.camera(3, 3, fx=3.0)
    turned = scenes.replaced(disc, quats=np.float32([[0, 1, 0, 0]]))
    for asset in (disc, turned):
        image = v3dg.render(asset, camera, device="cpu", channels=("normal",))
        np.testing.assert_allclose(image.normal[1, 1], (0, 0, -1), atol=1e-6)


def test_nothing_drawn_has_no_channels():
    camera = scenes.camera(3, 3, fx=3.0)
    image = v3dg.render(
        scenes.gaussians(np.zeros((0, 3))),
        camera,
        device="cpu",
        channels=(*CHANNELS, "label", "clipped"),
    )
    for plane in (image.normal, image.weight, image.median_depth, image.clipped):
        assert not plane.any()
    for plane in (image.instance, image.label):
        assert (plane == -1).all()


@pytest.mark.parametrize("seed", range(3))
def test_clipped_pixels_are_those_of_the_reference(seed):
    rng = np.random.default_rng(seed)
    camera = scenes.camera(48, 40, fx=40.0, near=0.5, pose=scenes.pose(seed))
    view = rng.uniform((-0.8, -0.8, -0.6), (0.8, 0.8, 1.2), (60, 3))
    means = (view - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    scales = np.exp(rng.uniform(-3.5, -0.9, (60, 3)))
    asset = scenes.gaussians(means, rng.normal(size=(60, 4)), scales, rng.uniform(0.002, 1, 60))
    image = v3dg.render(asset, camera, device="cpu", channels=("clipped",))
    expected, margin = reference.clipped(asset, camera)
    clear = margin > 1e-3
    np.testing.assert_array_equal(image.clipped[clear], expected[clear])
    assert 0.01 < expected.mean() < 0.99
    assert image.clipped.dtype == bool


def test_small_tiles_and_windows_have_every_pixel():
    """Test sizes that are not multiples of a tile or a block."""
    for width, height in ((1, 1), (33, 31), (70, 3)):
        camera = scenes.camera(width, height, fx=30.0)
        asset = with_flat_gaussians(1, camera, 40)
        image = drawn(asset, camera)
        assert_channels_or_empty(image, reference.sense(asset, camera))


def assert_channels_or_empty(image, expected):
    clear = expected.margin > BAND
    np.testing.assert_allclose(image.weight[clear], expected.weight[clear], rtol=2e-4, atol=2e-6)
    np.testing.assert_allclose(
        image.median_depth[clear], expected.median_depth[clear], rtol=2e-5, atol=0
    )


def assert_like_cpu(image, expected, planes):
    """Pixels near a cut-off may differ, as may ids of nearly equal weights."""
    for plane in planes:
        got, wanted = host(getattr(image, plane)), getattr(expected, plane)
        assert got.dtype == wanted.dtype
        error = np.abs(got.astype(np.float64) - wanted) / np.maximum(1, np.abs(wanted))
        assert (error > 2e-3).mean() < 0.01, plane


@pytest.mark.gpu
@pytest.mark.parametrize("stop", STOPS)
@pytest.mark.parametrize("light", ["display", "linear"])
def test_assets_have_the_channels_of_the_cpu_on_a_device(light, stop):
    camera = scenes.CAMERAS["off_centre"]
    asset = scenes.random_gaussians(3, camera, 400, aspect=5.0)
    planes = ("color", "alpha", *CHANNELS)
    options = {"channels": CHANNELS, "min_transmittance": stop, "background": (0.1, 0.2, 0.3)}
    for mesh in (None, layer_of(mesh_in(camera, 5), light)):
        expected = v3dg.render(asset, camera, device="cpu", mesh=mesh, **options)
        image = v3dg.render(asset, camera, device="cuda", mesh=mesh, **options)
        assert_like_cpu(image, expected, planes)
