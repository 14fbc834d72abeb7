"""Tests the gaussians from which the fits of coarser clusters start: pruning and
merging."""

import itertools

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scenes
from compare import MERGE_FLOAT, assert_close
from devices import host, on
from reference import simplify as reference
from v3dg import Gaussians, _core

CAMERA = scenes.CAMERAS["plain"]


def random_gaussians(seed, num, **options):
    return scenes.random_gaussians(seed, CAMERA, num, size_px=(1, 6), aspect=10, **options)


def segments(*lengths):
    return np.cumsum([0, *lengths])


def merge(device, gaussians, in_lengths, out_lengths):
    rows = on(device, gaussians).rows
    return Gaussians(*host(_core.merge(rows, segments(*in_lengths), segments(*out_lengths))))


def prune(device, gaussians, in_lengths, out_lengths):
    kept = _core.prune(on(device, gaussians).rows, segments(*in_lengths), segments(*out_lengths))
    return gaussians.subset(host(kept))


def same(a, b):
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in scenes.NAMES)


def transparent(gaussians):
    """Return gaussians so transparent that no merged opacity reaches 1, where area
    times opacity would be lost."""
    return scenes.replaced(gaussians, opacities=gaussians.opacities * np.float32(0.05))


# ---- prune


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 120), data=st.data())
def test_pruning_agrees_with_reference(device, seed, count, data):
    wanted = data.draw(st.integers(1, count))
    g = random_gaussians(seed, count, sh_degree=1)
    assert same(
        prune(device, g, [count], [wanted]), g.subset(np.array(reference.survivors(g, wanted)))
    )


@pytest.mark.parametrize("count", [1, 2, 7, 8, 9, 64, 100])
def test_pruning_keeps_the_first_of_equals(device, count):
    g = scenes.gaussians(np.zeros((count, 3)), color=np.arange(3 * count).reshape(count, 3))
    wanted = (count + 1) // 2
    assert same(
        prune(device, g, [count], [wanted]), g.subset(np.array(reference.survivors(g, wanted)))
    )


def test_each_octant_keeps_its_share(device):
    corners = np.array(list(itertools.product([-1, 1], repeat=3)), np.float32)
    rng = np.random.default_rng(0)
    means = np.repeat(corners, 16, axis=0) + rng.uniform(-0.1, 0.1, (128, 3))
    # All visible gaussians are in one corner. No more than the corner's share of
    # gaussians survives there.
    opacities = np.where(np.arange(128) < 16, 0.9, 0.01)
    kept = prune(device, scenes.gaussians(means, opacities=opacities), [128], [64])
    corner = np.round(kept.means).astype(int)
    assert (np.unique(corner, axis=0, return_counts=True)[1] == 8).all()


# ---- merge


@given(seed=st.integers(0, 2**32 - 1), num=st.integers(2, 6), degree=st.integers(0, 3))
def test_merging_all_agrees_with_reference(device, seed, num, degree):
    g = random_gaussians(seed, num, sh_degree=degree)
    one, expected = merge(device, g, [num], [1]), reference.merged(g)
    if num == 2:  # if more survive, pairs are merged, each with an opacity of at most 1
        assert_close(one.opacities[0], expected.opacity, MERGE_FLOAT)
    assert_close(one.means[0], expected.mean, MERGE_FLOAT)
    size = np.trace(expected.covariance)
    assert_close(reference.covariances(one)[0] / size, expected.covariance / size, MERGE_FLOAT)
    assert_close(one.sh[0], expected.sh, MERGE_FLOAT)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 60), data=st.data())
def test_merging_conserves_moments(device, seed, count, data):
    wanted = data.draw(st.integers(1, count))
    g = transparent(random_gaussians(seed, count, sh_degree=1))
    before, after = reference.moments(g), reference.moments(merge(device, g, [count], [wanted]))
    for name in ("mean", "second", "sh"):
        assert_close(
            getattr(after, name) / before.weight, getattr(before, name) / before.weight, MERGE_FLOAT
        )
    assert_close(after.weight, before.weight, MERGE_FLOAT)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(2, 12))
def test_cheapest_pair_is_merged(device, seed, count):
    g = random_gaussians(seed, count)
    out = merge(device, g, [count], [count - 1])
    i, k = reference.cheapest_pair(g)
    # The others stay unchanged and in order, and the pair takes the place of its first
    # member.
    rest = np.delete(np.arange(count), [i, k])
    assert same(out.subset(np.delete(np.arange(count - 1), i)), g.subset(rest))
    assert_close(out.means[i], reference.merged(g.subset(np.array([i, k]))).mean, MERGE_FLOAT)


def test_merging_to_as_many_changes_nothing(device):
    g = random_gaussians(3, 40, sh_degree=2)
    assert same(merge(device, g, [25, 15], [25, 15]), g)
    assert same(prune(device, g, [25, 15], [25, 15]), g)


def test_equal_gaussians_merge_into_their_like(device):
    g = transparent(random_gaussians(4, 1))
    copies = Gaussians.concatenate([g] * 8)
    one = merge(device, copies, [8], [1])
    assert_close(one.means, g.means, MERGE_FLOAT)
    assert_close(np.sort(one.scales), np.sort(g.scales), MERGE_FLOAT)
    assert_close(one.opacities, 8 * g.opacities, MERGE_FLOAT)
    # Ties are broken by index, so the first two are paired.
    assert same(
        merge(device, copies, [8], [7]).subset(slice(1, None)), copies.subset(slice(2, None))
    )


SHAPES = {
    "ball": [(0.3, 0.3, 0.3)] * 2,
    "discs": [(0.3, 0.3, 0.0)] * 2,
    "flat_pair": [(0.3, 0.2, 0.0)] * 2,
    "long": [(1.0, 1e-3, 1e-3)] * 2,
    "unlike": [(1.0, 0.1, 0.01), (1e-3, 1e-3, 1e-3)],
    "tiny": [(1e-12, 2e-12, 3e-12)] * 2,
    "large": [(1e9, 2e9, 3e9)] * 2,
}


@pytest.mark.parametrize(
    "quat", [(1, 0, 0, 0), (0, 1, 0, 0), (0.5, 0.5, 0.5, 0.5), (0.3, -0.2, 0.9, 0.1)]
)
@pytest.mark.parametrize("shape", SHAPES)
def test_scales_and_rotation_make_up_the_covariance(device, shape, quat):
    """Eigenvalues may be equal, zero, or differ by factors of millions."""
    scales = np.array(SHAPES[shape])
    g = scenes.gaussians([[0, 0, 0], scales[0] * 0.5], quats=quat, scales=scales, opacities=0.1)
    one, expected = merge(device, g, [2], [1]), reference.merged(g)
    eigenvalues = np.sort(np.linalg.eigvalsh(expected.covariance))
    size = eigenvalues[-1]
    assert_close(
        np.sort(one.scales[0].astype(np.float64) ** 2) / size, eigenvalues / size, MERGE_FLOAT
    )
    assert_close(reference.covariances(one)[0] / size, expected.covariance / size, MERGE_FLOAT)
    assert_close(np.linalg.norm(one.quats[0]), 1, MERGE_FLOAT)


def test_what_nobody_sees_does_not_move_what_is_seen(device):
    seen, unseen = random_gaussians(5, 1), random_gaussians(6, 1)
    unseen = scenes.replaced(unseen, opacities=np.zeros(1, np.float32))
    one = merge(device, Gaussians.concatenate([unseen, seen]), [2], [1])
    for name in ("means", "opacities", "sh"):
        assert_close(getattr(one, name), getattr(seen, name), MERGE_FLOAT)


def test_opaque_gaussians_stay_opaque(device):
    g = scenes.gaussians([[0, 0, 0], [0.01, 0, 0]], scales=0.3, opacities=1.0)
    assert merge(device, g, [2], [1]).opacities[0] == 1


def test_area_is_that_of_the_ellipsoid():
    """The area is compared with the mean area of the shadow over all directions, which
    is the surface area divided by 4 pi."""
    z, weight = np.polynomial.legendre.leggauss(256)
    turn = 2 * np.pi * (np.arange(256) + 0.5) / 256
    x, y = (np.sqrt(1 - z * z)[:, None] * f(turn) for f in (np.cos, np.sin))
    directions = np.stack([x, y, np.broadcast_to(z[:, None], x.shape)], axis=-1)
    for scales in itertools.product([1.0, 0.5, 0.2, 0.05, 0.01], repeat=3):
        a, b, c = scales
        shadows = np.sqrt(np.square(directions) @ np.square([b * c, a * c, a * b]))
        assert abs(reference.area(scales) / (weight @ shadows.mean(axis=1) / 2) - 1) < 0.012


# ---- both operations


@pytest.mark.parametrize("method", [merge, prune])
def test_segments_do_not_touch_each_other(device, method):
    g = random_gaussians(7, 90, sh_degree=1)
    whole = method(device, g, [50, 1, 39], [25, 1, 20])
    parts = [
        method(device, g.subset(slice(first, first + length)), [length], [wanted])
        for first, length, wanted in [(0, 50, 25), (50, 1, 1), (51, 39, 20)]
    ]
    assert same(whole, Gaussians.concatenate(parts))


@pytest.mark.parametrize("method", [merge, prune])
def test_no_gaussians_give_none(device, method):
    nothing = random_gaussians(8, 0)
    assert len(method(device, nothing, [], [])) == 0
    assert len(method(device, nothing, [0, 0], [0, 0])) == 0


@pytest.mark.parametrize("method", ["merge", "prune"])
@pytest.mark.parametrize(
    ("in_offset", "out_offset", "message"),
    [
        ([0, 3], [0, 4], "out_offset: expected 1 to 3 gaussians in segment 0, got 4"),
        ([0, 3], [0, 0], "out_offset: expected 1 to 3 gaussians in segment 0, got 0"),
        ([0, 2], [0, 1], "expected segments from 0"),
        ([1, 3], [0, 1], "expected segments from 0"),
        ([0, 3], [1, 2], "expected segments from 0"),
        ([0, 2, 1, 3], [0, 1, 1, 1], "in_offset: expected numbers that never decrease"),
        ([0, 3], [0, 1, 1], "out_offset: expected shape"),
        ([], [], "expected segments from 0"),
    ],
)
def test_wrong_segments_are_named(method, in_offset, out_offset, message):
    offsets = (np.array(o, np.int64) for o in (in_offset, out_offset))
    with pytest.raises(ValueError, match=message):
        getattr(_core, method)(random_gaussians(9, 3).rows, *offsets)


DEGENERATE = {
    "duplicates": lambda g: g.subset(np.arange(len(g)) % 7),
    "points": lambda g: scenes.replaced(g, scales=g.scales * np.float32(0)),
    "one place": lambda g: scenes.replaced(g, means=g.means * np.float32(0)),
    "unseen": lambda g: scenes.replaced(g, opacities=g.opacities * np.float32(0)),
    "tiny": lambda g: scenes.replaced(
        g, means=g.means * np.float32(1e-30), scales=g.scales * np.float32(1e-30)
    ),
    "large": lambda g: scenes.replaced(
        g, means=g.means * np.float32(1e15), scales=g.scales * np.float32(1e15)
    ),
    "as they are": lambda g: g,
}


@pytest.mark.gpu
@pytest.mark.parametrize("kind", DEGENERATE)
@pytest.mark.parametrize("method", [merge, prune])
def test_both_devices_decide_the_same(method, kind):
    lengths = [0, 1, 2, 5, 300, 33, 600, 8]
    g = DEGENERATE[kind](random_gaussians(10, sum(lengths), sh_degree=1))
    for share in (0.5, 0.1):
        wanted = [max(min(n, 1), int(n * share)) for n in lengths]
        assert same(method("cuda", g, lengths, wanted), method("cpu", g, lengths, wanted))
