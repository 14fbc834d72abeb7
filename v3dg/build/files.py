"""From files of an asset to a bundle's: built if need be, and gone on with after an interrupt."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from typing import Any, Literal

from v3dg import _files
from v3dg._device import Device
from v3dg._numbers import check_type
from v3dg._progress import Progress
from v3dg.build.config import BuildConfig
from v3dg.build.leaves import MemoryLeaves, made_with
from v3dg.build.leaves_on_disk import leaves_on_disk
from v3dg.build.memory import in_bytes, most_units, unit_bytes
from v3dg.build.unfinished import discard_levels
from v3dg.build.whole import build_into, devices_for
from v3dg.bundle import Bundle
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians

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
    """Build the bundle of an asset's file, or of several that make one asset, straight into a file.

    Until then it is at `levels_path`, and an asset that does not fit in memory in a scratch folder beside it.

    Args:
        asset: What is in the asset's file, where it is in memory already.
        resume: Keep a bundle that says that it was made of these gaussians with these settings, and go on
            from the levels of a build that was interrupted; otherwise all is made anew.
        memory: Of the host, beside what the process has: bytes, or text like "8GiB". Else half of the free.
        up: What is up in the asset, which the bundle then says to viewers and exports.
        config, seed, progress, device, unusable, executor, codec: As for `build_bundle`.

    Returns:
        The bundle, opened from its file, and whether it was built.

    Raises:
        ValueError: Memory is too little (the message says how much is needed), or a name not one of a bundle.
        ValueError, RuntimeError, OSError, MemoryError, KeyboardInterrupt: As `read_asset` and `build_bundle`.
    """
    paths = [asset_path] if isinstance(asset_path, str | os.PathLike) else list(asset_path)
    bundle_path, levels = Path(bundle_path), levels_path(bundle_path)
    config = BuildConfig() if config is None else config
    check_type("config", config, BuildConfig, "a BuildConfig")
    _files.check_bundle_name(bundle_path)
    _files.check_folder(bundle_path)
    _files.status_of_replaced(bundle_path)
    devices, num_bytes = devices_for(device, asset), in_bytes(memory)  # before anything is read
    if not resume:
        discard_levels(levels)
    where: dict[str, Any] = {"config": config, "unusable": unusable, "device": devices[0]}
    bounds: dict[str, Any] = {"memory": num_bytes, "reserved": unit_bytes, "progress": progress}
    bounds |= {} if executor is None else {"most_in_memory": 0}  # where workers would not find them
    with (
        _naming_asset(paths[0]),
        nullcontext(MemoryLeaves(asset, **where))
        if asset is not None
        else leaves_on_disk(paths, levels.with_suffix(".scratch"), **bounds, **where) as leaves,
    ):
        del asset
        if resume and _is_made_with(bundle_path, made_with(leaves, config, seed, codec, up), codec):
            with suppress(RuntimeError):  # another build to the same place has begun
                discard_levels(levels)
            return Bundle.open(bundle_path), False
        at: dict[str, Any] = {"bundle_path": bundle_path, "most_units": most_units(num_bytes, leaves)}
        at |= {"codec": codec, "executor": executor, "up": up}
        return build_into(levels, leaves, config, seed, devices, progress, **at), True


@contextmanager
def _naming_asset(path: AssetPath) -> Iterator[None]:
    """Have errors of an asset begin with the name of its file."""
    try:
        yield
    except ValueError as error:
        place = f"{os.fspath(path)}: " if str(error).startswith("asset: ") else ""
        raise ValueError(f"{place}{error}") from None


def _is_made_with(bundle_path: Path, how: dict[str, Any], codec: str) -> bool:
    """Whether a bundle is there, says that it was made so, and was not converted since."""
    try:
        bundle = Bundle.open(bundle_path)
        return bundle.config == how and bundle.codec == codec
    except (ValueError, OSError):  # none, damaged, or of another version: build it
        return False


def levels_path(bundle_path: str | os.PathLike[str]) -> Path:
    """The file that `build_file` makes the bundle in; from there an interrupted build goes on."""
    path = Path(bundle_path)
    if path.is_symlink():  # beside what it leads to, which it is to replace
        path = Path(os.path.realpath(path))
    return path.with_name(path.name + ".partial")
