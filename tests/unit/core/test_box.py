import itertools

import numpy as np
import pytest

import devices
import scenes
import scenes_lod
from reference import box as reference
from v3dg import _core


def bound_by_boxes(device, g, offset):
    return devices.host(_core.bound_by_boxes(devices.on(device, g).rows, offset))


@pytest.mark.parametrize("size", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("origin", [0.0, 1e5])
def test_boxes_hold_the_reach_and_little_more(device, size, origin):
    rng = np.random.default_rng(0)
    g = scenes_lod.blob(rng, 700, origin=origin, size=size)
    offset = np.array([0, 1, 3, 40, 350, 700])
    boxes = bound_by_boxes(device, g, offset)
    for box, (first, last) in zip(boxes, itertools.pairwise(offset), strict=True):
        part = g.subset(slice(first, last))
        low, high = reference.bound_by_boxes(part.means, part.quats, part.scales)
        assert (box[0] <= low).all()
        assert (box[1] >= high).all()
        slack = 1e-4 * (high - low) + 2e-6 * np.abs(part.means).max()
        assert (box[0] >= low - slack).all()
        assert (box[1] <= high + slack).all()


@pytest.mark.gpu
def test_both_devices_give_the_same_bits():
    g = scenes_lod.blob(np.random.default_rng(1), 20_000)
    g = scenes.replaced(g, scales=g.scales**3, quats=g.quats * np.float32(1e-3))
    offset = np.unique(np.append(np.random.default_rng(2).integers(0, len(g), 300), [0, len(g)]))
    np.testing.assert_array_equal(
        bound_by_boxes("cpu", g, offset), bound_by_boxes("cuda", g, offset)
    )


def test_nothing_has_no_box(device):
    g = scenes.gaussians([[1, 2, 3]], scales=0.0)
    box = bound_by_boxes(device, g, np.array([0, 0, 1]))
    np.testing.assert_array_equal(box[0], [[np.inf] * 3, [-np.inf] * 3])
    np.testing.assert_allclose(box[1], [[1, 2, 3]] * 2, rtol=2e-6)
    assert bound_by_boxes(device, g.subset(slice(0)), np.array([0])).shape == (0, 2, 3)


def test_zero_quaternion_turns_nothing(device):
    g = scenes.gaussians([[0, 0, 0]], quats=0, scales=(1, 2, 3))
    np.testing.assert_allclose(
        bound_by_boxes(device, g, np.array([0, 1]))[0, 1], [3.33, 6.66, 9.99], rtol=2e-4
    )


@pytest.mark.parametrize("offset", [[0], [0, 2], [1, 3], [0, 2, 1, 3]])
def test_wrong_offsets_are_named(device, offset):
    g = scenes.gaussians(np.zeros((3, 3)))
    with pytest.raises(
        ValueError, match="offset: expected ascending boundaries from 0 to 3, got other numbers"
    ):
        bound_by_boxes(device, g, np.array(offset))
