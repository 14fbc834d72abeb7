"""Packages that v3dg can do without: what each is for, and how to get it."""

import importlib
from typing import Any

EXTRAS = {
    "torch": ("torch>=2.2", "CUDA and gradients"),
    "msgspec": ("msgspec>=0.18.6", "the viewer"),
    "websockets": ("websockets>=14.1", "the viewer"),
    "flip_evaluator": ("flip-evaluator>=1.6", "errors by FLIP"),
    "av": ("av>=12", "videos"),
    "pxr": ("usd-core>=26.11", "OpenUSD"),
    "pycolmap": ("pycolmap>=4.0", "cameras of COLMAP"),
    "fsspec": ("fsspec[http]>=2024.2", "files at URLs"),
    "distributed": ("distributed>=2024.1", "builds on many machines"),
}
"""By module: what pip is to install, and what it is for."""


def missing(module: str) -> str:
    """What to say where one is not installed, or too old."""
    requirement, purpose = EXTRAS[module]
    needed = " ".join(f"'{other}'" for other, what in EXTRAS.values() if what == purpose)
    return f"{purpose}: expected {requirement}, got none or an older one; pip install {needed}"


def load(module: str) -> Any:
    """The module; ImportError says how to get it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(missing(module.partition(".")[0])) from error
