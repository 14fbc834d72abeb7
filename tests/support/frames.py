"""Shared parts of the tests of whole frames: a camera, a scene, and the comparison of
pictures."""

import functools

import numpy as np

import scenes_lod
import v3dg
from compare import PICTURE_FLOAT
from devices import host
from v3dg import Camera

CAMERA = Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)


render = functools.partial(v3dg.render, depth=True)


class Renderer(v3dg.Renderer):
    """Draws depth, too, so that tests compare it."""

    def render(self, camera, **options):
        return super().render(camera, **{"depth": True} | options)


def arrays(image):
    return host((image.color, image.alpha, image.depth))


def assert_same_bytes(image, other):
    for got, expected in zip(arrays(image), arrays(other), strict=True):
        np.testing.assert_array_equal(got, expected)


def assert_close(planes, expected):
    """Compare pictures that both have rounding errors; a pixel may differ by more at a
    cut-off."""
    for got, wanted in zip(planes, expected, strict=True):
        assert got.shape == wanted.shape
        assert np.isfinite(got).all()
        error = np.abs(got - wanted) / np.maximum(1, np.abs(wanted))
        assert error.mean() <= PICTURE_FLOAT.mean
        assert (error > PICTURE_FLOAT.absolute).mean() <= PICTURE_FLOAT.share


def assert_like_cpu(image, expected):
    assert_close(arrays(image), arrays(expected))
    assert image.stats.gaussians_selected == expected.stats.gaussians_selected
    assert image.stats.gaussians_in_frustum == expected.stats.gaussians_in_frustum


def composed_scene(rng, sh_degree=1):
    bundles = [
        scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, n, sh_degree=sh_degree), 64)
        for n in (900, 300)
    ]
    scene = scenes_lod.random_scene(rng, bundles[0], 30, spread=3.0)
    scene.add(bundles[1], positions=rng.normal(size=(7, 3)), quaternions=rng.normal(size=(7, 4)))
    return scene
