"""Picture files: float pictures to 8 bits, written whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from v3dg import _files

if TYPE_CHECKING:
    from numpy.typing import NDArray

SUFFIXES = (".png", ".jpg", ".jpeg")


def to_8bit(image: Any) -> NDArray[np.uint8]:
    """Round display values in [0,1] to 0..255; what lies outside is clipped."""
    clipped = np.clip(np.asarray(image, dtype=np.float32), 0, 1)
    pixels: NDArray[np.uint8] = (clipped * np.float32(255) + np.float32(0.5)).astype(np.uint8)
    return pixels


def check_picture_path(path: str | os.PathLike[str]) -> Path:
    """Check, before long work, that a picture can be written there.

    Raises:
        ValueError: The suffix is not one of ``SUFFIXES``, or the folder does not exist.
    """
    path = Path(path)
    if path.suffix.lower() not in SUFFIXES:
        raise ValueError(f"{path}: expected a file name ending in {', '.join(SUFFIXES)}; choose one of them")
    _files.check_folder(path)
    return path


def write_picture(path: str | os.PathLike[str], image: Any) -> None:
    """Write (H,W,3) floats in [0,1] or 8-bit values as PNG or JPEG; the file appears when it is complete."""
    from PIL import Image

    path = check_picture_path(path)
    pixels = image if getattr(image, "dtype", None) == np.uint8 else to_8bit(image)
    kind = "PNG" if path.suffix.lower() == ".png" else "JPEG"
    options: dict[str, Any] = {"quality": 90} if kind == "JPEG" else {}
    with _files.replacing(path) as temporary:
        Image.fromarray(pixels).save(temporary, kind, **options)
