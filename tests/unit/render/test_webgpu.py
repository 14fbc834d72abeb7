"""`device="webgpu"` draws what the CPU draws. The tests need the package wgpu and an
adapter, such as that of Mesa's lavapipe (`apt install mesa-vulkan-drivers`)."""

import dataclasses
import importlib.util
import subprocess
import sys

import numpy as np
import pytest

import scenes_lod
import v3dg
from v3dg.metrics import flip, psnr

LEAST_PSNR = 50
MOST_FLIP = 0.006
CAMERA = v3dg.Camera.look_at((1.5, -2, 0.7), (0, 0, 0), fov_x=0.9, width=100, height=75)


def _missing_part():
    """Return why WebGPU cannot be used; None if it can."""
    if importlib.util.find_spec("wgpu") is None:
        return "wgpu is not installed"
    from v3dg.render.webgpu.gpu import Gpu

    try:
        Gpu()
    except RuntimeError as error:
        return str(error)
    return None


_MISSING = _missing_part()
needs_webgpu = pytest.mark.skipif(_MISSING is not None, reason=str(_MISSING))


@pytest.fixture(scope="module")
def bundles():
    """Return quantised bundles of the degrees 0 to 3."""
    made = []
    for degree in range(4):
        rng = np.random.default_rng(degree)
        blob = scenes_lod.blob(rng, 1000, size=0.5, sh_degree=degree)
        blob = dataclasses.replace(blob, sh=0.3 * blob.sh)
        bundle = scenes_lod.lod_bundle(rng, blob, 64)
        made.append(v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, {}, "quantized"))
    return made


@pytest.fixture(scope="module")
def scene(bundles):
    """Return a scene of rotated, tinted and faded instances of all bundles."""
    scene = v3dg.Scene()
    rng = np.random.default_rng(7)
    for bundle in bundles:
        scene.add(
            bundle,
            rng.normal(size=(3, 3)),
            rng.normal(size=(3, 4)),
            rng.uniform(0.2, 0.8, 3),
            opacity=rng.uniform(0.3, 1, 3),
            tint=rng.uniform(0.5, 1.2, (3, 3)),
        )
    return scene


def check_close(picture, expected):
    """Check that pictures agree to what rounding allows."""
    assert expected.color.max() > 0.3
    color = np.clip(picture.color, 0, 1)
    expected_color = np.clip(expected.color, 0, 1)
    assert psnr(color, expected_color) >= LEAST_PSNR
    assert flip(color, expected_color) <= MOST_FLIP
    np.testing.assert_allclose(picture.alpha, expected.alpha, atol=0.02)
    assert picture.stats.gaussians_selected == expected.stats.gaussians_selected


@needs_webgpu
def test_a_scene_is_drawn_as_on_the_cpu(scene):
    options = {"tolerance": 20, "fade": 2.0, "background": (0.2, 0.3, 0.4)}
    picture = v3dg.render(scene, CAMERA, device="webgpu", **options)
    check_close(picture, v3dg.render(scene, CAMERA, device="cpu", **options))


@needs_webgpu
def test_a_budget_is_met_as_on_the_cpu(scene):
    picture = v3dg.render(scene, CAMERA, budget=3000, device="webgpu")
    expected = v3dg.render(scene, CAMERA, budget=3000, device="cpu")
    check_close(picture, expected)
    assert picture.stats.tolerance == expected.stats.tolerance


@needs_webgpu
def test_a_cut_that_was_selected_before_is_drawn(scene):
    cut = v3dg.select(scene, CAMERA, tolerance=50, device="cpu")
    picture = v3dg.render(scene, CAMERA, cut=cut, device="webgpu")
    check_close(picture, v3dg.render(scene, CAMERA, cut=cut, device="cpu"))


@needs_webgpu
def test_a_scene_far_from_the_origin_is_drawn_as_on_the_cpu(bundles):
    far = np.array([3e6, -2e6, 1e6])
    scene = v3dg.Scene()
    scene.add(bundles[2], far, (0.3, 0.1, -0.9, 0.2))
    camera = v3dg.Camera.look_at(
        far + np.array([1.5, -2, 0.7]), far, fov_x=0.9, width=100, height=75
    )
    picture = v3dg.render(scene, camera, tolerance=1, device="webgpu")
    check_close(picture, v3dg.render(scene, camera, tolerance=1, device="cpu"))


@needs_webgpu
def test_pixels_stop_behind_the_requested_transmittance(bundles):
    options = {"tolerance": 1, "min_transmittance": 0.3}
    picture = v3dg.render(bundles[0], CAMERA, device="webgpu", **options)
    check_close(picture, v3dg.render(bundles[0], CAMERA, device="cpu", **options))
    whole = v3dg.render(bundles[0], CAMERA, tolerance=1, device="webgpu")
    assert np.abs(whole.alpha - picture.alpha).max() > 0.1


@needs_webgpu
def test_gaussians_of_float32_are_rounded(bundles):
    rng = np.random.default_rng(0)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 500, size=0.5, sh_degree=1), 64)
    rounded = v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, {}, "quantized")
    picture = v3dg.render(bundle, CAMERA, tolerance=1, device="webgpu")
    expected = v3dg.render(rounded, CAMERA, tolerance=1, device="webgpu")
    assert np.array_equal(picture.color, expected.color)


@needs_webgpu
def test_a_file_is_drawn_as_its_bundle(bundles, tmp_path):
    path = tmp_path / "bundle.v3dg"
    bundles[3].write(path)
    picture = v3dg.render(v3dg.Bundle.open(path), CAMERA, tolerance=9, device="webgpu")
    expected = v3dg.render(bundles[3], CAMERA, tolerance=9, device="webgpu")
    assert np.array_equal(picture.color, expected.color)


@needs_webgpu
def test_an_empty_view_shows_the_background(scene):
    camera = v3dg.Camera.look_at((90, 0, 0), (99, 0, 0), fov_x=0.5, width=20, height=10)
    picture = v3dg.render(scene, camera, background=(0.1, 0.2, 0.3), device="webgpu")
    np.testing.assert_allclose(picture.color, np.broadcast_to([0.1, 0.2, 0.3], (10, 20, 3)))
    assert not picture.alpha.any()


@needs_webgpu
def test_large_gaussians_enlarge_the_buffers(bundles, monkeypatch):
    from v3dg.render.webgpu import drawer, frame

    monkeypatch.setattr(drawer, "_LEAST_CAPACITY", 64)
    monkeypatch.setattr(frame, "_shared", frame._SharedDrawer())
    near = v3dg.Camera.look_at((0.05, -0.3, 0.0), (0, 0, 0), fov_x=1.2, width=300, height=225)
    picture = v3dg.render(bundles[0], near, tolerance=1, device="webgpu")
    check_close(picture, v3dg.render(bundles[0], near, tolerance=1, device="cpu"))


@needs_webgpu
def test_pages_stay_on_the_device_and_make_room(bundles):
    from v3dg.render.webgpu.gpu import Gpu
    from v3dg.render.webgpu.page_pool import PagePool

    gpu = Gpu()
    layout = bundles[0].page_layout
    all_pages = [np.arange(layout.num_pages)]
    sizes = [4 * len(page) for page in bundles[0].code_pages(range(layout.num_pages))]
    gpu.most_bytes = sum(sizes) + sizes[0] // 2
    pool = PagePool(gpu)
    places = pool.bring_in(bundles[:1], all_pages)
    assert pool.num_bytes == sum(sizes)
    assert 4 * places[0].max() + sizes[int(places[0].argmax())] == sum(sizes)
    pool.bring_in(bundles[:1], all_pages)
    assert pool.num_bytes == sum(sizes)
    pool.bring_in(bundles[1:2], [np.arange(1)])  # the pages of the first bundle make room
    assert 0 < pool.num_bytes < sum(sizes)
    gpu.most_bytes = 4
    with pytest.raises(RuntimeError, match="lower the budget or raise the tolerance"):
        pool.bring_in(bundles[:1], all_pages)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"depth": True}, "depth: expected False"),
        ({"channels": ["normal"]}, "channels: expected no channels"),
        ({"memory": "1GB"}, "memory: expected None"),
        ({"color_by": "level"}, "color_by: expected 'appearance'"),
    ],
)
def test_what_webgpu_lacks_is_one_error(bundles, options, message):
    with pytest.raises(ValueError, match=message):
        v3dg.render(bundles[0], CAMERA, device="webgpu", **options)


def test_cameras_that_webgpu_lacks_are_errors(bundles):
    stereo = v3dg.StereoCamera.of(CAMERA, 0.06)
    distorted = dataclasses.replace(CAMERA, model="OPENCV", distortion=(0.1, 0, 0, 0))
    sphere = v3dg.EquirectangularCamera.level(CAMERA, (0, 0, 1), 64)
    for camera in (stereo, distorted, sphere):
        with pytest.raises(ValueError, match="camera: expected a pinhole"):
            v3dg.render(bundles[0], camera, device="webgpu")


def test_assets_and_batches_are_errors(bundles):
    with pytest.raises(ValueError, match="subject: expected a scene or a bundle"):
        v3dg.render(bundles[0].gaussians, CAMERA, device="webgpu")
    with pytest.raises(ValueError, match="renderer: a batch is drawn on the CPU or with CUDA"):
        v3dg.Renderer(bundles[0], device="webgpu").render_batch([CAMERA])


def test_other_functions_do_not_accept_webgpu(bundles):
    with pytest.raises(ValueError, match="device: 'webgpu' only draws pictures"):
        v3dg.select(bundles[0], CAMERA, device="webgpu")


def test_a_missing_package_is_one_error(tmp_path):
    program = (
        "import sys; sys.modules['wgpu'] = None\n"
        "from v3dg.render.webgpu.gpu import Gpu\n"
        "try: Gpu()\n"
        "except ImportError as error: print(error)\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert "pip install 'wgpu>=" in answer.stdout


@pytest.mark.skipif(importlib.util.find_spec("wgpu") is None, reason="wgpu is not installed")
def test_a_missing_adapter_is_one_error():
    program = (
        "import wgpu\n"
        "def refuse(**options): raise RuntimeError('no backends')\n"
        "wgpu.gpu.request_adapter_sync = refuse\n"
        "from v3dg.render.webgpu.gpu import Gpu\n"
        "try: Gpu()\n"
        "except RuntimeError as error: print(error)\n"
    )
    answer = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True, timeout=60
    )
    assert answer.stdout.startswith("device: WebGPU finds no adapter (no backends); install")
