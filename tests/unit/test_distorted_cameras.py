"""Tests cameras with lens distortion: where gaussians are drawn, and which functions
accept the cameras."""

import math
import pickle
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from devices import host, on
from frames import assert_like_cpu, assert_same_bytes
from scenes_lod import blob, lod_bundle, random_camera, random_scene
from v3dg import Camera, Gaussians, StereoCamera, select

K = np.array([[150.0, 0, 103], [0, 140, 55], [0, 0, 1]])
# The order is that of OpenCV: k1, k2, p1, p2, k3 to k6.
LENSES = {
    "barrel": ("OPENCV", (-0.12, 0.01, 1e-3, -2e-3)),
    "pincushion": ("OPENCV", (0.12, 0.02, -1e-3, 1e-3, 0.005)),
    "rational": ("OPENCV", (0.3, 0.02, 3e-4, 2e-4, -0.001, 0.4, 0.05, 0.002)),
    "fisheye": ("OPENCV_FISHEYE", (0.05, -0.01, 0.002, -0.0005)),
}


def camera_of(lens, **changes):
    model, distortion = LENSES[lens]
    camera = Camera(np.eye(4), K, 200, 120, distortion=distortion, model=model)
    return replace(camera, **changes)


@pytest.fixture(params=LENSES)
def lens(request):
    return request.param


def image_of(camera, point):
    """Return the image of a point, by OpenCV's documentation."""
    x, y, z = point
    if camera.model == "OPENCV_FISHEYE":
        angle = math.atan2(math.hypot(x, y), z)
        k1, k2, k3, k4 = camera.distortion
        bent = angle * (1 + k1 * angle**2 + k2 * angle**4 + k3 * angle**6 + k4 * angle**8)
        x, y = np.array([x, y]) * bent / math.hypot(x, y)
    else:
        x, y = x / z, y / z
        k1, k2, p1, p2, k3, k4, k5, k6 = (*camera.distortion, 0, 0, 0, 0)[:8]
        s = x * x + y * y
        factor = (1 + k1 * s + k2 * s**2 + k3 * s**3) / (1 + k4 * s + k5 * s**2 + k6 * s**3)
        x, y = (
            x * factor + 2 * p1 * x * y + p2 * (s + 2 * x * x),
            y * factor + p1 * (s + 2 * y * y) + 2 * p2 * x * y,
        )
    return np.array([camera.fx * x + camera.cx, camera.fy * y + camera.cy])


def dots(points, size=1e-4):
    """Return white gaussians that are points, except for a filter."""
    n = len(points)
    return Gaussians(
        means=np.asarray(points, np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (n, 1)),
        scales=np.full((n, 3), size, np.float32),
        opacities=np.full(n, 0.9, np.float32),
        sh=np.full((n, 1, 3), 0.5 / 0.28209479, np.float32),
    )


def test_points_are_drawn_where_opencv_has_them(lens, device):
    camera = camera_of(lens)
    for position in ([30.2, 20.7], [103.0, 55.0], [180.9, 100.1], [60.0, 110.0]):
        direction = camera.directions([position])[0]
        point = 3.0 * direction
        if np.hypot(*point[:2]) > 0:
            np.testing.assert_allclose(image_of(camera, point), position, atol=1e-6)
        image = v3dg.rasterize(on(device, dots([point])), camera, filter_px2=1.0)
        alpha = host(image.alpha).astype(np.float64)
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        center = [(columns * alpha).sum() / alpha.sum(), (rows * alpha).sum() / alpha.sum()]
        np.testing.assert_allclose(center, position, atol=0.02)
        depth = host(image.depth)[alpha > 0.5]
        np.testing.assert_allclose(depth, 3.0, rtol=1e-5)


def test_nothing_is_drawn_beyond_the_first_fold(device):
    # The image of this lens folds back at a slope of 1 / sqrt(1.2).
    folding = Camera(np.eye(4), K, 200, 120, distortion=(-0.4, 0, 0, 0), model="OPENCV")
    beyond = [1.4, 0.0, 1.0]
    u, v = image_of(folding, beyond)
    assert 0 < u < 200
    assert 0 < v < 120
    seen = v3dg.rasterize(on(device, dots([[0.5, 0, 1.0]])), folding, filter_px2=1.0)
    hidden = v3dg.rasterize(on(device, dots([beyond])), folding, filter_px2=1.0)
    assert host(seen.alpha).max() > 0.5
    assert host(hidden.alpha).max() == 0


def test_a_fisheye_sees_behind_itself(device):
    wide = np.array([[40.0, 0, 100], [0, 40, 100], [0, 0, 1]])
    camera = Camera(np.eye(4), wide, 200, 200, distortion=(0, 0, 0, 0), model="OPENCV_FISHEYE")
    behind = [math.sin(2.2), 0, math.cos(2.2)]
    image = v3dg.rasterize(on(device, dots([behind])), camera, filter_px2=1.0)
    row, column = np.unravel_index(host(image.alpha).argmax(), (200, 200))
    assert (row, column) in {(99, 187), (99, 188), (100, 187), (100, 188)}


def test_a_lens_without_distortion_is_a_pinhole():
    plain = Camera(np.eye(4), K, 200, 120)
    zeros = Camera(np.eye(4), K, 200, 120, distortion=(0, 0, 0, 0), model="OPENCV")
    gaussians = blob(np.random.default_rng(0), 200, origin=(0, 0, 4))
    assert_same_bytes(v3dg.rasterize(gaussians, zeros), v3dg.rasterize(gaussians, plain))
    assert not zeros.is_distorted


def scene_around(rng):
    return random_scene(rng, lod_bundle(rng, blob(rng, 600), 16), 40, spread=6)


def views(rng, lens, count):
    model, distortion = LENSES[lens]
    for _ in range(count):
        view = random_camera(rng, distance=rng.uniform(0.5, 8))
        yield replace(view, distortion=distortion, model=model)


def test_culling_drops_nothing_that_is_seen(lens):
    rng = np.random.default_rng(5)
    scene = scene_around(rng)
    dropped = 0
    for camera in views(rng, lens, 12):
        drawn = select(scene, camera, tolerance=2, cull=True, device="cpu")
        everything = select(scene, camera, tolerance=2, cull=False, device="cpu")
        dropped += len(everything.cluster_ids) - len(drawn.cluster_ids)
        image = v3dg.render(scene, camera, cut=drawn, device="cpu")
        assert_same_bytes_of_color(image, v3dg.render(scene, camera, cut=everything, device="cpu"))
    assert dropped > 0


def assert_same_bytes_of_color(image, other):
    np.testing.assert_array_equal(image.color, other.color)
    np.testing.assert_array_equal(image.alpha, other.alpha)


def test_cuts_are_fine_enough_everywhere_in_the_image(lens):
    """Selection assumes a density of px² per steradian that no pixel exceeds. The
    growth towards the borders is ignored, as for pinholes."""
    camera = camera_of(lens)
    rng = np.random.default_rng(1)
    center = rng.uniform((1, 1), (camera.width - 1, camera.height - 1), (500, 2))
    corners = [camera.directions(center + shift) for shift in ([0, 0], [0.1, 0], [0, 0.1])]
    is_seen = np.isfinite(corners).all(axis=(0, 2))
    first, right, below = (c[is_seen] for c in corners)
    # For OPENCV, the areas are on the plane at depth 1.
    area = np.linalg.norm(np.cross(right - first, below - first), axis=1)
    assert camera.core.px2_per_steradian >= (0.01 / area).max() * (1 - 1e-3)


def test_several_cameras_are_drawn_as_if_alone(lens):
    scene = scene_around(np.random.default_rng(4))
    cameras = [camera_of(lens), camera_of(lens)]
    options = {"tolerance": 2, "device": "cpu"}
    for image in v3dg.render(scene, cameras, **options):
        assert_same_bytes_of_color(image, v3dg.render(scene, cameras[0], **options))


@pytest.mark.gpu
def test_cuda_draws_what_the_cpu_draws(lens):
    rng = np.random.default_rng(6)
    scene = scene_around(rng)
    for camera in views(rng, lens, 3):
        images = [
            v3dg.render(scene, camera, tolerance=2, depth=True, device=device)
            for device in ("cuda", "cpu")
        ]
        assert_like_cpu(*images)


@pytest.mark.gpu
def test_cuda_selects_what_the_cpu_selects(lens):
    rng = np.random.default_rng(7)
    scene = scene_around(rng)
    for camera in views(rng, lens, 6):
        cuts = [select(scene, camera, tolerance=2, device=device) for device in ("cuda", "cpu")]
        for name in ("instance_ids", "cluster_ids"):
            np.testing.assert_array_equal(*(host(getattr(cut, name)) for cut in cuts))


def test_gradients_are_those_of_finite_differences(lens):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(8)
    camera = camera_of(lens, width=40, height=24, K=np.diag([0.2, 0.2, 1]) @ K)
    source = blob(rng, 12, origin=(0, 0, 3), size=0.5)
    names = ("means", "quats", "scales", "opacities")
    arrays = [
        torch.tensor(getattr(source, name), dtype=torch.float64, requires_grad=True)
        for name in names
    ]
    sh = torch.tensor(source.sh, dtype=torch.float64)
    weight = torch.tensor(rng.normal(size=(24, 40, 3)))

    def loss(*values):
        gaussians = Gaussians(**dict(zip(names, values, strict=True)), sh=sh)
        image = v3dg.rasterize(gaussians, camera, filter_px2=0.3)
        return (image.color * weight).sum() + (image.depth * weight[..., 0]).sum()

    loss(*arrays).backward()
    for index, array in enumerate(arrays):
        direction = torch.tensor(rng.normal(size=tuple(array.shape)))
        step = 1e-6
        shifted = []
        for sign in (1, -1):
            values = [a.detach() for a in arrays]
            values[index] = values[index] + sign * step * direction
            shifted.append(float(loss(*values)))
        slope = (shifted[0] - shifted[1]) / (2 * step)
        assert float((array.grad * direction).sum()) == pytest.approx(slope, rel=1e-5, abs=1e-5)


@pytest.mark.gpu
def test_gradients_on_cuda_are_those_of_the_cpu(lens):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(9)
    camera = camera_of(lens)
    source = blob(rng, 200, origin=(0, 0, 3), size=0.7)
    gradients = []
    for device in ("cpu", "cuda"):
        gaussians = source.torch(device)
        gaussians.means.requires_grad_(True)
        gaussians.scales.requires_grad_(True)
        image = v3dg.rasterize(gaussians, camera, filter_px2=0.3)
        (image.color.sum() + image.depth.sum()).backward()
        gradients.append([host(gaussians.means.grad), host(gaussians.scales.grad)])
    for got, expected in zip(*gradients, strict=True):
        assert np.linalg.norm(got - expected) <= 2e-3 * np.linalg.norm(expected)
    assert torch.isfinite(torch.tensor(gradients[0][0])).all()


def test_a_pick_is_on_the_ray_of_its_pixel(lens):
    rng = np.random.default_rng(3)
    scene = scene_around(rng)
    found = 0
    for camera in views(rng, lens, 4):
        for x, y in rng.integers(0, (camera.width, camera.height), (10, 2)):
            pick = v3dg.pick(scene, camera, int(x), int(y), tolerance=2)
            if pick is None or np.isnan(camera.directions([[x + 0.5, y + 0.5]])).any():
                continue
            point = camera.viewmat[:3, :3] @ (pick.position - camera.position)
            np.testing.assert_allclose(image_of(camera, point), [x + 0.5, y + 0.5], atol=1e-4)
            found += 1
    assert found > 5


def test_directions_are_those_that_opencv_maps_back(lens):
    camera = camera_of(lens)
    positions = np.random.default_rng(2).uniform((0, 0), (200, 120), (50, 2))
    for position, direction in zip(positions, camera.directions(positions), strict=True):
        np.testing.assert_allclose(image_of(camera, direction), position, atol=1e-6)


def test_a_corner_that_a_lens_does_not_show_has_no_direction():
    folding = Camera(np.eye(4), K, 200, 120, distortion=(-0.9, 0, 0, 0), model="OPENCV")
    assert np.isnan(folding.directions([[0.5, 0.5]])).all()
    assert np.isfinite(folding.directions([[103.0, 55.0]])).all()


def test_a_larger_picture_has_the_same_lens(lens):
    camera = camera_of(lens)
    double = camera.scaled(2)
    positions = np.array([[20.0, 30.0], [150.0, 90.0]])
    np.testing.assert_allclose(
        double.directions(2 * positions), camera.directions(positions), atol=1e-12
    )


def test_cameras_survive_pickling(lens):
    camera = pickle.loads(pickle.dumps(camera_of(lens)))
    assert (camera.distortion, camera.model) == tuple(LENSES[lens])[::-1]


BAD = {
    "three coefficients": (
        {"distortion": (0.1, 0, 0), "model": "OPENCV"},
        "distortion: expected 4 or 5 or 8 coefficients of OPENCV, got 3",
    ),
    "of a pinhole": ({"distortion": (0.1,) * 4}, "distortion: expected 0 coefficients of PINHOLE"),
    "not finite": (
        {"distortion": (math.nan, 0, 0, 0), "model": "OPENCV"},
        "distortion: expected ",
    ),
    "unknown model": ({"model": "FOV"}, "model: expected 'PINHOLE' or 'OPENCV' or"),
}


@pytest.mark.parametrize("case", BAD)
def test_wrong_lenses_are_refused(case):
    changes, message = BAD[case]
    with pytest.raises(ValueError, match="^" + message):
        Camera(np.eye(4), K, 200, 120, **changes)


def test_a_batch_of_lenses_is_drawn_as_its_cameras_alone(lens):
    rng = np.random.default_rng(4)
    scene = scene_around(rng)
    cameras = [
        *views(rng, lens, 2),
        replace(next(views(rng, lens, 1)), distortion=(), model="PINHOLE"),
    ]
    renderer = v3dg.Renderer(scene, device="cpu", memory=None)
    batch = renderer.render_batch(v3dg.CameraBatch.of(cameras), depth=True)
    for number, camera in enumerate(cameras):
        alone = renderer.render(camera, depth=True)
        assert alone.alpha.max() > 0.5
        assert_same_bytes(batch[number], alone)
        rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
        directions = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
        lengths = np.nan_to_num(np.linalg.norm(directions, axis=1)).reshape(rows.shape)
        distance = batch.distance[number]
        np.testing.assert_allclose(distance, alone.depth * lengths, rtol=1e-5)
        assert (distance > 0).any()
    with pytest.raises(ValueError, match=r"^channels: 'clipped' needs a pinhole camera"):
        renderer.render_batch(v3dg.CameraBatch.of(cameras), channels=["clipped"])


@pytest.mark.gpu
def test_a_batch_of_lenses_is_refused_on_cuda(lens):
    camera = camera_of(lens)
    rng = np.random.default_rng(0)
    renderer = v3dg.Renderer(lod_bundle(rng, blob(rng, 100), 16), device="cuda", memory=None)
    with pytest.raises(ValueError, match=r"^cameras: expected pinholes on a CUDA device"):
        renderer.render_batch(v3dg.CameraBatch.of([camera, camera]))


def test_what_needs_a_pinhole_says_so(lens):
    camera = camera_of(lens)
    rng = np.random.default_rng(0)
    bundle = lod_bundle(rng, blob(rng, 100), 16)
    with pytest.raises(ValueError, match=r"^left: expected a pinhole, got OPENCV"):
        StereoCamera.of(camera, 0.06)
    with pytest.raises(ValueError, match=r"^footprint: expected 'solid_angle' for a distorted"):
        select(bundle, camera, footprint="paper", device="cpu")
    with pytest.raises(ValueError, match=r"^cameras\[0\]: expected a pinhole, got OPENCV"):
        v3dg.refine_bundle(bundle, cameras=[camera], steps=1)
