"""Shared parts of the tests of whole frames: a camera, a scene, and the comparison of
pictures."""

import functools

import numpy as np

import scenes_lod
import v3dg
from compare import PICTURE_FLOAT
from devices import host, on
from v3dg import Camera, CameraBatch, Scene

CAMERA = Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)


render = functools.partial(v3dg.render, depth=True)


class Renderer(v3dg.Renderer):
    """A renderer that also draws depth, so that tests compare it."""

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


def tensors_of(cameras, **options):
    """Return a batch of cameras of one size as tensors on the GPU."""
    arrays = CameraBatch.of(cameras)
    viewmats, K = on("cuda", (arrays.viewmats, arrays.K))
    return CameraBatch(viewmats, K, arrays.width, arrays.height, **options)


def composed_scene(rng, sh_degree=1):
    bundles = [
        scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, n, sh_degree=sh_degree), 64)
        for n in (900, 300)
    ]
    scene = scenes_lod.random_scene(rng, bundles[0], 30, spread=3.0)
    scene.add(bundles[1], positions=rng.normal(size=(7, 3)), quaternions=rng.normal(size=(7, 4)))
    return scene


def tinted_scene(rng):
    """Return instances of one bundle, each with an opacity and a tint of its own."""
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 400), 32)
    scene = Scene()
    count = 90
    scene.add(
        bundle,
        positions=rng.normal(0, 3, (count, 3)),
        quaternions=rng.normal(size=(count, 4)),
        scales=np.exp(rng.normal(-1, 0.5, count)),
        opacity=rng.choice([0.0, 0.4, 1.0], count),
        tint=rng.uniform(0, 2, (count, 3)),
    )
    return scene
