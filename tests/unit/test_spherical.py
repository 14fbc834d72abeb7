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
from devices import host
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


PLANES = ("range", "intensity", "second_range", "second_intensity", "alpha")


def scanned_on(device, subject, lidar, pose, **options):
    """Return a scan whose arrays are NumPy's."""
    made = v3dg.scan(subject, lidar, pose, device=device, **options)
    return replace(made, **{name: host(getattr(made, name)) for name in PLANES})


def drawn_on(device, subject, camera, **options):
    """Return colour, alpha and, if requested, depth as NumPy arrays."""
    image = v3dg.render(subject, camera, device=device, **options)
    depth = None
    if options.get("depth"):
        depth = host(image.depth)
    return v3dg.Image(host(image.color), host(image.alpha), depth)


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
def test_a_panorama_is_what_rays_in_float64_see(device, size):
    rng = np.random.default_rng(3)
    gaussians = around(rng, 80, size)
    camera = EquirectangularCamera(np.eye(4), 48)
    image = drawn_on(device, gaussians, camera, depth=True)
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
def test_a_dot_is_drawn_where_its_direction_is(device, direction):
    camera = EquirectangularCamera(np.eye(4), 128)
    point = 3 * _unit(np.array(direction))
    image = drawn_on(device, dot(point, size=0.1), camera, depth=True)
    row, column = np.unravel_index(image.alpha.argmax(), image.alpha.shape)
    ray = camera.directions([[column + 0.5, row + 0.5]])[0]
    assert ray @ point / 3 > math.cos(2 * math.pi / 128)
    np.testing.assert_allclose(image.depth[row, column], 3, rtol=1e-3)


def test_a_panorama_has_no_seam(device):
    """If the camera makes half a turn, the picture moves by half of its width across
    the border."""
    rng = np.random.default_rng(5)
    gaussians = around(rng, 100, 0.15)
    first = drawn_on(device, gaussians, EquirectangularCamera(np.eye(4), 64))
    turned = drawn_on(device, gaussians, EquirectangularCamera(np.diag([-1.0, 1, -1, 1]), 64))
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
def test_no_cluster_that_a_scan_sees_is_left_out(device, tolerance):
    """The rays in float64 pass through all selected gaussians, without any culling."""
    rng = np.random.default_rng(7)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 200, sh_degree=1), 16), 6, spread=3)
    eye = rng.normal(size=3)
    pose = pose_of(rng, eye)
    lidar = Lidar(FULL_TURN[::2], np.linspace(-1.3, 1.3, 12), near=0.02)
    scanned = scanned_on(device, scene, lidar, pose, tolerance=tolerance)
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


def test_a_ray_does_not_depend_on_the_other_rays(device):
    """Neither the tiles nor the boxes of directions change a result."""
    rng = np.random.default_rng(8)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 10, spread=3)
    pose = pose_of(rng, [0.3, 0.2, -0.1])
    whole = scanned_on(device, scene, LIDAR, pose)
    for rows, columns in ((slice(3, 5), slice(None)), (slice(None), slice(61, 64)), ([7], [20])):
        part = replace(LIDAR, azimuth=LIDAR.azimuth[columns], elevation=LIDAR.elevation[rows])
        scanned = scanned_on(device, scene, part, pose)
        for name in PLANES:
            expected = getattr(whole, name)[rows][:, columns]
            np.testing.assert_array_equal(getattr(scanned, name), expected, err_msg=name)


_SCAN = """
import sys, numpy as np, v3dg
from scenes_lod import blob, lod_bundle, random_scene
rng = np.random.default_rng(9)
scene = random_scene(rng, lod_bundle(rng, blob(rng, 400), 16), 12, spread=3)
lidar = v3dg.Lidar(np.linspace(0, 6, 50), np.linspace(-1, 1, 20))
scan = v3dg.scan(scene, lidar, np.eye(4), device="cpu")
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


def test_tables_may_have_any_order(device):
    rng = np.random.default_rng(10)
    gaussians = blob(rng, 300, size=3)
    azimuth = rng.permutation(FULL_TURN) - 2 * math.pi
    elevation = rng.permutation(LIDAR.elevation)
    mixed = scanned_on(
        device, gaussians, replace(LIDAR, azimuth=azimuth, elevation=elevation), np.eye(4)
    )
    plain = scanned_on(device, gaussians, LIDAR, np.eye(4))
    rows = np.searchsorted(LIDAR.elevation, elevation)
    columns = np.rint((azimuth + 2 * math.pi) / FULL_TURN[1]).astype(int)
    np.testing.assert_allclose(mixed.range, plain.range[rows][:, columns], rtol=1e-5)
    table = RayTable.of(np.array([-1e-17, 1.0]), np.zeros(1))
    assert table.azimuth.max() < 2 * math.pi


def lidar_at(azimuths, **changes):
    return Lidar(np.array(azimuths), np.zeros(1), spacing=1e-3, **changes)


def test_returns_are_layers_of_light(device):
    leaf = dot((5, 0, 0), opacity=0.4, gray=0.5)
    branch = dot((5.2, 0, 0), opacity=0.5, gray=0.5)
    wall = dot((9, 0, 0), opacity=0.9, gray=1.0)
    dust = dot((2, 0, 0), opacity=0.05, gray=1.0)
    scene = v3dg.join([dust, leaf, branch, wall])
    scanned = scanned_on(device, scene, lidar_at([0.0], gap=0.5, detection=0.1), np.eye(4))
    # The dust is below the detection, so that it counts towards the next layer.
    weights = 0.05, 0.95 * 0.4, 0.95 * 0.6 * 0.5, 0.95 * 0.6 * 0.5 * 0.9
    np.testing.assert_allclose(scanned.range, 5, rtol=1e-5)
    np.testing.assert_allclose(
        scanned.intensity, weights[0] + 0.5 * (weights[1] + weights[2]), rtol=1e-4
    )
    np.testing.assert_allclose(scanned.second_range, 9, rtol=1e-5)
    np.testing.assert_allclose(scanned.second_intensity, weights[3], rtol=1e-4)
    np.testing.assert_allclose(scanned.alpha, sum(weights), rtol=1e-4)
    split = scanned_on(device, scene, lidar_at([0.0], gap=0.1, detection=0.01), np.eye(4))
    np.testing.assert_allclose([split.range[0, 0], split.second_range[0, 0]], [2, 5], rtol=1e-5)


def test_points_are_in_the_world(device):
    rng = np.random.default_rng(11)
    pose = pose_of(rng, [3, -2, 1])
    lidar = lidar_at([0.0, 1.0, 2.5])
    places = lidar.directions[0] * np.array([[4.0], [6], [5]])
    world = places @ pose[:3, :3].T + pose[:3, 3]
    scene = v3dg.join([dot(point, size=0.05) for point in world[:2]])
    scanned = v3dg.scan(scene, lidar, pose, device=device)
    np.testing.assert_allclose(host(scanned.points()), world[:2], atol=1e-4)
    assert np.isinf(host(scanned.range)[0, 2])
    assert scanned.second_points().shape == (0, 3)
    assert host(scanned.intensity)[0, 2] == 0


def test_only_places_between_near_and_far_are_hit(device):
    dots = v3dg.join([dot((x, 0, 0), size=0.001 * x) for x in (1.0, 2.0, 4.0)])
    ranges = {
        (0.1, math.inf): 1,
        (1.5, math.inf): 2,
        (1.5, 3.0): 2,
        (2.5, 3.0): math.inf,
    }
    for (near, far), expected in ranges.items():
        scanned = scanned_on(device, dots, lidar_at([0.0], near=near, far=far), np.eye(4))
        np.testing.assert_allclose(scanned.range, expected, rtol=1e-5)


def test_an_eye_inside_a_gaussian_sees_it_in_front_only(device):
    cloud = dot((0.5, 0, 0), size=1.0)
    scanned = scanned_on(device, cloud, lidar_at([0.0, math.pi]), np.eye(4))
    np.testing.assert_allclose(scanned.range[0, 0], 0.5, rtol=1e-4)
    assert np.isinf(scanned.range[0, 1])


@pytest.mark.parametrize("broken", ["means", "quats", "scales", "opacities"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_gaussians_that_are_not_finite_are_not_hit(device, broken, value):
    gaussians = dot((3, 0, 0), size=0.1)
    getattr(gaussians, broken)[:] = value
    scanned = scanned_on(device, gaussians, lidar_at([0.0, 1.0, 4.0]), np.eye(4))
    assert (scanned.alpha == 0).all()


def test_factors_of_instances_and_weights_count(device):
    rng = np.random.default_rng(12)
    bundle = lod_bundle(rng, blob(rng, 200), 16)
    scene = Scene()
    scene.add(bundle, positions=[[4.0, 0, 0]])
    plain = scanned_on(device, scene, LIDAR, np.eye(4))
    scene.set_opacity(0.25)
    faint = scanned_on(device, scene, LIDAR, np.eye(4))
    assert 0 < faint.alpha.max() < plain.alpha.max()


def test_several_poses_are_several_scans(device):
    rng = np.random.default_rng(13)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 10, spread=3)
    poses = np.stack([pose_of(rng, rng.normal(size=3)) for _ in range(5)])
    batch = v3dg.scan(scene, LIDAR, poses, device=device)
    assert len(batch) == len(batch.gaussians) == 5
    assert batch.alpha.max() > 0.5
    for pose, of_batch in zip(poses, batch, strict=True):
        alone = v3dg.scan(scene, LIDAR, pose, device=device)
        assert of_batch.gaussians == alone.gaussians
        np.testing.assert_array_equal(of_batch.pose, pose)
        for name in PLANES:
            expected = host(getattr(alone, name))
            np.testing.assert_array_equal(host(getattr(of_batch, name)), expected, err_msg=name)
    assert [scan.gaussians for scan in batch[1:3]] == batch.gaussians[1:3]
    with pytest.raises(IndexError, match=r"^number: expected one of 5 scans, got 5"):
        batch[5]


def part_of(scene, environment):
    """Return the shared instances, then those of an environment."""
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


def test_a_sensor_sees_its_environment_and_what_is_shared(device):
    rng = np.random.default_rng(20)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 24, spread=3)
    scene.set_environment(rng.permutation(np.repeat([-1, 0, 1, 3], 6)))
    poses = np.stack([pose_of(rng, rng.normal(size=3)) for _ in range(5)])
    environment = [0, 3, -1, 2, 1]
    batch = v3dg.scan(scene, LIDAR, poses, environment=environment, device=device)
    alone = [
        v3dg.scan(part_of(scene, number), LIDAR, pose, device=device)
        for number, pose in zip(environment, poses, strict=True)
    ]
    one = v3dg.scan(scene, LIDAR, poses[1], environment=3, device=device)
    same = v3dg.scan(scene, LIDAR, poses[:2], environment=3, device=device)
    assert batch.gaussians == [scan.gaussians for scan in alone]
    for name in PLANES:
        expected = np.stack([host(getattr(scan, name)) for scan in alone])
        np.testing.assert_array_equal(host(getattr(batch, name)), expected, err_msg=name)
        np.testing.assert_array_equal(host(getattr(one, name)), expected[1], err_msg=name)
        np.testing.assert_array_equal(host(getattr(same, name))[1], expected[1], err_msg=name)
    everything = v3dg.scan(scene, LIDAR, poses[0], device=device)
    assert everything.gaussians > alone[0].gaussians


def test_many_hits_at_one_place_are_blended_in_order(device):
    """More gaussians than a window holds reach from the eye to beyond the wall, so that
    nothing is certain to be in front of anything."""
    rng = np.random.default_rng(14)
    count = 600
    axis = np.array([1.0, 0.3, 0.1]) / math.sqrt(1.1)
    distances = np.append(rng.uniform(2, 6, count - 1), 4.0)
    gaussians = Gaussians(
        means=np.float32(distances[:, None] * axis),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.tile(np.float32([3, 0.4, 0.4]), (count, 1)),
        opacities=np.full(count, 0.02, np.float32),
        sh=rng.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )
    lidar = Lidar(np.linspace(-0.5, 1.0, 40), np.linspace(-0.5, 0.7, 20), near=0.01)
    scanned = scanned_on(device, gaussians, lidar, np.eye(4))
    exact = reference_rays.cast(
        gaussians, np.zeros(3), lidar.directions.reshape(-1, 3), near=lidar.near
    )
    assert max(len(ray) for ray in exact.contributions) > 300
    assert_like(scanned.alpha, exact.alpha, exact.cutoff_distance, 2e-4)
    layers = np.array(
        [reference_rays.returns(ray, lidar.detection, lidar.gap) for ray in exact.contributions]
    )
    ranges = np.stack([scanned.range.ravel(), scanned.second_range.ravel()], axis=1)
    assert np.isclose(ranges, layers[:, :, 0], rtol=1e-3).mean() > 0.95
    light = np.stack([scanned.intensity.ravel(), scanned.second_intensity.ravel()], axis=1)
    assert np.isclose(light, layers[:, :, 2], atol=2e-3).mean() > 0.95


@pytest.mark.parametrize("columns", [7, 400])
def test_flat_gaussians_seen_from_the_side_are_blended_in_order(device, columns):
    """Across a disc of a floor, the distances of the hits change by more than its
    distance from the next disc."""
    rng = np.random.default_rng(23)
    count = 400
    angles = rng.uniform(-math.pi, math.pi, count)
    radii = rng.uniform(1, 6, count)
    heights = np.full(count, -0.4) + rng.normal(0, 0.01, count)
    means = np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
    quats = np.stack([np.ones(count), *rng.normal(0, 0.05, (3, count))], axis=1)
    gaussians = Gaussians(
        means=np.float32(means),
        quats=np.float32(quats),
        scales=np.tile(np.float32([0.5, 0.3, 0.004]), (count, 1)),
        opacities=rng.uniform(0.05, 0.6, count).astype(np.float32),
        sh=rng.uniform(-1, 1, (count, 1, 3)).astype(np.float32),
    )
    azimuth = np.linspace(-math.pi, math.pi, columns, endpoint=False)
    lidar = Lidar(azimuth, np.linspace(-0.5, 0.1, 20), near=0.01)
    scanned = scanned_on(device, gaussians, lidar, np.eye(4))
    exact = reference_rays.cast(
        gaussians, np.zeros(3), lidar.directions.reshape(-1, 3), near=lidar.near
    )
    assert_like(scanned.alpha, exact.alpha, exact.cutoff_distance, 1e-3)
    layers = np.array(
        [reference_rays.returns(ray, lidar.detection, lidar.gap) for ray in exact.contributions]
    )
    is_clear = exact.cutoff_distance > 1e-3
    ranges = np.stack([scanned.range.ravel(), scanned.second_range.ravel()], axis=1)
    assert np.isclose(ranges, layers[:, :, 0], rtol=1e-3)[is_clear].mean() > 0.97
    light = np.stack([scanned.intensity.ravel(), scanned.second_intensity.ravel()], axis=1)
    assert np.isclose(light, layers[:, :, 2], atol=2e-3)[is_clear].mean() > 0.97


def test_opaque_rays_end_behind_a_small_share_of_the_light(device):
    wall = v3dg.join([dot((x, 0, 0), opacity=0.999, size=0.3) for x in (2.0, 3.0, 4.0)])
    scanned = scanned_on(device, wall, lidar_at([0.0]), np.eye(4))
    np.testing.assert_allclose(scanned.alpha, 1 - 1e-6, rtol=0, atol=1e-7)
    np.testing.assert_allclose(scanned.range, 2, rtol=1e-5)
    assert np.isinf(scanned.second_range).all()


def some_bundle():
    rng = np.random.default_rng(21)
    return lod_bundle(rng, blob(rng, 40), 16)


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
    "environment: expected None for an asset": lambda: v3dg.scan(
        dot((1, 0, 0)), LIDAR, np.eye(4), environment=-1
    ),
    "environment: expected 1 whole numbers": lambda: v3dg.scan(
        some_bundle(), LIDAR, np.eye(4), environment=[0, 0]
    ),
    "environment[0]: expected -1 to -1, as the scene has, got 0": lambda: v3dg.scan(
        some_bundle(), LIDAR, np.eye(4), environment=0
    ),
    "pose[2]: expected finite numbers, got nan": lambda: v3dg.scan(
        dot((1, 0, 0)), LIDAR, [np.eye(4), np.eye(4), np.full((4, 4), math.nan)]
    ),
    "pose: expected finite numbers, got inf": lambda: v3dg.scan(
        dot((1, 0, 0)), LIDAR, np.full((4, 4), math.inf)
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
def test_scans_of_both_devices_agree():
    rng = np.random.default_rng(15)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 400, sh_degree=2), 16), 40, spread=4)
    scene.set_opacity(0.7)
    lidar = Lidar(np.linspace(0, 6.2, 300), np.linspace(-0.6, 0.6, 40))
    for pose in (pose_of(rng, [0.1, 0, 0.2]), pose_of(rng, [3, 1, 0])):
        on_cpu = scanned_on("cpu", scene, lidar, pose)
        on_cuda = scanned_on("cuda", scene, lidar, pose)
        assert on_cpu.gaussians == on_cuda.gaussians
        for name in PLANES:
            is_close = np.isclose(
                getattr(on_cuda, name), getattr(on_cpu, name), rtol=1e-4, atol=1e-4
            )
            assert is_close.mean() > 0.998, name


@pytest.mark.gpu
def test_panoramas_of_both_devices_agree():
    rng = np.random.default_rng(16)
    bundle = lod_bundle(rng, blob(rng, 400, sh_degree=1), 16)
    scene = random_scene(rng, bundle, 20, spread=3)
    camera = EquirectangularCamera(np.eye(4), 256)
    options = {"background": (0.2, 0.3, 0.4), "fade": 1.5, "depth": True}
    on_cpu = drawn_on("cpu", scene, camera, **options)
    on_cuda = drawn_on("cuda", scene, camera, **options)
    for name, bound in (("color", 1e-4), ("alpha", 1e-4), ("depth", 1e-3)):
        difference = np.abs(getattr(on_cuda, name) - getattr(on_cpu, name))
        assert np.quantile(difference, 0.998) < bound, name


@pytest.mark.gpu
def test_poses_on_the_device_are_read_there():
    import torch

    rng = np.random.default_rng(17)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 10, spread=3)
    poses = np.stack([pose_of(rng, rng.normal(size=3)) for _ in range(3)])
    expected = v3dg.scan(scene, LIDAR, poses, device="cuda")
    tensor = torch.tensor(poses, device="cuda")
    made = v3dg.scan(scene, LIDAR, tensor, device="cuda")
    assert made.range.is_cuda
    np.testing.assert_array_equal(host(made.range), host(expected.range))
    np.testing.assert_allclose(host(made[1].points()), host(expected[1].points()), atol=1e-9)
    tensor[1, 0, 0] = math.nan
    broken = v3dg.scan(scene, LIDAR, tensor, device="cuda")
    assert host(broken.alpha)[1].max() == 0
    assert np.isinf(host(broken.range)[1]).all()
    np.testing.assert_array_equal(host(broken.range)[[0, 2]], host(expected.range)[[0, 2]])
    single = v3dg.scan(scene, LIDAR, tensor[0].float(), device="cuda")
    assert np.isclose(host(single.alpha), host(expected.alpha)[0], atol=1e-3).mean() > 0.99
    with pytest.raises(ValueError, match=r"^pose: expected a tensor on cpu"):
        v3dg.scan(scene, LIDAR, tensor, device="cpu")


@pytest.mark.gpu
@pytest.mark.parametrize("dtype", ["int32", "int64"])
def test_environments_on_the_device_are_read_there(dtype):
    import torch

    rng = np.random.default_rng(22)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 16), 12, spread=3)
    scene.set_environment(np.arange(12) % 3)
    poses = torch.tensor(np.stack([pose_of(rng, rng.normal(size=3)) for _ in range(3)])).cuda()
    expected = v3dg.scan(scene, LIDAR, poses, environment=[2, 0, 1], device="cuda")
    numbers = torch.tensor([2, 0, 1], dtype=getattr(torch, dtype), device="cuda")
    made = v3dg.scan(scene, LIDAR, poses, environment=numbers, device="cuda")
    np.testing.assert_array_equal(host(made.alpha), host(expected.alpha))
    assert host(made.alpha).max() > 0.5
    numbers[1] = 7
    broken = v3dg.scan(scene, LIDAR, poses, environment=numbers, device="cuda")
    assert host(broken.alpha)[1].max() == 0
    np.testing.assert_array_equal(host(broken.alpha)[[0, 2]], host(expected.alpha)[[0, 2]])
    with pytest.raises(ValueError, match=r"^environment: expected int32 or int64"):
        v3dg.scan(scene, LIDAR, poses, environment=numbers.float(), device="cuda")


@pytest.mark.gpu
def test_scans_have_the_same_bits_in_every_run():
    rng = np.random.default_rng(18)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 500), 32), 60, spread=4)
    first, *others = (scanned_on("cuda", scene, LIDAR, np.eye(4)) for _ in range(4))
    for other in others:
        for name in PLANES:
            np.testing.assert_array_equal(getattr(first, name), getattr(other, name))


@pytest.mark.gpu
def test_scans_follow_a_scene_that_moves_and_grows():
    rng = np.random.default_rng(19)
    bundle = lod_bundle(rng, blob(rng, 300), 16)
    scene = Scene()
    ids = scene.add(bundle, positions=[[4.0, 0, 0], [0, 5.0, 0]])
    before = scanned_on("cuda", scene, LIDAR, np.eye(4))
    scene.move(ids, positions=[[6.0, 0, 0], [0, 5.0, 0]])
    scene.add(lod_bundle(rng, blob(rng, 200), 16), positions=[[-4.0, 0, 0]])
    after = scanned_on("cuda", scene, LIDAR, np.eye(4))
    on_cpu = scanned_on("cpu", scene, LIDAR, np.eye(4))
    assert np.isclose(after.alpha, on_cpu.alpha, atol=1e-4).mean() > 0.998
    assert not np.isclose(after.alpha, before.alpha, atol=1e-2).all()
