"""Every gaussian on every ray, in space, in float64."""

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
    mean_range: np.ndarray  # (R,) by blend weight, 0 where nothing is hit
    # Per ray, ordered by range: (K,3) range, blend weight, luma.
    contributions: list[np.ndarray]
    # (R,) smallest relative distance of an alpha to 1/255: below a band, rounding may
    # decide otherwise than float64 does.
    cutoff_distance: np.ndarray


def cast(
    gaussians, eye, directions, *, filters_rad2=0.0, antialiased=False, near=0.01, far=np.inf
) -> Rays:
    """Blend on each ray (R,3), unit vectors in the world, the largest values of the
    gaussians, ordered by their distances.

    The filter adds its variance times the squared distance of the mean to the
    covariance; compensated opacities keep the integral over the plane across the mean.
    """
    means = gaussians.means.astype(np.float64) - eye
    distance2 = (means**2).sum(axis=1)
    axes = rotation(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    covariances = axes @ axes.transpose(0, 2, 1)
    filtered = covariances + (filters_rad2 * distance2)[:, None, None] * np.eye(3)
    opacities = gaussians.opacities.astype(np.float64)
    before = _across(covariances, means)
    after = _across(filtered, means)
    opacities = np.where(antialiased, opacities * np.sqrt(before / after), opacities)
    precisions = np.linalg.inv(filtered)
    toward_mean = np.einsum("nij,nj->ni", precisions, means)
    above = directions @ toward_mean.T
    below = np.einsum("ri,nij,rj->rn", directions, precisions, directions)
    ranges = above / below
    offsets = ranges[:, :, None] * directions[:, None] - means
    square = np.einsum("rni,nij,rnj->rn", offsets, precisions, offsets)
    alphas = opacities * np.exp(-0.5 * square)
    colors = reference_sh.color(gaussians.sh, means)
    is_hit = (alphas >= ALPHA_MIN) & (ranges >= near) & (ranges <= far)
    cutoff = np.abs(alphas / ALPHA_MIN - 1).min(axis=1)
    alphas = np.minimum(alphas, ALPHA_MAX)
    result = Rays(
        np.zeros((len(directions), 3)),
        np.zeros(len(directions)),
        np.zeros(len(directions)),
        [],
        cutoff,
    )
    for ray in range(len(directions)):
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


def _across(covariances, means):
    """Determinants of the covariances, projected along the directions of the means."""
    unit = means / np.linalg.norm(means, axis=1, keepdims=True)
    first = np.cross(unit, np.eye(3)[np.argmin(np.abs(unit), axis=1)])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    plane = np.stack([first, np.cross(unit, first)], axis=1)
    return np.linalg.det(plane @ covariances @ plane.transpose(0, 2, 1))


def returns(contributions, detection, gap, count=2):
    """(count,3) range, weight and intensity of each layer of a ray."""
    layers = np.tile([np.inf, 0, 0], (count, 1))
    rest = contributions
    for k in range(count):
        detected = np.flatnonzero(np.cumsum(rest[:, 1]) >= detection)
        if not len(detected):
            break
        is_in = rest[:, 0] <= rest[detected[0], 0] + gap
        layer = rest[is_in]
        weight = layer[:, 1].sum()
        median = np.argmax(np.cumsum(layer[:, 1]) >= 0.5 * weight)
        layers[k] = layer[median, 0], weight, layer[:, 1] @ layer[:, 2]
        rest = rest[~is_in]
    return layers
