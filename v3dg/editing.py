"""Edits assets: crops, drops gaussians, changes the SH degree, joins.

Each function returns new gaussians and does not change its arguments. Positions and
lengths are in the frame of the asset, as returned by `read_asset`.
"""

from collections.abc import Iterable, Sequence
from typing import Literal, TypeAlias

import numpy as np
import numpy.typing as npt

from v3dg._numbers import check, check_type, one_of, positive, real, value_text, whole
from v3dg.cleaning import examine, outliers
from v3dg.gaussians import Array, Gaussians

Part: TypeAlias = Literal["inside", "outside"]
"""The part of an asset that a crop keeps."""

_Mask: TypeAlias = npt.NDArray[np.bool_]


def crop_box(
    gaussians: Gaussians,
    low: Array | npt.ArrayLike,
    high: Array | npt.ArrayLike,
    *,
    keep: Part = "inside",
) -> Gaussians:
    """Return the gaussians whose centres are in a box, or all others.

    A centre on the surface counts as inside. A centre that is not finite counts as
    outside.

    Args:
        low: (3,) the corner with the smallest coordinates. Use -inf for no limit.
        high: (3,) the opposite corner. Use inf for no limit.
        keep: The part that is kept. "outside" removes the gaussians in the box.

    Raises:
        ValueError: A corner is not three numbers, or a coordinate of ``high`` is less
            than that of ``low``.
    """
    lowest = _corner(low, "low")
    highest = _corner(high, "high")
    is_box = (lowest <= highest).all()
    check(
        "low, high",
        is_box,
        f"high to be at least low in each coordinate, got {lowest} and {highest}",
    )
    means = _check_gaussians(gaussians).numpy().means
    with np.errstate(invalid="ignore"):
        is_inside = ((means >= lowest) & (means <= highest)).all(axis=1)
    return _kept(gaussians, is_inside, keep)


def crop_sphere(
    gaussians: Gaussians,
    center: Array | npt.ArrayLike,
    radius: float,
    *,
    keep: Part = "inside",
) -> Gaussians:
    """Return the gaussians whose centres are in a sphere, or all others.

    A centre on the surface counts as inside. A centre that is not finite counts as
    outside.

    Args:
        center: (3,) centre of the sphere.
        radius: Radius of the sphere, > 0.
        keep: The part that is kept. "outside" removes the gaussians in the sphere.

    Raises:
        ValueError: An argument is invalid.
    """
    middle = _corner(center, "center")
    check("center", np.isfinite(middle).all(), f"finite numbers, got {middle}")
    length = positive(radius, "radius")
    means = _check_gaussians(gaussians).numpy().means
    with np.errstate(invalid="ignore", over="ignore"):
        is_inside = np.linalg.norm(means.astype(np.float64) - middle, axis=1) <= length
    return _kept(gaussians, is_inside, keep)


def drop_outliers(gaussians: Gaussians) -> Gaussians:
    """Return the gaussians without outliers: sky, floaters and mistakes.

    An outlier is more than 20 times the median distance away from the median position
    of the drawable gaussians. `v3dg info` prints the number of outliers. Gaussians
    whose positions are not finite are kept.
    """
    host = _check_gaussians(gaussians).numpy()
    is_finite = np.isfinite(host.means).all(axis=1)
    is_far = np.zeros(len(host), bool)
    is_far[is_finite] = outliers(
        host.means[is_finite], reference=host.means[examine(host).drawable]
    )
    return gaussians.subset(~is_far)


def drop_transparent(gaussians: Gaussians, min_opacity: float) -> Gaussians:
    """Return the gaussians whose opacity is at least a limit. Gaussians with NaN are
    removed.

    Raises:
        ValueError: The limit is not a number from 0 to 1.
    """
    limit = real(min_opacity, "min_opacity", "a number from 0 to 1", 0.0, 1.0)
    opacities = _check_gaussians(gaussians).numpy().opacities
    # The limit is rounded to float32, like the opacities, so that an opacity of 0.1 is
    # not below a limit of 0.1.
    with np.errstate(invalid="ignore"):
        return gaussians.subset(opacities >= np.float32(limit))


def to_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the gaussians with another SH degree, 0 to 3. Coefficients of higher
    degrees are removed, and missing ones are zero.

    Raises:
        ValueError: The degree is not 0, 1, 2 or 3.
    """
    count = (whole(degree, "degree", "an SH degree from 0 to 3", 0, 3) + 1) ** 2
    sh = _check_gaussians(gaussians).sh
    has_count = int(sh.shape[1])
    if count == has_count:
        return gaussians
    if count < has_count:
        if isinstance(sh, np.ndarray):
            cut = np.ascontiguousarray(sh[:, :count])
        else:
            cut = sh[:, :count].contiguous()
        return _with_sh(gaussians, cut)
    if isinstance(sh, np.ndarray):
        return _with_sh(gaussians, np.pad(sh, ((0, 0), (0, count - has_count), (0, 0))))
    import torch

    padding = (0, 0, 0, count - has_count)
    return _with_sh(gaussians, torch.nn.functional.pad(sh, padding))


def join(parts: Sequence[Gaussians]) -> Gaussians:
    """Join assets into one, in order. The SH degree is the highest of all parts, and
    missing coefficients are zero.

    Use `Gaussians.transform` to place a part first.

    Raises:
        ValueError: There are no parts.
        TypeError: A part is not Gaussians, or NumPy and torch are mixed.
    """
    check_type("parts", parts, Iterable, "a list of Gaussians")
    parts = list(parts)
    check("parts", parts, "at least one Gaussians, got none")
    for number, part in enumerate(parts):
        check_type(f"parts[{number}]", part, Gaussians, "Gaussians")
    degree = max(part.sh_degree for part in parts)
    return Gaussians.concatenate([to_degree(part, degree) for part in parts])


def _check_gaussians(gaussians: Gaussians) -> Gaussians:
    check_type("gaussians", gaussians, Gaussians, "Gaussians")
    return gaussians


def _corner(values: Array | npt.ArrayLike, name: str) -> npt.NDArray[np.float64]:
    """Return three numbers, which may be infinite."""
    host: Array = values
    if hasattr(host, "detach"):
        host = host.numpy(force=True)
    try:
        corner = np.array(host, np.float64)
    except (TypeError, ValueError, OverflowError):
        corner = np.full(0, np.nan)
    is_point = corner.shape == (3,) and not np.isnan(corner).any()
    check(name, is_point, f"three numbers, got {value_text(values)}")
    return corner


def _kept(gaussians: Gaussians, is_inside: _Mask, keep: Part) -> Gaussians:
    one_of(keep, "keep", ("inside", "outside"))
    if keep == "outside":
        return gaussians.subset(~is_inside)
    return gaussians.subset(is_inside)


def _with_sh(gaussians: Gaussians, sh: Array) -> Gaussians:
    changed = Gaussians(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities, sh)
    return changed.trained(antialiased=gaussians.antialiased)
