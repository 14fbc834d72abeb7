import itertools
import os
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from devices import host, on
from reference import cluster as reference
from v3dg import _core

# There are only a few distinct values, so that axes, coordinates and whole points are
# often equal.
coarse_means = hnp.arrays(
    np.float32,
    st.tuples(st.integers(0, 60), st.just(3)),
    elements=st.sampled_from([-1.0, -0.0, 0.0, 0.5, 2.0]),
)
finite = st.floats(-(2.0**100), 2.0**100, width=32)
any_means = hnp.arrays(np.float32, st.tuples(st.integers(0, 40), st.just(3)), elements=finite)


def median_split(device, means, cluster_size):
    depth = _core.num_halvings(len(means), cluster_size)
    return split_segments(device, means, np.array([0, len(means)]), depth)


def split_segments(device, means, offset, depth, unit=1):
    order, leaf_offset = _core.median_split(on(device, means), offset, depth, unit)
    return host(order), leaf_offset


@given(means=st.one_of(coarse_means, any_means), cluster_size=st.integers(1, 9))
def test_split_agrees_with_reference(device, means, cluster_size):
    order, leaf_offset = median_split(device, means, cluster_size)
    leaves = reference.median_split(means, cluster_size)
    np.testing.assert_array_equal(leaf_offset, np.cumsum([0] + [len(leaf) for leaf in leaves]))
    np.testing.assert_array_equal(order, [i for leaf in leaves for i in leaf])


@given(
    num_points=st.integers(0, 3000),
    cluster_size=st.integers(1, 500),
    seed=st.integers(0, 2**32 - 1),
)
def test_leaves_partition_the_points_evenly(device, num_points, cluster_size, seed):
    means = np.random.default_rng(seed).normal(size=(num_points, 3)).astype(np.float32)
    order, leaf_offset = median_split(device, means, cluster_size)
    sizes = np.diff(leaf_offset)
    num_leaves = len(sizes)
    assert num_leaves & (num_leaves - 1) == 0
    assert sizes.max() <= cluster_size
    assert sizes.max() - sizes.min() <= 1
    # The depth is as small as possible.
    assert num_leaves == 1 or -(-num_points // (num_leaves // 2)) > cluster_size
    np.testing.assert_array_equal(np.sort(order), np.arange(num_points))
    for first, last in itertools.pairwise(leaf_offset):
        assert (np.diff(order[first:last]) > 0).all()


@given(means=st.one_of(coarse_means, any_means), unit=st.integers(1, 9))
def test_runs_agree_with_reference(device, means, unit):
    depth = _core.num_halvings(-(-len(means) // unit), 1)
    ends = np.array([0, len(means)])
    order, leaf_offset = split_segments(device, means, ends, depth, unit)
    runs = reference.runs(means, unit)
    np.testing.assert_array_equal(order, [i for run in runs for i in run])
    assert set(leaf_offset) == {0, *np.cumsum([len(run) for run in runs])}
    # All runs except the last are full, so each begins at a multiple of the unit.
    assert all(len(run) == unit for run in runs[:-1])


@given(means=st.one_of(coarse_means, any_means), unit=st.integers(1, 9))
def test_points_in_runs_keep_their_order(device, means, unit):
    depth = _core.num_halvings(-(-len(means) // unit), 1)
    ends = np.array([0, len(means)])
    order, _ = split_segments(device, means, ends, depth, unit)
    again, _ = split_segments(device, means[order], ends, depth, unit)
    np.testing.assert_array_equal(again, np.arange(len(means)))


def test_identical_points_split_by_index(device):
    order, leaf_offset = median_split(device, np.ones((10, 3), np.float32), 3)
    np.testing.assert_array_equal(order, np.arange(10))
    np.testing.assert_array_equal(leaf_offset, [0, 3, 5, 8, 10])


def test_large_split_agrees_with_itself_moved(device):
    means = np.random.default_rng(1).integers(-4096, 4096, size=(100_000, 3)).astype(np.float32)
    order, leaf_offset = median_split(device, means, 64)
    moved_order, moved_offset = median_split(device, means + np.float32(8192), 64)
    np.testing.assert_array_equal(order, moved_order)
    np.testing.assert_array_equal(leaf_offset, moved_offset)


@given(
    lengths=st.lists(st.integers(0, 40), max_size=6),
    depth=st.integers(0, 5),
    unit=st.integers(1, 9),
    seed=st.integers(0, 2**32 - 1),
)
def test_segments_split_as_if_alone(device, lengths, depth, unit, seed):
    offset = np.cumsum([0, *lengths])
    means = np.random.default_rng(seed).integers(-3, 3, size=(offset[-1], 3)).astype(np.float32)
    order, leaf_offset = split_segments(device, means, offset, depth, unit)
    assert len(leaf_offset) == len(lengths) * 2**depth + 1
    for s, (first, last) in enumerate(itertools.pairwise(offset)):
        alone, alone_offset = split_segments(
            "cpu", means[first:last], np.array([0, last - first]), depth, unit
        )
        np.testing.assert_array_equal(order[first:last], first + alone)
        np.testing.assert_array_equal(
            leaf_offset[s * 2**depth : (s + 1) * 2**depth + 1], first + alone_offset
        )


@pytest.mark.gpu
@pytest.mark.parametrize("decimals", [1, 6])
def test_large_splits_are_the_same_on_both_devices(decimals):
    means = np.round(np.random.default_rng(2).normal(size=(150_000, 3)), decimals).astype(
        np.float32
    )
    for split, argument in (
        (median_split, (100,)),
        (split_segments, (np.arange(0, 150_001, 300), 3)),
        (split_segments, (np.arange(0, 150_001, 250), 3, 32)),
    ):
        for got, expected in zip(
            split("cuda", means, *argument), split("cpu", means, *argument), strict=True
        ):
            np.testing.assert_array_equal(got, expected)


@pytest.mark.parametrize(
    ("means", "cluster_size", "message"),
    [
        (np.zeros((4, 2), np.float32), 2, r"means: expected shape \(N, 3\), got \(4, 2\)"),
        (np.zeros((4, 3)), 2, "means: expected dtype float32, got float64"),
        (np.zeros((4, 3), np.float32), 0, "cluster_size: expected at least 1, got 0"),
        (np.full((4, 3), np.nan, np.float32), 2, "means: expected finite values, got nan in row 0"),
        (np.zeros((8, 3), np.float32)[::2], 2, "means: expected a C-contiguous array"),
    ],
)
def test_split_refuses_bad_input(means, cluster_size, message):
    with pytest.raises(ValueError, match=message):
        median_split("cpu", means, cluster_size)


def test_split_refuses_bad_unit():
    with pytest.raises(ValueError, match="unit: expected at least 1, got 0"):
        split_segments("cpu", np.zeros((4, 3), np.float32), np.array([0, 4]), 1, 0)


@pytest.mark.parametrize("offset", [[0, 3], [1, 4], [0, 3, 2, 4], []])
def test_split_refuses_bad_boundaries(offset):
    with pytest.raises(ValueError, match="offset: expected ascending boundaries from 0 to 4"):
        _core.median_split(np.zeros((4, 3), np.float32), np.array(offset, np.int64), 1)


def random_offset(rng, count, num_segments):
    inner = np.sort(rng.integers(0, count + 1, size=num_segments - 1))
    return np.concatenate([[0], inner, [count]]).astype(np.int64)


def bound(device, spheres, offset):
    return host(_core.bound_spheres(on(device, np.asarray(spheres, np.float32)), np.array(offset)))


def reaches(ball, spheres):
    """Return the distance from the ball's centre to the far side of each sphere, in
    double precision."""
    ball, spheres = ball.astype(np.float64), spheres.astype(np.float64)
    return np.linalg.norm(spheres[:, :3] - ball[:3], axis=1) + spheres[:, 3]


@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 200),
    num_segments=st.integers(1, 5),
    origin=st.sampled_from([0.0, 1.0, 1e3, 1e6]),
    size=st.sampled_from([1e-6, 1.0, 1e4]),
)
def test_balls_contain_their_spheres_with_margin(device, seed, count, num_segments, origin, size):
    rng = np.random.default_rng(seed)
    means = (origin + size * rng.normal(size=(count, 3))).astype(np.float32)
    radii = (size * rng.exponential(0.1, size=count)).astype(np.float32)
    spheres = np.concatenate([means, radii[:, None]], axis=1)
    offset = random_offset(rng, count, num_segments)
    balls = bound(device, spheres, offset)
    np.testing.assert_array_equal(balls, bound("cpu", spheres, offset))
    for ball, (first, last) in zip(balls, itertools.pairwise(offset), strict=True):
        if first < last:
            assert ball[3] >= reaches(ball, spheres[first:last]).max() * (1 + 3.9e-6)
        assert ball[3] >= 1e-15


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 100))
def test_ball_is_nearly_the_smallest(device, seed, count):
    rng = np.random.default_rng(seed)
    # The points are on the unit sphere, together with their opposites, so the smallest
    # ball is the unit ball.
    half = rng.normal(size=(count, 3))
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    spheres = np.pad(np.concatenate([half, -half, 0.9 * half]), ((0, 0), (0, 1)))
    assert bound(device, spheres, [0, len(spheres)])[0, 3] <= 1.005


def test_ball_of_two_balls_is_exact(device):
    ball = bound(device, [[0, 0, 0, 1], [4, 0, 0, 2]], [0, 2])
    np.testing.assert_allclose(ball, [[2.5, 0, 0, 3.5]], rtol=2e-3, atol=1e-6)


def test_ball_of_nested_balls_is_the_outer_one(device):
    ball = bound(device, [[0, 0, 0, 5], [1, 0, 0, 0.5], [0, 0, 0, 1]], [0, 3])
    np.testing.assert_allclose(ball, [[0, 0, 0, 5]], rtol=1e-3, atol=1e-3)


def test_empty_and_single_segments(device):
    none = np.zeros((0, 4))
    assert bound(device, none, [0]).shape == (0, 4)
    np.testing.assert_array_equal(bound(device, none, [0, 0]), np.float32([[0, 0, 0, 1e-15]]))
    np.testing.assert_array_equal(
        bound(device, [[1, 1, 1, 0]], [0, 0, 1, 1]),
        np.float32([[0, 0, 0, 1e-15], [1, 1, 1, 1e-15], [0, 0, 0, 1e-15]]),
    )


@pytest.mark.gpu
@pytest.mark.parametrize("decimals", [1, 6])
def test_large_balls_are_the_same_on_both_devices(decimals):
    rng = np.random.default_rng(3)
    spheres = np.round(np.abs(rng.normal(size=(60_000, 4))), decimals)
    offset = np.concatenate([[0, 20_000, 20_000], np.arange(20_001, 60_001, 77), [60_000]])
    np.testing.assert_array_equal(bound("cuda", spheres, offset), bound("cpu", spheres, offset))


@pytest.mark.parametrize("offset", [[0, 3], [1, 2], [0, 2, 1, 2], []])
def test_balls_refuse_bad_boundaries(offset):
    with pytest.raises(ValueError, match="offset: expected ascending boundaries from 0 to 2"):
        _core.bound_spheres(np.zeros((2, 4), np.float32), np.array(offset, np.int64))


DIGEST = """
import hashlib, numpy as np
from v3dg import _core
rng = np.random.default_rng(5)
means = np.round(rng.normal(size=(200_000, 3)), 2).astype(np.float32)
offset = np.array([0, len(means)])
order, leaf_offset = _core.median_split(means, offset, _core.num_halvings(len(means), 100))
radii = rng.exponential(0.01, size=(len(means), 1)).astype(np.float32)
ball = _core.bound_spheres(np.concatenate([means[order], radii], axis=1), leaf_offset)
print(hashlib.sha256(order.tobytes() + leaf_offset.tobytes() + ball.tobytes()).hexdigest())
"""


def test_number_of_threads_changes_nothing():
    digests = [
        subprocess.run(
            [sys.executable, "-c", DIGEST],
            env={**os.environ, "OMP_NUM_THREADS": threads},
            check=True,
            capture_output=True,
            text=True,
        ).stdout
        for threads in ("1", "2", "3")
    ]
    assert len(set(digests)) == 1
