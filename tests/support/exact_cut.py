"""Counts how often a path from a leaf to a root has not exactly one selected cluster: it must be never.

A trial is an instance, a camera and a tolerance. Each leaf gets a random 64-bit number, each group the sum
of the numbers below it, split at random over the clusters that it made. Then the numbers of the selected
clusters add up to those of all leaves if every path has exactly one; if not, with a chance of 2^-64.
"""

import time

import numpy as np

from partial import closed_residency, random_shift, resident_scene, rule
from random_bundle import random_bundle
from scenes_lod import blob, group_metrics, lod_bundle
from v3dg import Camera, Scene, select

BATCH = 10_000  # instances that share a camera and a tolerance


def numbers_of_clusters(bundle, rng):
    """(C,) uint64 and their sum over any exact cut."""
    clusters, groups = bundle.clusters, bundle.groups
    number = rng.integers(1 << 64, size=len(clusters), dtype=np.uint64)
    for g in range(len(groups)):  # ordered by level, so what is below is final
        below, made = (np.flatnonzero(links == g) for links in (clusters.parent_group, clusters.own_group))
        number[made[-1]] = 0
        number[made[-1:]] = number[below].sum(dtype=np.uint64) - number[made].sum(keepdims=True)
    return number, number[clusters.parent_group < 0].sum(dtype=np.uint64)


def random_trees(rng):
    """Trees and groupings of several shapes."""
    bundles = [
        lod_bundle(rng, blob(rng, 1500, origin=origin), 12, group_size=group_size, past_root=3)
        for group_size, origin in ((2, 0.0), (4, 0.0), (8, 10.0), (32, 1e4))
    ]
    return bundles + [random_bundle(int(rng.integers(1 << 31)), num_levels=n, max_fan=4) for n in (2, 4, 6)]


def log_uniform(rng, low, high, size=None):
    return 10 ** rng.uniform(np.log10(low), np.log10(high), size)


def random_batch(bundle, rng, count):
    """A scene of instances, a camera among or around them, and a tolerance that cuts most of them inside."""
    radius = float(bundle.groups.ball[:, 3].max(initial=1.0))
    center = bundle.groups.ball[-1, :3].astype(np.float64) if len(bundle.groups) else np.zeros(3)
    origin = rng.choice([0.0, 1e3, 1e6]) * rng.normal(size=3)
    quaternions = rng.normal(size=(count, 4))
    scales = log_uniform(rng, 1e-2, 1e2, count)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # From within the ball to a few radii, or to very many; in units of the instance.
    farthest = rng.choice([5.0, 30.0, 1e4])
    distance = radius * scales * log_uniform(rng, 0.3, farthest, count)
    scene = Scene()
    scene.add(bundle, np.zeros((count, 3)), quaternions, scales)
    from_center = distance[:, None] * direction - scales[:, None] * (scene.rotations @ center)
    scene.move(positions=origin + from_center)
    camera = Camera.look_at(
        origin,
        origin + rng.normal(size=3),
        rng.normal(size=3),
        float(rng.uniform(0.2, 2.5)),
        width=int(rng.integers(16, 4096)),
        height=int(rng.integers(16, 4096)),
    )
    # The metric of some group of some instance, exactly or about.
    i = int(rng.integers(count))
    one = Scene()
    one.add(bundle, scene.positions[i], quaternions[i], scales[i])
    metrics = group_metrics(one, camera)[0]
    metrics = metrics[np.isfinite(metrics)]
    if len(metrics) == 0:
        return scene, camera, 1.0, False
    is_tie = bool(rng.random() < 0.5)
    return scene, camera, float(rng.choice(metrics)) * (1 if is_tie else np.exp(rng.normal())), is_tie


def count_wrong(instance_ids, cluster_ids, num_instances, number, whole):
    """Instances whose selected clusters do not add up to the whole."""
    bounds = np.searchsorted(instance_ids, np.arange(num_instances + 1))
    sums = np.concatenate([np.zeros(1, np.uint64), np.cumsum(number[cluster_ids], dtype=np.uint64)])
    return int((np.diff(sums[bounds]) != whole).sum())


def check_counting(bundle, number, whole):
    """A cut is counted as right; with a cluster taken out, doubled or replaced by its neighbour as wrong."""
    cut = np.flatnonzero(bundle.clusters.own_group < 0).astype(np.int32)
    others = [cut[1:], np.append(cut, cut[:1]), np.append(cut[1:], len(number) - 1)]
    for cluster_ids, wrong in [(cut, 0), *((other, 1) for other in others)]:
        if count_wrong(np.zeros(len(cluster_ids), np.int32), cluster_ids, 1, number, whole) != wrong:
            raise AssertionError("the count of violations does not count")


def run_trials(num_trials, bundles=None, *, seed=0, device="cpu", partial=False):
    """Violations among the trials, and what was tried; random trees if no bundles are given.

    With ``partial``, of pages closed towards the root, other ones for each camera.
    """
    rng = np.random.default_rng(seed)
    bundles = bundles or random_trees(rng)
    numbers = [numbers_of_clusters(bundle, rng) for bundle in bundles]
    check_counting(bundles[0], *numbers[0])
    trials = wrong = ties = drawn = at_ends = 0
    seconds = 0.0
    start = time.perf_counter()
    while trials < num_trials:
        b = int(rng.integers(len(bundles)))
        count = min(BATCH, num_trials - trials)
        scene, camera, tolerance, is_tie = random_batch(bundles[b], rng, count)
        if partial:
            shift, _ = random_shift(rng, bundles[b], closed_residency(rng, bundles[b]))
            begin = time.perf_counter()
            selection = resident_scene(scene, [shift], device).select(
                camera.core, rule(tolerance, cull=False)
            )
            seconds += time.perf_counter() - begin
        else:
            selection = select(scene, camera, tolerance=tolerance, cull=False, device=device)
            seconds += selection.seconds
        wrong += count_wrong(selection.instance_ids, selection.cluster_ids, count, *numbers[b])
        trials += count
        ties += is_tie
        drawn += len(selection.cluster_ids)
        ends = (bundles[b].clusters.own_group < 0) | (bundles[b].clusters.parent_group < 0)
        at_ends += int(ends[selection.cluster_ids].sum())
    return {
        "clusters": [len(bundle.clusters) for bundle in bundles],
        "seed": seed,
        "device": device,
        "partial": partial,
        "trials": trials,
        "violations": wrong,
        "batches_with_the_tolerance_a_metric": ties,
        "selected_per_trial": drawn / max(trials, 1),
        "selected_between_leaf_and_root": 1 - at_ends / max(drawn, 1),
        "select_seconds": seconds,
        "seconds": time.perf_counter() - start,
    }
