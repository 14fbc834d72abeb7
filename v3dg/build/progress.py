"""The bar of a build."""

from __future__ import annotations

from typing import Any

import numpy as np

from v3dg import _core
from v3dg.build.plan import Plan


class Bar:
    """One bar over all levels; it advances by fitted gaussians, which is what time goes with."""

    def __init__(self, plan: Plan, is_visible: bool) -> None:
        self._levels = plan.levels
        self._is_visible = is_visible
        # Gaussians of the levels from 1 on up to each.
        self._before = np.cumsum([0, 0, *(level.num_gaussians for level in plan.levels[1:])]).tolist()
        self._bar: Any = None

    def show(self, level: int, state: _core.FitProgress) -> None:
        """Show how many groups of the level are done."""
        from tqdm import tqdm

        if self._bar is None:
            self._bar = tqdm(
                total=self._before[-1],
                initial=self._before[level],
                unit=" gaussians",
                unit_scale=True,
                smoothing=0.1,
                dynamic_ncols=True,
                disable=not self._is_visible,
            )
        self._bar.set_description(f"level {level}/{len(self._levels) - 1}", refresh=False)
        done = state.groups_done
        if done > 0:
            here = self._levels[level]
            text = f"groups {done}/{here.num_groups}, loss {state.loss_sum / done:.4f}"
            self._bar.set_postfix_str(text, refresh=False)
            self._bar.update(self._before[level] + here.num_gaussians * done // here.num_groups - self._bar.n)

    def close(self) -> None:
        if self._bar is not None:
            self._bar.close()
