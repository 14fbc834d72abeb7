"""Gaussians: the arrays of one asset, with their shapes and units."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias, cast

import numpy as np

from v3dg import _core
from v3dg._numbers import check, check_type, positive, vector

Array: TypeAlias = Any  # numpy.ndarray or torch.Tensor; a union would make every use of a field a type error

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

    Torch tensors may all be float64 instead, which `rasterize` then computes in; all else takes float32.

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
        for name, array in vars(self).items():
            _check_kind(name, array, self.means)
        got = tuple(self.means.shape)
        check("means", got[1:] == (3,), f"shape (N, 3), got {got}")
        num = got[0]
        for name, shape in (("quats", (num, 4)), ("scales", (num, 3)), ("opacities", (num,))):
            got = tuple(getattr(self, name).shape)
            check(name, got == shape, f"shape {shape} to go with means {(num, 3)}, got {got}")
        got = tuple(self.sh.shape)
        fits = any(got == (num, count, 3) for count in _NUM_SH)
        check("sh", fits, f"shape ({num}, K, 3) with K 1, 4, 9 or 16, got {got}")

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
        if not _is_tensor(self.means):
            return _core.Rows(*vars(self).values())
        tensors = [tensor.detach() for tensor in vars(self).values()]
        if not self.means.is_cuda:
            return _core.Rows(*(tensor.numpy() for tensor in tensors))
        return _core.Rows(*(tensor if tensor.data_ptr() % 16 == 0 else tensor.clone() for tensor in tensors))

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
            rows: Any = cast(Any, index).cpu().numpy() if _is_tensor(index) else index
            if isinstance(rows, slice) or rows.dtype == bool:
                return self._map(lambda array: np.ascontiguousarray(array[rows]))
            return self._map(lambda array: array.take(rows, axis=0))  # unlike [rows], lets threads run
        if not isinstance(index, slice):
            import torch

            index = torch.as_tensor(index, device=self.means.device)
            if index.is_cuda:
                _check_range(index, len(self))
        return self._map(lambda tensor: tensor[index].contiguous())

    def transform(
        self, quaternion: Any = (1.0, 0.0, 0.0, 0.0), position: Any = (0.0, 0.0, 0.0), scale: float = 1.0
    ) -> Gaussians:
        """Return the gaussians in another frame: p goes to scale * rotation p + position, colours turn along.

        They are of the same kind and on the same device, without gradients.

        Args:
            quaternion: (4,) w x y z of any length but zero.
            position: (3,).
            scale: > 0.

        Raises:
            ValueError: A shape or a value is not as above.
        """
        turn = vector(quaternion, "quaternion", (4,))
        check("quaternion", turn.any(), "a rotation, got a quaternion of zeros")
        turn /= np.abs(turn).max()  # so that squares neither overflow nor vanish
        turn /= np.linalg.norm(turn)
        where = vector(position, "position"), positive(scale, "scale")
        moved = Gaussians(*_core.transform(self.rows, turn, *where))
        return moved.torch() if _is_tensor(self.means) else moved

    @staticmethod
    def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
        """Join sets of gaussians of one SH degree and one kind, in order.

        Raises:
            ValueError: no parts, or parts of different degrees.
            TypeError: a part is not Gaussians, or NumPy and torch are mixed.
        """
        check_type("parts", parts, Iterable, "a list of Gaussians")
        parts = list(parts)
        check("parts", parts, "at least one Gaussians, got none")
        for i, part in enumerate(parts):
            check_type(f"parts[{i}]", part, Gaussians, "Gaussians")
            _check_kind(f"parts[{i}].means", part.means, parts[0].means)
            degree, first = part.sh_degree, parts[0].sh_degree
            check(f"parts[{i}]", degree == first, f"SH degree {first} like parts[0], got {degree}")
        join: Any = np.concatenate
        if _is_tensor(parts[0].means):
            import torch

            join = torch.cat
        return Gaussians(*map(join, zip(*(vars(part).values() for part in parts), strict=True)))

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
        return Gaussians(*map(function, vars(self).values()))


def shapes_of(count: int, sh_degree: int) -> list[tuple[int, ...]]:
    """Of the arrays of so many gaussians, in order."""
    return [(count, 3), (count, 4), (count, 3), (count,), (count, (sh_degree + 1) ** 2, 3)]


def empty(count: int, sh_degree: int) -> Gaussians:
    """Gaussians on the host with any values, to be filled."""
    return Gaussians(*(np.empty(shape, np.float32) for shape in shapes_of(count, sh_degree)))


def gaussian_bytes(sh_degree: int) -> int:
    """Of one gaussian in memory."""
    return 4 * sum(map(math.prod, shapes_of(1, sh_degree)))


def put(part: Gaussians, out: Gaussians, at: int) -> None:
    """Put gaussians on the host into others of the same SH degree or a higher one, from row `at` on."""
    for name, values in vars(part).items():
        target = getattr(out, name)[at : at + len(part)]
        if name == "sh":
            target[:, values.shape[1] :] = 0
            target = target[:, : values.shape[1]]
        target[:] = values


def _check_kind(name: str, array: Any, like: Any) -> None:
    """Raise unless `array` is contiguous, float32 (tensors: or float64), of the kind and device of `like`."""
    if not isinstance(array, np.ndarray) and not _is_tensor(array):
        raise TypeError(f"{name}: expected a NumPy array or a torch tensor, got {_kind(array)}")
    if _is_tensor(array) != _is_tensor(like):
        raise TypeError(f"{name}: expected {_kind(like)} like the others, got {_kind(array)}")
    dtype, first = (str(a.dtype).removeprefix("torch.") for a in (array, like))
    wanted = "float64" if _is_tensor(array) and first == "float64" else "float32"
    check(name, dtype == wanted, f"dtype {wanted}, got {dtype}; convert it first")
    if _is_tensor(array):
        check(name, array.device == like.device, f"device {like.device} like the others, got {array.device}")
        check(name, array.is_contiguous(), "a contiguous tensor, got a strided one; call .contiguous()")
    else:
        expected = "a C-contiguous array, got a strided one; call numpy.ascontiguousarray"
        check(name, array.flags.c_contiguous, expected)


def _checked_index(index: Any) -> Array:
    """A mask or int64 indices: a tensor where it is one, else a NumPy array."""
    array: Any = index.detach() if _is_tensor(index) else np.asarray(index)
    if array.ndim == 1 and len(array) == 0 and "float" in str(array.dtype):
        array = np.zeros(0, np.int64)  # an empty list says nothing about its kind
    dtype = str(array.dtype).removeprefix("torch.")
    if array.ndim == 0 or not dtype.startswith(("int", "uint", "bool")):
        more = f" of dtype {dtype}" if array.ndim else "; for one gaussian use a slice of length 1"
        raise TypeError(f"index: expected a slice, integers or booleans, got {_kind(index)}{more}")
    is_meta = _is_tensor(array) and array.is_meta
    check("index", not is_meta, "a tensor with data, got one on the device meta")
    check("index", array.ndim == 1, f"one dimension, got shape {tuple(array.shape)}")
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
