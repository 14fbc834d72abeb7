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
        """Return the view that long after the first, on a smooth curve through all of them.

        Positions, rotations and fields of view follow cubic Hermite curves whose slopes are those of
        Catmull-Rom for uneven times; rotations are normalised. Before the first and after the last time it
        stays.

        Raises:
            ValueError: The path is empty.
        """
        if not self.views:
            raise ValueError("path: expected at least one view, got none")
        times = np.asarray(self.times) - self.times[0]
        rows = _rows(self.views)
        if len(times) == 1:
            return self.views[0]
        seconds = float(np.clip(seconds, 0.0, times[-1]))
        after = int(np.clip(np.searchsorted(times, seconds, side="right"), 1, len(times) - 1))
        first, last = rows[after - 1], rows[after]
        length = times[after] - times[after - 1]
        t = (seconds - times[after - 1]) / length
        slope_first, slope_last = _slope(times, rows, after - 1), _slope(times, rows, after)
        row = (
            (2 * t**3 - 3 * t**2 + 1) * first
            + (t**3 - 2 * t**2 + t) * length * slope_first
            + (3 * t**2 - 2 * t**3) * last
            + (t**3 - t**2) * length * slope_last
        )
        quaternion = row[:4] / np.linalg.norm(row[:4])
        w, x, y, z = (float(q) for q in quaternion)
        return View((w, x, y, z), (float(row[4]), float(row[5]), float(row[6])), float(row[7]), float(row[8]))

    def views_at(self, fps: int) -> list[View]:
        """Return the views of a film: the first, the last, and those between at ``fps`` a second."""
        count = max(round(self.seconds * fps), 1) + 1
        return [self.at(t) for t in np.linspace(0.0, self.seconds, count)]

    def cameras(self, fps: int, width: int, height: int, near: float) -> dict[str, Camera]:
        """Return the film's cameras by name."""
        views = self.views_at(fps)
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


def _slope(times: Floats, rows: Floats, place: int) -> Floats:
    """Change a second at one of the rows; the paths' ends are gone out of and into along a straight line."""
    before, after = max(place - 1, 0), min(place + 1, len(times) - 1)
    return np.asarray((rows[after] - rows[before]) / (times[after] - times[before]))
