"""The work on one unit, wherever it is done."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass

from v3dg import _device
from v3dg._device import Device
from v3dg.build.config import BuildConfig
from v3dg.build.plan import Plan
from v3dg.build.simplify import Show, build_levels
from v3dg.build.unfinished import NO_HASHES, FinishedLevel, MemoryStore, PageFile
from v3dg.bundle.pages import PageRun
from v3dg.gaussians import Gaussians


@dataclass(frozen=True, eq=False)
class UnitTask:
    """All that the work on a unit needs; it can be pickled where `leaves` and `pages` can."""

    leaves: Callable[[], Gaussians]
    plan: Plan
    runs: Sequence[PageRun | None]  # pages of its levels; None for the last, which shares them
    config: BuildConfig
    seed: int
    finished: Mapping[int, FinishedLevel]  # levels that are built already
    pages: PageFile | MemoryStore

    def levels(self, device: Device, show: Show) -> Iterator[tuple[int, FinishedLevel]]:
        """Build the levels that are not finished, one after another, and write their pages."""
        finished = (self.finished[n].read(self.pages, self.runs[n]) for n in sorted(self.finished))
        leaves = next(finished).gaussians if self.finished else self.leaves()
        own = _device.place(leaves, device)
        levels = build_levels(own, self.plan, self.config, self.seed, finished=finished, show=show)
        del leaves, own
        for number, level in enumerate(levels):
            run = self.runs[number]
            if number not in self.finished and run is not None:
                yield number, FinishedLevel(level.tables, self.pages.write(run, level.gaussians))
            elif number not in self.finished:
                yield number, FinishedLevel(level.tables, NO_HASHES, level.gaussians.numpy())
            del level  # while the next is made, its memory is free
