import numpy as np
import pytest

from benchmarks.worlds.rings import Pile, _near_pairs
from v3dg.rotations import rotation_from_quaternion

RING, TUBE = 0.07, 0.04
FLAT = [1.0, 0.0, 0.0, 0.0]
UPRIGHT = [np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0]  # its axis is x


def pile_of(positions, quaternions=None, scales=None, **options):
    count = len(positions)
    quaternions = np.tile(FLAT, (count, 1)) if quaternions is None else quaternions
    scales = np.ones(count) if scales is None else scales
    return Pile(positions, quaternions, scales, ring=RING, tube=TUBE, **options)


def nearest_distance(pile, a, b, count=400):
    """Return the distance between the circles of two rings, by brute force."""
    angle = np.linspace(0, 2 * np.pi, count, endpoint=False)
    circle = np.stack([np.cos(angle), np.sin(angle), 0 * angle], -1)
    rotations = rotation_from_quaternion(pile.quaternions)
    on_a, on_b = (pile.positions[k] + pile.ring[k] * circle @ rotations[k].T for k in (a, b))
    return np.linalg.norm(on_a[:, None] - on_b, axis=-1).min()


def test_free_fall_follows_gravity():
    pile = pile_of([[0, 0, 100.0]], gravity=10.0)
    for _ in range(60):
        pile.step(1 / 60)
    fallen = 100 - pile.positions[0, 2]
    assert abs(fallen - 5.0) < 0.05


def test_a_ring_comes_to_rest_flat_on_the_ground():
    tilted = [np.cos(0.2), np.sin(0.2), 0, 0]
    pile = pile_of([[0, 0, 0.3]], [tilted])
    for _ in range(150):
        pile.step()
    up = rotation_from_quaternion(pile.quaternions)[0, :, 2]
    assert up[2] > 0.995
    assert abs(pile.positions[0, 2] - TUBE) < 0.1 * TUBE


def test_rings_pile_up_on_each_other():
    pile = pile_of([[0, 0, 0.1], [0.003, 0, 0.25], [0, 0.003, 0.4]])
    for _ in range(150):
        pile.step()
    assert np.allclose(np.sort(pile.positions[:, 2]), TUBE * np.array([1, 3, 5]), atol=0.25 * TUBE)
    assert pile.deepest_overlap() < 0.15


@pytest.mark.parametrize("seed", range(5))
def test_touching_rings_are_found_as_brute_force_finds_them(seed):
    rng = np.random.default_rng(seed)
    quaternions = rng.normal(size=(2, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    pile = pile_of([[0, 0, 1.0], [0, 0, 1.0] + 0.1 * rng.normal(size=3)], quaternions)
    expected = max(0.0, 2 * TUBE - nearest_distance(pile, 0, 1)) / TUBE
    assert abs(pile.deepest_overlap() - expected) < 0.02


def test_relaxing_pushes_overlapping_rings_apart():
    pile = pile_of([[0, 0, 0.1], [0.11, 0, 0.12]], [FLAT, UPRIGHT])
    before = pile.deepest_overlap()
    assert before > 0.3
    pile.relax(60)
    assert pile.deepest_overlap() < 0.1


def test_same_start_same_pile():
    first, again = (pile_of([[0, 0, 0.1], [0.03, 0, 0.3]]) for _ in range(2))
    for _ in range(40):
        first.step()
        again.step()
    assert np.array_equal(first.positions, again.positions)
    assert np.array_equal(first.quaternions, again.quaternions)


def test_near_pairs_are_all_pairs_within_reach():
    rng = np.random.default_rng(1)
    positions, reach = rng.uniform(-1, 1, (200, 3)), rng.uniform(0.05, 0.2, 200)
    distance = np.linalg.norm(positions[:, None] - positions, axis=-1)
    expected = np.argwhere(np.triu(distance < reach[:, None] + reach, 1))
    a, b = _near_pairs(positions, reach)
    assert sorted(zip(a, b, strict=True)) == [tuple(pair) for pair in expected]


def test_an_empty_pile_passes_time():
    pile = pile_of(np.zeros((0, 3)), np.zeros((0, 4)))
    pile.step()
    pile.relax()
    assert len(pile) == 0
    assert pile.deepest_overlap() == 0


def test_wrong_shapes_and_radii_are_refused():
    with pytest.raises(ValueError, match=r"expected shapes \(N, 3\), \(N, 4\), \(N,\)"):
        pile_of(np.zeros((2, 3)), np.zeros((1, 4)))
    with pytest.raises(
        ValueError, match="tube: expected a radius between 0 and the ring's 1, got 2"
    ):
        Pile([[0, 0, 0]], [FLAT], [1.0], ring=1.0, tube=2.0)
