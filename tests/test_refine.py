"""Levels refined together: what gets better, what stays, and one step by itself."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from devices import host, on
from random_bundle import random_bundle
from v3dg import BuildConfig, _core
from v3dg.build.fit import fit_config
from v3dg.donut import make_donut
from v3dg.metrics import draw_truth
from v3dg.refine import _Views, refine_bundle

SIZES = ("step_position", "step_quat", "step_log_scale", "step_logit", "step_sh0", "step_sh_rest")


@pytest.fixture(scope="module")
def bundle():
    """Merged levels of a small donut, which leave much to be made better."""
    config = BuildConfig(steps=0, cluster_size=128)
    return v3dg.build_bundle(make_donut(3000), config=config, device="cpu", progress=False)


def distance_to_asset(bundle, device):
    """Mean difference between cuts of several counts, from four sides, and the asset."""
    errors = []
    for camera in v3dg.turntable((0, 0, 0), 3.0, 4, width=48, height=48):
        truth = draw_truth(bundle.level_gaussians(0), camera, "cpu", 4).astype(np.float32) / 255
        for budget in (1200, 300, 80):
            picture = v3dg.render(bundle, camera, budget=budget, device=device).color
            errors.append(np.abs(host(picture) - truth).mean())
    return np.array(errors)


def test_cuts_come_closer_to_the_asset(bundle, device):
    refined = refine_bundle(bundle, steps=400, device=device, progress=False)
    before, after = distance_to_asset(bundle, device), distance_to_asset(refined, device)
    assert after.mean() < 0.9 * before.mean()


def test_tables_and_level_0_stay(bundle, device):
    refined = refine_bundle(bundle, steps=3, seed=5, device=device, progress=False)
    assert refined.config == bundle.config | {"refined": {"steps": 3, "seed": 5}}
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


def test_a_quantised_bundle_stays_one(bundle, device):
    coded = v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, bundle.config, "quantized")
    refined = refine_bundle(coded, steps=3, device=device, progress=False)
    assert refined.codec == "quantized"


def test_the_same_seed_gives_the_same_bits(bundle, device):
    def values(seed):
        refined = refine_bundle(bundle, steps=20, seed=seed, device=device, progress=False)
        return np.concatenate([array.ravel() for array in vars(refined.gaussians).values()])

    first = values(0)
    np.testing.assert_array_equal(first, values(0))
    assert not np.array_equal(first, values(1))


def test_threads_do_not_change_the_result(bundle, tmp_path):
    bundle.write(tmp_path / "bundle.v3dg")
    program = (
        "import v3dg, sys; b = v3dg.Bundle.open(sys.argv[1]);"
        "v3dg.refine_bundle(b, steps=10, device='cpu', progress=False).write(sys.argv[2])"
    )
    for threads in ("1", "3"):
        command = [sys.executable, "-c", program, tmp_path / "bundle.v3dg", tmp_path / f"{threads}.v3dg"]
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
    with pytest.raises(ValueError, match="steps: expected 1 step or more, got 0"):
        refine_bundle(bundle, steps=0)
    with pytest.raises(TypeError, match="bundle: expected a Bundle, got Gaussians"):
        refine_bundle(make_donut(1000))


def test_what_a_progress_function_raises_ends_it(bundle):
    def stop(done, total, text):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        refine_bundle(bundle, steps=300, device="cpu", progress=stop)


def test_pictures_are_of_all_sizes(bundle):
    views = _Views(bundle, np.random.default_rng(0))
    for count in (10, 1000, 100_000, 1e12):
        for _ in range(20):
            picture, window = views._pictures(count)
            assert 8 <= picture.width == picture.height <= 1 << 15
            assert window.width == window.height == min(picture.width, 256)
            corner = picture.K[:2, 2] - window.K[:2, 2]
            assert (corner >= 0).all()
            assert (corner + window.width <= picture.width).all()
    counts = [len(views.random()[1]) for _ in range(50)]
    assert min(counts) < 3
    assert max(counts) > 10


def arguments(bundle, device, config, clusters, camera):
    gaussians = on(device, bundle.gaussians.subset(np.arange(bundle.num_gaussians)))
    leaves = gaussians.subset(slice(0, len(bundle.level_gaussians(0))))
    given = {
        "config": fit_config(config, 0, 1),
        "target": _core.FitTarget(leaves.rows, 0.0, False),
        "gaussians": gaussians.rows,
        "offset": bundle.clusters.offset,
        "radius": np.full(bundle.num_gaussians, 2.0, np.float32),
        "views": [(camera.core, np.asarray(clusters, np.int32))],
        "progress": _core.FitProgress(),
    }
    return gaussians, given


def test_a_step_goes_down_the_slope_of_the_loss(bundle, device):
    """The first step of Adam has the size of the step and the sign of the slope, whatever that is."""
    torch = pytest.importorskip("torch")
    sizes = dict(zip(SIZES, (1e-4, 2e-4, 3e-4, 4e-4, 5e-4, 6e-4), strict=True))
    config = replace(BuildConfig(), steps=1, first_steps=1, supersample=1, filter_px2=0.1, **sizes)
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=160, height=160)[0]
    clusters = bundle.level_range(2)
    gaussians, given = arguments(bundle, device, config, clusters, camera)
    _core.refine_cuts(**given)
    moved = host(gaussians)

    offset = bundle.clusters.offset
    rows = slice(int(offset[clusters.start]), int(offset[clusters.stop]))
    start = bundle.gaussians.subset(rows)
    tensors = [torch.tensor(a.astype(np.float64), requires_grad=True) for a in vars(start).values()]
    drawn = v3dg.rasterize(v3dg.Gaussians(*tensors), camera, filter_px2=0.1, antialiased=True)
    leaves = v3dg.Gaussians(
        *(torch.tensor(a.astype(np.float64)) for a in vars(bundle.level_gaussians(0)).values())
    )
    wanted = v3dg.rasterize(leaves, camera)
    loss = (drawn.color - wanted.color).abs().mean() + 0.5 * (drawn.alpha - wanted.alpha).abs().mean()
    loss.backward()
    slopes = dict(zip(vars(start), (t.grad.numpy() for t in tensors), strict=True))
    is_faint = start.opacities < 0.99  # beyond, the logit of a float has few digits

    def logit(gaussians):
        opacities = gaussians.opacities[is_faint].astype(np.float64)
        return np.log(opacities / (1 - opacities))

    moved = moved.subset(rows)
    slopes["opacities"] = slopes["opacities"][is_faint]
    steps = {
        "means": (moved.means - start.means, 2.0 * sizes["step_position"]),
        "scales": (np.log(moved.scales / start.scales), sizes["step_log_scale"]),
        "opacities": (logit(moved) - logit(start), sizes["step_logit"]),
        "sh": (moved.sh - start.sh, sizes["step_sh0"]),
    }
    for name, (step, size) in steps.items():
        slope = slopes[name]
        if name == "sh":
            step, slope = step[:, 0], slope[:, 0]
        is_steep = np.abs(slope) > 0.05 * np.abs(slope).max()
        assert is_steep.sum() > 20
        np.testing.assert_allclose(step[is_steep], -size * np.sign(slope[is_steep]), rtol=0.05, err_msg=name)
    others = np.ones(bundle.num_gaussians, bool)
    others[rows] = False
    for name, values in vars(bundle.gaussians).items():
        np.testing.assert_array_equal(getattr(host(gaussians), name)[others], values[others])


def test_the_core_refuses_what_does_not_fit(bundle, device):
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=16, height=16)[0]
    _, given = arguments(bundle, device, BuildConfig(steps=1), [0], camera)
    count = bundle.num_gaussians
    wrong = {
        "offset: expected numbers from 0": {"offset": bundle.clusters.offset[:-1]},
        "radius: expected positive": {"radius": np.zeros(count, np.float32)},
        "radius: expected": {"radius": np.ones(count - 1, np.float32)},
        "clusters: expected numbers of clusters, got -1": {"views": [(camera.core, np.int32([-1]))]},
        f"got {len(bundle.clusters)}": {"views": [(camera.core, np.int32([len(bundle.clusters)]))]},
    }
    for message, change in wrong.items():
        with pytest.raises(ValueError, match=message):
            _core.refine_cuts(**(given | change))
