"""Tests codes of gaussians: error bounds that follow from the steps, a second
implementation of the formula, and extreme clusters."""

import numpy as np
import pytest

import scenes
from reference import quantize as reference
from v3dg import Gaussians, _core

DEGREES = (0, 1, 2, 3)


def random_clusters(seed, sh_degree, num_clusters=6, most=60):
    """Return gaussians as in assets, in clusters of unit size at random places, and the
    offsets of the clusters."""
    rng = np.random.default_rng(seed)
    sizes = rng.integers(1, most, num_clusters)
    n = int(sizes.sum())
    centre = np.repeat(rng.normal(0, 30, (num_clusters, 3)), sizes, axis=0)
    gaussians = Gaussians(
        *(
            np.ascontiguousarray(array, np.float32)
            for array in (
                centre + rng.uniform(-0.5, 0.5, (n, 3)),
                rng.normal(size=(n, 4)) * rng.uniform(0.1, 10, (n, 1)),
                np.exp2(rng.normal(-6, 2, (n, 3))),
                rng.uniform(0, 1, n),
                rng.normal(0, 0.5, (n, (sh_degree + 1) ** 2, 3)),
            )
        )
    )
    return gaussians, np.concatenate([[0], np.cumsum(sizes)])


def like(gaussians):
    return Gaussians(*(np.full_like(array, np.nan) for array in vars(gaussians).values()))


def decoded(page, offset, gaussians):
    out = like(gaussians)
    _core.decode_page(page, offset, out.rows)
    return out


def rounded(gaussians, offset):
    return decoded(_core.encode_page(gaussians.rows, offset), offset, gaussians)


def ranges_of(values, offset):
    """Return the smallest and the largest value (N, ...) in the cluster of each
    gaussian."""
    sizes = np.diff(offset)
    least, most = (
        np.repeat(f.reduceat(values, offset[:-1], axis=0), sizes, 0)
        for f in (np.minimum, np.maximum)
    )
    return least.astype(np.float64), most.astype(np.float64)


def covariances(gaussians):
    q = gaussians.quats.astype(np.float64)
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    axes = np.moveaxis(np.array(rows), -1, 0) * gaussians.scales[:, None, :].astype(np.float64)
    return axes @ axes.transpose(0, 2, 1)


@pytest.mark.parametrize("sh_degree", DEGREES)
@pytest.mark.parametrize("seed", range(3))
def test_errors_are_those_of_the_steps(seed, sh_degree):
    gaussians, offset = random_clusters(seed, sh_degree)
    out = rounded(gaussians, offset)
    # The bound is half a step. At the upper end it is up to two steps, because the step
    # is rounded to 12 bits. Finally, float32 rounds.
    least, most = ranges_of(gaussians.means, offset)
    step = (most - least) / 4095
    error = np.abs(out.means - gaussians.means.astype(np.float64))
    at_end = gaussians.means > most - 2.5 * step
    assert (
        error <= np.where(at_end, 2.5, 0.501) * step + np.spacing(np.abs(most).astype(np.float32))
    ).all()
    assert np.abs(out.opacities - gaussians.opacities).max() <= 0.5 / 255 + 1e-7
    # The bound is half a step, or the part that is lost when the ends of the range are
    # rounded inwards to float16.
    least, most = ranges_of(gaussians.sh[:, 0], offset)
    ends = np.maximum(np.abs(least), np.abs(most)) * 2.0**-10
    error = np.abs(out.sh[:, 0] - gaussians.sh[:, 0].astype(np.float64))
    assert (error <= 0.5 * (most - least) / 511 + ends).all()


@pytest.mark.parametrize("seed", range(3))
def test_shapes_keep_to_their_steps(seed):
    """Covariances are compared, because the axes may have another order."""
    gaussians, offset = random_clusters(seed, 0)
    out = rounded(gaussians, offset)
    # Half a step in the bits of floats is at most this relative error of a scale. The
    # ends of the range are coarser by 2^-8.
    bits = gaussians.scales.view(np.int32)
    least, most = ranges_of(np.stack([bits.min(1), bits.max(1)], axis=1), offset)
    relative = 0.5 * (most[:, 1] - least[:, 0]) / 1023 * 2.0**-23 + 2.0**-8
    error = np.abs(np.sort(out.scales, axis=1) / np.sort(gaussians.scales, axis=1) - 1).max(axis=1)
    assert (error <= relative).all()
    # Three components have an error of half a step of 1/666, and w is at least 0.75.
    # Therefore the angle is at most 2 sqrt(3) / 1332 / 0.75.
    angle = 2 * np.sqrt(3) * 0.5 / 666 / 0.74
    expected, got = covariances(gaussians), covariances(out)
    largest = gaussians.scales.max(axis=1).astype(np.float64) ** 2
    difference = np.linalg.norm(got - expected, axis=(1, 2))
    assert (difference <= largest * (2 * angle + np.sqrt(3) * (2 * relative + relative**2))).all()
    np.testing.assert_allclose(np.linalg.norm(out.quats, axis=1), 1, rtol=1e-6)


@pytest.mark.parametrize("sh_degree", DEGREES[1:])
def test_small_coefficients_have_small_steps(sh_degree):
    gaussians, offset = random_clusters(5, sh_degree)
    out = rounded(gaussians, offset)
    values, got = (reference.channels_of(g.sh[:, 1:].astype(np.float64)) for g in (gaussians, out))
    first = 0
    for band in range(1, sh_degree + 1):
        here = slice(first, first := first + 2 * band + 1)
        for channel in range(3):
            value, error = values[:, here, channel], np.abs(got - values)[:, here, channel]
            largest = ranges_of(np.abs(value).max(axis=1), offset)[1][:, None]
            most = 2 ** (reference.sh_bits(sh_degree, band)[channel] - 1) - 1
            unit = largest / most**2
            # A step lies between the squares n² and (n+1)², in a unit that float16
            # stores with a relative error of 2^-11.
            assert (
                error <= unit * (np.sqrt(np.abs(value) / unit) + 0.5) + largest * 2.0**-10
            ).all()


@pytest.mark.parametrize("sh_degree", DEGREES)
def test_the_formula_is_that_of_the_reference(sh_degree):
    """The bits agree even if products are not rounded before they are added, because no
    code depends on it."""
    gaussians, offset = random_clusters(9, sh_degree)
    page = _core.encode_page(gaussians.rows, offset)
    out = decoded(page, offset, gaussians)
    for fused in (False, True):
        expected = reference.decode(page.view(np.uint8), offset, sh_degree, fused=fused)
        for name, array in zip(scenes.NAMES, expected, strict=True):
            assert getattr(out, name).tobytes() == array.tobytes(), (name, fused)


def extreme_clusters(rng, n, sh_degree):
    """Return clusters of any floats that a bundle can contain: equal, tiny, huge, far
    from the origin, and of all sizes together."""

    def values(*shape):
        exponent = rng.integers(-38, 39)
        kinds = (
            lambda: np.zeros(shape),
            lambda: np.full(shape, rng.normal() * 10.0 ** rng.integers(-12, 13)),
            lambda: (
                rng.normal() * 10.0 ** rng.integers(-3, 6)
                + rng.normal(size=shape) * 10.0 ** rng.integers(-8, 2)
            ),
            lambda: rng.normal(size=shape) * 10.0 ** rng.uniform(-12, 12, size=shape),
            lambda: rng.normal(size=shape) * 10.0**exponent,
            lambda: rng.choice([-1, 0, 1e-45, 1e-12, 1, 1e12, 3e38], size=shape),
        )
        return np.clip(kinds[rng.integers(len(kinds))](), -3.4e38, 3.4e38).astype(np.float32)

    opacities = np.abs(np.clip(values(n), -1, 1))
    return Gaussians(
        values(n, 3),
        values(n, 4),
        np.abs(values(n, 3)),
        opacities,
        values(n, (sh_degree + 1) ** 2, 3),
    )


@pytest.mark.parametrize("seed", range(8))
def test_extreme_clusters_become_finite_gaussians_that_stay_as_they_are(seed):
    """Encoding decoded gaussians gives the same page again, so an interrupted build
    continues with the same values."""
    rng = np.random.default_rng(seed)
    for _ in range(150):
        n, sh_degree = int(rng.integers(1, 40)), int(rng.integers(0, 4))
        gaussians, offset = extreme_clusters(rng, n, sh_degree), np.array([0, n])
        page = _core.encode_page(gaussians.rows, offset)
        out = decoded(page, offset, gaussians)
        assert all(np.isfinite(array).all() for array in vars(out).values())
        assert (out.scales > 0).all()
        assert ((out.opacities >= 0) & (out.opacities <= 1)).all()
        np.testing.assert_array_equal(_core.encode_page(out.rows, offset), page)


def test_a_cluster_in_one_point_stays_there():
    gaussians, _ = random_clusters(1, 3)
    n = len(gaussians)
    gaussians.means[:] = np.float32([1e6 + 0.25, -3e-7, 0])
    gaussians.sh[:, 0] = 1.25
    out = rounded(gaussians, np.array([0, n]))
    np.testing.assert_array_equal(out.means, gaussians.means)
    np.testing.assert_array_equal(out.sh[:, 0], gaussians.sh[:, 0])


def test_one_gaussian_keeps_its_place_and_the_ends_of_opacity():
    gaussians, _ = random_clusters(2, 0)
    for i, opacity in enumerate((0, 1 / 255, 1)):
        one = gaussians.subset([i])
        one.opacities[:] = opacity
        out = rounded(one, np.array([0, 1]))
        np.testing.assert_array_equal(out.means, one.means)
        np.testing.assert_array_equal(out.opacities, one.opacities)
        np.testing.assert_allclose(np.sort(out.scales), np.sort(one.scales), rtol=2.0**-8)


def test_scales_of_all_sizes_keep_their_order_of_magnitude():
    gaussians, _ = random_clusters(3, 0)
    n = len(gaussians)
    gaussians.scales[:] = np.float32(10.0) ** np.linspace(-12, 12, 3 * n, dtype=np.float32).reshape(
        n, 3
    )
    gaussians.quats[:] = [1, 0, 0, 0]
    out = rounded(gaussians, np.array([0, n]))
    # The range spans 80 octaves.
    np.testing.assert_allclose(out.scales, gaussians.scales, rtol=0.5 * 80 / 1023 + 2.0**-8)


def test_flat_gaussians_stay_flat():
    gaussians, offset = random_clusters(4, 0)
    gaussians.scales[:, 1] = 0
    out = rounded(gaussians, offset)
    assert (out.scales.min(axis=1) < out.scales.max(axis=1) / 8000).all()
    assert (
        np.abs(np.log2(out.scales).min(axis=1) - np.log2(out.scales).max(axis=1) + 14).max() < 0.1
    )


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("name", scenes.NAMES)
def test_what_is_not_finite_is_refused(name, value):
    gaussians, offset = random_clusters(6, 1)
    getattr(gaussians, name).reshape(len(gaussians), -1)[7, -1] = value
    with pytest.raises(
        ValueError, match="gaussians: expected finite values, got infinite or NaN ones in row 7"
    ):
        _core.encode_page(gaussians.rows, offset)


def test_pages_are_parts_of_rows():
    gaussians, offset = random_clusters(8, 2)
    page = _core.encode_page(gaussians.rows, offset[2:5])
    rows = slice(offset[2], offset[4])
    alone = gaussians.subset(rows)
    np.testing.assert_array_equal(page, _core.encode_page(alone.rows, offset[2:5] - offset[2]))
    out = decoded(page, offset[2:5], gaussians)
    np.testing.assert_array_equal(out.means[rows], rounded(alone, offset[2:5] - offset[2]).means)
    assert np.isnan(np.delete(out.means, np.arange(rows.start, rows.stop), axis=0)).all()


def test_no_gaussians_are_a_page_too():
    gaussians = random_clusters(1, 3)[0].subset(slice(0, 0))
    for clusters in (0, 1, 3):
        offset = np.zeros(clusters + 1, np.int64)
        page = _core.encode_page(gaussians.rows, offset)
        assert not page.any()
        assert page.nbytes == -(-60 * clusters // 16) * 16
        decoded(page, offset, gaussians)


def test_wrong_arguments_are_refused():
    gaussians, offset = random_clusters(1, 0)
    page = _core.encode_page(gaussians.rows, offset)
    with pytest.raises(ValueError, match="page: expected"):
        _core.decode_page(page[:-1], offset, gaussians.rows)
    for wrong in (offset[::-1].copy(), offset + 1, np.zeros(0, np.int64), offset - 1):
        with pytest.raises(ValueError, match="offset: expected ascending boundaries"):
            _core.encode_page(gaussians.rows, wrong)
    with pytest.raises(ValueError, match="sh_degree: expected 0 to 3"):
        _core.page_code_bytes(4)
    page[-12] = 0x7FC00000  # the least mean in the ranges of the last cluster
    page.view(np.float32)[4 * len(gaussians)] = np.nan
    with pytest.raises(ValueError, match="cluster 0 of the page: expected finite ranges"):
        _core.decode_page(page, offset, gaussians.rows)
