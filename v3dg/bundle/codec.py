"""Codecs, which define how the gaussians of a page are stored as bytes.

The core encodes and decodes pages, with one `PageCodec` for each codec
(csrc/residency/page_source.h). docs/extending.md describes how to add a codec.
"""

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _device
from v3dg._numbers import one_of
from v3dg.gaussians import Gaussians, empty, gaussian_bytes


class Codec:
    """The codec "float32". A page contains the float32 arrays of its gaussians, one
    after another. All gaussians have the same SH degree.

    Attributes:
        name: The name in the API and in files.
        alignment: Pages begin at multiples of this number of bytes in the file.
        gaussian_bytes, cluster_bytes: Number of bytes of a page for each gaussian and
            each cluster.
    """

    name: ClassVar[str] = "float32"
    # The alignment is the size of a memory page, so that the operating system can map
    # or load pages of the bundle directly.
    alignment: int = 4096

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree
        self.gaussian_bytes = gaussian_bytes(sh_degree)
        self.cluster_bytes = 0

    def page_bytes(
        self, num_gaussians: NDArray[np.int64], num_clusters: NDArray[np.int64]
    ) -> NDArray[np.int64]:
        """Return the sizes of pages in bytes, including padding. The arguments are
        their numbers of gaussians and clusters."""
        num_bytes = num_gaussians * self.gaussian_bytes + num_clusters * self.cluster_bytes
        return (num_bytes + self.alignment - 1) & -self.alignment  # the alignment is a power of two

    def rounded(self, gaussians: Gaussians, offset: NDArray[np.int64]) -> Gaussians:
        """Return the gaussians after encoding and decoding, on the same device.
        `offset` has the first row of each cluster, then the end."""
        return gaussians

    def empty(self, count: int) -> Gaussians:
        """Return uninitialised gaussians on the host, into which pages are decoded."""
        return empty(count, self.sh_degree)


class Quantized(Codec):
    """The codec "quantized". Its codes are relative to the ranges of a cluster. A
    gaussian has 16 bytes, and up to 24 more for higher SH degrees."""

    name = "quantized"

    def __init__(self, sh_degree: int) -> None:
        self.sh_degree = sh_degree
        self.gaussian_bytes, self.cluster_bytes, self.alignment = _core.page_code_bytes(sh_degree)

    def rounded(self, gaussians: Gaussians, offset: NDArray[np.int64]) -> Gaussians:
        result = self.empty(len(gaussians))
        page = _core.encode_page(gaussians.numpy().rows, offset)
        _core.decode_page(page, offset, result.rows)
        return _device.place(result, _device.of(gaussians.means))


CODECS: dict[str, type[Codec]] = {codec.name: codec for codec in (Codec, Quantized)}


def codec_of(name: str, sh_degree: int) -> Codec:
    """Return the codec with a name. Raise ValueError if there is none."""
    one_of(name, "codec", tuple(CODECS))
    return CODECS[name](sh_degree)
