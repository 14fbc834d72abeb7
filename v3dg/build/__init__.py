"""Build a bundle from an asset: split it into clusters, then halve and fit level after level."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, Literal

from v3dg._device import Device
from v3dg.build.checkpoint import discard_levels
from v3dg.build.config import BuildConfig
from v3dg.build.files import build_file, levels_path
from v3dg.build.leaves import MemoryLeaves
from v3dg.build.whole import build_into, devices_for
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.bundle.codec import Codec
from v3dg.bundle.pages import MemoryPages, PageLayout
from v3dg.gaussians import Gaussians

__all__ = ["BuildConfig", "build_bundle", "build_file", "discard_levels", "levels_path"]


def build_bundle(
    asset: Gaussians,
    *,
    config: BuildConfig | None = None,
    seed: int = 0,
    progress: bool = True,
    device: str | Device = "auto",
    resume_path: str | os.PathLike[str] | None = None,
    unusable: Literal["drop", "refuse"] = "drop",
) -> Bundle:
    """Build all levels of one asset (V3DG, algorithm 1; what we do differently is in docs/levels.md).

    The same asset, config, seed and device give the same bundle, bit for bit, whatever the number of threads
    (on one instruction set or one kind of GPU: others round differently).

    Args:
        asset: At least one gaussian that can be drawn.
        config: Settings; ours by default.
        seed: Of the views that groups are fitted to.
        progress: Show a bar with the level, its groups done, the time left and their mean loss.
        device: Where to compute; the bundle is on the host in any case. "auto" and "cuda" are the asset's or
            the current CUDA device and all others of its kind, where torch can use it; "auto" else the CPU.
        resume_path: Where to keep finished levels; a build of the same asset, config, seed and device that
            finds them there goes on from them. The file stays: remove it once the bundle is saved.
        unusable: Whether gaussians with wrong values (not finite, negative scales, opacities outside 0 to 1)
            are left out, with a `v3dg.cleaning.AssetWarning`, or are an error. Those that no pixel can show,
            because their opacity is below 1/255, are left out in any case. How many of each kind is kept in
            the bundle's config as "dropped".

    Raises:
        ValueError: The asset has nothing that can be drawn, or a setting is wrong.
        RuntimeError: The device is "cuda", and something is missing for it; or another build is using
            `resume_path`.
        OSError: `resume_path` cannot be written; the levels before are whole.
        MemoryError: The device has too little memory; the message has the numbers.
        KeyboardInterrupt: Ctrl-C; threads have stopped, finished levels are at `resume_path`.
    """
    config = config or BuildConfig()
    devices = devices_for(device, asset)
    leaves = MemoryLeaves(asset, config, unusable, devices[0])
    memory = _Memory()
    build_into(memory.open, leaves, config, seed, devices=devices, progress=progress, resume_path=resume_path)
    return memory.bundle


class _Memory:
    """A sink for pages whose bundle is in memory."""

    @contextmanager
    def open(self, layout: PageLayout, codec: Codec, made_with: dict[str, Any]) -> Iterator[_Memory]:
        self._pages = MemoryPages(layout, codec.empty(int(layout.first_gaussian[-1])))
        self._made_with = made_with
        yield self

    def write(self, first_page: int, last_page: int, gaussians: Gaussians) -> None:
        self._pages.write(first_page, last_page, gaussians)

    def finish(self, clusters: Clusters, groups: Groups) -> None:
        self.bundle = Bundle(clusters, groups, self._pages.gaussians, self._made_with)
