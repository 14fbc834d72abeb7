"""Gaussians: the arrays of one asset, with their shapes and units."""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg import _core
from v3dg._numbers import check, check_type, positive, vector

if TYPE_CHECKING:
    import torch

Array: TypeAlias = (
    # NumPy array or torch tensor; a union would make every use of a field a type error
    Any
)

TRAINED_FILTER_PX2 = 0.3
"""Variance, px², of the screen-space filter in training. It is the same in the code of
3DGS and in gsplat, with and without antialiasing."""

_NUM_SH = {1: 0, 4: 1, 9: 2, 16: 3}  # coefficients per channel -> SH degree


def _is_tensor(value: object) -> bool:
    """Return whether `value` is a torch tensor, without importing torch."""
    torch = sys.modules.get("torch")
    return torch is not None and isinstance(value, torch.Tensor)


def _kind(value: object) -> str:
    if isinstance(value, np.ndarray):
        return "a NumPy array"
    if _is_tensor(value):
        return "a torch tensor"
    return type(value).__name__


class _Trained:
    """Whether gaussians were trained with antialiasing. The value is stored in a slot,
    so that `vars` of gaussians only contains their arrays."""

    __slots__ = ("_antialiased",)
    _antialiased: bool | None

    @property
    def antialiased(self) -> bool | None:
        """Whether opacities were trained to compensate for the filter of the
        rasterizer; None if unknown. See `trained`."""
        return self._antialiased


@dataclass(frozen=True, eq=False, repr=False)
class Gaussians(_Trained):
    """N 3D Gaussians: NumPy arrays or torch tensors, float32, C-contiguous, all of one
    kind on one device.

    Torch tensors may also all be float64. `rasterize` then computes in float64; other
    functions require float32.

    Args:
        means: (N, 3) centres, in world units of the asset's own frame.
        quats: (N, 4) rotations as w, x, y, z; they need not be normalised.
        scales: (N, 3) standard deviations along the rotated axes, in world units (not
            logarithms).
        opacities: (N,) in [0, 1] (not logits).
        sh: (N, K, 3) spherical harmonics of RGB, K = (degree + 1)², degree 0 to 3. A
            colour is ½ plus the value of the harmonics in the view direction.

    Types, shapes, dtypes and memory layout are checked here, but values are not.
    Nothing is copied. `antialiased` is initially None. `trained` returns gaussians with
    another value, which the results of all methods keep.

    Raises:
        TypeError: An argument is not an array, or NumPy and torch are mixed.
        ValueError: An array has the wrong shape, dtype, device or memory layout.
    """

    means: Array
    quats: Array
    scales: Array
    opacities: Array
    sh: Array

    def __post_init__(self) -> None:
        object.__setattr__(self, "_antialiased", None)
        for name, array in vars(self).items():
            _check_kind(name, array, self.means)
        shape = tuple(self.means.shape)
        check("means", shape[1:] == (3,), f"shape (N, 3), got {shape}")
        num = shape[0]
        for name, expected in (("quats", (num, 4)), ("scales", (num, 3)), ("opacities", (num,))):
            shape = tuple(getattr(self, name).shape)
            check(
                name,
                shape == expected,
                f"shape {expected} to match means of shape {(num, 3)}, got {shape}",
            )
        shape = tuple(self.sh.shape)
        fits = any(shape == (num, count, 3) for count in _NUM_SH)
        check("sh", fits, f"shape ({num}, K, 3) with K = 1, 4, 9 or 16, got {shape}")

    def __reduce__(self) -> tuple[Callable[..., Gaussians], tuple[object, ...]]:
        return _restored, (list(vars(self).values()), self.antialiased)

    def __len__(self) -> int:
        return int(self.means.shape[0])

    def __repr__(self) -> str:
        kind = "numpy"
        if _is_tensor(self.means):
            kind = f"torch {self.means.device}"
        return f"Gaussians({len(self)}, sh_degree={self.sh_degree}, {kind})"

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return _NUM_SH[int(self.sh.shape[1])]

    @property
    def rows(self) -> _core.Rows:
        """The arrays for the compiled operations, without gradients. They share memory
        with this object.

        Tensors on a CUDA device that are not aligned to 16 bytes are copied.
        """
        if not _is_tensor(self.means):
            return _core.Rows(*vars(self).values())
        tensors = [tensor.detach() for tensor in vars(self).values()]
        if not self.means.is_cuda:
            return _core.Rows(*(tensor.numpy() for tensor in tensors))
        return _core.Rows(*map(_aligned, tensors))

    def trained(self, *, antialiased: bool | None) -> Gaussians:
        """Return the same gaussians, marked as trained with or without antialiasing, or
        as unknown (None). The arrays are shared.

        Training with antialiasing draws with a filter and multiplies each opacity by
        the square root of det(covariance) before / after the filter (Mip-Splatting, eq.
        9). `v3dg.render` draws such an asset in the same way. Files can declare the
        value (docs/formats.md), and `v3dg.write_asset` writes it to them.

        Raises:
            TypeError: ``antialiased`` is neither a bool nor None.
        """
        if antialiased is not None:
            check_type("antialiased", antialiased, bool, "a bool or None")
        marked = Gaussians(*vars(self).values())
        object.__setattr__(marked, "_antialiased", antialiased)
        return marked

    def subset(self, index: slice | Sequence[int] | Array) -> Gaussians:
        """Return the gaussians selected by a slice, by an array of M indices (in their
        order), or by a mask of N booleans.

        A slice with step 1 shares memory with this object. All other results are
        copies.

        Raises:
            TypeError: The index is a single number, or its elements are neither
                integers nor booleans.
            ValueError: The index has more than one dimension.
            IndexError: An index is out of range, or a mask has another length.
        """
        if isinstance(index, slice):
            if index.step not in (None, 1):  # torch does not support negative steps
                index = np.arange(*index.indices(len(self)))
        else:
            index = _checked_index(index)
        if not _is_tensor(self.means):
            rows: Array = index
            if _is_tensor(rows):
                rows = rows.cpu().numpy()
            if isinstance(rows, slice) or rows.dtype == bool:
                return self._map(lambda array: np.ascontiguousarray(array[rows]))
            # take() releases the GIL, which indexing with [rows] does not.
            return self._map(lambda array: array.take(rows, axis=0))
        if not isinstance(index, slice):
            import torch

            index = torch.as_tensor(index, device=self.means.device)
            if index.is_cuda:
                _check_range(index, len(self))
        return self._map(lambda tensor: tensor[index].contiguous())

    def transform(
        self,
        quaternion: Array | npt.ArrayLike = (1.0, 0.0, 0.0, 0.0),
        position: Array | npt.ArrayLike = (0.0, 0.0, 0.0),
        scale: float = 1.0,
    ) -> Gaussians:
        """Return the gaussians transformed by p -> scale * rotation p + position, with
        rotated colours.

        The result has the same array type and device, without gradients.

        Args:
            quaternion: (4,) rotation as w, x, y, z; it need not be normalised.
            position: (3,) translation.
            scale: Uniform scale, > 0.

        Raises:
            ValueError: A shape or a value is invalid.
        """
        rotation = vector(quaternion, "quaternion", (4,))
        check("quaternion", rotation.any(), "a nonzero quaternion, got zeros")
        rotation /= np.abs(rotation).max()  # prevents overflow and underflow of squares
        rotation /= np.linalg.norm(rotation)
        translation = vector(position, "position")
        moved = Gaussians(
            *_core.transform(self.rows, rotation, translation, positive(scale, "scale"))
        )
        if _is_tensor(self.means):
            moved = moved.torch()
        return moved.trained(antialiased=self.antialiased)

    @staticmethod
    def concatenate(parts: Sequence[Gaussians]) -> Gaussians:
        """Join gaussians of the same SH degree and array type, in order. If
        `antialiased` differs between the parts, it becomes None.

        Raises:
            ValueError: There are no parts, or they have different SH degrees.
            TypeError: A part is not Gaussians, or NumPy and torch are mixed.
        """
        check_type("parts", parts, Iterable, "a list of Gaussians")
        parts = list(parts)
        check("parts", parts, "at least one Gaussians, got none")
        for i, part in enumerate(parts):
            check_type(f"parts[{i}]", part, Gaussians, "Gaussians")
            _check_kind(f"parts[{i}].means", part.means, parts[0].means)
            expected = parts[0].sh_degree
            is_right = part.sh_degree == expected
            check(
                f"parts[{i}]", is_right, f"SH degree {expected} like parts[0], got {part.sh_degree}"
            )
        columns = zip(*(vars(part).values() for part in parts), strict=True)
        join: Callable[..., Array] = np.concatenate
        if _is_tensor(parts[0].means):
            import torch

            join = torch.cat
        antialiased = common([part.antialiased for part in parts])
        return Gaussians(*map(join, columns)).trained(antialiased=antialiased)

    def numpy(self) -> Gaussians:
        """Return the same gaussians as NumPy arrays without gradients. Only arrays on
        another device are copied."""
        if not _is_tensor(self.means):
            return self
        return self._map(lambda tensor: tensor.detach().cpu().numpy())

    def torch(self, device: str | int | torch.device | None = None) -> Gaussians:
        """Return the same gaussians as torch tensors on `device`. With None, tensors
        stay on their device and NumPy arrays become tensors on the CPU.

        Arrays are copied only if they move to another device, or if a NumPy array is
        read-only. Gradients propagate through such a move.

        Raises:
            ValueError: torch does not know the device.
            RuntimeError: The device does not exist.
        """
        import torch

        try:
            torch.empty(0, device=device)
        except (AssertionError, RuntimeError, TypeError) as error:
            reason = str(error).partition("\n")[0][:100]
            text = f"device: expected one that torch can use, got {device!r} ({reason})"
            if isinstance(error, AssertionError):
                raise RuntimeError(text) from None
            raise ValueError(text) from None

        def tensor(array: Array) -> Array:
            if isinstance(array, np.ndarray):
                if not array.flags.writeable:
                    array = array.copy()
                array = torch.from_numpy(array)
            if device is None:
                return array
            return array.to(device)

        return self._map(tensor)

    def _map(self, function: Callable[[Array], Array]) -> Gaussians:
        mapped = Gaussians(*map(function, vars(self).values()))
        return mapped.trained(antialiased=self.antialiased)


def _restored(arrays: Sequence[Array], antialiased: bool | None) -> Gaussians:  # noqa: FBT001
    """Return gaussians from the state that `Gaussians.__reduce__` stores."""
    return Gaussians(*arrays).trained(antialiased=antialiased)


def common(values: Sequence[bool | None]) -> bool | None:
    """Return the value if all are equal.

    Return None if they differ or there are none.
    """
    if len(set(values)) == 1:
        return values[0]
    return None


def _aligned(tensor: Array) -> Array:
    """Return a tensor. If its memory is not aligned to 16 bytes, return a copy."""
    if tensor.data_ptr() % 16 == 0:
        return tensor
    return tensor.clone()


def shapes_of(count: int, sh_degree: int) -> list[tuple[int, ...]]:
    """Return the shapes of the arrays of ``count`` gaussians, in the order of the
    fields."""
    return [(count, 3), (count, 4), (count, 3), (count,), (count, (sh_degree + 1) ** 2, 3)]


def empty(count: int, sh_degree: int) -> Gaussians:
    """Return uninitialised gaussians on the host."""
    return Gaussians(*(np.empty(shape, np.float32) for shape in shapes_of(count, sh_degree)))


def gaussian_bytes(sh_degree: int) -> int:
    """Return the size of one gaussian in memory, in bytes."""
    return 4 * sum(map(math.prod, shapes_of(1, sh_degree)))


def put(part: Gaussians, out: Gaussians, row: int) -> None:
    """Copy gaussians on the host into others of the same or a higher SH degree,
    starting at index ``row``."""
    for name, values in vars(part).items():
        target = getattr(out, name)[row : row + len(part)]
        if name == "sh":
            target[:, values.shape[1] :] = 0
            target = target[:, : values.shape[1]]
        target[:] = values


def _dtype_name(array: Array) -> str:
    return str(array.dtype).removeprefix("torch.")


def _check_kind(name: str, array: Array, first: Array) -> None:
    """Raise an error unless `array` is contiguous, has the type and the device of
    `first`, and is float32 (tensors may be float64)."""
    if not isinstance(array, np.ndarray) and not _is_tensor(array):
        raise TypeError(f"{name}: expected a NumPy array or a torch tensor, got {_kind(array)}")
    if _is_tensor(array) != _is_tensor(first):
        raise TypeError(
            f"{name}: expected {_kind(first)} like the other arrays, got {_kind(array)}"
        )
    expected_dtype = "float32"
    if _is_tensor(array) and _dtype_name(first) == "float64":
        expected_dtype = "float64"
    dtype = _dtype_name(array)
    check(name, dtype == expected_dtype, f"dtype {expected_dtype}, got {dtype}; convert it first")
    if _is_tensor(array):
        is_there = array.device == first.device
        check(name, is_there, f"device {first.device} like the other arrays, got {array.device}")
        check(
            name,
            array.is_contiguous(),
            "a contiguous tensor, got a strided one; call .contiguous()",
        )
    else:
        expected = "a C-contiguous array, got a strided one; call numpy.ascontiguousarray"
        check(name, array.flags.c_contiguous, expected)


def _checked_index(index: Array) -> Array:
    """Return a mask or int64 indices. The result is a tensor if ``index`` is one, and
    otherwise a NumPy array."""
    array: Array
    if _is_tensor(index):
        array = index.detach()
    else:
        array = np.asarray(index)
    if array.ndim == 1 and len(array) == 0 and "float" in str(array.dtype):
        array = np.zeros(0, np.int64)  # an empty list has no dtype
    dtype = _dtype_name(array)
    expected = "index: expected a slice, integers or booleans"
    if array.ndim == 0:
        raise TypeError(f"{expected}, got {_kind(index)}; for one gaussian use a slice of length 1")
    if not dtype.startswith(("int", "uint", "bool")):
        raise TypeError(f"{expected}, got {_kind(index)} of dtype {dtype}")
    is_meta = _is_tensor(array) and array.is_meta
    check("index", not is_meta, "a tensor with data, got one on the meta device")
    check("index", array.ndim == 1, f"one dimension, got shape {tuple(array.shape)}")
    if _is_tensor(array):
        if dtype == "bool":
            return array
        return array.long()
    if dtype == "bool":
        return np.ascontiguousarray(array, bool)
    return np.ascontiguousarray(array, np.int64)


def _check_range(index: Array, count: int) -> None:
    """Raise IndexError if a tensor of indices is out of range. On a CUDA device, using
    such indices would make the CUDA context unusable."""
    if str(index.dtype) == "torch.bool" or len(index) == 0:
        return
    for number in (int(index.max()), int(index.min())):
        if not -count <= number < count:
            raise IndexError(f"index: expected {-count} to {count - 1}, got {number}")
