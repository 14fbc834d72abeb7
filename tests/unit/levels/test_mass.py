"""Cuts keep the total alpha and colour of assets that are faint, or dark with bright
spots."""

from dataclasses import replace

import numpy as np
import pytest

import v3dg
from devices import host
from v3dg import BuildConfig, _device
from v3dg.levels import refined

SAMPLES = 8
DISTANCE = 14.0


@pytest.fixture(scope="module")
def faint_cloud():
    """Return 3,000 faint gaussians around the origin."""
    rng = np.random.default_rng(1)
    count = 3_000
    return v3dg.Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=rng.uniform(0.02, 0.07, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.02, 0.08, count).astype(np.float32),
        sh=rng.uniform(-0.5, 1.5, (count, 1, 3)).astype(np.float32),
    )


@pytest.fixture(scope="module")
def dark_ball():
    """Return a ball of 3,000 gaussians whose median colour is dark, but whose mean
    colour is not."""
    rng = np.random.default_rng(3)
    count = 3_000
    outwards = rng.normal(size=(count, 3))
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    brightness = np.where(rng.random((count, 1, 1)) < 0.12, 2.0, -1.5)
    return v3dg.Gaussians(
        means=(2 * outwards).astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=rng.uniform(0.02, 0.08, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0.6, 0.99, count).astype(np.float32),
        sh=(brightness + rng.uniform(-0.1, 0.1, (count, 1, 3))).astype(np.float32),
    )


def cameras(width):
    """Return views of the asset from all sides, with this width in px."""
    rng = np.random.default_rng(2)
    for _ in range(24):
        eye = rng.normal(size=3)
        eye *= DISTANCE / np.linalg.norm(eye)
        yield v3dg.Camera.look_at(
            eye, (0, 0, 0), rng.normal(size=3), 0.6, width=width, height=width
        )


def totals(image):
    """Return the sums (4,) of colour and alpha over a picture."""
    planes = [host(image.color), host(image.alpha)[..., None]]
    return np.concatenate(planes, axis=-1).sum((0, 1), dtype=np.float64)


def ratios(asset, bundle, width, device):
    """Return the total colour and alpha (4,) of the cut at the default tolerance,
    divided by those of the asset, which is drawn with many samples per pixel."""
    of_cuts = np.zeros(4)
    of_asset = np.zeros(4)
    for camera in cameras(width):
        of_cuts += totals(v3dg.render(bundle, camera, device=device))
        of_asset += totals(v3dg.rasterize(asset, camera.scaled(SAMPLES))) / SAMPLES**2
    return of_cuts / of_asset


def test_cuts_of_a_faint_asset_keep_its_alpha_and_colour(faint_cloud, device):
    bundle = v3dg.build_bundle(faint_cloud, device=device, progress=False, quality="draft")
    for width in (14, 20):
        np.testing.assert_allclose(ratios(faint_cloud, bundle, width, device), 1, atol=0.02)


def test_a_fit_by_pixels_alone_loses_alpha(faint_cloud):
    """Without the loss of cells, alpha is lost, because the medians of sparse pixels
    are below their means."""
    config = BuildConfig(loss_cells=0.0, smooth="no")
    bundle = v3dg.build_bundle(faint_cloud, config=config, device="cpu", progress=False)
    assert (ratios(faint_cloud, bundle, 14, "cpu") < 0.96).all()


def test_a_faint_asset_has_no_filter(faint_cloud):
    opaque = v3dg.Gaussians(
        faint_cloud.means,
        faint_cloud.quats,
        faint_cloud.scales / 4,
        np.full_like(faint_cloud.opacities, 0.9),
        faint_cloud.sh,
    )
    for asset, filter_px2 in ((faint_cloud, 0), (opaque, 0.05)):
        config = BuildConfig(first_steps=20, steps=20)
        bundle = v3dg.build_bundle(asset, config=config, device="cpu", progress=False)
        first = bundle.level_range(1).start
        np.testing.assert_allclose(bundle.clusters.filter_px2[first], filter_px2, rtol=1e-6)


@pytest.fixture(scope="module")
def drafts(faint_cloud, dark_ball):
    """Return bundles that are not refined."""
    return [
        (asset, v3dg.build_bundle(asset, device="cpu", progress=False, quality="draft"))
        for asset in (faint_cloud, dark_ball)
    ]


def test_refined_cuts_keep_alpha_and_colour(drafts, device):
    pictures = 1_000 * refined.default_steps(_device.resolve(device)).windows
    for asset, bundle in drafts:
        moved = v3dg.refine_bundle(bundle, steps=pictures, device=device, progress=False)
        np.testing.assert_allclose(ratios(asset, moved, 14, device), 1, atol=0.025)


def test_a_faint_asset_loses_no_gaussians(drafts):
    for (_, bundle), is_faint in zip(drafts, (True, False), strict=True):
        moved = v3dg.refine_bundle(bundle, steps=1, drop=0.1, device="cpu", progress=False)
        assert (moved.num_gaussians == bundle.num_gaussians) == is_faint


@pytest.mark.slow
def test_a_refinement_by_pixels_and_cells_alone_darkens(drafts, monkeypatch):
    """The medians of small cells are below their means, too. The refinement may drop
    gaussians here, as it does for assets that are not faint."""
    monkeypatch.setattr(refined, "is_faint", lambda _: False)
    plain = refined.default_steps
    monkeypatch.setattr(
        refined, "default_steps", lambda device: replace(plain(device), window_means=0.0)
    )
    for asset, bundle in drafts:
        moved = v3dg.refine_bundle(bundle, steps=1_000, device="cpu", progress=False)
        assert (ratios(asset, moved, 14, "cpu")[:3] < 0.977).all()
