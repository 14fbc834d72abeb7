"""Builds the file of a bundle from the files of an asset, and resumes an interrupted
build."""

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import Executor
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from v3dg import _files
from v3dg._device import Device
from v3dg._numbers import check, check_type
from v3dg._progress import Progress
from v3dg._urls import shown
from v3dg.bundle import Bundle
from v3dg.cameras import Axis
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.default_quality import chosen_quality
from v3dg.levels.leaves import Leaves, MemoryLeaves, made_with
from v3dg.levels.leaves_on_disk import MOST_GAUSSIANS, leaves_on_disk
from v3dg.levels.memory import in_bytes, in_mib, most_units, unit_bytes
from v3dg.levels.quality import Quality, refined_settings, refinement_of
from v3dg.levels.refine_sizes import refine_bytes
from v3dg.levels.unfinished import discard_levels
from v3dg.levels.viewpoints import SeenFrom
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
    quality: Quality | None = None,
    seen_from: SeenFrom = "auto",
    up: Axis | None = None,
) -> tuple[Bundle, bool]:
    """Build the bundle of an asset from its file, or from several files that form one
    asset, and write it to a file.

    The unfinished bundle is written to `levels_path`. An asset that does not fit in
    memory is sorted in a scratch folder next to that file.

    Args:
        asset: The content of the asset's file, if it is already in memory.
        resume: True keeps an existing bundle if its config says that it was built from
            these gaussians with these settings. It also continues from the levels of an
            interrupted build. False builds everything again.
        memory: Host memory that the build may use in addition to the current use of the
            process, as bytes or text like "8GiB". The default is half of the free
            memory.
        up: The axis of the asset that points up, which the bundle stores for viewers
            and exports. config, seed, progress, device, unusable, executor, codec,
            quality, seen_from: See `build_bundle`. If a build is interrupted during the
            refinement, the levels stay as they were built.

    Returns:
        The bundle, opened from its file, and whether it was built.

    Raises:
        ValueError: The memory is too small (the message states the required amount), or
            the file name does not end in .v3dg.
        ValueError, RuntimeError, OSError, MemoryError, KeyboardInterrupt: See
            `read_asset` and `build_bundle`.
    """
    _check_output(Path(bundle_path))
    build = _FileBuild(
        paths=_paths_of(asset_path),
        bundle_path=Path(bundle_path),
        config=_checked_config(config),
        seed=seed,
        progress=progress,
        devices=devices_for(device, asset),
        unusable=unusable,
        num_bytes=in_bytes(memory),
        executor=executor,
        codec=codec,
        quality=quality,
        seen_from=seen_from,
        up=up,
    )
    if not resume:
        discard_levels(build.levels_path)
    with _naming_asset(build.paths[0]):
        source = build.leaves_of(asset)
        del asset
        return build.run(source, resume=resume)


def _checked_config(config: BuildConfig | None) -> BuildConfig:
    if config is None:
        return BuildConfig()
    check_type("config", config, BuildConfig, "a BuildConfig")
    return config


def _check_output(bundle_path: Path) -> None:
    """Raise an error before the build if no bundle can be written to this path."""
    _files.check_bundle_name(bundle_path)
    _files.make_folder(bundle_path)
    _files.status_of_replaced(bundle_path)


def _paths_of(asset_path: AssetPath | Sequence[AssetPath]) -> list[AssetPath]:
    if isinstance(asset_path, str | os.PathLike):
        return [asset_path]
    return list(asset_path)


@dataclass(frozen=True, eq=False)
class _FileBuild:
    """The checked arguments of `build_file`."""

    paths: Sequence[AssetPath]
    bundle_path: Path
    config: BuildConfig
    seed: int
    progress: Progress
    devices: Sequence[Device]
    unusable: Literal["drop", "refuse"]
    num_bytes: int  # host memory
    executor: Executor | None
    codec: str
    quality: Quality | None
    seen_from: SeenFrom
    up: Axis | None

    @property
    def levels_path(self) -> Path:
        return levels_path(self.bundle_path)

    def leaves_of(self, asset: Gaussians | None) -> AbstractContextManager[Leaves]:
        """Return the leaves of an asset in memory, or in its files."""
        if asset is not None:
            return nullcontext(MemoryLeaves(asset, self.config, self.unusable, self.devices[0]))
        most_in_memory = MOST_GAUSSIANS
        if self.executor is not None:  # other processes cannot read the memory of this one
            most_in_memory = 0
        return leaves_on_disk(
            self.paths,
            self.levels_path.with_suffix(".scratch"),
            memory=self.num_bytes,
            config=self.config,
            unusable=self.unusable,
            reserved=unit_bytes,
            device=self.devices[0],
            progress=self.progress,
            most_in_memory=most_in_memory,
        )

    def run(self, source: AbstractContextManager[Leaves], *, resume: bool) -> tuple[Bundle, bool]:
        """Return the finished bundle, and whether it was built.

        If a finished bundle exists, it is kept.
        """
        with source as leaves:
            config = leaves.settings(self.config)
            quality = chosen_quality(self.quality, config, leaves, self.devices[0], self.num_bytes)
            if resume and self._is_finished(leaves, config, quality):
                # A RuntimeError here means that another build is writing this file.
                with suppress(RuntimeError):
                    discard_levels(self.levels_path)
                return Bundle.open(self.bundle_path), False
            self._check_memory(leaves, quality)
            bundle = build_into(
                self.levels_path,
                leaves,
                config,
                self.seed,
                self.devices,
                self.progress,
                codec=self.codec,
                quality=quality,
                seen_from=self.seen_from,
                bundle_path=self.bundle_path,
                most_units=most_units(self.num_bytes, leaves),
                executor=self.executor,
                up=self.up,
            )
            return bundle, True

    def _check_memory(self, leaves: Leaves, quality: Quality) -> None:
        """Raise ValueError before the build if its refinement would need too much
        memory."""
        count = leaves.num_gaussians
        required = 0
        if quality != "draft":
            required = refine_bytes(count, leaves.sh_degree)
        check(
            "memory",
            self.num_bytes >= required,
            f"at least {in_mib(required)} to refine an asset of {count:,} gaussians, got "
            f"{in_mib(self.num_bytes)}; allow more memory, or build with quality 'draft'",
        )

    def _is_finished(self, leaves: Leaves, config: BuildConfig, quality: Quality) -> bool:
        """Return whether the bundle exists and was built from these leaves with these
        settings. A bundle that was converted to another codec later does not count."""
        settings = made_with(leaves, config, self.seed, self.codec, self.up)
        request = refinement_of(
            quality, leaves.num_gaussians, leaves.sh_degree, settings["seed"], self.seen_from
        )
        try:
            bundle = Bundle.open(self.bundle_path)
            if request is not None:
                settings = refined_settings(request, bundle, settings)
            return bundle.config == settings and bundle.codec == self.codec
        # missing, damaged, or of another version, so it is built again
        except (ValueError, OSError):
            return False


@contextmanager
def _naming_asset(path: AssetPath) -> Iterator[None]:
    """Prefix errors about an asset with the name of its file."""
    try:
        yield
    except ValueError as error:
        text = str(error)
        if text.startswith("asset: "):
            text = f"{shown(path)}: {text}"
        raise ValueError(text) from None


def levels_path(bundle_path: str | os.PathLike[str]) -> Path:
    """Return the path of the unfinished bundle. `build_file` writes it, and continues
    an interrupted build from it."""
    path = Path(bundle_path)
    # The finished bundle replaces the target of a link, so the unfinished one is next
    # to the target.
    if path.is_symlink():
        path = Path(os.path.realpath(path))
    return path.with_name(path.name + ".partial")
