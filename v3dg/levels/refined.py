"""Refines the levels of a bundle together, by comparing pictures of cuts with pictures
of the asset. In a cut, gaussians of different groups hide each other, which fits of
single groups cannot show."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._json import JsonObject
from v3dg._progress import Bar, Progress
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.levels.config import BuildConfig
from v3dg.levels.fit import fit_config, run_fit
from v3dg.levels.rows import in_runs
from v3dg.levels.smooth import is_faint
from v3dg.levels.viewpoints import SeenFrom
from v3dg.residency import residency

_T = TypeVar("_T", covariant=True)
# Step sizes of a refinement, as a fraction of those of a fit. The fraction is small,
# because a refinement starts from fitted levels.
_RATE = 0.2
# Default fraction of a level's visibility that may be lost by dropping its least
# visible gaussians.
DROP = 0.02
# Number of pictures for measuring how visible each gaussian is.
_NUM_WEIGHING_PICTURES = 2_000
# The visibility of a gaussian counts as known if it is in the cuts of at least this
# many pictures. Pictures of a very large asset show only a part of it, so some
# gaussians are in fewer cuts.
_LEAST_LOOKS = 8


@dataclass(frozen=True)
class RefineRequest:
    """The settings of a refinement; `v3dg.refine_bundle` explains them.

    Attributes:
        steps: Number of pictures that are compared. If the bundle is refined in several
            units, this is the number for each.
    """

    steps: int
    drop: float
    seed: int
    seen_from: SeenFrom = "auto"
    cameras: tuple[Camera, ...] = ()

    def num_pictures(self, device: Device) -> tuple[int, int]:
        """Return the number of pictures for weighing gaussians, and the number of
        pictures for moving them."""
        num_weighing = 0
        if self.drop > 0:
            num_weighing = _NUM_WEIGHING_PICTURES
        windows = default_steps(device).windows
        return num_weighing, -(-self.steps // windows) * windows

    def record(self) -> JsonObject:
        """Return the entries for this request in the config of a refined bundle."""
        record: JsonObject = {"steps": self.steps, "drop": self.drop, "seed": self.seed}
        if self.seen_from != "auto":
            record["seen_from"] = self.seen_from
        if self.cameras:
            record["cameras"] = len(self.cameras)
        return record


def with_refined_levels(
    bundle: Bundle,
    request: RefineRequest,
    cameras: Sequence[Camera],
    device: Device,
    progress: Progress,
    *,
    text: str = "",
    first_level: int = 1,
    target_px2: float = 0.0,
) -> Bundle:
    """Return the bundle with refined levels. Levels below `first_level` stay as they
    are.

    Args:
        text: The text in the progress bar.
        target_px2: The filter of level 0, which is the target. It is 0 for an asset.
    """
    if request.drop > 0:
        bundle = without_unseen(
            bundle, cameras, request.drop, request.seed, device, progress, first_level=first_level
        )
    cuts = Cuts(bundle, cameras, request.seed, device, progress)
    moved = cuts.refined(
        request.steps,
        default_steps(device),
        text,
        first_level=first_level,
        target_px2=target_px2,
    )
    refined = in_runs(moved, bundle.clusters.offset)
    clusters = bundle.clusters.around(refined)
    return Bundle(clusters, bundle.groups, refined, bundle.config, bundle.codec)


def without_unseen(
    bundle: Bundle,
    cameras: Sequence[Camera],
    drop: float,
    seed: int,
    device: Device,
    progress: Progress,
    *,
    first_level: int = 1,
) -> Bundle:
    """Return the bundle without the least visible gaussians of each level, beginning
    with level `first_level`. A faint asset keeps all: none of its gaussians is hidden.

    `drop` is the fraction of a level's visibility that may be lost. Visibility is
    measured in pictures of cuts.
    """
    if is_faint(bundle.level_gaussians(0)):
        return bundle
    cuts = Cuts(bundle, cameras, seed, device, progress)
    weights, looks = cuts.weights(_NUM_WEIGHING_PICTURES)
    known_weights = np.where(looks < _LEAST_LOOKS, np.nan, weights)
    return _without_least(bundle, known_weights, drop, first_level)


@dataclass(frozen=True)
class RefineSteps:
    """How cuts are compared with the asset, and how gaussians are moved.

    Attributes:
        windows: Number of windows (rectangular parts of pictures) whose gradients are
            used in one step, 1 to 32.
        cuts_per_view: Number of cuts that are compared with each picture of the asset,
            1 to 128.
        rate: Step sizes as a fraction of those of a fit, for a gaussian that appears in
            one window. Step sizes grow with the square root of the number of windows
            that show the gaussian.
        window_means: Weight of the difference between the mean of a window and the mean
            of the asset in it, relative to the differences of pixels.
    """

    windows: int
    cuts_per_view: int = 8
    rate: float = _RATE
    window_means: float = 1.0


def default_steps(device: Device) -> RefineSteps:
    """Return the default steps for a kind of device. A single window keeps a CPU busy,
    but not a GPU."""
    if device.is_cuda:
        return RefineSteps(windows=16, cuts_per_view=4)
    return RefineSteps(windows=1)


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
    """Draws pictures of a bundle's cuts, and refines copies of its gaussians on a
    device."""

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
        self._leaves = bundle.level_rows(0)
        self._gaussians = _device.place(everything.subset(np.arange(len(everything))), device)
        self._pictures = _core.CutPictures(
            table=residency.table(bundle),
            asset=everything.subset(self._leaves).rows,
            cameras=[camera.core for camera in cameras],
            seed=seed,
        )

    def refined(
        self,
        num_pictures: int,
        settings: RefineSteps,
        text: str = "",
        *,
        first_level: int = 1,
        target_px2: float = 0.0,
    ) -> Gaussians:
        """Refine the gaussians of all levels from `first_level` on, and return the
        gaussians of all levels. The number of pictures is rounded up to whole steps.
        `text` is shown in the progress bar. Level 0 is the target, drawn with the
        filter `target_px2`."""
        clusters = self._bundle.clusters
        radius = np.append(self._bundle.groups.ball[:, 3], np.float32(0))[clusters.own_group]
        radius[clusters.level < first_level] = 0  # these gaussians do not move
        radius = np.repeat(radius, np.diff(clusters.offset))
        leaves = self._gaussians.subset(self._leaves).rows
        target = _core.FitTarget(leaves, filter_px2=target_px2, antialiased=target_px2 > 0)
        comparison = _core.CutComparison(
            windows_per_step=settings.windows,
            cuts_per_view=settings.cuts_per_view,
            window_means=settings.window_means,
        )
        num_steps = -(-num_pictures // settings.windows)
        move = partial(
            _core.refine_cuts,
            config=self._config(num_steps, settings.rate),
            comparison=comparison,
            target=target,
            radius=radius,
        )
        self._run("refine", num_steps * settings.windows, move, text)
        return self._gaussians.numpy()

    def weights(self, num_pictures: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.int32]]:
        """Return how visible each gaussian is in some pictures, and how many of their
        cuts contain it."""
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

    def _run(
        self, name: str, num_pictures: int, operation: _CutOperation[_T], text: str = ""
    ) -> _T:
        work = partial(operation, gaussians=self._gaussians.rows, pictures=self._pictures)
        with Bar(num_pictures, name, self._progress) as bar:

            def show(state: _core.FitProgress) -> None:
                bar.update(state.groups_done - bar.num_done, text)

            return run_fit(lambda state: work(progress=state), self._device, show)


def _without_least(
    bundle: Bundle, weight: npt.NDArray[np.float64], share: float, first_level: int = 1
) -> Bundle:
    """Drop the gaussians with the smallest weights from each level, beginning with
    level `first_level`. The dropped weights add up to at most this fraction of the
    level's total weight.

    Gaussians whose weight is NaN are kept, and do not count in the total.
    """
    offset = bundle.clusters.offset
    is_kept = np.ones(bundle.num_gaussians, bool)
    for level in range(first_level, bundle.num_levels):
        rows = bundle.level_rows(level)
        order = np.argsort(weight[rows], kind="stable")
        cumulated = np.cumsum(weight[rows][order])
        is_kept[rows][order[cumulated < share * np.nansum(weight[rows])]] = False
    kept_rows = np.flatnonzero(is_kept)
    clusters = replace(bundle.clusters, offset=np.searchsorted(kept_rows, offset))
    gaussians = bundle.gaussians.subset(kept_rows)
    return Bundle(clusters, bundle.groups, gaussians, bundle.config, bundle.codec)
