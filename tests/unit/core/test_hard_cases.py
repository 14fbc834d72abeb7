"""Every hard case is compared with float64, forward and backward, on both devices."""

import functools
import os
from types import SimpleNamespace

import numpy as np
import pytest

import scenes
import scenes_lod
import v3dg
from compare import GRADIENT_DOUBLE, PICTURE_DOUBLE, PICTURE_FLOAT, assert_pictures_agree
from devices import host, on
from hard_cases import (
    draw_core,
    drawn_rows,
    expected_picture,
    gradient_errors,
    gradients,
    hard_cases,
    picture,
    relative_changes,
)
from reference import rasterize as reference_rasterize
from v3dg import _core

CASES = pytest.mark.parametrize("name", hard_cases())
# Cases that torch operations can differentiate quickly and without 0 / 0.
SMOOTH = [
    name
    for name, case in hard_cases().items()
    if len(case.gaussians) <= 200 and case.is_drawn and np.isfinite(case.gaussians.sh).all()
]


@pytest.fixture(scope="module")
def torch():
    return pytest.importorskip("torch")


@functools.cache
def expected_of(name):
    return expected_picture(hard_cases()[name])


@functools.cache
def expected_gradients_of(name):
    import torch

    return gradients(hard_cases()[name], draw_core, torch.float64)


@CASES
def test_picture_is_the_references(device, name):
    case = hard_cases()[name]
    assert (expected_of(name).alpha > 0).any() == case.is_drawn
    assert_pictures_agree(picture(case, device), expected_of(name), case.picture)


@CASES
def test_picture_in_double_is_the_references(torch, name):
    case = hard_cases()[name]
    raster = v3dg.rasterize(scenes.doubles(case.gaussians, torch=torch), case.camera, **case.mode)
    assert_pictures_agree(raster, expected_of(name), PICTURE_DOUBLE)


@CASES
def test_gradients_are_those_in_double(torch, device, name):
    case = hard_cases()[name]
    got, expected = gradients(case, draw_core, torch.float32, device), expected_gradients_of(name)
    assert all(np.isfinite(g).all() for g in got)
    drawn = drawn_rows(case)
    for g in got[:4]:
        assert not g[~drawn & np.isfinite(case.gaussians.sh).all((1, 2))].any()
    if case.gradient is None:
        return
    errors = gradient_errors(relative_changes(case, got), relative_changes(case, expected))
    assert max(errors) <= case.gradient.relative_l2, dict(zip(scenes.NAMES, errors, strict=True))


@pytest.mark.parametrize("name", SMOOTH)
def test_gradients_in_double_are_autograds(torch, name):
    """The gradients are compared with those of a chain of torch operations that shares
    no formula with the core."""
    from reference import rasterize_torch

    case = hard_cases()[name]
    drawn = drawn_rows(case)

    def draw(inputs, camera, mode):
        background = torch.zeros(3, dtype=torch.float64)
        return rasterize_torch.rasterize(*(t[drawn] for t in inputs), background, camera, **mode)

    theirs = relative_changes(case, gradients(case, draw, torch.float64))
    ours = relative_changes(case, expected_gradients_of(name))
    whole = np.sqrt(sum((t[drawn] ** 2).sum() for t in theirs))
    for o, t in zip(ours, theirs, strict=True):
        assert np.abs(o[drawn] - t[drawn]).max(initial=0) <= GRADIENT_DOUBLE.relative * whole


def test_maps_keep_their_detail(device):
    """An asset with details of 10⁻³ has its own frame, which an instance places at
    coordinates of 10⁷."""
    rng = np.random.default_rng(0)
    asset = scenes_lod.blob(rng, 400, size=0.02, sh_degree=1)
    bundle = scenes_lod.lod_bundle(rng, asset, 64)
    place = np.array([4.5e6 + 0.123456, 5.2e6 - 0.654321, 1e7 + 0.111111])
    eye = np.array([0.01, -0.12, 0.03])
    lens = {"width": 70, "height": 50, "near": 0.001}
    near, far = (v3dg.Camera.look_at(at + eye, at, **lens) for at in (np.zeros(3), place))
    scene = v3dg.Scene()
    scene.add(bundle, positions=place[None])
    got = v3dg.render(scene, far, tolerance=0.0, depth=True, device=device)
    raster = v3dg.Image(*host((got.color, got.alpha, got.depth)))
    expected = reference_rasterize.rasterize(
        asset, near, min_transmittance=_core.stop_of_tolerance(0.0)
    )
    assert (expected.alpha > 0.5).mean() > 0.3
    assert_pictures_agree(raster, expected, PICTURE_FLOAT)


@pytest.mark.parametrize("distance", [1e3, 1e4, 1e5])
def test_assets_far_from_their_zero_keep_their_detail(device, distance):
    """The asset's own coordinates are up to 10⁵, the eye is among them, and the
    instance rotates and scales."""
    rng = np.random.default_rng(0)
    near = scenes_lod.blob(rng, 400, size=0.5, sh_degree=2)
    center = distance * np.array([0.6, -0.64, 0.48])
    asset = scenes.replaced(near, means=near.means + center.astype(np.float32))
    scene, quaternion, scale = v3dg.Scene(), (0.3, -0.5, 0.7, 0.4), 7.0
    scene.add(scenes_lod.lod_bundle(rng, asset, 64), (3.0, 5e4, -700.0), quaternion, scale)
    place = scene.positions[0] + scale * scene.rotations[0] @ center
    camera = v3dg.Camera.look_at(place + np.array([0.3, -9.0, 1.0]), place, width=70, height=50)
    # The same camera in the frame of the asset, where distances are divided by the
    # scale.
    viewmat = np.eye(4)
    viewmat[:3, :3] = camera.viewmat[:3, :3] @ scene.rotations[0]
    eye = scene.rotations[0].T @ (camera.position - scene.positions[0]) / scale
    viewmat[:3, 3] = -viewmat[:3, :3] @ eye
    own = v3dg.Camera(viewmat, camera.K, 70, 50, camera.near / scale)
    got = v3dg.render(scene, camera, tolerance=0.0, depth=True, device=device)
    raster = v3dg.Image(*host((got.color, got.alpha, got.depth / scale)))
    expected = reference_rasterize.rasterize(
        asset, own, min_transmittance=_core.stop_of_tolerance(0.0)
    )
    assert (expected.alpha > 0.5).mean() > 0.1
    assert_pictures_agree(raster, expected, PICTURE_FLOAT)


UNSEEN = {
    "no gaussians": scenes.gaussians(np.zeros((0, 3))),
    "all behind": scenes.gaussians([[0, 0, -2.0]] * 300),
    "all beside": scenes.gaussians([[50.0, 0, 2.0]] * 300, scales=0.01),
    "all too faint": scenes.gaussians([[0, 0, 2.0]] * 300, opacities=0.003),
    "all between pixel centres": scenes.gaussians([[0.0, 0, 2.0]] * 300, scales=1e-4),
    "none a number": scenes.gaussians([[np.nan, 0, 2.0]] * 300),
}


@pytest.mark.parametrize("name", UNSEEN)
def test_nothing_to_see_is_the_background(torch, device, name):
    camera, background = scenes.CAMERAS["plain"], (0.1, 0.2, 0.3)
    inputs = scenes.leaves(torch, UNSEEN[name], background, torch.float32, device)
    g = SimpleNamespace(**dict(zip(scenes.NAMES, inputs, strict=False)))
    raster = v3dg.rasterize(g, camera, background=inputs[5])
    assert (host(raster.color) == np.float32(background)).all()
    assert not host(raster.alpha).any()
    assert not host(raster.depth).any()
    *by_inputs, d_background = torch.autograd.grad(raster.color.sum(), inputs)
    assert not any(host(g).any() for g in by_inputs)
    np.testing.assert_allclose(host(d_background), camera.width * camera.height)


@pytest.mark.parametrize("count", [0, 3])
def test_scene_out_of_sight_is_the_background(device, count):
    rng = np.random.default_rng(0)
    scene = v3dg.Scene()
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 200), 64)
    scene.add(bundle, positions=np.full((count, 3), [0.0, 0.0, -100.0]))
    image = v3dg.render(scene, scenes.CAMERAS["plain"], background=(0.1, 0.2, 0.3), device=device)
    assert (host(image.color) == np.float32((0.1, 0.2, 0.3))).all()
    assert not host(image.alpha).any()
    assert image.stats.gaussians_in_frustum == 0


def test_more_pairs_than_31_bits_count(torch, device):
    """Every pixel has stopped long before the 5,000th gaussian, so more gaussians
    change nothing."""
    # The picture has 1920 x 1080 pixels, in tiles of 32 x 16 or 32 x 32.
    num, tiles = (550_000, 60 * 68) if device == "cuda" else (1_060_000, 60 * 34)
    assert num * tiles > 1 << 31
    if device == "cpu" and "V3DG_HUGE" not in os.environ:
        pytest.skip("takes minutes; set V3DG_HUGE=1")
    if device == "cuda" and torch.cuda.mem_get_info()[0] < 64 << 30:
        pytest.skip("expected 64 GiB of free device memory")
    camera = scenes.camera(1920, 1080, fx=1000.0)
    rng = np.random.default_rng(0)
    depth = np.linspace(1, 2, num)
    everywhere = scenes.gaussians(
        np.column_stack([rng.normal(0, 0.1, (num, 2)), depth]),
        scales=5.0,
        opacities=0.0075,
        color=rng.uniform(0, 1, (num, 3)),
    )
    few = v3dg.rasterize(on(device, everywhere.subset(slice(5000))), camera)
    assert few.alpha.min() > 0.999
    many = v3dg.rasterize(on(device, everywhere), camera)
    for got, expected in (
        (many.color, few.color),
        (many.alpha, few.alpha),
        (many.depth, few.depth),
    ):
        np.testing.assert_array_equal(host(got), host(expected))
