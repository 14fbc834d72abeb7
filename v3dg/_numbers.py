"""Checks of numbers that users pass. An error text is one line that begins with the
name of the argument."""

import math
import operator
import os
from collections.abc import Callable
from typing import NoReturn, Protocol, SupportsFloat, SupportsIndex, TypeAlias, cast

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]

MOST_INT = (1 << 31) - 1
LEAST_FLOAT = 1.4e-45
"""The smallest positive float32."""
MOST_FLOAT = float(np.finfo(np.float32).max)
"""The largest float32."""
MOST_DOUBLE = float(np.finfo(np.float64).max)
"""The largest float64."""


class _Tensor(Protocol):
    """A tensor of torch."""

    def numpy(self, *, force: bool) -> npt.NDArray[np.generic]: ...


def floats(values: object, name: str, expected: str = "numbers") -> Floats:
    """Convert numbers, an array or a torch tensor to a new array of doubles. Raise
    ValueError unless all values are finite."""
    array = doubles(values, name, expected)
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)][0]}")
    return array


def doubles(values: object, name: str, expected: str = "numbers") -> Floats:
    """Return numbers, an array or a torch tensor as a new array of doubles, which may
    be infinite or NaN."""
    try:
        if hasattr(values, "detach"):
            array = np.asarray(cast(_Tensor, values).numpy(force=True))
        else:
            array = np.asarray(values)
        if array.dtype.kind not in "biufO":
            raise TypeError
        with np.errstate(over="ignore"):
            array = np.array(array, dtype=np.float64, order="C")
    except OverflowError:
        raise ValueError(
            f"{name}: expected {expected} below 1.8e308, the largest double, got a larger one"
        ) from None
    except (TypeError, ValueError, RuntimeError):
        kind = type(values).__name__
        dtype = getattr(values, "dtype", None)
        if dtype is not None:
            kind = f"{kind} of {dtype}"
        raise ValueError(f"{name}: expected {expected}, got {kind}") from None
    return array


def vector(values: object, name: str, shape: tuple[int, ...] = (3,)) -> Floats:
    """Return a new array of finite doubles of this shape; see `floats`."""
    if (
        type(values) is np.ndarray
        and values.shape == shape
        and values.dtype == np.float64
        and math.isfinite(sum(values.ravel().tolist()))
    ):
        return np.array(values, order="C")  # fast path for calls in every frame
    array = floats(values, name, f"numbers of shape {shape}")
    check(name, array.shape == shape, f"shape {shape}, got {array.shape}")
    return array


def color(values: object, name: str) -> list[float]:
    """Return three numbers that a float32 can represent."""
    if (
        type(values) is tuple
        and len(values) == 3
        and all(type(v) is float and 0 <= v <= 1 for v in values)
    ):
        return list(values)  # fast path for calls in every frame
    array = vector(values, name)
    largest = np.abs(array).max()
    check(name, largest <= MOST_FLOAT, f"numbers that a float32 can hold, got {largest}")
    return [float(value) for value in array]


def real(
    value: object,
    name: str,
    expected: str = "a number",
    lower_bound: float = -math.inf,
    upper_bound: float = math.inf,
) -> float:
    """Return one number from ``lower_bound`` to ``upper_bound``. Raise ValueError for
    other values."""
    number = math.nan
    try:
        if not getattr(value, "ndim", 0) and not isinstance(value, str):
            number = float(cast(SupportsFloat, value))
    except OverflowError:
        number = math.inf
        if cast(int, value) < 0:
            number = -math.inf
    except (TypeError, ValueError, RuntimeError):
        number = math.nan
    if not lower_bound <= number <= upper_bound:
        refuse(name, f"{expected}, got {value_text(value)}")
    return number


def positive(value: object, name: str) -> float:
    """Return one positive finite number. Raise ValueError for other values."""
    return real(value, name, "a positive number", 5e-324, MOST_DOUBLE)


def whole(
    value: object, name: str, expected: str, lower_bound: int, upper_bound: int = MOST_INT
) -> int:
    """Return one integer from ``lower_bound`` to ``upper_bound``. Raise ValueError for
    other values."""
    try:
        number = operator.index(cast(SupportsIndex, value))
    except TypeError:
        refuse(name, f"{expected}, got {value_text(value)}")
    if isinstance(value, bool) or number < lower_bound:
        refuse(name, f"{expected}, got {value_text(value)}")
    if number > upper_bound:
        refuse(name, f"at most {upper_bound}, got {value_text(value)}")
    return number


def whole_number(value: object, name: str) -> int:
    """Return one integer of any size. Raise TypeError for other values."""
    try:
        return operator.index(cast(SupportsIndex, value))
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, got {value_text(value)}") from None


def check(name: str | os.PathLike[str], holds: object, expected: str) -> None:
    """Raise ValueError with the message ``name: expected ...`` unless ``holds``."""
    if not holds:
        refuse(name, expected)


def refuse(name: str | os.PathLike[str], expected: str) -> NoReturn:
    """Raise the ValueError of `check`. Use this function if composing the message is
    slow."""
    raise ValueError(f"{os.fspath(name)}: expected {expected}")


def check_type(name: str, value: object, kind: type, expected: str) -> None:
    """Raise TypeError unless a value is an instance of ``kind``. The message calls that
    type ``expected``."""
    if not isinstance(value, kind):
        advice = ""
        if isinstance(value, str | os.PathLike) and kind.__name__ == "Camera":
            advice = "; v3dg.read_cameras reads camera files"
        raise TypeError(f"{name}: expected {expected}, got {type(value).__name__}{advice}")


def check_all(
    name: str,
    values: npt.NDArray[np.generic],
    good: npt.NDArray[np.bool_],
    expected: str | Callable[..., str],
) -> None:
    """Raise ValueError for the first row that is invalid.

    ``expected`` is a text, or a function that returns the text for the index of the
    row.
    """
    if not good.all():
        row = int(np.argmin(good.reshape(len(good), -1).all(1)))
        if callable(expected):
            expected = expected(row)
        raise ValueError(f"{name}[{row}]: expected {expected}, got {values[row].tolist()}")


def one_of(value: object, name: str, choices: tuple[str, ...]) -> None:
    """Raise ValueError unless ``value`` is one of the strings in ``choices``."""
    if not (isinstance(value, str) and value in choices):
        refuse(name, f"{' or '.join(map(repr, choices))}, got {value_text(value)}")


def value_text(value: object) -> str:
    """Return a value as text for a one-line message."""
    if isinstance(value, int) and value.bit_length() > 128:
        return f"a whole number of {value.bit_length()} bits"
    text = " ".join(repr(value).split())
    if len(text) > 60:
        return text[:57] + "..."
    return text
