"""Tests composed scenes: adding, removing and moving instances, budgets, drawing
earlier cuts, and false colours."""

import numpy as np
import pytest

import v3dg
from devices import host
from frames import Renderer, arrays, render
from random_bundle import random_bundle
from reference import select as reference
from scenes_lod import blob, lod_bundle, random_camera, random_scene
from v3dg import Scene, select

# Neighbouring tolerances from which a budget chooses differ by this number in the bits
# of float32.
STEP_BITS = 1 << 12


def pairs(selection):
    return list(zip(selection.instance_ids.tolist(), selection.cluster_ids.tolist(), strict=True))


def same_picture(a, b):
    for one, other in zip(arrays(a), arrays(b), strict=True):
        np.testing.assert_array_equal(one, other)


def step_from(tolerance, steps):
    """Return a tolerance that is coarser by this number of steps."""
    return float(
        (np.float32(tolerance).view(np.int32) + np.int32(steps * STEP_BITS)).view(np.float32)
    )


def composed(rng, count=40, **change):
    """Return instances of a bundle with the layout of a build and of random trees, some
    of them important."""
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 8), count, spread=8, **change)
    scene.add(random_bundle(int(rng.integers(1 << 30)), num_levels=4), rng.normal(size=(3, 3)))
    scene.set_importance(np.exp(rng.normal(size=len(scene))))
    return scene


@pytest.mark.parametrize("seed", range(12))
def test_budget_is_met_by_the_finest_cut(device, seed):
    rng = np.random.default_rng(seed)
    scene, camera = composed(rng), random_camera(rng, distance=6)
    full = select(scene, camera, tolerance=0.0, device="cpu").num_gaussians
    least = select(scene, camera, tolerance=np.inf, device="cpu").num_gaussians
    for budget in (least, least + 1, *rng.integers(least, full + 1, 4), full, full + 1):
        cut = select(scene, camera, budget=int(budget), device=device)
        assert cut.num_gaussians <= budget
        again = select(scene, camera, tolerance=cut.tolerance, device=device)
        assert pairs(cut) == pairs(again)
        if cut.tolerance == 0:
            assert cut.num_gaussians == full
        elif np.isfinite(cut.tolerance) and cut.tolerance > 2**-10:
            finer = select(scene, camera, tolerance=step_from(cut.tolerance, -1), device=device)
            assert finer.num_gaussians > budget
            for steps in (1, 2, 3, 10, 100, 1000):
                coarser = select(
                    scene, camera, tolerance=step_from(cut.tolerance, steps), device=device
                )
                assert coarser.num_gaussians <= budget


def test_tolerance_and_budget_both_hold(device):
    rng = np.random.default_rng(3)
    scene, camera = composed(rng), random_camera(rng, distance=6)
    at_one = select(scene, camera, tolerance=1.0, device=device)
    for budget in (at_one.num_gaussians, at_one.num_gaussians + 1, 10**9):
        cut = select(scene, camera, tolerance=1.0, budget=budget, device=device)
        assert cut.tolerance == 1.0
        assert pairs(cut) == pairs(at_one)
    fewer = select(scene, camera, tolerance=1.0, budget=at_one.num_gaussians - 1, device=device)
    assert fewer.num_gaussians < at_one.num_gaussians
    assert fewer.tolerance > 1.0
    assert select(scene, camera, tolerance=np.inf, budget=10**9, device=device).tolerance == np.inf


def test_budget_below_the_coarsest_cut_is_refused(device):
    rng = np.random.default_rng(4)
    scene, camera = composed(rng), random_camera(rng, distance=6)
    least = select(scene, camera, tolerance=np.inf, device="cpu").num_gaussians
    message = rf"budget: expected at least {least}, the number of gaussians .*, got {least - 1}"
    with pytest.raises(ValueError, match=message):
        select(scene, camera, budget=least - 1, device=device)
    image = render(scene, camera, budget=least, device=device)
    assert image.stats.gaussians_selected == least
    with pytest.raises(ValueError, match=message):
        render(scene, camera, budget=least - 1, device=device).stats  # noqa: B018  waits for the picture
    with pytest.raises(
        ValueError, match="budget: expected a whole number of gaussians of at least 0, got -1"
    ):
        select(scene, camera, budget=-1, device="cpu")


def test_budget_with_the_papers_footprint(device):
    rng = np.random.default_rng(5)
    scene, camera = composed(rng), random_camera(rng, distance=6)
    full = select(scene, camera, tolerance=0.0, footprint="paper", device="cpu").num_gaussians
    cut = select(scene, camera, budget=full // 2, footprint="paper", device=device)
    assert 0 < cut.num_gaussians <= full // 2
    assert pairs(cut) == pairs(
        select(scene, camera, tolerance=cut.tolerance, footprint="paper", device="cpu")
    )


def test_importance_divides_the_tolerance(device):
    rng = np.random.default_rng(6)
    scene, camera = composed(rng), random_camera(rng, distance=6)
    scene.set_importance(1.0)
    finer = select(scene, camera, tolerance=0.25, device=device)
    scene.set_importance(4.0)
    assert pairs(select(scene, camera, tolerance=1.0, device=device)) == pairs(finer)
    scene.set_importance(1.0)
    scene.set_importance(4.0, ids=[1, 2])
    mixed = select(scene, camera, tolerance=1.0, device=device)
    plain = select(Scene.of(scene), camera, tolerance=1.0, device=device)
    assert pairs(mixed) == pairs(plain)
    scene.set_importance(1.0)
    coarse = select(scene, camera, tolerance=1.0, device=device)
    expected = [p for p in pairs(finer) if p[0] in (1, 2)] + [
        p for p in pairs(coarse) if p[0] not in (1, 2)
    ]
    assert pairs(mixed) == sorted(expected)


@pytest.mark.parametrize("min_level", [1, 2, 3, 100])
def test_nothing_finer_than_the_least_level(device, min_level):
    rng = np.random.default_rng(7)
    scene, camera = composed(rng), random_camera(rng, distance=3)
    cut = select(scene, camera, tolerance=0.0, min_level=min_level, cull=False, device=device)
    for i in range(len(scene)):
        clusters = scene.bundles[scene.instance_bundle[i]].clusters
        groups = scene.bundles[scene.instance_bundle[i]].groups
        mine = set(cut.cluster_ids[cut.instance_ids == i].tolist())
        for c in mine:
            assert clusters.level[c] == min_level or (
                clusters.level[c] < min_level and clusters.parent_group[c] < 0
            )
        for path in reference.paths(clusters, groups):
            assert len(mine.intersection(path)) == 1
    assert pairs(select(scene, camera, tolerance=0.0, min_level=min_level, device=device))
    with pytest.raises(
        ValueError, match="min_level: expected the index of a level, at least 0, got -1"
    ):
        select(scene, camera, min_level=-1, device="cpu")


def rebuilt(scene):
    """Return a new scene with the same instances, added run by run."""
    fresh = Scene()
    for i in range(len(scene)):
        fresh.add(
            scene.bundles[scene.instance_bundle[i]],
            scene.positions[i],
            scene.quaternions[i],
            scene.scales[i],
            scene.importance[i],
        )
    return fresh


def test_scene_that_changes_is_the_scene_built_anew(device):
    rng = np.random.default_rng(8)
    scene, camera = composed(rng, 20), random_camera(rng, distance=10)
    for step in range(6):
        if step == 1:
            scene.move(positions=5 * rng.normal(size=(len(scene), 3)))
        if step == 2:
            scene.move([3, 5], quaternions=rng.normal(size=(2, 4)), scales=0.5)
        if step == 3:
            scene.remove([0, 7, len(scene) - 1])
        if step == 4:
            scene.add(
                lod_bundle(rng, blob(rng, 50), 8),
                rng.normal(size=(4, 3)),
                scales=2.0,
                importance=3.0,
            )
        if step == 5:
            scene.remove(range(len(scene)))
        fresh = rebuilt(scene)
        a, b = (select(s, camera, tolerance=0.2, device=device) for s in (scene, fresh))
        assert len(scene) == len(fresh)
        assert pairs(a) == pairs(b) == pairs(select(scene, camera, tolerance=0.2, device="cpu"))
        same_picture(*(render(s, camera, tolerance=0.2, device=device) for s in (scene, fresh)))


def test_removed_instances_close_the_gap():
    scene = Scene()
    scene.add(random_bundle(0), np.arange(15.0).reshape(5, 3))
    scene.remove(np.array([1, 3]))
    np.testing.assert_array_equal(scene.positions[:, 0], [0, 6, 12])
    scene.remove([])
    assert len(scene) == 3
    with pytest.raises(IndexError, match="ids: expected 0 to 2, got 3"):
        scene.remove(3)
    with pytest.raises(IndexError, match="ids: expected 0 to 2, got -1"):
        scene.move([-1], scales=[1.0])
    with pytest.raises(ValueError, match="ids: expected integers"):
        scene.remove([0.5])


def test_what_cannot_be_a_pose_is_refused_and_changes_nothing():
    scene = Scene()
    scene.add(random_bundle(0), np.zeros((2, 3)))
    before = [rows.copy() for rows in (scene.positions, scene.quaternions, scene.scales)]
    for change, message in [
        ({"positions": np.zeros((3, 3))}, r"positions: expected shape \(2, 3\), got \(3, 3\)"),
        (
            {"positions": np.zeros((2, 3)), "scales": [1.0, 0.0]},
            "scales: expected positive numbers, got 0",
        ),
        ({"quaternions": np.zeros((2, 4))}, "quaternions: expected a nonzero quaternion"),
        ({"positions": [[0, 0, np.nan]] * 2}, "positions: expected finite numbers, got nan"),
    ]:
        with pytest.raises(ValueError, match=message):
            scene.move(**change)
    for rows, same in zip(before, (scene.positions, scene.quaternions, scene.scales), strict=True):
        np.testing.assert_array_equal(rows, same)
    with pytest.raises(ValueError, match="read-only"):
        scene.positions[0] = 1
    with pytest.raises(ValueError, match="importance: expected positive numbers"):
        scene.set_importance([1.0, -1.0])


def test_poses_may_be_tensors(device):
    torch = pytest.importorskip("torch")
    rng = np.random.default_rng(9)
    expected, camera = composed(rng, 12), random_camera(rng, distance=10)
    scene = Scene()
    for i, b in enumerate(expected.instance_bundle):
        scene.add(
            expected.bundles[b], torch.zeros(1, 3, device=device), importance=expected.importance[i]
        )

    def tensor(rows):
        return torch.from_numpy(np.array(rows)).to(device)

    scene.move(
        positions=tensor(expected.positions),
        quaternions=tensor(expected.quaternions),
        scales=tensor(expected.scales),
    )
    scene.move([1, 2], positions=expected.positions[[1, 2]])
    scene.move(torch.tensor([4]), scales=tensor(expected.scales[[4]]))
    np.testing.assert_allclose(scene.quaternions, expected.quaternions, rtol=0, atol=1e-15)
    np.testing.assert_array_equal(scene.positions, expected.positions)
    assert pairs(select(scene, camera, tolerance=0.2, device=device)) == pairs(
        select(expected, camera, tolerance=0.2, device=device)
    )
    scene.remove([0])
    assert len(scene.scales) == len(expected) - 1


@pytest.mark.gpu
def test_poses_of_a_device_that_are_none_are_not_drawn():
    import torch

    rng = np.random.default_rng(10)
    bundle = lod_bundle(rng, blob(rng, 100), 8)
    scene, camera = random_scene(rng, bundle, 4, spread=1), random_camera(rng, distance=10)
    everything = select(scene, camera, tolerance=0.2, device="cuda")
    positions = torch.from_numpy(np.array(scene.positions)).cuda()
    positions[1, 2] = torch.nan
    scales = torch.from_numpy(np.array(scene.scales)).cuda()
    scales[2] = 0
    scene.move(positions=positions, scales=scales)
    expected = [p for p in pairs(everything) if p[0] in (0, 3)]
    for device in ("cpu", "cuda"):
        assert pairs(select(scene, camera, tolerance=0.2, device=device)) == expected
        image = render(scene, camera, tolerance=0.2, device=device)
        assert np.isfinite(host(image.color)).all()
        kept = render(scene, camera, cut=everything, device=device)
        assert np.isfinite(host(kept.color)).all()


def test_several_cameras_are_each_as_if_alone(device):
    rng = np.random.default_rng(11)
    scene = composed(rng)
    cameras = [random_camera(rng, distance=6, width=w, height=40) for w in (64, 30, 64)]
    for cut, camera in zip(
        select(scene, cameras, budget=3000, device=device), cameras, strict=True
    ):
        assert pairs(cut) == pairs(select(scene, camera, budget=3000, device=device))
    for image, camera in zip(
        render(scene, cameras, budget=3000, device=device), cameras, strict=True
    ):
        alone = render(scene, camera, budget=3000, device=device)
        same_picture(image, alone)
        assert image.stats.gaussians_selected == alone.stats.gaussians_selected
        assert image.stats.tolerance == alone.stats.tolerance
    assert render(scene, [], device=device) == []


def test_cut_can_be_kept_while_the_camera_moves(device):
    rng = np.random.default_rng(12)
    scene = composed(rng)
    camera = random_camera(rng, distance=8)
    other = random_camera(rng, distance=8)
    cut = select(scene, camera, tolerance=0.5, device=device)
    same_picture(
        render(scene, camera, cut=cut, device=device),
        render(scene, camera, tolerance=0.5, device=device),
    )
    everything = select(scene, camera, tolerance=0.5, cull=False, device=device)
    kept = render(scene, other, cut=everything, device=device)
    assert kept.stats.gaussians_selected == everything.num_gaussians
    assert kept.stats.tolerance == 0.5
    # The asset is drawn from the same gaussians in world space.
    own = render(scene, other, tolerance=0.5, device=device)
    assert not np.array_equal(host(kept.color), host(own.color))
    nothing = select(
        scene,
        v3dg.Camera.look_at((1e6, 0, 0), (2e6, 0, 0), width=8, height=8),
        tolerance=1.0,
        device="cpu",
    )
    assert not host(render(scene, camera, cut=nothing, device=device).alpha).any()


def test_cut_of_another_scene_is_refused(device):
    rng = np.random.default_rng(13)
    scene, camera = composed(rng), random_camera(rng)
    cut = select(scene, camera, device="cpu")
    with pytest.raises(ValueError, match="cut: expected a selection from this scene"):
        render(composed(rng), camera, cut=cut, device=device)
    with pytest.raises(ValueError, match="budget: expected no value together with a cut"):
        render(scene, camera, cut=cut, budget=10**6, device=device)
    everything = select(scene, camera, cull=False, device="cpu")
    scene.remove(len(scene) - 1)
    with pytest.raises(ValueError, match="cut: instances were removed from the scene"):
        render(scene, camera, cut=everything, device=device)


@pytest.mark.gpu
def test_both_devices_choose_the_same():
    rng = np.random.default_rng(15)
    for trial in range(20):
        scene, camera = composed(rng, 100, log_scale=0.5), random_camera(rng, distance=20)
        options = {"min_level": int(rng.integers(3)), "cull": bool(trial % 2)}
        least = select(scene, camera, tolerance=np.inf, device="cpu", **options).num_gaussians
        for choice in ({"tolerance": float(10 ** rng.uniform(-3, 3))}, {"budget": 2 * least + 5}):
            cpu, cuda = (
                select(scene, camera, device=d, **choice, **options) for d in ("cpu", "cuda")
            )
            assert pairs(cpu) == pairs(cuda)
            assert (cpu.num_gaussians, cpu.tolerance) == (cuda.num_gaussians, cuda.tolerance)


@pytest.mark.gpu
def test_budgets_before_do_not_matter():
    # There are few clusters, many of them at the borders of the picture. Therefore a
    # coarser cut can have more gaussians.
    rng = np.random.default_rng(19)
    for _ in range(20):
        scene = random_scene(rng, lod_bundle(rng, blob(rng, 120), 8), 3, spread=1)
        camera = random_camera(rng, distance=1)
        least = select(scene, camera, tolerance=np.inf, device="cpu").num_gaussians
        full = select(scene, camera, tolerance=0.0, device="cpu").num_gaussians
        for budget in rng.integers(least, full + 2, 12):
            cpu, cuda = (
                select(scene, camera, budget=int(budget), device=d) for d in ("cpu", "cuda")
            )
            assert cpu.tolerance == cuda.tolerance
            assert pairs(cpu) == pairs(cuda)


@pytest.mark.gpu
def test_picture_under_way_shows_the_scene_as_it_was():
    rng = np.random.default_rng(16)
    scene, camera = composed(rng), random_camera(rng, distance=8)
    renderer = Renderer(scene)
    before = renderer.render(camera, tolerance=0.0)  # its buffers are too small at first
    expected = Renderer(rebuilt(scene)).render(camera, tolerance=0.0)
    scene.move(positions=scene.positions + 1)
    after = renderer.render(camera, tolerance=0.0)
    same_picture(before, expected)
    assert not np.array_equal(host(before.color), host(after.color))
