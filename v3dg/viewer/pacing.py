"""Decides the size and the time of pictures. While the camera moves, they are small;
then they become larger and larger."""

import contextlib
import math
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple, Protocol

from v3dg import _core
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.viewer.frame import Frame, SceneView, Settings, Stopped
from v3dg.viewer.view import View

Size = tuple[int, int]

# Target time, in ms, of one picture while the camera moves. A drag is then answered in
# less than twice this time.
TARGET_MS = 60.0
# A larger picture is started if nothing has changed for this many seconds.
REST_SECONDS = 0.15
# While the camera rests, a picture waits this many seconds for missing pages. As long
# as pages are missing, more pictures follow.
PAGES_SECONDS = 0.1
# If a draft has taken this many seconds, it is abandoned when another picture is
# requested.
PATIENCE_SECONDS = 4e-3 * TARGET_MS
# The width of the smallest draft as a fraction of the full width. If drawing it is
# still too slow, the tolerance is multiplied, up to the second number.
_SMALLEST = 1 / 4
_COARSEST = 64.0
# Sizes are rounded to this number of steps per factor of two, so that they do not
# change with every picture.
_STEPS_AN_OCTAVE = 4


class Draft(NamedTuple):
    """The quality of pictures while the camera moves.

    Attributes:
        size: Width and height in px.
        coarser: Factor by which the tolerance is multiplied.
    """

    size: Size
    coarser: float = 1.0


class Pacer:
    """Chooses the size and the tolerance of a draft, so that it meets the target time.
    The choice is based on the times of earlier pictures.

    The model assumes that time is proportional to work, where work is the number of
    pixels divided by the factor of the tolerance. Each picture updates the measured
    speed. Even if the model is inaccurate, the choice converges to the target time.
    """

    def __init__(self, target_ms: float = TARGET_MS) -> None:
        self._target_ms = target_ms
        self._work_per_ms = 0.0

    def draft(self, full: Size) -> Draft:
        """Return the draft for a picture of size ``full``.

        The draft has about the same aspect ratio as ``full`` and is not larger. The
        first draft has a quarter of the width.
        """
        whole = math.prod(full)
        share = (self._target_ms * self._work_per_ms or whole / 16) / whole
        # The small term prevents rounding from excluding a step that fits exactly.
        scale = 2 ** (math.floor(_STEPS_AN_OCTAVE * math.log2(share) / 2 + 1e-6) / _STEPS_AN_OCTAVE)
        coarser = min(max((_SMALLEST / scale) ** 2, 1.0), _COARSEST)
        return Draft(scaled(full, min(max(scale, _SMALLEST), 1.0)), coarser)

    def drew(self, draft: Draft, milliseconds: float) -> None:
        """Update the measured speed with the time of a picture."""
        speed = math.prod(draft.size) / draft.coarser / max(milliseconds, 0.1)
        # A lower speed is adopted immediately, a higher one only gradually.
        share = 1.0
        if speed > self._work_per_ms > 0:
            share = 0.3
        self._work_per_ms += share * (speed - self._work_per_ms)

    def rested(self) -> None:
        """Halve the work of the next draft, because the browser on the same CPU is
        still decoding the large picture."""
        self._work_per_ms /= 2


def scaled(full: Size, scale: float) -> Size:
    """Return a size in px multiplied by a factor. It is at least 1 x 1."""
    return max(1, round(scale * full[0])), max(1, round(scale * full[1]))


def finer_sizes(drawn: Size, full: Size) -> list[Size]:
    """Return the sizes to draw after ``drawn``, up to ``full``. Each has twice as many
    px as the one before. If ``drawn`` is already that large, return none."""
    sizes = []
    width = drawn[0]
    while width < full[0]:
        # A last step by a factor of less than 1.5 is not worth another picture.
        if 3 * width >= full[0]:
            sizes.append(full)
            break
        width *= 2
        sizes.append(scaled(full, width / full[0]))
    return sizes


class Request(NamedTuple):
    """A picture that a tab requests.

    Attributes:
        size: Width and height of the full picture in px.
        number: Identifies the pictures that answer this request.
    """

    view: View
    size: Size
    settings: Settings
    number: int = 0


class SendFrame(Protocol):
    """Sends a picture to the web page. ``number`` is that of its request, and
    ``is_final`` marks the last picture for the request."""

    def __call__(self, frame: Frame, number: int, *, is_final: bool) -> None: ...


class RenderLoop:
    """Draws the most recent request of a tab in a separate thread, as often and as
    large as time allows.

    A request is answered by a small picture. If no other request arrives, larger ones
    follow, up to the full size. A new request immediately ends a larger picture. It
    also ends a small picture that has already taken too long, and the next one is
    smaller. The smallest picture is always finished, so that something is shown.

    Args:
        send: Called in the loop's thread with each picture.
        fail: Called in the loop's thread with each error of drawing or sending.
    """

    def __init__(
        self,
        scene_view: SceneView,
        send: SendFrame,
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
        """Request a picture. It replaces the previous request."""
        with self._changed:
            self._request = request
            if time.monotonic() >= self._patience_ends:
                self._stop.request()
            self._changed.notify()

    def close(self, seconds: float) -> bool:
        """Stop drawing. Wait at most `seconds` for the thread. Return whether it has
        ended."""
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
                # After an error, the loop continues, and the tab shows the reason.
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
        self._send(frame, request.number, is_final=not sizes and not has_pool)
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
            is_last = size == sizes[-1]
            self._send(frame, request.number, is_final=is_last and not has_pool)
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
        finally:
            # If the picture had not been stopped, it would have taken at least this
            # long.
            self._pacer.drew(draft, 1e3 * (time.perf_counter() - start))

    def _draw_until_complete(self, request: Request) -> None:
        """Draw pictures from a pool until no page is missing."""
        is_complete = False
        while not is_complete:
            stop = self._begin(0.0)
            frame = self._scene_view.frame(
                request.view, request.size, request.settings, stop, patience=PAGES_SECONDS
            )
            if self._has_news():
                return
            is_complete = not frame.figures.missing
            self._send(frame, request.number, is_final=is_complete)

    def _draw_until_settled(self, request: Request, tolerance: float) -> None:
        """Draw pictures until the tolerance no longer changes. It approaches the
        tolerance of the budget in steps."""
        is_settled = False
        while not is_settled:
            stop = self._begin(0.0)
            frame = self._scene_view.frame(
                request.view, request.size, request.settings, stop, self._steps
            )
            self._send(frame, request.number, is_final=True)
            is_settled = frame.figures.tolerance == tolerance
            tolerance = frame.figures.tolerance

    def _while_moving(self, settings: Settings, draft: Draft) -> Settings:
        """Return the settings for pictures while the camera moves. Modes that are too
        slow are replaced."""
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
        """Return the flag that can stop the next picture.

        A new request stops the picture only if it arrives at least ``patience`` seconds
        from now.
        """
        with self._changed:
            self._stop = _core.Stop()
            self._patience_ends = time.monotonic() + patience
            if self._is_closed or (patience == 0 and self._request is not None):
                self._stop.request()
            return self._stop
