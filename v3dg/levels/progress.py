"""The progress bar of a build."""

import threading

from v3dg import _core, _progress
from v3dg._progress import Progress
from v3dg.levels.plan import Plan
from v3dg.levels.simplify import Show


class Stopped(Exception):
    """Raised because another thread of the build has failed."""


class Bar(_progress.Bar):
    """One bar for all levels. It counts fitted gaussians, because the time is
    proportional to their number."""

    def __init__(self, plan: Plan, initial: int, progress: Progress) -> None:
        total = sum(level.num_gaussians for level in plan.levels[1:])
        super().__init__(total, "build", progress, initial=initial)
        self._last_level = len(plan.levels) - 1
        self._initial = initial
        # Number of fitted gaussians, by part and by the lowest level of a fit.
        self._fitted: dict[tuple[int, int], float] = {}
        self._lock = threading.Lock()
        self._is_stopped = False

    def stop(self) -> None:
        """Make every thread that reports progress raise `Stopped` from now on."""
        self._is_stopped = True

    def show_of(self, part: int) -> Show:
        """Return the progress callback for the fits of one part."""

        def show(
            levels: range, num_groups: int, num_gaussians: int, state: _core.FitProgress
        ) -> None:
            if self._is_stopped:
                raise Stopped
            text = f"level {levels[-1]}/{self._last_level}"
            num_fitted = state.groups_done
            if num_fitted > 0:
                loss = state.loss_sum / num_fitted
                text += f", groups {num_fitted}/{num_groups}, loss {loss:.4f}"
            self._update((part, levels[0]), num_gaussians * num_fitted / num_groups, text)

        return show

    def add(self, part: int, level: int, num_gaussians: int) -> None:
        """Count a level that another process has built."""
        if level > 0:
            self._update((part, level), num_gaussians)

    def _update(self, key: tuple[int, int], num_gaussians: float, text: str = "") -> None:
        with self._lock:
            self._fitted[key] = num_gaussians
            self.update(self._initial + int(sum(self._fitted.values())) - self.num_done, text)
