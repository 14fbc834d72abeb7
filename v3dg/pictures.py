"""8-bit pictures: conversion from colours, contact sheets, reading, and writing."""

import io
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._numbers import check
from v3dg.gaussians import Array

Picture: TypeAlias = NDArray[np.uint8]
"""(H, W, 3) uint8, sRGB."""

SUFFIXES = (".png", ".jpg", ".jpeg")
MOST_SIDE = 65_500
"""Largest side of a picture in px, which is JPEG's limit."""
MOST_PIXELS_DRAWN = 1 << 27
"""Maximum number of pixels of a picture that is drawn. Each pixel needs 20 bytes of
memory."""
MOST_PIXELS_COMPARED = 1 << 25
"""Maximum number of pixels of a picture that is compared, which is that of an 8K
screen. Each pixel needs 200 bytes of memory."""

_GAP_PX = 6
_TEXT_PX = 18
_PAPER = (16, 18, 22)
_INK = (238, 240, 243)


def to_8bit(image: Array) -> Picture:
    """Convert display values from [0,1] to 0..255 with rounding, on the device of the
    array. Values outside [0,1] are clipped."""
    if hasattr(image, "detach"):
        import torch

        return np.asarray((image.detach().clip(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy())
    clipped = np.clip(np.asarray(image, dtype=np.float32), 0, 1)
    return np.asarray((clipped * np.float32(255) + np.float32(0.5)).astype(np.uint8))


def checked(name: str, image: Array) -> NDArray[np.generic]:
    """Return a picture (H,W,3) as a NumPy array on the host, without gradients. Raise
    TypeError or ValueError if it is not a picture."""
    if hasattr(image, "detach"):
        image = image.detach().cpu().numpy()
    if not isinstance(image, np.ndarray):
        raise TypeError(
            f"{name}: expected a NumPy array or a torch tensor, got {type(image).__name__}"
        )
    fits = image.ndim == 3 and image.shape[2] == 3 and 0 not in image.shape
    check(name, fits, f"shape (H, W, 3) with at least one pixel, got {image.shape}")
    return image


def contact_sheet(rows: Sequence[Sequence[tuple[str, Picture]]]) -> Picture:
    """Arrange rows of pairs (text, picture) as one picture, with each text above its
    picture."""
    from PIL import Image, ImageDraw, ImageFont

    heights = [max(picture.shape[0] for _, picture in row) for row in rows]
    widths = [sum(picture.shape[1] + _GAP_PX for _, picture in row) for row in rows]
    size = max(widths) + _GAP_PX, sum(h + _TEXT_PX + _GAP_PX for h in heights) + _GAP_PX
    canvas = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(canvas)
    font = ImageFont.load_default(12)
    top = _GAP_PX
    for row, height in zip(rows, heights, strict=True):
        left = _GAP_PX
        for text, picture in row:
            draw.text((left, top), text, font=font, fill=_INK)
            canvas.paste(Image.fromarray(picture), (left, top + _TEXT_PX))
            left += picture.shape[1] + _GAP_PX
        top += height + _TEXT_PX + _GAP_PX
    return np.asarray(canvas)


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """Check before long work that the name of a picture has a known suffix.

    Raises:
        ValueError: The suffix is not one of ``SUFFIXES``.
    """
    path = Path(path)
    is_known = path.suffix.lower() in SUFFIXES
    check(path, is_known, f"a file name ending in {', '.join(SUFFIXES)}")
    return path


def check_size(name: str, width: int, height: int, most_pixels: int = MOST_PIXELS_DRAWN) -> None:
    """Check the size of a picture before it is decoded or drawn.

    Raises:
        ValueError: A side has more than ``MOST_SIDE`` px, or the picture more than
            ``most_pixels``.
    """
    expected = (
        f"a picture of at most {MOST_SIDE:,} px a side and at most {most_pixels:,} px in total"
    )
    fits = max(width, height) <= MOST_SIDE and width * height <= most_pixels
    check(name, fits, f"{expected}, got {width} x {height} px")


def read_picture(path: str | os.PathLike[str]) -> Picture:
    """Read a PNG or a JPEG for a comparison. Its suffix and its transparency are
    ignored.

    Raises:
        ValueError: The file is not a PNG or a JPEG, is damaged or too large, or has
            more than 8 bits per channel.
        OSError: The file cannot be read.
    """
    from PIL import Image

    name = os.fspath(path)
    with warnings.catch_warnings(), open(_files.open_regular(path), "rb") as file:
        # Pillow's warnings are about other content of the file, such as further
        # pictures.
        warnings.simplefilter("ignore")
        is_known = file.read(8).startswith((b"\x89PNG\r\n\x1a\n", b"\xff\xd8"))
        check(name, is_known, "a PNG or a JPEG, got another file; convert it first")
        with _files.value_errors(name, "a PNG or a JPEG that is not damaged"):
            # Only these formats are allowed, because Pillow starts external programs
            # for some others.
            image = Image.open(file, formats=("PNG", "JPEG"))
        check_size(name, *image.size, MOST_PIXELS_COMPARED)
        check(
            name,
            not image.mode.startswith("I"),
            "8 bits per channel, got 16; convert the picture first",
        )
        with _files.value_errors(name, "a PNG or a JPEG that is not damaged"):
            return np.asarray(image.convert("RGB"))


def encode_png(image: Array) -> bytes:
    """Return a PNG of (H,W,3) floats in [0,1]."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, "PNG")
    return stream.getvalue()


def write_picture(
    path: str | os.PathLike[str], image: Array, *, alpha: Array | None = None
) -> None:
    """Write a picture as PNG or JPEG. The file appears only when it is complete.

    Args:
        path: Path of the file. Its folder is created if needed.
        image: (H, W, 3) floats in [0, 1], or 8-bit values.
        alpha: (H, W) opacity in [0, 1], for a transparent PNG. `image` must then be
            floats: the premultiplied colours of a picture that was drawn on black. The
            file has straight alpha, which means colours divided by alpha, as PNG
            requires.

    Raises:
        TypeError, ValueError: A shape, a type or a value is invalid, or the suffix is
            not that of a PNG or a JPEG (with `alpha`, only of a PNG).
        OSError: The file cannot be written.
    """
    from PIL import Image

    path = check_picture_path(path)
    pixels = checked("image", image)
    if alpha is not None:
        is_png = path.suffix.lower() == ".png"
        check(path, is_png, "a file name ending in .png for a transparent picture")
        pixels = _straight(pixels, alpha)
    if pixels.dtype != np.uint8:
        check("image", pixels.dtype.kind == "f", f"uint8, or floats in [0,1], got {pixels.dtype}")
        check("image", not np.isnan(pixels).any(), "colours without NaN, got NaN")
        pixels = to_8bit(pixels)
    kind = "JPEG"
    if path.suffix.lower() == ".png":
        kind = "PNG"
    with _files.replacing(path) as temporary:
        # `quality` is used only for JPEG.
        Image.fromarray(pixels).save(temporary, kind, quality=90)


def _straight(premultiplied: NDArray[np.generic], alpha: Array) -> NDArray[np.generic]:
    """Return (H, W, 4) straight colours and alpha."""
    if hasattr(alpha, "detach"):
        alpha = alpha.detach().cpu().numpy()
    coverage = np.asarray(alpha)
    shape = premultiplied.shape[:2]
    check("alpha", coverage.shape == shape, f"shape {shape}, got {coverage.shape}")
    check("image", premultiplied.dtype.kind == "f", f"floats, got {premultiplied.dtype}")
    colors = np.asarray(premultiplied, np.float32)
    is_on_black = not (colors[coverage == 0] != 0).any()
    check("image", is_on_black, "a picture drawn on black, got one on another background")
    divided = colors / np.maximum(coverage, np.float32(1e-6))[..., None]
    return np.concatenate([divided, coverage[..., None].astype(np.float32)], axis=2)
