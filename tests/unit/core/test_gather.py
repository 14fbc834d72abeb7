"""The gaussians of a selection are transformed into the world."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import scenes
from devices import host, on
from random_bundle import random_bundle
from reference.sh import basis
from scenes_lod import blob, covariances, lod_bundle, random_camera, random_scene, rotation_matrices
from v3dg import Camera, Scene, _core, select


def pairs(selection):
    return zip(selection.instance_ids.tolist(), selection.cluster_ids.tolist(), strict=True)


def color_of(gaussians, n, direction):
    """Return the colour of gaussian n in a unit direction, by the definition of the
    real harmonics."""
    x, y, z = direction
    basis = [0.28209479177387814]
    basis += [0.4886025119029199 * v for v in (-y, z, -x)]
    basis += [
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * z * z - x * x - y * y),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (x * x - y * y),
    ]
    basis += [
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * z * z - x * x - y * y),
        0.3731763325901154 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -0.4570457994644658 * x * (4 * z * z - x * x - y * y),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    coefficients = gaussians.sh[n].astype(np.float64)
    return np.array(basis[: len(coefficients)]) @ coefficients


@given(
    seed=st.integers(0, 2**32 - 1), sh_degree=st.integers(0, 3), origin=st.sampled_from([0.0, 1e6])
)
def test_gaussians_are_those_of_the_instances_in_the_world(device, seed, sh_degree, origin):
    rng = np.random.default_rng(seed)
    bundle = lod_bundle(rng, blob(rng, 40, sh_degree=sh_degree), 8)
    scene = random_scene(rng, bundle, 3, origin=origin)
    camera = random_camera(rng, origin=origin)
    selection = select(
        scene, camera, tolerance=float(rng.choice([0.0, 1.0, 1e3])), cull=False, device="cpu"
    )
    world = host(selection.gaussians(origin=camera.position, device=device))
    assert len(world) == selection.num_gaussians
    first = 0
    for i, c in pairs(selection):
        asset = bundle.cluster_gaussians(c)
        rows = slice(first, first + len(asset))
        first += len(asset)
        rotation, scale = scene.rotations[i], scene.scales[i]
        means = (
            scale * asset.means.astype(np.float64) @ rotation.T
            + scene.positions[i]
            - camera.position
        )
        np.testing.assert_allclose(world.means[rows], means, rtol=1e-5, atol=1e-5)
        placed = world.subset(rows)
        expected = scale**2 * rotation @ covariances(asset) @ rotation.T
        atol = 1e-5 * np.abs(expected).max()
        np.testing.assert_allclose(covariances(placed), expected, rtol=1e-4, atol=atol)
        np.testing.assert_array_equal(placed.opacities, asset.opacities)
        direction = rng.normal(size=3)
        direction /= np.linalg.norm(direction)
        for n in range(len(asset)):
            towards = color_of(asset, n, rotation.T @ direction)
            np.testing.assert_allclose(
                color_of(placed, n, direction), towards, rtol=1e-4, atol=1e-5
            )
        filters = selection.filters_px2[rows]
        np.testing.assert_array_equal(filters, np.full(len(asset), bundle.clusters.filter_px2[c]))
        assert (selection.antialiased[rows] == bool(bundle.clusters.antialiased[c])).all()


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_harmonics_turn_as_the_bases_do(device, degree):
    """The precision is 1e-12 although results are float32, because all but one
    coefficient of a band nearly vanish. As coefficients of the asset, each row of the
    exact rotation becomes one basis function in the world, up to rounding.
    """
    rng = np.random.default_rng(degree)
    count, size, first = 50, 2 * degree + 1, degree * degree
    quaternions = rng.normal(size=(count, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    directions = rng.normal(size=(200, 3))
    bases = basis(directions, degree)[:, first:]
    sh = np.zeros((count * size, (degree + 1) ** 2, 3), np.float32)
    expected = np.zeros((count, size, size))
    for i, rotation in enumerate(rotation_matrices(quaternions)):
        in_asset = basis(directions @ rotation, degree)[:, first:]
        band = np.linalg.lstsq(bases, in_asset, rcond=None)[0]
        np.testing.assert_allclose(band @ band.T, np.eye(size), atol=1e-13)
        mine = slice(i * size, (i + 1) * size)
        sh[mine, first:] = band[:, :, None]
        expected[i] = sh[mine, first:, 0].astype(np.float64) @ band.T
    asset = scenes.gaussians(np.zeros((count * size, 3)), sh=sh)
    instances = _core.Instances(
        bundle=np.zeros(count, np.int32),
        positions=np.zeros((count, 3)),
        quaternions=quaternions,
        scales=np.ones(count),
        importance=np.ones(count, np.float32),
    )
    there = on(device, asset).rows
    *_, turned = host(
        _core.gather(
            bundles=[there],
            instances=instances,
            instance=np.arange(count, dtype=np.int32),
            first_row=size * np.arange(count),
            offset=size * np.arange(count + 1),
            device=there.device,
        )
    )
    found = turned[:, first:].reshape(count, size, size, 3).astype(np.float64)
    off_diagonal = ~np.eye(size, dtype=bool)
    for channel in range(3):
        error = np.abs(found[..., channel] - expected)
        assert error[:, off_diagonal].max() < 1e-12
        assert error[:, ~off_diagonal].max() < 1e-7  # the nearest other float32
    assert (turned[:, :first] == 0).all()


def mixed_selection():
    """Return a selection from bundles of different SH degrees, some of which are placed
    more than once."""
    rng = np.random.default_rng(8)
    low, high, unseen = (lod_bundle(rng, blob(rng, 60, sh_degree=d), 8) for d in (1, 3, 2))
    scene = Scene()
    for bundle in (low, high, low):
        scene.add(bundle, positions=rng.normal(size=(2, 3)))
    scene.add(unseen, positions=np.zeros((0, 3)))
    return select(scene, random_camera(rng, distance=30), tolerance=0.0, cull=False, device="cpu")


def test_bundles_of_different_degrees(device):
    selection = mixed_selection()
    scene = selection.scene
    world = host(selection.gaussians(device=device))
    assert world.sh_degree == 3
    first = 0
    for i, c in pairs(selection):
        asset = scene.bundles[scene.instance_bundle[i]].cluster_gaussians(c)
        num_sh = asset.sh.shape[1]
        rows = slice(first, first + len(asset))
        np.testing.assert_allclose(world.means[rows], asset.means + scene.positions[i], atol=1e-5)
        np.testing.assert_allclose(world.sh[rows, :num_sh], asset.sh, atol=1e-5)
        assert (world.sh[rows, num_sh:] == 0).all()
        first += len(asset)


@pytest.mark.gpu
def test_both_devices_give_the_same_bits():
    rng = np.random.default_rng(9)
    turned = random_scene(rng, lod_bundle(rng, blob(rng, 400, sh_degree=3), 16), 40, spread=20)
    for selection in (
        mixed_selection(),
        select(turned, random_camera(rng, distance=30), tolerance=0.1, device="cpu"),
    ):
        on_cpu = selection.gaussians(device="cpu")
        on_device = host(selection.gaussians(device="cuda"))
        assert len(on_cpu) > 0
        for name in scenes.NAMES:
            np.testing.assert_array_equal(getattr(on_cpu, name), getattr(on_device, name))


def test_nothing_selected_gives_no_gaussians(device):
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
    for scene in (Scene(), random_bundle(num_levels=0)):
        gaussians = select(scene, camera, tolerance=1.0, device="cpu").gaussians(device=device)
        assert len(gaussians) == 0
        assert ("torch" in repr(gaussians)) == (device == "cuda")


def test_gaussians_of_an_unplaced_bundle_are_its_own(device):
    rng = np.random.default_rng(0)
    one = lod_bundle(rng, blob(rng, 1, size=0.01), 4, past_root=0)
    camera = Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
    world = host(select(one, camera, tolerance=1.0, device="cpu").gaussians(device=device))
    np.testing.assert_array_equal(world.means, one.gaussians.means)


def test_wrong_arguments_are_named():
    selection = select(
        random_bundle(1),
        Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8),
        tolerance=1,
        device="cpu",
    )
    with pytest.raises(ValueError, match=r"origin: expected shape \(3,\)"):
        selection.gaussians(origin=1.0, device="cpu")
    with pytest.raises(
        ValueError, match="device: expected 'auto', 'cpu', 'cuda' or 'cuda:1', got 'gpu'"
    ):
        selection.gaussians(device="gpu")
