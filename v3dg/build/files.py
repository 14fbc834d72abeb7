"""From an asset's file to a bundle's: built if need be, and gone on with after an interrupt."""

from __future__ import annotations

import os
from contextlib import AbstractContextManager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any, Literal

from v3dg import _device, _files
from v3dg._device import Device
from v3dg.build.checkpoint import discard_levels
from v3dg.build.config import BuildConfig
from v3dg.build.whole import build_into
from v3dg.bundle import Bundle
from v3dg.bundle.bundle import config_to_json
from v3dg.bundle.codec import Codec
from v3dg.bundle.file import BundleWriter, writing
from v3dg.bundle.pages import PageLayout
from v3dg.gaussians import Gaussians
from v3dg.io import read_asset


def build_file(
    asset_path: str | os.PathLike[str],
    bundle_path: str | os.PathLike[str],
    *,
    asset: Gaussians | None = None,
    config: BuildConfig | None = None,
    seed: int = 0,
    progress: bool = True,
    device: str | Device = "auto",
    resume: bool = False,
    unusable: Literal["drop", "refuse"] = "drop",
) -> tuple[Bundle, bool]:
    """Build the bundle of an asset's file, straight into a file.

    Beside the asset, memory holds no more than level 0 and the level at work. Until the bundle is there,
    finished levels are kept at `levels_path`.

    Args:
        asset: What is in the asset's file, where it is in memory already.
        resume: Keep a bundle that is newer than the asset and made with these settings, and go on from the
            levels of a build that was interrupted; otherwise all is made anew.
        config, seed, progress, device, unusable: As for `build_bundle`.

    Returns:
        The bundle, opened from its file, and whether it was built.

    Raises:
        ValueError, RuntimeError, OSError, MemoryError, KeyboardInterrupt: As `read_asset` and `build_bundle`.
    """
    asset_path, bundle_path = Path(asset_path), Path(bundle_path)
    config = config or BuildConfig()
    _files.check_folder(bundle_path)
    _device.resolve(device)  # before anything is read
    if resume and is_current(bundle_path, asset_path, config, seed):
        return Bundle.open(bundle_path), False
    levels = levels_path(bundle_path)
    if not resume:
        discard_levels(levels)
    if asset is None:
        asset = read_asset(asset_path)
    try:
        build_into(
            partial(_open_file, bundle_path),
            asset,
            config=config,
            seed=seed,
            progress=progress,
            device=device,
            resume_path=levels,
            unusable=unusable,
        )
    except ValueError as error:
        place = f"{asset_path}: " if str(error).startswith("asset: ") else ""
        raise ValueError(f"{place}{error}") from None
    levels.unlink(missing_ok=True)
    return Bundle.open(bundle_path), True


def _open_file(
    path: Path, layout: PageLayout, codec: Codec, made_with: dict[str, Any]
) -> AbstractContextManager[BundleWriter]:
    """The levels beside the bundle are locked, so no other build writes to it."""
    return writing(path, layout, codec, config_to_json(made_with), is_locked=True)


def levels_path(bundle_path: str | os.PathLike[str]) -> Path:
    """Where `build_file` keeps finished levels until the bundle is there."""
    path = Path(bundle_path)
    return path.with_name(path.name + ".partial")


def is_current(
    bundle_path: str | os.PathLike[str], asset_path: str | os.PathLike[str], config: BuildConfig, seed: int
) -> bool:
    """Whether a bundle is there, was made with these settings, and its asset's file has not changed since."""
    bundle_path = Path(bundle_path)
    if not bundle_path.is_file() or bundle_path.stat().st_mtime_ns < os.stat(asset_path).st_mtime_ns:
        return False
    try:
        made_with = Bundle.open(bundle_path).config
    except ValueError:  # damaged, or of another version: build it again
        return False
    is_ours = made_with.keys() >= {"build", "seed", "asset_gaussians", "dropped"}
    return bool(is_ours and made_with["build"] == asdict(config) and made_with["seed"] == seed)
