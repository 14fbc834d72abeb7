"""The host memory that a build may use, and the number of units that fit into it."""

import re
from contextlib import suppress
from pathlib import Path
from typing import Literal

import numpy as np

from v3dg import _device, _system
from v3dg._device import Device
from v3dg._numbers import refuse, value_text
from v3dg.gaussians import gaussian_bytes
from v3dg.levels.leaves import Leaves
from v3dg.levels.whole import UNIT_LEAVES

_UNITS = {"": 1, "K": 1 << 10, "M": 1 << 20, "G": 1 << 30, "T": 1 << 40}
# Host memory per leaf of a unit, until its levels are written: a constant number of
# bytes, plus this many copies of the gaussian. It was measured for a unit of 1,048,576
# leaves: 380 bytes per leaf at SH degree 0, where a gaussian has 56 bytes, and 870
# bytes at degree 3, where it has 236.
_LEAF_BYTES = 320
_LEAF_COPIES = 2.5


def in_bytes(memory: int | str | None) -> int:
    """Convert bytes, or text like "8GiB", to an amount of memory in bytes. None means
    half of the free memory."""
    if memory is None:
        return free_bytes() // 2
    is_amount = isinstance(memory, str | int | float | np.number) and not isinstance(memory, bool)
    # Python may refuse to convert a very long integer to text.
    is_long = isinstance(memory, int) and memory.bit_length() > 128
    text = ""
    if is_amount and not is_long:
        text = str(memory)
    match = re.fullmatch(r"\s*(\d+(?:\.\d+)?)\s*([KMGT]?)(?:i?B)?\s*", text, re.IGNORECASE)
    if match is None or not float(match[1]) > 0:
        refuse(
            "memory", f"a positive number of bytes, or text like '8GiB', got {value_text(memory)}"
        )
    return int(min(float(match[1]) * _UNITS[match[2].upper()], 2.0**62))


def pool_bytes(memory: int | str | None) -> int | Literal["auto"] | None:
    """Check the memory of a renderer's pool, and return it: bytes, "auto", or None.
    Raise ValueError for other values."""
    if memory is None:
        return None
    if isinstance(memory, str) and memory == "auto":
        return "auto"
    return in_bytes(memory)


def most_units(memory: int, leaves: Leaves) -> int:
    """Return how many units may be in memory together with the leaves.

    It is at least one.
    """
    return max(
        1, (memory - leaves.resident_bytes) // unit_bytes(leaves.num_gaussians, leaves.sh_degree)
    )


def unit_bytes(num_gaussians: int, sh_degree: int) -> int:
    """Return the memory that a unit of an asset needs, in bytes."""
    return int(
        min(num_gaussians, UNIT_LEAVES) * (_LEAF_BYTES + _LEAF_COPIES * gaussian_bytes(sh_degree))
    )


def in_mib(num_bytes: int) -> str:
    """Return a number of bytes as text for messages. The value is rounded up to MiB."""
    return f"{-(-num_bytes >> 20):,} MiB"


def free_on(device: Device) -> int:
    """Return the bytes of memory that a device has available."""
    if not device.is_cuda:
        return free_bytes()
    import torch

    _device.spare_memory(device)
    return int(torch.cuda.mem_get_info(device.number)[0])


def free_bytes() -> int:
    """Return the free memory in bytes. In a container, this is at most what the
    container has free."""
    free = _system.available_memory()
    with suppress(OSError, ValueError):  # no cgroup, or no limit ("max")
        group = Path("/sys/fs/cgroup")
        limit = int((group / "memory.max").read_text())
        used = int((group / "memory.current").read_text())
        free = min(free, max(limit - used, 0))
    return free
