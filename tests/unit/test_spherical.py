"""Tests equirectangular cameras and LiDARs: rays against float64, seams and poles, cuts
and returns."""

import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from reference import rays as reference_rays
from scenes_lod import blob, lod_bundle, random_scene
from v3dg import Camera, EquirectangularCamera, Gaussians, Lidar, Scene
from v3dg.rotations import rotation_from_quaternion
from v3dg.spherical import RayTable

FULL_TURN = np.linspace(0, 2 * math.pi, 64, endpoint=False)
LIDAR = Lidar(FULL_TURN, np.linspace(-1.2, 1.3, 24), near=0.05)


def pose_of(rng, eye):
    pose = np.eye(4)
    pose[:3, :3] = rotation_from_quaternion(_unit(rng.normal(size=4)))
    pose[:3, 3] = eye
    return pose


def _unit(vector):
    return vector / np.linalg.norm(vector)


def around(rng, count, size):
    """Return gaussians in all directions, many of them at a pole and at the seam of a
    camera in the origin. `size` is their standard deviation as an angle."""
    directions = rng.normal(size=(count, 3))
    directions[: count // 4] = [0, 1, 0] + 0.1 * rng.normal(size=(count // 4, 3))
    directions[count // 4 : count // 2] = [0, -0.2, -1] + 0.1 * rng.normal(size=(count // 4, 3))
    distances = rng.uniform(1, 5, (count, 1))
    means = distances * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return Gaussians(
        means=means.astype(np.float32),
        quats=rng.normal(size=(count, 4)).astype(np.float32),
        scales=(size * distances * np.exp(rng.normal(0, 0.7, (count, 3)))).astype(np.float32),
        opacities=rng.uniform(0.05, 1, count).astype(np.float32),
        sh=rng.normal(0, 0.5, (count, 4, 3)).astype(np.float32),
    )


def dot(point, opacity=0.9, size=0.01, gray=1.0):
    return Gaussians(
        means=np.float32([point]),
        quats=np.float32([[1, 0, 0, 0]]),
        scales=np.full((1, 3), size, np.float32),
        opacities=np.float32([opacity]),
        sh=np.full((1, 1, 3), (gray - 0.5) / 0.28209479, np.float32),
    )


def assert_like(values, reference, cutoff, bound):
    """Compare rays, except for those with an alpha near 1/255, which rounding
    decides."""
    is_clear = cutoff > 1e-3
    assert is_clear.mean() > 0.5
    np.testing.assert_allclose(
        values.reshape(-1, *reference.shape[1:])[is_clear], reference[is_clear], atol=bound
    )


@pytest.mark.parametrize("size", [0.02, 0.2, 0.8])
def test_a_panorama_is_what_rays_in_float64_see(size):
    rng = np.random.default_rng(3)
    gaussians = around(rng, 80, size)
    camera = EquirectangularCamera(np.eye(4), 48)
    image = v3dg.render(gaussians, camera, depth=True)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    directions = camera.directions(np.column_stack([columns.ravel(), rows.ravel()]))
    exact = reference_rays.cast(gaussians, np.zeros(3), directions)
    assert exact.alpha.max() > 0.8
    assert_like(image.color, exact.color, exact.cutoff_distance, 1e-4)
    assert_like(image.alpha, exact.alpha, exact.cutoff_distance, 1e-4)
    assert_like(image.depth, exact.mean_range, exact.cutoff_distance, 2e-3)


def test_directions_of_a_panorama():
    camera = EquirectangularCamera(np.eye(4), 100)
    positions = [[50, 25], [75, 25], [25, 25], [100, 25], [50, 0], [50, 50]]
    expected = [[0, 0, 1], [1, 0, 0], [-1, 0, 0], [0, 0, -1], [0, -1, 0], [0, 1, 0]]
    np.testing.assert_allclose(camera.directions(positions), expected, atol=1e-12)


@pytest.mark.parametrize("direction", [[0.2, 0.1, 1], [0.01, 0.2, -1], [0.3, -3, 0.1], [1, 2, -1]])
def test_a_dot_is_drawn_where_its_direction_is(direction):
    camera = EquirectangularCamera(np.eye(4), 128)
    point = 3 * _unit(np.array(direction))
    image = v3dg.render(dot(point, size=0.1), camera, depth=True)
    row, column = np.unravel_index(image.alpha.argmax(), image.alpha.shape)
    ray = camera.directions([[column + 0.5, row + 0.5]])[0]
    assert ray @ point / 3 > math.cos(2 * math.pi / 128)
    np.testing.assert_allclose(image.depth[row, column], 3, rtol=1e-3)


def test_a_panorama_has_no_seam():
    """If the camera makes half a turn, the picture moves by half of its width across
    the border."""
    rng = np.random.default_rng(5)
    gaussians = around(rng, 100, 0.15)
    first = v3dg.render(gaussians, EquirectangularCamera(np.eye(4), 64))
    turned = v3dg.render(gaussians, EquirectangularCamera(np.diag([-1.0, 1, -1, 1]), 64))
    difference = np.abs(np.roll(turned.color, 32, axis=1) - first.color)
    assert np.quantile(difference, 0.99) < 1e-5
    assert np.abs(first.alpha[:, :1] - first.alpha[:, -1:]).max() < 0.3


def test_a_level_camera_has_up_in_its_first_row():
    camera = Camera.look_at((1, 2, 3), (4, 2, 9), (0, 0, 1), width=64, height=48)
    level = EquirectangularCamera.level(camera, (0, 0, 1), 64)
    np.testing.assert_allclose(level.position, camera.position)
    np.testing.assert_allclose(level.viewmat[1, :3], [0, 0, -1], atol=1e-12)
    with pytest.raises(ValueError, match=r"^up, camera: expected a camera that does not look"):
        EquirectangularCamera.level(camera, (3, 0, 6), 64)


def selected(scene, sensor_spacing, eye, tolerance):
    """Return the gaussians of the cut relative to the eye, their filters in rad², and
    whether their opacities are compensated."""
    focal = 1 / sensor_spacing
    viewmat = np.eye(4)
    viewmat[:3, 3] = -eye
    pinhole = Camera(viewmat, np.diag([focal, focal, 1]), 1, 1)
    cut = v3dg.select(scene, pinhole, tolerance=tolerance, cull=False, device="cpu")
    filters = cut.filters_px2.astype(np.float64) * sensor_spacing**2
    return cut.gaussians(eye, device="cpu"), filters, cut.antialiased


@pytest.mark.parametrize("tolerance", [0.0, 3.0, 400.0])
def test_no_cluster_that_a_scan_sees_is_left_out(tolerance):
    """The rays in float64 pass through all selected gaussians, without any culling."""
    rng = np.random.default_rng(7)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 200, sh_degree=1), 16), 6, spread=3)
    eye = rng.normal(size=3)
    pose = pose_of(rng, eye)
    lidar = Lidar(FULL_TURN[::2], np.linspace(-1.3, 1.3, 12), near=0.02)
    scanned = v3dg.scan(scene, lidar, pose, tolerance=tolerance)
    gaussians, filters, antialiased = selected(scene, lidar.spacing, eye, tolerance)
    assert scanned.gaussians == len(gaussians)
    directions = lidar.directions.reshape(-1, 3) @ pose[:3, :3].T
    exact = reference_rays.cast(
        gaussians,
        np.zeros(3),
        directions,
        filters_rad2=filters,
        antialiased=antialiased,
        near=lidar.near,
    )
    assert (exact.alpha > 0.5).mean() > 0.05
    assert_like(scanned.alpha, exact.alpha, exact.cutoff_distance, 2e-4)
    layers = np.array(
        [reference_rays.returns(ray, lidar.detection, lidar.gap) for ray in exact.contributions]
    )
    values = np.stack([scanned.range.ravel(), scanned.second_range.ravel()], axis=1)
    is_close = np.isclose(values, layers[:, :, 0], rtol=1e-3)
    assert is_close.mean() > 0.99  # rounding decides which gaussian is the median
    light = np.stack([scanned.intensity.ravel(), scanned.second_intensity.ravel()], axis=1)
    assert np.isclose(light, layers[:, :, 2], atol=1e-3).mean() > 0.99


def test_a_ray_does_not_depend_on_the_other_rays():
    """Neither the tiles nor the boxes of directions change a result."""
    rng = np.random.default_rng(8)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 10, spread=3)
    pose = pose_of(rng, [0.3, 0.2, -0.1])
    whole = v3dg.scan(scene, LIDAR, pose)
    for rows, columns in ((slice(3, 5), slice(None)), (slice(None), slice(61, 64)), ([7], [20])):
        part = replace(LIDAR, azimuth=LIDAR.azimuth[columns], elevation=LIDAR.elevation[rows])
        scanned = v3dg.scan(scene, part, pose)
        for name in ("range", "intensity", "second_range", "second_intensity", "alpha"):
            expected = getattr(whole, name)[rows][:, columns]
            np.testing.assert_array_equal(getattr(scanned, name), expected, err_msg=name)


_SCAN = """
import sys, numpy as np, v3dg
from scenes_lod import blob, lod_bundle, random_scene
rng = np.random.default_rng(9)
scene = random_scene(rng, lod_bundle(rng, blob(rng, 400), 16), 12, spread=3)
lidar = v3dg.Lidar(np.linspace(0, 6, 50), np.linspace(-1, 1, 20))
scan = v3dg.scan(scene, lidar, np.eye(4))
sys.stdout.buffer.write(scan.range.tobytes() + scan.alpha.tobytes())
"""


def test_scans_do_not_depend_on_threads():
    outputs = []
    for threads in ("1", "3"):
        environment = os.environ | {
            "OMP_NUM_THREADS": threads,
            "PYTHONPATH": os.pathsep.join(sys.path),
        }
        run = subprocess.run(
            [sys.executable, "-c", _SCAN], env=environment, capture_output=True, check=True
        )
        outputs.append(run.stdout)
    assert len(outputs[0]) == 2 * 4 * 1000
    assert outputs[0] == outputs[1]


def test_tables_may_have_any_order():
    rng = np.random.default_rng(10)
    gaussians = blob(rng, 300, size=3)
    azimuth = rng.permutation(FULL_TURN) - 2 * math.pi
    elevation = rng.permutation(LIDAR.elevation)
    mixed = v3dg.scan(gaussians, replace(LIDAR, azimuth=azimuth, elevation=elevation), np.eye(4))
    plain = v3dg.scan(gaussians, LIDAR, np.eye(4))
    rows = np.searchsorted(LIDAR.elevation, elevation)
    columns = np.rint((azimuth + 2 * math.pi) / FULL_TURN[1]).astype(int)
    np.testing.assert_allclose(mixed.range, plain.range[rows][:, columns], rtol=1e-5)
    table = RayTable.of(np.array([-1e-17, 1.0]), np.zeros(1))
    assert table.azimuth.max() < 2 * math.pi


def lidar_at(azimuths, **changes):
    return Lidar(np.array(azimuths), np.zeros(1), spacing=1e-3, **changes)


def test_returns_are_layers_of_light():
    leaf = dot((5, 0, 0), opacity=0.4, gray=0.5)
    branch = dot((5.2, 0, 0), opacity=0.5, gray=0.5)
    wall = dot((9, 0, 0), opacity=0.9, gray=1.0)
    dust = dot((2, 0, 0), opacity=0.05, gray=1.0)
    scene = v3dg.join([dust, leaf, branch, wall])
    scanned = v3dg.scan(scene, lidar_at([0.0], gap=0.5, detection=0.1), np.eye(4))
    # The dust is below the detection, so that it counts towards the next layer.
    weights = 0.05, 0.95 * 0.4, 0.95 * 0.6 * 0.5, 0.95 * 0.6 * 0.5 * 0.9
    np.testing.assert_allclose(scanned.range, 5, rtol=1e-5)
    np.testing.assert_allclose(
        scanned.intensity, weights[0] + 0.5 * (weights[1] + weights[2]), rtol=1e-4
    )
    np.testing.assert_allclose(scanned.second_range, 9, rtol=1e-5)
    np.testing.assert_allclose(scanned.second_intensity, weights[3], rtol=1e-4)
    np.testing.assert_allclose(scanned.alpha, sum(weights), rtol=1e-4)
    split = v3dg.scan(scene, lidar_at([0.0], gap=0.1, detection=0.01), np.eye(4))
    np.testing.assert_allclose([split.range[0, 0], split.second_range[0, 0]], [2, 5], rtol=1e-5)


def test_points_are_in_the_world():
    rng = np.random.default_rng(11)
    pose = pose_of(rng, [3, -2, 1])
    lidar = lidar_at([0.0, 1.0, 2.5])
    places = lidar.directions[0] * np.array([[4.0], [6], [5]])
    world = places @ pose[:3, :3].T + pose[:3, 3]
    scene = v3dg.join([dot(point, size=0.05) for point in world[:2]])
    scanned = v3dg.scan(scene, lidar, pose)
    np.testing.assert_allclose(scanned.points(), world[:2], atol=1e-4)
    assert np.isinf(scanned.range[0, 2])
    assert scanned.second_points().shape == (0, 3)
    assert scanned.intensity[0, 2] == 0


def test_only_places_between_near_and_far_are_hit():
    dots = v3dg.join([dot((x, 0, 0), size=0.001 * x) for x in (1.0, 2.0, 4.0)])
    ranges = {
        (0.1, math.inf): 1,
        (1.5, math.inf): 2,
        (1.5, 3.0): 2,
        (2.5, 3.0): math.inf,
    }
    for (near, far), expected in ranges.items():
        scanned = v3dg.scan(dots, lidar_at([0.0], near=near, far=far), np.eye(4))
        np.testing.assert_allclose(scanned.range, expected, rtol=1e-5)


def test_an_eye_inside_a_gaussian_sees_it_in_front_only():
    cloud = dot((0.5, 0, 0), size=1.0)
    scanned = v3dg.scan(cloud, lidar_at([0.0, math.pi]), np.eye(4))
    np.testing.assert_allclose(scanned.range[0, 0], 0.5, rtol=1e-4)
    assert np.isinf(scanned.range[0, 1])


@pytest.mark.parametrize("broken", ["means", "quats", "scales", "opacities"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_gaussians_that_are_not_finite_are_not_hit(broken, value):
    gaussians = dot((3, 0, 0), size=0.1)
    getattr(gaussians, broken)[:] = value
    scanned = v3dg.scan(gaussians, lidar_at([0.0, 1.0, 4.0]), np.eye(4))
    assert (scanned.alpha == 0).all()


def test_factors_of_instances_and_weights_count():
    rng = np.random.default_rng(12)
    bundle = lod_bundle(rng, blob(rng, 200), 16)
    scene = Scene()
    scene.add(bundle, positions=[[4.0, 0, 0]])
    plain = v3dg.scan(scene, LIDAR, np.eye(4))
    scene.set_opacity(0.25)
    faint = v3dg.scan(scene, LIDAR, np.eye(4))
    assert 0 < faint.alpha.max() < plain.alpha.max()


def test_several_poses_are_several_scans():
    gaussians = dot((3, 0, 0), size=0.1)
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1
    first, second = v3dg.scan(gaussians, lidar_at([0.0]), poses)
    np.testing.assert_allclose([first.range[0, 0], second.range[0, 0]], [3, 2], rtol=1e-5)


ERRORS = {
    "azimuth: expected 1 to": lambda: Lidar(np.zeros((2, 2)), np.zeros(1)),
    "azimuth: expected finite": lambda: Lidar(np.array([math.nan]), np.zeros(1)),
    "elevation: expected radians": lambda: Lidar(np.zeros(1), np.array([2.0])),
    "spacing: expected an angle": lambda: Lidar(np.zeros(1), np.zeros(1)),
    "near, far: expected near up to far": lambda: replace(LIDAR, far=0.01),
    "gap: expected a positive": lambda: replace(LIDAR, gap=0),
    "detection: expected a share": lambda: replace(LIDAR, detection=0),
    "width: expected an even": lambda: EquirectangularCamera(np.eye(4), 33),
    "viewmat: expected a rotation": lambda: EquirectangularCamera(2 * np.eye(4), 32),
    "pose: expected shape": lambda: v3dg.scan(dot((1, 0, 0)), LIDAR, np.eye(3)),
    "pose: expected a rotation": lambda: v3dg.scan(dot((1, 0, 0)), LIDAR, np.diag([1.0, 1, -1, 1])),
    "pose[1]: expected the last row": lambda: v3dg.scan(
        dot((1, 0, 0)), LIDAR, [np.eye(4), np.ones((4, 4))]
    ),
    "budget: expected none": lambda: v3dg.render(
        dot((1, 0, 0)), EquirectangularCamera(np.eye(4), 32), budget=3
    ),
    "memory: expected 'auto' or None": lambda: v3dg.render(
        dot((1, 0, 0)), EquirectangularCamera(np.eye(4), 32), memory=10**9
    ),
    "channels, mesh: expected none": lambda: v3dg.render(
        dot((1, 0, 0)), EquirectangularCamera(np.eye(4), 32), channels=["normal"]
    ),
    "min_transmittance: expected None": lambda: v3dg.render(
        dot((1, 0, 0)), EquirectangularCamera(np.eye(4), 32), min_transmittance=0.1
    ),
    "color_by: expected 'appearance'": lambda: v3dg.render(
        dot((1, 0, 0)), EquirectangularCamera(np.eye(4), 32), color_by="level"
    ),
}


@pytest.mark.parametrize("message", ERRORS)
def test_wrong_values_are_one_clear_error(message):
    with pytest.raises(ValueError, match="^" + message.replace("[", r"\[")) as error:
        ERRORS[message]()
    assert "\n" not in str(error.value)


@pytest.mark.gpu
def test_rays_on_a_cuda_device_are_refused():
    camera = EquirectangularCamera(np.eye(4), 32)
    with pytest.raises(ValueError, match=r"^device: expected 'cpu' or 'auto'"):
        v3dg.render(dot((1, 0, 0)), camera, device="cuda")
    with pytest.raises(ValueError, match=r"^device: expected 'cpu' or 'auto'"):
        v3dg.scan(dot((1, 0, 0)), LIDAR, np.eye(4), device="cuda")
