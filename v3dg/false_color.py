"""False colours: palettes that show the levels, the clusters or the missing pages of a
bundle."""

from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.bundle import Bundle

ColorBy: TypeAlias = Literal["appearance", "level", "cluster", "residency"]


def palette_of(bundle: Bundle, color_by: ColorBy) -> npt.NDArray[np.float32] | None:
    """Return SH coefficients of degree 0 (C, 3), one colour for each cluster. Return
    None if gaussians keep their own colours."""
    if color_by == "appearance":
        return None
    level = bundle.clusters.level
    if color_by == "level":
        colors = _core.level_colors(bundle.num_levels)[level]
    elif color_by == "cluster":
        colors = _core.cluster_colors(len(level))
    else:  # all pages are resident, so none is missing
        colors = _core.missing_colors(np.zeros_like(level))
    return np.ascontiguousarray((colors - 0.5) / _core.sh_base0, np.float32)
