"""The pages of bundles on the device of WebGPU. They stay there between pictures."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING

import numpy as np

from v3dg.bundle.codec import Quantized
from v3dg.levels.memory import in_mib

if TYPE_CHECKING:
    from collections.abc import Sequence

    import wgpu
    from numpy.typing import NDArray

    from v3dg.bundle import Bundle
    from v3dg.render.webgpu.gpu import Gpu

_WORD = 4
_FIRST_WORDS = 1 << 22
_ABSENT = -1


class PagePool:
    """Pages as codes in one buffer, which grows up to what a shader can use. When it is
    full, it is filled anew with what the picture needs.

    Attributes:
        buffer: The words of all pages.
        num_bytes: Number of bytes of pages in the buffer.
    """

    def __init__(self, gpu: Gpu) -> None:
        self._gpu = gpu
        self._num_words = min(_FIRST_WORDS, gpu.most_bytes // _WORD)
        self.buffer = self._new_buffer()
        self._end = 0
        # First word of each page, or _ABSENT.
        self._places: weakref.WeakKeyDictionary[Bundle, NDArray[np.int64]]
        self._places = weakref.WeakKeyDictionary()

    @property
    def num_bytes(self) -> int:
        return _WORD * self._end

    def bring_in(
        self, bundles: Sequence[Bundle], pages: Sequence[NDArray[np.int64]]
    ) -> list[NDArray[np.int64]]:
        """Bring in pages of each bundle. Return the first word of each page of each
        bundle in the buffer; those of other pages are undefined.

        Raises:
            RuntimeError: The buffer has no room for all of them together.
            ValueError, OSError: See `Bundle.code_pages`.
        """
        missing = self._missing(bundles, pages)
        if self._end + _words_of(bundles, missing) > self._most_words:
            self._places.clear()
            self._end = 0
            missing = self._missing(bundles, pages)
        num_words = self._end + _words_of(bundles, missing)
        if num_words > self._most_words:
            needed = in_mib(_WORD * num_words)
            capacity = in_mib(self._gpu.most_bytes)
            raise RuntimeError(
                f"device: the pages of this picture have {needed}, and {self._gpu.name} can use "
                f"{capacity} through WebGPU; lower the budget or raise the tolerance"
            )
        self._reserve(num_words)
        for bundle, absent in zip(bundles, missing, strict=True):
            self._append(bundle, absent)
        return [self._places_of(bundle) for bundle in bundles]

    @property
    def _most_words(self) -> int:
        return self._gpu.most_bytes // _WORD

    def _places_of(self, bundle: Bundle) -> NDArray[np.int64]:
        return self._places.setdefault(bundle, np.full(bundle.num_pages, _ABSENT, np.int64))

    def _missing(
        self, bundles: Sequence[Bundle], pages: Sequence[NDArray[np.int64]]
    ) -> list[NDArray[np.int64]]:
        return [
            needed_pages[self._places_of(bundle)[needed_pages] == _ABSENT]
            for bundle, needed_pages in zip(bundles, pages, strict=True)
        ]

    def _reserve(self, num_words: int) -> None:
        """Enlarge the buffer if necessary; its pages are copied."""
        if num_words <= self._num_words:
            return
        old = self.buffer
        self._num_words = min(max(num_words, 2 * self._num_words), self._most_words)
        self.buffer = self._new_buffer()
        if self._end:
            encoder = self._gpu.device.create_command_encoder()
            encoder.copy_buffer_to_buffer(old, 0, self.buffer, 0, self.num_bytes)
            self._gpu.device.queue.submit([encoder.finish()])
        old.destroy()

    def _new_buffer(self) -> wgpu.GPUBuffer:
        from wgpu import BufferUsage

        usage = BufferUsage.STORAGE | BufferUsage.COPY_DST | BufferUsage.COPY_SRC
        return self._gpu.buffer(_WORD * self._num_words, usage)

    def _append(self, bundle: Bundle, pages: NDArray[np.int64]) -> None:
        if not len(pages):
            return
        words = bundle.code_pages(pages.tolist())
        ends = self._end + np.cumsum([len(page) for page in words])
        self._gpu.write(self.buffer, np.concatenate(words), self.num_bytes)
        self._places_of(bundle)[pages] = ends - [len(page) for page in words]
        self._end = int(ends[-1])


def _words_of(bundles: Sequence[Bundle], pages: Sequence[NDArray[np.int64]]) -> int:
    """Return the size of pages of several bundles."""
    return sum(
        int(bundle.page_layout.page_bytes(Quantized(bundle.sh_degree))[needed_pages].sum()) // _WORD
        for bundle, needed_pages in zip(bundles, pages, strict=True)
    )
