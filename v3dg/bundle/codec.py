"""Codecs: what the bytes of a page are.

A new codec is a class here with what `Codec` has; `codec_of` is where a file's header picks it.
"""

from __future__ import annotations

from dataclasses import fields
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from v3dg.gaussians import Gaussians

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from numpy.typing import NDArray


class Codec(Protocol):
    """Gaussians of one SH degree as bytes, page by page, and back."""

    sh_degree: int

    def page_bytes(self, num_gaussians: NDArray[np.int64]) -> NDArray[np.int64]:
        """Sizes of pages of so many gaussians, without what they are filled up with."""

    def most_gaussians(self, num_bytes: int) -> int:
        """How many gaussians so many bytes can hold."""

    def encode(self, gaussians: Gaussians, rows: slice) -> list[NDArray[Any]]:
        """Arrays whose bytes, one array after another, are those of the page that has these rows."""

    def decode(self, read: Callable[[Sequence[NDArray[Any]]], None], out: Gaussians, rows: slice) -> None:
        """Fill the rows with a page, whose bytes `read` reads into the arrays that it is given."""

    def empty(self, count: int) -> Gaussians:
        """Gaussians on the host to decode to, with any values."""


def codec_of(metadata: Mapping[str, str]) -> Codec:
    """The codec of a file with this header: version 1 of the format has one."""
    return Float32Codec(int(metadata["sh_degree"]))


class Float32Codec:
    """The arrays of a page's gaussians, float32, one whole array after another."""

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree

    @property
    def floats_per_gaussian(self) -> int:
        """3 mean, 4 quaternion, 3 scale, 1 opacity, 3 (d+1)² SH."""
        return 11 + 3 * (self.sh_degree + 1) ** 2

    def page_bytes(self, num_gaussians: NDArray[np.int64]) -> NDArray[np.int64]:
        return num_gaussians * (4 * self.floats_per_gaussian)

    def most_gaussians(self, num_bytes: int) -> int:
        return num_bytes // (4 * self.floats_per_gaussian)

    def encode(self, gaussians: Gaussians, rows: slice) -> list[NDArray[Any]]:
        return [getattr(gaussians, field.name)[rows] for field in fields(Gaussians)]

    def decode(self, read: Callable[[Sequence[NDArray[Any]]], None], out: Gaussians, rows: slice) -> None:
        read(self.encode(out, rows))

    def empty(self, count: int) -> Gaussians:
        shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (self.sh_degree + 1) ** 2, 3)]
        return Gaussians(*(np.empty(shape, np.float32) for shape in shapes))
