"""Measures many pictures in separate processes, and averages the results."""

import contextlib
import multiprocessing
import statistics
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from typing import NamedTuple, TypeVar, cast

from v3dg import _system
from v3dg._json import JsonObject

T = TypeVar("T")
R = TypeVar("R")


class _Judge(NamedTuple):
    """A measuring process, and this process's end of its pipe."""

    process: SpawnProcess
    pipe: Connection


class Judges:
    """Processes that measure items. A process is started when it is first needed, and
    ended by `close`."""

    def __init__(self) -> None:
        self._cores = _system.num_processors()
        self._judges: list[_Judge] = []

    def measured(self, items: Iterable[T], measure: Callable[[T], R]) -> Iterator[tuple[T, R]]:
        """Yield each item with the result of ``measure`` for it, in order. While items
        are measured, later ones are already produced.

        ``measure`` must be defined at the top level of a module, because other
        processes import it.
        """
        waiting: deque[tuple[T, Connection]] = deque()
        try:
            for number, item in enumerate(items):
                if len(waiting) == self._cores:
                    measured_item, pipe = waiting.popleft()
                    yield measured_item, cast(R, _answer(pipe))
                pipe = self._pipe(number % self._cores)
                pipe.send((measure, item))
                waiting.append((item, pipe))
            while waiting:
                measured_item, pipe = waiting.popleft()
                yield measured_item, cast(R, _answer(pipe))
        except BaseException:
            # End the processes, because results that are still pending would be
            # mistaken for results of later items.
            self.close()
            raise

    def _pipe(self, number: int) -> Connection:
        """Return the pipe to a process. If the process is not running yet, start it."""
        if number == len(self._judges):
            # starting the tracker unblocks signals, so do it before blocking them
            resource_tracker.ensure_running()
            # Only the parent process handles Ctrl-C. A new process must not be
            # interrupted before it can ignore the signal.
            previous_mask = _system.block_signals(_system.SIGNALS)
            try:
                # CUDA and OpenMP do not work in a forked process.
                context = multiprocessing.get_context("spawn")
                pipe, pipe_of_judge = context.Pipe()
                process = context.Process(target=_judge, args=(pipe_of_judge,), daemon=True)
                process.start()
                pipe_of_judge.close()
                self._judges.append(_Judge(process, pipe))
            finally:
                _system.set_blocked_signals(previous_mask)
        return self._judges[number].pipe

    def close(self) -> None:
        for judge in self._judges:
            judge.process.kill()
        for judge in self._judges:
            judge.process.join()
        self._judges = []


def _judge(pipe: Connection) -> None:
    """Measure the items that arrive, until the other end of the pipe is closed."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            measure, item = pipe.recv()
            try:
                pipe.send((measure(item), None))
            except Exception as error:
                pipe.send((None, error))


def _answer(pipe: Connection) -> object:
    result: object
    error: Exception | None
    try:
        result, error = pipe.recv()
    except (EOFError, ConnectionError):
        raise RuntimeError(
            "a worker that measures pictures was killed; try again with more free memory"
        ) from None
    if error is not None:
        raise error
    return result


def mean_of(rows: Sequence[Mapping[str, float | None]], *names: str) -> JsonObject:
    """Return the mean of each column, rounded to six significant digits. It is None for
    a column without values."""
    means: dict[str, float | None] = {}
    for name in names:
        values = [value for row in rows if (value := row.get(name)) is not None]
        means[name] = None
        if values:
            means[name] = float(f"{statistics.fmean(values):.6g}")
    return means
