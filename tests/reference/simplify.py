"""The gaussians at which fits of coarser clusters start, in float64: the survivors of
pruning, and merged pairs."""

from __future__ import annotations

import itertools
from types import SimpleNamespace

import numpy as np

from reference import project as reference_project

# Y_00 converts the first SH coefficient to a colour.
CONSTANT_BASIS = 0.5 / np.sqrt(np.pi)
# The weight of a difference in colour relative to a distance in units of the spacing of
# the remaining gaussians.
COLOR_WEIGHT = 6.0


def survivors(gaussians, wanted: int) -> list[int]:
    """Return the gaussians that survive pruning (V3DG, section 3.2, as in its published
    code): from each octant around the medians, its share of the gaussians with the
    highest opacity and size."""
    count = len(gaussians)
    scales = gaussians.scales.astype(np.float64)
    score = gaussians.opacities * np.prod(scales, axis=1) ** (2 / 3)
    medians = np.sort(gaussians.means, axis=0)[(count - 1) // 2]
    octant = (gaussians.means >= medians) @ np.array([4, 2, 1])
    kept = []
    num_before = 0
    for number in range(8):
        rows = [int(i) for i in np.flatnonzero(octant == number)]
        end = num_before + len(rows)
        share = end * wanted // count - num_before * wanted // count
        kept += sorted(rows, key=lambda i: (-score[i], i))[:share]
        num_before = end
    return sorted(kept)


def area(scales) -> np.ndarray:
    """Return the surface area of an ellipsoid divided by 4 pi, computed as the weighted
    mean area of its shadows along 13 directions."""
    directions = [d for d in itertools.product([-1, 0, 1], repeat=3) if d > (0, 0, 0)]
    weights = {1: 0.0604247, 2: 0.1013528 / 2, 3: 0.5029995 / 4}
    a, b, c = np.moveaxis(np.asarray(scales, np.float64), -1, 0)
    pairs = np.stack([b * c, a * c, a * b], axis=-1) ** 2
    return sum(
        weights[int(np.abs(d).sum())] * np.sqrt(pairs @ np.square(d) / np.abs(d).sum())
        for d in directions
    )


def covariances(gaussians) -> np.ndarray:
    """Return the covariances (N, 3, 3)."""
    axes = (
        reference_project.rotation(gaussians.quats)
        * gaussians.scales.astype(np.float64)[:, None, :]
    )
    return axes @ axes.transpose(0, 2, 1)


def moments(gaussians) -> SimpleNamespace:
    """Return sums over gaussians of 1, the mean, its square plus the covariance, and
    SH, weighted by opacity times area."""
    weight = gaussians.opacities * area(gaussians.scales)
    means = gaussians.means.astype(np.float64)
    second = covariances(gaussians) + means[:, :, None] * means[:, None, :]
    return SimpleNamespace(
        weight=weight.sum(),
        mean=weight @ means,
        second=np.einsum("n,nij->ij", weight, second),
        sh=np.einsum("n,nkc->kc", weight, gaussians.sh.astype(np.float64)),
    )


def merged(gaussians) -> SimpleNamespace:
    """Return one gaussian with the total moments. Its opacity preserves the sum of area
    times opacity."""
    m = moments(gaussians)
    mean = m.mean / m.weight
    covariance = m.second / m.weight - np.outer(mean, mean)
    scales = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance), 0))
    return SimpleNamespace(
        mean=mean,
        covariance=covariance,
        opacity=min(1.0, m.weight / area(scales)),
        sh=m.sh / m.weight,
    )


def cheapest_pair(gaussians) -> tuple[int, int]:
    """Return the pair that is joined if one gaussian must be merged."""
    count = len(gaussians)
    weight = gaussians.opacities * area(gaussians.scales)
    means = gaussians.means.astype(np.float64)
    colors = CONSTANT_BASIS * gaussians.sh[:, 0].astype(np.float64)
    extent2 = np.sum((means.max(axis=0) - means.min(axis=0)) ** 2)
    costs = {}
    for i in range(count):
        for k in range(i + 1, count):
            place = np.sum((means[i] - means[k]) ** 2) * (count - 1) / extent2
            color = np.sum((colors[i] - colors[k]) ** 2)
            harmonic = weight[i] * weight[k] / (weight[i] + weight[k])
            costs[i, k] = harmonic * (place + COLOR_WEIGHT * color)
    return min(costs, key=lambda pair: (costs[pair], pair))
