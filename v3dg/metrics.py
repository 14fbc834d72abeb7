"""Measures the difference between two pictures: PSNR, SSIM and FLIP. FLIP needs the
extra `flip`.

Every function takes a reference and a test picture (H,W,3) with display values in [0,1]
(sRGB as shown, not linear light), as NumPy arrays or torch tensors, and returns the
mean over the whole picture. Nothing is cropped.
"""

import importlib.util
from typing import cast

import numpy as np
from numpy.typing import NDArray

from v3dg import _core, _extras
from v3dg._device import Device
from v3dg._numbers import check
from v3dg.cameras import Camera
from v3dg.gaussians import Array
from v3dg.opening import File
from v3dg.pictures import Picture, checked, to_8bit
from v3dg.render import render
from v3dg.scene import Subject

FLIP_PIXELS_PER_DEGREE = 67.0
"""Pixels per degree of a 0.7 m wide 4K display seen from a distance of 0.7 m. This is
the viewing condition in the paper of FLIP."""

MIN_TRANSMITTANCE = 1e-4
"""Transmittance at which pixels of reference pictures stop: a tenth of that of other
pictures."""

FLIP_MISSING = _extras.missing("flip_evaluator")


def _pair(reference: Array, test: Array) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Return both pictures as NumPy arrays. Raise ValueError unless they have floats
    and the same size."""
    a = checked("reference", reference)
    b = checked("test", test)
    for name, dtype in (("reference", a.dtype), ("test", b.dtype)):
        check(
            name, dtype.kind == "f", f"floats in [0, 1], got {dtype}; divide 8-bit pictures by 255"
        )
    check("test", a.shape == b.shape, f"the reference's shape {a.shape}, got {b.shape}")
    return cast(NDArray[np.floating], a), cast(NDArray[np.floating], b)


def psnr(reference: Array, test: Array) -> float:
    """Compute the peak signal-to-noise ratio in dB, for a peak of 1; it is infinite for
    equal pictures.

    Values are not clipped. Clip both pictures to [0,1] first to compare them as shown
    on a screen.
    """
    a, b = _pair(reference, test)
    difference = a.astype(np.float64) - b
    mean_square = float(np.mean(difference * difference))
    if mean_square == 0:
        return float("inf")
    return -10 * float(np.log10(mean_square))


def ssim(reference: Array, test: Array) -> float:
    """Compute the structural similarity (SSIM), which is 1 for equal pictures.

    The window is a Gaussian of 11×11 px with a standard deviation of 1.5 px. Variances
    are those of the population, borders are mirrored, and the result is the mean over
    all pixels and channels. Values are not clipped. Other conventions change the third
    digit.

    Raises:
        ValueError: A side is shorter than 6 px, which is less than half a window.

    Source: Wang et al., Image quality assessment: from error visibility to structural
    similarity, 2004.
    """
    a, b = _pair(reference, test)
    check("reference", min(a.shape[:2]) >= 6, f"at least 6 px a side, got {a.shape}")
    if a.dtype == b.dtype == np.float32:
        return _core.ssim(np.ascontiguousarray(a, np.float32), np.ascontiguousarray(b, np.float32))
    return _core.ssim(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b, np.float64))


def has_flip() -> bool:
    """Return whether the extra `flip` is installed, which FLIP requires."""
    return importlib.util.find_spec("flip_evaluator") is not None


def _flip(reference: Array, test: Array, *, magma: bool) -> NDArray[np.float32]:
    flip_evaluator = _extras.load("flip_evaluator")
    # The arrays are copied, because the evaluator may write into its arguments.
    a, b = (
        np.clip(picture, 0, 1).astype(np.float32, order="C") for picture in _pair(reference, test)
    )
    parameters = {"ppd": FLIP_PIXELS_PER_DEGREE}
    error, _, _ = flip_evaluator.evaluate(a, b, "LDR", applyMagma=magma, parameters=parameters)
    return np.asarray(error, dtype=np.float32)


def flip_map(reference: Array, test: Array) -> NDArray[np.float32]:
    """Compute LDR-FLIP per pixel at 67 pixels per degree: (H,W), from 0 (no visible
    difference) to 1.

    Pictures are clipped to [0,1] first.

    Raises:
        ImportError: The extra `flip` is not installed.

    Source: Andersson et al., FLIP: a difference evaluator for alternating images, HPG
    2020; computed by the authors' package.
    """
    return _flip(reference, test, magma=False).reshape(reference.shape[0], reference.shape[1])


def flip(reference: Array, test: Array) -> float:
    """Compute the mean of `flip_map`."""
    return float(np.mean(flip_map(reference, test), dtype=np.float64))


def error_image(reference: Array, test: Array) -> NDArray[np.float32]:
    """Return `flip_map` in the magma colours that are customary for FLIP, (H,W,3);
    black means no difference."""
    return _flip(reference, test, magma=True)


def box_downsample(image: Array, factor: int) -> Array:
    """Average blocks of ``factor`` × ``factor`` pixels: (H,W,...) to
    (H/factor,W/factor,...). The type of the array is kept.

    Raises:
        ValueError: ``factor`` is not positive, or does not divide the height and the
            width.
    """
    check("factor", factor >= 1, f"at least 1, got {factor}")
    height, width = image.shape[:2]
    is_divisible = height % factor == 0 == width % factor
    check(
        "image", is_divisible, f"a height and width divisible by {factor}, got {height} x {width}"
    )
    return image.reshape(height // factor, factor, width // factor, factor, *image.shape[2:]).mean(
        (1, 3)
    )


def errors_of(reference: Picture, test: Picture) -> dict[str, float | None]:
    """Return the FLIP, the PSNR and the SSIM of two 8-bit pictures. FLIP is None
    without the extra `flip`, and PSNR is None for equal pictures."""
    a, b = (picture.astype(np.float32) / np.float32(255) for picture in (reference, test))
    errors: dict[str, float | None] = {"flip": None, "psnr": None, "ssim": ssim(a, b)}
    if has_flip():
        errors["flip"] = flip(a, b)
    if (reference != test).any():
        errors["psnr"] = psnr(a, b)
    return errors


def draw_truth(
    subject: Subject | File,
    camera: Camera,
    device: str | Device = "auto",
    supersampling: int = 2,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> Picture:
    """Draw all gaussians of a subject as an 8-bit reference picture for comparisons.

    A pixel is the average of ``supersampling`` × ``supersampling`` samples. Each sample
    is clipped to [0,1] first, as on a screen.
    """
    image = render(
        subject,
        camera.scaled(supersampling),
        tolerance=0.0,
        background=background,
        min_transmittance=MIN_TRANSMITTANCE,
        device=device,
    )
    return to_8bit(box_downsample(image.color.clip(0, 1), supersampling))
