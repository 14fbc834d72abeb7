"""From an asset's file to a bundle's: built if need be, and gone on with after an interrupt."""

from __future__ import annotations

import os
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Literal

from v3dg import _device, _files
from v3dg._device import Device
from v3dg.build.checkpoint import discard_levels
from v3dg.build.config import BuildConfig
from v3dg.build.whole import Job, build_into
from v3dg.bundle import Bundle
from v3dg.bundle.file import writing
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
        resume: Keep a bundle that says that it was made of these gaussians with these settings, and go on
            from the levels of a build that was interrupted; otherwise all is made anew.
        config, seed, progress, device, unusable: As for `build_bundle`.

    Returns:
        The bundle, opened from its file, and whether it was built.

    Raises:
        ValueError, RuntimeError, OSError, MemoryError, KeyboardInterrupt: As `read_asset` and `build_bundle`.
    """
    asset_path, bundle_path = Path(asset_path), Path(bundle_path)
    levels = levels_path(bundle_path)
    _files.check_folder(bundle_path)
    _device.resolve(device)  # before anything is read
    if not resume:
        discard_levels(levels)
    if asset is None:
        asset = read_asset(asset_path)
    try:
        job = Job.of(asset, config, seed, unusable)
        del asset
        is_kept = resume and _is_of(bundle_path, job)
        if not is_kept:
            # The levels beside the bundle are locked, so no other build writes to it.
            open_sink = partial(writing, bundle_path, is_locked=True)
            build_into(open_sink, job, progress=progress, device=device, resume_path=levels)
    except ValueError as error:
        place = f"{asset_path}: " if str(error).startswith("asset: ") else ""
        raise ValueError(f"{place}{error}") from None
    with suppress(RuntimeError):  # another build to the same place has begun
        discard_levels(levels)
    return Bundle.open(bundle_path), not is_kept


def _is_of(bundle_path: Path, job: Job) -> bool:
    """Whether a bundle is there and says that it was made by this job."""
    try:
        return Bundle.open(bundle_path).config == job.made_with
    except (ValueError, OSError):  # none, damaged, or of another version: build it
        return False


def levels_path(bundle_path: str | os.PathLike[str]) -> Path:
    """Where `build_file` keeps finished levels until the bundle is there."""
    path = Path(bundle_path)
    return path.with_name(path.name + ".partial")
