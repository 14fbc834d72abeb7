"""False colours: palettes by level and by cluster."""

from dataclasses import replace

import numpy as np
import pytest

import v3dg
from devices import host
from frames import render
from random_bundle import random_bundle
from scenes_lod import blob, lod_bundle
from v3dg import Scene, _core
from v3dg.false_color import palette_of


@pytest.mark.parametrize("by", ["level", "cluster"])
def test_palette_draws_what_a_recoloured_copy_does(device, by):
    """The bits are the same, even where neighbouring clusters of several instances are
    drawn together."""
    rng = np.random.default_rng(21)
    bundle = lod_bundle(rng, blob(rng, 300, sh_degree=2), 16)
    clusters = bundle.clusters
    sh = np.repeat(palette_of(bundle, by), np.diff(clusters.offset), axis=0)[:, None]
    recoloured = v3dg.Bundle(clusters, bundle.groups, replace(bundle.gaussians, sh=sh))
    camera = v3dg.Camera.look_at((0, -6, 0), (0, 0, 0), width=64, height=48)
    poses = rng.normal(size=(3, 3))
    pictures = []
    for subject, color_by in ((bundle, by), (recoloured, "appearance")):
        scene = Scene()
        scene.add(subject, positions=poses)
        pictures.append(render(scene, camera, tolerance=5.0, color_by=color_by, device=device))
    np.testing.assert_array_equal(host(pictures[0].color), host(pictures[1].color))


@pytest.mark.parametrize("by", ["level", "cluster"])
def test_false_colors_show_what_was_chosen(device, by):
    rng = np.random.default_rng(14)
    bundle = lod_bundle(rng, blob(rng, 200), 16)
    camera = v3dg.Camera.look_at((0, -6, 0), (0, 0, 0), width=48, height=40)
    palette = palette_of(bundle, by)
    clusters = bundle.clusters
    assert palette.shape == (len(clusters), 3)
    key = clusters.level if by == "level" else np.arange(len(clusters.level))
    rgb = (0.28209479177387814 * palette + 0.5).clip(0)
    seen = {}
    for name, color in zip(key.tolist(), rgb, strict=True):
        assert seen.setdefault(name, color.tobytes()) == color.tobytes()
    assert len(set(list(seen.values())[:9])) == min(len(seen), 9)
    top = render(bundle, camera, tolerance=np.inf, color_by=by, device=device)
    color = host(top.color)
    alpha = host(top.alpha)
    shown = color[alpha > 0.5] / alpha[alpha > 0.5, None]
    last = rgb[-1]
    np.testing.assert_allclose(shown, np.broadcast_to(last, shown.shape), atol=2e-3)
    with pytest.raises(ValueError, match=r"color_by: expected .* or 'residency', got 'size'"):
        render(bundle, camera, color_by="size", device=device)
    with pytest.raises(ValueError, match="color_by: expected 'appearance' for an asset"):
        render(bundle.level_gaussians(0), camera, color_by=by, device=device)


def test_palettes_of_what_is_resident_and_of_own_colours():
    bundle = random_bundle(3)
    assert palette_of(bundle, "appearance") is None
    palette = palette_of(bundle, "residency")
    assert palette.dtype == np.float32
    assert palette.shape == (len(bundle.clusters), 3)
    assert (palette == palette[0]).all()  # a bundle in memory has all of its pages
    resident, missing = _core.missing_colors(np.array([0, 1 << 30], np.int32))
    np.testing.assert_allclose(_core.sh_base0 * palette[0] + 0.5, resident, atol=1e-6)
    assert not np.allclose(resident, missing)
