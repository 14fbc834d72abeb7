"""Levels of a bundle made better together: as cuts show them, next to what hides parts of them."""

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check_type, real, whole
from v3dg._progress import Bar, Progress
from v3dg.build.config import BuildConfig
from v3dg.build.fit import fit_config, run_fit
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.opening import File
from v3dg.residency import residency

_T = TypeVar("_T")
_RATE = 0.2  # of the step sizes of a fit, from whose result this starts
# Pictures that tell how much is seen of each gaussian, and how many of them must have it in their cuts: of a
# very large asset windows show parts, and what none of them looks at is not known.
_WEIGHED, _LEAST_LOOKS = 2_000, 8


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
    """Make the levels of a bundle look more like its asset, in small pictures and large ones; a copy.

    A build fits every group alone, seen from all sides, at the size at which it is selected. Pictures of cuts
    show gaussians next to each other, where they hide each other. By these, this drops the least seen
    gaussians of all levels but the first, and moves the others until such pictures are those of the asset.
    Cuts have 0.7 of the asset's gaussians down to those of the last level, and pictures 0.18 to 9.7 times the
    size at which they are at home, 2 px² a gaussian. docs/levels.md has what is gained.

    The same bundle, cameras, steps, share and seed give the same bits on the same kind of device.

    Args:
        bundle: What `build_bundle` made, or its file. About six times what that takes is in memory meanwhile.
        cameras: Where the asset is seen from, also by name: for a room those of its photographs. What is
            seen from elsewhere may get worse. Without any, pictures are taken from all around.
        steps: Pictures that cuts are compared with, one after another.
        drop: The least seen gaussians of a level are dropped, up to this share of what is seen of it: 0,
            which keeps all, to 0.5. A bundle that was refined before loses gaussians again.
        seed: Of the pictures.
        device: Where to compute.
        progress: As for `build_bundle`.

    Raises:
        TypeError: The bundle or a camera is none.
        ValueError: There are no steps, or the share or the seed is out of range.
        RuntimeError: The device is "cuda", and something is missing for it.
        KeyboardInterrupt: Ctrl-C; threads have stopped.
    """
    bundle = Bundle.open(bundle) if isinstance(bundle, str | os.PathLike) else bundle
    check_type("bundle", bundle, Bundle, "a Bundle")
    cameras = list(cameras.values() if isinstance(cameras, Mapping) else cameras)
    for number, camera in enumerate(cameras):
        check_type(f"cameras[{number}]", camera, Camera, "a Camera")
    steps = whole(steps, "steps", "1 step or more", 1, 1_000_000)
    drop = real(drop, "drop", "a share of 0 to 0.5", 0, 0.5)
    seed, where = whole(seed, "seed", "0 to 2^58 - 1", 0, (1 << 58) - 1), _device.resolve(device)
    if bundle.num_levels < 2 or bundle.clusters.offset[bundle.level_range(0).stop] == 0:
        return bundle
    if drop > 0:
        seen, looks = _Cuts(bundle, cameras, seed, where, progress).run("weigh", _WEIGHED, _core.weigh_cuts)
        bundle = _without_least(bundle, np.where(looks < _LEAST_LOOKS, np.nan, seen), drop)
    refined = _Cuts(bundle, cameras, seed, where, progress).refined(steps)
    about = {"steps": steps, "drop": drop, "seed": seed} | ({"cameras": len(cameras)} if cameras else {})
    made: dict[str, Any] = {**bundle.config, "refined": about}
    return Bundle(bundle.clusters.around(refined), bundle.groups, refined, made, bundle.codec)


class _Cuts:
    """Pictures of a bundle's cuts, and copies of its gaussians on a device, which are moved by them."""

    def __init__(
        self, bundle: Bundle, cameras: Sequence[Camera], seed: int, where: Device, progress: Progress
    ) -> None:
        self._bundle, self._seed, self._where, self._progress = bundle, seed, where, progress
        everything = bundle.gaussians
        self._leaves = slice(0, int(bundle.clusters.offset[bundle.level_range(0).stop]))
        self._gaussians = _device.place(everything.subset(np.arange(len(everything))), where)
        self._pictures = _core.CutPictures(
            table=residency.table(bundle),
            asset=everything.subset(self._leaves).rows,
            cameras=[camera.core for camera in cameras],
            seed=seed,
        )

    def refined(self, steps: int) -> Gaussians:
        groups, of_cluster = self._bundle.groups, self._bundle.clusters.own_group
        radius = np.where(of_cluster < 0, np.float32(1), groups.ball[of_cluster, 3])
        radius = np.repeat(radius, np.diff(self._bundle.clusters.offset))
        target = _core.FitTarget(self._gaussians.subset(self._leaves).rows, 0.0, False)
        self.run("refine", steps, partial(_core.refine_cuts, target=target, radius=radius))
        return self._gaussians.numpy()

    def run(self, name: str, steps: int, operation: Callable[..., _T]) -> _T:
        """Do something by so many pictures; what it returns."""
        sizes: Any = {k: _RATE * v for k, v in vars(BuildConfig()).items() if k.startswith("step_")}
        filter_px2 = float(self._bundle.clusters.filter_px2[self._bundle.level_range(1).start])
        config = BuildConfig(steps=steps, first_steps=steps, filter_px2=filter_px2, **sizes)
        given = {"gaussians": self._gaussians.rows, "pictures": self._pictures}
        work = partial(operation, config=fit_config(config, self._seed, 1), **given)
        with Bar(steps, name, self._progress) as bar:

            def show(state: _core.FitProgress) -> None:
                bar.update(state.groups_done - bar.done)

            return run_fit(lambda state: work(progress=state), self._where, show)


def _without_least(bundle: Bundle, weight: npt.NDArray[np.float64], share: float) -> Bundle:
    """Drop, of each level but the first, those of least weight that have this share of it together.

    What has no number stays, and has none of it.
    """
    offset, is_kept = bundle.clusters.offset, np.ones(bundle.num_gaussians, bool)
    for level in range(1, bundle.num_levels):
        here = bundle.level_range(level)
        rows = slice(offset[here.start], offset[here.stop])
        order = np.argsort(weight[rows], kind="stable")
        below = np.cumsum(weight[rows][order])
        is_kept[rows][order[below < share * np.nansum(weight[rows])]] = False
    kept = np.flatnonzero(is_kept)
    clusters = replace(bundle.clusters, offset=np.searchsorted(kept, offset))
    return Bundle(clusters, bundle.groups, bundle.gaussians.subset(kept), bundle.config, bundle.codec)
