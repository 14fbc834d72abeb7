"""The opacity and the tint of instances: in pictures, in cuts and in exports, on every
device."""

import numpy as np
import pytest

import scenes
import v3dg
from devices import host
from frames import CAMERA, arrays, assert_close, assert_like_cpu, render
from reference.sh import basis
from scenes_lod import blob, lod_bundle
from v3dg import Scene, _core, select

LEAST_ALPHA = 1 / 255
TINT = (0.25, 1.5, 0.0)
OPACITY = 0.6
WHITE = (1.0, 1.0, 1.0)


def bundle_of(seed, count=300, sh_degree=1, codec="float32"):
    """Return a bundle, and its gaussians of level 0."""
    rng = np.random.default_rng(seed)
    bundle = lod_bundle(rng, blob(rng, count, sh_degree=sh_degree), 32)
    return v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, {}, codec)


def tinted(gaussians, tint, opacity):
    """By definition, the clamped colour and the opacity are multiplied."""
    factor = np.asarray(tint, np.float64)
    sh = gaussians.sh.astype(np.float64) * factor
    sh[:, 0] += (factor - 1) * 0.5 / 0.28209479177387814
    return scenes.replaced(
        gaussians,
        opacities=(gaussians.opacities * np.float32(opacity)).astype(np.float32),
        sh=sh.astype(np.float32),
    )


def scene_of(bundle, **factors):
    scene = Scene()
    scene.add(bundle, (0.2, 0.1, 0.0), (1, 0.3, 0.2, 0.1), 0.7, **factors)
    return scene


@pytest.mark.parametrize("sh_degree", range(4))
def test_a_picture_shows_the_asset_with_other_colours_and_opacities(device, sh_degree):
    bundle = bundle_of(sh_degree, sh_degree=sh_degree)
    scene = scene_of(bundle, tint=TINT, opacity=OPACITY)
    whole = select(scene_of(bundle), CAMERA, tolerance=0, cull=False, device="cpu")
    expected = render(tinted(whole.gaussians(device="cpu"), TINT, OPACITY), CAMERA, device="cpu")
    assert expected.alpha.max() > 0.3
    assert_close(arrays(render(scene, CAMERA, tolerance=0, device=device)), arrays(expected))


@pytest.mark.parametrize("sh_degree", range(4))
def test_coded_bundles_are_tinted_alike(device, tmp_path, sh_degree):
    asset = blob(np.random.default_rng(4), 200, size=0.5, sh_degree=sh_degree)
    config = v3dg.BuildConfig(cluster_size=32, steps=0)
    v3dg.build_bundle(asset, config=config, codec="quantized", progress=False, device="cpu").write(
        tmp_path / "a.v3dg"
    )
    bundle = v3dg.Bundle.open(tmp_path / "a.v3dg")
    whole = select(scene_of(bundle), CAMERA, tolerance=0, cull=False, device="cpu")
    expected = render(tinted(whole.gaussians(device="cpu"), TINT, OPACITY), CAMERA, device="cpu")
    scene = scene_of(bundle, tint=TINT, opacity=OPACITY)
    assert_close(arrays(render(scene, CAMERA, tolerance=0, device=device)), arrays(expected))


def test_colours_are_clamped_before_they_are_tinted():
    black = scenes.replaced(
        blob(np.random.default_rng(0), 50), sh=np.full((50, 1, 3), -9, np.float32)
    )
    bundle = lod_bundle(np.random.default_rng(0), black, 32)
    image = render(scene_of(bundle, tint=(3, 3, 3)), CAMERA, device="cpu")
    assert image.alpha.max() > 0.3
    np.testing.assert_array_equal(image.color, 0)


def test_an_overflowing_tint_does_not_spread():
    bundle = bundle_of(0, sh_degree=0)
    image = render(scene_of(bundle, tint=(3e38, 1, 1)), CAMERA, background=WHITE, device="cpu")
    assert np.isfinite(image.color[..., 1:]).all()
    assert not np.isnan(image.color).any()


def test_factors_of_one_change_no_bit(device):
    bundle = bundle_of(1)
    scene = scene_of(bundle)
    before = arrays(render(scene, CAMERA, device=device))
    scene.set_tint((0.5, 1, 1))
    scene.set_opacity(0.5)
    changed = arrays(render(scene, CAMERA, device=device))
    assert not np.array_equal(changed[0], before[0])
    assert not np.array_equal(changed[1], before[1])
    scene.set_tint(WHITE)
    scene.set_opacity(1)
    for got, wanted in zip(arrays(render(scene, CAMERA, device=device)), before, strict=True):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("opacity", [0.0, 0.99 * LEAST_ALPHA])
def test_an_invisible_instance_costs_nothing(device, opacity):
    scene = scene_of(bundle_of(1), opacity=opacity)
    image = render(scene, CAMERA, device=device)
    assert image.stats.gaussians_selected == 0
    np.testing.assert_array_equal(host(image.alpha), 0)
    for cull in (True, False):
        assert len(select(scene, CAMERA, cull=cull, device=device)) == 0


def test_the_least_visible_opacity_is_selected():
    scene = scene_of(bundle_of(1), opacity=np.float32(LEAST_ALPHA))
    assert len(select(scene, CAMERA, device="cpu")) > 0


def test_a_given_cut_skips_what_has_become_invisible(device):
    scene = scene_of(bundle_of(1))
    cut = select(scene, CAMERA, device=device)
    scene.set_opacity(0)
    image = render(scene, CAMERA, cut=cut, device=device)
    np.testing.assert_array_equal(host(image.alpha), 0)


def crowd(rng, count=90):
    """Return instances of two bundles, near and far, each with its own factors.
    Neighbours share coarse clusters."""
    scene = Scene()
    for seed, sh_degree in ((0, 0), (1, 2)):
        scene.add(
            bundle_of(seed, sh_degree=sh_degree),
            rng.normal(size=(count, 3)) * (4, 25, 3) + (0, 20, 0),
            rng.normal(size=(count, 4)),
            opacity=rng.uniform(0, 1, count),
            tint=rng.uniform(0, 2, (count, 3)),
        )
    return scene


@pytest.mark.parametrize("fade", [None, 1.5])
def test_every_instance_of_a_crowd_has_its_own_factors(device, fade):
    scene = crowd(np.random.default_rng(0))
    image = render(scene, CAMERA, tolerance=4.0, fade=fade, device=device)
    assert_like_cpu(image, render(scene, CAMERA, tolerance=4.0, fade=fade, device="cpu"))
    cut = select(scene, CAMERA, tolerance=4.0, fade=fade, device=device)
    again = render(scene, CAMERA, cut=cut, device=device)
    assert_close(arrays(again), arrays(image))
    assert image.stats.gaussians_selected > 1000


def test_opacity_multiplies_the_weights_of_a_fade():
    bundle = bundle_of(2)
    cut = select(scene_of(bundle), CAMERA, tolerance=4.0, fade=2.0, device="cpu")
    half = v3dg.Selection(
        scene=cut.scene,
        instance_ids=cut.instance_ids,
        cluster_ids=cut.cluster_ids,
        num_gaussians=cut.num_gaussians,
        tolerance=cut.tolerance,
        seconds=0.0,
        given_weights=cut.weights * np.float32(0.5),
    )
    expected = render(cut.scene, CAMERA, cut=half, device="cpu")
    scene = scene_of(bundle, opacity=0.5)
    image = render(scene, CAMERA, tolerance=4.0, fade=2.0, device="cpu")
    for got, wanted in zip(arrays(image), arrays(expected), strict=True):
        np.testing.assert_array_equal(got, wanted)


@pytest.mark.parametrize("sh_degree", range(4))
def test_gathered_gaussians_have_the_factors(device, sh_degree):
    bundle = bundle_of(sh_degree, 60, sh_degree)
    plain = select(scene_of(bundle), CAMERA, tolerance=0, cull=False, device="cpu")
    cut = select(scene_of(bundle, tint=TINT, opacity=OPACITY), CAMERA, tolerance=0, cull=False)
    got = host(cut.gaussians(device=device))
    before = plain.gaussians(device="cpu")
    np.testing.assert_array_equal(got.opacities, before.opacities * np.float32(OPACITY))
    direction = np.array([0.6, 0.0, -0.8])
    bases = basis(direction[None], sh_degree)[0]
    colors = np.maximum(0.5 + np.einsum("k,nkc->nc", bases, before.sh.astype(float)), 0)
    tinted_colors = np.maximum(0.5 + np.einsum("k,nkc->nc", bases, got.sh.astype(float)), 0)
    np.testing.assert_allclose(tinted_colors, colors * TINT, atol=2e-6)


def test_false_colours_keep_their_meaning(device):
    bundle = bundle_of(3)
    plain = render(scene_of(bundle), CAMERA, color_by="level", device=device)
    image = render(scene_of(bundle, tint=TINT), CAMERA, color_by="level", device=device)
    np.testing.assert_array_equal(host(image.color), host(plain.color))


def test_a_pool_draws_the_factors(device, tmp_path):
    bundle_of(5).write(tmp_path / "a.v3dg")
    scene = scene_of(v3dg.Bundle.open(tmp_path / "a.v3dg"), tint=TINT, opacity=OPACITY)
    expected = render(scene, CAMERA, device="cpu")
    image = render(scene, CAMERA, device=device, memory=64 << 20)
    assert_close(arrays(image), arrays(expected))


def test_picking_looks_through_what_is_hidden():
    scene = Scene()
    scene.add(bundle_of(6), [(0, -2, 0), (0, 0, 0)])
    x, y = CAMERA.width // 2, CAMERA.height // 2
    assert v3dg.pick(scene, CAMERA, x, y, tolerance=0).instance == 0
    scene.set_opacity(0, [0])
    assert v3dg.pick(scene, CAMERA, x, y, tolerance=0).instance == 1


def test_the_core_refuses_factors_of_another_shape():
    arrays_of_one = {
        "bundle": np.zeros(1, np.int32),
        "positions": np.zeros((1, 3)),
        "quaternions": np.ones((1, 4)),
        "scales": np.ones(1),
        "importance": np.ones(1, np.float32),
    }
    with pytest.raises(ValueError, match="factors"):
        _core.Instances(**arrays_of_one, factors=np.ones((2, 4), np.float32))
