import hashlib
import math
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scenes
import v3dg
from command_line import TESTS_ENVIRONMENT
from compare import (
    BACKGROUND_GRADIENT,
    FINITE_DIFFERENCE,
    GRADIENT_DOUBLE,
    GRADIENT_FLOAT,
    GRADIENT_GSPLAT,
    NEEDLES_FLOAT,
    PICTURE_DOUBLE,
    PICTURE_FLOAT,
    assert_close,
    assert_gradients_agree,
    assert_pictures_agree,
)
from devices import host, on
from reference import rasterize as reference
from scenes import leaves

CAMERAS = pytest.mark.parametrize("camera", scenes.CAMERAS.values(), ids=scenes.CAMERAS.keys())
MODES = pytest.mark.parametrize(
    "mode",
    [
        {},
        {"filter_px2": 0.3},
        {"filter_px2": 0.1, "antialiased": True},
        {"filter_px2": 0.3, "antialiased": True, "background": (0.2, 0.9, 0.4)},
    ],
    ids=["plain", "filter", "antialiased", "background"],
)
INPUTS = (*scenes.NAMES, "background")


@pytest.fixture
def torch():
    return pytest.importorskip("torch")


def draw(device, gaussians, camera, **mode):
    """Return the picture that `device` draws, as NumPy arrays."""
    raster = v3dg.rasterize(on(device, gaussians), camera, **mode)
    return v3dg.Image(*host((raster.color, raster.alpha, raster.depth)))


def draw_double(torch, gaussians, camera, **mode):
    return v3dg.rasterize(scenes.doubles(gaussians, torch=torch), camera, **mode)


def digest(raster):
    arrays = (np.ascontiguousarray(a) for a in (raster.color, raster.alpha, raster.depth))
    return hashlib.sha256(b"".join(a.tobytes() for a in arrays)).hexdigest()


# Agreement with the reference.


@CAMERAS
@MODES
@pytest.mark.parametrize("sh_degree", range(4))
def test_picture_in_double_is_the_references(torch, camera, mode, sh_degree):
    gaussians = scenes.random_gaussians(sh_degree, camera, 100, aspect=1e3, sh_degree=sh_degree)
    picture = reference.rasterize(gaussians, camera, **mode)
    assert_pictures_agree(draw_double(torch, gaussians, camera, **mode), picture, PICTURE_DOUBLE)


@CAMERAS
@MODES
@pytest.mark.parametrize("sh_degree", range(4))
def test_picture_is_the_references(device, camera, mode, sh_degree):
    gaussians = scenes.random_gaussians(10 + sh_degree, camera, 100, sh_degree=sh_degree)
    picture = reference.rasterize(gaussians, camera, **mode)
    assert (picture.alpha > 0).mean() > 0.5
    assert_pictures_agree(draw(device, gaussians, camera, **mode), picture, PICTURE_FLOAT)


@MODES
def test_many_gaussians_over_many_tiles(torch, device, mode):
    camera = scenes.camera(131, 97, fx=90.0, cx=60.0, cy=55.0, pose=scenes.pose(8))
    gaussians = scenes.trained_like(20, camera, 1500)
    picture = reference.rasterize(gaussians, camera, **mode)
    assert picture.num_blended.max() > 20
    assert picture.is_stopped.any() or mode.get("antialiased")
    assert_pictures_agree(draw_double(torch, gaussians, camera, **mode), picture, PICTURE_DOUBLE)
    assert_pictures_agree(draw(device, gaussians, camera, **mode), picture, NEEDLES_FLOAT)


@MODES
@pytest.mark.parametrize("name", scenes.degenerate())
def test_degenerate_scene_is_the_references(torch, device, mode, name):
    gaussians, camera = scenes.degenerate()[name], scenes.CAMERAS["plain"]
    picture = reference.rasterize(gaussians, camera, **mode)
    assert_pictures_agree(draw_double(torch, gaussians, camera, **mode), picture, PICTURE_DOUBLE)
    assert_pictures_agree(draw(device, gaussians, camera, **mode), picture, NEEDLES_FLOAT)


CROWDS = {
    "spread": lambda rng, num: rng.uniform(1, 4, num),
    "on a plane": lambda rng, num: np.full(num, 2.0),
    "on three planes": lambda rng, num: rng.integers(1, 4, num),
    "on sheets": lambda rng, num: 1 + rng.integers(0, 7, num) ** 2 + rng.uniform(0, 1e-4, num),
    "behind one": lambda rng, num: np.where(
        np.arange(num) == num // 2, 0.02, rng.uniform(3, 3.001, num)
    ),
    "before one": lambda rng, num: np.where(
        np.arange(num) == num // 2, 1e6, rng.uniform(3, 3.001, num)
    ),
}


@pytest.mark.parametrize("opacity", [0.01, 0.8])
@pytest.mark.parametrize("depths", CROWDS)
def test_crowded_tiles_are_the_references(device, depths, opacity):
    camera, num = scenes.camera(36, 18, fx=40.0), 9000
    rng = np.random.default_rng(30)
    depth = CROWDS[depths](rng, num)
    place = rng.uniform(-1, [[37], [19]], (2, num)) - [[18], [9]]
    gaussians = scenes.gaussians(
        np.stack([*(place * depth / 40), depth], axis=1),
        quats=rng.normal(size=(num, 4)),
        scales=rng.uniform(0.2, 1.5, (num, 3)) * depth[:, None] / 40,
        opacities=opacity * rng.uniform(0.5, 1, num),
        color=rng.uniform(0, 1, (num, 3)),
    )
    picture = reference.rasterize(gaussians, camera)
    assert_pictures_agree(draw(device, gaussians, camera), picture, PICTURE_FLOAT)


@pytest.mark.parametrize("name", scenes.poison())
@MODES
def test_gaussian_without_meaning_is_not_drawn(device, name, mode):
    camera = scenes.CAMERAS["plain"]
    good = scenes.random_gaussians(3, camera, 20)
    alone = draw(device, good, camera, **mode)
    with_poison = v3dg.Gaussians.concatenate([scenes.poison()[name], good])
    assert digest(draw(device, with_poison, camera, **mode)) == digest(alone)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_color_without_meaning_stays_where_the_gaussian_is(device, value):
    camera = scenes.CAMERAS["plain"]
    here = scenes.gaussians([-0.4, 0, 2.0], color=(value, 0.5, 0.5))
    there = scenes.gaussians([0.5, 0, 2.0])
    both = draw(device, v3dg.Gaussians.concatenate([here, there]), camera)
    right = draw(device, there, camera)
    np.testing.assert_array_equal(both.color[:, 30:], right.color[:, 30:])


@pytest.mark.parametrize("num", [1, 2, 7, 8, 9, 15, 16, 17, 31, 33])
def test_every_count_of_gaussians(device, num):
    camera = scenes.CAMERAS["posed"]
    gaussians = scenes.random_gaussians(num, camera, num, sh_degree=1)
    picture = reference.rasterize(gaussians, camera, filter_px2=0.1)
    assert_pictures_agree(draw(device, gaussians, camera, filter_px2=0.1), picture, PICTURE_FLOAT)


@pytest.mark.parametrize("num", [63, 64, 65, 511, 512, 513, 1100])
def test_every_count_of_gaussians_in_one_tile(device, num):
    # Faint gaussians, so that the last ones show, of which some reach all of the tile.
    camera = scenes.camera(30, 30, fx=40.0, cx=15.0, cy=15.0)
    faint = scenes.random_gaussians(
        num, camera, num, size_px=(0.5, 9), opacity=(0.01, 0.03), margin=0
    )
    picture = reference.rasterize(faint, camera, filter_px2=0.1)
    assert_pictures_agree(draw(device, faint, camera, filter_px2=0.1), picture, PICTURE_FLOAT)


@pytest.mark.parametrize(
    "size", [(1, 1), (1, 40), (40, 1), (31, 33), (32, 32), (33, 31), (64, 65), (129, 3)]
)
def test_every_image_size(device, size):
    camera = scenes.camera(*size, fx=40.0)
    gaussians = scenes.random_gaussians(7, camera, 60, size_px=(1, 8))
    picture = reference.rasterize(gaussians, camera)
    assert_pictures_agree(draw(device, gaussians, camera), picture, PICTURE_FLOAT)


@st.composite
def wild_gaussian(draw):
    """Return one gaussian of any shape at any position that one of the cameras sees."""
    log_scale = st.floats(-5, 1.5)
    place = st.floats(-3, 3, width=32)
    return scenes.gaussians(
        [draw(place), draw(place), draw(st.floats(-1, 4, width=32))],
        quats=[draw(st.floats(-1, 1)) for _ in range(3)] + [draw(st.floats(0.1, 1))],
        scales=[10.0 ** draw(log_scale) for _ in range(3)],
        opacities=draw(st.floats(0, 1)),
    )


@given(
    gaussian=wild_gaussian(),
    size=st.tuples(st.integers(1, 70), st.integers(1, 70)),
    center=st.tuples(st.floats(-20, 90), st.floats(-20, 90)),
    filter_px2=st.sampled_from([0.0, 0.1, 0.3]),
)
@settings(max_examples=200)
def test_tiles_lose_no_pixel_of_any_gaussian(gaussian, size, center, filter_px2):
    torch = pytest.importorskip("torch")
    camera = scenes.camera(*size, fx=30.0, fy=45.0, cx=center[0], cy=center[1])
    picture = reference.rasterize(gaussian, camera, filter_px2=filter_px2)
    assert_pictures_agree(
        draw_double(torch, gaussian, camera, filter_px2=filter_px2), picture, PICTURE_DOUBLE
    )


# Where pixels stop.


def draw_stopped(device, gaussians, camera, min_transmittance, **mode):
    options = {"min_transmittance": min_transmittance, "depth": True, "device": device}
    raster = v3dg.render(gaussians, camera, **options, **mode)
    return v3dg.Image(*host((raster.color, raster.alpha, raster.depth)))


@pytest.mark.parametrize("min_transmittance", [0.0, 1e-4, 1e-3, 0.1, 0.99])
def test_pixels_stop_behind_the_one_that_hides_the_rest(device, min_transmittance):
    camera, mode = scenes.CAMERAS["plain"], {"background": (0.2, 0.9, 0.4)}
    gaussians = scenes.trained_like(30, camera, 600)
    picture = reference.rasterize(gaussians, camera, min_transmittance=min_transmittance, **mode)
    assert picture.is_stopped.any() == (min_transmittance > 0)
    drawn = draw_stopped(device, gaussians, camera, min_transmittance, **mode)
    assert_pictures_agree(drawn, picture, NEEDLES_FLOAT)


@pytest.mark.parametrize("min_transmittance", [1e-4, 1e-3, 1e-2])
def test_no_more_light_is_lost_than_asked_for(device, min_transmittance):
    """This also holds for opaque gaussians, each of which takes all light except a
    thousandth."""
    camera = scenes.CAMERAS["plain"]
    loose = scenes.trained_like(31, camera, 2000)
    gaussians = scenes.replaced(
        loose,
        opacities=np.where(np.arange(len(loose)) % 2 == 0, np.float32(1), loose.opacities),
        sh=np.clip(loose.sh, -0.2, 0.2),  # colours from 0 to 1
    )
    whole = draw_stopped(device, gaussians, camera, 0.0)
    picture = draw_stopped(device, gaussians, camera, min_transmittance)
    for plane, of_whole in ((picture.color, whole.color), (picture.alpha, whole.alpha)):
        assert 0 < np.abs(plane - of_whole).max() <= min_transmittance * (1 + 1e-4)


@pytest.mark.parametrize("value", [-1e-9, 1.001, np.nan, "much"])
def test_a_share_of_light_is_refused_that_is_none(value):
    camera = scenes.CAMERAS["plain"]
    with pytest.raises(
        ValueError, match=r"min_transmittance: expected a transmittance from 0 to 0\.99, got"
    ):
        v3dg.render(
            scenes.trained_like(32, camera, 5), camera, min_transmittance=value, device="cpu"
        )


def test_assets_are_drawn_as_rasterized_unless_asked(device):
    camera = scenes.CAMERAS["plain"]
    gaussians = scenes.trained_like(33, camera, 600)
    rendered = draw_stopped(device, gaussians, camera, None)
    expected = draw(device, gaussians, camera)
    # On CUDA, an asset is drawn from precomputed covariances, which are rounded
    # differently.
    assert np.abs(rendered.color - expected.color).max() <= 1e-5
    stopped = draw_stopped(device, gaussians, camera, 1e-3)
    assert np.abs(stopped.color - expected.color).max() > 1e-4


# Properties.


def test_gaussian_nearer_than_near_is_not_drawn(device):
    at = scenes.gaussians([[0, 0, 0.5]], scales=0.01)
    for near, drawn in ((0.499, True), (0.5, True), (0.501, False)):
        alpha = draw(device, at, scenes.camera(near=near)).alpha
        assert (alpha.max() > 0) == drawn


def test_background_is_composed_last(device):
    camera = scenes.CAMERAS["plain"]
    gaussians = scenes.random_gaussians(4, camera, 30)
    black = draw(device, gaussians, camera)
    shown = draw(device, gaussians, camera, background=(0.25, 1.0, 2.0))
    np.testing.assert_array_equal(shown.alpha, black.alpha)
    np.testing.assert_array_equal(shown.depth, black.depth)
    np.testing.assert_allclose(
        shown.color, black.color + (1 - black.alpha)[..., None] * [0.25, 1.0, 2.0], atol=1e-6
    )


def test_empty_set_shows_the_background(device):
    raster = draw(
        device, scenes.gaussians(np.zeros((0, 3))), scenes.camera(5, 3), background=(0.1, 0.2, 0.3)
    )
    np.testing.assert_array_equal(
        raster.color, np.broadcast_to(np.float32([0.1, 0.2, 0.3]), (3, 5, 3))
    )
    assert not raster.alpha.any()
    assert not raster.depth.any()


def test_equal_depths_are_drawn_in_the_order_of_their_index(device):
    camera = scenes.camera(33, 33)
    red, blue = [1.0, 0, 0], [0, 0, 1.0]
    for colors in ([red, blue], [blue, red]):
        pair = scenes.gaussians([[0, 0, 2.0]] * 2, opacities=0.7, color=colors)
        center = draw(device, pair, camera).color[16, 16]
        expected = 0.7 * np.array(colors[0]) + 0.3 * 0.7 * np.array(colors[1])
        np.testing.assert_allclose(center, expected, atol=2e-6)


def test_depths_too_far_apart_for_an_entry_keep_their_order(torch):
    # 30 bits of depth and 23 bits of records are one bit more than an entry has, so
    # neighbours in depth become equal.
    count = 4_300_000
    generator = np.random.default_rng(1)
    depths = (np.float32(0.02).view(np.uint32) + generator.integers(0, 64, count)).astype(np.uint32)
    means = np.c_[0.02 * generator.uniform(-0.5, 0.5, (count, 2)), depths.view(np.float32)]
    near = scenes.gaussians(
        means,
        scales=1.6e-4,
        opacities=0.1,
        color=generator.uniform(size=(count, 3)).astype(np.float32),
    )
    far = scenes.gaussians([[0, 0, 1e18]], scales=3e16, opacities=0.1)
    camera = v3dg.Camera(np.eye(4), [[64, 0, 32], [0, 64, 32], [0, 0, 1]], 64, 64)
    pictures = []
    for gaussians in (near, v3dg.Gaussians.concatenate([near, far])):
        leaf = gaussians.torch("cpu")
        leaf.opacities.requires_grad_(True)  # so that the picture is drawn as a whole
        pictures.append(v3dg.rasterize(leaf, camera).color.detach().numpy())
    # every pixel stops in front of the far gaussians
    np.testing.assert_array_equal(*pictures)


@pytest.mark.parametrize("count", [300, 900, 3000, 9000])
def test_depths_that_differ_in_their_last_bits_are_ordered(count):
    """Lists are first sorted by their leading bits. A far gaussian makes all others
    equal in these bits. Gaussians of equal depth keep the order of the array."""
    generator = np.random.default_rng(count)
    depths = (np.float32(2).view(np.uint32) + generator.integers(0, 40, count)).astype(np.uint32)
    depths = np.append(depths.view(np.float32), np.float32(1e6))
    means = np.c_[0.02 * depths[:, None] * generator.uniform(-1, 1, (count + 1, 2)), depths]
    near = scenes.gaussians(
        means,
        scales=0.02 * depths[:, None] * np.ones(3),
        opacities=0.01,
        color=generator.uniform(size=(count + 1, 3)),
    )
    order = np.argsort(depths, kind="stable")
    camera = v3dg.Camera(np.eye(4), [[64, 0, 16], [0, 64, 16], [0, 0, 1]], 32, 32)
    np.testing.assert_array_equal(
        draw("cpu", near, camera).color, draw("cpu", near.subset(order), camera).color
    )


def test_order_of_the_arrays_does_not_matter(device):
    camera = scenes.CAMERAS["off_centre"]
    gaussians = scenes.trained_like(6, camera, 300)
    order = np.random.default_rng(0).permutation(300)
    assert digest(draw(device, gaussians, camera)) == digest(
        draw(device, gaussians.subset(order), camera)
    )


def test_gaussians_out_of_sight_change_nothing(device):
    camera = scenes.CAMERAS["plain"]
    seen = scenes.random_gaussians(9, camera, 50)
    unseen = scenes.gaussians(
        [[0, 0, -2], [50, 0, 1], [0, -50, 1], [0, 0, 2], [0, 0, 3.0]],
        scales=[[1.0] * 3, [0.1] * 3, [0.1] * 3, [1.0] * 3, [0.0] * 3],
        opacities=[1, 1, 1, 0, 1],
    )
    alone = digest(draw(device, seen, camera))
    assert digest(draw(device, v3dg.Gaussians.concatenate([unseen, seen]), camera)) == alone
    assert digest(draw(device, v3dg.Gaussians.concatenate([seen, unseen]), camera)) == alone


def test_moving_world_and_camera_together_changes_only_rounding(device):
    camera = scenes.CAMERAS["posed"]
    gaussians = scenes.random_gaussians(5, camera, 100)
    shift = np.array([4.0, -2.0, 8.0])
    viewmat = camera.viewmat.copy()
    viewmat[:3, 3] -= viewmat[:3, :3] @ shift
    moved = scenes.replaced(gaussians, means=gaussians.means + shift.astype(np.float32))
    there = v3dg.Camera(viewmat, camera.K, camera.width, camera.height)
    picture = reference.rasterize(gaussians, camera, filter_px2=0.3)
    assert_pictures_agree(draw(device, moved, there, filter_px2=0.3), picture, PICTURE_FLOAT)


def test_antialiased_keeps_what_a_small_gaussian_adds_to_the_picture(device):
    camera = scenes.camera(33, 33)
    tiny = scenes.gaussians([0.003, 0.002, 2.0], scales=0.02, opacities=0.5)  # half a pixel
    sharp, soft = (draw(device, tiny, camera, **m).alpha.sum() for m in ({}, {"filter_px2": 0.3}))
    kept = draw(device, tiny, camera, filter_px2=0.3, antialiased=True).alpha.sum()
    assert soft > 1.5 * sharp
    assert abs(kept - sharp) < 0.1 * sharp


# Kinds of arrays, and wrong arguments.


def test_numpy_in_numpy_out():
    raster = v3dg.rasterize(scenes.gaussians([0, 0, 1.0]), scenes.camera(20, 10))
    for array, shape in (
        (raster.color, (10, 20, 3)),
        (raster.alpha, (10, 20)),
        (raster.depth, (10, 20)),
    ):
        assert isinstance(array, np.ndarray)
        assert array.dtype == np.float32
        assert array.shape == shape


def test_torch_in_torch_out(torch, device):
    raster = v3dg.rasterize(scenes.gaussians([0, 0, 1.0]).torch(device), scenes.camera(20, 10))
    for tensor, shape in (
        (raster.color, (10, 20, 3)),
        (raster.alpha, (10, 20)),
        (raster.depth, (10, 20)),
    ):
        assert isinstance(tensor, torch.Tensor)
        assert tensor.device.type == device
        assert tensor.dtype == torch.float32
        assert tensor.shape == shape
        assert not tensor.requires_grad


@pytest.mark.parametrize(
    "mode", [{}, {"filter_px2": 0.3, "antialiased": True, "background": (1, 0.5, 0)}]
)
def test_numpy_and_torch_are_drawn_alike(torch, mode):
    camera = scenes.CAMERAS["off_centre"]
    gaussians = scenes.random_gaussians(2, camera, 40, sh_degree=2)
    assert digest(v3dg.rasterize(gaussians.torch(), camera, **mode)) == digest(
        v3dg.rasterize(gaussians, camera, **mode)
    )


@pytest.mark.gpu
def test_double_precision_stays_on_the_cpu(torch):
    double = v3dg.Gaussians(
        *(getattr(scenes.gaussians([0, 0, 1.0]).torch("cuda"), n).double() for n in scenes.NAMES)
    )
    with pytest.raises(ValueError, match="float64 is supported only on the CPU"):
        v3dg.rasterize(double, scenes.camera())


@pytest.mark.gpu
def test_rows_may_begin_anywhere_in_memory(torch):
    camera = scenes.CAMERAS["plain"]
    gaussians = scenes.random_gaussians(8, camera, 41).torch("cuda")
    rest = gaussians.subset(slice(1, None))
    copies = v3dg.Gaussians(*(getattr(rest, n).clone() for n in scenes.NAMES))
    pictures = [host(v3dg.rasterize(g, camera).color) for g in (rest, copies)]
    assert rest.sh.data_ptr() % 16 != 0
    np.testing.assert_array_equal(*pictures)


def test_inputs_are_left_as_they_were(torch, device):
    camera = scenes.CAMERAS["plain"]
    gaussians = scenes.random_gaussians(2, camera, 40, sh_degree=2)
    before = [getattr(gaussians, n).copy() for n in scenes.NAMES]
    tensors = gaussians.torch(device)
    tensors.means.requires_grad_()
    v3dg.rasterize(gaussians, camera)
    v3dg.rasterize(tensors, camera).color.sum().backward()
    for name, array in zip(scenes.NAMES, before, strict=True):
        np.testing.assert_array_equal(getattr(gaussians, name), array)
        np.testing.assert_array_equal(host(getattr(tensors, name)), array)


@pytest.mark.parametrize(
    ("mode", "message"),
    [
        ({"filter_px2": -0.1}, "filter_px2: expected"),
        ({"filter_px2": math.nan}, "filter_px2: expected"),
        ({"background": (1.0, 2.0)}, "background: expected shape"),
        ({"background": (1.0, 2.0, 3.0, 4.0)}, "background: expected shape"),
    ],
)
def test_wrong_arguments_are_refused(mode, message):
    with pytest.raises(ValueError, match=message):
        v3dg.rasterize(scenes.gaussians([0, 0, 1.0]), scenes.camera(), **mode)


# Gradients.


def weighted_sum(torch, raster, seed=0):
    """Return a number that depends on every pixel of colour, alpha and depth."""
    rng = np.random.default_rng(seed)
    parts = [raster.color, raster.alpha, raster.depth] if hasattr(raster, "color") else raster
    return sum((p * torch.from_numpy(rng.normal(size=tuple(p.shape))).to(p)).sum() for p in parts)


def draw_leaves(inputs, camera, **mode):
    g = SimpleNamespace(**dict(zip(scenes.NAMES, inputs[:5], strict=True)))
    return v3dg.rasterize(g, camera, background=inputs[5], **mode)


GRADIENT_MODES = pytest.mark.parametrize(
    "mode",
    [{}, {"filter_px2": 0.3}, {"filter_px2": 0.1, "antialiased": True}],
    ids=["plain", "filter", "antialiased"],
)
BACKGROUND = (0.3, -0.2, 0.8)


@CAMERAS
@GRADIENT_MODES
def test_gradients_in_double_are_those_of_autograd(torch, camera, mode):
    from reference import rasterize_torch

    gaussians = scenes.random_gaussians(
        30, camera, 40, size_px=(0.5, 10), sh_degree=3, opacity=(0.02, 1.2)
    )
    inputs = leaves(torch, gaussians, BACKGROUND, torch.float64)
    got = torch.autograd.grad(weighted_sum(torch, draw_leaves(inputs, camera, **mode)), inputs)
    raster = rasterize_torch.rasterize(*inputs, camera, **mode)
    expected = torch.autograd.grad(weighted_sum(torch, raster), inputs)
    for name, g, e in zip(INPUTS, got, expected, strict=True):
        assert e.abs().max() > 0, name
        assert_close(g.numpy(), e.numpy(), GRADIENT_DOUBLE)


def smooth_scene(camera, mode, num=8, sh_degree=3):
    return scenes.first_smooth(
        lambda seed: scenes.random_gaussians(
            seed, camera, num, size_px=(1.5, 6), aspect=8, sh_degree=sh_degree, margin=-0.1
        ),
        camera,
        **mode,
    )


SMOOTH_CAMERAS = {
    "off_centre": scenes.camera(21, 17, fx=20.0, cx=6.5, cy=14.0, pose=scenes.pose(2)),
    "non_square": scenes.camera(14, 22, fx=15.0, fy=30.0, cx=7.0, cy=9.5, pose=scenes.pose(3)),
    "clamped": scenes.camera(16, 16, fx=30.0, cx=-20.0, cy=40.0, pose=scenes.pose(4)),
}


@pytest.mark.parametrize("name", SMOOTH_CAMERAS)
@GRADIENT_MODES
def test_gradients_are_finite_differences(torch, name, mode):
    camera = SMOOTH_CAMERAS[name]
    gaussians = smooth_scene(camera, mode)
    picture = reference.rasterize(gaussians, camera, **mode)
    assert (picture.alpha > 0).mean() > 0.5
    assert (picture.contribution > 0).all()
    inputs = leaves(torch, gaussians, BACKGROUND, torch.float64)
    gradients = torch.autograd.grad(
        weighted_sum(torch, draw_leaves(inputs, camera, **mode)), inputs
    )
    generator = torch.Generator().manual_seed(0)
    step = 1e-6
    for i, (input_name, gradient) in enumerate(zip(INPUTS, gradients, strict=True)):
        rows = gradient.reshape(len(gradient), -1)
        assert (rows.abs().max(dim=1).values > 0).all(), f"{input_name}: rows without gradient"
        for _ in range(4):
            direction = torch.randn(inputs[i].shape, generator=generator, dtype=torch.float64)
            if input_name == "scales":
                direction *= inputs[i].detach()  # steps are relative, so no scale changes its sign
            values = []
            for sign in (1, -1):
                moved = [t.detach() for t in inputs]
                moved[i] = moved[i] + sign * step * direction
                values.append(weighted_sum(torch, draw_leaves(moved, camera, **mode)).item())
            measured = (values[0] - values[1]) / (2 * step)
            size = gradient.norm().item() * direction.norm().item()
            error = abs((gradient * direction).sum().item() - measured)
            assert error <= FINITE_DIFFERENCE.relative * size + FINITE_DIFFERENCE.absolute, (
                input_name
            )


def test_each_coordinate_is_its_finite_difference(torch):
    camera = SMOOTH_CAMERAS["off_centre"]
    mode = {"filter_px2": 0.1, "antialiased": True}
    gaussians = smooth_scene(camera, mode, num=3)
    inputs = leaves(torch, gaussians, BACKGROUND, torch.float64)
    gradients = torch.autograd.grad(
        weighted_sum(torch, draw_leaves(inputs, camera, **mode)), inputs
    )
    step = 1e-6
    for i, gradient in enumerate(gradients):
        for k in range(gradient.numel()):
            values = []
            for sign in (1, -1):
                moved = [t.detach().clone() for t in inputs]
                moved[i].view(-1)[k] += sign * step
                values.append(weighted_sum(torch, draw_leaves(moved, camera, **mode)).item())
            measured = (values[0] - values[1]) / (2 * step)
            assert abs(gradient.reshape(-1)[k].item() - measured) <= (
                FINITE_DIFFERENCE.relative * gradient.norm().item() + 1e-7
            ), (INPUTS[i], k)


def gradients_of(torch, gaussians, camera, dtype, device, *, background=BACKGROUND, **mode):
    """Return the gradients of weighted_sum with respect to the five inputs and the
    background, as NumPy arrays."""
    inputs = leaves(torch, gaussians, background, dtype, device)
    return host(
        torch.autograd.grad(weighted_sum(torch, draw_leaves(inputs, camera, **mode)), inputs)
    )


def assert_gradients_are_those_in_double(torch, gaussians, camera, device, **mode):
    single = gradients_of(torch, gaussians, camera, torch.float32, device, **mode)
    double = gradients_of(torch, gaussians, camera, torch.float64, "cpu", **mode)
    for name, s, d in zip(INPUTS, single, double, strict=True):
        assert s.dtype == np.float32
        assert np.abs(d).max() > 0, name
        assert_gradients_agree(s, d, GRADIENT_FLOAT)


@CAMERAS
@GRADIENT_MODES
def test_gradients_in_float_are_those_in_double(torch, device, camera, mode):
    gaussians = scenes.random_gaussians(40, camera, 200, size_px=(0.5, 8), sh_degree=3)
    assert_gradients_are_those_in_double(torch, gaussians, camera, device, **mode)


@pytest.mark.parametrize("sh_degree", range(3))
def test_gradients_of_every_degree(torch, device, sh_degree):
    camera = scenes.CAMERAS["posed"]
    gaussians = scenes.random_gaussians(41, camera, 100, size_px=(0.5, 8), sh_degree=sh_degree)
    assert_gradients_are_those_in_double(torch, gaussians, camera, device)


@GRADIENT_MODES
def test_gradients_over_many_tiles(torch, device, mode):
    """Some gaussians cover hundreds of tiles, and some a single pixel. Some pixels stop
    early."""
    camera = scenes.camera(517, 389, fx=300.0, pose=scenes.pose(9))
    small = scenes.random_gaussians(
        42, camera, 3000, size_px=(0.5, 6), opacity=(0.1, 1.0), sh_degree=1
    )
    large = scenes.random_gaussians(
        43, camera, 60, size_px=(40, 150), opacity=(0.8, 1.2), sh_degree=1
    )
    gaussians = v3dg.Gaussians.concatenate([small, large])
    alpha = v3dg.rasterize(gaussians, camera, **mode).alpha
    assert (alpha > 0.999).any()
    assert_gradients_are_those_in_double(torch, gaussians, camera, device, **mode)


@pytest.mark.parametrize("which", ["color", "alpha", "depth"])
def test_each_output_has_gradients_of_its_own(torch, which):
    from reference import rasterize_torch

    camera = scenes.CAMERAS["posed"]
    gaussians = scenes.random_gaussians(31, camera, 20, sh_degree=1)
    inputs = leaves(torch, gaussians, BACKGROUND, torch.float64)
    ours = getattr(draw_leaves(inputs, camera, filter_px2=0.3), which)
    color, alpha, depth = rasterize_torch.rasterize(*inputs, camera, filter_px2=0.3)
    theirs = {"color": color, "alpha": alpha, "depth": depth}[which]
    got = torch.autograd.grad(weighted_sum(torch, [ours]), inputs)
    expected = torch.autograd.grad(weighted_sum(torch, [theirs]), inputs, allow_unused=True)
    assert expected[0].abs().max() > 0
    for g, e in zip(got, expected, strict=True):
        assert_close(g.numpy(), 0 * g.numpy() if e is None else e.numpy(), GRADIENT_DOUBLE)


@pytest.mark.parametrize("which", ["color", "alpha", "depth"])
def test_one_output_alone_can_be_differentiated(torch, device, which):
    camera = scenes.CAMERAS["posed"]
    gaussians = scenes.random_gaussians(31, camera, 50, sh_degree=1)
    gradients = []
    for dtype, where in ((torch.float32, device), (torch.float64, "cpu")):
        inputs = leaves(torch, gaussians, BACKGROUND, dtype, where)
        output = getattr(draw_leaves(inputs, camera, filter_px2=0.3), which)
        gradients.append(host(torch.autograd.grad(weighted_sum(torch, [output]), inputs)))
    for single, double in zip(*gradients, strict=True):
        assert_gradients_agree(single, double, GRADIENT_FLOAT)


def test_pictures_can_be_differentiated_in_any_order_and_again(torch, device):
    camera = scenes.CAMERAS["plain"]
    scene = [scenes.random_gaussians(seed, camera, 60) for seed in (50, 51, 52)]
    alone = [gradients_of(torch, g, camera, torch.float32, device) for g in scene]
    inputs = [leaves(torch, g, BACKGROUND, torch.float32, device) for g in scene]
    losses = [weighted_sum(torch, draw_leaves(i, camera)) for i in inputs]
    for k in (1, 1, 0, 2):
        again = host(torch.autograd.grad(losses[k], inputs[k], retain_graph=True))
        for a, b in zip(again, alone[k], strict=True):
            np.testing.assert_array_equal(a, b)


def test_gradients_are_the_same_on_every_run(torch, device):
    camera = scenes.camera(131, 97, fx=90.0, cx=60.0, cy=55.0, pose=scenes.pose(8))
    gaussians = scenes.trained_like(20, camera, 1500)
    first, *others = (
        gradients_of(torch, gaussians, camera, torch.float32, device) for _ in range(4)
    )
    for other in others:
        for a, b in zip(first, other, strict=True):
            np.testing.assert_array_equal(a, b)


@pytest.mark.gpu
def test_streams_do_not_disturb_each_other(torch):
    camera = scenes.camera(517, 389, fx=300.0)
    scene = [scenes.random_gaussians(seed, camera, 20000, size_px=(0.5, 6)) for seed in range(3)]
    alone = [gradients_of(torch, g, camera, torch.float32, "cuda") for g in scene]
    for _ in range(5):
        gradients = []
        for g in scene:
            with torch.cuda.stream(torch.cuda.Stream()):
                inputs = leaves(torch, g, BACKGROUND, torch.float32, "cuda")
                gradients.append(
                    torch.autograd.grad(weighted_sum(torch, draw_leaves(inputs, camera)), inputs)
                )
        torch.cuda.synchronize()
        for got, expected in zip(gradients, alone, strict=True):
            for a, b in zip(host(got), expected, strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.gpu
def test_picture_that_was_written_to_cannot_be_differentiated(torch):
    inputs = leaves(torch, scenes.gaussians([0, 0, 2.0]), BACKGROUND, torch.float32, "cuda")
    color = draw_leaves(inputs, scenes.camera()).color
    loss = color.sum()
    with torch.no_grad():
        color.zero_()
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


@pytest.mark.gpu
def test_background_on_the_device_has_its_gradient_there(torch):
    inputs = leaves(torch, scenes.gaussians([0, 0, 2.0]), BACKGROUND, torch.float32, "cuda")
    on_host = [*inputs[:5], torch.tensor(BACKGROUND, requires_grad=True)]
    gradients = []
    for tensors in (inputs, on_host):
        loss = draw_leaves(tensors, scenes.camera()).color.sum()
        gradients.append(torch.autograd.grad(loss, tensors[5])[0])
        assert gradients[-1].device == tensors[5].device
    np.testing.assert_array_equal(*host(gradients))


def test_gaussians_that_are_not_drawn_have_zero_gradients(torch, device):
    camera = scenes.CAMERAS["plain"]
    seen = scenes.random_gaussians(9, camera, 10)
    unseen = [
        *scenes.poison().values(),
        scenes.degenerate()["behind"],
        scenes.degenerate()["opacity_below_threshold"],
    ]
    gaussians = v3dg.Gaussians.concatenate([seen, *unseen])
    gradients = gradients_of(torch, gaussians, camera, torch.float32, device, filter_px2=0.1)
    expected = gradients_of(torch, seen, camera, torch.float32, device, filter_px2=0.1)
    for g, e in zip(gradients[:5], expected[:5], strict=True):
        np.testing.assert_array_equal(g[:10], e)
        assert not g[10:].any()


def test_no_gaussians_leave_the_background_its_gradient(torch, device):
    nothing = scenes.gaussians(np.zeros((0, 3)))
    *gradients, d_background = gradients_of(
        torch, nothing, scenes.camera(70, 50), torch.float32, device
    )
    assert [g.shape for g in gradients] == [getattr(nothing, n).shape for n in scenes.NAMES]
    assert_close(
        d_background,
        gradients_of(torch, nothing, scenes.camera(70, 50), torch.float64, "cpu")[5],
        BACKGROUND_GRADIENT,
    )


@pytest.mark.parametrize("name", scenes.degenerate())
@GRADIENT_MODES
def test_gradients_of_degenerate_scenes_are_finite(torch, device, name, mode):
    camera, gaussians = scenes.CAMERAS["plain"], scenes.degenerate()[name]
    gradients = gradients_of(torch, gaussians, camera, torch.float32, device, **mode)
    for g, n in zip(gradients, scenes.NAMES, strict=False):
        assert g.shape == getattr(gaussians, n).shape
        assert np.isfinite(g).all()


def test_gradient_descent_finds_a_moved_gaussian(torch, device):
    camera = scenes.camera(32, 32, fx=30.0)
    target = draw(device, scenes.gaussians([0.15, -0.1, 2.0], scales=0.2), camera)
    start = scenes.gaussians([0.0, 0.0, 2.0], scales=0.25).torch(device)
    start.means.requires_grad_()
    optimizer = torch.optim.Adam([start.means], lr=0.02)
    decay = torch.optim.lr_scheduler.ExponentialLR(optimizer, 0.97)
    goal = torch.from_numpy(target.color).to(device)
    for _ in range(150):
        optimizer.zero_grad()
        (v3dg.rasterize(start, camera).color - goal).square().sum().backward()
        optimizer.step()
        decay.step()
    x, y, depth = start.means.detach()[0].tolist()
    np.testing.assert_allclose([x / depth, y / depth], [0.075, -0.05], atol=0.001)
    # The gaussian is larger than the target, so it moves to where it looks equally
    # small.
    np.testing.assert_allclose(depth, 2.5, atol=0.05)


def draw_with_gsplat(gsplat, torch, inputs, camera, filter_px2, antialiased=False):
    """Return gsplat's colour, alpha and expected depth of the five inputs on the
    background."""
    view, K = (
        torch.tensor(m, dtype=torch.float32, device="cuda")[None]
        for m in (camera.viewmat, camera.K)
    )
    pictures, alpha, _ = gsplat.rasterization(
        *inputs[:5],
        view,
        K,
        camera.width,
        camera.height,
        near_plane=camera.near,
        eps2d=filter_px2,
        sh_degree=math.isqrt(inputs[4].shape[1]) - 1,
        rasterize_mode="antialiased" if antialiased else "classic",
        render_mode="RGB+ED",
    )
    color = pictures[0, ..., :3] + (1 - alpha[0]) * inputs[5]
    return color, alpha[0, ..., 0], pictures[0, ..., 3]


@pytest.mark.gpu
@pytest.mark.witness
@pytest.mark.filterwarnings("ignore")  # gsplat's imports cause warnings
@pytest.mark.parametrize("antialiased", [False, True])
@pytest.mark.parametrize("sh_degree", [0, 3])
def test_pictures_and_gradients_are_gsplats(torch, antialiased, sh_degree):
    gsplat = pytest.importorskip("gsplat")
    camera = scenes.camera(517, 389, fx=300.0, pose=scenes.pose(9))
    gaussians = scenes.random_gaussians(60, camera, 5000, size_px=(0.5, 20), sh_degree=sh_degree)
    mode = {"filter_px2": 0.3, "antialiased": antialiased}
    inputs = leaves(torch, gaussians, BACKGROUND, torch.float32, "cuda")
    ours = draw_leaves(inputs, camera, **mode)
    theirs = draw_with_gsplat(gsplat, torch, inputs, camera, **mode)
    for got, expected in zip((ours.color, ours.alpha), theirs[:2], strict=True):
        error = (got - expected).abs()
        # A contribution at the threshold of 1/255, or one at which a pixel stops, may
        # or may not be blended.
        assert error.max() < PICTURE_FLOAT.flip
        assert (error > 1e-3).float().mean() < 1e-3
    got = host(torch.autograd.grad(weighted_sum(torch, ours), inputs))
    expected = host(torch.autograd.grad(weighted_sum(torch, theirs), inputs))
    for name, g, e in zip(INPUTS, got, expected, strict=True):
        assert np.abs(e).max() > 0, name
        assert_gradients_agree(g, e, GRADIENT_GSPLAT)


# The same bits in every run and on every machine.

RUN = """
import sys
import numpy as np, scenes, v3dg
camera = scenes.camera(131, 97, fx=90.0, cx=60.0, cy=55.0, pose=scenes.pose(8))
gaussians = scenes.trained_like(20, camera, 1500)
out = []
for _ in range(2):
    raster = v3dg.rasterize(
        gaussians, camera, filter_px2=0.1, antialiased=True, background=(0.1, 0.2, 0.3))
    out.append([raster.color, raster.alpha, raster.depth])
if sys.argv[2] == "gradients":
    from test_rasterize import draw_leaves, leaves, weighted_sum
    import torch
    for arrays in out:
        inputs = leaves(torch, gaussians, (0.1, 0.2, 0.3), torch.float32)
        loss = weighted_sum(torch, draw_leaves(inputs, camera, filter_px2=0.1, antialiased=True))
        arrays += [g.numpy() for g in torch.autograd.grad(loss, inputs)]
for a, b in zip(*out):
    np.testing.assert_array_equal(a, b)
np.savez(sys.argv[1], *out[0])
"""


def run_elsewhere(path, what, **environment):
    """Return the arrays that RUN computes in a process of its own. Return None if the
    processor lacks the instructions."""
    done = subprocess.run(
        [sys.executable, "-c", RUN, str(path), what],
        env=TESTS_ENVIRONMENT | environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if "this processor does not support" in done.stderr:
        return None
    assert done.returncode == 0, done.stderr
    with np.load(path) as file:
        return [file[key] for key in file.files]


def test_number_of_threads_changes_nothing(torch, tmp_path):
    one, two, five = (
        run_elsewhere(tmp_path / f"{n}.npz", "gradients", OMP_NUM_THREADS=n)
        for n in ("1", "2", "5")
    )
    assert all(np.abs(a).max() > 0 for a in one)
    for a, b, c in zip(one, two, five, strict=True):
        np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(a, c)


@pytest.mark.parametrize("isa", ["baseline", "avx2", "avx512"])
def test_every_instruction_set_draws_the_reference(tmp_path, isa):
    arrays = run_elsewhere(tmp_path / "out.npz", "picture", V3DG_ISA=isa)
    if arrays is None:
        pytest.skip(f"this processor does not support {isa}")
    camera = scenes.camera(131, 97, fx=90.0, cx=60.0, cy=55.0, pose=scenes.pose(8))
    picture = reference.rasterize(
        scenes.trained_like(20, camera, 1500),
        camera,
        filter_px2=0.1,
        antialiased=True,
        background=(0.1, 0.2, 0.3),
    )
    assert_pictures_agree(v3dg.Image(*arrays), picture, NEEDLES_FLOAT)
