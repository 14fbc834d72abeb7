"""The length of a quaternion has no effect: forward, backward, in scenes and in
files."""

import numpy as np
import pytest

import hard_cases
import scenes
import v3dg
from devices import host, on
from v3dg.rotations import normalised
from v3dg.viewer.view import View

# Products with powers of two are exact, even if few bits are left.
QUATS = np.array([[5, -3, 7, 2], [1, 6, -2, 4], [-7, 1, 0, 3], [0, 0, 5, 4]], np.float32) / 8
EXPONENTS = (-125, -110, -86, -70, -64, -50, -41, -39, 39, 41, 49, 52, 63, 66, 100, 126)


def crowd_turned_by(factor):
    """Return ordinary gaussians that are rotated by QUATS times `factor`."""
    num = hard_cases.NUM
    return hard_cases.crowd(5, quats=np.float32(factor) * np.resize(QUATS, (num, 4)))


def planes_of(gaussians, device, mode):
    image = v3dg.rasterize(on(device, gaussians), hard_cases.PLAIN, **mode)
    return host((image.color, image.alpha, image.depth))


@pytest.mark.parametrize("mode", [{}, hard_cases.ANTIALIASED], ids=["plain", "antialiased"])
@pytest.mark.parametrize("exponent", EXPONENTS)
def test_length_changes_no_bit_of_a_picture(device, exponent, mode):
    if device == "cuda" and exponent < -120:
        pytest.skip("kernels take the denormal components as 0 (docs/numerics.md)")
    expected = planes_of(crowd_turned_by(1), device, mode)
    got = planes_of(crowd_turned_by(2.0**exponent), device, mode)
    assert expected[1].any()
    for e, g in zip(expected, got, strict=True):
        np.testing.assert_array_equal(g, e)


def test_denormal_quaternions_turn_on_the_cpu():
    expected = planes_of(crowd_turned_by(1), "cpu", {})
    got = planes_of(crowd_turned_by(2.0**-146), "cpu", {})
    for e, g in zip(expected, got, strict=True):
        np.testing.assert_array_equal(g, e)


def gradients_at(exponent, dtype, device):
    case = hard_cases.HardCase("", crowd_turned_by(2.0**exponent), mode=hard_cases.FILTER)
    return hard_cases.gradients(case, hard_cases.draw_core, dtype, device)


@pytest.mark.parametrize("exponent", [e for e in EXPONENTS if abs(e) <= 100])
def test_gradients_grow_as_one_over_the_length(device, exponent):
    torch = pytest.importorskip("torch")
    expected = gradients_at(0, torch.float32, device)
    got = gradients_at(exponent, torch.float32, device)
    expected[1] = expected[1] * 2.0**-exponent
    assert expected[1].any()
    for name, e, g in zip(scenes.NAMES, expected, got, strict=True):
        # Values below the smallest normal number are rounded to subnormal numbers.
        np.testing.assert_allclose(g, e, rtol=1e-6, atol=1e-37, err_msg=name)


@pytest.mark.parametrize("exponent", [-125, 126])
def test_gradients_of_the_shortest_and_longest_are_finite(device, exponent):
    torch = pytest.importorskip("torch")
    assert all(
        np.isfinite(gradient).all() for gradient in gradients_at(exponent, torch.float32, device)
    )


@pytest.mark.parametrize("exponent", [-900, -500, -310, 360, 500, 900])
def test_length_changes_no_bit_in_double(exponent):
    torch = pytest.importorskip("torch")
    usual = scenes.doubles(crowd_turned_by(1), torch=torch)
    other = scenes.doubles(crowd_turned_by(1), torch=torch)
    other.quats = other.quats * 2.0**exponent
    expected = v3dg.rasterize(usual, hard_cases.PLAIN)
    got = v3dg.rasterize(other, hard_cases.PLAIN)
    np.testing.assert_array_equal(got.color, expected.color)


@pytest.mark.parametrize("exponent", [-1050, -600, -290, 340, 600, 1000])
def test_transform_does_not_depend_on_the_length(exponent):
    asset = hard_cases.crowd(5, sh_degree=2)
    quaternion = np.array([5.0, -3.0, 7.0, 2.0]) / 8
    expected = asset.transform(normalised(quaternion), (1, 2, 3), 2.0)
    got = asset.transform(np.ldexp(quaternion, exponent), (1, 2, 3), 2.0)
    for name in ("means", "scales", "sh"):
        np.testing.assert_allclose(
            getattr(got, name), getattr(expected, name), rtol=1e-6, atol=1e-6
        )
    np.testing.assert_allclose(normalised(got.quats), normalised(expected.quats), atol=1e-6)


@pytest.mark.parametrize("factor", [1e-38, 3e38 / 7])
def test_turned_gaussians_keep_rotations_of_any_length(factor):
    asset = crowd_turned_by(1)
    other = scenes.replaced(asset, quats=asset.quats * np.float32(factor))
    expected = asset.transform((0.6, 0.0, 0.8, 0.0))
    got = other.transform((0.6e-3, 0.0, 0.8e-3, 0.0))
    np.testing.assert_allclose(normalised(got.quats), normalised(expected.quats), atol=1e-6)


@pytest.mark.parametrize(
    ("quaternion", "is_drawn"),
    [
        ((1e-200, 2e-200, 0, 0), True),
        ((1e200, 2e200, 0, 0), True),
        ((5e-324, 0, 0, 0), True),
        ((1.7e308, 1.7e308, 1.7e308, 0), True),
        ((0, 0, 0, 0), False),
        ((np.nan, 0, 0, 1), False),
        ((np.inf, 0, 0, 1), False),
    ],
)
def test_instances_are_placed_unless_zero_or_not_finite(quaternion, is_drawn):
    asset = scenes.gaussians([[0.0, 0.0, 0.0]], scales=0.3)
    scene = v3dg.Scene.of(v3dg.build_bundle(asset, device="cpu", progress=False))
    camera = v3dg.Camera.look_at((0, -3, 0), (0, 0, 0), width=32, height=32)
    # Poses on a CUDA device are not checked before they are drawn.
    scene._state = scene._state._replace(quaternions=np.array([quaternion], np.float64))
    image = v3dg.render(scene, camera, tolerance=0.0, device="cpu")
    assert (image.alpha.max() > 0.5) == is_drawn


def test_normalised_is_of_length_one_at_any_length():
    rows = np.array([[3.0, 0.0, 0.0, 4.0]]) * np.array(
        [[1.0], [1e-300], [1e-320], [1e300], [4e307], [1e-150]]
    )
    unit = normalised(rows)
    np.testing.assert_allclose(unit, np.tile([0.6, 0.0, 0.0, 0.8], (6, 1)), rtol=1e-3)
    np.testing.assert_allclose(np.linalg.norm(unit, axis=1), 1.0, rtol=1e-15)


def test_normalised_keeps_zeros_and_says_what_is_not_finite():
    unit = normalised(np.array([[0.0, 0, 0, 0], [np.nan, 1, 0, 0], [np.inf, 1, 0, 0]]))
    assert not unit[0].any()
    assert np.isnan(unit[1:]).any(axis=1).all()


@pytest.mark.parametrize("factor", [1e-200, 1e200])
def test_views_of_any_length_look_the_same_way(factor):
    wxyz = np.array([0.5, -0.1, 0.7, 0.2])
    expected = View(tuple(wxyz.tolist()), (0.0, 0.0, 0.0), 0.8, 1.0).camera(8, 8, 0.1)
    got = View(tuple((wxyz * factor).tolist()), (0.0, 0.0, 0.0), 0.8, 1.0).camera(8, 8, 0.1)
    np.testing.assert_allclose(got.viewmat, expected.viewmat, rtol=0, atol=1e-14)


def test_text_files_may_hold_doubles_of_any_length(tmp_path):
    names = ("x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity")
    names += ("scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
    header = [
        "ply",
        "format ascii 1.0",
        "element vertex 2",
        *(f"property double {name}" for name in names),
    ]
    rows = ["0 0 0 0 0 0 0 0 0 0 3e-200 0 0 4e-200", "0 0 0 0 0 0 0 0 0 0 3e200 0 0 4e200"]
    (tmp_path / "doubles.ply").write_text("\n".join([*header, "end_header", *rows, ""]))
    quats = v3dg.read_asset(tmp_path / "doubles.ply").quats
    np.testing.assert_array_equal(quats, np.float32([[0.6, 0, 0, 0.8]] * 2))
