"""Shared code of the readers and writers of quantised formats."""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _core
from v3dg._numbers import check_all
from v3dg.gaussians import Gaussians, empty
from v3dg.rotations import normalised

Floats: TypeAlias = NDArray[np.floating]
Integers: TypeAlias = NDArray[np.integer]

SQRT2 = math.sqrt(2.0)
SH_C0 = _core.sh_base0
"""The basis function of SH degree 0. A colour is 0.5 plus SH_C0 times its
coefficient."""

DEGREES = {0: 0, 3: 1, 8: 2, 15: 3}
"""The SH degree for each number of coefficients per channel after the first."""

# Number of gaussians that are decoded together. A block of doubles fits into the cache.
_BLOCK = 1 << 16
# Minimum logarithm of a scale, which is that of 2e-9. It is used for a scale of 0,
# which has no finite logarithm.
_MIN_LOG_SCALE = -20.0
_LEAST_VISIBLE_OPACITY = np.float32(_core.min_alpha)


@dataclass(frozen=True)
class Limits:
    """The ranges of values in a quantised format. Other values are clipped.

    Attributes:
        log_scale: Minimum and maximum logarithm of a scale.
        color: Minimum and maximum SH coefficient of degree 0.
        harmonic: Minimum and maximum SH coefficient of higher degrees.
    """

    log_scale: tuple[float, float] = (_MIN_LOG_SCALE, math.inf)
    color: tuple[float, float] = (-math.inf, math.inf)
    harmonic: tuple[float, float] = (-math.inf, math.inf)


# The indices of the stored components of a quaternion, by the index of its omitted
# component.
_STORED_COMPONENTS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, _BLOCK):
        yield slice(start, min(start + _BLOCK, count))


def assemble(count: int, degree: int, decode: Callable[[slice], tuple[Floats, ...]]) -> Gaussians:
    """Decode gaussians in blocks. ``decode`` returns the means, quats, scales,
    opacities and sh of the gaussians in a slice."""
    gaussians = empty(count, degree)
    # Infinities and NaN are kept.
    with np.errstate(over="ignore", invalid="ignore"):
        for block in blocks(count):
            for array, values in zip(vars(gaussians).values(), decode(block), strict=True):
                array[block] = values
    return gaussians


def quats_from_three(three: Floats, omitted: Integers) -> Floats:
    """Return unit quaternions (N, 4). The arguments are three components, and the index
    of the fourth, which is not negative."""
    omitted_component = np.sqrt(np.maximum(0.0, 1.0 - np.square(three).sum(axis=1)))
    quats = np.empty((len(three), 4))
    np.put_along_axis(quats, _STORED_COMPONENTS[omitted], three, axis=1)
    np.put_along_axis(quats, omitted[:, None].astype(np.intp), omitted_component[:, None], axis=1)
    return quats


def three_of_quats(quats: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the arguments of `quats_from_three` for some quaternions: three components
    (N, 3), within ±√½, and the index (N,) of the largest component, which is
    omitted."""
    unit = normalised(quats)
    largest = np.abs(unit).argmax(axis=1)
    sign = np.where(np.take_along_axis(unit, largest[:, None], axis=1) < 0, -1.0, 1.0)
    return np.take_along_axis(unit, _STORED_COMPONENTS[largest], axis=1) * sign, largest


def log_scales(scales: Floats) -> Floats:
    """Return the natural logs of scales in double precision, at least -20."""
    with np.errstate(divide="ignore"):
        return np.maximum(np.log(scales.astype(np.float64)), _MIN_LOG_SCALE)


def to_integers(values: Floats, largest: int) -> NDArray[np.uint32]:
    """Return the nearest integers between 0 and ``largest``."""
    return np.clip(np.rint(values), 0, largest).astype(np.uint32)


def opacity_bytes(opacities: Floats) -> NDArray[np.uint32]:
    """Return opacities as bytes, where 255 is opaque. Invisible opacities become 0. If
    they were rounded up, they would be visible."""
    return np.where(opacities < _LEAST_VISIBLE_OPACITY, 0, to_integers(opacities * 255.0, 255))


def check_writable(gaussians: Gaussians) -> Gaussians:
    """Return the gaussians on the host. Raise a ValueError that names the first value
    that a quantised format cannot store."""
    host = gaussians.numpy()
    for name, values in vars(host).items():
        check_all(
            name,
            values,
            np.isfinite(values),
            ("finite values (v3dg.cleaning.examine reports all others)"),
        )
    check_all("quats", host.quats, (host.quats != 0).any(axis=1), "a length above 0")
    check_all("scales", host.scales, host.scales >= 0, "values >= 0")
    check_all("opacities", host.opacities, abs(host.opacities - 0.5) <= 0.5, "values in [0, 1]")
    return host
