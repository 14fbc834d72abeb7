"""Assets that are moved, rotated and scaled."""

import numpy as np
import pytest

from random_bundle import random_gaussians
from v3dg.rotations import rotation_from_quaternion


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_transform_moves_turns_and_scales(kind):
    asset = random_gaussians(np.random.default_rng(0), 5)
    given = asset if kind == "numpy" else asset.torch("cpu")
    turn = np.array([2.0, 0, 0, 2.0])  # a quarter of a turn about z, with quaternions of any length
    moved = given.transform(turn, (1, 2, 3), 3.0)
    assert type(moved.means) is type(given.means)
    rotation = rotation_from_quaternion(turn / np.linalg.norm(turn))
    np.testing.assert_allclose(
        moved.numpy().means, 3 * asset.means @ rotation.T + (1, 2, 3), atol=1e-5
    )
    np.testing.assert_allclose(moved.numpy().scales, 3 * asset.scales, rtol=1e-6)
    np.testing.assert_array_equal(moved.numpy().opacities, asset.opacities)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0, 0, 0),), "quaternion: expected a nonzero quaternion, got zeros"),
        (((1, 0, 0, 0), (0, 0)), "position: expected shape"),
        (((1, 0, 0, 0), (0, 0, 0), 0), "scale: expected a positive number, got 0"),
    ],
)
def test_transform_names_what_is_wrong(arguments, message):
    with pytest.raises(ValueError, match=message):
        random_gaussians(np.random.default_rng(0), 5).transform(*arguments)
