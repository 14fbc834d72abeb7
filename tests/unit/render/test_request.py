"""What is asked for, as it goes to the core: cuts, and what pixels show."""

import numpy as np
import pytest

import v3dg
from random_bundle import random_gaussians
from scenes_lod import lod_bundle
from v3dg import Camera
from v3dg.render import DEFAULT_MIN_TRANSMITTANCE
from v3dg.render.request import BLACK, CutRequest, shade_of


def test_a_request_with_the_same_numbers_has_the_same_rule():
    assert CutRequest(2.0, 100, 1).rule is CutRequest(2.0, 100, 1).rule


def test_numbers_of_numpy_are_taken_but_not_remembered():
    plain = CutRequest(2.0, 100)
    numpy = CutRequest(np.float64(2.0), np.int64(100))
    assert plain.is_plain
    assert not numpy.is_plain
    assert numpy.rule is not numpy.rule
    assert numpy.rule.tolerance_px2 == plain.rule.tolerance_px2 == 2.0


def test_true_is_refused_also_after_the_number_it_equals():
    assert CutRequest(min_level=1).rule is CutRequest(min_level=1).rule
    with pytest.raises((TypeError, ValueError), match="min_level"):
        CutRequest(min_level=True).rule  # noqa: B018


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((-1.0,), "tolerance: expected"),
        ((None, -1), "budget: expected"),
        ((None, None, -1), "min_level: expected"),
        ((None, None, 0, float("nan")), "fade: expected"),
    ],
)
def test_wrong_numbers_are_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        CutRequest(*arguments).rule  # noqa: B018


def test_wrong_shades_are_named():
    with pytest.raises(ValueError, match="background: expected"):
        shade_of((0.25, 0.5), None, is_asset=False, depth=True)
    with pytest.raises(ValueError, match="min_transmittance: expected a transmittance from"):
        shade_of(BLACK, 1.0, is_asset=False, depth=True)


@pytest.mark.parametrize("is_asset", [True, False])
def test_a_transmittance_that_is_not_given_is_the_default(is_asset):
    """Of assets that of `v3dg.rasterize`, which is a decision of the core."""
    rng = np.random.default_rng(5)
    asset = random_gaussians(rng, 400)
    camera = Camera.look_at((0, -6, 0), (0, 0, 0), width=48, height=40)
    subject = asset if is_asset else lod_bundle(rng, asset, 32)
    default = v3dg.render(subject, camera, tolerance=0.0, device="cpu")
    if is_asset:
        expected = v3dg.rasterize(asset, camera)
    else:
        stop = DEFAULT_MIN_TRANSMITTANCE
        expected = v3dg.render(subject, camera, tolerance=0.0, min_transmittance=stop, device="cpu")
        assert default.alpha.max() > 1 - 2 * stop  # the stop matters somewhere
    np.testing.assert_array_equal(default.color, expected.color)
