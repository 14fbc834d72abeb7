"""Shows the progress of long work: as a bar in a terminal, as a few lines in a log, or
by calls of a function."""

import contextlib
import logging
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, TypeAlias, TypeVar

if TYPE_CHECKING:
    from tqdm import tqdm as TerminalBar

T = TypeVar("T")
Progress: TypeAlias = bool | Callable[[int, int, str], object]
"""Whether to show progress, or a function that is called with the amount of finished
work, the total, and a text about the current work."""

_LOG = logging.getLogger("v3dg")
_LOG.addHandler(logging.NullHandler())
_LINES = 4  # number of log lines for one piece of work
_LEAST_SCALED = 10_000  # a bar counts in thousands or millions from this total on
_PATIENCE_SECONDS = 2.0  # Work that takes less time shows nothing.


class Bar:
    """A display of finished work as a part of a total.

    Raises:
        TypeError: ``progress`` is neither a boolean nor a function.
    """

    def __init__(self, total: int, name: str, progress: Progress, *, initial: int = 0) -> None:
        if not isinstance(progress, bool) and not callable(progress):
            raise TypeError(f"progress: expected True, False or a function, got {progress!r}")
        self.total = total
        self.num_done = initial
        self._name = name
        self._text = name
        self._num_logged = self._num_lines
        self._call: Callable[[int, int, str], object] | None = None
        if not isinstance(progress, bool):
            self._call = progress
        self._is_shown = progress is True
        self._bar: TerminalBar | None = None
        if self._is_shown and sys.stderr.isatty():
            from tqdm import tqdm

            self._bar = tqdm(
                desc=name,
                total=total,
                initial=initial,
                leave=False,
                unit_scale=total >= _LEAST_SCALED,
                dynamic_ncols=True,
            )

    @property
    def _num_lines(self) -> int:
        return _LINES * self.num_done // max(self.total, 1)

    def __enter__(self: T) -> T:
        return self

    def close(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.close()

    __exit__ = close

    def update(self, count: int, text: str = "") -> None:
        """Add `count` to the finished work, and show `text` about the current work."""
        self.num_done += count
        if text:
            self._text = f"{self._name}, {text}"
        if self._bar is not None:
            self._bar.set_description(self._text, refresh=False)
            self._bar.update(count)
        if self._call is not None:
            self._call(self.num_done, self.total, self._text)
        if self._num_lines > self._num_logged:
            self._num_logged = self._num_lines
            line = f"{self._text}: {100 * self.num_done // max(self.total, 1)} %"
            _LOG.info(line)
            if self._is_shown and self._bar is None:
                print(line, file=sys.stderr, flush=True)


def counted(items: Iterable[T], total: int, name: str, progress: Progress) -> Iterator[T]:
    """Yield the items. An item counts as finished when the next one is requested."""
    with Bar(total, name, progress) as bar:
        for item in items:
            yield item
            bar.update(1)


@contextlib.contextmanager
def waiting(text: str, *, show: bool) -> Iterator[None]:
    """Show that work of unknown duration is in progress, if it takes more than two
    seconds. A terminal shows the elapsed seconds, and a log gets one line."""
    if not show:
        yield
        return
    is_done = threading.Event()
    thread = threading.Thread(target=_show_waiting, args=(text, is_done), daemon=True)
    thread.start()
    try:
        yield
    finally:
        is_done.set()
        thread.join()


def _show_waiting(text: str, is_done: threading.Event) -> None:
    start = time.monotonic()
    if is_done.wait(_PATIENCE_SECONDS):
        return
    is_terminal = sys.stderr.isatty()
    if not is_terminal:
        print(f"{text} ...", file=sys.stderr, flush=True)
        return
    while True:
        seconds = time.monotonic() - start
        print(f"\r{text} ... {seconds:.0f} s", end="", file=sys.stderr, flush=True)
        if is_done.wait(1.0):
            # This sequence erases the line.
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
            return
