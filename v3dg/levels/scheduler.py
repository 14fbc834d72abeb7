"""Whether the dask scheduler behind an executor still answers, so that no build waits
for it without end.

A client of dask's that keeps its connection sends messages and waits for results: it
does not notice that a scheduler has stopped, on a machine that hangs, say. So the
scheduler is asked for next to nothing, again and again, while units are built. Only its
silence ends a build: units may take as long as they need, and workers that die are the
scheduler's to notice.
"""

import asyncio
import sys
from collections.abc import Collection, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, wait
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from distributed import Client

T = TypeVar("T")

# A scheduler that lives may be busy for long with the graphs of others, which its one
# thread works on.
_MOST_SILENCE_S = 120.0
_TICK_S = 5.0  # between two questions
_ADVICE = "look after it; finished units are kept, and a build that is resumed goes on from them"


class SchedulerError(RuntimeError):
    """A scheduler does not answer any more, or has dropped what it was asked to do."""


class Watch:
    """Asks the scheduler of one client, while that waits for results.

    Attributes:
        name: Of the scheduler, as errors give it.
    """

    def __init__(self, client: "Client") -> None:
        self.name = f"scheduler {client.scheduler.address}"
        self._client = client
        self._question: Future[None] | None = None
        self._silent_s = 0.0

    def hear(self) -> None:
        """Note that a result has come, which is an answer, too."""
        self._silent_s = 0.0

    def tick(self) -> None:
        """Note that another tick has passed; SchedulerError after too many without an
        answer.

        Ticks are counted and no clock is read: a process that was itself stopped for a
        while has heard nothing, and must not conclude anything from that.
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
    """A watch over the scheduler whose workers an executor has; None for executors of
    other kinds."""
    module = sys.modules.get("distributed.cfexecutor")
    if module is None or not isinstance(executor, module.ClientExecutor):
        return None
    client = executor._client  # dask gives the client no public name
    if client.scheduler is None:
        return None
    return Watch(client)


def completed(futures: Collection[Future[T]], watch: Watch | None) -> Iterator[Future[T]]:
    """Futures in the order in which they end; SchedulerError where the scheduler drops
    them or is silent."""
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
                watch.hear()
            else:
                watch.tick()
        yield from ended
