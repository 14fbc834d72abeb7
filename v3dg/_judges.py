"""Many pictures measured, a core each, and means of what was found."""

from __future__ import annotations

import multiprocessing
import os
import signal
import statistics
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from typing import Any, TypeVar

T = TypeVar("T")
R = TypeVar("R")


class Judges:
    """Processes that measure what they are given: started when they are first needed, there until `close`."""

    def __init__(self) -> None:
        self._cores = len(os.sched_getaffinity(0))
        self._pool: ProcessPoolExecutor | None = None

    def measured(self, items: Iterable[T], measure: Callable[[T], R]) -> Iterator[tuple[T, R]]:
        """Items with what a function of a module says of each, in order; later ones are made meanwhile."""
        if self._pool is None:
            # A forked process would inherit CUDA and OpenMP in a state that neither survives.
            # Ctrl-C is for this process alone.
            context, ignore = multiprocessing.get_context("spawn"), (signal.SIGINT, signal.SIG_IGN)
            self._pool = ProcessPoolExecutor(self._cores, context, signal.signal, ignore)
        waiting: deque[tuple[T, Future[R]]] = deque()
        for item in items:
            waiting.append((item, self._pool.submit(measure, item)))
            if len(waiting) > self._cores:
                first, found = waiting.popleft()
                yield first, found.result()
        for item, found in waiting:
            yield item, found.result()

    def close(self) -> None:
        if self._pool is not None:
            self._pool.shutdown()


def mean_of(rows: Sequence[dict[str, Any]], *names: str) -> dict[str, Any]:
    """Means of columns, to six digits; None where every value is missing."""
    means: dict[str, Any] = {}
    for name in names:
        values = [row[name] for row in rows if row.get(name) is not None]
        means[name] = float(f"{statistics.fmean(values):.6g}") if values else None
    return means
