"""Tests which faults are found in an asset."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scenes
from devices import on
from v3dg import rasterize
from v3dg.cleaning import SMALLEST_OPACITY, coarse_note, describe, examine, outliers

CAMERA = scenes.camera()


def test_nothing_is_wrong_with_a_good_asset(device):
    asset = scenes.random_gaussians(0, CAMERA, 50, sh_degree=1)
    findings = examine(on(device, asset))
    assert findings.drawable.all()
    assert (findings.counts, findings.num_wrong, findings.num_dropped) == ({}, 0, 0)


def test_an_empty_asset_has_no_findings():
    findings = examine(scenes.gaussians(np.zeros((0, 3))))
    assert findings.drawable.shape == (0,)
    assert findings.counts == {}


def test_every_kind_is_counted_and_a_gaussian_may_be_of_several(device):
    asset = scenes.random_gaussians(0, CAMERA, 50, sh_degree=1)
    arrays = {name: np.array(getattr(asset, name)) for name in scenes.NAMES}
    arrays["means"][3, 1] = np.nan
    arrays["means"][4, 0] = -2e18
    arrays["quats"][3, 3] = np.inf
    arrays["scales"][[5, 6], 2] = -1, np.inf
    arrays["opacities"][[7, 8, 9, 10]] = 1.5, -np.inf, 0.001, 0
    arrays["sh"][11, 3, 2] = np.nan
    findings = examine(on(device, scenes.replaced(asset, **arrays)))
    np.testing.assert_array_equal(np.flatnonzero(~findings.drawable), [3, 4, 5, 6, 7, 8, 9, 10, 11])
    assert findings.counts == {
        "means_not_finite": 1,
        "quats_not_finite": 1,
        "scales_not_finite": 1,
        "opacities_not_finite": 1,
        "sh_not_finite": 1,
        "too_large": 1,
        "negative_scale": 1,
        "opacity_out_of_range": 2,
        "transparent": 2,
    }
    assert (findings.num_wrong, findings.num_dropped) == (7, 9)
    assert findings.text.startswith(
        "9 of 50 gaussians cannot be drawn: 1 with a position that is not finite"
    )


@pytest.mark.parametrize("name", scenes.poison())
def test_what_has_no_meaning_is_wrong(name):
    assert examine(scenes.poison()[name]).num_wrong == 1


def test_counts_are_described_in_words():
    text = describe({"negative_scale": 1234, "transparent": 1})
    assert text == "1,234 with a negative scale, 1 with an opacity below 1/255, which is invisible"


@pytest.mark.parametrize("filter_px2", [0.0, 0.3])
def test_what_is_called_transparent_is_never_drawn(filter_px2):
    asset = scenes.random_gaussians(1, CAMERA, 200)
    below = np.full(200, np.nextafter(np.float32(SMALLEST_OPACITY), np.float32(0)), np.float32)
    assert (examine(scenes.replaced(asset, opacities=below)).counts) == {"transparent": 200}
    hidden = rasterize(scenes.replaced(asset, opacities=below), CAMERA, filter_px2=filter_px2)
    assert hidden.alpha.max() == 0
    assert rasterize(asset, CAMERA, filter_px2=filter_px2).alpha.max() > 0


@given(
    seed=st.integers(0, 99),
    scale=st.floats(1e-12, 1e12),
    shift=st.floats(-1e3, 1e3),
    far=st.floats(60, 1e6),
)
def test_outliers_are_the_same_wherever_and_however_large(seed, scale, shift, far):
    means = np.random.default_rng(seed).normal(size=(100, 3))
    means[[2, 50]] *= far / np.linalg.norm(means[[2, 50]], axis=1, keepdims=True)
    placed = ((means + shift) * scale).astype(np.float32)
    np.testing.assert_array_equal(np.flatnonzero(outliers(placed)), [2, 50])


@pytest.mark.parametrize("num", [0, 1, 2, 5])
def test_few_or_equal_positions_have_no_outliers(num):
    assert not outliers(np.zeros((num, 3), np.float32)).any()
    assert not outliers(np.random.default_rng(0).normal(size=(num, 3)).astype(np.float32)).any()


@pytest.mark.parametrize(
    ("distance", "scale", "expected"),
    [
        (1e3, 0.01, None),
        (4e6, 10.0, None),
        (4e6, 0.01, "steps of up to 0.25, because float32 is no finer 4e+06 from zero"),
        (np.nan, 0.01, None),
    ],
)
def test_positions_that_float32_cannot_tell_apart_are_told(distance, scale, expected):
    means = np.full((40, 3), distance)
    note = coarse_note(scenes.gaussians(means, scales=np.full((40, 3), scale)))
    assert note == expected or expected in note


def test_some_strays_make_no_asset_coarse():
    means = np.zeros((100, 3))
    means[:40] = 1e7
    assert coarse_note(scenes.gaussians(means)) is None
    assert coarse_note(scenes.gaussians(np.zeros((0, 3)))) is None
