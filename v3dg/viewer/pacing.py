"""How large to draw, and when: small while things move, larger step by step once they
rest."""

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

# Of one picture while the camera moves; a drag then has an answer in less than twice
# that.
TARGET_MS = 60.0
# Without a change for so long, a larger picture is begun.
REST_SECONDS = 0.15
# What a picture at rest waits for pages; another one follows as long as some are
# missing.
PAGES_SECONDS = 0.1
# A draft that has taken so long is given up for what is asked for now.
PATIENCE_SECONDS = 4e-3 * TARGET_MS
# Smaller ones show nothing; from there on the cut gets coarser, which shows less.
_SMALLEST = 1 / 4
_COARSEST = 64.0
# Sizes are this far apart, so that they do not change from picture to picture.
_STEPS_AN_OCTAVE = 4


class Draft(NamedTuple):
    """How to draw what passes by: its size in px, and what the tolerance is multiplied
    by."""

    size: Size
    coarser: float = 1.0


class Pacer:
    """Chooses how to draw a picture in time, from how long earlier ones took.

    Time is taken to be proportional to work, pixels over the factor of the tolerance,
    measured with the picture that was drawn last: where it is not, the choice still
    settles at the one that takes the target.
    """

    def __init__(self, target_ms: float = TARGET_MS) -> None:
        self._target_ms = target_ms
        self._work_per_ms = 0.0

    def draft(self, full: Size) -> Draft:
        """Return a size with about the shape of ``full``, not larger, at first a
        quarter of its width."""
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
        share = 1.0
        if speed > self._work_per_ms > 0:
            share = 0.3
        self._work_per_ms += share * (speed - self._work_per_ms)

    def rested(self) -> None:
        """Take half the work for the next: a browser on these cores has a large picture
        to move then."""
        self._work_per_ms /= 2


def scaled(full: Size, scale: float) -> Size:
    return max(1, round(scale * full[0])), max(1, round(scale * full[1]))


def finer_sizes(drawn: Size, full: Size) -> list[Size]:
    """Return the sizes to go on with, each twice the one before, to ``full``; empty
    where that is drawn."""
    sizes = []
    width = drawn[0]
    while width < full[0]:
        # The last step is not worth a picture of its own where it is small.
        if 3 * width >= full[0]:
            sizes.append(full)
            break
        width *= 2
        sizes.append(scaled(full, width / full[0]))
    return sizes


class Request(NamedTuple):
    """What a tab wants to see: a view, full size in px, settings; and the number by
    which it knows that."""

    view: View
    size: Size
    settings: Settings
    number: int = 0


class RenderLoop:
    """Draws what one tab asked for last, in a thread of its own, as often and as large
    as time allows.

    A request is answered by a small picture; after a rest larger ones follow, up to the
    full size. A new request ends a larger picture at once, and a small one that has
    taken too long, after which the next is smaller; the smallest is always finished, so
    that something is seen.

    Args:
        send: Called with each picture, whether it is the final one, and the request's
            number; in the loop's thread.
        fail: Called with what could not be drawn or sent; in the loop's thread.
    """

    def __init__(
        self,
        scene_view: SceneView,
        send: Callable[[Frame, bool, int], None],
        fail: Callable[[Exception], None],
        pacer: Pacer | None = None,
    ) -> None:
        self._scene_view = scene_view
        self._send = send
        self._fail = fail
        self._pacer = pacer or Pacer()
        self._steps = _core.BudgetSteps()
        self._changed = threading.Condition()
        self._request: Request | None = None
        self._is_closed = False
        self._stop = _core.Stop()
        self._patience_ends = 0.0
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
        """Draw nothing more; returns whether the thread has ended, waiting so long for
        it."""
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
                request = self._request
                self._request = None
            if self._is_closed or request is None:
                return
            try:
                self._draw(request)
            except Stopped:
                pass
            except Exception as error:
                # a tab that shows the reason is better than one that stands still
                with contextlib.suppress(Exception):
                    self._fail(error)

    def _draw(self, request: Request) -> None:
        draft = self._pacer.draft(request.size)
        settings = self._while_moving(request.settings, draft)
        frame = self._draw_draft(request.view, draft, settings)
        sizes = finer_sizes(draft.size, request.size)
        if settings != request.settings and not sizes:
            sizes = [draft.size]
        has_pool = self._scene_view.pool is not None
        self._send(frame, not sizes and not has_pool, request.number)
        with self._changed:
            if self._changed.wait_for(self._has_news, REST_SECONDS):
                return
        self._pacer.rested()
        is_larger = draft.size != request.size
        steps: _core.BudgetSteps | None = self._steps
        if is_larger:
            steps = None
        for size in sizes:
            frame = self._scene_view.frame(
                request.view, size, request.settings, self._begin(0.0), steps
            )
            if self._has_news():
                return
            self._send(frame, size == sizes[-1] and not has_pool, request.number)
        if has_pool:
            self._draw_until_complete(request)
        elif request.settings.budget is not None and not is_larger:
            self._draw_until_settled(request, frame.figures.tolerance)

    def _draw_draft(self, view: View, draft: Draft, settings: Settings) -> Frame:
        patience = math.inf
        if draft.coarser < _COARSEST:
            patience = PATIENCE_SECONDS
        stop = self._begin(patience)
        start = time.perf_counter()
        try:
            return self._scene_view.frame(view, draft.size, settings, stop, self._steps)
        finally:  # a picture that was stopped would have taken at least as long
            self._pacer.drew(draft, 1e3 * (time.perf_counter() - start))

    def _draw_until_complete(self, request: Request) -> None:
        """Draw pictures from a pool until one misses no page."""
        is_complete = False
        while not is_complete:
            stop = self._begin(0.0)
            frame = self._scene_view.frame(
                request.view, request.size, request.settings, stop, patience=PAGES_SECONDS
            )
            if self._has_news():
                return
            is_complete = not frame.figures.missing
            self._send(frame, is_complete, request.number)

    def _draw_until_settled(self, request: Request, tolerance: float) -> None:
        """Draw pictures until the tolerance of a budget, which changes in steps, stays
        the same."""
        is_settled = False
        while not is_settled:
            stop = self._begin(0.0)
            frame = self._scene_view.frame(
                request.view, request.size, request.settings, stop, self._steps
            )
            self._send(frame, True, request.number)
            is_settled = frame.figures.tolerance == tolerance
            tolerance = frame.figures.tolerance

    def _while_moving(self, settings: Settings, draft: Draft) -> Settings:
        """What of the settings there is time for."""
        draws_all = self._scene_view.draws_all_while_moving
        if not draws_all and (settings.split > 0 or settings.shows == "difference"):
            settings = replace(settings, shows="appearance", split=0.0)
        smallest = DEFAULT_TOLERANCE
        if draws_all and draft.coarser == 1:
            smallest = 0.0
        return replace(settings, tolerance=max(settings.tolerance, smallest) * draft.coarser)

    def _has_news(self) -> bool:
        return self._is_closed or self._request is not None

    def _begin(self, patience: float) -> _core.Stop:
        """Return what ends the next picture once something new is asked for, after so
        many seconds."""
        with self._changed:
            self._stop = _core.Stop()
            self._patience_ends = time.monotonic() + patience
            if self._is_closed or (patience == 0 and self._request is not None):
                self._stop.request()
            return self._stop
