"""Single pictures of assets and bundles; test_composed.py draws scenes."""

import numpy as np
import pytest

import v3dg
from devices import host
from frames import render
from scenes_lod import blob, lod_bundle, random_camera


def test_depth_is_drawn_where_it_is_asked_for(device):
    rng = np.random.default_rng(11)
    bundle = lod_bundle(rng, blob(rng, 500), 32)
    for subject in (bundle, blob(rng, 500)):
        camera = random_camera(rng)
        with_depth, without = (
            render(subject, camera, depth=asked, device=device) for asked in (True, False)
        )
        assert host(with_depth.depth).shape == host(with_depth.alpha).shape
        for one, other in ((without.color, with_depth.color), (without.alpha, with_depth.alpha)):
            np.testing.assert_array_equal(host(one), host(other))
        with pytest.raises(
            AttributeError, match="depth: expected a picture that was drawn with depth=True"
        ):
            without.depth  # noqa: B018


def test_asset_and_bundle_are_seen_from_the_same_place(device):
    """The rotation has an error as in float32 text, and the camera is far from the
    origin."""
    rng = np.random.default_rng(20)
    center = np.array([300.0, -200.0, 50.0])
    asset = blob(rng, 200, origin=center, sh_degree=3)
    bundle = lod_bundle(rng, asset, 16)
    exact = v3dg.Camera.look_at(center - [0, 6, 1], center, width=64, height=48)
    viewmat = exact.viewmat.copy()
    viewmat[:3, :3] += rng.uniform(-3e-5, 3e-5, (3, 3))
    viewmat[:3, 3] = -viewmat[:3, :3] @ exact.position
    camera = v3dg.Camera(viewmat, exact.K, 64, 48)
    # If this matrix were used as an exact rotation, the eye would be elsewhere, and
    # colours would depend on the wrong direction.
    np.testing.assert_allclose(camera.position, exact.position, atol=1e-9)
    assert np.linalg.norm(-viewmat[:3, :3].T @ viewmat[:3, 3] - camera.position) > 5e-3
    as_bundle = render(bundle, camera, tolerance=0.0, depth=True, device=device)
    as_asset = render(asset, camera, depth=True, device=device)
    raster = v3dg.rasterize(asset.torch("cuda") if device == "cuda" else asset, camera)
    assert host(as_bundle.alpha).max() > 0.9
    for picture in (as_asset, raster):
        for name in ("color", "alpha", "depth"):
            error = np.abs(host(getattr(picture, name)) - host(getattr(as_bundle, name)))
            assert error.max() < 2e-4, name
            # Depths are near 6, where the spacing of float32 is 5e-7. Packed values are
            # rounded once more.
            assert error.mean() < 3e-6, name
