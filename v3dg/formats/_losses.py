"""Measures what gaussians lose when they are written to a quantised format: clipped
values, and rounding errors of the others."""

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from v3dg._json import JsonObject
from v3dg.cleaning import SMALLEST_OPACITY, ball_of_most
from v3dg.formats._packing import SH_C0, Limits, blocks, log_scales
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised, product


@dataclass(frozen=True)
class Losses:
    """The losses of gaussians that were written to a file of a quantised format.

    Attributes:
        cut: Number of values that were clipped to the range of the format, by kind:
            `scales`, `colors` of degree 0, `harmonics` of higher degrees, and
            `opacities` that became 0 because they were too small to be visible. Kinds
            without clipped values are missing.
        position_error: Largest error of a coordinate, relative to the diameter of the
            ball that contains most gaussians.
        scale_error: Largest relative error of a scale that was not clipped.
        rotation_error: Largest angle, in degrees, by which an ellipsoid was rotated.
        color_error: Largest error of a colour of degree 0 that was not clipped. 1 is
            the difference between black and white.
        harmonics_error: Largest error of a coefficient of a higher degree that was not
            clipped.
        limits: The range of the format.
    """

    cut: dict[str, int]
    position_error: float
    scale_error: float
    rotation_error: float
    color_error: float
    harmonics_error: float
    limits: Limits

    @property
    def lines(self) -> list[str]:
        """The losses as sentences for users."""
        lines = []
        if self.cut:
            counts = ", ".join(f"{count:,} {self._kind(kind)}" for kind, count in self.cut.items())
            lines.append(f"cut to what the format holds: {counts}")
        errors = f"positions {self.position_error:.1e} of the size"
        errors += f", scales {self.scale_error:.1%}, rotations {self.rotation_error:.2g}°"
        errors += f", colours {self.color_error:.4f}"
        if self.harmonics_error:
            errors += f", harmonics {self.harmonics_error:.4f}"
        return [*lines, f"largest errors of rounding: {errors}"]

    def result(self) -> JsonObject:
        """Return the losses as JSON for the result of a command."""
        errors = {
            "positions": self.position_error,
            "scales": self.scale_error,
            "rotations": self.rotation_error,
            "colors": self.color_error,
            "harmonics": self.harmonics_error,
        }
        return {"cut": self.cut, "largest_errors": errors}

    def _kind(self, kind: str) -> str:
        limits = self.limits
        if kind == "scales":
            low, high = map(math.exp, limits.log_scale)
            return f"scales beyond {low:.2g} to {high:.2g}"
        if kind == "colors":
            low, high = (0.5 + SH_C0 * value for value in limits.color)
            return f"colours beyond {low:.2f} to {high:.2f}"
        if kind == "harmonics":
            return f"harmonics beyond {limits.harmonic[0]:.2f} to {limits.harmonic[1]:.2f}"
        return "opacities below 1/255, which became 0"


def losses(written: Gaussians, read: Gaussians, limits: Limits) -> Losses:
    """Compare gaussians on the host with those that a quantised file contains, in the
    same order and axes."""
    higher = written.sh[:, 1:]
    logs = log_scales(written.scales)
    is_cut = {
        "scales": _is_outside(logs, limits.log_scale),
        "colors": _is_outside(written.sh[:, 0], limits.color),
        "harmonics": _is_outside(higher, limits.harmonic),
        "opacities": (written.opacities > 0) & (written.opacities < SMALLEST_OPACITY),
    }
    size = 1.0
    if len(written):
        size = 2 * ball_of_most(written.means)[1]
    all_kept = np.zeros(written.means.shape, bool)
    log_error = _largest_error(logs, log_scales(read.scales), is_cut["scales"])
    return Losses(
        cut={kind: int(mask.sum()) for kind, mask in is_cut.items() if mask.any()},
        position_error=_largest_error(written.means, read.means, all_kept) / size,
        scale_error=math.expm1(log_error),
        rotation_error=_largest_angle(written.quats, read.quats),
        color_error=SH_C0 * _largest_error(written.sh[:, 0], read.sh[:, 0], is_cut["colors"]),
        harmonics_error=_largest_error(higher, read.sh[:, 1:], is_cut["harmonics"]),
        limits=limits,
    )


def _is_outside(
    values: npt.NDArray[np.floating], bounds: tuple[float, float]
) -> npt.NDArray[np.bool_]:
    return np.asarray((values < bounds[0]) | (values > bounds[1]))


def _largest_error(
    values: npt.NDArray[np.floating],
    read: npt.NDArray[np.floating],
    is_cut: npt.NDArray[np.bool_],
) -> float:
    errors = np.abs(values.astype(np.float64) - read)
    return float(errors[~is_cut].max(initial=0.0))


def _largest_angle(quats: npt.NDArray[np.floating], read: npt.NDArray[np.floating]) -> float:
    """Return the largest angle, in degrees, by which reading rotates an ellipsoid. A
    half turn about an axis of the ellipsoid does not count, because it does not change
    the ellipsoid."""
    largest = 0.0
    for rows in blocks(len(quats)):
        inverses = normalised(quats[rows]) * np.array([1, -1, -1, -1])
        # The largest component of the quaternion of such a rotation belongs either to
        # no rotation, or to a half turn about an axis.
        turns = np.sort(np.abs(product(inverses, normalised(read[rows]))), axis=1)
        sines = np.linalg.norm(turns[:, :3], axis=1)
        largest = max(largest, 2 * np.arctan2(sines, turns[:, 3]).max())
    return math.degrees(largest)
