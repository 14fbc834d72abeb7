import numpy as np
import pytest

from v3dg.procedural import make_asset, place_field


def rotations(quats):
    w, x, y, z = quats.T
    return np.stack(
        [
            *(1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
            *(2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
            *(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
        ],
        -1,
    ).reshape(-1, 3, 3)


@pytest.fixture(scope="module")
def asset():
    return make_asset(12_000, seed=3)


@pytest.mark.parametrize("count", [1000, 1001, 5000])
def test_asset_has_exactly_as_many_gaussians_as_asked(count):
    assert len(make_asset(count)) == count


def test_same_seed_same_asset(asset):
    again, other = make_asset(12_000, seed=3), make_asset(12_000, seed=4)
    for name in ("means", "quats", "scales", "opacities", "sh"):
        assert np.array_equal(getattr(asset, name), getattr(again, name))
    assert not np.array_equal(asset.means, other.means)


def test_asset_is_well_formed(asset):
    assert asset.sh_degree == 1
    for name in ("means", "quats", "scales", "opacities", "sh"):
        array = getattr(asset, name)
        assert array.dtype == np.float32
        assert np.isfinite(array).all()
    assert np.allclose(np.linalg.norm(asset.quats, axis=1), 1, atol=1e-6)
    assert asset.scales.min() > 0
    assert asset.opacities.min() > 0
    assert asset.opacities.max() < 1


def test_asset_stands_on_the_ground_and_fits_its_tuft(asset):
    assert asset.means[:, 2].min() > -0.3
    assert 0.9 < asset.means[:, 2].max() < 1.6
    assert np.percentile(np.hypot(asset.means[:, 0], asset.means[:, 1]), 95) < 1.1


def test_asset_is_spread_like_a_trained_one(asset):
    thin, middle, long = np.sort(asset.scales, axis=1).T
    assert np.median(long / thin) > 5, "surfaces are covered with flat gaussians"
    assert np.percentile(long / middle, 95) > 5, "some are needles"
    assert np.percentile(long, 99) / np.percentile(long, 1) > 8
    assert (asset.opacities < 0.3).mean() > 0.05
    assert (asset.opacities > 0.9).mean() > 0.25
    assert np.abs(asset.sh[:, 1:]).max() > 0.3, "some shine"


def test_field_starts_upright_at_the_origin():
    positions, quats, scales = place_field(50)
    assert np.array_equal(positions[0], [0, 0, 0])
    assert np.allclose(quats[0], [1, 0, 0, 0])
    assert scales[0] == 1


def test_field_instances_stand_up_and_keep_apart():
    positions, quats, scales = place_field(400, seed=1)
    assert positions.shape == (400, 3)
    assert quats.shape == (400, 4)
    assert np.allclose(np.linalg.norm(quats, axis=1), 1)
    assert (rotations(quats)[:, 2, 2] > 0.8).all(), "upright but for the slope"
    assert scales.min() > 0.5
    apart = np.linalg.norm(positions[:, None, :2] - positions[None, :, :2], axis=-1)
    np.fill_diagonal(apart, np.inf)
    assert apart.min() > 1.1, "toadstools reach 0.6 from the middle of their tuft"


def test_same_seed_same_field():
    for a, b in zip(place_field(30, seed=5), place_field(30, seed=5), strict=True):
        assert np.array_equal(a, b)


def test_field_of_one():
    positions, quats, scales = place_field(1)
    assert (positions.shape, quats.shape, scales.shape) == ((1, 3), (1, 4), (1,))


def test_too_few_are_refused():
    with pytest.raises(ValueError, match="num_gaussians: expected at least 1000, got 10"):
        make_asset(10)
    with pytest.raises(ValueError, match="count: expected at least 1, got 0"):
        place_field(0)
