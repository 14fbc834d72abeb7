"""Tests codebooks: the tables and palettes of SOG, and the order in which gaussians are
written."""

import numpy as np
import pytest

from reference import codebook as reference
from v3dg import _core


@pytest.mark.parametrize("count", [0, 1, 200, 256, 257, 5000])
def test_a_codebook_is_that_of_lloyds_algorithm(count):
    rng = np.random.default_rng(count)
    values = rng.normal(size=count) * rng.gamma(0.3, 1, count)
    table = _core.codebook_of(values)
    np.testing.assert_allclose(table, reference.codebook_of(values), rtol=1e-9, atol=1e-12)
    assert (np.diff(table) >= 0).all()
    if count <= 256:
        assert np.isin(values, table).all()


def test_values_that_are_all_alike_are_kept():
    np.testing.assert_array_equal(_core.codebook_of(np.full(1000, -3.5)), np.full(256, -3.5))


@pytest.mark.parametrize("size", [1, 2, 30, 500])
@pytest.mark.parametrize("count", [0, 1, 400])
def test_a_palette_halves_what_errs_most(count, size):
    rng = np.random.default_rng(count)
    vectors = (rng.normal(size=(count, 9)) * rng.gamma(0.3, 1, (count, 1))).astype(np.float32)
    palette, labels = _core.palette_of(vectors, size)
    wanted, wanted_labels = reference.palette_of(vectors, size)
    np.testing.assert_array_equal(labels, wanted_labels)
    np.testing.assert_allclose(palette, wanted, rtol=1e-12, atol=1e-12)


def test_a_palette_that_has_room_is_exact():
    vectors = np.random.default_rng(0).normal(size=(30, 24)).astype(np.float32).repeat(20, axis=0)
    palette, labels = _core.palette_of(vectors, 1024)
    assert len(palette) == 30
    np.testing.assert_allclose(palette[labels], vectors, rtol=1e-15)


@pytest.mark.parametrize("count", [0, 1, 3000])
def test_points_are_put_along_a_morton_curve(count):
    means = np.random.default_rng(count).normal(size=(count, 3)).astype(np.float32)
    # the first of equal means comes first
    means[count // 2 :] = means[: count - count // 2]
    np.testing.assert_array_equal(_core.morton_order(means), reference.morton_order(means))


def test_points_that_are_not_finite_have_no_order():
    with pytest.raises(ValueError, match="means: expected finite values, got nan in row 1"):
        _core.morton_order(np.array([[0, 0, 0], [0, np.nan, 0]], np.float32))
