"""Levels of a bundle made better together: as cuts show them, next to what hides parts of them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check_type, whole
from v3dg._progress import Bar, Progress
from v3dg.build.config import BuildConfig
from v3dg.build.fit import fit_config, run_fit
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.residency import residency

_RATE = 0.2  # of the step sizes of a fit, from whose result this starts
_MOST = 0.7  # of the asset's gaussians, in a cut
_SHARE = 0.99  # of the gaussians that an asset's radius holds; the rest may float far away


def refine_bundle(
    bundle: Bundle,
    *,
    cameras: Iterable[Camera] | Mapping[str, Camera] = (),
    steps: int = 30_000,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
) -> Bundle:
    """Make the levels of a bundle look more like its asset, in small pictures and large ones; a copy.

    A build fits every group alone, seen from all sides, at the size at which it is selected. This moves the
    gaussians of all levels but the first, as many as there were, until pictures of cuts, in which they stand
    next to each other and hide each other, are those of the asset. Cuts have 0.7 of the asset's gaussians
    down to those of the last level, and pictures 0.18 to 9.7 times the size at which they are at home, 2 px²
    a gaussian. docs/levels.md has what is gained.

    The same bundle, cameras, steps and seed give the same bits on the same kind of device.

    Args:
        bundle: What `build_bundle` made. About six times what its gaussians take is in memory meanwhile.
        cameras: Where the asset is seen from, also by name: for a room those of its photographs. What is
            seen from elsewhere may get worse. Without any, pictures are taken from all around.
        steps: Pictures that cuts are compared with, one after another.
        seed: Of the pictures.
        device: Where to compute.
        progress: As for `build_bundle`.

    Raises:
        TypeError: The bundle or a camera is none.
        ValueError: There are no steps, or the seed is out of range.
        RuntimeError: The device is "cuda", and something is missing for it.
        KeyboardInterrupt: Ctrl-C; threads have stopped.
    """
    check_type("bundle", bundle, Bundle, "a Bundle")
    cameras = list(cameras.values() if isinstance(cameras, Mapping) else cameras)
    for number, camera in enumerate(cameras):
        check_type(f"cameras[{number}]", camera, Camera, "a Camera")
    steps = whole(steps, "steps", "1 step or more", 1, 1_000_000)
    seed = whole(seed, "seed", "0 to 2^58 - 1", 0, (1 << 58) - 1)
    where = _device.resolve(device)
    num_leaves = int(bundle.clusters.offset[bundle.level_range(0).stop]) if bundle.num_levels > 1 else 0
    if num_leaves == 0:
        return bundle
    everything, clusters = bundle.gaussians, bundle.clusters
    gaussians = _device.place(everything.subset(np.arange(len(everything))), where)
    target = _core.FitTarget(gaussians.subset(slice(0, num_leaves)).rows, 0.0, False)
    radius = np.where(clusters.own_group < 0, np.float32(1), bundle.groups.ball[clusters.own_group, 3])
    radius = np.repeat(radius, np.diff(clusters.offset))
    sizes: Any = {k: _RATE * v for k, v in vars(BuildConfig()).items() if k.startswith("step_")}
    filter_px2 = float(clusters.filter_px2[-1])
    config = BuildConfig(steps=steps, first_steps=steps, filter_px2=filter_px2, **sizes)
    pictures = _pictures(bundle, everything.subset(slice(0, num_leaves)), cameras, seed)
    refine = partial(_core.refine_cuts, fit_config(config, seed, 1), target, gaussians.rows, radius, pictures)
    with Bar(steps, "refine", progress) as bar:
        run_fit(refine, where, lambda state: bar.update(state.groups_done - bar.done))
    refined = gaussians.numpy()
    about = {"steps": steps, "seed": seed} | ({"cameras": len(cameras)} if cameras else {})
    made: dict[str, Any] = {**bundle.config, "refined": about}
    return Bundle(clusters.around(refined), bundle.groups, refined, made, bundle.codec)


def _pictures(bundle: Bundle, asset: Gaussians, cameras: Sequence[Camera], seed: int) -> _core.CutPictures:
    """Pictures of the bundle's cuts. What is twice as large in the asset is looked at twice as often."""
    means = asset.means.astype(np.float64)
    center = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - center, axis=1), _SHARE)) or 1.0
    area = np.sort(asset.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1)
    least = float(len(bundle.level_gaussians(bundle.num_levels - 1)))
    return _core.CutPictures(
        table=residency.table(bundle),
        counts=(max(_MOST * len(asset), least), least),
        means=asset.means,
        weight=np.cumsum(asset.opacities * np.sqrt(area)),
        ball=(*center.tolist(), radius),
        cameras=[camera.core for camera in cameras],
        seed=seed,
    )
