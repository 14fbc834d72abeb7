"""Draws the same pictures as rasterize.py with torch operations in float64, so that
autograd provides the gradients."""

from __future__ import annotations

import math

import torch


def _rotation(quats):
    w, x, y, z = torch.nn.functional.normalize(quats, dim=1, eps=1e-100).unbind(1)
    zero = torch.zeros_like(w)
    # With v the vector part of the quaternion: R = I + 2 w [v] + 2 [v]^2
    v = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=1).reshape(-1, 3, 3)
    return torch.eye(3, dtype=quats.dtype) + 2 * w[:, None, None] * v + 2 * v @ v


def _sh_basis(directions, degree):
    x, y, z = torch.nn.functional.normalize(directions, dim=1).unbind(1)
    one = torch.ones_like(x)
    bands = [[one / 2]]
    if degree >= 1:
        bands.append([-(3**0.5) / 2 * y, 3**0.5 / 2 * z, -(3**0.5) / 2 * x])
    if degree >= 2:
        r15, r5 = 15**0.5 / 2, 5**0.5 / 4
        bands.append(
            [
                r15 * x * y,
                -r15 * y * z,
                r5 * (3 * z * z - 1),
                -r15 * x * z,
                r15 / 2 * (x * x - y * y),
            ]
        )
    if degree >= 3:
        r70, r105, r42, r7 = 70**0.5 / 8, 105**0.5 / 2, 42**0.5 / 8, 7**0.5 / 4
        bands.append(
            [
                -r70 * y * (3 * x * x - y * y),
                r105 * x * y * z,
                -r42 * y * (5 * z * z - 1),
                r7 * z * (5 * z * z - 3),
                -r42 * x * (5 * z * z - 1),
                r105 / 2 * z * (x * x - y * y),
                -r70 * x * (x * x - 3 * y * y),
            ]
        )
    return torch.stack([f for band in bands for f in band], dim=1) / math.sqrt(math.pi)


def project(means, quats, scales, sh, camera, filter_px2=0.0, plain_colors=False):
    """Return (N,2) means in px; (N,4) covariances in px² as xx, xy, yy and the
    determinant; depths and compensations (N,); colours (N,3)."""
    viewmat = torch.as_tensor(camera.viewmat, dtype=torch.float64)
    rotate, eye = viewmat[:3, :3], torch.as_tensor(camera.position, dtype=torch.float64)
    view = means @ rotate.T + viewmat[:3, 3]
    depth = view[:, 2]
    image, rows = [], []
    toward_view = rotate @ _rotation(quats) * scales[:, None, :]
    for axis, focal, center, size in (
        (0, camera.fx, camera.cx, camera.width),
        (1, camera.fy, camera.cy, camera.height),
    ):
        slope = view[:, axis] / depth
        image.append(focal * slope + center)
        beyond = 0.15 * size / focal
        bounded = slope.clamp(-center / focal - beyond, (size - center) / focal + beyond)
        rows.append(
            focal / depth[:, None] * (toward_view[:, axis] - bounded[:, None] * toward_view[:, 2])
        )
    a, b, c = ((rows[i] * rows[j]).sum(1) for i, j in ((0, 0), (0, 1), (1, 1)))
    # Sums of positive terms keep the digits of needles.
    normal = torch.linalg.cross(*rows)
    sharp = (normal * normal).sum(1)
    blurred = sharp + filter_px2 * (a + c) + filter_px2**2
    a, c = a + filter_px2, c + filter_px2
    compensation = (sharp / blurred).sqrt()
    colors = sh[:, 0]
    if not plain_colors:
        basis = _sh_basis(means - eye, math.isqrt(sh.shape[1]) - 1)
        colors = ((basis[:, :, None] * sh).sum(1) + 0.5).clamp(min=0)
    return (
        torch.stack(image, dim=1),
        torch.stack([a, b, c, blurred], dim=1),
        depth,
        compensation,
        colors,
    )


def rasterize(
    means,
    quats,
    scales,
    opacities,
    sh,
    background,
    camera,
    *,
    filter_px2=0.0,
    antialiased=False,
    plain_colors=False,
):
    """Return colour (H,W,3), alpha (H,W) and expected depth (H,W), differentiable by
    the first six arguments."""
    image, covariance, depth, compensation, colors = project(
        means, quats, scales, sh, camera, filter_px2, plain_colors
    )
    if antialiased:
        opacities = opacities * compensation
    a, b, _, determinant = covariance.unbind(1)

    f64 = torch.float64
    height, width = camera.height, camera.width
    v, u = torch.meshgrid(
        torch.arange(height, dtype=f64) + 0.5, torch.arange(width, dtype=f64) + 0.5, indexing="ij"
    )
    transmittance = torch.ones(height, width, dtype=f64)
    is_open = torch.ones(height, width, dtype=torch.bool)
    color = torch.zeros(height, width, 3, dtype=f64)
    depth_sum = torch.zeros(height, width, dtype=f64)
    for i in torch.argsort(depth.detach(), stable=True).tolist():
        if depth[i] < camera.near:
            continue
        du, dv = u - image[i, 0], v - image[i, 1]
        across = a[i] * dv - b[i] * du
        power = -0.5 * (du * du / a[i] + across * across / (a[i] * determinant[i]))
        alpha = (opacities[i] * power.exp()).clamp(max=0.999)
        left = transmittance * (1 - alpha)
        counts = is_open & (alpha.detach() >= 1 / 255)
        is_open = is_open & ~(counts & (left.detach() <= 1e-4))
        blends = counts & is_open
        weight = torch.where(blends, transmittance * alpha, 0.0)
        color = color + weight[..., None] * colors[i]
        depth_sum = depth_sum + weight * depth[i]
        transmittance = torch.where(blends, left, transmittance)
    alpha = 1 - transmittance
    drawn = alpha.detach() > 0
    expected = torch.where(drawn, depth_sum / torch.where(drawn, alpha, 1.0), 0.0)
    return color + transmittance[..., None] * background, alpha, expected
