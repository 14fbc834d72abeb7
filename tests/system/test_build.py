"""Whole builds: the content of a bundle, and the quality of its levels."""

import hashlib
import itertools
import math
import os
import re
import subprocess
import sys
from dataclasses import fields, replace
from pathlib import Path
from typing import Annotated, get_args, get_origin

import numpy as np
import pytest

import scenes
import v3dg
from benchmarks.worlds.procedural import make_asset
from reference import cluster as reference_cluster
from reference import project as reference_project
from v3dg import (
    BuildConfig,
    Camera,
    Gaussians,
    _core,
    build_bundle,
    metrics,
    rasterize,
    render,
    select,
)
from v3dg._device import CPU, place, resolve
from v3dg.bundle.codec import codec_of
from v3dg.levels.leaves import MemoryLeaves
from v3dg.levels.plan import Plan
from v3dg.levels.rows import RUN_ROWS
from v3dg.levels.simplify import Level, LevelTables
from v3dg.levels.smooth import measured_config

SMALL = BuildConfig(cluster_size=32, steps=10)
TABLES = {"clusters": v3dg.Clusters, "groups": v3dg.Groups}


def build(asset, config=SMALL, **options):
    return build_bundle(asset, config=config, progress=False, **options, quality="draft")


@pytest.fixture(scope="module")
def asset():
    return make_asset(num_gaussians=1200, seed=0)


@pytest.fixture(scope="module")
def bundle(asset, device):
    return build(asset, device=device)


def everything_in(bundle):
    """Return all arrays of a bundle by name."""
    arrays = {
        f"{t}.{n}": getattr(getattr(bundle, t), n) for t in TABLES for n in vars(getattr(bundle, t))
    }
    return arrays | {name: getattr(bundle.gaussians, name) for name in scenes.NAMES}


def same(bundle, other):
    a, b = everything_in(bundle), everything_in(other)
    return a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)


def ball_around(gaussians):
    """Return the centre and the radius of a ball, not empty, that contains everything
    that is drawn."""
    low, high = gaussians.means.min(axis=0), gaussians.means.max(axis=0)
    radius = float(np.linalg.norm(high - low)) / 2 + 3 * float(gaussians.scales.max())
    return (low + high).astype(np.float64) / 2, radius or 1.0


def camera_at(center, radius, direction, footprint_px2):
    """Return a camera four radii away that sees the ball with about this area in
    px²."""
    side = max(4, math.ceil(2.2 * math.sqrt(footprint_px2 / math.pi)))
    fov = 2 * math.atan(1.1 * math.tan(math.asin(1 / 4)))
    eye = center + 4 * radius * np.asarray(direction) / np.linalg.norm(direction)
    return Camera.look_at(
        eye, center, [0.1, 0.2, 1.0], fov_x=fov, width=side, height=side, near=0.1 * radius
    )


def held_out_psnr(asset, bundle, level):
    """Return the PSNR of a level relative to the supersampled asset, at the size at
    which the level is selected."""
    gaussians, (center, radius) = bundle.level_gaussians(level), ball_around(asset)
    first = bundle.level_range(level).start
    options = {
        "filter_px2": float(bundle.clusters.filter_px2[first]),
        "antialiased": bool(bundle.clusters.antialiased[first]),
    }
    errors = []
    for direction in np.random.default_rng(99).normal(size=(8, 3)):
        footprint = BuildConfig().px2_per_gaussian * len(gaussians)
        camera = camera_at(center, radius, direction, footprint)
        truth = metrics.box_downsample(rasterize(asset, camera.scaled(4)).color, 4)
        errors.append(np.mean((truth - rasterize(gaussians, camera, **options).color) ** 2))
    return -10 * math.log10(np.mean(errors))


# ---- builds that give the same bytes


THREADS_SCRIPT = """
import sys
import v3dg
from benchmarks.worlds.procedural import make_asset
config = v3dg.BuildConfig(cluster_size=32, steps=10)
asset = make_asset(num_gaussians=1200, seed=0)
v3dg.build_bundle(asset, config=config, progress=False, device="cpu").write(sys.argv[1])
"""


def test_same_file_on_any_number_of_threads(asset, tmp_path):
    build(asset, device="cpu").write(tmp_path / "here.v3dg")
    files = [tmp_path / "here.v3dg"]
    for threads in (1, 2, 4):
        files.append(tmp_path / f"{threads}.v3dg")
        environment = os.environ | {
            "PYTHONPATH": os.pathsep.join(
                str(Path(file).parents[1]) for file in (v3dg.__file__, Path(__file__).parent)
            ),
            "OMP_NUM_THREADS": str(threads),
        }
        command = [sys.executable, "-c", THREADS_SCRIPT, str(files[-1])]
        subprocess.run(command, cwd=tmp_path, env=environment, check=True)
    assert len({hashlib.sha256(file.read_bytes()).hexdigest() for file in files}) == 1


def test_another_seed_builds_another_bundle(asset, bundle, device):
    assert same(build(asset, seed=0, device=device), bundle)
    assert not same(build(asset, seed=1, device=device), bundle)


def test_largest_seed_is_its_own(asset, device):
    largest = 2**58 - 1
    a, b = (build(asset, seed=seed, device=device) for seed in (largest, largest - 1))
    assert not same(a, b)
    for seed in (-1, largest + 1):
        with pytest.raises(ValueError, match="seed: expected a whole number from 0 to 2\\^58 - 1"):
            build(asset, seed=seed)


@pytest.mark.gpu
@pytest.mark.parametrize("init", ["merge", "prune"])
@pytest.mark.parametrize("group_size", [2, 8])
def test_devices_start_from_the_same_bits(asset, init, group_size):
    config = replace(SMALL, steps=0, init=init, group_size=group_size)
    cpu, cuda = (everything_in(build(asset, config, device=device)) for device in ("cpu", "cuda"))
    for name, array in cpu.items():
        if name == "groups.error":
            np.testing.assert_allclose(cuda[name], array, rtol=1e-3, atol=1e-5)
        else:
            np.testing.assert_array_equal(cuda[name], array, err_msg=name)


@pytest.mark.gpu
def test_asset_may_be_on_the_device(asset):
    there = asset.torch("cuda")
    there.means.requires_grad_()
    for device in ("cuda", "cpu"):
        assert same(build(there, device=device), build(asset, device=device))


@pytest.mark.gpu
def test_gpu_memory_that_is_taken_changes_no_byte():
    """Groups whose pictures do not fit in memory together are fitted one after another,
    with the same results."""
    import torch

    asset, config = make_asset(num_gaussians=60_000, seed=0), BuildConfig(cluster_size=32, steps=8)
    expected = build(asset, config, device="cuda")
    torch.cuda.empty_cache()
    free, _ = torch.cuda.mem_get_info()
    taken = torch.empty(free - (400 << 20), dtype=torch.uint8, device="cuda")
    assert same(build(asset, config, device="cuda"), expected)
    del taken
    torch.cuda.empty_cache()


@pytest.mark.gpu
def test_build_runs_on_the_callers_stream(asset):
    import torch

    stream = torch.cuda.Stream()
    with torch.cuda.stream(stream):
        bundle = build(asset, device="cuda")
    assert same(bundle, build(asset, device="cuda"))


# ---- clusters, filters and colours of levels


@pytest.mark.parametrize("num_gaussians", [1000, 1023, 1025])
@pytest.mark.parametrize("group_size", [2, 8])
def test_each_level_has_half_of_the_one_below(num_gaussians, group_size, device):
    asset = make_asset(num_gaussians=1100, seed=3).subset(slice(num_gaussians))
    bundle = build(asset, replace(SMALL, steps=0, group_size=group_size), device=device)
    sizes = [len(bundle.level_gaussians(level)) for level in range(bundle.num_levels)]
    clusters = [len(bundle.level_range(level)) for level in range(bundle.num_levels)]
    assert sizes[0] == num_gaussians
    for level in range(1, bundle.num_levels):
        groups = int((bundle.groups.level == level).sum())
        assert sizes[level - 1] / 2 <= sizes[level] <= (sizes[level - 1] + groups) / 2
        assert clusters[level] == max(1, clusters[level - 1] // 2)
        assert groups == max(1, clusters[level - 1] // group_size)
    assert sizes[-1] // 2 < SMALL.min_gaussians <= sizes[-1]


@pytest.mark.parametrize(("filter_px2", "last"), [(0.0, 0.0), (0.05, 1 / 12), (0.2, 0.2)])
def test_the_last_level_has_the_filter_of_a_pixel(filter_px2, last):
    bundle = build(
        make_asset(num_gaussians=1000, seed=3), replace(SMALL, steps=0, filter_px2=filter_px2)
    )
    level = bundle.clusters.level
    expected = np.select([level == 0, level < bundle.num_levels - 1], [0.0, filter_px2], last)
    np.testing.assert_array_equal(bundle.clusters.filter_px2, expected.astype(np.float32))
    only = build(make_asset(num_gaussians=1000, seed=3), replace(SMALL, min_gaussians=1001))
    assert not only.clusters.filter_px2.any()


def shell(width, height, seed=0):
    """Return a ball of flat gaussians with this width and height, in distances to the
    nearest neighbour."""
    rng, num = np.random.default_rng(seed), 1500
    quats = rng.normal(size=(num, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    w, x, y, z = quats.T
    normals = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)
    scales = np.tile(math.sqrt(4 * math.pi / num) * np.array([width, height, 0.1]), (num, 1))
    arrays = normals, quats, scales, np.full(num, 0.9), np.sin(3 * normals)[:, None]
    return Gaussians(*(array.astype(np.float32) for array in arrays))


SMOOTH = BuildConfig(cluster_size=64, steps=40, num_views=16)


def growth_of_level_1(smooth, plain):
    """Return (G,) the factors by which balls of level 1 of a smooth asset are larger;
    the balls above contain them."""
    is_first, ball, other = smooth.groups.level == 1, smooth.groups.ball, plain.groups.ball
    np.testing.assert_array_equal(ball[is_first, :3], other[is_first, :3])
    for lower, upper in enumerate(smooth.groups.parent):
        if upper >= 0:
            apart = np.linalg.norm(ball[lower, :3].astype(float) - ball[upper, :3])
            assert apart + ball[lower, 3] <= ball[upper, 3] * (1 + 1e-5)
    return ball[is_first, 3] / other[is_first, 3]


def test_level_1_is_selected_later_where_it_is_worse_than_its_leaves(device):
    config = replace(SMOOTH, smooth="no", filter_px2=0.0)
    bundle, here = build(shell(1.1, 1.1), config, device=device), Plan.of(1500, config).levels[1]
    leaves, ball = bundle.level_gaussians(0), bundle.groups.ball[bundle.groups.level == 1]

    def growth(level):
        rows = [place(gaussians, resolve(device)).rows for gaussians in (leaves, level)]
        return _core.first_selected(
            *rows, here.leaf_offset, here.leaf_offset, ball, 0.0, False, 0.0
        )

    is_worse = np.add.reduceat(leaves.means[:, 2], here.leaf_offset[:-1]) > 0
    shift = np.where(np.repeat(is_worse, np.diff(here.leaf_offset)), 0.05, 0)[:, None, None]
    found = growth(replace(leaves, sh=leaves.sh + shift.astype(np.float32)))
    assert np.median(found[is_worse]) > 1.5 * np.median(found[~is_worse])
    np.testing.assert_allclose(growth(leaves), 1.4, rtol=1e-6)


def test_level_1_of_what_is_built_in_parts_is_selected_at_half_the_size(device, monkeypatch):
    monkeypatch.setattr("v3dg.levels.whole.UNIT_LEAVES", 400)
    options = {"asset": shell(1.1, 1.1), "device": device}
    smooth, plain = (
        build(config=replace(SMOOTH, smooth=s, filter_px2=0.0), **options) for s in ("yes", "no")
    )
    np.testing.assert_array_equal(growth_of_level_1(smooth, plain), 2)


@pytest.mark.parametrize(
    ("width", "height", "is_smooth"), [(1.1, 1.1, True), (0.4, 0.4, False), (1.1, 0.1, False)]
)
def test_smooth_assets_have_no_filter_and_a_level_1_for_later(
    width, height, is_smooth, device, tmp_path
):
    asset = shell(width, height)
    found = build(asset, SMOOTH, device=device)
    first = found.level_range(1)
    assert (found.clusters.filter_px2[first] == (0 if is_smooth else np.float32(0.05))).all()
    assert found.clusters.filter_px2[-1] == np.float32(1 / 12)
    assert found.config["build"]["smooth"] == "measured"
    assert same(
        found, build(asset, replace(SMOOTH, smooth="yes" if is_smooth else "no"), device=device)
    )
    assert same(found, build(asset, SMOOTH, device=device, resume_path=tmp_path / "parts.v3dg"))
    if is_smooth:
        plain = build(asset, replace(SMOOTH, smooth="no", filter_px2=0.0), device=device)
        arrays, others = (vars(bundle.gaussians).values() for bundle in (found, plain))
        assert all(map(np.array_equal, arrays, others))
        growth = growth_of_level_1(found, plain)
        assert 1.39 < growth.min() < growth.max() < 4.01


@pytest.mark.parametrize(
    ("changes", "is_smooth"),
    [
        ({"filter_px2": 0.2}, True),
        ({"min_clusters": 16}, True),
        ({"group_size": 4, "init": "prune"}, True),
        ({"filter_px2": 0.0}, False),
        ({"steps": 0}, False),
        ({"first_steps": 0}, False),
    ],
)
def test_smoothness_is_measured_where_levels_are_fitted_with_a_filter(changes, is_smooth, device):
    config = replace(SMOOTH, **changes)
    bundle = build(shell(1.1, 1.1), config, device=device)
    told = replace(config, smooth="yes" if is_smooth else "no")
    assert same(bundle, build(shell(1.1, 1.1), told, device=device))
    untold = replace(config, smooth="no" if is_smooth else "yes")
    assert not same(bundle, build(shell(1.1, 1.1), untold, device=device))


@pytest.mark.parametrize("num_gaussians", [8192, 8193, 8200, 9000, 700])
@pytest.mark.parametrize(("missed", "is_smooth"), [(1.47, True), (1.48, False)])
def test_smoothness_is_measured_all_over_the_asset(num_gaussians, missed, is_smooth, monkeypatch):
    """This also holds if groups have one gaussian more than a round number, in which
    case the clusters of a sample could be larger."""
    asset = make_asset(num_gaussians=1000, seed=0).subset(np.arange(num_gaussians) % 1000)
    config = BuildConfig(cluster_size=64, group_size=4, steps=7, loss_l1=2.0, loss_alpha=0.25)
    leaves = MemoryLeaves(asset, config)
    plan = Plan.of(leaves.num_gaussians, config)
    num_groups, reads, builders = plan.levels[1].num_groups, [], []
    read = leaves.read
    monkeypatch.setattr(
        leaves, "read", lambda first, last: reads.append((first, last)) or read(first, last)
    )

    def levels(builder, asset):
        builders.append(builder)
        assert (
            len(asset)
            == sum(last - first for first, last in reads)
            == builder.plan.levels[0].num_gaussians
        )
        error = np.array([[0.2, 0.4], [0.6, 0.8]])  # a loss of 2 * 0.4 + 0.25 * 0.6
        error[:, 0] *= missed if builder.config.filter_px2 == 0 else 1
        yield from [Level(asset, LevelTables(None, None, None, error))] * len(builder.plan.levels)

    monkeypatch.setattr("v3dg.levels.simplify.LevelBuilder.levels", levels)
    found = measured_config(config, plan, leaves, 5, codec_of("float32", 1), CPU)
    assert found == (replace(config, smooth="yes", filter_px2=0.0) if is_smooth else config)
    count = min(32, num_groups)
    offset = plan.levels[1].leaf_offset
    own = [np.searchsorted(offset, first, side="right") - 1 for first, _ in reads]
    assert np.diff(own).tolist() == [num_groups // count] * (count - 1)
    assert all(
        offset[g] == first and last <= offset[g + 1]
        for g, (first, last) in zip(own, reads, strict=True)
    )
    assert [builder.config.filter_px2 for builder in builders] == [0.05, 0.0]
    for builder in builders:
        assert [level.num_groups for level in builder.plan.levels] == [2 * count, count]
        assert builder.config.steps_at(1) == 3
        assert builder.seed == 5


def test_level_zero_is_the_asset(asset, bundle):
    rows = [np.concatenate([getattr(g, n).reshape(len(g), -1) for n in scenes.NAMES], axis=1)
            for g in (asset, bundle.level_gaussians(0))]  # fmt: skip
    np.testing.assert_array_equal(*(r[np.lexsort(r.T)] for r in rows))


@pytest.mark.parametrize("codec", ["float32", "quantized"])
@pytest.mark.parametrize("config", [BuildConfig(steps=2), BuildConfig.paper(steps=2)])
def test_neighbours_stand_together_in_the_clusters_of_every_level(config, codec, device):
    # In the configuration of the paper, clusters are split after the fit.
    config = replace(config, cluster_size=100, group_size=4)
    asset = make_asset(num_gaussians=1500, seed=3)
    bundle = build(asset, config, codec=codec, device=device)
    for first, last in itertools.pairwise(bundle.clusters.offset):
        runs = reference_cluster.runs(bundle.gaussians.means[first:last], RUN_ROWS)
        np.testing.assert_array_equal(np.concatenate(runs), np.arange(last - first))
    assert bundle.config["run_rows"] == RUN_ROWS


def test_the_filter_of_an_asset_is_its_own(asset, bundle, device):
    """Level 0 is drawn with the filter of the asset. Coarser levels are fitted to the
    asset without a filter; otherwise they would be thicker."""
    filtered = build(asset, replace(SMALL, asset_filter_px2=0.3), device=device)
    is_fine = bundle.clusters.level == 0
    assert (filtered.clusters.filter_px2[is_fine] == np.float32(0.3)).all()
    for level in range(bundle.num_levels):
        found, wanted = filtered.level_gaussians(level), bundle.level_gaussians(level)
        np.testing.assert_array_equal(found.means, wanted.means)
        np.testing.assert_array_equal(found.opacities, wanted.opacities)


def test_gaussians_stay_within_their_ranges(asset, bundle):
    g = bundle.gaussians
    assert (g.scales >= 0).all()
    assert ((g.opacities >= 0) & (g.opacities <= 1)).all()
    coarse = g.subset(slice(len(asset), None))
    np.testing.assert_allclose(np.linalg.norm(coarse.quats, axis=1), 1, rtol=1e-5)
    assert (coarse.scales > 0).all()


def test_weights_and_balls_grow_towards_the_root(bundle):
    groups = bundle.groups
    child = np.flatnonzero(groups.parent >= 0)
    parent = groups.parent[child]
    assert (groups.weight[parent] >= groups.weight[child]).all()
    a, b = groups.ball[child].astype(np.float64), groups.ball[parent].astype(np.float64)
    assert (np.linalg.norm(a[:, :3] - b[:, :3], axis=1) + a[:, 3] <= b[:, 3]).all()


@pytest.mark.parametrize("moved", [0.0, 1e4])
def test_boxes_hold_all_that_is_drawn(asset, moved, device):
    bundle = build(scenes.replaced(asset, means=asset.means + np.float32(moved)), device=device)
    g = bundle.gaussians
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(200, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    # At this number of standard deviations, alpha is 1/255.
    sigmas = np.sqrt(2 * np.log(np.maximum(255 * g.opacities.astype(np.float64), 1)))
    axes = reference_project.rotation(g.quats) * (g.scales * sigmas[:, None])[:, None, :]
    points = g.means[:, None, :] + directions @ axes.transpose(0, 2, 1)
    cluster = np.repeat(np.arange(len(bundle.clusters)), np.diff(bundle.clusters.offset))
    low, high = bundle.clusters.box[cluster, 0, None], bundle.clusters.box[cluster, 1, None]
    assert ((points >= low) & (points <= high)).all()


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_colours_of_all_degrees_survive_to_the_coarsest_level(degree, device):
    rng = np.random.default_rng(degree)
    num_bases = (degree + 1) ** 2
    means = rng.uniform(-1, 1, (600, 3))
    sh = np.broadcast_to(rng.normal(0, 0.3, (num_bases, 3)), (600, num_bases, 3))
    asset = scenes.gaussians(means, scales=0.2, opacities=0.5, sh=sh.astype(np.float32))
    bundle = build(asset, replace(SMALL, steps=0), device=device)
    last = bundle.level_gaussians(bundle.num_levels - 1)
    np.testing.assert_allclose(last.sh, asset.sh[: len(last)], rtol=1e-5, atol=1e-6)
    # The fit makes gaussians brighter to compensate for lost overlap, but has no reason
    # to change coefficients that depend on the direction.
    fitted = build(asset, device=device)
    assert fitted.sh_degree == degree
    fitted_last = fitted.level_gaussians(fitted.num_levels - 1)
    np.testing.assert_allclose(fitted_last.sh.mean(axis=0)[1:], asset.sh[0, 1:], atol=0.1)


# ---- unusual assets


def degenerate_assets():
    rng = np.random.default_rng(5)
    many = scenes.random_gaussians(1, scenes.CAMERAS["plain"], 150, sh_degree=1)

    def scaled(factor, shift=0.0):
        return scenes.replaced(
            many,
            means=(many.means * np.float32(factor) + np.float32(shift)),
            scales=many.scales * np.float32(factor),
        )

    same_place = np.tile([1, 2, 3], (100, 1))
    return {
        "one": many.subset(slice(1)),
        "two": many.subset(slice(2)),
        "three": many.subset(slice(3)),
        "seven": many.subset(slice(7)),
        "same_place": scenes.gaussians(same_place),
        "same_place_no_size": scenes.gaussians(same_place, scales=0.0),
        "no_size": scenes.replaced(many, scales=np.zeros_like(many.scales)),
        "flat": scenes.replaced(many, scales=many.scales * np.float32([1, 1, 0])),
        "lines": scenes.replaced(many, scales=many.scales * np.float32([1, 0, 0])),
        "on_a_line": scenes.gaussians(np.linspace(0, 1, 90)[:, None] * [1, 2, 3], scales=0.01),
        "faint": scenes.replaced(many, opacities=np.full_like(many.opacities, 0.005)),
        "solid": scenes.replaced(many, opacities=np.ones_like(many.opacities)),
        "zero_quats": scenes.replaced(many, quats=np.zeros_like(many.quats)),
        "long_quats": scenes.replaced(many, quats=many.quats * np.float32(1e6)),
        "far_away": scaled(1, 1e7),
        "far_away_and_small": scaled(1e-3, 1e7),
        "tiny": scaled(1e-6),
        "large": scaled(1e6),
        "huge": scaled(1e12),
        "one_giant": scenes.replaced(
            many, scales=np.where(np.arange(150)[:, None] == 3, np.float32(1e4), many.scales)
        ),
        "bright": scenes.replaced(many, sh=many.sh * np.float32(1e6)),
        "duplicates": Gaussians.concatenate([many.subset(slice(20))] * 5),
        "all_sizes": scenes.replaced(
            many, scales=np.exp(rng.uniform(-25, 5, many.scales.shape)).astype(np.float32)
        ),
    }


DEGENERATE = degenerate_assets()


@pytest.mark.parametrize("init", ["merge", "prune"])
@pytest.mark.parametrize("name", DEGENERATE)
def test_any_asset_is_built_selected_and_drawn(name, init, device):
    asset = DEGENERATE[name]
    config = BuildConfig(
        cluster_size=8, steps=3, views_per_step=1, num_views=8, min_gaussians=1, init=init
    )
    bundle = build(asset, config, device=device)
    for array_name, array in everything_in(bundle).items():
        assert np.isfinite(array).all(), array_name
    assert len(bundle.level_gaussians(bundle.num_levels - 1)) == 1
    center, radius = ball_around(asset)
    for tolerance in (0.0, 0.5, 1e9):
        camera = camera_at(center, radius, [1, 0.3, 0.2], 300.0)
        num = select(bundle, camera, tolerance=tolerance, device="cpu").num_gaussians
        assert 1 <= num <= len(asset)
        image = render(bundle, camera, tolerance=tolerance, depth=True, device="cpu")
        assert all(
            np.isfinite(picture).all() for picture in (image.color, image.alpha, image.depth)
        )


def test_asset_without_gaussians_is_refused(device):
    with pytest.raises(ValueError, match="asset: expected at least one gaussian, got none"):
        build(scenes.gaussians(np.zeros((0, 3))), device=device)


WRONG = [
    ("means", np.nan, "means_not_finite", "2 with a position that is not finite"),
    ("means", -1e19, "too_large", "2 with a position or a scale beyond 1e+18"),
    ("quats", np.inf, "quats_not_finite", "2 with a rotation that is not finite"),
    ("sh", -np.inf, "sh_not_finite", "2 with a colour that is not finite"),
    ("scales", np.nan, "scales_not_finite", "2 with a scale that is not finite"),
    ("scales", 1e19, "too_large", "2 with a position or a scale beyond 1e+18"),
    ("scales", -0.1, "negative_scale", "2 with a negative scale"),
    ("opacities", 1.1, "opacity_out_of_range", "2 with an opacity outside 0 to 1"),
    ("opacities", -0.1, "opacity_out_of_range", "2 with an opacity outside 0 to 1"),
    ("opacities", np.nan, "opacities_not_finite", "2 with an opacity that is not finite"),
]


@pytest.mark.parametrize(("name", "value", "kind", "reason"), WRONG)
def test_gaussians_with_wrong_values_are_left_out(asset, name, value, kind, reason, device):
    wrong = np.array(getattr(asset, name))
    wrong.reshape(len(wrong), -1)[[17, 40], -1] = value
    dirty = scenes.replaced(asset, **{name: wrong})
    message = f"asset: 2 of 1,200 gaussians cannot be drawn: {re.escape(reason)}; they are left out"
    with pytest.warns(v3dg.cleaning.AssetWarning, match=message):
        bundle = build(dirty, device=device)
    assert bundle.config["dropped"] == {kind: 2}
    clean = build(asset.subset(np.delete(np.arange(1200), [17, 40])), device=device)
    assert same(bundle, clean)
    message = f"asset: expected only gaussians that can be drawn, but .* {re.escape(reason)}; "
    with pytest.raises(ValueError, match=message):
        build(dirty, device=device, unusable="refuse")


def test_gaussians_that_no_pixel_can_show_are_left_out_silently(asset, device):
    opacities = np.maximum(asset.opacities, np.float32(0.01))
    opacities[[3, 700, 900]] = 0, 1 / 256, 0.0038
    bundle = build(scenes.replaced(asset, opacities=opacities), device=device, unusable="refuse")
    assert bundle.config["dropped"] == {"transparent": 3}
    assert len(bundle.level_gaussians(0)) == 1197


def test_asset_with_nothing_left_is_refused(asset, device):
    hidden = scenes.replaced(asset, opacities=np.full(1200, 0.001, np.float32))
    with pytest.raises(
        ValueError,
        match=r"asset: expected at least one gaussian that can be drawn, got none: 1,200",
    ):
        build(hidden, device=device)


def test_unknown_choice_for_unusable_gaussians_is_refused(asset):
    with pytest.raises(ValueError, match="unusable: expected 'drop' or 'refuse', got 'keep'"):
        build(asset, unusable="keep")


# ---- settings


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cluster_size": 1}, "cluster_size: expected 2 to 1,073,741,824, got 1"),
        ({"cluster_size": 64.0}, "cluster_size: expected a whole number, got 64.0"),
        (
            {"cluster_size": 2**62},
            "cluster_size: expected 2 to 1,073,741,824, got 4611686018427387904",
        ),
        ({"steps": -1}, "steps: expected 0 to 1,000,000, got -1"),
        ({"steps": True}, "steps: expected a whole number, got True"),
        ({"steps": 2**31 - 1}, "steps: expected 0 to 1,000,000, got 2147483647"),
        ({"views_per_step": 0}, "views_per_step: expected 1 to 1,024, got 0"),
        ({"views_per_step": 2**31 - 1}, "views_per_step: expected 1 to 1,024, got 2147483647"),
        ({"num_views": -1}, "num_views: expected 0 to 65,536, got -1"),
        ({"supersample": 0}, "supersample: expected 1 to 64, got 0"),
        ({"supersample": 2**16}, "supersample: expected 1 to 64, got 65536"),
        ({"image_size": 2**31}, "image_size: expected 0 to 8,192, got 2147483648"),
        (
            {"image_size": 8000},
            "image_size: expected views of at most 8192 px a side after multiplication",
        ),
        ({"image_size": 2000, "num_views": 64}, "image_size: expected views of at most 8192 px"),
        ({"min_gaussians": 0}, "min_gaussians: expected 1 to 4,611,686,018,427,387,904, got 0"),
        ({"group_size": 1}, "group_size: expected 2 to 1,073,741,824, got 1"),
        ({"group_size": 6}, "group_size: expected a power of two, got 6"),
        ({"init": "best"}, "init: expected 'merge' or 'prune', got 'best'"),
        ({"init": ["merge"]}, "init: expected 'merge' or 'prune', got ['merge']"),
        ({"targets": "root"}, "targets: expected 'finest' or 'previous', got 'root'"),
        ({"distance": 1.0}, "distance: expected 1.1 to 1,000, got 1.0"),
        ({"distance": math.nan}, "distance: expected 1.1 to 1,000, got nan"),
        ({"distance": 1e300}, "distance: expected 1.1 to 1,000, got 1e+300"),
        ({"filter_px2": -0.1}, "filter_px2: expected 0 to 1,000,000, got -0.1"),
        ({"asset_filter_px2": math.inf}, "asset_filter_px2: expected 0 to 1,000,000, got inf"),
        ({"loss_l1": "1"}, "loss_l1: expected a number, got '1'"),
        ({"loss_dssim": 10**400}, "loss_dssim: expected 0 to 1,000,000, got 1000"),
        ({"step_quat": math.nan}, "step_quat: expected 0 to 1,000,000,000, got nan"),
        ({"px2_per_gaussian": 0}, "px2_per_gaussian: expected 0.001 to 1,000,000, got 0"),
        ({"px2_per_gaussian": 1e20}, "px2_per_gaussian: expected 0.001 to 1,000,000, got 1e+20"),
        ({"px2_per_gaussian": 1e6}, "px2_per_gaussian: expected views of at most 8192 px"),
        ({"final_step": 0.0}, "final_step: expected 1e-06 to 1,000,000, got 0.0"),
        ({"position_in_world": 1}, "position_in_world: expected True or False, got 1"),
    ],
)
def test_wrong_settings_are_named(changes, message):
    with pytest.raises(ValueError, match="^" + re.escape(message)):
        BuildConfig(**changes)


def number_of(field):
    """Return the annotation of a setting that is a number in a range, also if it is
    optional; None for other settings."""
    for kind in (field.type, *get_args(field.type)):
        if get_origin(kind) is Annotated:
            return kind
    return None


def test_every_number_has_a_range_in_which_a_build_ends(asset):
    """Each setting in turn takes either end of its range. The asset is then built, or
    the settings are refused before memory is allocated."""
    small = BuildConfig(cluster_size=32, steps=1, num_views=2, asset_filter_px2=0.0)
    # All settings that are numbers must have a range.
    assert not {field.name for field in fields(BuildConfig) if field.type in (int, float)}
    numbers = {field.name: number_of(field) for field in fields(BuildConfig)}
    ranges = {name: get_args(kind)[1] for name, kind in numbers.items() if kind is not None}
    assert len(ranges) == 27
    for name, ends in ranges.items():
        for value in {*ends} - {1_000_000 if name.endswith("steps") else None, 1 << 16}:
            kind = type(getattr(small, name))
            try:
                config = replace(small, **{name: kind(value)})
                built = build(asset, config, device="cpu")
            except ValueError as error:
                assert "expected views of at most" in str(error)  # noqa: PT017
            else:
                parts = [getattr(built.gaussians, part) for part in scenes.NAMES]
                assert all(np.isfinite(part).all() for part in parts), (name, value)


def test_views_that_are_too_large_for_the_clusters_are_refused(asset):
    with pytest.raises(
        ValueError, match="px2_per_gaussian: expected views of at most 8192 px a side"
    ):
        build(asset, BuildConfig(cluster_size=1 << 20, px2_per_gaussian=1e4), device="cpu")


def test_wrong_options_are_named(asset):
    with pytest.raises(
        ValueError, match="device: expected 'auto', 'cpu', 'cuda' or 'cuda:1', got 'gpu'"
    ):
        build(asset, device="gpu")
    with pytest.raises(TypeError, match="progress: expected True, False or a function, got 'yes'"):
        build_bundle(asset, progress="yes", quality="draft")
    with pytest.raises(TypeError):
        build(asset, seed=0.5)


@pytest.mark.parametrize("group_size", [2, 4, 8, 32])
@pytest.mark.parametrize(
    "changes", [{}, {"prune_growth": 1.0}, {"init": "merge", "targets": "finest"}]
)
def test_paper_settings_build(asset, group_size, changes, device):
    config = BuildConfig.paper(cluster_size=1200 // 16, group_size=group_size, steps=2, **changes)
    bundle = build(asset, config, device=device)
    # The coarsest level has two clusters instead of one.
    clusters = [len(bundle.level_range(level)) for level in range(bundle.num_levels)]
    assert clusters == [16, 8, 4, 2]
    assert bundle.config["build"]["group_size"] == group_size
    camera = camera_at(*ball_around(asset), [0.3, 1, 0.2], 400.0)
    assert np.isfinite(render(bundle, camera, device="cpu").color).all()


def test_settings_for_leaves_only_make_one_level(asset, device):
    bundle = build(asset, BuildConfig.leaves_only(), device=device)
    assert bundle.num_levels == 1
    assert len(bundle.gaussians) == len(asset)


def test_paper_fit_reduces_the_error(asset, device):
    config = BuildConfig.paper(cluster_size=300)
    start, fitted = (
        build(asset, replace(config, steps=steps), device=device) for steps in (0, 100)
    )
    assert held_out_psnr(asset, fitted, 1) > held_out_psnr(asset, start, 1)


# ---- quality


def test_fit_is_never_worse_than_its_start(asset, device):
    config = replace(SMALL, num_views=16)
    start = build(asset, replace(config, steps=0), device=device).groups
    # The steps are so long that fits diverge. All builds begin the fits of the first
    # level alike.
    for change in (
        {},
        {"step_position": 10.0, "step_logit": 50.0},
        {"step_log_scale": 5.0, "step_sh0": 9.0},
    ):
        fitted = build(asset, replace(config, **change), device=device).groups
        weights = [config.loss_l1, config.loss_alpha]
        first = start.level == 1
        assert (fitted.error[first] @ weights <= start.error[first] @ weights).all()
        assert np.isfinite(fitted.error).all()


def test_runaway_fit_leaves_the_start(asset, device):
    runaway = replace(
        SMALL, steps=3, step_position=1e6, step_logit=1e6, step_log_scale=1e6, step_sh0=1e6
    )
    fitted, start = (
        build(asset, c, device=device).level_gaussians(1)
        for c in (runaway, replace(SMALL, steps=0))
    )
    np.testing.assert_allclose(fitted.means, start.means, atol=1e-6)
    np.testing.assert_allclose(fitted.opacities, start.opacities, atol=1e-3)
    np.testing.assert_allclose(fitted.sh, start.sh, atol=1e-6)


def test_fit_gains_over_merging_alone(asset, device):
    """The gain in dB is measured at the size of selection, in views that no fit used.
    Measured: 1.5, 1.5, 0.7."""
    merged, fitted = (
        build(asset, BuildConfig(cluster_size=64, steps=steps), device=device) for steps in (0, 200)
    )
    for level in (1, 2, 3):
        assert held_out_psnr(asset, fitted, level) > held_out_psnr(asset, merged, level) + 0.6


# ---- progress


def test_progress_counts_all_levels_ahead(asset, device):
    """At the end the progress is complete: all gaussians of coarser levels, all levels,
    and the last group with its loss."""
    told = []
    config = replace(SMALL, group_size=4)
    bundle = build_bundle(
        asset,
        config=config,
        progress=lambda *state: told.append(state),
        device=device,
        quality="draft",
    )
    done, total, text = told[-1]
    assert done == total == bundle.num_gaussians - len(asset)
    assert all(before[0] <= after[0] for before, after in itertools.pairwise(told))
    top = bundle.num_levels - 1
    expected = rf"build, level {top}/{top}, groups (\d+)/(\d+), loss 0\.0\d+"
    groups, of_all = re.fullmatch(expected, text).groups()
    assert groups == of_all


def test_progress_is_four_lines_where_there_is_no_terminal(asset, capfd, device, caplog):
    with caplog.at_level("INFO"):
        build_bundle(asset, config=SMALL, progress=True, device=device, quality="draft")
    out, err = capfd.readouterr()
    assert out == ""
    lines = err.splitlines()
    assert 1 <= len(lines) <= 4
    assert lines[-1].endswith(": 100 %")
    assert caplog.messages == lines


def test_no_progress_unless_wanted(asset, capfd, device):
    build_bundle(asset, config=SMALL, progress=False, device=device, quality="draft")
    assert capfd.readouterr() == ("", "")


def test_what_progress_raises_ends_the_build(asset, device, tmp_path):
    def give_up(*_):
        raise InterruptedError("enough")

    with pytest.raises(InterruptedError, match="enough"):
        build_bundle(asset, config=SMALL, progress=give_up, device=device, quality="draft")
