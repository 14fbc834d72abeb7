"""Refines all levels of a bundle together, in pictures of cuts, where gaussians hide
each other."""

import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check_type, real, whole
from v3dg._progress import Bar, Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.fit import fit_config, run_fit
from v3dg.opening import File
from v3dg.residency import residency

_T = TypeVar("_T", covariant=True)
# The factor of the step sizes of a fit. It is small because refinement starts from a
# fitted level, and grows with the root of the number of windows that make a step.
_RATE = 0.2
# The number of pictures that measure how much is seen of each gaussian.
_NUM_WEIGHING_PICTURES = 2_000
# A gaussian is measured if it is in the cuts of at least this many of them. Pictures
# show only parts of a very large asset, so some gaussians are in too few.
_LEAST_LOOKS = 8


def refine_bundle(
    bundle: Bundle | File,
    *,
    cameras: Iterable[Camera] | Mapping[str, Camera] = (),
    steps: int = 30_000,
    drop: float = 0.02,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
) -> Bundle:
    """Return a copy of a bundle whose levels look more like its asset, in small and
    large pictures.

    A build fits every group alone, seen from all sides, at the size at which it is
    selected. Pictures of cuts show gaussians next to each other, where they hide each
    other. With such pictures, this function drops the least visible gaussians of all
    levels but the first, and moves the others until the pictures match those of the
    asset. Cuts have between 0.7 of the asset's gaussians and the number of the last
    level. Pictures have 0.18 to 9.7 times the native size of the cut, which is 2 px² a
    gaussian. docs/levels.md has the gain.

    The same bundle, cameras, steps, share and seed give the same bits on the same kind
    of device.

    Args:
        bundle: A bundle of `build_bundle`, or its file. The function takes about six
            times the bundle's memory.
        cameras: Views of the asset, also by name: for a room, those of its photographs.
            Views from elsewhere may get worse. Without cameras, pictures are taken from
            all around.
        steps: Number of pictures that are compared. A GPU takes eight for each step of
            its gradients, and rounds up.
        drop: Share of a level's visibility, 0 to 0.5, up to which its least visible
            gaussians are dropped; 0 keeps all. Refining a bundle again drops gaussians
            again.
        seed: Seed of the pictures.
        device: The device that computes.
        progress: See `build_bundle`.

    Raises:
        TypeError: ``bundle`` is not a bundle, or a camera is not a camera.
        ValueError: There are no steps, or the share or the seed is out of range.
        RuntimeError: The device is "cuda" and cannot be used.
        KeyboardInterrupt: Ctrl-C was pressed; threads have stopped.
    """
    if isinstance(bundle, str | os.PathLike):
        bundle = Bundle.open(bundle)
    check_type("bundle", bundle, Bundle, "a Bundle")
    if isinstance(cameras, Mapping):
        cameras = cameras.values()
    cameras = list(cameras)
    for number, camera in enumerate(cameras):
        check_type(f"cameras[{number}]", camera, Camera, "a Camera")
    steps = whole(steps, "steps", "1 step or more", 1, 1_000_000)
    drop = real(drop, "drop", "a share of 0 to 0.5", 0, 0.5)
    seed = whole(seed, "seed", "0 to 2^58 - 1", 0, (1 << 58) - 1)
    chosen_device = _device.resolve(device)
    if bundle.num_levels < 2 or bundle.clusters.offset[bundle.level_range(0).stop] == 0:
        return bundle
    if drop > 0:
        bundle = without_unseen(bundle, cameras, drop, seed, chosen_device, progress)
    cuts = Cuts(bundle, cameras, seed, chosen_device, progress)
    refined = cuts.refined(steps, default_steps(chosen_device))
    record: dict[str, int | float] = {"steps": steps, "drop": drop, "seed": seed}
    if cameras:
        record["cameras"] = len(cameras)
    config = {**bundle.config, "refined": record}
    return Bundle(bundle.clusters.around(refined), bundle.groups, refined, config, bundle.codec)


def without_unseen(
    bundle: Bundle,
    cameras: Sequence[Camera],
    drop: float,
    seed: int,
    device: Device,
    progress: Progress,
) -> Bundle:
    """Drop from each level but the first what pictures of cuts show least of, up to
    this share of what they show of the level."""
    cuts = Cuts(bundle, cameras, seed, device, progress)
    weights, looks = cuts.weights(_NUM_WEIGHING_PICTURES)
    return _without_least(bundle, np.where(looks < _LEAST_LOOKS, np.nan, weights), drop)


@dataclass(frozen=True)
class RefineSteps:
    """How a refinement compares cuts with the asset, and how it moves gaussians.

    Attributes:
        windows: Windows of pictures, 1 to 32, whose gradients make one step.
        cuts_per_view: Cuts that are compared with each picture of the asset, 1 to 128.
        rate: Step sizes, as parts of those of a fit.
        power: The loss of a value is this power of its difference, more than 0 and at
            most 1.
        is_blurred: Whether differences are blurred by a pixel first.
    """

    windows: int
    cuts_per_view: int = 8
    rate: float = _RATE
    power: float = 1.0
    is_blurred: bool = False


def default_steps(device: Device) -> RefineSteps:
    """The steps for a kind of device: a GPU is busy only with several windows at once,
    a CPU with one."""
    windows = 8 if device.is_cuda else 1
    return RefineSteps(windows=windows, rate=_RATE * windows**0.5)


class _CutOperation(Protocol[_T]):
    """An operation of the core on pictures of cuts."""

    def __call__(
        self,
        *,
        gaussians: _core.Rows,
        pictures: _core.CutPictures,
        progress: _core.FitProgress,
    ) -> _T: ...


class Cuts:
    """Pictures of a bundle's cuts, and copies of its gaussians on a device, which they
    move."""

    def __init__(
        self,
        bundle: Bundle,
        cameras: Sequence[Camera],
        seed: int,
        device: Device,
        progress: Progress,
    ) -> None:
        self._bundle = bundle
        self._seed = seed
        self._device = device
        self._progress = progress
        everything = bundle.gaussians
        self._leaves = slice(0, int(bundle.clusters.offset[bundle.level_range(0).stop]))
        self._gaussians = _device.place(everything.subset(np.arange(len(everything))), device)
        self._pictures = _core.CutPictures(
            table=residency.table(bundle),
            asset=everything.subset(self._leaves).rows,
            cameras=[camera.core for camera in cameras],
            seed=seed,
        )

    def refined(self, num_pictures: int, settings: RefineSteps) -> Gaussians:
        """Move the gaussians by this number of pictures, rounded up to whole steps."""
        clusters = self._bundle.clusters
        ball = self._bundle.groups.ball
        radius = np.where(clusters.own_group < 0, np.float32(1), ball[clusters.own_group, 3])
        radius = np.repeat(radius, np.diff(clusters.offset))
        leaves = self._gaussians.subset(self._leaves).rows
        target = _core.FitTarget(leaves, filter_px2=0.0, antialiased=False)
        comparison = _core.CutComparison(
            windows_per_step=settings.windows,
            cuts_per_view=settings.cuts_per_view,
            power=settings.power,
            is_blurred=settings.is_blurred,
        )
        num_steps = -(-num_pictures // settings.windows)
        move = partial(
            _core.refine_cuts,
            config=self._config(num_steps, settings.rate),
            comparison=comparison,
            target=target,
            radius=radius,
        )
        self._run("refine", num_steps * settings.windows, move)
        return self._gaussians.numpy()

    def weights(self, num_pictures: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
        """What pictures show of each gaussian, and how many of their cuts have it."""
        weigh = partial(_core.weigh_cuts, config=self._config(num_pictures, _RATE))
        return self._run("weigh", num_pictures, weigh)

    def _config(self, num_steps: int, rate: float) -> _core.FitConfig:
        filter_px2 = float(self._bundle.clusters.filter_px2[self._bundle.level_range(1).start])
        config = BuildConfig(steps=num_steps, first_steps=num_steps, filter_px2=filter_px2)
        config = replace(
            config,
            step_position=rate * config.step_position,
            step_log_scale=rate * config.step_log_scale,
            step_quat=rate * config.step_quat,
            step_logit=rate * config.step_logit,
            step_sh0=rate * config.step_sh0,
            step_sh_rest=rate * config.step_sh_rest,
        )
        return fit_config(config, self._seed, 1)

    def _run(self, name: str, num_pictures: int, operation: _CutOperation[_T]) -> _T:
        work = partial(operation, gaussians=self._gaussians.rows, pictures=self._pictures)
        with Bar(num_pictures, name, self._progress) as bar:

            def show(state: _core.FitProgress) -> None:
                bar.update(state.groups_done - bar.num_done)

            return run_fit(lambda state: work(progress=state), self._device, show)


def _without_least(bundle: Bundle, weight: npt.NDArray[np.float64], share: float) -> Bundle:
    """Drop from each level but the first its gaussians of least weight, up to a share
    of the level's weight.

    Gaussians whose weight is not a number stay, and count for nothing in the sum.
    """
    offset = bundle.clusters.offset
    is_kept = np.ones(bundle.num_gaussians, bool)
    for level in range(1, bundle.num_levels):
        clusters_of_level = bundle.level_range(level)
        rows = slice(offset[clusters_of_level.start], offset[clusters_of_level.stop])
        order = np.argsort(weight[rows], kind="stable")
        cumulated = np.cumsum(weight[rows][order])
        is_kept[rows][order[cumulated < share * np.nansum(weight[rows])]] = False
    kept_rows = np.flatnonzero(is_kept)
    clusters = replace(bundle.clusters, offset=np.searchsorted(kept_rows, offset))
    gaussians = bundle.gaussians.subset(kept_rows)
    return Bundle(clusters, bundle.groups, gaussians, bundle.config, bundle.codec)
