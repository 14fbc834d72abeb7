"""Many pictures measured, a core each, and means of what was found."""

import contextlib
import multiprocessing
import os
import signal
import statistics
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any, TypeVar

from v3dg._start import SIGNALS

T = TypeVar("T")
R = TypeVar("R")


class Judges:
    """Processes that measure what they are given: started when they are first needed, there until `close`."""

    def __init__(self) -> None:
        self._cores = len(os.sched_getaffinity(0))
        self._processes: list[tuple[Any, Any]] = []  # each with the pipe to it

    def measured(self, items: Iterable[T], measure: Callable[[T], R]) -> Iterator[tuple[T, R]]:
        """Items with what a function of a module says of each, in order; later ones are made meanwhile."""
        waiting: deque[tuple[T, Any]] = deque()
        try:
            for number, item in enumerate(items):
                if len(waiting) == self._cores:
                    yield _answered(*waiting.popleft())
                pipe = self._pipe(number % self._cores)
                pipe.send((measure, item))
                waiting.append((item, pipe))
            while waiting:
                yield _answered(*waiting.popleft())
        except BaseException:  # answers that nobody waits for would be taken for the next ones
            self.close()
            raise

    def _pipe(self, number: int) -> Any:
        """The pipe to a process, which is started if it is the next one."""
        if number == len(self._processes):
            resource_tracker.ensure_running()  # which hears signals again once it has started
            # Ctrl-C is for this process alone: one that is started has no time for it, even to ignore it.
            heard = signal.pthread_sigmask(signal.SIG_BLOCK, SIGNALS)
            try:
                # A forked process would inherit CUDA and OpenMP in a state that neither survives.
                context = multiprocessing.get_context("spawn")
                ours, theirs = context.Pipe()
                process = context.Process(target=_judge, args=(theirs,), daemon=True)
                process.start()
                theirs.close()
                self._processes.append((process, ours))
            finally:
                signal.pthread_sigmask(signal.SIG_SETMASK, heard)
        return self._processes[number][1]

    def close(self) -> None:
        for process, _ in self._processes:
            process.kill()
        for process, _ in self._processes:
            process.join()
        self._processes = []


def _judge(pipe: Connection) -> None:
    """Measure what comes, until whoever asks has gone."""
    with contextlib.suppress(EOFError, OSError):
        while True:
            measure, item = pipe.recv()
            try:
                pipe.send((measure(item), None))
            except Exception as error:
                pipe.send((None, error))


def _answered(item: T, pipe: Any) -> tuple[T, Any]:
    try:
        result, error = pipe.recv()
    except (EOFError, ConnectionError):
        raise RuntimeError("a process that measures pictures was ended from outside") from None
    if error is not None:
        raise error
    return item, result


def mean_of(rows: Sequence[dict[str, Any]], *names: str) -> dict[str, Any]:
    """Means of columns, to six digits; None where every value is missing."""
    means: dict[str, Any] = {}
    for name in names:
        values = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(f"{statistics.fmean(values):.6g}") if values else None
    return means
