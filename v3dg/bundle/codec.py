"""The codec: what the bytes of a page are."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from v3dg.gaussians import Gaussians, empty, gaussian_bytes

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    import numpy as np
    from numpy.typing import NDArray


class Codec:
    """Gaussians of one SH degree as bytes, and back: the arrays of a page, float32, one after another."""

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree
        self.gaussian_bytes = gaussian_bytes(sh_degree)

    def page_bytes(self, num_gaussians: NDArray[np.int64]) -> NDArray[np.int64]:
        """Sizes of pages of so many gaussians, without what they are filled up with."""
        return num_gaussians * self.gaussian_bytes

    def encode(self, gaussians: Gaussians, rows: slice) -> list[NDArray[Any]]:
        """Arrays whose bytes, one array after another, are those of the page that has these rows."""
        return [array[rows] for array in vars(gaussians).values()]

    def decode(self, read: Callable[[Sequence[NDArray[Any]]], None], out: Gaussians, rows: slice) -> None:
        """Fill the rows with a page, whose bytes `read` reads into the arrays that it is given."""
        read(self.encode(out, rows))

    def empty(self, count: int) -> Gaussians:
        """Gaussians on the host to decode to, with any values."""
        return empty(count, self.sh_degree)
