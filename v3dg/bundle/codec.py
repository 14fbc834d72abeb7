"""Codecs, which define the bytes of a page.

Pages are encoded here and decoded in the core, which has a `PageCodec` for each codec
(csrc/residency/page_source.h). docs/extending.md says how to add one.
"""

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _device
from v3dg._numbers import one_of
from v3dg.gaussians import Gaussians, empty, gaussian_bytes


class Codec:
    """Gaussians of one SH degree as bytes: the float32 arrays of a page, one after
    another.

    Attributes:
        name: The name for users and in files.
        alignment: A page begins in the file at a multiple of so many bytes.
        gaussian_bytes, cluster_bytes: Bytes of a page for each gaussian and each
            cluster.
    """

    name: ClassVar[str] = "float32"
    alignment: int = 4096  # the memory page, so that a page maps or loads directly

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree
        self.gaussian_bytes = gaussian_bytes(sh_degree)
        self.cluster_bytes = 0

    def page_bytes(
        self, num_gaussians: NDArray[np.int64], num_clusters: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Sizes of pages with so many gaussians and clusters, including padding."""
        num_bytes = num_gaussians * self.gaussian_bytes + num_clusters * self.cluster_bytes
        return (num_bytes + self.alignment - 1) & -self.alignment  # a power of two

    def encode(
        self, gaussians: Gaussians, offset: NDArray[np.int64]
    ) -> Sequence[NDArray[np.generic]]:
        """The page of the clusters that begin at these rows, as arrays whose bytes
        follow each other."""
        return [array[offset[0] : offset[-1]] for array in vars(gaussians).values()]

    def rounded(self, gaussians: Gaussians, offset: NDArray[np.int64]) -> Gaussians:
        """The gaussians of these clusters after encoding and decoding, on the device
        where they are."""
        return gaussians

    def empty(self, count: int) -> Gaussians:
        """Uninitialised gaussians on the host, to decode into."""
        return empty(count, self.sh_degree)


class Quantized(Codec):
    """Codes of 16 bytes and up to 24 for the higher degrees, relative to the ranges of
    a cluster."""

    name = "quantized"

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree
        self.gaussian_bytes, self.cluster_bytes, self.alignment = _core.page_code_bytes(sh_degree)

    def encode(
        self, gaussians: Gaussians, offset: NDArray[np.int64]
    ) -> Sequence[NDArray[np.generic]]:
        return [_core.encode_page(gaussians.rows, offset)]

    def rounded(self, gaussians: Gaussians, offset: NDArray[np.int64]) -> Gaussians:
        result = self.empty(len(gaussians))
        page = _core.encode_page(gaussians.numpy().rows, offset)
        _core.decode_page(page, offset, result.rows)
        return _device.place(result, _device.of(gaussians.means))


CODECS: dict[str, type[Codec]] = {codec.name: codec for codec in (Codec, Quantized)}


def codec_of(name: str, sh_degree: int) -> Codec:
    """The codec of that name; ValueError where there is none."""
    one_of(name, "codec", tuple(CODECS))
    return CODECS[name](sh_degree)
