"""Build a bundle from an asset: split it into clusters, then halve and fit level after
level."""

import os
from concurrent.futures import Executor
from typing import Literal

from v3dg._device import Device
from v3dg._numbers import check, check_type
from v3dg._progress import Progress
from v3dg.bundle import Bundle
from v3dg.gaussians import Gaussians
from v3dg.io import loaded
from v3dg.levels.config import BuildConfig
from v3dg.levels.files import build_file, levels_path
from v3dg.levels.leaves import MemoryLeaves
from v3dg.levels.unfinished import discard_levels
from v3dg.levels.whole import build_into, devices_for

__all__ = ["BuildConfig", "build_bundle", "build_file", "discard_levels", "levels_path"]


def build_bundle(
    asset: Gaussians | str | os.PathLike[str],
    *,
    config: BuildConfig | None = None,
    seed: int = 0,
    progress: Progress = True,
    device: str | Device = "auto",
    resume_path: str | os.PathLike[str] | None = None,
    unusable: Literal["drop", "refuse"] = "drop",
    executor: Executor | None = None,
    codec: Literal["float32", "quantized"] = "float32",
) -> Bundle:
    """Build all levels of one asset (V3DG, algorithm 1; what we do differently is in
    docs/levels.md).

    The same asset, config, seed and device give the same bundle, bit for bit, whatever
    the number of threads (on one instruction set or one kind of GPU: others round
    differently).

    Args:
        asset: At least one gaussian that can be drawn; or the file of it, as for
            `read_asset`.
        config: Settings; ours by default.
        seed: Of the views that groups are fitted to.
        progress: Show a bar with the level, its groups done, the time left and their
            mean loss; four lines where stderr is no terminal. Or a function that is
            called with the gaussians that are fitted, of how many, and a text; what it
            raises ends the build. The four lines are also logged in any case, as INFO
            of the logger `v3dg`.
        device: Where to compute; the bundle is on the host in any case. "auto" and
            "cuda" are the asset's or the current CUDA device and all others of its
            kind, where torch can use it; "auto" else the CPU.
        resume_path: The file of the bundle, which is written there as it is built, and
            opened from there; a build of the same asset, config, seed and device goes
            on from what it finds.
        unusable: Whether gaussians with wrong values (not finite, negative scales,
            opacities outside 0 to 1) are left out, with a `v3dg.cleaning.AssetWarning`,
            or are an error. Those that no pixel can show, because their opacity is
            below 1/255, are left out in any case. How many of each kind is kept in the
            bundle's config as "dropped".
        executor: Whose workers build, as `dask.distributed.Client.get_executor()`; by
            default, threads of this process. They are to have devices of one kind with
            this process, which builds the topmost levels, and to reach `resume_path`,
            where they write their parts (docs/cluster.md).
        codec: How the bundle keeps gaussians, see `v3dg.Bundle`. Where that rounds,
            levels are fitted to what those below them were rounded to.

    Raises:
        ValueError: The asset has nothing that can be drawn, or a setting is wrong.
        RuntimeError: The device is "cuda", and something is missing for it; another
            build is using `resume_path`; or a worker is of another kind, or ended.
        OSError: `resume_path` cannot be written; what is finished stays there.
        MemoryError: The device has too little memory; the message has the numbers.
        KeyboardInterrupt: Ctrl-C; threads have stopped, what is finished is at
            `resume_path`.
    """
    asset = loaded(asset)
    check_type("asset", asset, Gaussians, "Gaussians")
    if config is None:
        config = BuildConfig()
    check_type("config", config, BuildConfig, "a BuildConfig")
    devices = devices_for(device, asset)
    leaves = MemoryLeaves(asset, config, unusable, devices[0])
    has_place = executor is None or resume_path is not None
    check("resume_path", has_place, "a file that all workers of the executor reach, got None")
    return build_into(
        resume_path, leaves, config, seed, devices, progress, codec=codec, executor=executor
    )
