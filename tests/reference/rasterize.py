"""Evaluates every gaussian at every pixel, front to back, in float64."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from reference import sh as reference_sh
from reference.project import project

ALPHA_MIN = 1 / 255
ALPHA_MAX = 0.999
TRANSMITTANCE_MIN = 1e-4


@dataclass(frozen=True)
class Picture:
    color: np.ndarray  # (H,W,3) with the background
    alpha: np.ndarray  # (H,W)
    depth: np.ndarray  # (H,W) expected depth, 0 where nothing is drawn
    num_blended: np.ndarray  # (H,W) number of gaussians that contributed
    is_stopped: np.ndarray  # (H,W) whether the pixel has stopped
    # (H,W) smallest relative distance of an alpha to 1/255, of a transmittance to the
    # value at which a pixel stops, or of an unclamped alpha to 0.999. Within a band
    # around 0, rounding may decide differently than float64.
    cutoff_distance: np.ndarray
    clamp_distance: np.ndarray
    contribution: np.ndarray  # (N,) sum of weights over all pixels


def rasterize(
    gaussians,
    camera,
    *,
    filter_px2=0.0,
    antialiased=False,
    background=(0.0, 0.0, 0.0),
    sh_degree=None,
    min_transmittance=None,
) -> Picture:
    """Draw gaussians. A pixel stops before the gaussian that would reduce its
    transmittance below TRANSMITTANCE_MIN. If `min_transmittance` is given, a pixel
    stops after the gaussian that reduces it below this value, and the remaining light
    is given to the blended gaussians."""
    stop = TRANSMITTANCE_MIN if min_transmittance is None else min_transmittance
    projection = project(gaussians, camera, filter_px2=filter_px2)
    colors = reference_sh.color(
        gaussians.sh, np.asarray(gaussians.means) - camera.position, sh_degree
    )
    opacities = np.asarray(gaussians.opacities, np.float64)
    if antialiased:
        opacities = opacities * projection.compensation

    height, width = camera.height, camera.width
    y, x = np.mgrid[:height, :width] + 0.5
    color = np.zeros((height, width, 3))
    weighted_depth = np.zeros((height, width))
    transmittance = np.ones((height, width))
    is_open = np.ones((height, width), bool)
    num_blended = np.zeros((height, width), int)
    cutoff_distance = np.full((height, width), np.inf)
    clamp_distance = np.full((height, width), np.inf)
    contribution = np.zeros(len(opacities))

    for i in np.argsort(projection.depth, kind="stable"):
        if not projection.is_drawable[i] or not opacities[i] > 0:
            continue
        if not is_open.any():
            break
        a, b = projection.covariance_px2[i][0]
        dx, dy = x - projection.mean_px[i, 0], y - projection.mean_px[i, 1]
        # Written as a sum of squares (Cholesky), the exponent of a needle is never
        # positive because of rounding.
        along = dx * dx / a
        across = (a * dy - b * dx) ** 2 / (a * projection.determinant[i])
        falloff = opacities[i] * np.exp(-0.5 * (along + across))
        alpha = np.minimum(ALPHA_MAX, falloff)
        left = transmittance * (1 - alpha)

        counts = is_open & (alpha >= ALPHA_MIN)
        distance = np.abs(falloff / ALPHA_MIN - 1)
        if stop > 0:
            distance = np.where(counts, np.minimum(distance, np.abs(left / stop - 1)), distance)
        cutoff_distance = np.where(is_open, np.minimum(cutoff_distance, distance), cutoff_distance)
        clamp_distance = np.where(
            is_open, np.minimum(clamp_distance, np.abs(falloff / ALPHA_MAX - 1)), clamp_distance
        )

        stops = counts & (left <= stop)
        is_open &= ~stops
        blends = counts if min_transmittance is not None else counts & ~stops
        weight = np.where(blends, transmittance * alpha, 0.0)
        color += weight[..., None] * colors[i]
        weighted_depth += weight * projection.depth[i]
        contribution[i] = weight.sum()
        transmittance = np.where(blends, left, transmittance)
        num_blended += blends

    blended = 1 - transmittance
    depth = np.divide(weighted_depth, blended, out=np.zeros_like(blended), where=blended > 0)
    if min_transmittance is not None:
        filled = ~is_open & (transmittance > 0)
        color[filled] /= blended[filled][:, None]
        transmittance[filled] = 0
    alpha = 1 - transmittance
    color = color + transmittance[..., None] * np.asarray(background, np.float64)
    return Picture(
        color, alpha, depth, num_blended, ~is_open, cutoff_distance, clamp_distance, contribution
    )
