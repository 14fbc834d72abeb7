"""Tests picking: which gaussian a pixel shows."""

from dataclasses import replace

import numpy as np
import pytest

import v3dg
from frames import render
from random_bundle import random_bundle
from scenes_lod import blob, lod_bundle, random_camera, random_scene
from v3dg import Scene, select


def pairs(selection):
    return list(zip(selection.instance_ids.tolist(), selection.cluster_ids.tolist(), strict=True))


def composed(rng, count):
    """Return instances of a bundle with the layout of a build and of random trees, some
    of them important."""
    scene = random_scene(rng, lod_bundle(rng, blob(rng, 300), 8), count, spread=8)
    scene.add(random_bundle(int(rng.integers(1 << 30)), num_levels=4), rng.normal(size=(3, 3)))
    scene.set_importance(np.exp(rng.normal(size=len(scene))))
    return scene


def test_pick_finds_what_a_pixel_shows():
    rng = np.random.default_rng(17)
    scene = composed(rng, 15)
    camera = random_camera(rng, distance=8)
    options = {"tolerance": 0.3}
    image = render(scene, camera, device="cpu", **options)
    full = select(scene, camera, device="cpu", **options)
    seen = 0
    for x, y in rng.integers(0, (camera.width, camera.height), (40, 2)):
        found = v3dg.pick(scene, camera, x, y, **options)
        if found is None:
            assert image.alpha[y, x] < 1 / 255
            continue
        seen += 1
        assert (found.instance, found.cluster) in pairs(full)
        assert 0 < found.weight <= image.alpha[y, x] + 1e-6
        # Without its cluster, the pixel loses at least the contribution of the picked
        # gaussian, whatever is behind it.
        keep = (full.instance_ids != found.instance) | (full.cluster_ids != found.cluster)
        rest = replace(
            full, instance_ids=full.instance_ids[keep], cluster_ids=full.cluster_ids[keep]
        )
        assert image.alpha[y, x] != render(scene, camera, cut=rest, device="cpu").alpha[y, x]
        ray = camera.viewmat[:3, :3] @ (found.position - camera.position)
        np.testing.assert_allclose(
            ray[:2] / ray[2] * [camera.fx, camera.fy] + [camera.cx, camera.cy],
            [x + 0.5, y + 0.5],
            atol=1e-6,
        )
        assert ray[2] == pytest.approx(found.depth)
    assert seen > 10


def test_pick_takes_the_one_in_front():
    rng = np.random.default_rng(18)
    asset = replace(
        blob(rng, 50, size=0.3),
        opacities=np.full(50, 0.99, np.float32),
        scales=np.full((50, 3), 0.3, np.float32),
    )
    bundle = lod_bundle(rng, asset, 8)
    scene = Scene()
    scene.add(bundle, [[0, 3, 0], [0, 1, 0], [50, 0, 0]])
    camera = v3dg.Camera.look_at((0, -5, 0), (0, 0, 0), width=64, height=64)
    found = v3dg.pick(scene, camera, 32, 32, budget=len(bundle.level_gaussians(0)))
    assert found is not None
    assert found.instance == 1
    assert abs(found.position[1] - 1) < 1.5
    assert v3dg.pick(scene, camera, 0, 0) is None
    with pytest.raises(ValueError, match=r"x, y: expected a pixel inside 64 x 64, got \(64, 0\)"):
        v3dg.pick(scene, camera, 64, 0)
