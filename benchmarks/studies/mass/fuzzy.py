"""Random assets of thin or faint gaussians, whose levels are the first to lose alpha
and colour."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

import v3dg

Floats = npt.NDArray[np.float64]

_SH_CONSTANT = 0.28209479177387814  # the value of the SH function of degree 0


def make_cloud() -> v3dg.Gaussians:
    """3,000 faint round gaussians."""
    rng = np.random.default_rng(1)
    count = 3_000
    means = rng.normal(size=(count, 3))
    scales = rng.uniform(0.03, 0.1, (count, 1)) * rng.uniform(0.4, 1, (count, 3))
    colors = rng.uniform(0.4, 0.9, (count, 3))
    return _gaussians(means, _random_quats(rng, count), scales, _faint(rng, count, 0.1), colors)


def make_smoke() -> v3dg.Gaussians:
    """A plume of 6,000 large and very faint gaussians."""
    rng = np.random.default_rng(2)
    count = 6_000
    height = rng.uniform(0, 3, count)
    width = 0.15 + 0.3 * height
    around = rng.normal(size=(count, 2)) * width[:, None]
    means = np.column_stack([around, height])
    scales = (0.05 + 0.08 * height)[:, None] * rng.uniform(0.6, 1, (count, 3))
    colors = np.repeat(rng.uniform(0.35, 0.7, (count, 1)), 3, axis=1)
    return _gaussians(means, _random_quats(rng, count), scales, _faint(rng, count, 0.04), colors)


def make_grass() -> v3dg.Gaussians:
    """A lawn of 12,000 blades, each a needle."""
    rng = np.random.default_rng(3)
    count = 12_000
    lean = rng.normal(scale=0.35, size=(count, 2))
    direction = np.column_stack([lean, np.ones(count)])
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = rng.uniform(0.05, 0.2, count)
    ground = np.column_stack([rng.uniform(-1, 1, (count, 2)), np.zeros(count)])
    means = ground + direction * length[:, None]
    scales = np.column_stack([length / 2, np.full(count, 0.003), np.full(count, 0.0015)])
    colors = np.column_stack(
        [rng.uniform(0.1, 0.4, count), rng.uniform(0.3, 0.8, count), rng.uniform(0.05, 0.2, count)]
    )
    opacities = rng.uniform(0.3, 0.95, count)
    return _gaussians(means, _quats_along(direction), scales, opacities, colors)


def make_hair() -> v3dg.Gaussians:
    """500 curled strands of 30 needles on a ball."""
    rng = np.random.default_rng(4)
    strands = 500
    pieces = 30
    roots = rng.normal(size=(strands, 3))
    roots /= np.linalg.norm(roots, axis=1, keepdims=True)
    along = np.linspace(0, 1, pieces + 1)[:, None, None]
    curl = 0.12 * np.sin(7 * along + 6 * roots[None, :, ::-1])
    points = roots * (1 + 0.6 * along) + curl * along
    points[:, :, 2] -= 0.5 * along[:, :, 0] ** 2
    steps = (points[1:] - points[:-1]).reshape(-1, 3)
    length = np.linalg.norm(steps, axis=1)
    count = len(steps)
    means = ((points[1:] + points[:-1]) / 2).reshape(-1, 3)
    scales = np.column_stack([length / 2, np.full(count, 0.004), np.full(count, 0.004)])
    tint = np.tile(rng.uniform(0.6, 1.2, strands), pieces)[:, None]
    colors = np.clip(tint * np.array([0.55, 0.35, 0.18]), 0, 1)
    opacities = np.full(count, 0.7)
    return _gaussians(means, _quats_along(steps / length[:, None]), scales, opacities, colors)


def make_foliage() -> v3dg.Gaussians:
    """A tree's crown of 15,000 leaves, each a disc that lets light through."""
    rng = np.random.default_rng(5)
    count = 15_000
    clumps = rng.normal(size=(150, 3)) * [1, 1, 0.7]
    means = clumps[rng.integers(0, len(clumps), count)] + rng.normal(scale=0.15, size=(count, 3))
    size = rng.uniform(0.015, 0.04, (count, 1))
    scales = size * np.array([1, 0.6, 0.03])
    light = rng.uniform(0.5, 1.3, (count, 1))
    colors = np.clip(light * np.array([0.25, 0.5, 0.12]), 0, 1)
    opacities = rng.uniform(0.25, 0.9, count)
    return _gaussians(means, _random_quats(rng, count), scales, opacities, colors)


FUZZY: dict[str, Callable[[], v3dg.Gaussians]] = {
    "cloud": make_cloud,
    "smoke": make_smoke,
    "grass": make_grass,
    "hair": make_hair,
    "foliage": make_foliage,
}


def _faint(rng: np.random.Generator, count: int, largest: float) -> Floats:
    return rng.uniform(0.25, 1, count) * largest


def _random_quats(rng: np.random.Generator, count: int) -> Floats:
    quats = rng.normal(size=(count, 4))
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _quats_along(direction: Floats) -> Floats:
    """Return rotations that map the x axis to unit directions (N, 3)."""
    quats = np.column_stack(
        [1 + direction[:, 0], np.zeros(len(direction)), -direction[:, 2], direction[:, 1]]
    )
    return quats / np.linalg.norm(quats, axis=1, keepdims=True)


def _gaussians(
    means: Floats, quats: Floats, scales: Floats, opacities: Floats, colors: Floats
) -> v3dg.Gaussians:
    """Return gaussians of SH degree 0 with these colours in [0, 1]."""
    sh = ((colors - 0.5) / _SH_CONSTANT)[:, None, :]
    arrays = (array.astype(np.float32) for array in (means, quats, scales, opacities, sh))
    return v3dg.Gaussians(*arrays)
