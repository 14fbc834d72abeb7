"""Tests levels that are refined together: what improves, what stays unchanged, and
single steps."""

import itertools
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from devices import host, on
from random_bundle import random_bundle
from reference import cluster as reference_cluster
from v3dg import BuildConfig, _core
from v3dg.donut import make_donut
from v3dg.levels.fit import fit_config
from v3dg.levels.refined import _without_least
from v3dg.levels.rows import RUN_ROWS
from v3dg.metrics import box_downsample, draw_truth
from v3dg.refine import refine_bundle
from v3dg.residency import residency

SIZES = ("step_position", "step_quat", "step_log_scale", "step_logit", "step_sh0", "step_sh_rest")
STEP_SIZES = dict(zip(SIZES, (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4), strict=True))


@pytest.fixture(scope="module")
def bundle():
    """Return merged levels of a small donut, which can still be improved much."""
    config = BuildConfig(steps=0, cluster_size=128)
    return v3dg.build_bundle(make_donut(3000), config=config, device="cpu", progress=False)


def distance_to_asset(bundle, device):
    """Return the mean difference between the asset and cuts with several counts, from
    four sides."""
    errors = []
    for camera in v3dg.turntable((0, 0, 0), 3.0, 4, width=48, height=48):
        truth = draw_truth(bundle.level_gaussians(0), camera, "cpu", 4).astype(np.float32) / 255
        for budget in (1200, 300, 80):
            picture = v3dg.render(bundle, camera, budget=budget, device=device).color
            errors.append(np.abs(host(picture) - truth).mean())
    return np.array(errors)


@pytest.mark.slow
def test_cuts_come_closer_to_the_asset(bundle, device):
    refined = refine_bundle(bundle, steps=400, drop=0, device=device, progress=False)
    before, after = distance_to_asset(bundle, device), distance_to_asset(refined, device)
    assert after.mean() < 0.9 * before.mean()


def test_tables_and_level_0_stay(bundle, device):
    refined = refine_bundle(bundle, steps=3, drop=0, seed=5, device=device, progress=False)
    assert refined.config == bundle.config | {"refined": {"steps": 3, "drop": 0, "seed": 5}}
    assert refined.codec == bundle.codec
    for table in ("clusters", "groups"):
        for name, values in vars(getattr(bundle, table)).items():
            if name != "box":
                np.testing.assert_array_equal(values, getattr(getattr(refined, table), name))
    for name, values in vars(bundle.gaussians).items():
        changed = getattr(refined.gaussians, name)
        assert not np.array_equal(values, changed)
        leaves = slice(0, len(bundle.level_gaussians(0)))
        np.testing.assert_array_equal(values[leaves], changed[leaves])
    boxes = _core.bound_by_boxes(refined.gaussians.rows, refined.clusters.offset)
    np.testing.assert_array_equal(refined.clusters.box, boxes)


def test_neighbours_stand_together_in_clusters_of_an_earlier_build(bundle, device):
    """Gaussians move and are dropped. Bundles of earlier versions had the gaussians of
    a cluster in the order of the asset."""
    offset = bundle.clusters.offset
    rng = np.random.default_rng(1)
    order = [first + rng.permutation(last - first) for first, last in itertools.pairwise(offset)]
    gaussians = bundle.gaussians.subset(np.concatenate(order))
    config = {name: value for name, value in bundle.config.items() if name != "run_rows"}
    earlier = v3dg.Bundle(bundle.clusters, bundle.groups, gaussians, config)
    refined = refine_bundle(earlier, steps=5, drop=0.1, device=device, progress=False)
    assert refined.config["run_rows"] == RUN_ROWS
    for first, last in itertools.pairwise(refined.clusters.offset):
        runs = reference_cluster.runs(refined.gaussians.means[first:last], RUN_ROWS)
        np.testing.assert_array_equal(np.concatenate(runs), np.arange(last - first))


def test_a_quantised_bundle_stays_one(bundle, device):
    coded = v3dg.Bundle(
        bundle.clusters, bundle.groups, bundle.gaussians, bundle.config, "quantized"
    )
    refined = refine_bundle(coded, steps=3, drop=0, device=device, progress=False)
    assert refined.codec == "quantized"


def test_the_same_seed_gives_the_same_bits(bundle, device):
    def values(seed):
        refined = refine_bundle(bundle, steps=20, drop=0, seed=seed, device=device, progress=False)
        return np.concatenate([array.ravel() for array in vars(refined.gaussians).values()])

    first = values(0)
    np.testing.assert_array_equal(first, values(0))
    assert not np.array_equal(first, values(1))


def test_threads_do_not_change_the_result(bundle, tmp_path):
    bundle.write(tmp_path / "bundle.v3dg")
    program = (
        "import sys; import v3dg; from v3dg.levels import refined; "
        "refined._NUM_WEIGHING_PICTURES = 50; b = v3dg.Bundle.open(sys.argv[1]); "
        "v3dg.refine_bundle(b, steps=10, drop=0.1, device='cpu', progress=False)"
        ".write(sys.argv[2])"
    )
    for threads in ("1", "3"):
        command = [
            sys.executable,
            "-c",
            program,
            tmp_path / "bundle.v3dg",
            tmp_path / f"{threads}.v3dg",
        ]
        subprocess.run(command, check=True, env={**os.environ, "OMP_NUM_THREADS": threads})
    assert (tmp_path / "1.v3dg").read_bytes() == (tmp_path / "3.v3dg").read_bytes()


def test_a_bundle_without_levels_stays_as_it_is(device):
    only = v3dg.build_bundle(
        make_donut(1000), config=BuildConfig(steps=0, min_gaussians=1000), progress=False
    )
    assert only.num_levels == 1
    assert refine_bundle(only, device=device) is only


def test_a_bundle_whose_asset_is_empty_stays_as_it_is(device):
    empty = random_bundle(0, num_levels=3)
    gaussians = empty.gaussians.subset(slice(0, 0))
    clusters = replace(empty.clusters, offset=np.zeros_like(empty.clusters.offset))
    nothing = v3dg.Bundle(clusters, empty.groups, gaussians)
    assert refine_bundle(nothing, device=device) is nothing


def test_wrong_arguments_are_told(bundle):
    with pytest.raises(ValueError, match="steps: expected at least 1 step, got 0"):
        refine_bundle(bundle, steps=0)
    for share in (-0.1, 0.6, np.nan, "some"):
        with pytest.raises(
            ValueError, match=f"drop: expected a share from 0 to 0.5, got '?{share}"
        ):
            refine_bundle(bundle, drop=share)
    with pytest.raises(TypeError, match="bundle: expected a Bundle, got Gaussians"):
        refine_bundle(make_donut(1000))
    with pytest.raises(TypeError, match=r"cameras\[1\]: expected a Camera, got str"):
        refine_bundle(bundle, cameras=[v3dg.turntable((0, 0, 0), 3.0, 1)[0], "front"])


@pytest.mark.parametrize("drop", [0, 0.1])
def test_what_a_progress_function_raises_ends_it(bundle, drop):
    def stop(done, total, text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_bundle(bundle, steps=300, drop=drop, device="cpu", progress=stop)


def pictures_of(bundle, cameras=()):
    return _core.CutPictures(
        table=residency.table(bundle),
        asset=bundle.level_gaussians(0).rows,
        cameras=[camera.core for camera in cameras],
        seed=0,
    )


def place_of(view):
    """Return the position of the window's camera, and its size."""
    camera, *_ = view
    return tuple(camera.position), camera.width, camera.height


def test_pictures_are_of_all_sizes_from_all_around(bundle):
    pictures = pictures_of(bundle)
    views = [pictures.view(number) for number in range(200)]
    asset = bundle.level_gaussians(0)
    center = np.median(asset.means, axis=0)
    outwards = np.array([camera.position for camera, _, _ in views]) - center
    distance = np.linalg.norm(outwards, axis=1)
    np.testing.assert_allclose(distance, distance[0], rtol=1e-6)
    assert np.abs((outwards / distance[:, None]).mean(axis=0)).max() < 0.2
    widths = np.array([camera.width for camera, _, _ in views])
    assert widths.min() == 8
    assert 256 < widths.max() <= 512
    assert {samples for _, _, samples in views} == {2, 3, 8}
    assert all(camera.width == camera.height for camera, _, _ in views)
    counts = [len(clusters) for _, clusters, _ in views]
    assert min(counts) < 3
    assert max(counts) > 10


def test_a_picture_follows_from_its_number(bundle):
    first, again = pictures_of(bundle), pictures_of(bundle)
    for number in (0, 7, 1 << 40):
        one, other = first.view(number), again.view(number)
        assert place_of(one) == place_of(other)
        np.testing.assert_array_equal(one[1], other[1])
    assert place_of(first.view(0)) != place_of(first.view(1))


def test_what_a_window_shows_is_the_cut_of_its_picture(bundle):
    """At most one cluster of each path is in the cut, and clusters that are left out
    are outside the window."""
    pictures, parent = pictures_of(bundle), bundle.clusters.parent_group
    made = bundle.clusters.own_group
    for number in range(50):
        _, clusters, _ = pictures.view(number)
        below = set(made[clusters]) - {-1}
        above = set(parent[clusters]) - {-1}
        assert not below & above


def test_pictures_from_cameras_are_taken_there(bundle):
    cameras = v3dg.turntable((0, 0, 0), 3.0, 3, width=640, height=360)
    known = {tuple(camera.core.position) for camera in cameras}
    views = [pictures_of(bundle, cameras).view(number) for number in range(100)]
    assert {tuple(camera.position) for camera, _, _ in views} == known
    whole = [camera for camera, _, _ in views if camera.width < 256]
    assert len(whole) > 10
    for camera in whole:
        assert abs(camera.height - camera.width * 9 / 16) <= 1


def test_cuts_from_inside_are_of_coarse_levels_where_no_other_is_small_enough(bundle):
    """Groups around the eye are refined at any tolerance. If too many gaussians remain,
    whole levels are drawn instead."""
    center = np.median(bundle.level_gaussians(0).means, axis=0)
    camera = v3dg.Camera.look_at(
        center, center + np.array([0, 0, 1]), (0, 1, 0), fov_x=1.5, width=96, height=96
    )
    left = v3dg.select(bundle, camera, tolerance=1e30, device="cpu").num_gaussians
    views = [pictures_of(bundle, [camera]).view(number) for number in range(100)]
    sizes, level = np.diff(bundle.clusters.offset), bundle.clusters.level
    finest = np.array([level[clusters].min(initial=99) for _, clusters, _ in views])
    counts = np.array([sizes[clusters].sum() for _, clusters, _ in views])
    assert (finest == 0).any()
    coarse = (finest > 0) & (counts > sizes[-1])
    assert coarse.sum() > 20
    assert counts[coarse].max() < left


def test_cameras_come_by_name_too_and_one_by_one(bundle):
    cameras = v3dg.turntable((0, 0, 0), 3.0, 2, width=64, height=64)

    def refined(given):
        return refine_bundle(bundle, cameras=given, steps=2, drop=0, device="cpu", progress=False)

    wanted = refined(cameras)
    for given in ({"front": cameras[0], "back": cameras[1]}, iter(cameras)):
        found = refined(given)
        assert found.config["refined"]["cameras"] == 2
        np.testing.assert_array_equal(found.gaussians.means, wanted.gaussians.means)


def test_a_camera_that_sees_nothing_changes_nothing(bundle, device):
    away = v3dg.Camera.look_at((0, 0, 5), (0, 0, 9), (0, 1, 0), width=64, height=64)
    refined = refine_bundle(bundle, cameras=[away], steps=3, device=device, progress=False)
    for name, values in vars(bundle.gaussians).items():
        np.testing.assert_array_equal(values, getattr(refined.gaussians, name))
    assert refined.config["refined"] == {"steps": 3, "drop": 0.02, "seed": 0, "cameras": 1}


def test_cuts_from_a_camera_come_closer_to_the_asset(bundle, device):
    """They come closer than with the same number of steps from all around."""
    camera = v3dg.Camera.look_at((0, 0, 3), (0, 0, 0), (0, 1, 0), width=96, height=96)
    truth = draw_truth(bundle.level_gaussians(0), camera, "cpu", 4).astype(np.float32) / 255

    def error(refined):
        budgets = (1200, 300, 80)
        drawn = [v3dg.render(refined, camera, budget=b, device=device).color for b in budgets]
        return np.mean([np.abs(host(picture) - truth).mean() for picture in drawn])

    around = refine_bundle(bundle, steps=150, drop=0, device=device, progress=False)
    there = refine_bundle(
        bundle, cameras=[camera], steps=150, drop=0, device=device, progress=False
    )
    assert error(there) < error(around) < error(bundle)


def weights_of(bundle, device, steps, cameras=()):
    """Return how visible each gaussian is in the pictures of `steps`, and how many cuts
    contain it."""
    gaussians = on(device, bundle.gaussians)
    config = fit_config(BuildConfig(steps=steps, first_steps=steps, filter_px2=0.1), 0, 1)
    return _core.weigh_cuts(
        config, gaussians.rows, pictures_of(bundle, cameras), _core.FitProgress()
    )


def test_what_is_seen_of_gaussians_adds_up_to_the_alpha_of_pictures(bundle, device):
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=160, height=160)[0]
    weight, num_looks = weights_of(bundle, device, 1, [camera])
    window, clusters, _ = pictures_of(bundle, [camera]).view(0)
    offset = bundle.clusters.offset
    rows = np.concatenate([np.arange(offset[c], offset[c + 1]) for c in clusters])
    shown = replace(camera, K=window.K, width=window.width, height=window.height)
    drawn = v3dg.rasterize(bundle.gaussians.subset(rows), shown, filter_px2=0.1, antialiased=True)
    assert weight.sum() == pytest.approx(drawn.alpha.mean(), rel=1e-4)
    assert weight.min() >= 0
    others = np.ones(bundle.num_gaussians, bool)
    others[rows] = False
    assert not weight[others].any()
    np.testing.assert_array_equal(num_looks, ~others)


def test_looks_are_counted(bundle, device):
    """A gaussian in the cut of a picture counts, whether it is visible there or not."""
    _, num_looks = weights_of(bundle, device, 12)
    pictures, offset = pictures_of(bundle), bundle.clusters.offset
    expected = np.zeros(bundle.num_gaussians, int)
    for number in range(12):
        for cluster in pictures.view(number)[1]:
            expected[offset[cluster] : offset[cluster + 1]] += 1
    np.testing.assert_array_equal(num_looks, expected)


@pytest.mark.slow
def test_what_is_not_looked_at_stays(bundle, device):
    """A camera that sees only one side does not change the other side."""
    camera = v3dg.Camera.look_at((0.75, 0, 0.6), (0.75, 0, 0), (0, 1, 0), 0.5, width=64, height=64)
    _, num_looks = weights_of(bundle, "cpu", 2000, [camera])
    assert (num_looks == 0).any()
    refined = refine_bundle(
        bundle, cameras=[camera], steps=1, drop=0.5, device=device, progress=False
    )
    offset = bundle.clusters.offset[:-1]
    is_unseen = np.maximum.reduceat(num_looks, offset) == 0
    before, after = (np.diff(b.clusters.offset) for b in (bundle, refined))
    np.testing.assert_array_equal(before[is_unseen], after[is_unseen])
    assert after.sum() < before.sum()


def levels_inside_a_shell():
    """Return a bundle of a closed shell of opaque gaussians around hidden ones."""
    rng = np.random.default_rng(0)
    outwards = rng.normal(size=(3000, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    means = np.concatenate([outwards, 0.5 * outwards[:600]]).astype(np.float32)
    asset = v3dg.Gaussians(
        means=means,
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (len(means), 1)),
        scales=np.full((len(means), 3), 0.06, np.float32),
        opacities=np.full(len(means), 0.99, np.float32),
        sh=rng.uniform(-1, 1, (len(means), 1, 3)).astype(np.float32),
    )
    config = BuildConfig(steps=0, cluster_size=64)
    return v3dg.build_bundle(asset, config=config, device="cpu", progress=False)


def test_what_nobody_sees_is_dropped_of_all_levels_but_the_first(device, tmp_path):
    bundle = levels_inside_a_shell()
    refined = refine_bundle(bundle, seen_from="outside", steps=3, device=device, progress=False)
    assert len(refined.level_gaussians(0)) == len(bundle.level_gaussians(0))
    for level in (1, 2):
        before, after = (
            np.linalg.norm(b.level_gaussians(level).means, axis=1) < 0.7 for b in (bundle, refined)
        )
        assert after.sum() < 0.1 * before.sum()
        assert (~after).sum() > 0.9 * (~before).sum()
    for name in ("level", "own_group", "parent_group", "filter_px2"):
        np.testing.assert_array_equal(
            getattr(refined.clusters, name), getattr(bundle.clusters, name)
        )
    refined.write(tmp_path / "refined.v3dg")
    again = v3dg.Bundle.open(tmp_path / "refined.v3dg")
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=64, height=64)[0]
    for tolerance in (0.0, 2.0, np.inf):
        cuts = [v3dg.select(b, camera, tolerance=tolerance, device=device) for b in (bundle, again)]
        np.testing.assert_array_equal(cuts[0].cluster_ids, cuts[1].cluster_ids)
        assert cuts[1].num_gaussians <= cuts[0].num_gaussians


def test_what_is_dropped_has_the_share_together(bundle):
    """The share holds for each level, and no remaining gaussian is less visible than a
    dropped one."""
    rng = np.random.default_rng(0)
    weight = rng.exponential(size=bundle.num_gaussians)
    weight[rng.random(len(weight)) < 0.1] = np.nan  # not known
    for share in (0.01, 0.3):
        offset = bundle.clusters.offset
        left = _without_least(bundle, weight, share)
        for level in range(1, bundle.num_levels):
            of_level = bundle.level_range(level)
            weights = weight[offset[of_level.start] : offset[of_level.stop]]
            least = np.sort(weights)
            num_dropped = int((np.cumsum(least) < share * np.nansum(weights)).sum())
            assert len(left.level_gaussians(level)) == len(weights) - num_dropped
            kept = bundle.level_gaussians(level).means[~(weights < least[num_dropped])]
            np.testing.assert_array_equal(left.level_gaussians(level).means, kept)


def comparison(windows_per_step=1, cuts_per_view=8, window_means=1.0):
    return _core.CutComparison(
        windows_per_step=windows_per_step, cuts_per_view=cuts_per_view, window_means=window_means
    )


def arguments(bundle, device, config, pictures):
    gaussians = on(device, bundle.gaussians.subset(np.arange(bundle.num_gaussians)))
    leaves = gaussians.subset(slice(0, len(bundle.level_gaussians(0))))
    given = {
        "config": fit_config(config, 0, 1),
        "comparison": comparison(),
        "target": _core.FitTarget(leaves.rows, 0.0, False),
        "gaussians": gaussians.rows,
        "radius": np.full(bundle.num_gaussians, 2.0, np.float32),
        "pictures": pictures,
        "progress": _core.FitProgress(),
    }
    return gaussians, given


def planned_views(pictures, num_windows):
    """Return the windows of the first step: the first views, each with a cut of another
    number."""
    return [pictures.view(number, number % 8) for number in range(num_windows)]


def loss_of_window(window, drawn, leaves, samples, camera, window_means):
    """Return the loss of a window relative to its loss of pixels, computed with
    torch."""
    import torch

    shape = replace(camera, K=window.K, width=window.width, height=window.height)
    larger = v3dg.rasterize(leaves, shape.scaled(samples))
    color, alpha = (
        torch.tensor(box_downsample(array, samples).astype(np.float64))
        for array in (larger.color, larger.alpha)
    )
    differences = torch.cat([drawn.color - color, (drawn.alpha - alpha)[..., None]], dim=-1)
    weights = torch.tensor([1 / 3, 1 / 3, 1 / 3, 0.5], dtype=torch.float64)
    of_pixels = (differences.abs() @ weights).mean()
    border = (0, -window.width % 4, 0, -window.height % 4)
    padded = torch.nn.functional.pad(differences.permute(2, 0, 1), border)
    means = torch.nn.functional.avg_pool2d(padded, 4)
    of_each = torch.nn.functional.smooth_l1_loss(
        means, torch.zeros_like(means), reduction="none", beta=1e-4
    )
    of_cells = 16 * of_each.sum((1, 2)) @ weights
    sums = differences.sum((0, 1))
    target = torch.cat([color, alpha[..., None]], dim=-1).sum((0, 1))
    small = 0.02 * torch.maximum(target, 0.1 * target[3])
    of_means = (small * huber(sums / small)) @ weights
    num_pixels = window.width * window.height
    loss = of_pixels + (of_cells + window_means * of_means) / num_pixels
    return loss / (of_pixels.detach() + 1e-4)


def huber(x):
    """Return a function that is x² / 2 up to 1, and linear beyond it."""
    size = abs(x)
    return size.clip(max=1) * (size - size.clip(max=1) / 2)


class Slopes:
    """The gradients of the loss of a step's windows, computed with torch, and the
    number of windows that show each gaussian."""

    def __init__(self, bundle, pictures, camera, num_windows, window_means):
        import torch

        offset = bundle.clusters.offset
        leaves = bundle.level_gaussians(0)
        tensors = [
            torch.tensor(array.astype(np.float64), requires_grad=True)
            for array in vars(bundle.gaussians).values()
        ]
        self.num_windows = np.zeros(bundle.num_gaussians, int)
        loss = 0
        for window, clusters, samples in planned_views(pictures, num_windows):
            rows = np.concatenate([np.arange(offset[c], offset[c + 1]) for c in clusters])
            self.num_windows[rows] += 1
            drawn = v3dg.rasterize(
                v3dg.Gaussians(*(tensor[torch.tensor(rows)] for tensor in tensors)),
                replace(camera, K=window.K, width=window.width, height=window.height),
                filter_px2=0.1,
                antialiased=True,
            )
            loss = loss + loss_of_window(window, drawn, leaves, samples, camera, window_means)
        loss.backward()
        gradients = (tensor.grad.numpy() for tensor in tensors)
        self.by_name = dict(zip(vars(bundle.gaussians), gradients, strict=True))


def steps_of(start, moved):
    """Return how far each value moved, in units of its step size."""
    with np.errstate(divide="ignore", invalid="ignore"):  # an opacity of 1 has no logit
        logits = [
            np.log(opacities / (1 - opacities))
            for opacities in (g.opacities.astype(np.float64) for g in (start, moved))
        ]
        logit_steps = logits[1] - logits[0]
    return {
        "means": (moved.means - start.means) / (2.0 * STEP_SIZES["step_position"]),
        "scales": np.log(moved.scales / start.scales) / STEP_SIZES["step_log_scale"],
        "opacities": logit_steps / STEP_SIZES["step_logit"],
        "sh": (moved.sh - start.sh) / STEP_SIZES["step_sh0"],
    }


@pytest.mark.parametrize(("num_windows", "window_means"), [(1, 0), (1, 1), (5, 4), (8, 1)])
def test_a_step_goes_down_the_slope_of_the_loss(bundle, device, num_windows, window_means):
    """The first step of Adam has the sign of the gradient. Its length is the step size
    times the square root of the number of windows that show the gaussian."""
    pytest.importorskip("torch")
    config = replace(BuildConfig(), steps=1, first_steps=1, filter_px2=0.1, **STEP_SIZES)
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=160, height=160)[0]
    pictures = pictures_of(bundle, [camera])
    gaussians, given = arguments(bundle, device, config, pictures)
    given["comparison"] = comparison(windows_per_step=num_windows, window_means=window_means)
    _core.refine_cuts(**given)
    start = bundle.gaussians
    moved = host(gaussians)

    slopes = Slopes(bundle, pictures, camera, num_windows, window_means)
    moves = slopes.num_windows > 0
    moves[: len(bundle.level_gaussians(0))] = False
    if num_windows > 1:
        assert len(set(slopes.num_windows[moves])) > 1
    is_faint = start.opacities < 0.99  # beyond it, the logit of a float has few digits
    for name, steps in steps_of(start, moved).items():
        is_compared = moves
        if name == "opacities":
            is_compared = moves & is_faint
        step, slope = (
            values[is_compared].reshape(is_compared.sum(), -1)[:, :3]  # SH of degree 0
            for values in (steps, slopes.by_name[name])
        )
        size = np.broadcast_to(np.sqrt(slopes.num_windows[is_compared])[:, None], step.shape)
        is_steep = np.abs(slope) > 0.05 * np.abs(slope).max()
        assert is_steep.sum() > 20
        expected = -size[is_steep] * np.sign(slope[is_steep])
        np.testing.assert_allclose(step[is_steep], expected, rtol=0.05, err_msg=name)
    for name, values in vars(start).items():
        np.testing.assert_array_equal(getattr(moved, name)[~moves], values[~moves])


def test_gaussians_of_radius_0_do_not_move(bundle, device):
    config = replace(BuildConfig(), steps=5, first_steps=5, filter_px2=0.1, **STEP_SIZES)
    gaussians, inputs = arguments(bundle, device, config, pictures_of(bundle))
    stays = bundle.num_gaussians // 2 < np.arange(bundle.num_gaussians)
    inputs["radius"][stays] = 0
    _core.refine_cuts(**inputs)
    moves = ~stays
    moves[: len(bundle.level_gaussians(0))] = False
    moved = host(gaussians)
    for name, values in vars(bundle.gaussians).items():
        np.testing.assert_array_equal(getattr(moved, name)[stays], values[stays])
        assert (getattr(moved, name)[moves] != values[moves]).any()


def test_all_cuts_of_a_view_have_its_window(bundle):
    """A target is drawn once and compared with several cuts."""
    cameras = v3dg.turntable((0, 0, 0), 3.0, 3, width=640, height=360)
    for pictures in (pictures_of(bundle), pictures_of(bundle, cameras)):
        num_shown = []
        for number in range(20):
            views = [pictures.view(number, cut) for cut in range(5)]
            assert len({place_of(view) for view in views}) == 1
            np.testing.assert_array_equal(views[2][1], pictures.view(number, 2)[1])
            num_shown.append([len(clusters) for _, clusters, _ in views])
        num_shown = np.array(num_shown)
        assert (num_shown.min(axis=1) < num_shown.max(axis=1)).mean() > 0.7


def test_steps_of_several_windows_are_the_same_with_any_number_of_them_ahead(bundle, device):
    """A picture of the asset is replaced only after all steps that use it."""
    config = BuildConfig(steps=90, first_steps=90, filter_px2=0.05)

    def moved():
        gaussians, given = arguments(bundle, device, config, pictures_of(bundle))
        given["comparison"] = comparison(windows_per_step=4, cuts_per_view=3)
        _core.refine_cuts(**given)
        assert given["progress"].groups_done == 4 * 90
        return np.concatenate([array.ravel() for array in vars(host(gaussians)).values()])

    np.testing.assert_array_equal(moved(), moved())


@pytest.mark.gpu
def test_both_devices_take_the_same_steps(bundle):
    """The pictures of the asset are used several times, each time with new cuts."""
    config = BuildConfig(steps=40, first_steps=40, filter_px2=0.05)
    config = replace(config, **{name: 0.1 * getattr(config, name) for name in SIZES})
    moved = {}
    for device in ("cpu", "cuda"):
        gaussians, given = arguments(bundle, device, config, pictures_of(bundle))
        given["comparison"] = comparison(windows_per_step=8, cuts_per_view=2)
        _core.refine_cuts(**given)
        moved[device] = host(gaussians)
    for name, start in vars(bundle.gaussians).items():
        steps = [getattr(gaussians, name) - start for gaussians in moved.values()]
        distance = np.linalg.norm(steps[0] - steps[1])
        assert distance < 0.2 * np.linalg.norm(steps[0]), name


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"windows_per_step": 0}, "windows_per_step: expected 1 to 32, got 0"),
        ({"windows_per_step": 33}, "windows_per_step: expected 1 to 32, got 33"),
        ({"cuts_per_view": 0}, "cuts_per_view: expected 1 to 128, got 0"),
        ({"window_means": -1.0}, "window_means: expected a finite number of at least 0, got -1"),
        ({"window_means": np.inf}, "window_means: expected a finite number of at least 0, got inf"),
    ],
)
def test_a_comparison_is_refused_that_makes_no_sense(change, message):
    with pytest.raises(ValueError, match=message):
        comparison(**change)


def test_the_core_refuses_what_does_not_fit(bundle, device):
    _, given = arguments(bundle, device, BuildConfig(steps=1), pictures_of(bundle))
    count = bundle.num_gaussians
    wrong = {
        "radius: expected numbers of at least 0, got -1": {
            "radius": np.full(count, -1, np.float32)
        },
        "radius: expected": {"radius": np.ones(count - 1, np.float32)},
        f"gaussians: expected {count} as in the table, got {count - 1}": {
            "gaussians": on(device, bundle.gaussians.subset(np.arange(count - 1))).rows,
            "radius": np.ones(count - 1, np.float32),
        },
    }
    for message, change in wrong.items():
        with pytest.raises(ValueError, match=message):
            _core.refine_cuts(**(given | change))


def test_pictures_are_refused_of_nothing(bundle):
    given = {"table": residency.table(bundle), "cameras": [], "seed": 0}
    nothing = bundle.gaussians.subset(slice(0, 0))
    with pytest.raises(ValueError, match="asset: expected at least one gaussian, got none"):
        _core.CutPictures(asset=nothing.rows, **given)


@pytest.mark.gpu
def test_pictures_are_refused_of_an_asset_elsewhere(bundle):
    given = {"table": residency.table(bundle), "cameras": [], "seed": 0}
    with pytest.raises(
        ValueError, match="asset: expected gaussians on the host, got gaussians on a device"
    ):
        _core.CutPictures(asset=on("cuda", bundle.level_gaussians(0)).rows, **given)
