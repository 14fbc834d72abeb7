"""Pools: the part of a scene's bundles that is resident, in memory of a fixed size."""

import time
from collections.abc import Sequence
from contextlib import nullcontext
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
    """Pages of bundles in a fixed amount of memory of one device, which come and go as views need them."""

    def __init__(
        self, bundles: tuple[Bundle, ...], tables: list[_core.ClusterTable], device: Device, num_bytes: int
    ) -> None:
        self.tables = tables
        sources = [bundle.page_source for bundle in bundles]
        self.core = _core.PagePool(tables, sources, device.number, num_bytes, NUM_THREADS)

    def settle(self, resident: ResidentScene, view: _View, timeout: float, seconds: float) -> None:
        """Bring in what a view needs, or as much of it as comes in so many seconds.

        Raises:
            ValueError: A page is damaged.
            OSError: A page cannot be read; TimeoutError when none came in for `timeout` seconds.
        """
        core = self.core
        core.forget_failures()
        core.reset_tolerance()
        last, known, end = time.monotonic(), -1, time.monotonic() + seconds

        while True:
            with residency.lock if resident.device.is_cuda else nullcontext():  # it stays as it is
                tolerance = core.ask(resident.core, *view)
            status = core.status()
            if status.failed:
                raise (ValueError if status.is_damage else OSError)(status.error)
            if core.raise_tolerance(tolerance):
                continue
            if not status.missing or time.monotonic() > end:
                return
            if status.pages_in != known:
                last, known = time.monotonic(), status.pages_in
            elif time.monotonic() - last > timeout:
                missing = f"{status.missing} pages are missing and none came in for {timeout:g} s"
                raise TimeoutError(f"settle: expected the disk or the server to answer, but {missing}")
            core.wait(_WAIT_SECONDS)
