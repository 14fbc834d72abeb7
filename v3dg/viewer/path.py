"""Camera paths: views at times, and the smooth way through them."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field

import numpy as np

from v3dg.cameras import Camera, Floats
from v3dg.viewer.view import View

# Between recorded views; more often shows nothing new.
_SHORTEST_SECONDS = 1 / 30


@dataclass
class CameraPath:
    """Views at growing times, seconds from the first."""

    times: list[float] = field(default_factory=list)
    views: list[View] = field(default_factory=list)

    def __len__(self) -> int:
        return len(self.views)

    @property
    def seconds(self) -> float:
        return self.times[-1] - self.times[0] if self.times else 0.0

    def add(self, view: View, seconds: float) -> None:
        """Append a view so long after the last one."""
        self.times.append(self.times[-1] + seconds if self.times else 0.0)
        self.views.append(view)

    def record(self, view: View, now: float) -> None:
        """Append a view seen at that time, if the last one is not from just before."""
        if not self.times or now - self.times[-1] >= _SHORTEST_SECONDS:
            self.times.append(now)
            self.views.append(view)

    def at(self, seconds: float) -> View:
        """Return the view so long after the first; errors are those of `views_at`."""
        return self.views_at(np.array([seconds]))[0]

    def views_at(self, seconds: Floats) -> list[View]:
        """Return the views so long after the first, on a smooth curve through all of them.

        Positions, rotations and fields of view follow cubic Hermite curves whose slopes are those of
        Catmull-Rom for uneven times; rotations are normalised. Before the first and after the last time it
        stays.

        Raises:
            ValueError: The path is empty.
        """
        if not self.views:
            raise ValueError("path: expected at least one view; add this one, or record while you fly")
        if len(self.views) == 1:
            return self.views * len(seconds)
        times, rows = np.asarray(self.times) - self.times[0], _rows(self.views)
        places = np.arange(len(times))
        before, after = np.maximum(places - 1, 0), np.minimum(places + 1, places[-1])
        slopes = (rows[after] - rows[before]) / (times[after] - times[before])[:, None]
        now = np.clip(seconds, 0.0, times[-1])
        last = np.clip(np.searchsorted(times, now, side="right"), 1, places[-1])
        first = last - 1
        length = (times[last] - times[first])[:, None]
        t = (now - times[first])[:, None] / length
        curve = (2 * t**3 - 3 * t**2 + 1) * rows[first] + (3 * t**2 - 2 * t**3) * rows[last]
        curve += length * ((t**3 - 2 * t**2 + t) * slopes[first] + (t**3 - t**2) * slopes[last])
        curve[:, :4] /= np.linalg.norm(curve[:, :4], axis=1, keepdims=True)
        return [View(tuple(row[:4]), tuple(row[4:7]), row[7], row[8]) for row in curve.tolist()]

    def film(self, fps: int) -> list[View]:
        """Return the views of a film: the first, the last, and those between at ``fps`` a second."""
        return self.views_at(np.linspace(0.0, self.seconds, max(round(self.seconds * fps), 1) + 1))

    def cameras(self, fps: int, width: int, height: int, near: float) -> dict[str, Camera]:
        """Return the film's cameras by name."""
        views = self.film(fps)
        digits = len(str(len(views) - 1))
        return {f"{i:0{digits}}": view.camera(width, height, near) for i, view in enumerate(views)}


def _rows(views: list[View]) -> Floats:
    """(K, 9): quaternion of the sign that is next to the one before, position, field of view, aspect."""
    rows = np.array([(*v.wxyz, *v.position, v.fov_y, v.aspect) for v in views], np.float64)
    rows[:, :4] /= np.linalg.norm(rows[:, :4], axis=1, keepdims=True)
    for before, row in itertools.pairwise(rows):
        if before[:4] @ row[:4] < 0:
            row[:4] *= -1
    return rows
