"""Gaussians: the arrays of one asset, with their shapes and units."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from v3dg import _core

Array: TypeAlias = Any  # numpy.ndarray or torch.Tensor; a union would make every use of a field a type error

_NAMES = ("means", "quats", "scales", "opacities", "sh")
_NUM_SH = {1: 0, 4: 1, 9: 2, 16: 3}  # coefficients a channel -> degree


def _is_tensor(value: object) -> bool:
    """Whether `value` is a torch tensor, found out without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _kind(value: object) -> str:
    if isinstance(value, np.ndarray):
        return "a NumPy array"
    return "a torch tensor" if _is_tensor(value) else type(value).__name__


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians:
    """N 3D Gaussians: NumPy arrays or torch tensors, float32, C-contiguous, all of one kind on one device.

    Torch tensors may all be float64 instead, which `rasterize` then computes in; all else wants float32.

    Args:
        means: (N, 3) centres, in world units of the asset's own frame.
        quats: (N, 4) rotations as w, x, y, z; need not have length one.
        scales: (N, 3) standard deviations along the rotated axes, in world units; not their logs.
        opacities: (N,) in [0, 1]; not logits.
        sh: (N, K, 3) spherical harmonics of RGB, K = (degree + 1)², degree 0 to 3; colour is their value in
            the view direction plus ½.

    Kinds, shapes, dtypes and layout are checked here, values are not. Nothing is copied.

    Raises:
        TypeError: an argument is not an array, or NumPy and torch are mixed.
        ValueError: wrong shape, dtype, device or memory layout.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh: Array

    def __post_init__(self) -> None:
        for name in _NAMES:
            _check_kind(name, getattr(self, name), self.means)
        if self.means.ndim != 2 or self.means.shape[1] != 3:
            raise ValueError(f"means: expected shape (N, 3), got {tuple(self.means.shape)}")
        num = self.means.shape[0]
        for name, shape in (("quats", (num, 4)), ("scales", (num, 3)), ("opacities", (num,))):
            got = tuple(getattr(self, name).shape)
            if got != shape:
                raise ValueError(f"{name}: expected shape {shape} to go with means {(num, 3)}, got {got}")
        got = tuple(self.sh.shape)
        if len(got) != 3 or got[0] != num or got[1] not in _NUM_SH or got[2] != 3:
            raise ValueError(f"sh: expected shape ({num}, K, 3) with K 1, 4, 9 or 16, got {got}")

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        where = f"torch {self.means.device}" if _is_tensor(self.means) else "numpy"
        return f"Gaussians({len(self)}, sh_degree={self.sh_degree}, {where})"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return _NUM_SH[int(self.sh.shape[1])]

    @property
    def rows(self) -> _core.Rows:
        """The arrays as the compiled operations take them, without gradients; they share memory.

        Tensors on a CUDA device that do not begin where it can be read in words of 16 bytes are copied.
        """
        arrays = [getattr(self, name) for name in _NAMES]
        if _is_tensor(self.means):
            arrays = [tensor.detach() for tensor in arrays]
            if self.means.is_cuda:
                arrays = [tensor if tensor.data_ptr() % 16 == 0 else tensor.clone() for tensor in arrays]
            else:
                arrays = [tensor.numpy() for tensor in arrays]
        return _core.Rows(*arrays)

    def subset(self, index: slice | Sequence[int] | Array) -> Gaussians:
        """Take the gaussians that a slice, an array of M indices or a mask of N booleans names, in its order.

        A slice of step 1 shares memory with this object; everything else is copied.

        Raises:
            TypeError: the index is a single number, or not made of integers or booleans.
            ValueError: the index has more than one dimension.
            IndexError: out of range, or a mask of another length.
        """
        if isinstance(index, slice):
            if index.step not in (None, 1):  # torch knows no negative steps
                index = np.arange(*index.indices(len(self)))
        else:
            index = _checked_index(index)
        if not _is_tensor(self.means):
            rows = cast(Any, index).cpu().numpy() if _is_tensor(index) else index
            return self._map(lambda array: np.ascontiguousarray(array[rows]))
        if not isinstance(index, slice):
            import torch

            index = torch.as_tensor(index, device=self.means.device)
            if index.is_cuda:
                _check_range(index, len(self))
        return self._map(lambda tensor: tensor[index].contiguous())

    @staticmethod
    def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
        """Join sets of gaussians of one SH degree and one kind, in order.

        Raises:
            ValueError: no parts, or parts of different degrees.
            TypeError: a part is not Gaussians, or NumPy and torch are mixed.
        """
        parts = list(parts)
        if not parts:
            raise ValueError("parts: expected at least one Gaussians, got none")
        for i, part in enumerate(parts):
            if not isinstance(part, Gaussians):
                raise TypeError(f"parts[{i}]: expected Gaussians, got {type(part).__name__}")
            _check_kind(f"parts[{i}].means", part.means, parts[0].means)
            if part.sh_degree != parts[0].sh_degree:
                raise ValueError(
                    f"parts[{i}]: expected SH degree {parts[0].sh_degree} like parts[0], got {part.sh_degree}"
                )
        join: Any = np.concatenate
        if _is_tensor(parts[0].means):
            import torch

            join = torch.cat
        return Gaussians(*(join([getattr(part, name) for part in parts]) for name in _NAMES))

    def numpy(self) -> Gaussians:
        """Return the same gaussians as NumPy arrays, without gradients; copied only from another device."""
        if not _is_tensor(self.means):
            return self
        return self._map(lambda tensor: tensor.detach().cpu().numpy())

    def torch(self, device: Any = None) -> Gaussians:
        """Return the same gaussians as torch tensors on `device` (None: where they are, NumPy's on the CPU).

        Copied only when they move or when a NumPy array is read-only; gradients flow through a move.

        Raises:
            ValueError: torch knows no such device.
            RuntimeError: The device is not there.
        """
        import torch

        try:
            torch.empty(0, device=device)
        except (AssertionError, RuntimeError, TypeError) as error:
            kind = RuntimeError if isinstance(error, AssertionError) else ValueError
            reason = str(error).partition("\n")[0][:100]
            raise kind(f"device: expected one that torch can use, got {device!r} ({reason})") from None

        def tensor(array: Any) -> Any:
            if isinstance(array, np.ndarray):
                array = torch.from_numpy(array if array.flags.writeable else array.copy())
            return array if device is None else array.to(device)

        return self._map(tensor)

    def _map(self, function: Any) -> Gaussians:
        return Gaussians(*(function(getattr(self, name)) for name in _NAMES))


def empty(count: int, sh_degree: int) -> Gaussians:
    """Gaussians on the host with any values, to be filled."""
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, (sh_degree + 1) ** 2, 3)]
    return Gaussians(*(np.empty(shape, np.float32) for shape in shapes))


def _check_kind(name: str, array: Any, like: Any) -> None:
    """Raise unless `array` is contiguous, float32 (tensors: or float64), of the kind and device of `like`."""
    if not isinstance(array, np.ndarray) and not _is_tensor(array):
        raise TypeError(f"{name}: expected a NumPy array or a torch tensor, got {_kind(array)}")
    if _is_tensor(array) != _is_tensor(like):
        raise TypeError(f"{name}: expected {_kind(like)} like the others, got {_kind(array)}")
    dtype, first = (str(a.dtype).removeprefix("torch.") for a in (array, like))
    wanted = "float64" if _is_tensor(array) and first == "float64" else "float32"
    if dtype != wanted:
        raise ValueError(f"{name}: expected dtype {wanted}, got {dtype}; convert it first")
    if _is_tensor(array):
        if array.device != like.device:
            raise ValueError(f"{name}: expected device {like.device} like the others, got {array.device}")
        if not array.is_contiguous():
            raise ValueError(f"{name}: expected a contiguous tensor, got a strided one; call .contiguous()")
    elif not array.flags.c_contiguous:
        raise ValueError(
            f"{name}: expected a C-contiguous array, got a strided one; call numpy.ascontiguousarray"
        )


def _checked_index(index: Any) -> Array:
    """A mask or int64 indices: a tensor where it is one, else a NumPy array."""
    array: Any = index.detach() if _is_tensor(index) else np.asarray(index)
    if array.ndim == 1 and len(array) == 0 and "float" in str(array.dtype):
        array = np.zeros(0, np.int64)  # an empty list says nothing about its kind
    dtype = str(array.dtype).removeprefix("torch.")
    if array.ndim == 0 or not dtype.startswith(("int", "uint", "bool")):
        raise TypeError(
            f"index: expected a slice, integers or booleans, got {_kind(index)}"
            + (f" of dtype {dtype}" if array.ndim else "; for one gaussian use a slice of length 1")
        )
    if _is_tensor(array) and array.is_meta:
        raise ValueError("index: expected a tensor with data, got one on the device meta")
    if array.ndim != 1:
        raise ValueError(f"index: expected one dimension, got shape {tuple(array.shape)}")
    if _is_tensor(array):
        return array if dtype == "bool" else array.long()
    return np.ascontiguousarray(array, bool if dtype == "bool" else np.int64)


def _check_range(index: Any, count: int) -> None:
    """Raise for a tensor of indices out of range; on a CUDA device indexing itself would end the context."""
    if str(index.dtype) == "torch.bool" or len(index) == 0:
        return
    low, high = int(index.min()), int(index.max())
    if low < -count or high >= count:
        raise IndexError(f"index: expected {-count} to {count - 1}, got {high if high >= count else low}")
