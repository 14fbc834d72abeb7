"""The cut of a scene of which only some pages are resident is exact, and reports the
pages that are missing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from devices import host, on
from exact_cut import (
    WHOLE,
    count_wrong,
    numbers_of_clusters,
    parts_of,
    random_batch,
    random_trees,
    run_trials,
)
from partial import (
    ABSENT,
    arrived,
    closed_residency,
    page_rows,
    random_begins,
    random_shift,
    resident_scene,
    rule,
)
from random_bundle import random_bundle
from scenes_lod import blob, group_metrics, lod_bundle, random_camera, random_scene
from v3dg import Gaussians, Scene, _core, select
from v3dg._device import CPU
from v3dg.residency import residency

seeds = st.integers(0, 2**32 - 1)
fades = st.sampled_from([None, 1.05, 4.0])


def scene_of(rng, *, sh_degree=0):
    """Return instances of two bundles. One has the layout of a build, and the other is
    a tree of any shape."""
    asset = blob(rng, int(rng.integers(1, 400)), sh_degree=sh_degree)
    scene = random_scene(rng, lod_bundle(rng, asset, int(rng.integers(2, 30))), 5)
    tree = random_bundle(
        int(rng.integers(1 << 30)), num_levels=int(rng.integers(1, 6)), sh_degree=sh_degree
    )
    scene.add(tree, positions=rng.normal(size=(3, 3)), importance=np.float32(rng.uniform(0.1, 10)))
    return scene


def partly_there(rng, scene):
    """For each bundle, return which pages are resident, and where they are."""
    there = [closed_residency(rng, bundle) for bundle in scene.bundles]
    return there, [random_shift(rng, b, t)[0] for b, t in zip(scene.bundles, there, strict=True)]


def a_tolerance(rng, scene, camera):
    """Return the metric of some group, or a value close to it."""
    metrics = np.concatenate(group_metrics(scene, camera))
    metrics = metrics[np.isfinite(metrics)]
    return float(rng.choice(metrics)) * float(rng.choice([1.0, 0.7])) if len(metrics) else 1.0


@pytest.mark.parametrize("fades", [False, True])
def test_every_path_has_exactly_one_cluster(device, fades):
    """With fades, the weights on a path add up to exactly one."""
    result = run_trials(200_000, device=device, partial=True, fades=fades)
    assert result["violations"] == 0
    assert result.get("pages_that_fade_in", 100) >= 100
    assert result.get("selected_with_weights_below_1", 1) > 0.1


def test_pages_that_fade_in_before_those_above_them_would_be_counted():
    rng = np.random.default_rng(0)
    bundle = random_trees(rng)[0]
    number, whole = numbers_of_clusters(bundle, rng)
    shift, _ = random_shift(rng, bundle, np.ones(bundle.num_pages, bool))
    begins = rng.integers(0, 8, bundle.num_pages).astype(np.int32)
    wrong = 0
    for _ in range(10):
        scene, camera, tolerance, _ = random_batch(bundle, rng, 200)
        core = resident_scene(scene, [shift], begins=[begins])
        cut = core.select(camera.core, rule(tolerance, fade=1.3, cull=False, frame=8))
        wrong += count_wrong(
            cut.instance_ids, cut.cluster_ids, 200, number, whole, parts_of(cut.weights)
        )
    assert wrong > 100


@settings(max_examples=60)
@given(seed=seeds, fade=fades)
def test_groups_are_refined_as_far_as_their_pages_have_faded_in(seed, fade):
    rng = np.random.default_rng(seed)
    scene = scene_of(rng)
    camera = random_camera(rng)
    tolerance = a_tolerance(rng, scene, camera)
    there, shifts = partly_there(rng, scene)
    begins, frames = zip(*(random_begins(rng, bundle) for bundle in scene.bundles), strict=True)
    frame = int(rng.choice(frames))
    one = rule(tolerance, fade=fade, cull=False, frame=frame)
    core = resident_scene(scene, shifts, begins=begins)
    cut = core.select(camera.core, one)
    if fade is None:  # nothing fades in
        np.testing.assert_array_equal(
            cut.cluster_ids, resident_scene(scene, shifts).select(camera.core, one).cluster_ids
        )
        return
    for i, metric in enumerate(group_metrics(scene, camera)):
        b = scene.instance_bundle[i]
        low, high = tolerance / fade, tolerance * fade
        ramp = (np.clip(metric.astype(np.float64), low, high) - low) / (high - low)
        refined = np.minimum(ramp, (arrived(begins[b], frame) * there[b])[:-1])
        clusters, mine = scene.bundles[b].clusters, cut.instance_ids == i
        expected = (
            np.append(refined, 1.0)[clusters.parent_group]
            - np.append(refined, 0.0)[clusters.own_group]
        )
        weights = np.zeros(len(clusters))
        weights[cut.cluster_ids[mine]] = cut.weights[mine]
        np.testing.assert_allclose(weights, expected, atol=2 / WHOLE)


@pytest.mark.parametrize("fade", [None, 1.3])
def test_violations_would_be_counted(fade):
    """If pages were resident without their ancestors, the cut would be drawn twice.

    The test must detect this.
    """
    rng = np.random.default_rng(0)
    bundle = random_trees(rng)[0]
    number, whole = numbers_of_clusters(bundle, rng)
    there = rng.random(bundle.num_pages) < 0.7
    there[-1] = True
    shift, _ = random_shift(rng, bundle, there)
    wrong = 0
    for _ in range(10):
        scene, camera, tolerance, _ = random_batch(bundle, rng, 200)
        cut = resident_scene(scene, [shift]).select(
            camera.core, rule(tolerance, fade=fade, cull=False)
        )
        parts = None if fade is None else parts_of(cut.weights)
        wrong += count_wrong(cut.instance_ids, cut.cluster_ids, 200, number, whole, parts)
    assert wrong > 100


@settings(max_examples=60)
@given(seed=seeds)
def test_cut_refines_what_is_wanted_and_there(seed):
    rng = np.random.default_rng(seed)
    scene = scene_of(rng)
    camera, min_level = random_camera(rng), int(rng.integers(0, 3))
    tolerance = a_tolerance(rng, scene, camera)
    there, shifts = partly_there(rng, scene)
    cut = resident_scene(scene, shifts).select(
        camera.core, rule(tolerance, None, min_level, cull=False)
    )
    expected = []
    for i, metrics in enumerate(group_metrics(scene, camera)):
        b = scene.instance_bundle[i]
        clusters, levels = scene.bundles[b].clusters, scene.bundles[b].groups.level
        refined = (metrics > np.float32(tolerance)) & (levels > min_level) & there[b][:-1]
        own = np.append(refined, False)[clusters.own_group]
        parent = np.append(refined, True)[clusters.parent_group]
        expected += [(i, c) for c in np.flatnonzero(parent & ~own)]
    assert list(zip(cut.instance_ids, cut.cluster_ids, strict=True)) == expected
    for i, c in expected:
        bundle = scene.bundles[scene.instance_bundle[i]]
        assert there[scene.instance_bundle[i]][bundle.clusters.parent_group[c]]


@settings(max_examples=60)
@given(seed=seeds, has_budget=st.booleans(), min_level=st.integers(0, 2), fade=fades)
def test_loading_what_is_missing_leads_to_the_cut_of_all_pages(seed, has_budget, min_level, fade):
    rng = np.random.default_rng(seed)
    scene = scene_of(rng)
    camera = random_camera(rng)
    options = {"tolerance": a_tolerance(rng, scene, camera), "min_level": min_level, "fade": fade}
    if has_budget:
        least = select(scene, camera, tolerance=np.inf, device="cpu").num_gaussians
        most = select(scene, camera, tolerance=0, device="cpu").num_gaussians
        options |= {"budget": int(rng.integers(least, max(least, most) + 1)), "tolerance": 0.0}
    whole = select(scene, camera, device="cpu", **options)
    there = [closed_residency(rng, bundle, share=0.3) for bundle in scene.bundles]
    shifts = [random_shift(rng, b, t)[0] for b, t in zip(scene.bundles, there, strict=True)]
    core = resident_scene(scene, shifts)  # the result borrows the arrays
    asked = [np.zeros(len(shift), bool) for shift in shifts]
    for _ in range(100):
        needs = core.page_needs(camera.core, rule(**options))
        missing = [
            np.flatnonzero((n > 1) & (s == ABSENT)) for n, s in zip(needs, shifts, strict=True)
        ]
        if not any(map(len, missing)):
            break
        for ever, pages in zip(asked, missing, strict=True):
            ever[pages] = True
        for bundle, shift, pages in zip(scene.bundles, shifts, missing, strict=True):
            for page in pages:
                while shift[page] == ABSENT:  # with all pages above it
                    shift[page] = 0
                    page = bundle.groups.parent[page]
    cut = core.select(camera.core, rule(**options))
    assert cut.tolerance_px2 == np.float32(whole.tolerance)
    np.testing.assert_array_equal(cut.instance_ids, whole.instance_ids)
    np.testing.assert_array_equal(cut.cluster_ids, whole.cluster_ids)
    np.testing.assert_array_equal(weights_of(cut), whole.weights)
    # A missing page must still be needed, or be an ancestor of a page that is nearly
    # needed. Otherwise it would be evicted and be missing again.
    for bundle, ever, need in zip(scene.bundles, asked, needs, strict=True):
        # the coarsest page never counts as missing
        above = np.append(bundle.groups.parent, -1)
        needed = np.zeros(len(ever), bool)
        for asking in np.flatnonzero(need > 0):
            page = asking if need[asking] > 1 else above[asking]
            while page >= 0 and not needed[page]:
                needed[page] = True
                page = above[page]
        assert not (ever & ~needed).any()


def weights_of(cut):
    return cut.weights if len(cut.weights) else np.ones(len(cut.cluster_ids), np.float32)


@settings(max_examples=30)
@given(seed=seeds, fade=fades)
def test_needs_are_what_the_cut_draws_or_misses(seed, fade):
    rng = np.random.default_rng(seed)
    scene = scene_of(rng)
    camera = random_camera(rng)
    one = rule(a_tolerance(rng, scene, camera), fade=fade)
    _, shifts = partly_there(rng, scene)
    core = resident_scene(scene, shifts)
    cut, needs = core.select(camera.core, one), core.page_needs(camera.core, one)
    for i, c in zip(cut.instance_ids, cut.cluster_ids, strict=True):
        b = scene.instance_bundle[i]
        clusters = scene.bundles[b].clusters
        own, page = clusters.own_group[c], clusters.parent_group[c]
        asks_for_finer = own >= 0 and needs[b][own] > 0
        assert page < 0 or needs[b][page] > 1 or asks_for_finer


def test_all_pages_are_as_good_as_no_table(device):
    rng = np.random.default_rng(1)
    for _ in range(10):
        scene = scene_of(rng)
        camera = random_camera(rng)
        shifts = [
            random_shift(rng, b, np.ones(max(b.num_pages, 1), bool))[0] for b in scene.bundles
        ]
        core = resident_scene(scene, shifts, device)
        tolerance = a_tolerance(rng, scene, camera)
        for options in (
            {},
            {"budget": 300},
            {"min_level": 1},
            {"fade": 1.3},
            {"fade": 1.3, "budget": 300},
        ):
            try:
                whole = select(scene, camera, tolerance=tolerance, device=device, **options)
            except ValueError:
                continue  # over the budget
            cut = core.select(camera.core, rule(tolerance, **options))
            np.testing.assert_array_equal(cut.cluster_ids, whole.cluster_ids)
            np.testing.assert_array_equal(cut.instance_ids, whole.instance_ids)
            np.testing.assert_array_equal(weights_of(cut), whole.weights)


@pytest.mark.gpu
def test_both_devices_choose_the_same_of_what_is_there():
    rng = np.random.default_rng(3)
    below = 0
    for k in range(40):
        scene, camera = scene_of(rng), random_camera(rng)
        there = [closed_residency(rng, bundle) for bundle in scene.bundles]
        shifts = [random_shift(rng, b, t)[0] for b, t in zip(scene.bundles, there, strict=True)]
        begins, frames = zip(*(random_begins(rng, bundle) for bundle in scene.bundles), strict=True)
        fade, frame = [None, 1.05, 1.3, 4.0][k % 4], int(rng.choice(frames))
        one = rule(a_tolerance(rng, scene, camera), fade=fade, frame=frame)
        cpu, cuda = (
            resident_scene(scene, shifts, device, begins=begins).select(camera.core, one)
            for device in ("cpu", "cuda")
        )
        np.testing.assert_array_equal(cpu.instance_ids, cuda.instance_ids)
        np.testing.assert_array_equal(cpu.cluster_ids, cuda.cluster_ids)
        np.testing.assert_array_equal(cpu.weights, cuda.weights)
        below += int((cpu.weights < 1).sum())
    assert below > 100


@pytest.mark.parametrize("fade", [None, 1.5])
def test_pages_are_drawn_from_wherever_they_lie(device, fade):
    """If the same pages lie in another order, with other rows in between, the cut is
    the same."""
    rng = np.random.default_rng(2)
    for _ in range(5):
        scene = Scene()
        bundle = lod_bundle(rng, blob(rng, 300, sh_degree=1), 12)
        scene.add(bundle, positions=rng.normal(size=(3, 3)))
        camera = random_camera(rng)
        one = rule(a_tolerance(rng, scene, camera), fade=fade)
        there = closed_residency(rng, bundle, share=0.8)
        in_order = np.where(there, 0, ABSENT)
        shift, num_rows = random_shift(rng, bundle, there)
        rows = moved_rows(bundle, shift, num_rows)
        pictures = []
        for places, gaussians in ((in_order, bundle.gaussians), (shift, rows)):
            core = resident_scene(scene, [places], device)
            frame = _core.SceneFrame(-1 if device == "cpu" else 0)
            frame.set_models([_core.Model(on(device, gaussians).rows)], [])
            shade = _core.Shade(background=[0.0, 0.0, 0.0], min_transmittance=1e-4, with_depth=True)
            drawing = frame.draw(core, _core.FrameRequest(camera.core, one, shade))
            assert drawing.finish().gaussians > 0
            pictures.append(host((drawing.color, drawing.alpha, drawing.depth)))
        for one_plane, other in zip(*pictures, strict=True):
            np.testing.assert_array_equal(one_plane, other)


def moved_rows(bundle, shift, num_rows):
    """Return the bundle's gaussians at their places, with NaN in between."""
    count = max(num_rows, bundle.num_gaussians)
    arrays = {
        n: np.full((count, *a.shape[1:]), np.nan, np.float32)
        for n, a in vars(bundle.gaussians).items()
    }
    first, length = page_rows(bundle)
    for page in np.flatnonzero(shift != ABSENT):
        source = slice(first[page], first[page] + length[page])
        place = slice(source.start + shift[page], source.stop + shift[page])
        for name, array in arrays.items():
            array[place] = getattr(bundle.gaussians, name)[source]
    return Gaussians(**arrays)


def test_wrong_shape_of_pages_is_refused():
    bundle = random_bundle(0)
    with pytest.raises(ValueError, match="page_shift"):
        _core.ClusterTable(
            **vars(bundle.clusters)
            | {n: getattr(bundle.groups, n) for n in ("ball", "weight", "level")},
            page_shift=np.zeros(2, np.int64),
        )
    assert residency.scene(bundle, CPU).core.page_needs(
        random_camera(np.random.default_rng(0)).core, rule()
    )
