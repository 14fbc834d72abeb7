"""From files of an asset to the file of its bundle: builds it if needed, and resumes an
interrupted build."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Literal

from v3dg import _files
from v3dg._device import Device
from v3dg._numbers import check_type
from v3dg._progress import Progress
from v3dg._urls import shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.leaves import Leaves, MemoryLeaves, made_with
from v3dg.levels.leaves_on_disk import MOST_GAUSSIANS, leaves_on_disk
from v3dg.levels.memory import in_bytes, most_units, unit_bytes
from v3dg.levels.unfinished import discard_levels
from v3dg.levels.whole import build_into, devices_for

AssetPath = str | os.PathLike[str]


def build_file(
    asset_path: AssetPath | Sequence[AssetPath],
    bundle_path: str | os.PathLike[str],
    *,
    asset: Gaussians | None = None,
    config: BuildConfig | None = None,
    seed: int = 0,
    progress: Progress = True,
    device: str | Device = "auto",
    resume: bool = False,
    unusable: Literal["drop", "refuse"] = "drop",
    memory: int | str | None = None,
    executor: Executor | None = None,
    codec: Literal["float32", "quantized"] = "float32",
    up: Axis | None = None,
) -> tuple[Bundle, bool]:
    """Build the bundle of an asset's file, or of several that make one asset, straight
    into a file.

    While it is built it is at `levels_path`; an asset that does not fit in memory is
    sorted in a scratch folder beside it.

    Args:
        asset: The content of the asset's file, if it is in memory already.
        resume: Keep a bundle whose config says that it was made of these gaussians with
            these settings, and continue from the levels of a build that was
            interrupted; otherwise everything is built again.
        memory: Memory of the host that the build may use in addition to what the
            process uses already: bytes, or text like "8GiB". Default: half of the free
            memory.
        up: The axis that is up in the asset, which the bundle records for viewers and
            exports.
        config, seed, progress, device, unusable, executor, codec: As for
            `build_bundle`.

    Returns:
        The bundle, opened from its file, and whether it was built.

    Raises:
        ValueError: Memory is too little (the message says how much is needed), or the
            file name does not end in .v3dg.
        ValueError, RuntimeError, OSError, MemoryError, KeyboardInterrupt: As
            `read_asset` and `build_bundle`.
    """
    paths = [asset_path] if isinstance(asset_path, str | os.PathLike) else list(asset_path)
    bundle_path = Path(bundle_path)
    levels = levels_path(bundle_path)
    if config is None:
        config = BuildConfig()
    check_type("config", config, BuildConfig, "a BuildConfig")
    _files.check_bundle_name(bundle_path)
    _files.check_folder(bundle_path)
    _files.status_of_replaced(bundle_path)
    devices = devices_for(device, asset)
    num_bytes = in_bytes(memory)
    if not resume:
        discard_levels(levels)
    with _naming_asset(paths[0]):
        source: AbstractContextManager[Leaves]
        if asset is not None:
            source = nullcontext(MemoryLeaves(asset, config, unusable, devices[0]))
        else:
            source = leaves_on_disk(
                paths,
                levels.with_suffix(".scratch"),
                memory=num_bytes,
                config=config,
                unusable=unusable,
                reserved=unit_bytes,
                device=devices[0],
                progress=progress,
                # Workers of an executor cannot read leaves in the memory of this
                # process.
                most_in_memory=MOST_GAUSSIANS if executor is None else 0,
            )
        del asset
        with source as leaves:
            if resume and _is_made_with(
                bundle_path, made_with(leaves, config, seed, codec, up), codec
            ):
                with suppress(RuntimeError):  # another build has begun to write there
                    discard_levels(levels)
                return Bundle.open(bundle_path), False
            bundle = build_into(
                levels,
                leaves,
                config,
                seed,
                devices,
                progress,
                codec=codec,
                bundle_path=bundle_path,
                most_units=most_units(num_bytes, leaves),
                executor=executor,
                up=up,
            )
            return bundle, True


@contextmanager
def _naming_asset(path: AssetPath) -> Iterator[None]:
    """Begin the messages of errors of an asset with the name of its file."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        if text.startswith("asset: "):
            text = f"{shown(path)}: {text}"
        raise ValueError(text) from None


def _is_made_with(bundle_path: Path, config: dict[str, Any], codec: str) -> bool:
    """Whether a bundle exists, has this config, and was not converted to another codec
    since."""
    try:
        bundle = Bundle.open(bundle_path)
        return bundle.config == config and bundle.codec == codec
    except (ValueError, OSError):  # missing, damaged, or of another version: build it
        return False


def levels_path(bundle_path: str | os.PathLike[str]) -> Path:
    """The file in which `build_file` makes the bundle, and from which an interrupted
    build continues."""
    path = Path(bundle_path)
    if path.is_symlink():  # the file is beside the target of the link, which it will replace
        path = Path(os.path.realpath(path))
    return path.with_name(path.name + ".partial")
