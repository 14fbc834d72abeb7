"""When groups of eight clusters are skipped together, none of the clusters is drawn."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from random_bundle import random_bundle
from scenes_lod import blob, group_metrics, instances_of, lod_bundle, random_camera, random_scene
from v3dg import _core, select
from v3dg.residency import residency
from v3dg.select import rule_of

seeds = st.integers(0, 2**32 - 1)
TOGETHER = 8


def may_draw(
    scene, camera, *, tolerance, min_level=0, footprint="solid_angle", cull=True, and_coarser=False
):
    """For each instance, return which clusters may be drawn."""
    rule = rule_of(tolerance, None, min_level, footprint, cull=cull)
    tables = [residency.table(bundle) for bundle in scene.bundles]
    flags, first = _core.bounds_may_draw(
        tables, instances_of(scene), camera.core, rule, and_coarser
    )
    counts = [len(scene.bundles[b].clusters.level) for b in scene.instance_bundle]
    return [
        np.repeat(flags[first[i] : first[i + 1]].astype(bool), TOGETHER)[:count]
        for i, count in enumerate(counts)
    ]


def drawn(scene, camera, **options):
    """For each instance, return which clusters are drawn."""
    cut = select(scene, camera, device="cpu", **options)
    masks = [np.zeros(len(scene.bundles[b].clusters.level), bool) for b in scene.instance_bundle]
    for i, c in zip(cut.instance_ids, cut.cluster_ids, strict=True):
        masks[i][c] = True
    return masks


def scene_of(rng):
    """Return a scene, near or far, with trees of any shape and bundles with the layout
    of a build."""
    origin, size = rng.choice([0.0, 10.0, 1e4]), rng.choice([1e-3, 1.0, 100.0])
    asset = blob(rng, int(rng.integers(1, 400)), origin=origin, size=size)
    scene = random_scene(rng, lod_bundle(rng, asset, int(rng.integers(2, 30))), 6, spread=4 * size)
    tree = random_bundle(int(rng.integers(1 << 30)), num_levels=int(rng.integers(0, 6)))
    scene.add(tree, positions=rng.normal(size=(3, 3)))
    return scene


@settings(max_examples=200)
@given(
    seed=seeds,
    distance=st.sampled_from([1e-3, 0.3, 5.0, 100.0, 1e6]),
    min_level=st.integers(0, 2),
    footprint=st.sampled_from(["solid_angle", "paper"]),
    cull=st.booleans(),
)
def test_what_is_drawn_is_never_passed_over(seed, distance, min_level, footprint, cull):
    rng = np.random.default_rng(seed)
    scene, options = scene_of(rng), {"min_level": min_level, "footprint": footprint, "cull": cull}
    camera = random_camera(rng, distance=distance)
    metrics = np.concatenate(group_metrics(scene, camera))
    exact = metrics[np.isfinite(metrics)] if np.isfinite(metrics).any() else np.zeros(1)
    tolerances = sorted([0.0, *rng.choice(exact, 4).tolist(), np.inf])
    coarser = may_draw(scene, camera, tolerance=tolerances[0], and_coarser=True, **options)
    for tolerance in tolerances:
        together = may_draw(scene, camera, tolerance=tolerance, **options)
        for one, two, three in zip(
            drawn(scene, camera, tolerance=tolerance, **options), together, coarser, strict=True
        ):
            assert not (one & ~two).any()
            assert not (one & ~three).any()


@pytest.mark.parametrize("seed", range(20))
def test_nothing_is_passed_over_because_a_float_overflows(seed):
    rng = np.random.default_rng(seed)
    scene, camera = scene_of(rng), random_camera(rng, distance=100.0)
    scene.set_importance(10 ** rng.uniform(33, 36, len(scene)))
    metrics = np.concatenate(group_metrics(scene, camera))
    for tolerance in rng.choice(metrics[np.isfinite(metrics) & (metrics > 0)], 20):
        together = may_draw(scene, camera, tolerance=tolerance)
        for one, two in zip(drawn(scene, camera, tolerance=tolerance), together, strict=True):
            assert not (one & ~two).any()


@pytest.mark.parametrize("tolerance", [0.05, 1.0, 20.0])
def test_much_of_what_is_not_drawn_is_passed_over(tolerance):
    rng = np.random.default_rng(3)
    bundle = lod_bundle(rng, blob(rng, 20000), 16)
    scene = random_scene(rng, bundle, 4, spread=10)
    camera = random_camera(rng, distance=60.0)
    passed = np.concatenate([~m for m in may_draw(scene, camera, tolerance=tolerance)])
    left = np.concatenate([~m for m in drawn(scene, camera, tolerance=tolerance)])
    assert passed.sum() > 0.3 * left.sum()
