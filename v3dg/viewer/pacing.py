"""How large to draw, and when: small while things move, larger step by step once they rest."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

from v3dg import _core
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.frame import Frame, SceneView, Settings, Stopped
from v3dg.viewer.view import View

Size = tuple[int, int]

# Of one picture while the camera moves; a drag then has an answer in less than twice that.
TARGET_MS = 60.0
# Without a change for so long, a larger picture is begun.
REST_SECONDS = 0.15
# What a picture at rest waits for pages; another one follows as long as some are missing.
PAGES_SECONDS = 0.1
# A draft that has taken so long is given up for what is asked for now.
PATIENCE_SECONDS = 4e-3 * TARGET_MS
# Smaller ones show nothing; from there on the cut gets coarser, which shows less.
_SMALLEST = 1 / 4
_COARSEST = 64.0
# Sizes are this far apart, so that they do not change from picture to picture.
_STEPS_AN_OCTAVE = 4


class Draft(NamedTuple):
    """How to draw what passes by: its size in px, and what the tolerance is multiplied by."""

    size: Size
    coarser: float = 1.0


class Pacer:
    """Chooses how to draw a picture in time, from how long earlier ones took.

    Time is taken to be proportional to work, pixels over the factor of the tolerance, measured with the
    picture that was drawn last: where it is not, the choice still settles at the one that takes the target.
    """

    def __init__(self, target_ms: float = TARGET_MS) -> None:
        self._target_ms = target_ms
        self._work_per_ms = 0.0

    def draft(self, full: Size) -> Draft:
        """Return a size with about the shape of ``full``, not larger, at first a quarter of its width."""
        whole = math.prod(full)
        share = (self._target_ms * self._work_per_ms or whole / 16) / whole
        # A little more, so that rounding refuses no step that fits.
        scale = 2 ** (math.floor(_STEPS_AN_OCTAVE * math.log2(share) / 2 + 1e-6) / _STEPS_AN_OCTAVE)
        coarser = min(max((_SMALLEST / scale) ** 2, 1.0), _COARSEST)
        return Draft(scaled(full, min(max(scale, _SMALLEST), 1.0)), coarser)

    def drew(self, draft: Draft, milliseconds: float) -> None:
        """Take note of how long a picture took."""
        speed = math.prod(draft.size) / draft.coarser / max(milliseconds, 0.1)
        # Slower counts at once, faster only where it lasts.
        share = 0.3 if speed > self._work_per_ms > 0 else 1.0
        self._work_per_ms += share * (speed - self._work_per_ms)

    def rested(self) -> None:
        """Take half the work for the next: a browser on these cores has a large picture to move then."""
        self._work_per_ms /= 2


def scaled(full: Size, scale: float) -> Size:
    return max(1, round(scale * full[0])), max(1, round(scale * full[1]))


def finer_sizes(drawn: Size, full: Size) -> list[Size]:
    """Return the sizes to go on with, each twice the one before, to ``full``; empty where that is drawn."""
    sizes = []
    width = drawn[0]
    while width < full[0]:
        # The last step is not worth a picture of its own where it is small.
        width = 2 * width if 3 * width < full[0] else full[0]
        sizes.append(full if width == full[0] else scaled(full, width / full[0]))
    return sizes


class Request(NamedTuple):
    """What a tab wants to see: a view, full size in px, settings; and the number by which it knows that."""

    view: View
    size: Size
    settings: Settings
    number: int = 0


class RenderLoop:
    """Draws what one tab asked for last, in a thread of its own, as often and as large as time allows.

    A request is answered by a small picture; after a rest larger ones follow, up to the full size. A new
    request ends a larger picture at once, and a small one that has taken too long, after which the next is
    smaller; the smallest is always finished, so that something is seen.

    Args:
        send: Called with each picture, whether it is the final one, and the request's number; in the loop's
            thread.
        fail: Called with what could not be drawn or sent; in the loop's thread.
    """

    def __init__(
        self,
        scene_view: SceneView,
        send: Callable[[Frame, bool, int], None],
        fail: Callable[[Exception], None],
        pacer: Pacer | None = None,
    ) -> None:
        self._scene_view, self._send, self._fail = scene_view, send, fail
        self._pacer, self._steps = pacer or Pacer(), _core.BudgetSteps()
        self._changed = threading.Condition()
        self._request: Request | None = None
        self._is_closed = False
        self._stop, self._patience_ends = _core.Stop(), 0.0
        self._thread = threading.Thread(target=self._run, name="v3dg render loop", daemon=True)
        self._thread.start()

    def ask(self, request: Request) -> None:
        """Ask for a picture, in place of what was asked for before."""
        with self._changed:
            self._request = request
            if time.monotonic() >= self._patience_ends:
                self._stop.request()
            self._changed.notify()

    def close(self, seconds: float) -> bool:
        """Draw nothing more; returns whether the thread has ended, waiting so long for it."""
        with self._changed:
            self._is_closed = True
            self._stop.request()
            self._changed.notify()
        self._thread.join(seconds)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(self._has_news)
                request, self._request = self._request, None
            if self._is_closed or request is None:
                return
            try:
                self._draw(request)
            except Stopped:
                pass
            except Exception as error:  # a tab that shows the reason is better than one that stands still
                with contextlib.suppress(Exception):
                    self._fail(error)

    def _draw(self, request: Request) -> None:
        draft = self._pacer.draft(request.size)
        settings = self._while_moving(request.settings, draft)
        stop = self._begin(PATIENCE_SECONDS if draft.coarser < _COARSEST else math.inf)
        start = time.perf_counter()
        try:
            frame = self._scene_view.frame(request.view, draft.size, settings, stop, self._steps)
        finally:  # where it was stopped, it would have taken so long at least
            self._pacer.drew(draft, 1e3 * (time.perf_counter() - start))
        sizes = finer_sizes(draft.size, request.size)
        if settings != request.settings and not sizes:
            sizes = [draft.size]
        is_whole = self._scene_view.pool is None
        self._send(frame, not sizes and is_whole, request.number)
        with self._changed:
            if self._changed.wait_for(self._has_news, REST_SECONDS):
                return
        self._pacer.rested()
        is_larger, has_budget = draft.size != request.size, request.settings.budget is not None
        steps = None if is_larger else self._steps
        for size in sizes:
            frame = self._scene_view.frame(request.view, size, request.settings, self._begin(0.0), steps)
            if self._has_news():
                return
            self._send(frame, size == sizes[-1] and is_whole, request.number)
        while not is_whole:
            how = request.settings, self._begin(0.0), None, PAGES_SECONDS
            frame = self._scene_view.frame(request.view, request.size, *how)
            if self._has_news():
                return
            is_whole = not frame.figures.missing
            self._send(frame, is_whole, request.number)
        is_on_way = has_budget and not is_larger and self._scene_view.pool is None
        while is_on_way:  # for a budget's tolerance goes in steps
            before, stop = frame.figures.tolerance, self._begin(0.0)
            frame = self._scene_view.frame(request.view, draft.size, request.settings, stop, steps)
            self._send(frame, True, request.number)
            is_on_way = frame.figures.tolerance != before

    def _while_moving(self, settings: Settings, draft: Draft) -> Settings:
        """What of the settings there is time for."""
        draws_all = self._scene_view.draws_all_while_moving
        if not draws_all and (settings.split > 0 or settings.shows == "difference"):
            settings = replace(settings, shows="appearance", split=0.0)
        least = 0.0 if draws_all and draft.coarser == 1 else DEFAULT_TOLERANCE
        return replace(settings, tolerance=max(settings.tolerance, least) * draft.coarser)

    def _has_news(self) -> bool:
        return self._is_closed or self._request is not None

    def _begin(self, patience: float) -> _core.Stop:
        """Return what ends the next picture once something new is asked for, after so many seconds."""
        with self._changed:
            self._stop, self._patience_ends = _core.Stop(), time.monotonic() + patience
            if self._is_closed or (patience == 0 and self._request is not None):
                self._stop.request()
            return self._stop
