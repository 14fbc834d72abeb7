"""Tests edits of assets: cropping, deleting, dropping outliers, reducing the SH degree,
and joining."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scenes
import v3dg
from v3dg.rotations import quaternion_from_angles, rotation_from_quaternion

KINDS = pytest.mark.parametrize("kind", ["numpy", "torch"])


def asset(count=50, sh_degree=1, seed=0):
    return scenes.random_gaussians(seed, scenes.camera(), count, sh_degree=sh_degree)


def of_kind(kind, gaussians):
    return gaussians if kind == "numpy" else gaussians.torch("cpu")


def same_rows(part, whole, rows):
    for name in scenes.NAMES:
        np.testing.assert_array_equal(getattr(part.numpy(), name), getattr(whole, name)[rows])


def with_means(means):
    means = np.asarray(means, np.float32)
    return scenes.replaced(asset(len(means)), means=means)


@KINDS
@given(corners=st.lists(st.floats(-2, 2), min_size=6, max_size=6))
def test_a_box_and_its_outside_share_the_asset(kind, corners):
    whole = asset()
    low, high = np.sort(np.reshape(corners, (2, 3)), axis=0)
    is_inside = np.all((whole.means >= low) & (whole.means <= high), axis=1)
    same_rows(v3dg.crop_box(of_kind(kind, whole), low, high), whole, is_inside)
    deleted = v3dg.crop_box(of_kind(kind, whole), low, high, keep="outside")
    same_rows(deleted, whole, ~is_inside)


@KINDS
def test_a_sphere_and_its_outside_share_the_asset(kind):
    whole = asset()
    center = whole.means.mean(axis=0)
    distance = np.linalg.norm(whole.means.astype(np.float64) - center, axis=1)
    radius = float(np.median(distance))
    same_rows(v3dg.crop_sphere(of_kind(kind, whole), center, radius), whole, distance <= radius)
    deleted = v3dg.crop_sphere(of_kind(kind, whole), center, radius, keep="outside")
    same_rows(deleted, whole, distance > radius)


def test_the_surface_is_inside_and_nan_is_outside():
    whole = with_means([[1, 1, 1], [-1, 0, 0], [np.nan, 0, 0], [np.inf, 0, 0]])
    assert len(v3dg.crop_box(whole, (-1, -1, -1), (1, 1, 1))) == 2
    assert len(v3dg.crop_sphere(whole, (0, 0, 0), 1)) == 1
    assert len(v3dg.crop_box(whole, (-np.inf,) * 3, (np.inf,) * 3)) == 3
    assert len(v3dg.crop_box(whole, (-np.inf,) * 3, (np.inf,) * 3, keep="outside")) == 1


def test_outliers_are_those_that_info_counts():
    means = np.random.default_rng(0).normal(size=(100, 3))
    means[7] = (0, 0, 1e4)
    means[8] = (np.nan, 0, 0)
    whole = with_means(means)
    whole.opacities[:] = 0.5
    rows = np.arange(100) != 7
    same_rows(v3dg.drop_outliers(whole), whole, rows)
    transparent = scenes.replaced(whole, opacities=np.zeros(100, np.float32))
    same_rows(v3dg.drop_outliers(transparent), transparent, np.ones(100, bool))


@KINDS
def test_an_opacity_at_the_limit_stays(kind):
    opacities = np.array([0.1, 0.09, np.nan, 0.5], np.float32)
    whole = scenes.replaced(asset(4), opacities=opacities)
    same_rows(v3dg.drop_transparent(of_kind(kind, whole), 0.1), whole, [0, 3])


@KINDS
def test_degrees_are_cut_and_extended_by_zeros(kind):
    whole = asset(sh_degree=2)
    lower = v3dg.to_degree(of_kind(kind, whole), 1).numpy()
    np.testing.assert_array_equal(lower.sh, whole.sh[:, :4])
    higher = v3dg.to_degree(of_kind(kind, whole), 3).numpy()
    np.testing.assert_array_equal(higher.sh[:, :9], whole.sh)
    assert not higher.sh[:, 9:].any()
    assert v3dg.to_degree(whole, 2) is whole


@KINDS
@pytest.mark.parametrize("antialiased", [None, False, True])
def test_another_degree_keeps_how_an_asset_was_trained(kind, antialiased):
    whole = of_kind(kind, asset(sh_degree=1)).trained(antialiased=antialiased)
    for degree in range(4):
        assert v3dg.to_degree(whole, degree).antialiased is antialiased


@KINDS
def test_joined_assets_have_the_highest_degree(kind):
    parts = [asset(3, 0), asset(4, 2, seed=1)]
    joined = v3dg.join([of_kind(kind, part) for part in parts]).numpy()
    assert (len(joined), joined.sh_degree) == (7, 2)
    same_rows(joined.subset(slice(3, 7)), parts[1], slice(None))
    np.testing.assert_array_equal(joined.sh[:3, :1], parts[0].sh)


def test_empty_assets_are_edited():
    empty = asset(0)
    assert len(v3dg.crop_box(empty, (0, 0, 0), (1, 1, 1))) == 0
    assert len(v3dg.crop_sphere(empty, (0, 0, 0), 1)) == 0
    assert len(v3dg.drop_outliers(empty)) == 0
    assert len(v3dg.drop_transparent(empty, 0.5)) == 0
    assert len(v3dg.join([empty, v3dg.to_degree(empty, 3)])) == 0


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda a: v3dg.crop_box(a, (0, 0), (1, 1, 1)), "low: expected three numbers"),
        (lambda a: v3dg.crop_box(a, (0, 0, np.nan), (1, 1, 1)), "low: expected three numbers"),
        (
            lambda a: v3dg.crop_box(a, (2, 0, 0), (1, 1, 1)),
            "low, high: expected high to be at least low",
        ),
        (lambda a: v3dg.crop_box(a, (0, 0, 0), (1, 1, 1), keep="both"), "keep: expected 'inside'"),
        (lambda a: v3dg.crop_sphere(a, (0, 0, np.inf), 1), "center: expected finite numbers"),
        (lambda a: v3dg.crop_sphere(a, (0, 0, 0), 0), "radius: expected a positive number"),
        (lambda a: v3dg.drop_transparent(a, 1.5), "min_opacity: expected a number from 0 to 1"),
        (lambda a: v3dg.to_degree(a, 4), "degree: expected at most 3, got 4"),
        (lambda _: v3dg.join([]), "parts: expected at least one"),
    ],
)
def test_wrong_arguments_are_named(edit, message):
    with pytest.raises(ValueError, match=message):
        edit(asset(2))


def test_other_things_than_gaussians_are_named():
    with pytest.raises(TypeError, match="gaussians: expected Gaussians, got str"):
        v3dg.drop_outliers("a.ply")
    with pytest.raises(TypeError, match=r"parts\[1\]: expected Gaussians, got int"):
        v3dg.join([asset(2), 1])


def test_angles_turn_about_fixed_axes_in_order():
    rotation = rotation_from_quaternion(np.array(quaternion_from_angles((90, 0, 90))))
    # The first rotation maps y to z, and the second one does not change z.
    np.testing.assert_allclose(rotation @ (0, 1, 0), (0, 0, 1), atol=1e-12)
    np.testing.assert_allclose(rotation @ (1, 0, 0), (0, 1, 0), atol=1e-12)
    rotation = rotation_from_quaternion(np.array(quaternion_from_angles((0, 90, 0))))
    np.testing.assert_allclose(rotation @ (0, 0, 1), (1, 0, 0), atol=1e-12)
