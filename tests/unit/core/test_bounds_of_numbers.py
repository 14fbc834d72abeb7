"""The error bounds in docs/numerics.md for needles and for large gaussians hold for
thousands of random ones."""

import dataclasses

import numpy as np
import pytest

import hard_cases
import scenes
import v3dg
from compare import NEEDLES_FLOAT, assert_pictures_agree
from devices import host, on
from reference import rasterize as reference_rasterize

CAMERAS = list(scenes.CAMERAS.values())[:4]
COUNT = 30
SEEDS = range(60)


def needle_case(seed, mode):
    """Return COUNT needles with lengths of 0.1 to 30 units. All have the same aspect
    ratio, 10² to 10⁶, which is also returned."""
    rng = np.random.default_rng(10_000 + seed)
    aspect = 10.0 ** rng.uniform(2, 6)
    length = 10.0 ** rng.uniform(-1, 1.5)
    camera = CAMERAS[seed % len(CAMERAS)]
    scales = (length, length / aspect, length / aspect)
    return hard_cases.HardCase(
        "", hard_cases.crowd(seed, camera, COUNT, scales=scales), camera, mode
    ), aspect


@pytest.mark.parametrize("first", [100 * k for k in range(5)])
def test_needles_without_a_filter_are_as_exact_as_their_aspect_lets_them_be(first):
    for seed in range(first, first + len(SEEDS)):
        case, aspect = needle_case(seed, {})
        largest = max(1e-4, 5e-7 * aspect)
        # At the cut-off of 3.3 standard deviations, the relative error of alpha is
        # larger.
        bound = dataclasses.replace(
            NEEDLES_FLOAT,
            absolute=largest,
            mean=largest,
            relative_depth=1.0,
            band=min(0.3, 10 * largest),
            share=0.02,
        )
        expected = reference_rasterize.rasterize(case.gaussians, case.camera)
        assert_pictures_agree(v3dg.rasterize(case.gaussians, case.camera), expected, bound)


def gradient_distances(case):
    """For each input, return the distance of the float32 gradient from the float64
    gradient, the norm of its own gradient, and the norm of all gradients."""
    import torch

    changes = [
        hard_cases.relative_changes(case, hard_cases.gradients(case, hard_cases.draw_core, dtype))
        for dtype in (torch.float32, torch.float64)
    ]
    own = [np.linalg.norm(double) for double in changes[1]]
    whole = np.sqrt(np.square(own).sum())
    return [np.linalg.norm(s - d) for s, d in zip(*changes, strict=True)], own, whole


@pytest.mark.parametrize(
    "mode", [{}, hard_cases.FILTER, hard_cases.ANTIALIASED], ids=["plain", "filter", "aa"]
)
def test_gradients_of_needles_are_as_exact_as_their_aspect_lets_them_be(mode):
    pytest.importorskip("torch")
    for seed in SEEDS:
        case, aspect = needle_case(seed, mode)
        bound = 2e-3 if mode else max(2e-3, 4e-6 * aspect)
        distances, _, whole = gradient_distances(case)
        assert max(distances) <= bound * max(whole, 1e-300), f"seed {seed}"


@pytest.mark.parametrize("mode", [hard_cases.FILTER, hard_cases.ANTIALIASED], ids=["filter", "aa"])
def test_small_shares_of_gradients_are_off_by_a_share_of_the_whole(mode):
    """The quaternions of gaussians of 10⁶ units and more hardly influence a uniform
    picture."""
    pytest.importorskip("torch")
    for seed in SEEDS:
        rng = np.random.default_rng(seed)
        camera = CAMERAS[seed % len(CAMERAS)]
        scales = 10.0 ** rng.uniform(5, 8, 3)
        gaussians = hard_cases.crowd(seed, camera, COUNT, scales=scales, opacities=0.1)
        case = hard_cases.HardCase("", gaussians, camera, mode)
        distances, own, whole = gradient_distances(case)
        for name, distance, norm in zip(scenes.NAMES, distances, own, strict=True):
            assert distance <= 2e-3 * norm + 1e-5 * whole, f"{name}, seed {seed}"


def test_depths_beyond_float32_are_not_drawn(device):
    """Without a check, they would be drawn at the principal point, and the depth of the
    picture would be NaN."""
    turned = scenes.CAMERAS["posed"]
    far = 3.6e38 * turned.viewmat[2, :3]
    beyond = scenes.gaussians(far[None], scales=0.3)
    image = v3dg.rasterize(on(device, beyond), turned, **hard_cases.FILTER)
    color, alpha, depth = host((image.color, image.alpha, image.depth))
    assert not color.any()
    assert not alpha.any()
    assert not depth.any()


def test_numbers_that_overflow_an_integer_are_no_harm():
    """Positions and extents beyond 2³¹ px have defined results, so
    UndefinedBehaviorSanitizer reports nothing."""
    means = np.float32(
        [[0, 0, 2], [1e20, 0, 2], [-1e20, 1e20, 2], [0, -1e38, 1], [1e38, 1e38, 1e38]]
    )
    far = scenes.gaussians(means, scales=0.3)
    one = scenes.gaussians(means[:1], scales=0.3)
    for mode in ({}, hard_cases.FILTER, hard_cases.ANTIALIASED):
        got = v3dg.rasterize(far, hard_cases.PLAIN, **mode)
        expected = v3dg.rasterize(one, hard_cases.PLAIN, **mode)
        np.testing.assert_array_equal(got.color, expected.color)
