"""Camera paths: views with times, and the smooth curve through these views."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from v3dg._numbers import check
from v3dg.cameras import Camera, Floats
from v3dg.rotations import normalised
from v3dg.viewer.view import View

_LEAST_SHARE = 1e-3
"""Minimum fraction of the time between two views. Without it, equal views would have
the same time, and the slope of the curve would be undefined."""


@dataclass(frozen=True)
class CameraPath:
    """A path through views.

    Attributes:
        stops: Each view, with the seconds since the previous view. The seconds of the
            first view are ignored.
    """

    stops: Sequence[tuple[float, View]] = ()

    @classmethod
    def through(cls, views: Sequence[View], seconds: float) -> "CameraPath":
        """Return the path through at least two views with a duration of ``seconds``.

        The speed is constant: the time between two views is proportional to the sum of
        their distance and their angle, each as a fraction of the total along the path.
        If all views are equal, the times between them are equal, too.
        """
        rows = _rows(list(views))
        distances = np.linalg.norm(np.diff(rows[:, 4:7], axis=0), axis=1)
        halves = np.linalg.norm(np.diff(rows[:, :4], axis=0), axis=1) / 2
        angles = 4 * np.arcsin(np.minimum(halves, 1.0))
        shares = _shares(distances) + _shares(angles)
        shares = _shares(np.maximum(shares, _LEAST_SHARE))
        return cls([(0.0, views[0]), *zip((shares * seconds).tolist(), views[1:], strict=True)])

    def __len__(self) -> int:
        return len(self.stops)

    @property
    def times(self) -> Floats:
        """(K,) time of each view in seconds since the first view."""
        return np.cumsum([0.0, *(seconds for seconds, _ in self.stops[1:])])

    def views_at(self, seconds: Floats) -> list[View]:
        """Return views on a smooth curve through all stops, at these times since the
        first stop.

        Positions, rotations and fields of view follow cubic Hermite curves with the
        slopes of Catmull-Rom splines for non-uniform times. Rotations are normalised.
        Times before the first stop give the first view, and times after the last stop
        give the last view.

        Raises:
            ValueError: The path is empty.
        """
        check(
            "path",
            self.stops,
            ("at least one view, got none; add the current view, or record one while you fly"),
        )
        times = self.times
        views = [view for _, view in self.stops]
        if len(views) == 1:
            return views * len(seconds)
        rows = _rows(views)
        ids = np.arange(len(times))
        previous = np.maximum(ids - 1, 0)
        following = np.minimum(ids + 1, ids[-1])
        slopes = (rows[following] - rows[previous]) / (times[following] - times[previous])[:, None]
        clipped = np.clip(seconds, 0.0, times[-1])
        last = np.clip(np.searchsorted(times, clipped, side="right"), 1, ids[-1])
        first = last - 1
        length = (times[last] - times[first])[:, None]
        t = (clipped - times[first])[:, None] / length
        curve = (2 * t**3 - 3 * t**2 + 1) * rows[first] + (3 * t**2 - 2 * t**3) * rows[last]
        curve += length * ((t**3 - 2 * t**2 + t) * slopes[first] + (t**3 - t**2) * slopes[last])
        curve[:, :4] /= np.linalg.norm(curve[:, :4], axis=1, keepdims=True)
        return [View(tuple(row[:4]), tuple(row[4:7]), row[7], row[8]) for row in curve.tolist()]

    def film(self, fps: int) -> list[View]:
        """Return the views of a film: the first and the last one, and ``fps`` views per
        second in between."""
        seconds = self.times[-1]
        return self.views_at(np.linspace(0.0, seconds, max(round(seconds * fps), 1) + 1))

    def cameras(self, fps: int, width: int, height: int, near: float) -> dict[str, Camera]:
        """Return the cameras of the film's views. Their names are numbers with equal
        numbers of digits."""
        views = self.film(fps)
        digits = len(str(len(views) - 1))
        return {f"{i:0{digits}}": view.camera(width, height, near) for i, view in enumerate(views)}


def _shares(lengths: Floats) -> Floats:
    """Return lengths as fractions of their sum. If the sum is zero, return zeros."""
    total = lengths.sum()
    if total == 0:
        return np.zeros_like(lengths)
    shares: Floats = lengths / total
    return shares


def _rows(views: list[View]) -> Floats:
    """Return (K, 9): quaternion, position, field of view and aspect ratio of each view.

    The sign of each quaternion is chosen such that it is closest to the previous one.
    """
    rows = np.array(
        [(*view.wxyz, *view.position, view.fov_y, view.aspect) for view in views], np.float64
    )
    rows[:, :4] = normalised(rows[:, :4])
    for previous, row in itertools.pairwise(rows):
        if previous[:4] @ row[:4] < 0:
            row[:4] *= -1
    return rows
