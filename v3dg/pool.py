"""Pools: the part of a scene's bundles that is resident, in memory of a fixed size."""

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeAlias

from v3dg import _core, _device
from v3dg._device import Device
from v3dg.build.memory import free_bytes
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.false_color import ColorBy
from v3dg.residency import ResidentScene, residency

_RESERVE_BYTES = 1 << 30  # at most, for frames, tables and whatever else
_View: TypeAlias = tuple[_core.Camera | _core.Eyes, _core.Rule]
NUM_THREADS = 8  # that read pages; a disk answers several at once
_WAIT_SECONDS = 0.05  # until Ctrl-C is heard


def free_on(device: Device) -> int:
    """Bytes of memory that a device can give."""
    if not device.is_cuda:
        return free_bytes()
    import torch

    _device.spare_memory(device)
    return int(torch.cuda.mem_get_info(device.number)[0])


def chosen_bytes(bundles: Sequence[Bundle], device: Device) -> int | None:
    """Of a pool of half of what is free on the device, where not all fits there; None where it does."""
    for where, num_bytes in residency.bytes_to_add(bundles, device).items():
        free = free_on(where)
        if num_bytes > free - min(free // 4, _RESERVE_BYTES):
            return free_on(device) // 2
    return None


@dataclass(frozen=True)
class PoolLook:
    """What a picture of a pool shows, and of which cut; anything but "appearance" is for the CPU alone.

    Attributes:
        shows: Colours as in `v3dg.render`, the share of the tolerance that metrics take as grey, or how many
            gaussians a pixel is blended of, in place of depth.
        chooser: Whose cut it is; None: that of the camera.
        aside: Draw what was there for the last picture, and neither bring pages nor ask for any.
    """

    shows: ColorBy | Literal["error", "count"] = "appearance"
    chooser: Camera | None = None
    aside: bool = False

    def options(self, bundles: Sequence[Bundle]) -> dict[str, Any]:
        """What the core takes."""
        by: Any = self.shows if self.shows in ("level", "cluster") else None
        palettes = [] if by is None else [residency.palette(bundle, by) for bundle in bundles]
        chooser = self.chooser and self.chooser.core
        return {"shows": self.shows, "colors": palettes, "chooser": chooser, "aside": self.aside}


class Pool:
    """Pages of bundles in a fixed amount of memory of one device, which come and go as views need them.

    Attributes:
        tables: Those of its bundles.
        num_bytes: The memory that it was given.
        lease: Held by a thread from `settle` until its picture is drawn, so that no other thread's view takes
            the place of what it has settled.
    """

    def __init__(
        self, bundles: tuple[Bundle, ...], tables: list[_core.ClusterTable], device: Device, num_bytes: int
    ) -> None:
        self.tables = tables
        self.num_bytes = num_bytes
        self.lease = threading.RLock()
        sources = [bundle.page_source for bundle in bundles]
        self.core = _core.PagePool(tables, sources, device.number, num_bytes, NUM_THREADS)

    def settle(self, resident: ResidentScene, view: _View, timeout: float, seconds: float) -> None:
        """Bring in what a view needs, or as much of it as comes in so many seconds.

        Raises:
            ValueError: A page is damaged.
            OSError: A page cannot be read; TimeoutError when none came in for `timeout` seconds.
        """
        core = self.core
        camera, rule = view
        start = time.monotonic()
        last_arrival = start
        pages_in = -1
        begins = True
        while True:
            with residency.turn(resident.device):
                step = core.settle_step(resident.core, camera, rule, begins)
            begins = False
            status = core.status()
            now = time.monotonic()
            if status.failed:
                raise (ValueError if status.is_damage else OSError)(status.error)
            if step.is_decided and core.raise_tolerance(step.tolerance_px2):
                continue
            is_settled = step.is_decided and step.num_absent == 0
            if is_settled or now - start > seconds:
                return
            if status.pages_in != pages_in:
                pages_in = status.pages_in
                last_arrival = now
            elif now - last_arrival > timeout:
                raise TimeoutError(
                    f"settle: {step.num_absent} pages are missing and none came in for {timeout:g} s; "
                    "is the disk or the server at work?"
                )
            core.wait(_WAIT_SECONDS)


class PoolSlot:
    """The pool that stills of one subject share on one device: the last one that was asked for."""

    def __init__(self) -> None:
        self._pool: Pool | None = None

    @property
    def num_bytes(self) -> int | None:
        """The size of the pool that is there; None without one."""
        return None if self._pool is None else self._pool.num_bytes

    def pool(
        self,
        bundles: tuple[Bundle, ...],
        tables: list[_core.ClusterTable],
        device: Device,
        num_bytes: int,
    ) -> Pool:
        """A pool of these bundles and of this size. Another one is given up first, for its memory is needed.

        Requires the lock of `residency`.
        """
        pool = self._pool
        if pool is not None and pool.tables == tables and pool.num_bytes == num_bytes:
            return pool
        self._pool = pool = None
        pool = Pool(bundles, tables, device, num_bytes)
        self._pool = pool
        return pool
