"""The device of WebGPU: one adapter of the machine, its buffers and its shaders."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _extras, export

if TYPE_CHECKING:
    from collections.abc import Sequence

    import wgpu
    from numpy.typing import NDArray

# The web page of `v3dg export --to v3dg` draws with the same shaders.
_SHADERS = Path(export.__file__).parent / "web"
_LIMITS = ("max-storage-buffer-binding-size", "max-buffer-size")
_LEAST_BYTES = 16


class Gpu:
    """A device of WebGPU.

    Args:
        features: Optional features of the adapter that are enabled.

    Attributes:
        device: The device of the package wgpu.
        name: The name of the adapter.
        most_bytes: Size of the largest buffer that a shader can use.
    """

    def __init__(self, features: Sequence[str] = ()) -> None:
        _extras.load("wgpu")
        adapter = _adapter()
        limits = {name: adapter.limits[name] for name in _LIMITS}
        self.device: wgpu.GPUDevice = adapter.request_device_sync(
            required_features=list(features), required_limits=limits
        )
        self.name = str(adapter.info["device"])
        # Sizes of buffers are multiples of 4.
        self.most_bytes = int(min(limits.values())) // 4 * 4

    def buffer(self, num_bytes: int, usage: int) -> wgpu.GPUBuffer:
        """Return a new buffer, filled with zeros."""
        return self.device.create_buffer(size=max(num_bytes, _LEAST_BYTES), usage=usage)

    def write(
        self, buffer: wgpu.GPUBuffer, array: NDArray[np.generic], first_byte: int = 0
    ) -> None:
        """Copy an array to a buffer."""
        if array.nbytes:
            self.device.queue.write_buffer(buffer, first_byte, np.ascontiguousarray(array))

    def read(self, buffer: wgpu.GPUBuffer, num_bytes: int) -> NDArray[np.uint32]:
        """Return the words at the beginning of a buffer. Waits until work in progress
        is finished."""
        return np.frombuffer(self.device.queue.read_buffer(buffer, 0, num_bytes), np.uint32)

    def shader(self, *names: str) -> wgpu.GPUShaderModule:
        """Return the shader whose text is in these files, one after another."""
        text = "".join(_shader_text(name) for name in names)
        return self.device.create_shader_module(code=text)


@cache
def _shader_text(name: str) -> str:
    return (_SHADERS / f"{name}.wgsl").read_text(encoding="utf-8")


def _adapter() -> wgpu.GPUAdapter:
    """Return the fastest adapter of the machine.

    Raises:
        RuntimeError: There is none.
    """
    import wgpu

    advice = "install the driver of a GPU for Vulkan, Metal or Direct3D 12, or use 'cpu'"
    try:
        return wgpu.gpu.request_adapter_sync(power_preference="high-performance")
    except RuntimeError as error:
        reason = " ".join(str(error).split())
        raise RuntimeError(f"device: WebGPU finds no adapter ({reason}); {advice}") from None
