"""Files at places that fsspec knows besides the web."""

import contextlib
import re
import threading
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from typing import Any, TypeAlias

from v3dg._urls.failures import Problem

Write: TypeAlias = Callable[[bytes, int], None]
"""Puts bytes at a place of the file that is read."""

_STEP_BYTES = 1 << 20
# What says which content a file has, by its name in the answers of fsspec's packages.
_TAG = re.compile(
    r"tag|md5|sha|crc|checksum|digest|modif|mtime|created|updated|generation|version", re.IGNORECASE
)


class OtherSource:
    """One file of a file system of fsspec.

    Attributes:
        num_bytes: Size; None where that is not known before all is read.
        tag: Differs when the content does; empty where the place says nothing of the kind.
    """

    def __init__(self, there: Any, place: str) -> None:
        info: dict[str, Any] = there.info(place)
        self.num_bytes: int | None = info["size"]
        is_known = any(value for name, value in info.items() if _TAG.search(name))
        self.tag = str(info) if is_known else ""
        self._there = there
        self._place = place
        # Only file systems of the asynchronous kind are for several threads.
        self._lock: AbstractContextManager[Any] = (
            contextlib.nullcontext() if there.async_impl else threading.Lock()
        )

    def read_parts(self, parts: Sequence[tuple[int, int]], write: Write) -> bool:
        """Write the bytes from each first to each last; whether all of the file came instead."""
        firsts = [first for first, _ in parts]
        lasts = [last for _, last in parts]
        with self._lock:
            answers = self._there.cat_ranges([self._place] * len(parts), firsts, lasts)
        for (first, last), data in zip(parts, answers, strict=True):
            if isinstance(data, Exception):
                raise data
            if len(data) == self.num_bytes:  # this place gives no parts
                write(data, 0)
                return True
            if len(data) != last - first:
                raise changed(first, last, len(data))
            write(data, first)
        return False

    def read_all(self, most: int, write: Write) -> int:
        """Write the whole file, of at most so many bytes; its size."""
        done = 0
        with self._lock, self._there.open(self._place, "rb") as file:
            while data := file.read(_STEP_BYTES):
                if done + len(data) > most:
                    raise too_long(most)
                write(data, done)
                done += len(data)
        return done


def changed(first: int, last: int, num_bytes: int) -> Problem:
    """What another number of bytes than was asked for means."""
    got = f"{num_bytes}; it has changed, open it again"
    return Problem(ValueError, f"expected {last - first} bytes at {first}, got {got}")


def too_long(most: int) -> Problem:
    """What a file means that does not end."""
    return Problem(
        ValueError, f"expected at most {most} bytes, got more; check the address, or fetch the file"
    )
