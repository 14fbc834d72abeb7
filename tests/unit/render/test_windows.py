"""Windows of a picture on the CPU have the same bits as the whole picture, for any
number of gaussians."""

import numpy as np
import pytest

import scenes_lod
from v3dg import Camera, Scene, _core, render, select
from v3dg._device import CPU
from v3dg.render import shade_of
from v3dg.residency import residency

CAMERA = Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)


def crowd(rng, count, num_gaussians=400):
    """Return many instances of one bundle around the origin."""
    bundle = scenes_lod.lod_bundle(
        rng, scenes_lod.blob(rng, num_gaussians, size=0.2, sh_degree=1), 64
    )
    scene = Scene()
    quaternions = rng.normal(size=(count, 4))
    scene.add(bundle, positions=rng.normal(size=(count, 3)), quaternions=quaternions)
    return scene


def draw_window(scene, camera, window):
    """Return colour, alpha, depth and statistics of the pixels [x0, x1) x [y0, y1)."""
    selection = select(scene, camera, tolerance=0.0, device="cpu")
    frame = _core.SceneFrame(CPU.number)
    residency.set_models(frame, scene.bundles, CPU, "appearance")
    request = _core.FrameRequest(
        camera.core.window(*window),
        shade=shade_of((0.1, 0.2, 0.3), None, is_asset=False, depth=True),
        cut=_core.GivenCut(selection.instance_ids, selection.cluster_ids),
    )
    drawing = frame.draw(residency.scene(scene, CPU).core, request)
    return drawing.color, drawing.alpha, drawing.depth, drawing.finish()


def assert_windows_are_parts(scene, camera, windows):
    image = render(
        scene, camera, tolerance=0.0, background=(0.1, 0.2, 0.3), depth=True, device="cpu"
    )
    assert (image.alpha > 0.5).mean() > 0.1
    for x0, y0, x1, y1 in windows:
        *part, stats = draw_window(scene, camera, (x0, y0, x1, y1))
        for got, whole in zip(part, (image.color, image.alpha, image.depth), strict=True):
            np.testing.assert_array_equal(got, whole[y0:y1, x0:x1])
        assert stats.in_frustum == image.stats.gaussians_in_frustum
    return image


def test_window_has_the_bits_of_the_whole_picture():
    rng = np.random.default_rng(0)
    corners = [np.sort(rng.choice(size, (20, 2)), axis=1) for size in (CAMERA.width, CAMERA.height)]
    windows = [(x0, y0, x1 + 1, y1 + 1) for (x0, x1), (y0, y1) in zip(*corners, strict=True)]
    pixels = [(x, y, x + 1, y + 1) for x, y in ((0, 0), (202, 116), (31, 32), (100, 60), (101, 58))]
    assert_windows_are_parts(crowd(rng, 50), CAMERA, windows + pixels)


def test_picture_of_more_gaussians_than_memory_takes_at_once_is_the_same():
    """The picture is drawn in bands, but each half has few enough gaussians to be drawn
    at once."""
    rng = np.random.default_rng(1)
    middle = CAMERA.height // 2
    halves = [(0, 0, CAMERA.width, middle), (0, middle, CAMERA.width, CAMERA.height)]
    image = assert_windows_are_parts(crowd(rng, 36_000), CAMERA, halves)
    assert image.stats.gaussians_in_frustum > 12 << 20


@pytest.mark.parametrize(
    "window", [(-1, 0, 3, 3), (0, 0, 204, 3), (0, 0, 3, 118), (5, 5, 5, 9), (5, 9, 9, 5)]
)
def test_windows_that_are_not_in_the_picture_are_refused(window):
    with pytest.raises(
        ValueError, match="window: expected x0 < x1 and y0 < y1 within 203 x 117 px, got"
    ):
        draw_window(crowd(np.random.default_rng(2), 1), CAMERA, window)
