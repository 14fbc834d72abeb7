"""Optional packages: what each is needed for, and how to install it."""

import importlib
from types import ModuleType
from typing import NamedTuple


class Extra(NamedTuple):
    """An optional package."""

    requirement: str  # in pip's syntax
    purpose: str


EXTRAS = {
    "torch": Extra("torch>=2.2", "CUDA and gradients"),
    "msgspec": Extra("msgspec>=0.18.6", "the viewer"),
    "websockets": Extra("websockets>=14.1", "the viewer"),
    "flip_evaluator": Extra("flip-evaluator>=1.6", "errors by FLIP"),
    "av": Extra("av>=12", "videos"),
    "pxr": Extra("usd-core>=26.11", "OpenUSD"),
    "fsspec": Extra("fsspec[http]>=2024.2", "files at URLs"),
    "gymnasium": Extra("gymnasium>=1.1", "environments of Gymnasium"),
    "mujoco": Extra("mujoco>=3.2", "MuJoCo"),
    "newton": Extra("newton>=1.8", "Newton"),
    "wgpu": Extra("wgpu>=0.32", "pictures by WebGPU"),
    "distributed": Extra("distributed>=2024.1", "builds on many machines"),
}
"""Optional packages, by the names of their modules."""


def missing(module: str) -> str:
    """Return the error text for a package that is missing or too old."""
    extra = EXTRAS[module]
    packages = [package for package in EXTRAS.values() if package.purpose == extra.purpose]
    needed = " ".join(f"'{package.requirement}'" for package in packages)
    return (
        f"{extra.purpose}: expected {extra.requirement}, got no package or an older version; run "
        f"pip install {needed}"
    )


def load(module: str) -> ModuleType:
    """Import a module.

    If it is missing, the ImportError says how to install its package.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        raise ImportError(missing(module.partition(".")[0])) from error
