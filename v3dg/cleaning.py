"""What is wrong with an asset: gaussians that cannot be drawn, and such as lie far from all others."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._numbers import MOST_FLOAT
from v3dg.gaussians import Array, Gaussians

LARGEST = 1e18
"""Of a coordinate or a scale, in world units: squares of more are no float32 numbers."""
SMALLEST_OPACITY = float(np.float32(_core.min_alpha))
"""A gaussian is drawn where its alpha is this or more, so one whose opacity is below is never drawn."""
OUTLIER_DISTANCE = 20.0
"""From the median of the positions, in median distances; sky and floaters lie there, and slips."""

_GAUSSIANS_AT_ONCE = 1 << 16

# Kinds of gaussians that cannot be drawn: those with wrong values, then those that no pixel can show.
_TEXT = {
    "means_not_finite": "with a position that is not finite",
    "quats_not_finite": "with a rotation that is not finite",
    "scales_not_finite": "with a scale that is not finite",
    "opacities_not_finite": "with an opacity that is not finite",
    "sh_not_finite": "with a colour that is not finite",
    "too_large": f"with a position or a scale beyond {LARGEST:g}",
    "negative_scale": "with a negative scale",
    "opacity_out_of_range": "with an opacity outside 0 to 1",
    "transparent": "with an opacity below 1/255, which no pixel shows",
}
KINDS = tuple(_TEXT)
_VALID = ("transparent",)


class AssetWarning(UserWarning):
    """Gaussians of an asset have wrong values and were left out."""


@dataclass(frozen=True, eq=False)
class Findings:
    """Which of an asset's N gaussians can be drawn, and why the others cannot.

    Attributes:
        drawable: (N,) bool, on the host.
        counts: How many there are of each kind that cannot be drawn; kinds without any are left out, and a
            gaussian can be of several.
        num_wrong: Gaussians with wrong values; the others that cannot be drawn are valid, but transparent.
    """

    drawable: npt.NDArray[np.bool_]
    counts: dict[str, int]
    num_wrong: int

    @property
    def num_dropped(self) -> int:
        """Gaussians that cannot be drawn."""
        return len(self.drawable) - int(self.drawable.sum())

    @property
    def text(self) -> str:
        """One line that says how many cannot be drawn and why."""
        return summary(self.num_dropped, len(self.drawable), self.counts)


def summary(num_dropped: int, num_gaussians: int, counts: Mapping[str, int]) -> str:
    """One line that says how many of an asset cannot be drawn and why."""
    return f"{num_dropped:,} of {num_gaussians:,} gaussians cannot be drawn: {describe(counts)}"


def describe(counts: Mapping[str, int]) -> str:
    """Counts of kinds in words."""
    return ", ".join(f"{count:,} {_TEXT[kind]}" for kind, count in counts.items())


def examine(asset: Gaussians) -> Findings:
    """Find the gaussians that cannot be drawn."""
    if _device.of(asset.means).is_cuda:
        return _examine(asset)
    drawable = np.ones(len(asset), bool)
    counts: Counter[str] = Counter()
    num_wrong = 0
    host = asset.numpy()
    for first in range(0, len(host), _GAUSSIANS_AT_ONCE):
        rows = slice(first, first + _GAUSSIANS_AT_ONCE)
        block = host.subset(rows)
        if not _is_plainly_drawable(block):
            found = _examine(block)
            drawable[rows] = found.drawable
            counts.update(found.counts)
            num_wrong += found.num_wrong
    return Findings(drawable, {kind: counts[kind] for kind in _TEXT if kind in counts}, num_wrong)


def _is_plainly_drawable(asset: Gaussians) -> bool:
    """Whether least and greatest values tell that all can be drawn; no comparison holds for NaN."""
    least = -LARGEST, -MOST_FLOAT, 0, SMALLEST_OPACITY, -MOST_FLOAT
    most = LARGEST, MOST_FLOAT, LARGEST, 1, MOST_FLOAT
    arrays = zip(vars(asset).values(), least, most, strict=True)
    return all(array.min() >= low and array.max() <= high for array, low, high in arrays)


def _examine(asset: Gaussians) -> Findings:
    isfinite = _device.library_of(asset.means).isfinite
    finite = {name: isfinite(values) for name, values in vars(asset).items()}
    masks: dict[str, Any] = {f"{name}_not_finite": _any(~good) for name, good in finite.items()}
    too_far, too_wide = (finite[name] & (abs(getattr(asset, name)) > LARGEST) for name in ("means", "scales"))
    masks["too_large"] = _any(too_far) | _any(too_wide)
    masks["negative_scale"] = _any(asset.scales < 0)
    masks["opacity_out_of_range"] = (asset.opacities < 0) | (asset.opacities > 1) & finite["opacities"]
    masks["transparent"] = (asset.opacities >= 0) & (asset.opacities < SMALLEST_OPACITY)
    host = {kind: _device.to_host(mask) for kind, mask in masks.items()}
    wrong = np.logical_or.reduce([mask for kind, mask in host.items() if kind not in _VALID])
    return Findings(
        drawable=~np.logical_or.reduce(list(host.values())),
        counts={kind: int(mask.sum()) for kind, mask in host.items() if mask.any()},
        num_wrong=int(wrong.sum()),
    )


def outliers(means: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
    """Which of (N, 3) finite positions lie far from all others: more than 20 times the median distance."""
    if len(means) == 0:
        return np.zeros(0, bool)
    exact = means.astype(np.float64)
    distance = np.linalg.norm(exact - np.median(exact, axis=0), axis=1)
    far: npt.NDArray[np.bool_] = distance > OUTLIER_DISTANCE * np.median(distance)
    return far


def ball_of_most(points: npt.NDArray[np.floating[Any]]) -> tuple[npt.NDArray[np.floating[Any]], float]:
    """Centre (3,) and radius, above 0, of a ball around nearly all of N > 0 points (N, 3): what to look at.

    Trained assets have a few gaussians far away from all others.
    """
    low, high = np.percentile(points, (1, 99), axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def _any(values: Array) -> Any:
    """Whether any of a row is true, for each row of an array of any dimensions."""
    rows = values.reshape(len(values), math.prod(values.shape[1:]))
    return rows.any(axis=1) if rows.any() else rows[:, 0]  # NumPy is slow with short rows
