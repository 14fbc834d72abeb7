import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import exact_cut
from command_line import TESTS_ENVIRONMENT
from random_bundle import random_bundle
from reference import select as reference
from scenes_lod import (
    blob,
    covariances,
    group_metrics,
    lod_bundle,
    random_camera,
    random_scene,
    rotation_matrices,
    turned,
)
from v3dg import BuildConfig, Bundle, Camera, Gaussians, Scene, _core, build_bundle, select

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
seeds = st.integers(0, 2**32 - 1)
# The position of the scene, and the distance of the cameras from it: far, inside, or at
# the same place.
places = st.sampled_from(
    [(0.0, 5.0), (0.0, 100.0), (0.0, 0.3), (0.0, 1e6), (1e6, 5.0), (-3e9, 50.0)]
)


def pairs(selection):
    return list(zip(selection.instance_ids.tolist(), selection.cluster_ids.tolist(), strict=True))


def same(a, b):
    np.testing.assert_array_equal(a.instance_ids, b.instance_ids)
    np.testing.assert_array_equal(a.cluster_ids, b.cluster_ids)


@st.composite
def bundles(draw):
    """Return random trees of any shape, or bundles with the layout of a build."""
    seed = draw(seeds)
    if draw(st.booleans()):
        return random_bundle(seed, num_levels=draw(st.integers(0, 5)))
    rng = np.random.default_rng(seed)
    origin = draw(st.sampled_from([0.0, 10.0, 1e4]))
    asset = blob(
        rng,
        draw(st.integers(1, 120)),
        origin=origin,
        size=draw(st.sampled_from([1e-3, 1.0, 100.0])),
    )
    return lod_bundle(
        rng, asset, draw(st.integers(2, 30)), group_size=draw(st.sampled_from([2, 4, 8]))
    )


def tolerances_of(draw, scene, camera):
    """Return the tolerances 0, infinity, some values in between, and exact metrics of
    groups."""
    metrics = np.concatenate([*group_metrics(scene, camera), np.zeros(1, np.float32)])
    exact = float(draw(st.sampled_from(sorted(set(metrics.tolist())))))
    return draw(st.sampled_from([0.0, exact, np.inf, 1e-3, 0.5, 1e4]))


def test_many_random_trials_have_no_violation():
    assert exact_cut.run_trials(200_000)["violations"] == 0


@settings(max_examples=300)
@given(data=st.data(), bundle=bundles(), seed=seeds, place=places)
def test_every_path_draws_exactly_one_cluster(data, bundle, seed, place):
    origin, distance = place
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, bundle, 3, origin=origin)
    camera = random_camera(rng, distance=distance, origin=origin)
    tolerance = tolerances_of(data.draw, scene, camera)
    selection = select(scene, camera, tolerance=tolerance, cull=False, device="cpu")
    paths = reference.paths(bundle.clusters, bundle.groups)
    for i in range(len(scene)):
        drawn = set(selection.cluster_ids[selection.instance_ids == i].tolist())
        for path in paths:
            assert len(drawn.intersection(path)) == 1


@given(bundle=bundles(), seed=seeds, place=places)
def test_metric_never_decreases_towards_the_root(bundle, seed, place):
    origin, distance = place
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, bundle, 4, origin=origin)
    if len(bundle.groups):
        # The eye is inside a ball, and on its surface.
        ball = bundle.groups.ball[rng.integers(len(bundle.groups))].astype(np.float64)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        scene.add(bundle, positions=scene.positions[0] - ball[:3] + ball[3] * direction)
    camera = random_camera(rng, distance=distance, origin=origin)
    below = np.flatnonzero(bundle.groups.parent >= 0)
    for metric in group_metrics(scene, camera):
        assert (metric >= 0).all()
        assert (metric[bundle.groups.parent[below]] >= metric[below]).all()


@given(seed=seeds, footprint=st.sampled_from(["solid_angle", "paper"]), place=places)
def test_metrics_agree_with_reference(seed, footprint, place):
    origin, distance = place
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, random_bundle(seed, num_levels=4), 2, origin=origin)
    camera = random_camera(rng, distance=distance, origin=origin)
    for i, metric in enumerate(group_metrics(scene, camera, footprint=footprint)):
        expected = np.array(reference.metrics(scene, i, camera, footprint))
        if footprint == "solid_angle":
            # Near the surface of a ball, the area is a steep function of the distance,
            # whose relative error in float32 is 1e-7.
            near = np.array(
                [
                    footprint_is_steep(ball, reference.eye_in_instance(scene, i, camera))
                    for ball in scene.bundles[0].groups.ball
                ],
                bool,
            )
            metric, expected = metric[~near], expected[~near]
            np.testing.assert_allclose(metric, expected, rtol=1e-4)
        else:
            depth = depths(scene, i, camera)
            clear = np.abs(depth) > 1e-2 * np.linalg.norm(
                reference.eye_in_instance(scene, i, camera)
            )
            np.testing.assert_allclose(metric[clear], expected[clear], rtol=1e-3)


def footprint_is_steep(ball, eye):
    distance = np.linalg.norm(ball[:3] - eye)
    return abs(distance - ball[3]) < 1e-3 * distance


def depths(scene, i, camera):
    forward = scene.rotations[i].T @ camera.viewmat[2, :3]
    return (
        scene.bundles[0].groups.ball[:, :3] - reference.eye_in_instance(scene, i, camera)
    ) @ forward


@given(
    seed=seeds, footprint=st.sampled_from(["solid_angle", "paper"]), tolerance=st.floats(1e-4, 1e4)
)
def test_cut_agrees_with_reference(seed, footprint, tolerance):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, random_bundle(seed, num_levels=4), 3)
    scene.add(random_bundle(seed + 1, num_levels=3), positions=rng.normal(size=(2, 3)))
    camera = random_camera(rng)
    for metric in group_metrics(scene, camera, footprint=footprint):
        if (np.abs(metric - tolerance) <= 1e-3 * tolerance).any():
            return  # rounding may decide here
    selection = select(
        scene, camera, tolerance=tolerance, footprint=footprint, cull=False, device="cpu"
    )
    assert pairs(selection) == reference.cut(scene, camera, tolerance, footprint)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("footprint", ["solid_angle", "paper"])
def test_tolerance_equal_to_a_metric_fits(device, footprint):
    rng = np.random.default_rng(3)
    bundle = lod_bundle(rng, blob(rng, 300), 20)
    camera = random_camera(rng)
    metric = group_metrics(bundle, camera, footprint=footprint)[0]
    for g in np.flatnonzero(np.isfinite(metric)):
        options = {"footprint": footprint, "cull": False, "device": device}
        at = select(bundle, camera, tolerance=float(metric[g]), **options)
        below = np.nextafter(metric[g], np.float32(-np.inf))
        just_below = select(bundle, camera, tolerance=float(below), **options)
        children = np.flatnonzero(bundle.clusters.parent_group == g)
        assert not np.isin(children, at.cluster_ids).any()
        assert (
            np.isin(np.flatnonzero(bundle.clusters.own_group == g), just_below.cluster_ids).sum()
            == 0
        )


def test_tolerance_orders_the_detail():
    rng = np.random.default_rng(4)
    bundle = lod_bundle(rng, blob(rng, 500), 16, past_root=3)
    camera = random_camera(rng, distance=20)
    counts = [
        select(bundle, camera, tolerance=t, cull=False, device="cpu").num_gaussians
        for t in (0, 1e-3, 0.1, 10, 1e3, np.inf)
    ]
    assert counts == sorted(counts, reverse=True)
    assert counts[0] == 500
    assert counts[-1] == len(bundle.level_gaussians(bundle.num_levels - 1))


@given(bundle=bundles(), seed=seeds)
def test_turning_the_camera_changes_nothing(bundle, seed):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, bundle, 3)
    camera = Camera(np.eye(4), np.diag([500.0, 500.0, 1.0]), 64, 48)
    for angle in rng.uniform(0, 2 * np.pi, 3):
        # A rotation about the eye at the origin is exact, so no bit may change.
        viewmat = np.eye(4)
        viewmat[:3, :3] = [
            [np.cos(angle), 0, np.sin(angle)],
            [0, 1, 0],
            [-np.sin(angle), 0, np.cos(angle)],
        ]
        other = Camera(viewmat, camera.K, 64, 48)
        for a, b in zip(group_metrics(scene, camera), group_metrics(scene, other), strict=True):
            np.testing.assert_array_equal(a, b)
        same(
            select(scene, camera, tolerance=0.5, cull=False, device="cpu"),
            select(scene, other, tolerance=0.5, cull=False, device="cpu"),
        )


def test_turning_a_camera_anywhere_changes_nothing():
    rng = np.random.default_rng(11)
    bundle = lod_bundle(rng, blob(rng, 400), 16)
    scene = random_scene(rng, bundle, 50, spread=20)
    for _ in range(20):
        camera = random_camera(rng, distance=30)
        other = Camera(turned(camera, rng).viewmat, camera.K, 64, 48)
        same(
            select(scene, camera, tolerance=0.5, cull=False, device="cpu"),
            select(scene, other, tolerance=0.5, cull=False, device="cpu"),
        )


@pytest.mark.parametrize("shift", [(1e6, -1e6, 1e6), (0, 3e7, 0)])
def test_moving_scene_and_camera_together_changes_nothing(shift):
    rng = np.random.default_rng(12)
    bundle = lod_bundle(rng, blob(rng, 400), 16)
    near = random_scene(rng, bundle, 50, spread=20)
    far = Scene()
    far.add(bundle, near.positions + shift, near.quaternions, near.scales)
    for _ in range(20):
        eye, target = 30 * rng.normal(size=3), rng.normal(size=3)
        camera = Camera.look_at(eye, target, width=64, height=48)
        moved = Camera.look_at(eye + shift, target + shift, width=64, height=48)
        a, b = (
            select(near, camera, tolerance=0.5, device="cpu"),
            select(far, moved, tolerance=0.5, device="cpu"),
        )
        assert len(a) > 0
        same(a, b)


def frames(gaussians, scene, i, camera):
    """Return means and covariances in camera space, in double precision."""
    turn = camera.viewmat[:3, :3] @ scene.rotations[i]
    means = (
        scene.scales[i] * gaussians.means.astype(np.float64) @ scene.rotations[i].T
        + scene.positions[i]
    )
    means = means @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]
    return means, scene.scales[i] ** 2 * turn @ covariances(gaussians) @ turn.T


@settings(max_examples=150)
@given(seed=seeds, distance=st.sampled_from([0.3, 2.0, 8.0]), off_center=st.booleans())
def test_frustum_never_drops_what_a_pixel_shows(seed, distance, off_center):
    rng = np.random.default_rng(seed)
    bundle = lod_bundle(rng, blob(rng, 60), 8, filter_px2=0.3)
    scene = random_scene(rng, bundle, 4, spread=2.0)
    camera = random_camera(rng, distance=distance, near=float(rng.choice([0.01, 1.0])))
    if off_center:
        K = camera.K + np.array(
            [[0, 0, rng.uniform(-40, 40)], [0, 0, rng.uniform(-40, 40)], [0, 0, 0]]
        )
        camera = Camera(camera.viewmat, K, camera.width, camera.height, camera.near)
    tolerance = float(rng.choice([0.0, 0.5, 100.0]))
    everything = pairs(select(scene, camera, tolerance=tolerance, cull=False, device="cpu"))
    kept = pairs(select(scene, camera, tolerance=tolerance, device="cpu"))
    assert kept == [pair for pair in everything if pair in set(kept)]
    for i, c in set(everything) - set(kept):
        gaussians = bundle.cluster_gaussians(c)
        filter_px2 = float(bundle.clusters.filter_px2[c])
        for mean, covariance in zip(*frames(gaussians, scene, i, camera), strict=True):
            assert not reference.touches_image(mean, covariance, filter_px2, camera)


@pytest.mark.parametrize("side", range(4))
def test_frustum_keeps_needles_whose_image_leans_in(side):
    # The needle lies next to the picture and along its border, past the eye. Its
    # projection is linearised at its mean, which is outside the picture. Therefore it
    # is drawn across the border, although the needle itself is not there.
    asset = Gaussians(
        means=np.zeros((1, 3), np.float32),
        quats=np.array([[1, 0, 0, 0]], np.float32),
        scales=np.array([[0.001, 0.001, 1.3]], np.float32),
        opacities=np.ones(1, np.float32),
        sh=np.ones((1, 1, 3), np.float32),
    )
    bundle = lod_bundle(np.random.default_rng(0), asset, 1, past_root=0)
    # The rotation is an eighth of a turn about y, then a quarter of a turn about the
    # viewing direction for each side.
    (w, z), (c, y) = ((np.cos(a), np.sin(a)) for a in (side * np.pi / 4, np.pi / 8))
    turn = rotation_matrices(np.array([[w, 0, 0, z]]))[0]
    scene = Scene()
    scene.add(bundle, turn @ [1.2, 0, 1], quaternions=[w * c, -z * y, w * y, z * c])
    camera = Camera(np.eye(4), [[50, 0, 50], [0, 50, 50], [0, 0, 1]], 100, 100)
    mean, covariance = (values[0] for values in frames(asset, scene, 0, camera))
    assert reference.touches_image(mean, covariance, 0.0, camera)
    assert len(select(scene, camera, tolerance=1.0, device="cpu")) == 1
    away = Scene()
    away.add(bundle, turn @ [2.5, 0, 1], quaternions=scene.quaternions)
    assert len(select(away, camera, tolerance=1.0, device="cpu")) == 0


def test_frustum_drops_most_of_what_lies_outside():
    rng = np.random.default_rng(5)
    bundle = lod_bundle(rng, blob(rng, 200, size=0.1), 10)
    scene = random_scene(rng, bundle, 400, spread=20, log_scale=0.1)
    camera = Camera.look_at((0, 0, 0), (1, 0, 0), fov_x=0.8, width=64, height=64)
    kept = select(scene, camera, tolerance=0.5, device="cpu")
    everything = select(scene, camera, tolerance=0.5, cull=False, device="cpu")
    assert 0 < len(kept) < 0.2 * len(everything)
    behind = Camera.look_at((1000, 0, 0), (2000, 0, 0), fov_x=0.8, width=64, height=64)
    assert len(select(scene, behind, tolerance=0.5, device="cpu")) == 0


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("num_bundles", [8, 9, 40])
def test_bundles_of_different_filters_are_cut_as_if_alone(device, num_bundles):
    # A wide filter reaches far beyond the frustum, so each bundle has its own frustum.
    rng = np.random.default_rng(num_bundles)
    scene = Scene()
    for b in range(num_bundles):
        filter_px2 = float(b % 10) ** 2
        bundle = lod_bundle(rng, blob(rng, 60, size=0.1), 8, filter_px2=filter_px2)
        scene.add(bundle, positions=[0, 0, 4] + rng.normal(size=(20, 3)) * [4, 4, 1])
    camera = Camera(np.eye(4), [[50, 0, 32], [0, 50, 32], [0, 0, 1]], 64, 64)
    cut = select(scene, camera, tolerance=0.5, device=device)
    kept = []
    for b, bundle in enumerate(scene.bundles):
        mine = np.flatnonzero(scene.instance_bundle == b)
        alone = Scene()
        alone.add(bundle, scene.positions[mine])
        expected = select(alone, camera, tolerance=0.5, device=device)
        own = np.isin(cut.instance_ids, mine)
        np.testing.assert_array_equal(cut.instance_ids[own], mine[expected.instance_ids])
        np.testing.assert_array_equal(cut.cluster_ids[own], expected.cluster_ids)
        kept.append(len(expected))
    # otherwise the filters would have no effect here
    assert max(kept[:8]) > 1.5 * min(kept[:8])


@given(bundle=bundles(), other=bundles(), seed=seeds)
def test_order_counts_and_scenes_of_several_bundles(bundle, other, seed):
    rng = np.random.default_rng(seed)
    scene = Scene()
    for _ in range(4):
        count = int(rng.integers(0, 4))
        scene.add(bundle if rng.random() < 0.5 else other, positions=rng.normal(size=(count, 3)))
    camera = random_camera(rng)
    selection = select(scene, camera, tolerance=float(rng.choice([0, 0.5, 50])), device="cpu")
    assert pairs(selection) == sorted(set(pairs(selection)))
    assert selection.instance_ids.dtype == selection.cluster_ids.dtype == np.int32
    sizes = [
        np.diff(scene.bundles[scene.instance_bundle[i]].clusters.offset)[c]
        for i, c in pairs(selection)
    ]
    assert selection.num_gaussians == sum(sizes)
    assert len(selection.filters_px2) == len(selection.antialiased) == selection.num_gaussians
    for i in range(len(scene)):
        alone = Scene()
        alone.add(scene.bundles[scene.instance_bundle[i]], scene.positions[i])
        mine = select(alone, camera, tolerance=0.5, cull=False, device="cpu").cluster_ids
        everything = select(scene, camera, tolerance=0.5, cull=False, device="cpu")
        np.testing.assert_array_equal(mine, everything.cluster_ids[everything.instance_ids == i])


def test_empty_and_smallest_scenes():
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
    nothing = select(Scene(), camera, tolerance=1.0, device="cpu")
    assert len(nothing) == nothing.num_gaussians == len(nothing.filters_px2) == 0
    empty = random_bundle(num_levels=0)
    assert select(empty, camera, tolerance=1.0, device="cpu").num_gaussians == 0
    rng = np.random.default_rng(0)
    one = lod_bundle(rng, blob(rng, 1, size=0.01), 4, past_root=0)
    selection = select(one, camera, tolerance=1.0, device="cpu")
    assert pairs(selection) == [(0, 0)]


def test_bad_arguments_are_refused():
    bundle = random_bundle(1)
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
    with pytest.raises(
        ValueError, match=r"tolerance: expected a number of px² of at least 0, got -1"
    ):
        select(bundle, camera, tolerance=-1, device="cpu")
    with pytest.raises(
        ValueError, match="tolerance: expected a number of px² of at least 0, got nan"
    ):
        select(bundle, camera, tolerance=float("nan"), device="cpu")
    with pytest.raises(
        ValueError, match="footprint: expected 'solid_angle' or 'paper', got 'ball'"
    ):
        select(bundle, camera, tolerance=1, footprint="ball", device="cpu")
    with pytest.raises(
        ValueError, match="device: expected 'auto', 'cpu', 'cuda' or 'cuda:1', got 'tpu'"
    ):
        select(bundle, camera, tolerance=1, device="tpu")
    for device in ("cpu", "auto"):
        with pytest.raises(TypeError, match="subject: expected a Scene or a Bundle, got int"):
            select(7, camera, tolerance=1, device=device)


def test_table_refuses_groups_that_do_not_exist():
    clusters, groups = random_bundle(1).clusters, random_bundle(1).groups
    wrong = clusters.own_group.copy()
    wrong[-1] = len(groups)
    with pytest.raises(ValueError, match="own_group: expected -1 or a group below"):
        _core.ClusterTable(
            ball=groups.ball,
            weight=groups.weight,
            level=groups.level,
            own_group=wrong,
            parent_group=clusters.parent_group,
            box=clusters.box,
            filter_px2=clusters.filter_px2,
            antialiased=clusters.antialiased,
            offset=clusters.offset,
        )


@pytest.mark.skipif(_core.has_cuda, reason="built with CUDA")
def test_missing_cuda_is_named():
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
    with pytest.raises(RuntimeError, match="v3dg was built without CUDA"):
        select(random_bundle(1), camera, tolerance=1, device="cuda")


@pytest.mark.gpu
def test_both_devices_choose_the_same():
    rng = np.random.default_rng(21)
    for _ in range(30):
        scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 8), 200, spread=10)
        scene.add(
            random_bundle(int(rng.integers(1 << 30)), num_levels=4),
            positions=rng.normal(size=(5, 3)),
        )
        camera = random_camera(rng)
        metric = np.concatenate(group_metrics(scene, camera))
        tolerance = float(rng.choice(metric[np.isfinite(metric)]))
        for footprint in ("solid_angle", "paper"):
            cpu, cuda = (
                select(scene, camera, tolerance=tolerance, footprint=footprint, device=device)
                for device in ("cpu", "cuda")
            )
            same(cpu, cuda)
            assert cpu.num_gaussians == cuda.num_gaussians


OPTIONS = [{}, {"fade": 1.3}, {"min_level": 7}, {"footprint": "paper"}]


def lane_scene(count):
    """Return a camera, and instances that need a whole table, its last clusters, or
    only its coarsest clusters, in every order."""
    rng = np.random.default_rng(count)
    config = BuildConfig(cluster_size=32, steps=0, num_views=1)
    made = [build_bundle(blob(rng, size), config=config, progress=False) for size in (700, 40, 1)]
    distance = 10 ** rng.uniform(0.5, 4, count)
    positions = distance[:, None] * [0, 0, 1] + rng.normal(size=(count, 3))
    scene = Scene()
    scene.add([made[k] for k in rng.integers(0, 3, count)], positions=positions)
    return scene, Camera.look_at((0, 0, -1), (0, 0, 1), (0, 1, 0), width=640, height=480)


@pytest.mark.gpu
@pytest.mark.parametrize("count", [300, 9000])
@pytest.mark.parametrize("options", [*OPTIONS, {"budget": 60_000}])
def test_both_devices_choose_the_same_of_what_a_lane_asks(count, options):
    scene, camera = lane_scene(count)
    for tolerance in (0.1, 3.0, 100.0):
        cpu, cuda = (
            select(scene, camera, tolerance=tolerance, device=device, **options)
            for device in ("cpu", "cuda")
        )
        same(cpu, cuda)
        assert (cpu.num_gaussians, cpu.tolerance) == (cuda.num_gaussians, cuda.tolerance)
        if cpu.weights is not None:
            np.testing.assert_array_equal(cpu.weights, cuda.weights)


@pytest.mark.parametrize("options", OPTIONS)
def test_many_instances_are_cut_as_each_alone(options):
    """For many instances of a bundle, clusters that the distance excludes are
    skipped."""
    scene, camera = lane_scene(200)
    for tolerance in (0.1, 3.0, 100.0):
        whole = select(scene, camera, tolerance=tolerance, device="cpu", **options)
        levels = set()
        for i in range(len(scene)):
            bundle, alone = scene.bundles[scene.instance_bundle[i]], Scene()
            alone.add(bundle, positions=scene.positions[i])
            expected = select(alone, camera, tolerance=tolerance, device="cpu", **options)
            chosen = whole.instance_ids == i
            np.testing.assert_array_equal(whole.cluster_ids[chosen], expected.cluster_ids)
            if whole.weights is not None:
                np.testing.assert_array_equal(whole.weights[chosen], expected.weights)
            levels |= set(bundle.clusters.level[expected.cluster_ids].tolist())
        assert options or len(levels) > 4


DIGEST = """
import hashlib
import numpy as np
from scenes_lod import blob, lod_bundle, random_camera, random_scene
from v3dg import select
rng = np.random.default_rng(5)
scene = random_scene(rng, lod_bundle(rng, blob(rng, 500), 8), 300)
selection = select(scene, random_camera(rng), tolerance=0.5, device="cpu")
assert len(selection) > 1000
chosen = selection.instance_ids.tobytes() + selection.cluster_ids.tobytes()
print(hashlib.sha256(chosen).hexdigest())
"""


def test_number_of_threads_changes_nothing():
    digests = [
        subprocess.run(
            [sys.executable, "-c", DIGEST],
            env=TESTS_ENVIRONMENT | {"OMP_NUM_THREADS": threads},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for threads in ("1", "2", "3")
    ]
    assert len(set(digests)) == 1


def test_bundle_is_a_scene_of_one():
    bundle = random_bundle(2)
    scene = Scene.of(bundle)
    assert Scene.of(scene) is scene
    assert len(scene) == 1
    assert isinstance(scene.bundles[0], Bundle)
    assert isinstance(bundle.gaussians, Gaussians)
    np.testing.assert_array_equal(rotation_matrices(scene.quaternions), np.eye(3)[None])
