"""Tests fades between levels. Weights add up to one and scale opacities, and no picture
changes suddenly."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import exact_cut
from devices import host
from frames import (
    CAMERA,
    Renderer,
    arrays,
    assert_close,
    assert_like_cpu,
    assert_same_bytes,
    composed_scene,
    render,
)
from random_bundle import random_bundle
from reference import select as reference
from scenes_lod import blob, group_metrics, lod_bundle, random_camera, random_scene, turned
from v3dg import (
    DEFAULT_FADE,
    Bundle,
    Camera,
    Gaussians,
    Scene,
    Selection,
    _core,
    _device,
    rasterize,
    select,
)
from v3dg.select import rule_of, select_by

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)]
WHOLE = exact_cut.WHOLE
seeds = st.integers(0, 2**32 - 1)
fades = st.sampled_from([1.01, 1.05, 1.3, 4.0])


def same(a, b):
    np.testing.assert_array_equal(a.instance_ids, b.instance_ids)
    np.testing.assert_array_equal(a.cluster_ids, b.cluster_ids)
    np.testing.assert_array_equal(a.weights, b.weights)
    assert (a.num_gaussians, a.tolerance) == (b.num_gaussians, b.tolerance)


def weights_of(selection, i, bundle):
    """Return the weights (C,) of the clusters of one instance, or 0 for clusters that
    are not drawn."""
    weights, mine = np.zeros(len(bundle.clusters)), selection.instance_ids == i
    weights[selection.cluster_ids[mine]] = selection.weights[mine]
    return weights


def test_many_random_trials_have_no_violation():
    result = exact_cut.run_trials(200_000, fades=True)
    assert result["violations"] == 0
    assert result["selected_with_weights_below_1"] > 0.1


@given(seed=seeds, fade=fades, tolerance=st.floats(1e-3, 1e3))
def test_weights_add_up_to_one_on_every_path(seed, fade, tolerance):
    rng = np.random.default_rng(seed)
    bundle = random_bundle(seed, num_levels=4)
    scene = random_scene(rng, bundle, 3)
    selection = select(
        scene, random_camera(rng), tolerance=tolerance, fade=fade, cull=False, device="cpu"
    )
    assert selection.weights.min(initial=1) > 0
    for i in range(len(scene)):
        weights = weights_of(selection, i, bundle)
        for path in reference.paths(bundle.clusters, bundle.groups):
            assert weights[path].sum() == 1


@given(seed=seeds, fade=fades, min_level=st.integers(0, 3))
def test_weights_are_those_of_the_ramp(seed, fade, min_level):
    rng = np.random.default_rng(seed)
    bundle = lod_bundle(rng, blob(rng, 100), 8)
    scene, camera = random_scene(rng, bundle, 2), random_camera(rng)
    tolerance = float(rng.uniform(0.01, 3))
    selection = select(
        scene, camera, tolerance=tolerance, fade=fade, min_level=min_level, cull=False, device="cpu"
    )
    own, parent = bundle.clusters.own_group, bundle.clusters.parent_group
    for i, metric in enumerate(group_metrics(scene, camera)):
        low, high = tolerance / fade, tolerance * fade
        ramp = (np.clip(metric.astype(np.float64), low, high) - low) / (high - low)
        ramp = np.where(bundle.groups.level <= min_level, 0, ramp)
        expected = np.append(ramp, 1.0)[parent] - np.append(ramp, 0.0)[own]  # -1 means no group
        np.testing.assert_allclose(weights_of(selection, i, bundle), expected, atol=2 / WHOLE)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("fade", [None, 1.0])
def test_no_fade_is_the_cut_of_one_cluster_a_path(device, fade):
    scene = composed_scene(np.random.default_rng(1))
    cut = select(scene, CAMERA, tolerance=2.0, device=device)
    same(cut, select(scene, CAMERA, tolerance=2.0, fade=fade, device=device))
    assert (cut.weights == 1).all()
    assert (
        len(replace(cut, instance_ids=cut.instance_ids[1:], cluster_ids=cut.cluster_ids[1:]))
        == len(cut) - 1
    )
    image = render(scene, CAMERA, tolerance=2.0, fade=fade, device=device)
    assert_same_bytes(image, render(scene, CAMERA, cut=cut, device=device))


@pytest.mark.parametrize("tolerance", [0.0, np.inf])
def test_the_finest_and_the_coarsest_cut_have_no_fade(tolerance):
    scene = composed_scene(np.random.default_rng(2))
    same(
        *(
            select(scene, CAMERA, tolerance=tolerance, fade=fade, device="cpu")
            for fade in (None, 1.05)
        )
    )


def test_weights_follow_the_camera_without_a_jump():
    rng = np.random.default_rng(3)
    bundle = lod_bundle(rng, blob(rng, 500), 16)
    away, step, fade = np.array([0.0, -30.0, 5.0]), 1e-4, 1.05
    start = Camera.look_at(away, (0, 0, 0), width=640, height=480)
    tolerance = float(np.median(group_metrics(bundle, start)[0]))
    last, most, changed = None, 0.0, 0
    for k in range(300):
        camera = Camera.look_at(away * (1 - step) ** k, (0, 0, 0), width=640, height=480)
        cut = select(bundle, camera, tolerance=tolerance, fade=fade, cull=False, device="cpu")
        weights = weights_of(cut, 0, bundle)
        if last is not None:
            most, changed = (
                max(most, np.abs(weights - last).max()),
                changed + (weights != last).any(),
            )
        last = weights
    # The metric grows by two steps, or more near a ball, in a band whose width is 2
    # (fade - 1).
    assert changed > 100
    assert most < 3 * step / (fade - 1)


@given(seed=seeds, fade=fades, share=st.floats(0, 1), cull=st.booleans())
def test_budget_is_kept(seed, fade, share, cull):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 200), 8), 5)
    camera = random_camera(rng)
    least, most = (
        select(scene, camera, tolerance=t, cull=cull, device="cpu").num_gaussians
        for t in (np.inf, 0.0)
    )
    budget = round(least + share * (most - least))
    cut = select(scene, camera, budget=budget, fade=fade, cull=cull, device="cpu")
    assert least <= cut.num_gaussians <= budget


@settings(max_examples=20)
@given(seed=seeds, fade=fades, share=st.floats(0, 1))
def test_budget_is_kept_in_steps(seed, fade, share):
    rng = np.random.default_rng(seed)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 200), 8), 5)
    renderer, camera = Renderer(scene, device="cpu"), random_camera(rng, width=16, height=12)
    eye, ahead = camera.position, camera.viewmat[2, :3]
    for step in (1e-3, 1e-3, 0.3, 3e-3, 0):
        eye = eye + step * np.linalg.norm(eye) * rng.normal(size=3)
        camera = Camera.look_at(eye, eye + ahead, camera.viewmat[1, :3], width=16, height=12)
        least, most = (
            select(scene, camera, tolerance=t, device="cpu").num_gaussians for t in (np.inf, 0.0)
        )
        options = {"budget": round(least + share * (most - least)), "fade": fade}
        cut = select(scene, camera, **options, device="cpu")
        stats = renderer.render(camera, **options).stats
        assert stats.gaussians_selected <= options["budget"]
        assert stats.tolerance >= cut.tolerance


def slow_orbit(num_frames):
    """Return cameras that move towards CAMERA while clusters enter and leave the
    view."""
    angles = 2e-3 * np.arange(num_frames)[::-1]
    eyes = [(6 * np.sin(a), -6 * np.cos(a), 1) for a in angles]
    return [Camera.look_at(eye, (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117) for eye in eyes]


def settled_at(renderer, camera, options):
    """Return the tolerance at which ten pictures of a camera at rest have the same
    bits."""
    first, *others = (renderer.render(camera, **options) for _ in range(10))
    for image in others:
        assert_same_bytes(image, first)
        assert image.stats.tolerance == first.stats.tolerance
    return first.stats.tolerance


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("memory", [None, "64MB"])
def test_a_budget_draws_the_same_bits_from_the_tenth_frame_at_rest_on(device, memory):
    """If the view is new, the first picture has these bits. After slow motion, the
    budget reaches the same picture in steps."""
    scene = composed_scene(np.random.default_rng(5))
    options, cameras = {"budget": 9000, "fade": DEFAULT_FADE}, slow_orbit(150)[:88]
    last = cameras[-1]
    roomy = select(
        scene, last, budget=9000 - 9000 // 32, fade=DEFAULT_FADE, device=device
    ).tolerance
    renderer = Renderer(scene, device=device, memory=memory)
    renderer.settle(last, **options)
    assert settled_at(renderer, last, options) == roomy
    renderer = Renderer(scene, device=device, memory=memory)
    *_, stop = (renderer.render(camera, **options).stats.tolerance for camera in cameras)
    renderer.settle(last, **options)
    ways = [np.log2(roomy / stop)]
    for _ in range(8):
        ways.append(np.log2(roomy / renderer.render(last, **options).stats.tolerance))
    steps = -np.diff(ways)
    assert ways[0] > 0.04
    # The tolerances within an octave are equally spaced.
    assert 0 <= steps.min() <= steps.max() < 2.1 * ways[0] / 8
    assert settled_at(renderer, last, options) == roomy


@pytest.mark.parametrize("device", DEVICES)
def test_what_moves_is_not_at_rest(device):
    """This also holds if an instance moves, or one of two cameras."""
    scene = composed_scene(np.random.default_rng(5))
    options, cameras = {"budget": 9000, "fade": DEFAULT_FADE}, slow_orbit(150)[:88]
    for what in ("an instance", "a camera", "nothing"):
        renderer = Renderer(scene, device=device)
        *_, last = (renderer.render(camera, **options).stats.tolerance for camera in cameras)
        steps = []
        for k in range(8):
            if what == "an instance":
                scene.move([0], positions=scene.positions[:1])
            camera = cameras[-1 - k % 2 if what == "a camera" else -1]
            tolerance = renderer.render(camera, **options).stats.tolerance
            steps.append(abs(np.log2(tolerance / last)))
            last = tolerance
        assert (max(steps) > 13 / 2048) == (what == "nothing")


@pytest.mark.parametrize("device", DEVICES)
def test_in_slow_motion_the_tolerance_of_a_budget_goes_in_steps(device):
    scene = composed_scene(np.random.default_rng(5))
    renderer = Renderer(scene, device=device)
    options = {"budget": 9000, "fade": DEFAULT_FADE}
    last, leaps, least_leaps = None, 0, 0
    for camera in slow_orbit(150):
        stats = renderer.render(camera, **options).stats
        least = select(scene, camera, **options, device="cpu").tolerance
        assert stats.tolerance >= least
        assert stats.gaussians_selected <= 9000
        if last is not None:
            tolerance, before = stats.tolerance, last[0]
            assert tolerance == least or abs(np.log2(tolerance / before)) <= 17 / 1024
            leaps += abs(np.log2(tolerance / before)) > 0.02
            least_leaps += abs(np.log2(least / last[1])) > 0.02
        last = stats.tolerance, least
    assert least_leaps > 3 * leaps


@pytest.mark.parametrize("device", DEVICES)
def test_leaps_of_a_budget_are_made_at_once(device):
    """This happens for another view, another budget or another tolerance, and if the
    budget no longer limits the cut."""
    scene = composed_scene(np.random.default_rng(5))
    renderer = Renderer(scene, device=device)
    not_binding = {"budget": 9000, "tolerance": 5000.7}
    for options in ({"budget": 9000}, {"budget": 12000}, {"budget": 9000}, not_binding):
        stats = renderer.render(CAMERA, **options, fade=1.05).stats
        roomy = options | {"budget": options["budget"] - options["budget"] // 32}
        assert stats.tolerance == select(scene, CAMERA, **roomy, fade=1.05, device="cpu").tolerance
    assert stats.tolerance == np.float32(5000.7)


def test_without_a_fade_a_budget_depends_on_the_view_alone():
    scene = composed_scene(np.random.default_rng(5))
    renderer = Renderer(scene, device="cpu")
    for camera in slow_orbit(10):
        image = renderer.render(camera, budget=9000)
        assert_same_bytes(image, render(scene, camera, budget=9000, device="cpu"))
    for camera in slow_orbit(10):
        image = render(scene, camera, budget=9000, fade=1.05, device="cpu")
        cut = select(scene, camera, budget=9000, fade=1.05, device="cpu")
        assert image.stats.tolerance == cut.tolerance


@pytest.mark.parametrize("device", DEVICES)
def test_cuts_that_follow_each_other_are_those_of_a_renderer(device):
    """This also holds if two viewers select cuts in turn."""
    scene, where = composed_scene(np.random.default_rng(5)), _device.resolve(device)
    options, cameras = {"budget": 9000, "fade": DEFAULT_FADE}, slow_orbit(150)[:88]
    viewers = [(Renderer(scene, device=device), _core.BudgetSteps()) for _ in range(2)]
    for pair in zip([*cameras, *10 * cameras[-1:]], cameras[::-1] + 10 * cameras[:1], strict=True):
        for camera, (renderer, steps) in zip(pair, viewers, strict=True):
            cut = select_by(
                rule_of(None, **options, min_level=0), scene, camera, 9000, where, steps
            )
            stats = renderer.render(camera, **options).stats
            assert (cut.tolerance, cut.num_gaussians) == (stats.tolerance, stats.gaussians_selected)
        last = cut
    assert last.tolerance == select(scene, camera, budget=9000 - 281, fade=DEFAULT_FADE).tolerance


@pytest.mark.gpu
def test_both_devices_go_the_same_steps():
    scene = composed_scene(np.random.default_rng(5))
    renderers = [Renderer(scene, device=device) for device in ("cpu", "cuda")]
    for budget in (9000, 9100, 15000):
        for camera in [*slow_orbit(60), *slow_orbit(150)[:88], *10 * slow_orbit(150)[87:88]]:
            cpu, cuda = (
                r.render(camera, budget=budget, fade=DEFAULT_FADE).stats for r in renderers
            )
            assert cuda.tolerance == cpu.tolerance
            assert cuda.gaussians_selected == cpu.gaussians_selected


@pytest.mark.parametrize("device", DEVICES)
def test_turning_in_place_changes_no_weight(device):
    rng = np.random.default_rng(6)
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 400), 16), 50, spread=20)
    for _ in range(10):
        camera = random_camera(rng, distance=30)
        other = Camera(turned(camera, rng).viewmat, camera.K, 64, 48)
        same(
            *(
                select(scene, c, tolerance=0.5, fade=1.05, cull=False, device=device)
                for c in (camera, other)
            )
        )


def faded(bundle, opacities, weights, device):
    """Return the opacities multiplied by the weights of clusters that have one gaussian
    each."""
    count = len(opacities)
    cut = Selection(
        Scene.of(bundle),
        np.zeros(count, np.int32),
        np.arange(count, dtype=np.int32),
        count,
        0.0,
        0.0,
        given_weights=weights.astype(np.float32),
    )
    return host(cut.gaussians(device=device).opacities)


def singles(opacities):
    """Return a bundle of this number of leaf clusters next to each other, with one
    gaussian each."""
    count = len(opacities)
    means = np.stack([np.arange(count), np.zeros(count), np.zeros(count)], 1).astype(np.float32)
    asset = Gaussians(
        means,
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.1, np.float32),
        np.asarray(opacities, np.float32),
        np.ones((count, 1, 3), np.float32),
    )
    return lod_bundle(np.random.default_rng(0), asset, 1)


@pytest.mark.parametrize("device", DEVICES)
def test_gaussians_have_opacities_times_weights(device):
    bundle = singles(np.linspace(0, 1, 64))
    leaves = bundle.gaussians.opacities[:64]
    for weights in (np.ones(64), np.arange(64) % 2, np.arange(64) / 64):
        found = faded(bundle, leaves, weights, device)
        np.testing.assert_array_equal(found, leaves * weights.astype(np.float32))


@pytest.mark.parametrize("device", DEVICES)
def test_picture_is_that_of_the_gaussians_with_faded_opacities(device):
    """Each gaussian has the filter of its level, so any rasterizer can draw fades."""
    rng = np.random.default_rng(7)
    bundle = lod_bundle(rng, blob(rng, 900), 32, filter_px2=0.05)
    tolerance = float(np.median(group_metrics(bundle, CAMERA)[0]))
    cut = select(bundle, CAMERA, tolerance=tolerance, fade=1.2, device=device)
    assert 0.2 < (cut.weights < 1).mean() < 1
    options = {"device": device, "min_transmittance": 0.0}
    image = render(bundle, CAMERA, cut=cut, **options)
    assert_same_bytes(image, render(bundle, CAMERA, tolerance=tolerance, fade=1.2, **options))
    assert (cut.filters_px2 == np.float32(0.05)).all()
    assert cut.antialiased.all()
    one = lod_bundle(rng, cut.gaussians(device="cpu"), 1 << 20, past_root=0)
    filters = {"filter_px2": np.full(1, 0.05, np.float32), "antialiased": np.ones(1, np.uint8)}
    shown = Bundle(replace(one.clusters, **filters), one.groups, one.gaussians)
    whole = render(shown, CAMERA, tolerance=0.0, **options)
    assert_close(arrays(image)[:2], arrays(whole)[:2])
    hard = render(bundle, CAMERA, tolerance=tolerance, **options)
    assert np.abs(arrays(image)[0] - arrays(hard)[0]).max() > 1e-2


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(("filter_px2", "is_antialiased"), [(0.0, 0), (0.3, 0), (0.02, 1)])
def test_a_fade_gives_level_0_a_filter_that_has_none(filter_px2, is_antialiased, device):
    """Level 0 has the filter even while nothing fades. Otherwise the whole picture
    would change when a fade begins."""
    rng = np.random.default_rng(3)
    asset = blob(rng, 900)
    # The gaussians are about one unit large, and none is so narrow that it gets a
    # smaller filter.
    px = CAMERA.fx / np.linalg.norm(CAMERA.position)
    asset = replace(asset, scales=np.clip(asset.scales, 0.2 / px, 0.5 / px).astype(np.float32))
    bundle = lod_bundle(rng, asset, 32)
    is_fine = bundle.clusters.level == 0
    filters = np.where(is_fine, np.float32(filter_px2), bundle.clusters.filter_px2)
    antialiased = np.where(is_fine, np.uint8(is_antialiased), bundle.clusters.antialiased)
    bundle = Bundle(
        replace(bundle.clusters, filter_px2=filters, antialiased=antialiased),
        bundle.groups,
        bundle.gaussians,
    )
    soft, hard = (
        select(bundle, CAMERA, tolerance=0.0, fade=fade, device=device) for fade in (1.05, None)
    )
    assert (hard.filters_px2 == np.float32(filter_px2)).all()
    assert (hard.antialiased == bool(is_antialiased)).all()
    assert (soft.weights == 1).all()
    expected, compensates = (filter_px2, bool(is_antialiased)) if filter_px2 else (0.05, True)
    assert (soft.filters_px2 == np.float32(expected)).all()
    assert (soft.antialiased == compensates).all()
    shown = rasterize(
        soft.gaussians(device=device), CAMERA, filter_px2=expected, antialiased=compensates
    )
    drawn = render(bundle, CAMERA, cut=soft, min_transmittance=1e-4, device=device)
    assert_close(arrays(drawn)[:2], arrays(shown)[:2])
    image = render(bundle, CAMERA, tolerance=0.0, fade=1.05, device=device)
    assert_same_bytes(image, render(bundle, CAMERA, cut=soft, device=device))
    still = render(bundle, CAMERA, tolerance=0.0, device=device)
    assert_same_bytes(still, render(bundle, CAMERA, cut=hard, device=device))
    is_other = np.abs(arrays(image)[1] - arrays(still)[1]).max() > 0.02
    assert is_other == (filter_px2 == 0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("distance", [3, 10, 30, 60])
def test_a_surface_of_tiny_gaussians_does_not_become_transparent(distance, device):
    """The gaussians are far smaller than the filter. Each alone would have an alpha
    below the smallest one that is drawn."""
    rng = np.random.default_rng(1)
    means = rng.normal(size=(50_000, 3))
    means /= np.linalg.norm(means, axis=1, keepdims=True)
    count = len(means)
    sphere = Gaussians(
        means.astype(np.float32),
        np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        np.full((count, 3), 0.01, np.float32),
        np.full(count, 0.5, np.float32),
        np.ones((count, 1, 3), np.float32),
    )
    bundle = lod_bundle(rng, sphere, 1 << 20, past_root=0)
    camera = Camera.look_at((0, -distance, 0), (0, 0, 0), width=160, height=160)
    options = {"tolerance": 0.0, "device": device}
    truth = host(render(bundle, camera.scaled(8), **options).alpha).sum() / 64
    assert host(render(bundle, camera, fade=1.05, **options).alpha).sum() == pytest.approx(
        truth, rel=0.1
    )


@pytest.mark.parametrize("device", DEVICES)
def test_levels_that_are_drawn_alike_without_a_fade_are_not_with_one(device):
    """The last clusters of level 0 and the first of level 1 are drawn directly one
    after the other, each with its own filter."""
    rng = np.random.default_rng(5)
    bundle = lod_bundle(rng, blob(rng, 240, size=0.02), 60, filter_px2=0.0)
    clusters = replace(bundle.clusters, antialiased=np.ones_like(bundle.clusters.antialiased))
    bundle = Bundle(clusters, bundle.groups, bundle.gaussians)
    assert (bundle.clusters.level[:8] == 0).sum() == 4
    both = 0
    for tolerance in np.geomspace(1, 1e4, 40):
        options = {"tolerance": float(tolerance), "fade": 4.0, "device": device}
        cut = select(bundle, CAMERA, **{**options, "device": "cpu"})
        both += {0, 1} <= set(bundle.clusters.level[cut.cluster_ids].tolist())
        image = render(bundle, CAMERA, **options)
        assert_like_cpu(image, render(bundle, CAMERA, **{**options, "device": "cpu"}))
        assert_same_bytes(image, render(bundle, CAMERA, cut=cut, device=device))
    assert both > 3


def test_weights_of_a_cut_may_be_any_numbers():
    bundle = lod_bundle(np.random.default_rng(8), blob(np.random.default_rng(8), 300), 32)
    cut = select(bundle, CAMERA, tolerance=2.0, device="cpu")
    for ones in (
        np.ones(len(cut)),
        np.ones(len(cut), np.int64),
        np.ones(2 * len(cut), np.float32)[::2],
    ):
        faded_cut = replace(cut, given_weights=ones)
        assert faded_cut.weights.dtype == np.float32
        assert (faded_cut.filters_px2 > 0).all()
        render(bundle, CAMERA, cut=faded_cut, device="cpu")


@pytest.mark.parametrize("fade", [None, 1.05])
def test_filters_of_no_gaussians_have_their_types(fade):
    cut = select(Scene(), CAMERA, fade=fade, device="cpu")
    assert cut.filters_px2.dtype == np.float32
    assert cut.antialiased.dtype == np.bool_


@pytest.mark.parametrize("device", DEVICES)
def test_what_has_no_weight_is_not_drawn(device):
    bundle = lod_bundle(np.random.default_rng(8), blob(np.random.default_rng(8), 900), 32)
    cut = select(bundle, CAMERA, tolerance=2.0, fade=1.2, device="cpu")
    weights = np.where(np.arange(len(cut)) % 3 == 0, 0, cut.weights).astype(np.float32)
    some = np.flatnonzero(weights > 0)
    fewer = replace(
        cut,
        instance_ids=cut.instance_ids[some],
        cluster_ids=cut.cluster_ids[some],
        given_weights=weights[some],
    )
    image = render(bundle, CAMERA, cut=replace(cut, given_weights=weights), device=device)
    assert_same_bytes(image, render(bundle, CAMERA, cut=fewer, device=device))
    assert arrays(image)[1].max() > 0.5


@pytest.mark.parametrize("fade", [0.99, 0, -1, np.nan, np.inf, 1001, "much", [1.05]])
def test_fades_out_of_range_are_refused(fade):
    bundle = random_bundle(1)
    for draw in (select, render):
        with pytest.raises(
            ValueError, match=r"fade: expected None or a factor from 1 to 1000, got"
        ):
            draw(bundle, CAMERA, fade=fade, device="cpu")


def test_weights_that_are_none_are_refused():
    bundle, ids = random_bundle(1), np.zeros(1, np.int32)
    for weights in ([-0.1], [1.1], [np.nan], [0.5, 0.5]):
        with pytest.raises(ValueError, match="given_weights: expected 1 numbers from 0 to 1, got"):
            Selection(Scene.of(bundle), ids, ids, 1, 0.0, 0.0, given_weights=np.float32(weights))
    for others in (["much"], [None], "much", [1j]):
        with pytest.raises(ValueError, match="given_weights: expected 1 numbers from 0 to 1, got"):
            Selection(Scene.of(bundle), ids, ids, 1, 0.0, 0.0, given_weights=others)


def test_the_papers_footprint_has_no_fade():
    with pytest.raises(ValueError, match="fade: expected None with the paper's footprint"):
        select(random_bundle(1), CAMERA, footprint="paper", fade=1.05, device="cpu")


@pytest.mark.gpu
def test_both_devices_choose_the_same_with_the_same_weights():
    rng = np.random.default_rng(21)
    below = 0
    for _ in range(60):
        scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 8, past_root=2), 200, spread=10)
        scene.add(
            random_bundle(int(rng.integers(1 << 30)), num_levels=4),
            positions=rng.normal(size=(5, 3)),
        )
        scene.set_importance(np.exp(rng.normal(size=len(scene))))
        camera = random_camera(rng)
        metric = np.concatenate(group_metrics(scene, camera))
        options = {
            "tolerance": float(rng.choice(metric[np.isfinite(metric)]))
            * np.exp(0.02 * rng.normal()),
            "fade": float(rng.choice([1.01, 1.05, 1.3, 4.0])),
            "min_level": int(rng.choice([0, 0, 2])),
            "cull": bool(rng.random() < 0.5),
        }
        if rng.random() < 0.5:
            least = select(
                scene, camera, **options | {"tolerance": np.inf}, device="cpu"
            ).num_gaussians
            options["budget"] = int(least * rng.uniform(1, 4))
        cpu, cuda = (select(scene, camera, **options, device=device) for device in ("cpu", "cuda"))
        same(cpu, cuda)
        below += int((cpu.weights < 1).sum())
    assert below > 1000


@pytest.mark.gpu
@pytest.mark.parametrize("sh_degree", [0, 1, 3])
@pytest.mark.parametrize("fade", [1.05, 2.0])
def test_faded_scene_looks_as_on_the_cpu(sh_degree, fade):
    scene = composed_scene(np.random.default_rng(sh_degree), sh_degree)
    for options in ({"tolerance": 2.0}, {"budget": 9000}, {"tolerance": np.inf}):
        images = [
            render(scene, CAMERA, **options, fade=fade, device=device) for device in ("cuda", "cpu")
        ]
        assert_like_cpu(*images)
    metric = np.concatenate(group_metrics(scene, CAMERA))
    between = {"tolerance": float(np.median(metric[np.isfinite(metric)])), "fade": fade}
    cut = select(scene, CAMERA, **between, device="cpu")
    assert (cut.weights < 1).any()
    drawn = render(scene, CAMERA, **between, device="cuda")
    assert_same_bytes(render(scene, CAMERA, cut=cut, device="cuda"), drawn)


@pytest.mark.gpu
def test_faded_gaussians_are_the_same_on_both_devices():
    scene = composed_scene(np.random.default_rng(9))
    cut = select(scene, CAMERA, tolerance=2.0, fade=1.5, device="cpu")
    cpu, cuda = (cut.gaussians(device=device) for device in ("cpu", "cuda"))
    np.testing.assert_array_equal(cpu.opacities, host(cuda.opacities))
