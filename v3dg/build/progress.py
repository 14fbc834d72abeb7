"""The bar of a build."""

from __future__ import annotations

import threading
from typing import Any

from v3dg import _core
from v3dg.build.plan import Plan
from v3dg.build.simplify import Show


def bar_of_gaussians(total: int, is_visible: bool, **options: Any) -> Any:
    """Tqdm's, which counts gaussians."""
    from tqdm import tqdm

    options |= {"unit": " gaussians", "unit_scale": True, "dynamic_ncols": True}
    return tqdm(total=total, disable=not is_visible, **options)


class Stopped(Exception):
    """Another thread of the build has failed."""


class Bar:
    """One bar over all levels; it advances by fitted gaussians, which is what time goes with."""

    def __init__(self, plan: Plan, initial: int, is_visible: bool) -> None:
        total = sum(level.num_gaussians for level in plan.levels[1:])
        self._last_level = len(plan.levels) - 1
        self._initial = initial
        self._fitted: dict[tuple[int, int], float] = {}  # by part and first level
        self._lock = threading.Lock()
        self._bar = bar_of_gaussians(total, is_visible, initial=initial, smoothing=0.1)
        self._is_stopped = False

    def __enter__(self) -> Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def stop(self) -> None:
        """Let every thread that shows something find out that the build has failed."""
        self._is_stopped = True

    def show_of(self, part: int) -> Show:
        """What shows how far the fits of a part are."""

        def show(levels: range, num_groups: int, num_gaussians: int, state: _core.FitProgress) -> None:
            if self._is_stopped:
                raise Stopped
            self._update((part, levels[0]), num_gaussians * state.groups_done / num_groups)
            with self._lock:
                self._bar.set_description(f"level {levels[-1]}/{self._last_level}", refresh=False)
                if (done := state.groups_done) > 0:
                    text = f"groups {done}/{num_groups}, loss {state.loss_sum / done:.4f}"
                    self._bar.set_postfix_str(text, refresh=False)

        return show

    def add(self, part: int, level: int, num_gaussians: int) -> None:
        """Count a level that was made elsewhere."""
        if level > 0:
            self._update((part, level), num_gaussians)

    def _update(self, key: tuple[int, int], num_gaussians: float) -> None:
        with self._lock:
            self._fitted[key] = num_gaussians
            self._bar.update(self._initial + int(sum(self._fitted.values())) - self._bar.n)
