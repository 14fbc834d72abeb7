"""Checks that the dask scheduler of an executor still answers, so that a build does not
wait for it forever.

While a dask client has an open connection, it waits for results. It does not notice
when the scheduler stops, for example because its machine hangs. Therefore a small
request is sent to the scheduler repeatedly while units are built. Only a silent
scheduler ends a build: units may take any time, and the scheduler itself detects
workers that die.
"""

import asyncio
import sys
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")

# A scheduler has only one thread, which may be busy with the graphs of other clients
# for a long time.
_MOST_SILENCE_S = 120.0
_TICK_S = 5.0  # time between two requests
_ADVICE = "check that it runs; finished units are kept, and a resumed build continues from them"


class SchedulerError(RuntimeError):
    """The scheduler does not answer, or has dropped the units of the build."""


class Watch:
    """Detects a scheduler that no longer answers while its client waits for results.

    Attributes:
        name: The scheduler's name in error messages.
    """

    def __init__(self, client: "Client") -> None:
        self.name = f"scheduler {client.scheduler.address}"
        self._client = client
        self._question: Future[None] | None = None
        self._silent_s = 0.0

    def note_answer(self) -> None:
        """Record that a result has arrived, which counts as an answer."""
        self._silent_s = 0.0

    def tick(self) -> None:
        """Record that `_TICK_S` seconds have passed. Raise SchedulerError if the
        scheduler has not answered for more than `_MOST_SILENCE_S`.

        Ticks are counted instead of reading a clock, so that the time in which this
        process itself was stopped does not count.
        """
        self._silent_s += _TICK_S
        if self._question is not None and self._question.done():
            if not self._question.cancelled() and self._question.exception() is None:
                self._silent_s = 0.0
            self._question = None
        if self._silent_s > _MOST_SILENCE_S:
            raise SchedulerError(f"{self.name}: no answer for {_MOST_SILENCE_S:.0f} s; {_ADVICE}")
        if self._question is None and self._client.status == "running":
            loop = self._client.loop.asyncio_loop
            self._question = asyncio.run_coroutine_threadsafe(_ask(self._client), loop)


async def _ask(client: "Client") -> None:
    await client.scheduler.ncores(workers=[])


def watch_over(executor: Executor) -> Watch | None:
    """Return a watch for the scheduler of a dask executor. Return None for other
    executors."""
    module = sys.modules.get("distributed.cfexecutor")
    if module is None or not isinstance(executor, module.ClientExecutor):
        return None
    client = executor._client  # dask has no public name for this attribute
    if client.scheduler is None:
        return None
    return Watch(client)


def completed(futures: Collection[Future[T]], watch: Watch | None) -> Iterator[Future[T]]:
    """Yield futures in the order in which they end. Raise SchedulerError if the
    scheduler drops them or does not answer."""
    waiting = set(futures)
    timeout = None
    if watch is not None:
        timeout = _TICK_S
    while waiting:
        ended, waiting = wait(waiting, timeout, FIRST_COMPLETED)
        if watch is not None:
            if any(future.cancelled() for future in ended):
                raise SchedulerError(
                    f"{watch.name}: connection lost, or units cancelled; {_ADVICE}"
                )
            if ended:
                watch.note_answer()
            else:
                watch.tick()
        yield from ended
