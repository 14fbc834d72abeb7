"""False colours: palettes that show the level or the cluster that gaussians belong to."""

from __future__ import annotations

from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle

ColorBy: TypeAlias = Literal["appearance", "level", "cluster", "residency"]

# Hues from fine to coarse, of which neighbours differ in lightness, too.
_LEVEL_COLORS = np.array(
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


def level_colors(count: int) -> npt.NDArray[np.float32]:
    """Return (count, 3) colours of levels, from fine to coarse; no two are the same.

    After nine come the hues between those, darker; then both again, ever nearer to white.
    """
    level, hues = np.arange(count), len(_LEVEL_COLORS)
    turn, place = np.divmod(level, hues)
    between = 0.6 * (_LEVEL_COLORS + np.roll(_LEVEL_COLORS, -1, axis=0)) / 2
    colors = np.where((turn % 2 == 0)[:, None], _LEVEL_COLORS[place], between[place])
    return np.asarray(1 - (1 - colors) * 0.6 ** (turn // 2)[:, None], np.float32)


def palette_of(bundle: Bundle, by: ColorBy) -> npt.NDArray[np.float32] | None:
    """Constant SH coefficients (C, 3) that clusters are drawn with; None for what they appear as."""
    if by == "appearance":
        return None
    level = bundle.clusters.level
    if by == "residency":  # of all of it
        colors = np.tile(np.array(_core.shade_missing(0.0), np.float32), (len(level), 1))
    else:
        colors = level_colors(bundle.num_levels)[level] if by == "level" else _scattered_colors(len(level))
    return np.ascontiguousarray((colors - 0.5) / _core.sh_base0, np.float32)


def _scattered_colors(count: int) -> npt.NDArray[np.float32]:
    """(count, 3): hues a golden ratio apart, so that clusters side by side differ, in three lightnesses."""
    index = np.arange(count)[:, None]
    hue = (index * 0.6180339887498949 + np.array([0.0, 1 / 3, 2 / 3])) % 1.0
    wave = np.clip(np.abs(6 * hue - 3) - 1, 0, 1)
    lightness = np.array([1.0, 0.75, 0.55])[index % 3]
    return np.asarray((0.25 + 0.75 * wave) * lightness, np.float32)
