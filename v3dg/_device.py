"""Devices: the CPU, with NumPy arrays, and CUDA devices, with torch tensors. Pictures
can also be drawn by WebGPU, into NumPy arrays."""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass
from types import ModuleType
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from v3dg import _core, _extras
from v3dg.gaussians import Array, Gaussians

HostArray: TypeAlias = npt.NDArray[Any]

_MUCH_MEMORY = 1 << 30
_WEBGPU_NUMBER = -2


@dataclass(frozen=True)
class Device:
    """The CPU, a CUDA device with its index, or the device of WebGPU."""

    number: int = -1

    @property
    def is_cuda(self) -> bool:
        return self.number >= 0

    @property
    def is_webgpu(self) -> bool:
        return self.number == _WEBGPU_NUMBER

    def __str__(self) -> str:
        if self.is_cuda:
            return f"cuda:{self.number}"
        if self.is_webgpu:
            return "webgpu"
        return "cpu"

    def current(self) -> AbstractContextManager[object]:
        """Return a context in which this device is torch's current one. For the CPU,
        the context does nothing."""
        if not self.is_cuda:
            return nullcontext()
        import torch

        return cast(AbstractContextManager[object], torch.cuda.device(self.number))


CPU = Device()
WEBGPU = Device(_WEBGPU_NUMBER)


def resolve_for_drawing(device: str | Device) -> Device:
    """As `resolve`, but accept "webgpu", too. Whether it can be used shows when it
    draws."""
    if str(device) == "webgpu":
        return WEBGPU
    return resolve(device)


def resolve(device: str | Device) -> Device:
    """Return the device with the name "auto", "cpu", "cuda" or, for example, "cuda:1".

    "cuda" means torch's current CUDA device. "auto" means "cuda" if CUDA can be used,
    otherwise "cpu".

    Raises:
        ValueError: The name is unknown.
        RuntimeError: A CUDA device was requested and cannot be used. The CPU is never
            used instead.
    """
    name = str(device)
    if name == "webgpu":
        raise ValueError(
            "device: 'webgpu' only draws pictures of scenes and bundles with v3dg.render, "
            "v3dg.Renderer and `v3dg render`; use 'auto', 'cpu' or 'cuda'"
        )
    kind, _, number = name.partition(":")
    if kind not in ("auto", "cpu", "cuda") or (
        name != kind and (kind != "cuda" or not number.isdecimal())
    ):
        raise ValueError(f"device: expected 'auto', 'cpu', 'cuda' or 'cuda:1', got {name!r}")
    if kind == "cpu":
        return CPU
    missing = missing_for_cuda()
    if missing is None:
        count = _core.num_cuda_devices()
        if int(number or 0) >= count:
            raise RuntimeError(
                f"device: expected the index of one of {count} CUDA devices, got {name!r}"
            )
        import torch

        if number:
            return Device(int(number))
        return Device(int(torch.cuda.current_device()))
    if kind == "cuda":
        raise RuntimeError(f"device: {missing}, or use 'cpu'")
    return CPU


def missing_for_cuda() -> str | None:
    """Return the reason why CUDA cannot be used, with advice. Return None if it can be
    used."""
    if not _core.has_cuda:
        return "v3dg was built without CUDA; install it again where nvcc is found"
    if _core.num_cuda_devices() == 0:
        return "expected a CUDA device and its driver, got none; install the driver"
    try:
        import torch
    except ImportError:
        return _extras.missing("torch")
    if not torch.cuda.is_available():
        return (
            f"expected a version of torch that can use the CUDA device, got {torch.__version__}; "
            "install torch with CUDA support"
        )
    return None


def describe(device: Device) -> str:
    """Return the model name of a GPU, or the instruction set of the CPU. The last bits
    of results depend on these."""
    if not device.is_cuda:
        return _core.isa()
    import torch

    return str(torch.cuda.get_device_name(device.number))


def of(array: Array) -> Device:
    """Return the device of an array. A torch tensor on the host belongs to the CPU."""
    if isinstance(array, np.ndarray) or not array.is_cuda:
        return CPU
    return Device(array.device.index)


def place(gaussians: Gaussians, device: Device) -> Gaussians:
    """Return gaussians without gradients, as NumPy arrays (for the CPU) or as tensors
    on a CUDA device."""
    if not device.is_cuda:
        return gaussians.numpy()
    tensors = vars(gaussians.torch(str(device))).values()
    placed = Gaussians(*(tensor.detach() for tensor in tensors))
    return placed.trained(antialiased=gaussians.antialiased)


def place_rows(array: Array, rows: npt.NDArray[np.bool_], device: Device) -> Array:
    """Return the marked rows of an array without gradients, as a NumPy array (for the
    CPU) or as a CUDA tensor."""
    if isinstance(array, np.ndarray) and not device.is_cuda:
        return array[rows]
    import torch

    tensor = torch.as_tensor(array, device=str(device)).detach()
    selected = tensor[torch.from_numpy(rows).to(tensor.device)]
    if device.is_cuda:
        return selected
    return selected.numpy()


def all_like(device: Device) -> list[Device]:
    """Return a CUDA device, followed by all others of the same model. For the CPU,
    return only the CPU."""
    devices = [device]
    if device.is_cuda:
        for number in range(_core.num_cuda_devices()):
            if number != device.number and describe(Device(number)) == describe(device):
                devices.append(Device(number))
    return devices


def library_of(array: Array) -> ModuleType:
    """Return the module numpy or torch, depending on the type of an array. Many
    functions have the same name and arguments in both."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def to_host(array: Array) -> HostArray:
    """Return the array as a NumPy array."""
    if isinstance(array, np.ndarray):
        return array
    return cast(HostArray, array.cpu().numpy())


@contextmanager
def memory_errors() -> Iterator[None]:
    """Convert torch's error for too little device memory to MemoryError, as the core
    does."""
    try:
        yield
    except RuntimeError as error:
        if type(error).__name__ != "OutOfMemoryError":
            raise
        raise MemoryError(str(error)) from error


def own_stream(device: Device) -> AbstractContextManager[object]:
    """Return a context in which a device is current and uses a stream that no other
    thread uses."""
    if not device.is_cuda:
        return nullcontext()
    import torch

    make_stream = cast(Callable[[int], torch.cuda.Stream], torch.cuda.Stream)
    return torch.cuda.stream(make_stream(device.number))


def with_this_stream(work: Callable[[], None], device: Device) -> Callable[[], None]:
    """Return a function that does the work on the stream that is current now in this
    thread. Any thread may run the function."""
    if not device.is_cuda:
        return work
    import torch

    stream = torch.cuda.current_stream(device.number)

    def on_stream() -> None:
        with torch.cuda.stream(stream):
            work()

    return on_stream


def spare_memory(device: Device) -> None:
    """If torch caches much unused memory on a device, make torch release it, because
    the core cannot use that memory."""
    if not device.is_cuda:
        return
    import torch

    if (
        torch.cuda.memory_reserved(device.number) - torch.cuda.memory_allocated(device.number)
        > _MUCH_MEMORY
    ):
        torch.cuda.empty_cache()
