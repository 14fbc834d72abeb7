"""Blends every gaussian on every ray in float64, with its largest value on the ray in
3D."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reference import sh as reference_sh
from reference.project import rotation

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4
LUMA = np.array([0.2126, 0.7152, 0.0722])


@dataclass(frozen=True)
class Rays:
    color: np.ndarray  # (R,3) premultiplied
    alpha: np.ndarray  # (R,)
    # (R,) mean range, weighted by blend weight; 0 where nothing is hit
    mean_range: np.ndarray
    # For each ray (K,3): range, blend weight and luma, ordered by range.
    contributions: list[np.ndarray]
    # (R,) smallest relative distance of an alpha to 1/255. If it is small, rounding may
    # decide differently than in float64.
    cutoff_distance: np.ndarray


def cast(
    gaussians, eye, directions, *, filters_rad2=0.0, antialiased=False, near=0.01, far=np.inf
) -> Rays:
    """Blend gaussians on rays (R,3), which are unit vectors in the world. Each gaussian
    has its largest value on the ray; gaussians are ordered by the distances of these
    values."""
    means = gaussians.means.astype(np.float64) - eye
    covariances, opacities = _filtered(gaussians, means, filters_rad2, antialiased)
    alphas, ranges = _largest(means, covariances, opacities, directions)
    colors = reference_sh.color(gaussians.sh, means)
    is_hit = (alphas >= ALPHA_MIN) & (ranges >= near) & (ranges <= far)
    num_rays = len(directions)
    result = Rays(
        color=np.zeros((num_rays, 3)),
        alpha=np.zeros(num_rays),
        mean_range=np.zeros(num_rays),
        contributions=[],
        cutoff_distance=np.abs(alphas / ALPHA_MIN - 1).min(axis=1),
    )
    alphas = np.minimum(alphas, ALPHA_MAX)
    for ray in range(num_rays):
        hit = np.flatnonzero(is_hit[ray])
        hit = hit[np.argsort(ranges[ray, hit], kind="stable")]
        passed = np.concatenate([[1.0], np.cumprod(1 - alphas[ray, hit])])
        count = np.argmax(np.append(passed[1:] < TRANSMITTANCE_MIN, True)) + 1
        hit = hit[:count]
        weights = passed[: len(hit)] * alphas[ray, hit]
        result.color[ray] = weights @ colors[hit]
        result.alpha[ray] = weights.sum()
        if len(hit):
            result.mean_range[ray] = weights @ ranges[ray, hit] / weights.sum()
        luma = colors[hit] @ LUMA
        result.contributions.append(np.column_stack([ranges[ray, hit], weights, luma]))
    return result


def _filtered(gaussians, means, filters_rad2, antialiased):
    """Return covariances and opacities with a filter. The filter adds its variance
    multiplied by the squared distance of the mean. Compensated opacities preserve the
    integral over the plane through the mean that is perpendicular to the view
    direction."""
    axes = rotation(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    covariances = axes @ axes.transpose(0, 2, 1)
    variances = filters_rad2 * (means**2).sum(axis=1)
    filtered = covariances + variances[:, None, None] * np.eye(3)
    opacities = gaussians.opacities.astype(np.float64)
    share = np.sqrt(_across(covariances, means) / _across(filtered, means))
    return filtered, np.where(antialiased, opacities * share, opacities)


def _largest(means, covariances, opacities, directions):
    """Return the largest alphas (R,N) on rays, and the distances at which they are
    reached."""
    precisions = np.linalg.inv(covariances)
    forward = directions @ np.einsum("nij,nj->ni", precisions, means).T
    ranges = forward / np.einsum("ri,nij,rj->rn", directions, precisions, directions)
    offsets = ranges[:, :, None] * directions[:, None] - means
    square = np.einsum("rni,nij,rnj->rn", offsets, precisions, offsets)
    return opacities * np.exp(-0.5 * square), ranges


def _across(covariances, means):
    """Return the determinants of the covariances after projection along the directions
    of the means."""
    unit = means / np.linalg.norm(means, axis=1, keepdims=True)
    first = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    plane = np.stack([first, np.cross(unit, first)], axis=1)
    return np.linalg.det(plane @ covariances @ plane.transpose(0, 2, 1))


def returns(contributions, detection, gap, count=2):
    """Return (count,3) the range, weight and intensity of each layer of a ray."""
    layers = np.tile([np.inf, 0, 0], (count, 1))
    remaining = contributions
    for k in range(count):
        detected = np.flatnonzero(np.cumsum(remaining[:, 1]) >= detection)
        if not len(detected):
            break
        is_in = remaining[:, 0] <= remaining[detected[0], 0] + gap
        layer = remaining[is_in]
        weight = layer[:, 1].sum()
        median = np.argmax(np.cumsum(layer[:, 1]) >= 0.5 * weight)
        layers[k] = layer[median, 0], weight, layer[:, 1] @ layer[:, 2]
        remaining = remaining[~is_in]
    return layers
