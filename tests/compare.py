"""Bounds for the difference of two results, each with its reason, and the comparisons
that use them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Bound:
    """A bound for each element: |got - expected| <= absolute + relative *
    |expected|."""

    relative: float
    absolute: float
    reason: str


@dataclass(frozen=True)
class PictureBound:
    """Bounds for pictures. Colour and alpha may differ by `absolute` at every pixel and
    by `mean` on average; depth may differ by `relative_depth` at every pixel.

    If an alpha is within the relative distance `band` of 1/255, or a transmittance
    within that of 1e-4, rounding decides whether the gaussian is drawn. Such pixels may
    differ by `flip`, but at most the fraction `share` of all pixels.
    """

    absolute: float
    mean: float
    relative_depth: float
    band: float
    share: float
    reason: str
    # One more or one fewer gaussian with an alpha near 1/255 changes a pixel by at most
    # 1/255 of the range of colours, which is up to 4 here. If a pixel stops one
    # gaussian earlier or later, it changes by at most the transmittance before this
    # gaussian, 1e-4 / (1 - 0.999).
    flip: float = 0.4


@dataclass(frozen=True)
class GradientBound:
    """Bounds for the relative L2 distance and the cosine over one whole input."""

    relative_l2: float
    cosine: float
    reason: str


PROJECTION_DOUBLE = Bound(
    relative=1e-7,
    absolute=1e-8,
    reason=(
        "float64 on both sides. gsplat takes the determinant as a difference, which for aspect "
        "30 (more after foreshortening) loses five of its sixteen digits; gradients square that"
        " loss."
    ),
)
PICTURE_DOUBLE = PictureBound(
    absolute=1e-9,
    mean=1e-11,
    relative_depth=1e-9,
    band=1e-8,
    share=0.0,
    reason=(
        "float64 on both sides, the order of operations differs; needles of aspect 1e3 lose six"
        " digits."
    ),
)
PICTURE_FLOAT = PictureBound(
    absolute=1e-4,
    mean=1e-6,
    relative_depth=1e-4,
    band=1e-4,
    share=0.01,
    reason=(
        "float32 against float64: a mean is off by 1e-6 px to 1e-5 px, which moves the falloff "
        "of the narrowest gaussians (0.1 px) by 3 sigma * 1e-5 / 0.1. Depth is divided by an "
        "alpha of 1/255, itself 1 minus a number that is rounded to 6e-8. Measured: 2e-5, 3e-7,"
        " 3e-5."
    ),
)
NEEDLES_FLOAT = PictureBound(
    absolute=1e-3,
    mean=2e-6,
    relative_depth=1e-3,
    band=1e-3,
    share=0.01,
    reason=(
        "As PICTURE_FLOAT, with gaussians of aspect 1e3 that are 0.005 px wide without a "
        "filter. Measured: 3e-4, 7e-7, 4e-4."
    ),
)
FAR_ASIDE_FLOAT = PictureBound(
    absolute=2e-3,
    mean=1e-5,
    relative_depth=2e-3,
    band=1e-3,
    share=0.01,
    reason=(
        "A mean at 4e3 px from the principal point is off by an ulp or two of that, 5e-4 px, "
        "which moves the falloff of gaussians of 0.5 px (the filter's) by as much. Measured: "
        "1e-3, 4e-6, 9e-4."
    ),
)
CUTOFF_FLOAT = PictureBound(
    absolute=1e-4,
    mean=1e-6,
    relative_depth=1e-4,
    band=1e-4,
    share=1.0,
    reason="As PICTURE_FLOAT, with a cut-off under every pixel: each may fall on either side.",
)
GRADIENT_DOUBLE = Bound(
    relative=1e-7,
    absolute=1e-9,
    reason=(
        "The same derivatives in float64 by another route; absolute where terms of order 1 cancel."
    ),
)
FINITE_DIFFERENCE = Bound(
    relative=2e-6,
    absolute=1e-8,
    reason=(
        "Central differences of step 1e-6 in float64: rounding leaves 1e-16 / 1e-6 of the "
        "picture's sum."
    ),
)
GRADIENT_FLOAT = GradientBound(
    relative_l2=2e-3,
    cosine=0.99999,
    reason="Sums over pixels in float32; single pixels flip at the cut-offs.",
)
GRADIENT_NEEDLES = GradientBound(
    relative_l2=1e-2,
    cosine=0.9999,
    reason=(
        "As GRADIENT_FLOAT; needles thinner than the rounding of their place cross other pixels."
    ),
)

GRADIENT_GSPLAT = GradientBound(
    relative_l2=5e-3,
    cosine=0.9999,
    reason="float32 on both sides. gsplat takes the determinant as a difference, approximates the "
    "exponential, and divides the transmittance back out from behind; single pixels flip at the "
    "cut-offs.",
)
BACKGROUND_GRADIENT = Bound(
    relative=1e-5,
    absolute=1e-4,
    reason="A sum over thousands of pixels of numbers of order 1, in float32.",
)

MERGE_FLOAT = Bound(
    relative=2e-5,
    absolute=3e-6,
    reason=(
        "Computed in float64 from and to float32; squares of scales and rotations lose a few "
        "ulps. Absolute for what is compared in units of the largest."
    ),
)
FIT_FLOAT = Bound(
    relative=2e-3,
    absolute=1e-5,
    reason=(
        "Tens of steps of float32 gradients against float64; Adam divides by their own size, so"
        " their relative errors stay."
    ),
)
DSSIM_FLOAT = Bound(
    relative=2e-3,
    absolute=2e-5,
    reason=(
        "Variances are differences of float32 blurs of squares, 6e-8 against the constant "
        "0.03^2 = 9e-4."
    ),
)


def assert_close(got, expected, bound: Bound) -> None:
    np.testing.assert_allclose(
        got, expected, rtol=bound.relative, atol=bound.absolute, err_msg=bound.reason
    )


def assert_pictures_agree(raster, picture, bound: PictureBound) -> None:
    """Compare a v3dg.Image (NumPy or torch) with a reference Picture."""
    color, alpha, depth = (
        np.asarray(x, np.float64) for x in (raster.color, raster.alpha, raster.depth)
    )
    assert color.shape == picture.color.shape
    assert alpha.shape == depth.shape == picture.alpha.shape
    error = np.maximum(np.abs(color - picture.color).max(axis=2), np.abs(alpha - picture.alpha))
    depth_error = np.abs(depth - picture.depth) / np.where(picture.depth > 0, picture.depth, 1)
    assert np.isfinite(error).all()
    assert np.isfinite(depth_error).all()
    is_off = (error > bound.absolute) | (depth_error > bound.relative_depth)
    may_flip = picture.cutoff_distance <= bound.band
    wrong = is_off & ~may_flip
    if wrong.any():
        i, j = np.unravel_index(np.argmax(np.where(wrong, error, -1)), error.shape)
        raise AssertionError(
            f"{wrong.sum()} of {wrong.size} pixels are off; worst at row {i}, column {j}: "
            f"colour {color[i, j]} for {picture.color[i, j]}, alpha {alpha[i, j]} for "
            f"{picture.alpha[i, j]}, depth {depth[i, j]} for {picture.depth[i, j]}, largest depth "
            f"error {depth_error[wrong].max()}; bound: {bound}"
        )
    assert error.max(initial=0) <= bound.flip
    assert is_off.sum() <= max(bound.share * is_off.size, 2 if bound.share else 0)
    assert error[~may_flip].mean() <= bound.mean if (~may_flip).any() else True


def assert_gradients_agree(got, expected, bound: GradientBound) -> None:
    got, expected = (np.asarray(x, np.float64).ravel() for x in (got, expected))
    norm = np.linalg.norm(expected)
    assert np.linalg.norm(got - expected) <= bound.relative_l2 * norm, bound
    assert got @ expected >= bound.cosine * np.linalg.norm(got) * norm, bound
