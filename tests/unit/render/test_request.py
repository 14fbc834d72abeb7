"""Tests requests as they are passed to the core: cuts, and what pixels show."""

import itertools

import numpy as np
import pytest

import v3dg
from devices import host
from random_bundle import random_gaussians
from scenes_lod import lod_bundle
from v3dg import Camera, StereoCamera, _core
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


EYE = Camera.look_at((0, -6, 0), (0, 0, 0), width=48, height=40)
TOLERANCES = [0.0, 3.0, 5.0, 9.4, 20.0]


@pytest.fixture(scope="module")
def asset():
    """Return gaussians that leave less than a ten-thousandth of the light in most
    pixels."""
    return random_gaussians(np.random.default_rng(5), 2000)


@pytest.fixture(scope="module")
def bundle(asset):
    return lod_bundle(np.random.default_rng(5), asset, 32)


def assert_same(picture, expected):
    for name in ("color", "alpha"):
        got, wanted = (host([getattr(side, name)])[0] for side in (picture, expected))
        np.testing.assert_array_equal(got, wanted)


def test_pixels_of_assets_stop_as_in_rasterize(asset):
    assert_same(v3dg.render(asset, EYE, device="cpu"), v3dg.rasterize(asset, EYE))


def test_the_stop_grows_with_the_tolerance_of_the_cut():
    stops = [_core.stop_of_tolerance(tolerance) for tolerance in np.linspace(0, 40, 401)]
    assert all(a <= b for a, b in itertools.pairwise(stops))
    for tolerance, stop in ((0, 1e-4), (3, 1e-4), (6, 4e-4), (9.5, 1e-3), (float("inf"), 1e-3)):
        assert _core.stop_of_tolerance(tolerance) == pytest.approx(stop)


@pytest.mark.parametrize("tolerance", TOLERANCES)
def test_pixels_of_cuts_stop_by_their_tolerance(bundle, device, tolerance):
    """This also holds for both eyes, for a cut that was selected earlier, and with a
    pool."""
    stop = _core.stop_of_tolerance(tolerance)
    options = {"tolerance": tolerance, "device": device}
    expected = v3dg.render(bundle, EYE, min_transmittance=stop, **options)
    assert_same(v3dg.render(bundle, EYE, **options), expected)
    assert_same(v3dg.render(bundle, EYE, memory="1GiB", **options), expected)
    cut = v3dg.select(bundle, EYE, **options)
    assert_same(v3dg.render(bundle, EYE, cut=cut, device=device), expected)
    for default, eye in zip(
        v3dg.render(bundle, StereoCamera.of(EYE, 0.1), **options),
        v3dg.render(bundle, StereoCamera.of(EYE, 0.1), min_transmittance=stop, **options),
        strict=True,
    ):
        assert_same(default, eye)
    other = 1e-3 if stop < 5e-4 else 1e-4
    changed = v3dg.render(bundle, EYE, min_transmittance=other, **options)
    assert (host([changed.color])[0] != host([expected.color])[0]).any()


@pytest.mark.parametrize("budget", [2000, 1200, 700, 300])
def test_pixels_of_a_budget_stop_by_the_tolerance_that_meets_it(bundle, device, budget):
    default = v3dg.render(bundle, EYE, budget=budget, device=device)
    stop = _core.stop_of_tolerance(default.stats.tolerance)
    expected = v3dg.render(bundle, EYE, budget=budget, min_transmittance=stop, device=device)
    assert_same(default, expected)


def test_a_cut_of_level_0_is_no_worse_than_its_asset(asset, bundle, device):
    """The default tolerance is used close to the asset, where the whole cut is level
    0."""
    near = Camera.look_at((0, -1.5, 0), (0, 0, 0), width=480, height=400)
    truth = v3dg.rasterize(asset, near)
    picture = v3dg.render(bundle, near, device=device)
    whole = v3dg.render(bundle, near, tolerance=0.0, min_transmittance=0.0, device=device)
    cut = v3dg.select(bundle, near, device=device)
    assert (cut.per_pair(lambda clusters: clusters.level) == 0).all()
    exact = host([whole.color])[0]
    error = np.abs(host([picture.color])[0] - exact).mean()
    assert error <= 1.001 * np.abs(truth.color - exact).mean()
