"""Build a bundle from an asset: divide the asset into clusters, then make coarser
levels by repeatedly halving the number of gaussians and fitting the result."""

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
from v3dg.levels.default_quality import DraftWarning, chosen_quality
from v3dg.levels.files import build_file, levels_path
from v3dg.levels.leaves import MemoryLeaves
from v3dg.levels.memory import free_bytes
from v3dg.levels.quality import Quality
from v3dg.levels.unfinished import discard_levels
from v3dg.levels.viewpoints import SeenFrom
from v3dg.levels.whole import build_into, devices_for

__all__ = [
    "BuildConfig",
    "DraftWarning",
    "build_bundle",
    "build_file",
    "discard_levels",
    "levels_path",
]


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
    quality: Quality | None = None,
    seen_from: SeenFrom = "auto",
) -> Bundle:
    """Build all levels of one asset (V3DG, algorithm 1; docs/levels.md lists the
    differences).

    The same asset, config, seed and device give the same bundle, bit for bit, for any
    number of threads. Other instruction sets or kinds of GPU round differently.

    Args:
        asset: Gaussians, at least one of which can be drawn, or the path of a file that
            `read_asset` can read.
        config: Settings; the defaults of `BuildConfig` if None.
        seed: Seed of the random views that groups are fitted to.
        progress: True shows a bar with the level, the number of fitted groups, the
            remaining time and the mean loss. If stderr is not a terminal, it prints
            four lines instead. A function is called with the number of fitted
            gaussians, the total, and a text; an exception that it raises ends the
            build. The four lines are always logged, as INFO of the logger `v3dg`.
        device: The device that computes; the bundle is always on the host. "cuda" means
            the asset's CUDA device, or else the current one, together with all other
            devices of its kind. "auto" means "cuda" if torch can use CUDA, otherwise
            the CPU.
        resume_path: The file of the bundle. The build writes each level to it and, at
            the end, opens the bundle from it. If the file has levels of an earlier
            build of the same asset with the same config, seed and device, the build
            continues from them.
        unusable: What to do with gaussians that have invalid values (not finite,
            negative scales, opacities outside 0 to 1). They are either left out, with a
            `v3dg.cleaning.AssetWarning`, or raise an error. Invisible gaussians, whose
            opacity is below 1/255, are always left out. The bundle's config stores the
            number of gaussians with each fault as "dropped".
        executor: The executor whose workers build, such as
            `dask.distributed.Client.get_executor()`; by default threads of this
            process. The workers need devices of the same kind as this process, which
            builds the topmost levels. They also need access to `resume_path`, where
            they write their parts (docs/cluster.md).
        codec: The codec of the bundle, see `v3dg.Bundle`. With a lossy codec, levels
            are fitted to the rounded gaussians of the levels below them.
        quality: "draft" leaves the levels as they are built. "standard" then refines
            them together (`v3dg.refine_bundle`). For each unit, it uses 18,000 pictures
            and one more for every 100 gaussians, which takes seconds on a GPU and
            minutes on a CPU. "best" uses five times as many pictures. docs/levels.md
            has the time and the gain of each. None means "standard" on a GPU, and
            "draft" on a CPU or for a config without steps. If there is too little free
            memory to refine the asset, None also means "draft", with a
            `v3dg.levels.DraftWarning`. The levels at `resume_path` stay unrefined, and
            the refined bundle is in memory.
        seen_from: Where the pictures of a refinement are taken from; see
            `v3dg.refine_bundle`.

    Raises:
        ValueError: The asset has no gaussian that can be drawn, or a setting is wrong.
        RuntimeError: The device is "cuda" and cannot be used; another build is using
            `resume_path`; a worker has a device of another kind; or a worker ended
            unexpectedly.
        OSError: `resume_path` cannot be written. Finished levels are kept in it.
        MemoryError: The device has too little memory; the message states the required
            amount.
        KeyboardInterrupt: Ctrl-C was pressed; all threads have stopped, and finished
            levels are at `resume_path`.
    """
    asset = loaded(asset)
    check_type("asset", asset, Gaussians, "Gaussians")
    if config is None:
        config = BuildConfig()
    check_type("config", config, BuildConfig, "a BuildConfig")
    devices = devices_for(device, asset)
    leaves = MemoryLeaves(asset, config, unusable, devices[0])
    _check_place(executor, resume_path)
    config = leaves.settings(config)
    quality = chosen_quality(quality, config, leaves, devices[0], free_bytes())
    return build_into(
        resume_path,
        leaves,
        config,
        seed,
        devices,
        progress,
        codec=codec,
        quality=quality,
        seen_from=seen_from,
        executor=executor,
    )


def _check_place(executor: Executor | None, resume_path: str | os.PathLike[str] | None) -> None:
    """Raise ValueError if the workers of an executor have no file for their parts."""
    check(
        "resume_path",
        executor is None or resume_path is not None,
        "a file on a disk that all workers of the executor share, got None; give the path of the "
        "bundle",
    )
