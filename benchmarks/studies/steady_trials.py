"""Measures what makes motion steadier besides a fade: a budget whose tolerance changes
in steps, hysteresis, pages that fade in, and other ramps of the fade.

A budget in steps is compared with the tolerance that each view needs by itself. The
comparison includes frames after the camera has stopped where the steps are farthest
behind. The other trials are experiments. Hysteresis uses cuts with a state, which are
computed from the metrics of the selection. Pages that fade in are simulated in addition
to those of a pool. Ramps have no state. docs/notes/experiments/index.md lists the
results.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.record import write
from benchmarks.evaluation.steadiness import Cut, Options, compare, paths_from
from benchmarks.evaluation.steadiness import Path as CameraPath
from benchmarks.studies.fades.measure import Stays, field_of, first_camera
from v3dg import (
    DEFAULT_FADE,
    DEFAULT_TOLERANCE,
    Bundle,
    Camera,
    Renderer,
    Scene,
    Selection,
    _core,
    select,
)
from v3dg.residency import residency
from v3dg.select import rule_of

# Hysteresis starts at this multiple of the distance, so that its state has settled at
# the first frame of the path.
_FAR = 1.15
_FAR_FRAMES = 30
_SWAY = 12  # number of frames in one direction
_ARRIVAL_FRAMES = 8  # the constant in csrc/residency/page_table.h
_HEADROOM_PARTS = 32  # the constant in csrc/select/budget_math.h


@dataclass
class Config:
    bundles: tuple[str, ...]
    """.v3dg files, each as PATH or PATH:UP, where UP is an axis such as -y or z."""
    frames: int = 48
    size: int = 160
    side: int = 1
    """Number of copies per side of a square field; 1 for a single copy."""
    distances: tuple[float, ...] = (3.0,)
    tolerance: float = DEFAULT_TOLERANCE
    """Tolerance of the cuts. The budget is the number of gaussians at this tolerance in
    the middle of the path."""
    fade: float = DEFAULT_FADE
    hysteresis: tuple[float, ...] = (1.05, 1.1)
    arrivals: tuple[int, ...] = (1, 4, 8)
    """Numbers of frames in which a page fades in."""
    rests: tuple[int, ...] = (1, 4, 16, 64)
    """Numbers of frames in which the tolerance of a budget reaches its final value
    after the camera stops."""
    bands: tuple[float, ...] = (1.005, 1.01, 1.03, 1.05)
    """More fades with linear ramps. Smooth ramps are drawn with these widths and with
    widths larger by half."""
    trials: tuple[str, ...] = ("budget", "rest", "hysteresis", "pages", "ramps")
    paths: tuple[str, ...] = ()
    """Names of the paths to measure; by default all."""
    device: str = "cpu"
    json: Path | None = None


class AtOnce:
    """The smallest tolerance for a budget, regardless of previous frames."""

    def __init__(self, budget: int, fade: float) -> None:
        self.budget, self.fade = budget, fade

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        cut = select(scene, camera, budget=self.budget, fade=self.fade, device="cpu")
        return {"tolerance": cut.tolerance, "fade": self.fade}


class Rests:
    """A budget in steps along a path. After the path's end, the tolerance moves to its
    final value over some frames.

    If `frames` is None, the tolerance moves as in a `Renderer`.
    """

    def __init__(
        self, scene: Scene, path: CameraPath, budget: int, config: Config, frames: int | None
    ) -> None:
        self.budget, self.fade, self.frames = budget, config.fade, frames
        self.goal = _goal(scene, path.cameras[-1], budget, config.fade)
        self.renderer, self.frame = Renderer(scene, device="cpu"), 0
        for camera in path.cameras[:-1]:
            self._draw(camera)

    def _draw(self, camera: Camera) -> float:
        return self.renderer.render(camera, budget=self.budget, fade=self.fade).stats.tolerance

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        if self.frame == 0 or self.frames is None:
            self.tolerance = self._draw(camera)
        else:
            left = max(self.frames - self.frame + 1, 1)
            self.tolerance *= (self.goal / self.tolerance) ** (1 / left)
        self.frame += 1
        return {"tolerance": self.tolerance, "fade": self.fade}


def _goal(scene: Scene, camera: Camera, budget: int, fade: float) -> float:
    """Return the tolerance towards which the steps move."""
    roomy = budget - budget // _HEADROOM_PARTS
    return select(scene, camera, budget=roomy, fade=fade, device="cpu").tolerance


def metrics_of(scene: Scene, camera: Camera) -> tuple[Any, Any]:
    """Return the metrics in px² of the groups of all instances, and the index of each
    instance's first group."""
    instances = _core.Instances(
        bundle=scene.instance_bundle,
        positions=scene.positions,
        quaternions=scene.quaternions,
        scales=scene.scales,
        importance=scene.importance,
    )
    tables = [residency.table(bundle) for bundle in scene.bundles]
    rule = rule_of(0.0, None, 0)
    return _core.group_metrics(tables=tables, instances=instances, camera=camera.core, rule=rule)


def cut_of(scene: Scene, refinement: Any, offset: Any) -> Selection:
    """Return the cut for refinements of the groups between 0 and 1. No group may be
    refined more than the group above it."""
    instance_ids, cluster_ids, weights, count = [], [], [], 0
    for i, b in enumerate(scene.instance_bundle):
        clusters = scene.bundles[b].clusters
        mine = refinement[offset[i] : offset[i + 1]]
        # Index -1 stands for no group; it refers to the last element, which is
        # appended.
        weight = (
            np.append(mine, 1.0)[clusters.parent_group] - np.append(mine, 0.0)[clusters.own_group]
        )
        assert weight.min() >= 0, "a path would have no cluster, or two"
        chosen = np.flatnonzero(weight > 0).astype(np.int32)
        instance_ids.append(np.full(len(chosen), i, np.int32))
        cluster_ids.append(chosen)
        weights.append(weight[chosen].astype(np.float32))
        count += int(np.diff(clusters.offset)[chosen].sum())
    ids = np.concatenate(instance_ids), np.concatenate(cluster_ids)
    return Selection(scene, *ids, count, 0.0, 0.0, given_weights=np.concatenate(weights))


class Sticks:
    """A cut with hysteresis: it refines a group whose metric is above the tolerance
    times a factor, and coarsens it below the tolerance divided by the factor."""

    def __init__(self, tolerance: float, factor: float) -> None:
        self.tolerance, self.factor = tolerance, factor
        self.refined: Any = None

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        metric, offset = metrics_of(scene, camera)
        at = 1.0 if self.refined is None else np.where(self.refined, 1 / self.factor, self.factor)
        self.refined = metric > at * self.tolerance
        return {"cut": cut_of(scene, self.refined.astype(float), offset)}


def between(metric: Any, tolerance: float, fade: float) -> Any:
    """Return the positions of metrics within the range of a fade: 0 below it, 1 above
    it."""
    low, high = tolerance / fade, tolerance * fade
    return np.clip((np.minimum(metric, 2 * high) - low) / (high - low), 0, 1)


class Smooth:
    """A fade whose ramp has a continuous derivative."""

    def __init__(self, tolerance: float, fade: float) -> None:
        self.tolerance, self.fade = tolerance, fade

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        metric, offset = metrics_of(scene, camera)
        ramp = between(metric, self.tolerance, self.fade)
        return {"cut": cut_of(scene, ramp * ramp * (3 - 2 * ramp), offset)}


class Arrives:
    """A cut with a fade, in which all pages arrive after the first frame and fade in
    over some frames.

    With `by_level`, the pages of a level fade in after all coarser levels have faded
    in; otherwise all pages fade in together.
    """

    def __init__(self, tolerance: float, fade: float, frames: int, *, by_level: bool) -> None:
        self.tolerance, self.fade, self.frames = tolerance, fade, frames
        self.by_level = by_level
        self.frame = 0

    def __call__(self, scene: Scene, camera: Camera) -> Options:
        metric, offset = metrics_of(scene, camera)
        ramp = between(metric, self.tolerance, self.fade)
        arrived = self.arrived(scene, camera)
        self.frame += 1
        return {"cut": cut_of(scene, np.minimum(ramp, arrived), offset)}

    def arrived(self, scene: Scene, camera: Camera) -> Any:
        """Return how far the pages of all groups of all instances have faded in, 0 to
        1."""
        levels = [scene.bundles[b].groups.level for b in scene.instance_bundle]
        waits = np.concatenate([level.max() - level for level in levels]) if self.by_level else 0
        return np.clip(self.frame / self.frames - waits, 0.0, 1.0)


class ArrivesInPool(Arrives):
    """Pages that fade in like `Arrives`, read by a renderer's pool while reference
    pictures are drawn."""

    def __init__(self, scene: Scene, tolerance: float, fade: float) -> None:
        super().__init__(tolerance, fade, 0, by_level=True)
        self.options: Any = {"tolerance": tolerance, "fade": fade}
        self.renderer = Renderer(scene, device="cpu", memory="1GB")

    def arrived(self, scene: Scene, camera: Camera) -> Any:
        self.renderer.render(camera, **self.options)
        frame = self.renderer.pool_frame
        assert frame is not None
        shares = [frame.core.arrived(b)[:-1] / _ARRIVAL_FRAMES for b in range(len(scene.bundles))]
        return np.concatenate([shares[b] for b in scene.instance_bundle])


def main(config: Config) -> None:
    rows = []
    for name in config.bundles:
        path, _, up = name.partition(":")
        bundle = Bundle.open(path)
        subject = field_of(bundle, config.side, up or "z")
        for distance in config.distances:
            first, center = first_camera(bundle, up or "z", distance, config.size)
            paths = paths_from(first, center, config.frames)
            for camera_path in [*paths, to_and_fro(paths[0])]:
                if config.paths and camera_path.name not in config.paths:
                    continue
                for trial in config.trials:
                    shown = (
                        up_to_the_rest(subject, camera_path, config)
                        if trial == "rest"
                        else camera_path
                    )
                    cuts = TRIALS[trial](subject, shown, config)
                    of = {"asset": Path(path).stem, "side": config.side, "distance": distance}
                    of |= {"trial": trial, "path": camera_path.name}
                    if trial == "rest":
                        of |= {"stops_after": len(shown.cameras)}
                        shown = replace(shown, cameras=shown.cameras[-1:] * config.frames)
                    found = compare(subject, shown, cuts, config.device)
                    rows += [{**of, **row} for row in found]
                    print(*(line(row) for row in rows[-len(found) :]), sep="\n", flush=True)
    settings = {k: v for k, v in vars(config).items() if k not in ("bundles", "json", "device")}
    write(config.json, {**settings, "rows": rows}, config.device)


def to_and_fro(path: CameraPath) -> CameraPath:
    """Return a path that repeats a few frames back and forth, so that the same groups
    are refined and coarsened repeatedly."""
    frames = [abs((k + _SWAY) % (2 * _SWAY) - _SWAY) for k in range(len(path.cameras))]
    return replace(
        path, name="to and fro", cameras=[path.cameras[min(k, len(frames) - 1)] for k in frames]
    )


def up_to_the_rest(scene: Scene, path: CameraPath, config: Config) -> CameraPath:
    """Return the part of the path up to the frame at which the steps are farthest
    behind their goal."""
    renderer, budget = Renderer(scene, device="cpu"), budget_of(scene, path.cameras[0], config)
    ways = []
    for camera in path.cameras:
        now = renderer.render(camera, budget=budget, fade=config.fade).stats.tolerance
        ways.append(abs(np.log2(now / _goal(scene, camera, budget, config.fade))))
    print(f"{path.name}: {max(ways):.4f} octaves behind at most")
    return replace(path, cameras=path.cameras[: int(np.argmax(ways)) + 1])


def budget_of(scene: Scene, camera: Camera, config: Config) -> int:
    options: Any = {"tolerance": config.tolerance, "fade": config.fade}
    return select(scene, camera, **options, device="cpu").num_gaussians


def rest_cuts(scene: Scene, path: CameraPath, config: Config) -> dict[str, Cut]:
    budget = budget_of(scene, path.cameras[0], config)
    cuts: dict[str, Cut] = {"as it is": Rests(scene, path, budget, config, None)}
    for frames in config.rests:
        cuts[f"over {frames}"] = Rests(scene, path, budget, config, frames)
    return cuts


def budget_cuts(scene: Scene, path: CameraPath, config: Config) -> dict[str, Cut]:
    chosen: Any = {"tolerance": config.tolerance, "fade": config.fade}
    budget = budget_of(scene, path.seen_from(len(path.cameras) // 2), config)
    return {
        "no budget": chosen,
        "at once": AtOnce(budget, config.fade),
        "at once, less": AtOnce(budget - budget // _HEADROOM_PARTS, config.fade),
        "in steps": {"budget": budget, "fade": config.fade},
    }


def hysteresis_cuts(scene: Scene, path: CameraPath, config: Config) -> dict[str, Cut]:
    tolerance = config.tolerance
    cuts: dict[str, Cut] = {
        "hard": {"tolerance": tolerance},
        f"fade {config.fade:g}": {"tolerance": tolerance, "fade": config.fade},
    }
    start = path.seen_from(0)
    for factor in config.hysteresis:
        sticks = Sticks(tolerance, factor)
        grows = path.name in ("drift in", "zoom", "walk", "moved instances")
        for far in np.geomspace(_FAR if grows else 1 / _FAR, 1.0, _FAR_FRAMES):
            away = np.array([0, 0, (far - 1) * _depth_of(scene, start)])
            viewmat = start.viewmat.copy()
            viewmat[:3, 3] += away
            sticks(scene, replace(start, viewmat=viewmat))
        cuts[f"hysteresis {factor:g}"] = sticks
    return cuts


def page_cuts(scene: Scene, path: CameraPath, config: Config) -> dict[str, Cut]:
    tolerance, fade = config.tolerance, config.fade
    cuts: dict[str, Cut] = {"all there": {"tolerance": tolerance, "fade": fade}}
    cuts["as it is"] = ArrivesInPool(scene, tolerance, fade)
    for frames in config.arrivals:
        cuts[f"together, {frames}"] = Arrives(tolerance, fade, frames, by_level=False)
        cuts[f"by level, {frames}"] = Arrives(tolerance, fade, frames, by_level=True)
    return cuts


def ramp_cuts(scene: Scene, path: CameraPath, config: Config) -> dict[str, Cut]:
    tolerance, fade = config.tolerance, config.fade
    cuts: dict[str, Cut] = {"hard": {"tolerance": tolerance}}
    for band in sorted({*config.bands, fade}):
        cuts[f"linear {band:g}"] = {"tolerance": tolerance, "fade": band}
    for band in (fade, 1 + 1.5 * (fade - 1)):
        cuts[f"smooth {band:g}"] = Smooth(tolerance, band)
    cuts["stays"] = Stays(path.seen_from(len(path.cameras) // 2), tolerance)
    return cuts


def _depth_of(scene: Scene, camera: Camera) -> float:
    """Return the depth of the middle of the scene."""
    return float((camera.viewmat[:3, :3] @ scene.positions.mean(axis=0) + camera.viewmat[:3, 3])[2])


TRIALS = {
    "budget": budget_cuts,
    "rest": rest_cuts,
    "hysteresis": hysteresis_cuts,
    "pages": page_cuts,
    "ramps": ramp_cuts,
}


def line(row: Row) -> str:
    low, high = row["tolerances"]
    return (
        f"{row['asset']:>8} {row['distance']:4g} {row['path']:15} {row['cut']:16} "
        f"{row['gaussians']:9,.0f} rms {row['rms']:.3f}  tile {row['tile_mean']:.3f} "
        f"{row['tile_p99']:.3f} {row['tile_worst']:.3f}  pop {row['pop_mean']:.3f} "
        f"{row['pop_worst']:.3f}  warped {row['warped_mean']:.3f} {row['warped_worst']:.3f}  "
        f"changed {row['changed_items']:.0f}  PSNR {row['psnr']:.2f}  tolerance {low:.3f} to "
        f"{high:.3f}"
    )


if __name__ == "__main__":
    main(tyro.cli(Config, description=__doc__))
