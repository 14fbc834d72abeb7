"""Rotations, quaternions and similarity transforms."""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from v3dg._numbers import check, floats, one_of, refuse
from v3dg.cameras import Axis, Floats

# The squares of larger components overflow a double, and those of smaller ones lose
# precision.
_LEAST = 1e-140
_MOST = 1e140

# Quaternions w x y z that rotate each axis to -y, which is the up direction of viewers
# in which y points down.
_HALF = math.sqrt(0.5)
_TO_UPRIGHT: dict[Axis, tuple[float, float, float, float]] = {
    "x": (_HALF, 0.0, 0.0, -_HALF),
    "y": (0.0, 1.0, 0.0, 0.0),
    "z": (_HALF, _HALF, 0.0, 0.0),
    "-x": (_HALF, 0.0, 0.0, _HALF),
    "-y": (1.0, 0.0, 0.0, 0.0),
    "-z": (_HALF, -_HALF, 0.0, 0.0),
}

# Largest relative difference between a matrix and a similarity transform. It allows for
# numbers that files round to a few digits.
_SIMILAR = 1e-4


class Similarity(NamedTuple):
    """I similarity transforms p -> scale * rotation p + position."""

    positions: Floats  # (I, 3)
    quaternions: Floats  # (I, 4) w x y z, unit length
    scales: Floats  # (I,)


def turn_upright(up: Axis) -> Floats:
    """Return the quaternion (4,) w x y z that rotates the up axis of an asset to -y;
    raise ValueError for an invalid axis."""
    one_of(up, "up", tuple(_TO_UPRIGHT))
    return np.array(_TO_UPRIGHT[up])


def turn_between(up: Axis, target: Axis) -> Floats:
    """Return the quaternion (4,) w x y z that rotates one axis to another. Between y,
    -y, z and -z, the x axis is unchanged."""
    return product(turn_upright(target) * [1, -1, -1, -1], turn_upright(up))


def product(first: Floats, second: Floats) -> Floats:
    """Return quaternions (..., 4) w x y z that rotate by `second` first, and then by
    `first`."""
    return np.asarray((first[..., None, :] @ product_matrix(second))[..., 0, :])


def product_matrix(quaternions: Floats) -> Floats:
    """Return the matrices M (..., 4, 4) of quaternions q. With row vectors p (4,) of
    quaternions, p @ M is the product p q."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [[w, x, y, z], [-x, w, -z, y], [-y, z, w, -x], [-z, -y, x, w]]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def similarity_of(matrices: ArrayLike, name: str = "matrix") -> Similarity:
    """Decompose matrices (4, 4) or (I, 4, 4) for column vectors into rotations,
    translations and uniform scales.

    Raises:
        ValueError: A shape is wrong, a number is not finite, or a matrix is any other
            transform, which the message describes.
    """
    array = floats(matrices, name)
    if array.ndim == 2:
        array = array[None]
    check(name, array.shape[1:] == (4, 4), f"shape (4, 4) or (I, 4, 4), got {np.shape(array)[1:]}")
    linear = array[:, :3, :3]
    largest = np.abs(linear).max(axis=(1, 2), initial=0.0)
    _check_similarities(array, largest, name)
    left, stretches, right = np.linalg.svd(linear / largest[:, None, None])
    quaternions = quaternions_from_rotations(left @ right)
    return Similarity(array[:, :3, 3].copy(), quaternions, stretches.mean(axis=1) * largest)


def _check_similarities(matrices: Floats, largest: Floats, name: str) -> None:
    """Raise a ValueError that says why one of the matrices (I, 4, 4) is not a
    similarity transform. ``largest`` has the largest absolute value of each linear
    part."""
    is_affine = np.abs(matrices[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0) <= _SIMILAR
    _refuse_first(name, is_affine, lambda row: f"the last row {_text(matrices[row, 3])}")
    _refuse_first(name, largest > 0, lambda _: "a scale of 0")
    linear = matrices[:, :3, :3] / largest[:, None, None]
    scales = np.linalg.norm(linear, axis=1)
    _refuse_first(
        name, np.asarray((scales > 0).all(axis=1)), lambda _: "a scale of 0 along an axis"
    )
    unit = linear / scales[:, None, :]
    cosines = np.abs(unit.transpose(0, 2, 1) @ unit - np.eye(3)).max(axis=(1, 2), initial=0.0)
    _refuse_first(name, cosines <= _SIMILAR, lambda _: "a shear")
    spreads = np.ptp(scales, axis=1)
    is_uniform = np.asarray(spreads <= _SIMILAR * scales.max(axis=1))
    sizes = scales * largest[:, None]
    _refuse_first(name, is_uniform, lambda row: f"different scales: {_text(sizes[row])}")
    _refuse_first(name, np.linalg.det(linear) > 0, lambda _: "a reflection")


def _refuse_first(name: str, good: NDArray[np.bool_], transform_of: Callable[[int], str]) -> None:
    """Raise ValueError for the first matrix that is not good. ``transform_of`` returns
    a description of the matrix at an index."""
    if good.all():
        return
    row = int(np.argmin(good))
    place = name
    if len(good) > 1:
        place = f"{name}[{row}]"
    refuse(
        place,
        f"a rotation, a translation and one positive scale, got {transform_of(row)}; instances "
        "cannot be stretched, sheared or mirrored",
    )


def _text(numbers: Floats) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def in_range(quaternions: NDArray[np.floating]) -> Floats:
    """Return quaternions (..., 4) as doubles whose squares neither underflow nor
    overflow.

    Very small and very large quaternions are multiplied by a power of two, which is
    exact. All others are unchanged, including zero quaternions and those that are not
    finite.
    """
    scaled = np.array(quaternions, np.float64)
    largest = np.abs(scaled).max(axis=-1)
    is_extreme = ((largest < _LEAST) & (largest > 0)) | ((largest > _MOST) & (largest < np.inf))
    if is_extreme.any():
        exponents = np.frexp(largest[is_extreme])[1]
        scaled[is_extreme] = np.ldexp(scaled[is_extreme], -exponents[..., None])
    return scaled


def normalised(quaternions: NDArray[np.floating]) -> Floats:
    """Return quaternions (..., 4) normalised to length one, in double precision.

    Zero quaternions stay zero, and quaternions that are not finite become NaN. Any
    other length is valid.
    """
    unit = in_range(quaternions)
    length = np.linalg.norm(unit, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore"):
        np.divide(unit, length, out=unit, where=length != 0)
    return unit


def rotation_from_quaternion(quaternions: Floats) -> Floats:
    """Return rotation matrices (I, 3, 3) of unit quaternions (I, 4) w x y z."""
    w, x, y, z = np.moveaxis(quaternions, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.ascontiguousarray(np.moveaxis(np.array(rows), (0, 1), (-2, -1)))


def quaternion_from_rotation(rotation: Floats) -> tuple[float, float, float, float]:
    """Return the unit quaternion w x y z, with w >= 0, of a (3, 3) rotation."""
    w, x, y, z = quaternions_from_rotations(np.asarray(rotation, np.float64)[None])[0].tolist()
    return w, x, y, z


def quaternions_from_rotations(rotations: Floats) -> Floats:
    """Return the unit quaternions (I, 4) w x y z, with w >= 0, of rotations (I, 3,
    3)."""
    # This is Bar-Itzhack's method: the quaternion is an eigenvector of a symmetric
    # matrix. It needs no case distinctions and is stable for any angle.
    trace = np.trace(rotations, axis1=1, axis2=2)
    symmetric = np.broadcast_to(trace[:, None, None], (len(rotations), 4, 4)).copy()
    skew = rotations - rotations.transpose(0, 2, 1)
    symmetric[:, 1:, 0] = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    trace_matrix = trace[:, None, None] * np.eye(3)
    symmetric[:, 1:, 1:] = rotations + rotations.transpose(0, 2, 1) - trace_matrix
    wxyz = np.linalg.eigh(symmetric, UPLO="L")[1][..., -1]
    return np.where(wxyz[:, :1] < 0, -wxyz, wxyz)


def quaternion_from_angles(degrees: Sequence[float]) -> tuple[float, float, float, float]:
    """Return the unit quaternion w x y z of rotations about the fixed axes x, then y,
    then z; angles (3,) in degrees."""
    x, y, z = np.radians(np.asarray(degrees, np.float64)) / 2
    cos_x, cos_y, cos_z = np.cos([x, y, z]).tolist()
    sin_x, sin_y, sin_z = np.sin([x, y, z]).tolist()
    return (
        cos_x * cos_y * cos_z + sin_x * sin_y * sin_z,
        sin_x * cos_y * cos_z - cos_x * sin_y * sin_z,
        cos_x * sin_y * cos_z + sin_x * cos_y * sin_z,
        cos_x * cos_y * sin_z - sin_x * sin_y * cos_z,
    )
