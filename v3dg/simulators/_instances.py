"""Instances of a scene that are attached to bodies of a simulator."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from v3dg._numbers import check

if TYPE_CHECKING:
    import numpy.typing as npt

    from v3dg.scene import Scene


def free_ids(
    instances: npt.ArrayLike, scene: Scene, attached: npt.ArrayLike
) -> npt.NDArray[np.int64]:
    """Return (M,) ids of instances. Raise ValueError if the scene does not have one of
    them, or if one is already attached to a body."""
    ids = np.atleast_1d(np.asarray(instances)).astype(np.int64)
    is_known = bool(((ids >= 0) & (ids < len(scene))).all())
    check("instances", is_known, f"ids from 0 to {len(scene) - 1}, got {ids.tolist()}")
    is_free = not np.isin(ids, attached).any()
    check("instances", is_free, f"instances without a body, got {ids.tolist()}")
    return ids
