"""Finds faulty gaussians in an asset: those that cannot be drawn, and those far away
from all others."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg.gaussians import Gaussians

LARGEST = _core.most_length
"""Largest valid coordinate or scale, in world units. The square of a larger one could
overflow float32."""
SMALLEST_OPACITY = float(np.float32(_core.min_alpha))
"""Smallest opacity that can be visible. Contributions with a smaller alpha are not
blended."""
OUTLIER_DISTANCE = 20.0
"""Gaussians farther than this from the median position, as a multiple of the median
distance, count as outliers: sky, floaters or mistakes."""

# Positions are coarse if the spacing of float32 exceeds this fraction of the longest
# scale, for at least this fraction of the gaussians.
_COARSE_STEP = 0.25
_COARSE_SHARE = 0.5
_MOST_SAMPLES = 100_000

# The reasons why gaussians cannot be drawn, in the order of the core's bits, with their
# descriptions.
_TEXT = {
    "means_not_finite": "with a position that is not finite",
    "quats_not_finite": "with a rotation that is not finite",
    "scales_not_finite": "with a scale that is not finite",
    "opacities_not_finite": "with an opacity that is not finite",
    "sh_not_finite": "with a colour that is not finite",
    "too_large": f"with a position or a scale beyond {LARGEST:g}",
    "negative_scale": "with a negative scale",
    "opacity_out_of_range": "with an opacity outside 0 to 1",
    "transparent": "with an opacity below 1/255, which is invisible",
}
KINDS = tuple(_TEXT)
# The bits of all reasons before "transparent".
_WRONG = (1 << KINDS.index("transparent")) - 1


class AssetWarning(UserWarning):
    """Emitted when gaussians of an asset have invalid values and are skipped, or when
    content of its file is ignored or converted."""


@dataclass(frozen=True, eq=False)
class Findings:
    """The gaussians of an asset that can be drawn, and the reasons why the others
    cannot.

    Attributes:
        drawable: (N,) bool, on the host.
        counts: The number of gaussians with each kind of fault. Kinds without gaussians
            are missing. A gaussian can have several faults.
        wrong: (N,) bool, whether a gaussian has invalid values. Gaussians that are
            neither drawable nor wrong are valid but transparent.
    """

    drawable: npt.NDArray[np.bool_]
    counts: dict[str, int]
    wrong: npt.NDArray[np.bool_]

    @property
    def num_wrong(self) -> int:
        """Number of gaussians with invalid values."""
        return int(self.wrong.sum())

    @property
    def num_dropped(self) -> int:
        """Number of gaussians that cannot be drawn."""
        return len(self.drawable) - int(self.drawable.sum())

    @property
    def text(self) -> str:
        """A one-line description of how many gaussians cannot be drawn, and why."""
        return summary(self.num_dropped, len(self.drawable), self.counts)


def summary(num_dropped: int, num_gaussians: int, counts: Mapping[str, int]) -> str:
    """Return a one-line description of how many gaussians of an asset cannot be drawn,
    and why."""
    return f"{num_dropped:,} of {num_gaussians:,} gaussians cannot be drawn: {describe(counts)}"


def describe(counts: Mapping[str, int]) -> str:
    """Return the counts of faults as text."""
    return ", ".join(f"{count:,} {_TEXT[kind]}" for kind, count in counts.items())


def examine(asset: Gaussians) -> Findings:
    """Find the gaussians that cannot be drawn."""
    faults = _core.examine(asset.numpy().rows)
    nonzero = faults[faults != 0]
    counts = {}
    for bit, kind in enumerate(KINDS):
        count = int((nonzero >> bit & 1).sum())
        if count:
            counts[kind] = count
    return Findings(drawable=faults == 0, counts=counts, wrong=(faults & _WRONG) != 0)


def has_no_rotation(asset: Gaussians) -> npt.NDArray[np.bool_]:
    """Return (N,) whether each quaternion is zero. A gaussian with such a quaternion is
    drawn without rotation. Quantised formats cannot store it."""
    return np.asarray(~asset.numpy().quats.any(axis=1))


def outliers(
    means: npt.NDArray[np.float32], reference: npt.NDArray[np.float32] | None = None
) -> npt.NDArray[np.bool_]:
    """Return (N,) whether each finite position (N, 3) is an outlier. An outlier is more
    than 20 times the median distance away from the median of ``reference``. If
    ``reference`` is None, the positions themselves are used."""
    if reference is None:
        reference = means
    if len(means) == 0 or len(reference) == 0:
        return np.zeros(len(means), bool)
    typical = reference.astype(np.float64)
    center = np.median(typical, axis=0)
    median_distance = np.median(np.linalg.norm(typical - center, axis=1))
    distance = np.linalg.norm(means.astype(np.float64) - center, axis=1)
    return np.asarray(distance > OUTLIER_DISTANCE * median_distance)


def ball_of_most(points: npt.NDArray[np.floating]) -> tuple[npt.NDArray[np.floating], float]:
    """Return the centre (3,) and the positive radius of a ball that contains nearly all
    points (N, 3). There must be at least one point.

    Trained assets have a few gaussians far away from all others. A ball around all of
    them would be too large for a view.
    """
    low, high = np.percentile(points, (1, 99), axis=0)
    return (low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-6)


def coarse_note(gaussians: Gaussians) -> str | None:
    """If gaussians on the host are so far from the origin that float32 rounds their
    positions visibly, return a sentence that says so. Otherwise return None.

    Such coordinates come from geographic data, or from placing an asset far away.
    """
    stride = max(1, len(gaussians) // _MOST_SAMPLES)
    reach = np.abs(gaussians.means[::stride]).max(axis=1, initial=0.0)
    longest = gaussians.scales[::stride].max(axis=1, initial=0.0)
    is_valid = np.isfinite(reach) & np.isfinite(longest)
    steps = np.spacing(reach[is_valid])
    is_coarse = steps > _COARSE_STEP * longest[is_valid]
    if not len(steps) or is_coarse.mean() < _COARSE_SHARE:
        return None
    return (
        f"Positions are rounded to steps of up to {steps[is_coarse].max():.2g}, because float32 "
        f"is no finer {reach[is_valid][is_coarse].max():.2g} from zero; that is coarse for the "
        f"scales of {is_coarse.mean():.0%} of the gaussians. Keep the asset near zero, and place "
        "its bundle in a scene."
    )
