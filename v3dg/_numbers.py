"""Numbers that users pass: as the core takes them, or an error of one line that names them."""

import math
import operator
import os
from typing import Any, NoReturn, TypeAlias

import numpy as np
import numpy.typing as npt

Floats: TypeAlias = npt.NDArray[np.float64]

MOST_INT = (1 << 31) - 1
LEAST_FLOAT, MOST_FLOAT = 1.4e-45, float(np.finfo(np.float32).max)  # positive float32


def floats(values: Any, name: str, expected: str = "numbers") -> Floats:
    """A new array of doubles, also of torch's tensors; ValueError for what is no number, or not finite."""
    try:
        array = np.asarray(values.numpy(force=True) if hasattr(values, "detach") else values)
        if array.dtype.kind not in "biufO":
            raise TypeError
        with np.errstate(over="ignore"):
            array = np.array(array, dtype=np.float64, order="C")
    except OverflowError:
        raise ValueError(f"{name}: expected {expected} that a double can hold, got a larger one") from None
    except (TypeError, ValueError, RuntimeError):
        dtype = getattr(values, "dtype", None)
        kind = type(values).__name__ + ("" if dtype is None else f" of {dtype}")
        raise ValueError(f"{name}: expected {expected}, got {kind}") from None
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: expected finite numbers, got {array[~np.isfinite(array)][0]}")
    return array


def vector(values: Any, name: str, shape: tuple[int, ...] = (3,)) -> Floats:
    """As `floats`, of this shape."""
    is_plain = type(values) is np.ndarray and values.shape == shape and values.dtype == np.float64
    if is_plain and math.isfinite(sum(values.ravel().tolist())):
        return np.array(values, order="C")  # of every frame, and quickly
    array = floats(values, name, f"numbers of shape {shape}")
    check(name, array.shape == shape, f"shape {shape}, got {array.shape}")
    return array


def color(values: Any, name: str) -> list[float]:
    """Three numbers that the core can hold."""
    if type(values) is tuple and len(values) == 3 and all(type(v) is float and 0 <= v <= 1 for v in values):
        return list(values)  # of every frame, and quickly
    array = vector(values, name)
    largest = np.abs(array).max()
    check(name, largest <= MOST_FLOAT, f"numbers that a float32 can hold, got {largest}")
    return [float(value) for value in array]


def real(
    value: Any, name: str, what: str = "a number", least: float = -math.inf, most: float = math.inf
) -> float:
    """One number of ``least`` to ``most``; ValueError otherwise."""
    try:
        number = math.nan if getattr(value, "ndim", 0) or isinstance(value, str) else float(value)
    except OverflowError:
        number = math.inf if value > 0 else -math.inf
    except (TypeError, ValueError, RuntimeError):
        number = math.nan
    if not least <= number <= most:
        refuse(name, f"{what}, got {shown(value)}")
    return number


def positive(value: Any, name: str) -> float:
    """One positive number that is finite; ValueError otherwise."""
    return real(value, name, "a positive number", least=5e-324, most=1.7976931348623157e308)


def whole(value: Any, name: str, what: str, least: int, most: int = MOST_INT) -> int:
    """One whole number of ``least`` to ``most``; ValueError otherwise."""
    try:
        number = least - 1 if isinstance(value, bool) else operator.index(value)
    except TypeError:
        number = least - 1
    if not least <= number <= most:
        refuse(name, f"{what if number < least else f'at most {most}'}, got {shown(value)}")
    return number


def whole_number(value: Any, name: str) -> int:
    """One whole number of any size; TypeError for what is none."""
    try:
        return operator.index(value)
    except TypeError:
        raise TypeError(f"{name}: expected a whole number, got {shown(value)}") from None


def check(name: str | os.PathLike[str], holds: object, expected: str) -> None:
    """Raise ValueError, which names the value and says what was expected and found, unless it holds."""
    if not holds:
        refuse(name, expected)


def refuse(name: str | os.PathLike[str], expected: str) -> NoReturn:
    """Raise the ValueError of `check`, whose message is then not made in vain."""
    raise ValueError(f"{os.fspath(name)}: expected {expected}")


def check_type(name: str, value: object, kind: type, expected: str) -> None:
    """Raise TypeError unless a value is of a kind, as which it is expected."""
    if not isinstance(value, kind):
        is_file = isinstance(value, str | os.PathLike) and kind.__name__ == "Camera"
        advice = "; v3dg.read_cameras reads files" if is_file else ""
        raise TypeError(f"{name}: expected {expected}, got {type(value).__name__}{advice}")


def check_all(name: str, values: npt.NDArray[Any], good: npt.NDArray[np.bool_], expected: Any) -> None:
    """Name the first row that is not good; ``expected`` is a text, or makes one from the row."""
    if not good.all():
        row = int(np.argmin(good.reshape(len(good), -1).all(1)))
        text = expected(row) if callable(expected) else expected
        raise ValueError(f"{name}[{row}]: expected {text}, got {values[row].tolist()}")


def one_of(value: Any, name: str, choices: tuple[str, ...]) -> None:
    """Raise ValueError unless it is one of these texts."""
    if not (isinstance(value, str) and value in choices):
        refuse(name, f"{' or '.join(map(repr, choices))}, got {shown(value)}")


def shown(value: Any) -> str:
    """A value as a message of one line shows it."""
    if isinstance(value, int) and value.bit_length() > 128:
        return f"a whole number of {value.bit_length()} bits"
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
