import numpy as np
import pytest

from v3dg.donut import make_donut, place_field
from v3dg.rotations import rotation_from_quaternion

ARRAYS = ("means", "quats", "scales", "opacities", "sh")


@pytest.mark.parametrize("count", [1000, 5003])
def test_as_many_gaussians_as_asked_for_that_can_be_drawn(count):
    donut = make_donut(count)
    assert len(donut) == count
    assert donut.sh_degree == 1
    assert all(np.isfinite(getattr(donut, name)).all() for name in ARRAYS)
    assert ((donut.opacities > 0) & (donut.opacities < 1)).all()
    np.testing.assert_allclose(np.linalg.norm(donut.quats, axis=1), 1, atol=1e-5)


def test_one_seed_gives_the_same_gaussians_and_another_gives_others():
    one, again, other = make_donut(1000), make_donut(1000), make_donut(1000, seed=1)
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(one, name), getattr(again, name))
    assert not np.array_equal(one.means, other.means)


def test_gaussians_lie_flat_on_a_ring():
    donut = make_donut(20_000)
    x, y, z = donut.means.T.astype(float)
    from_tube = np.hypot(np.hypot(x, y) - 0.63, z)
    assert from_tube.min() > 0.3
    assert from_tube.max() < 0.4
    outwards = np.stack([x, y, z], 1) - 0.63 * np.stack([x, y, 0 * z], 1) / np.hypot(x, y)[:, None]
    thinnest = rotation_from_quaternion(donut.quats.astype(float))[:, :, 2]
    along = (outwards / from_tube[:, None] * thinnest).sum(axis=1)
    assert np.median(along) > 0.99
    assert (np.diff(donut.scales, axis=1) <= 0).all()


def test_donuts_of_a_field_keep_their_distance_and_stand_on_a_hill():
    positions, quaternions, scales = place_field(300)
    apart = np.linalg.norm(positions[:, None] - positions, axis=-1) + 9 * np.eye(300)
    assert apart.min() > 1
    assert (positions[0, :2] == 0).all()
    assert positions[0, 2] == positions[:, 2].max()
    np.testing.assert_allclose(np.linalg.norm(quaternions, axis=1), 1)
    assert (rotation_from_quaternion(quaternions)[:, 2, 2] > 0.5).all(), "icing is above"
    assert ((scales >= 0.75) & (scales <= 1)).all()


def test_too_few_are_refused():
    with pytest.raises(ValueError, match="at least 1000"):
        make_donut(999)
    with pytest.raises(ValueError, match="at least 1"):
        place_field(0)
