"""Counts the paths from a leaf to a root on which not exactly one cluster is selected.
There must be none.

A trial is an instance, a camera and a tolerance. Each leaf gets a random 64-bit number.
Each group gets the sum of the numbers below it, split at random over the clusters that
it made. If every path has exactly one selected cluster, the numbers of the selected
clusters add up to those of all leaves; otherwise they do so only with probability
2^-64.

With a fade, the numbers are multiplied by the weights. Then the weights have to add up
to exactly 1 on every path; they are multiples of 1 / WHOLE. An error is missed with
probability 2^-49.
"""

import time

import numpy as np

from partial import arrived, closed_residency, random_begins, random_shift, resident_scene, rule
from random_bundle import random_bundle
from scenes_lod import blob, group_metrics, lod_bundle
from v3dg import Camera, Scene, select

BATCH = 10_000  # instances that share a camera and a tolerance
WHOLE = 1 << 15  # a weight of 1, in units of the smallest weight


def numbers_of_clusters(bundle, rng):
    """Return (C,) uint64 numbers, and their sum over any exact cut."""
    clusters, groups = bundle.clusters, bundle.groups
    number = rng.integers(1 << 64, size=len(clusters), dtype=np.uint64)
    for g in range(len(groups)):  # groups are ordered by level, so those below are final
        below, made = (
            np.flatnonzero(links == g) for links in (clusters.parent_group, clusters.own_group)
        )
        number[made[-1]] = 0
        number[made[-1:]] = number[below].sum(dtype=np.uint64) - number[made].sum(keepdims=True)
    return number, number[clusters.parent_group < 0].sum(dtype=np.uint64)


def random_trees(rng):
    """Return trees and groupings of several shapes."""
    bundles = [
        lod_bundle(rng, blob(rng, 1500, origin=origin), 12, group_size=group_size, past_root=3)
        for group_size, origin in ((2, 0.0), (4, 0.0), (8, 10.0), (32, 1e4))
    ]
    return bundles + [
        random_bundle(int(rng.integers(1 << 31)), num_levels=n, max_fan=4) for n in (2, 4, 6)
    ]


def log_uniform(rng, low, high, size=None):
    return 10 ** rng.uniform(np.log10(low), np.log10(high), size)


def random_batch(bundle, rng, count):
    """Return a scene of instances, a camera among or around them, and a tolerance at
    which most cuts are between the leaves and the root."""
    radius = float(bundle.groups.ball[:, 3].max(initial=1.0))
    center = bundle.groups.ball[-1, :3].astype(np.float64) if len(bundle.groups) else np.zeros(3)
    origin = rng.choice([0.0, 1e3, 1e6]) * rng.normal(size=3)
    quaternions = rng.normal(size=(count, 4))
    scales = log_uniform(rng, 1e-2, 1e2, count)
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    # The distance ranges from within the ball to a few radii or to very many, in units
    # of the instance.
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
    # The metric of some group of some instance, exactly or approximately.
    i = int(rng.integers(count))
    one = Scene()
    one.add(bundle, scene.positions[i], quaternions[i], scales[i])
    metrics = group_metrics(one, camera)[0]
    metrics = metrics[np.isfinite(metrics)]
    if len(metrics) == 0:
        return scene, camera, 1.0, False
    is_tie = bool(rng.random() < 0.5)
    return (
        scene,
        camera,
        float(rng.choice(metrics)) * (1 if is_tie else np.exp(rng.normal())),
        is_tie,
    )


def count_wrong(instance_ids, cluster_ids, num_instances, number, whole, parts=None):
    """Return the instances whose selected clusters, multiplied by their weights, do not
    add up to the whole."""
    bounds = np.searchsorted(instance_ids, np.arange(num_instances + 1))
    terms = number[cluster_ids]
    if parts is not None:
        terms, whole = terms * parts.astype(np.uint64), np.array([whole]) * np.uint64(WHOLE)
    sums = np.concatenate([np.zeros(1, np.uint64), np.cumsum(terms, dtype=np.uint64)])
    return int((np.diff(sums[bounds]) != whole).sum())


def check_counting(bundle, number, whole):
    """Check that a cut counts as right, and as wrong with a cluster removed, doubled or
    replaced by its neighbour."""
    cut = np.flatnonzero(bundle.clusters.own_group < 0).astype(np.int32)
    others = [cut[1:], np.append(cut, cut[:1]), np.append(cut[1:], len(number) - 1)]
    for cluster_ids, wrong in [(cut, 0), *((other, 1) for other in others)]:
        if (
            count_wrong(np.zeros(len(cluster_ids), np.int32), cluster_ids, 1, number, whole)
            != wrong
        ):
            raise AssertionError("the count of violations does not count")
    ids, parts = np.zeros(len(cut), np.int32), np.full(len(cut), WHOLE)
    for change in (0, -1):
        parts[-1] += change
        if count_wrong(ids, cut, 1, number, whole, parts) != (change != 0):
            raise AssertionError("the count of violations does not count weights")


def random_options(rng, bundle, tolerance):
    """Return random further options of a view, which change the drawn clusters but not
    the sums on paths."""
    min_level = int(rng.choice([0, 0, rng.integers(bundle.num_levels + 1)]))
    return {
        "tolerance": tolerance,
        "min_level": min_level,
        "fade": float(rng.choice([1.01, 1.05, 1.3, 4.0])),
    }


def parts_of(weights):
    """Return (S,) weights as integers; raise an error if a weight is 0 or not a
    multiple."""
    parts = weights.astype(np.float64) * WHOLE
    if not ((parts > 0) & (parts <= WHOLE) & (parts == np.round(parts))).all():
        raise AssertionError("weights: expected positive whole parts of at most 1")
    return parts.astype(np.int64)


def cut_of(scene, camera, options, pages, device):
    """Return the cut, with pages that are partly resident and fading in, or with all
    pages; and its time in seconds."""
    if pages is None:
        selection = select(scene, camera, **options, cull=False, device=device)
        return selection, selection.seconds
    begin = time.perf_counter()
    shift, begins, frame = pages
    core = resident_scene(scene, [shift], device, begins=[begins])
    cut = core.select(camera.core, rule(**options, cull=False, frame=frame))
    return cut, time.perf_counter() - begin


def run_trials(num_trials, bundles=None, *, seed=0, device="cpu", partial=False, fades=False):
    """Return the violations among the trials, and statistics of the trials; random
    trees are used if no bundles are given.

    With ``partial``, the resident pages are closed towards the root and differ between
    cameras. With ``fades``, views also have random fades, finest levels, importances
    and budgets, and pages fade in.
    """
    rng = np.random.default_rng(seed)
    bundles = bundles or random_trees(rng)
    numbers = [numbers_of_clusters(bundle, rng) for bundle in bundles]
    check_counting(bundles[0], *numbers[0])
    trials = wrong = ties = drawn = at_ends = between = fading = 0
    seconds = 0.0
    start = time.perf_counter()
    while trials < num_trials:
        b = int(rng.integers(len(bundles)))
        count = min(BATCH, num_trials - trials)
        scene, camera, tolerance, is_tie = random_batch(bundles[b], rng, count)
        pages, options, parts = None, {"tolerance": tolerance}, None
        if partial:
            shift, _ = random_shift(rng, bundles[b], closed_residency(rng, bundles[b]))
            pages = shift, *random_begins(rng, bundles[b])
            fading += int(np.isin(arrived(*pages[1:]), (0, 1), invert=True).sum())
        if fades:
            options = random_options(rng, bundles[b], tolerance)
            scene.set_importance(log_uniform(rng, 0.1, 10, count))
        selection, took = cut_of(scene, camera, options, pages, device)
        if fades:
            if rng.random() < 0.5:
                least, _ = cut_of(scene, camera, options | {"tolerance": np.inf}, None, device)
                options["budget"] = least.num_gaussians + int(
                    rng.integers(selection.num_gaussians + 1)
                )
                selection, took = cut_of(scene, camera, options, pages, device)
                wrong += pages is None and selection.num_gaussians > options["budget"]
            parts = parts_of(selection.weights)
            between += int((parts < WHOLE).sum())
        wrong += count_wrong(
            selection.instance_ids, selection.cluster_ids, count, *numbers[b], parts
        )
        seconds += took
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
        **({"pages_that_fade_in": fading} if fades and partial else {}),
        **({"selected_with_weights_below_1": between / max(drawn, 1)} if fades else {}),
        "select_seconds": seconds,
        "seconds": time.perf_counter() - start,
    }
