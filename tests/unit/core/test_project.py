import numpy as np
import pytest

import scenes
import v3dg
from compare import PROJECTION_DOUBLE, assert_close
from golden import make_golden
from reference import project as reference_project
from reference import rasterize as reference_rasterize
from reference import sh as reference_sh
from v3dg import Gaussians

GOLDEN = np.load(make_golden.PATH)
CAMERAS = pytest.mark.parametrize("name", scenes.CAMERAS)
FILTERS = pytest.mark.parametrize("filter_px2", make_golden.FILTERS_PX2)


def golden(name):
    """Return the gaussians, the camera and gsplat's results of one golden scene."""
    answers = {key.split("/")[1]: GOLDEN[key] for key in GOLDEN.files if key.startswith(name + "/")}
    gaussians = Gaussians(*(answers.pop(key) for key in scenes.NAMES))
    return gaussians, scenes.CAMERAS[name], answers


def conics(covariance_px2):
    inverse = np.linalg.inv(covariance_px2)
    return np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]], axis=1)


@CAMERAS
@FILTERS
def test_reference_projects_like_gsplat(name, filter_px2):
    gaussians, camera, gsplat = golden(name)
    ours = reference_project.project(gaussians, camera, filter_px2=filter_px2)
    assert ours.is_drawable.all()
    assert_close(ours.mean_px, gsplat["mean_px"], PROJECTION_DOUBLE)
    assert_close(ours.depth, gsplat["depth"], PROJECTION_DOUBLE)
    assert_close(conics(ours.covariance_px2), gsplat[f"conic_{filter_px2}"], PROJECTION_DOUBLE)
    assert_close(ours.compensation, gsplat[f"compensation_{filter_px2}"], PROJECTION_DOUBLE)


@CAMERAS
@pytest.mark.parametrize("degree", range(4))
def test_reference_colors_like_gsplat(name, degree):
    gaussians, camera, gsplat = golden(name)
    ours = reference_sh.color(gaussians.sh, gaussians.means - camera.position, degree)
    assert_close(ours, gsplat[f"color_{degree}"], PROJECTION_DOUBLE)


def test_golden_scenes_reach_the_clamped_jacobian():
    beyond = 0
    for name, camera in scenes.CAMERAS.items():
        gsplat = golden(name)[2]
        slope = (gsplat["mean_px"] - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        margin = 0.15 * np.array([camera.width, camera.height]) / [camera.fx, camera.fy]
        edge = np.array([[0, 0], [camera.width, camera.height]]) - [camera.cx, camera.cy]
        edge = edge / [camera.fx, camera.fy]
        beyond += ((slope < edge[0] - margin) | (slope > edge[1] + margin)).any(axis=1).sum()
    assert beyond >= 10


@CAMERAS
@pytest.mark.parametrize("antialiased", [False, True])
@FILTERS
def test_one_gaussian_draws_the_ellipse_that_gsplat_projects(name, antialiased, filter_px2):
    torch = pytest.importorskip("torch")
    gaussians, camera, gsplat = golden(name)
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    covered = 0
    for i in range(len(gaussians)):
        dx, dy = x - gsplat["mean_px"][i, 0], y - gsplat["mean_px"][i, 1]
        a, b, c = gsplat[f"conic_{filter_px2}"][i]
        opacity = float(gaussians.opacities[i])
        if antialiased:
            opacity *= gsplat[f"compensation_{filter_px2}"][i]
        falloff = opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
        alpha = np.where(falloff >= reference_rasterize.ALPHA_MIN, np.minimum(falloff, 0.999), 0)
        one = scenes.doubles(gaussians.subset(slice(i, i + 1)), torch=torch)
        raster = v3dg.rasterize(one, camera, filter_px2=filter_px2, antialiased=antialiased)
        clear = np.abs(falloff * 255 - 1) > 1e-6
        assert_close(raster.alpha.numpy()[clear], alpha[clear], PROJECTION_DOUBLE)
        color = alpha[..., None] * gsplat["color_3"][i]
        assert_close(raster.color.numpy()[clear], color[clear], PROJECTION_DOUBLE)
        depth = np.where(alpha > 0, gsplat["depth"][i], 0)
        assert_close(raster.depth.numpy()[clear], depth[clear], PROJECTION_DOUBLE)
        covered += (alpha > 0).sum()
    assert covered > 0


@CAMERAS
def test_torch_reference_has_the_gradients_of_gsplat(name):
    torch = pytest.importorskip("torch")
    from reference import rasterize_torch

    gaussians, camera, gsplat = golden(name)
    g = scenes.doubles(gaussians, torch=torch, requires_grad=True)
    values = []
    for filter_px2 in make_golden.FILTERS_PX2:
        mean_px, covariance, depth, compensation, _ = rasterize_torch.project(
            g.means, g.quats, g.scales, g.sh, camera, filter_px2
        )
        a, b, c, _ = covariance.unbind(1)
        conic = torch.stack([c, -b, a], dim=1) / (a * c - b * b)[:, None]
        values += [conic, compensation]
    values += [mean_px, depth]
    for bases in (1, 4, 9, 16):
        truncated = torch.cat([g.sh[:, :bases], torch.zeros_like(g.sh[:, bases:])], dim=1)
        values.append(rasterize_torch.project(g.means, g.quats, g.scales, truncated, camera)[4])
    loss = sum((v * torch.from_numpy(make_golden.weights(v.shape))).sum() for v in values)
    gradients = torch.autograd.grad(loss, (g.means, g.quats, g.scales, g.sh))
    for key, ours in zip(("d_means", "d_quats", "d_scales", "d_sh"), gradients, strict=True):
        assert np.abs(gsplat[key]).max() > 0
        assert_close(ours.numpy(), gsplat[key], PROJECTION_DOUBLE)


@pytest.mark.witness
@CAMERAS
def test_golden_file_is_what_gsplat_says(name):
    pytest.importorskip("torch")
    gsplat = make_golden.load_gsplat()
    if gsplat is None:
        pytest.skip("gsplat is not installed: pip install --no-deps gsplat==1.5.3")
    gaussians, camera, stored = golden(name)
    for key, value in make_golden.evaluate(gsplat, gaussians, camera).items():
        assert_close(value, stored[key], PROJECTION_DOUBLE)


def test_reference_harmonics_are_orthonormal():
    # This quadrature, Gauss-Legendre in z and uniform in the angle, is exact for
    # products of degree 3.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = 2 * np.pi * np.arange(16) / 16
    radius = np.sqrt(1 - z * z)[:, None]
    directions = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.broadcast_to(z[:, None], (8, 16))],
        axis=2,
    )
    basis = reference_sh.basis(directions.reshape(-1, 3), 3).reshape(8, 16, 16)
    gram = np.einsum("z,zak,zal->kl", weight, basis, basis) * 2 * np.pi / 16
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-14)


def test_reference_rotation_is_right_handed():
    quarter_about_z = np.array([[np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)]])
    np.testing.assert_allclose(
        reference_project.rotation(3 * quarter_about_z)[0] @ [1, 0, 0], [0, 1, 0], atol=1e-15
    )
