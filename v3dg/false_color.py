"""False colours: palettes that show the level or the cluster that gaussians belong to, or what is missing."""

from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle

ColorBy: TypeAlias = Literal["appearance", "level", "cluster", "residency"]


def palette_of(bundle: Bundle, by: ColorBy) -> npt.NDArray[np.float32] | None:
    """Constant SH coefficients (C, 3) that clusters are drawn with; None for what they appear as."""
    if by == "appearance":
        return None
    level = bundle.clusters.level
    if by == "level":
        colors = _core.level_colors(bundle.num_levels)[level]
    else:  # or of what is there, which is all
        colors = _core.cluster_colors(len(level)) if by == "cluster" else _core.missing_colors(0 * level)
    return np.ascontiguousarray((colors - 0.5) / _core.sh_base0, np.float32)
