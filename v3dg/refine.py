"""Levels of a bundle made better together: as cuts show them, next to what hides parts of them."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt

from v3dg import _core, _device
from v3dg._device import Device
from v3dg._numbers import check_type, whole
from v3dg._progress import Bar, Progress
from v3dg.build.config import BuildConfig
from v3dg.build.fit import fit_config, run_fit
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.scene import Scene
from v3dg.select import select

_RATE = 0.2  # of the step sizes of a fit, from whose result this starts
_SAMPLES = 4  # of a side of a pixel of the pictures that cuts are to look like
_WIDEST_PX, _NARROWEST_PX = 256, 8  # of a side of a picture; of wider ones windows are compared
_MOST_PX = 1 << 15  # of a side of such a wider one
# Of pictures, a side, in the size at which so many gaussians are at home. Cuts of the default tolerance are
# seen at a quarter to half of that.
_LEAST_SIZE, _OCTAVES = 0.18, 5.5
_MOST = 0.7  # of the asset's gaussians, in a cut
_HOME_PX2 = BuildConfig().px2_per_gaussian
_DISTANCE = 2.5  # of the cameras around an asset, in its radii
_SHARE = 0.99  # of the gaussians that an asset's radius holds; the rest may float far away


def refine_bundle(
    bundle: Bundle,
    *,
    steps: int = 10_000,
    seed: int = 0,
    device: str | Device = "auto",
    progress: Progress = True,
) -> Bundle:
    """Make the levels of a bundle look more like its asset, in small pictures and large ones; a copy.

    A build fits every group alone, seen from all sides, at the size at which it is selected. This moves the
    gaussians of all levels but the first, as many as there were, until pictures of cuts, in which they stand
    next to each other and hide each other, are those of the asset. Cuts have 0.7 of the asset's gaussians
    down to those of the last level, and pictures 0.18 to 8 times the size at which they are at home, 2 px² a
    gaussian. docs/levels.md has what is gained. Pictures are taken all around the asset: what is seen from
    inside, as a room is, gets worse.

    The same bundle, steps and seed give the same bits on the same kind of device.

    Args:
        bundle: What `build_bundle` made. About six times what its gaussians take is in memory meanwhile.
        steps: Pictures that cuts are compared with, one after another.
        seed: Of the pictures.
        device: Where to compute.
        progress: As for `build_bundle`.

    Raises:
        TypeError: The bundle is none.
        ValueError: There are no steps, or the seed is out of range.
        RuntimeError: The device is "cuda", and something is missing for it.
        KeyboardInterrupt: Ctrl-C; threads have stopped.
    """
    check_type("bundle", bundle, Bundle, "a Bundle")
    steps = whole(steps, "steps", "1 step or more", 1, 1_000_000)
    seed = whole(seed, "seed", "0 to 2^58 - 1", 0, (1 << 58) - 1)
    where = _device.resolve(device)
    num_leaves = len(bundle.level_gaussians(0)) if bundle.num_levels > 1 else 0
    if num_leaves == 0:
        return bundle
    everything = bundle.gaussians
    gaussians = _device.place(everything.subset(np.arange(len(everything))), where)
    clusters, balls = bundle.clusters, bundle.groups.ball
    target = _core.FitTarget(gaussians.subset(slice(0, num_leaves)).rows, 0.0, False)
    radius = np.where(clusters.own_group < 0, np.float32(1), balls[clusters.own_group, 3])
    radius = np.repeat(radius, np.diff(clusters.offset))
    config = _config(float(clusters.filter_px2[-1]), steps, seed)
    with Bar(steps, "refine", progress) as bar:
        views = _Views(bundle, np.random.default_rng(seed))
        chosen = [views.random() for _ in range(steps)]
        given = (config, target, gaussians.rows, clusters.offset, radius, chosen)
        refine = partial(_core.refine_cuts, *given)
        run_fit(refine, where, lambda state: bar.update(state.groups_done - bar.done))
    refined = gaussians.numpy()
    made = {**bundle.config, "refined": {"steps": steps, "seed": seed}}
    return Bundle(clusters.around(refined), bundle.groups, refined, made, bundle.codec)


def _config(filter_px2: float, steps: int, seed: int) -> _core.FitConfig:
    sizes: Any = {k: _RATE * v for k, v in vars(BuildConfig()).items() if k.startswith("step_")}
    config = BuildConfig(steps=steps, first_steps=steps, supersample=_SAMPLES, filter_px2=filter_px2)
    return fit_config(replace(config, **sizes), seed, 1)


class _Views:
    """Pictures of a bundle's cuts, as they are before anything moves."""

    def __init__(self, bundle: Bundle, rng: np.random.Generator) -> None:
        asset = bundle.level_gaussians(0)
        self._scene, self._rng = Scene.of(bundle), rng
        offset = bundle.clusters.offset
        self._most = _MOST * len(asset)
        self._least = float(offset[-1] - offset[bundle.level_range(bundle.num_levels - 1).start])
        self._means = asset.means.astype(np.float64)
        self._center = np.median(self._means, axis=0)
        distance = np.linalg.norm(self._means - self._center, axis=1)
        self._radius = float(np.quantile(distance, _SHARE)) or 1.0
        area = np.sort(asset.scales.astype(np.float64), axis=1)[:, 1:].prod(axis=1)
        self._weight = np.cumsum(asset.opacities * np.sqrt(area))

    def random(self) -> tuple[_core.Camera, npt.NDArray[np.int32]]:
        """A window of a picture, and the clusters of a cut that it shows."""
        count = self._most * (self._least / self._most) ** self._rng.uniform() ** 2
        size = _LEAST_SIZE * 2 ** (_OCTAVES * self._rng.uniform())
        camera, window = self._pictures(size * size * count)
        budget = math.ceil(count)
        tolerance = select(self._scene, camera, budget=budget, cull=False, device="cpu").tolerance
        return window.core, select(self._scene, window, tolerance=tolerance, device="cpu").cluster_ids

    def _pictures(self, count: float) -> tuple[Camera, Camera]:
        """A picture in which so many gaussians are at home, and a window of it."""
        rng = self._rng
        outwards, up = rng.normal(size=(2, 3))
        eye = self._center + _DISTANCE * self._radius * outwards / np.linalg.norm(outwards)
        side = math.ceil(min(max(math.sqrt(_HOME_PX2 * count), _NARROWEST_PX), _MOST_PX))
        near, fov = 0.01 * self._radius, 2 * math.asin(1 / _DISTANCE)
        camera = Camera.look_at(eye, self._center, up, fov, width=side, height=side, near=near)
        size = min(side, _WIDEST_PX)
        # What is twice as large in the asset is seen twice as often.
        shown = self._means[np.searchsorted(self._weight, rng.uniform(high=self._weight[-1]))]
        seen = camera.K @ (camera.viewmat[:3, :3] @ shown + camera.viewmat[:3, 3])
        K = camera.K.copy()
        K[:2, 2] -= np.clip(np.round(seen[:2] / max(seen[2], near) - size / 2), 0, side - size)
        return camera, replace(camera, K=K, width=size, height=size)
