"""Pools: memory of a fixed size for the resident pages of a scene's bundles."""

import threading
import time
from collections.abc import Sequence

from v3dg import _core
from v3dg._device import Device
from v3dg.bundle import Bundle
from v3dg.levels.memory import free_on
from v3dg.residency import ResidentScene, residency

# Maximum amount of memory that stays free for frames, tables and other data.
_RESERVE_BYTES = 1 << 30
# number of threads that read pages; disks process several requests at once
NUM_THREADS = 8
_WAIT_SECONDS = 0.05  # maximum delay before Ctrl-C is handled


def chosen_bytes(bundles: Sequence[Bundle], device: Device) -> int | None:
    """Return the size of a pool on a device in bytes, which is half of its free memory.
    Return None if all gaussians fit without a pool."""
    for memory, num_bytes in residency.bytes_to_add(bundles, device).items():
        free = free_on(memory)
        if num_bytes > free - min(free // 4, _RESERVE_BYTES):
            return free_on(device) // 2
    return None


class Pool:
    """Memory of a fixed size on one device for pages of bundles. As views need them,
    pages are loaded into it and evicted from it.

    Attributes:
        tables: The tables of the bundles.
        num_bytes: The size of the pool in bytes.
        lease: A lock that a thread holds from `settle` until its picture is drawn, so
            that views of other threads do not evict the pages in between.
    """

    def __init__(
        self,
        bundles: tuple[Bundle, ...],
        tables: list[_core.ClusterTable],
        device: Device,
        num_bytes: int,
    ) -> None:
        self.tables = tables
        self.num_bytes = num_bytes
        self.lease = threading.RLock()
        sources = [bundle.page_source for bundle in bundles]
        self.core = _core.PagePool(tables, sources, device.number, num_bytes, NUM_THREADS)

    def settle(
        self,
        resident: ResidentScene,
        camera: _core.Camera | _core.Eyes,
        rule: _core.Rule,
        timeout: float,
        seconds: float,
    ) -> None:
        """Bring in the pages that a view needs, or as many of them as arrive within
        ``seconds``.

        Raises:
            ValueError: A page is damaged.
            OSError: A page cannot be read. TimeoutError: No page arrived for `timeout`
                seconds.
        """
        core = self.core
        start = time.monotonic()
        last_arrival = start
        pages_in = -1
        begins = True
        while True:
            with residency.turn(resident.device):
                step = core.settle_step(resident.core, camera, rule, begins)
            begins = False
            status = core.status()
            time_of_step = time.monotonic()
            if status.failed and status.is_damage:
                raise ValueError(status.error)
            if status.failed:
                raise OSError(status.error)
            if step.is_decided and core.raise_tolerance(step.tolerance_px2):
                continue
            is_settled = step.is_decided and step.num_absent == 0
            if is_settled or time_of_step - start > seconds:
                return
            if status.pages_in != pages_in:
                pages_in = status.pages_in
                last_arrival = time_of_step
            elif time_of_step - last_arrival > timeout:
                raise TimeoutError(
                    f"settle: {step.num_absent} pages are missing and none arrived for {timeout:g} "
                    "s; check that the disk or the server responds"
                )
            core.wait(_WAIT_SECONDS)


class PoolSlot:
    """The pool that single pictures of one subject share on one device. Only the most
    recently requested pool is kept."""

    def __init__(self) -> None:
        self._pool: Pool | None = None

    @property
    def num_bytes(self) -> int | None:
        """The size of the pool in bytes; None if there is no pool."""
        if self._pool is None:
            return None
        return self._pool.num_bytes

    def pool(
        self,
        bundles: tuple[Bundle, ...],
        tables: list[_core.ClusterTable],
        device: Device,
        num_bytes: int,
    ) -> Pool:
        """Return a pool of this size for these bundles. If the current pool does not
        match, it is freed first, because its memory may be needed.

        The caller must hold the lock of `residency`.
        """
        pool = self._pool
        if pool is not None and pool.tables == tables and pool.num_bytes == num_bytes:
            return pool
        pool = None
        self._pool = None
        pool = Pool(bundles, tables, device, num_bytes)
        self._pool = pool
        return pool
