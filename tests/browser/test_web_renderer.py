"""The renderer for browsers draws a cut as `v3dg.render` does. The tests need
playwright, Chromium on PATH, and the compiled core (`python csrc/wasm/build.py
v3dg/export/web/core.wasm`)."""

import dataclasses

import numpy as np
import pytest

import scenes_lod
import v3dg
import web_pages
from v3dg.metrics import flip, psnr
from web_server import serving

pytestmark = web_pages.NEEDS

LEAST_PSNR = 45
MOST_FLIP = 0.006


@pytest.fixture(scope="module")
def webgpu():
    """Return Chromium with WebGPU in software."""
    with web_pages.chromium_with_webgpu() as browser:
        yield browser


@pytest.fixture(scope="module")
def bundles(tmp_path_factory):
    """Return quantised bundles of the degrees 0 to 3, and their folder."""
    folder = tmp_path_factory.mktemp("renderer")
    web_pages.write_page(folder)
    opened = []
    for degree in range(4):
        rng = np.random.default_rng(degree)
        blob = scenes_lod.blob(rng, 2000, size=0.5, sh_degree=degree)
        blob = dataclasses.replace(blob, sh=0.3 * blob.sh)
        bundle = scenes_lod.lod_bundle(rng, blob, 64)
        path = folder / f"degree_{degree}.v3dg"
        v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, {}, "quantized").write(path)
        opened.append(v3dg.Bundle.open(path))
    return folder, opened


@pytest.fixture(scope="module")
def page(webgpu, bundles):
    folder, _ = bundles
    with serving(folder) as server:
        tab = webgpu.new_page()
        tab.goto(server.url)
        tab.wait_for_function("window.isReady")
        yield tab
        tab.close()


def check_picture(page, scene, cut, camera, background=(0.0, 0.0, 0.0)):
    """Compare the pictures of both renderers."""
    names = [bundle.path.rpartition("/")[2] for bundle in scene.bundles]
    picture, report = web_pages.drawing(page, scene, names, cut, camera, background)
    expected = v3dg.render(scene, camera, cut=cut, device="cpu", background=background)
    expected = np.clip(np.asarray(expected.color), 0, 1)
    picture = np.clip(picture, 0, 1)
    assert report["count"] == cut.num_gaussians > 0
    assert expected.max() > 0.3
    assert psnr(picture, expected) >= LEAST_PSNR
    assert flip(picture, expected) <= MOST_FLIP


CAMERA = v3dg.Camera.look_at((1.5, -2, 0.7), (0, 0, 0), fov_x=0.9, width=200, height=150)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_a_bundle_is_drawn_as_by_render(page, bundles, degree):
    scene = v3dg.Scene.of(bundles[1][degree])
    cut = v3dg.select(scene, CAMERA, tolerance=20, device="cpu")
    check_picture(page, scene, cut, CAMERA)


def test_rotated_tinted_and_faded_instances_are_drawn_as_by_render(page, bundles):
    scene = v3dg.Scene()
    rng = np.random.default_rng(7)
    for bundle in bundles[1]:
        scene.add(
            bundle,
            rng.normal(size=(5, 3)),
            rng.normal(size=(5, 4)),
            rng.uniform(0.2, 0.8, 5),
            opacity=rng.uniform(0.3, 1, 5),
            tint=rng.uniform(0.5, 1.2, (5, 3)),
        )
    cut = v3dg.select(scene, CAMERA, tolerance=20, fade=2.0, device="cpu")
    assert cut.given_weights.min() < 1
    check_picture(page, scene, cut, CAMERA, background=(0.2, 0.3, 0.4))


def test_a_scene_far_from_the_origin_is_drawn_as_by_render(page, bundles):
    scene = v3dg.Scene()
    far = np.array([3e6, -2e6, 1e6])
    scene.add(bundles[1][2], far, (0.3, 0.1, -0.9, 0.2))
    eye = far + np.array([1.5, -2, 0.7])
    camera = v3dg.Camera.look_at(eye, far, fov_x=0.9, width=CAMERA.width, height=CAMERA.height)
    cut = v3dg.select(scene, camera, tolerance=1, device="cpu")
    check_picture(page, scene, cut, camera)
