"""False colours: a bundle whose gaussians show the level or the cluster that they belong to."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal, TypeAlias, get_args

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle
from v3dg.gaussians import Gaussians

ColorBy: TypeAlias = Literal["appearance", "level", "cluster"]

# From fine to coarse, and around again: neighbours differ in hue and in lightness.
LEVEL_COLORS = np.array(
    [
        (0.90, 0.24, 0.22),
        (0.98, 0.60, 0.17),
        (0.99, 0.88, 0.30),
        (0.50, 0.78, 0.32),
        (0.20, 0.65, 0.55),
        (0.26, 0.65, 0.90),
        (0.27, 0.40, 0.80),
        (0.55, 0.35, 0.75),
        (0.85, 0.45, 0.70),
    ],
    np.float32,
)


def false_color(bundle: Bundle, by: ColorBy) -> Gaussians:
    """Return the gaussians of all levels, coloured by level, by cluster, or as they appear.

    Raises:
        ValueError: ``by`` is none of these.
    """
    if by not in get_args(ColorBy):
        raise ValueError(f"color_by: expected {', '.join(map(repr, get_args(ColorBy)))}, got {by!r}")
    gaussians = bundle.gaussians
    if by == "appearance":
        return gaussians
    clusters = bundle.clusters
    if by == "level":
        colors = LEVEL_COLORS[clusters.level % len(LEVEL_COLORS)]
    else:
        colors = _scattered_colors(len(clusters.level))
    per_gaussian = np.repeat(colors, np.diff(clusters.offset), axis=0)
    return replace(
        gaussians, sh=np.ascontiguousarray((per_gaussian[:, None, :] - 0.5) / _core.sh_base0, np.float32)
    )


def _scattered_colors(count: int) -> npt.NDArray[np.float32]:
    """(count, 3): hues a golden ratio apart, so that clusters side by side differ, in three lightnesses."""
    index = np.arange(count)[:, None]
    hue = (index * 0.6180339887498949 + np.array([0.0, 1 / 3, 2 / 3])) % 1.0
    wave = np.clip(np.abs(6 * hue - 3) - 1, 0, 1)
    lightness = np.array([1.0, 0.75, 0.55])[index % 3]
    return np.asarray((0.25 + 0.75 * wave) * lightness, np.float32)
