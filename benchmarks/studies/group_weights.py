"""Measures whether weights of groups, computed from measured errors, give the same
error with fewer gaussians.

    python -m benchmarks.studies.group_weights donut.ply massa.sog --refine 0 30000 \\
        --layout donutsea.json --device cuda -o group_weights_h100.json

Each level is compared with the level below it in pictures of the whole asset, at
several sizes and from several sides. The loss of a pixel is its blurred difference to
the supersampled asset, raised to the power of 0.7. It is distributed over groups by the
blend weights of their leaves, as in csrc/levels/first_selected.cpp. The weight of a
group depends on how much the loss rises, for each gaussian that is saved, if the group
is drawn one level coarser. Weights never decrease towards the root, so that cuts stay
exact.

Cuts with the measured weights are then compared with cuts with the weights of the
build, at many tolerances, in views of the asset, of a field of its instances, and of
crops of a layout. The study reports FLIP at equal counts and counts at equal FLIP. The
latter uses the smallest count on each curve whose FLIP is not larger.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
import tyro

import v3dg
from benchmarks.evaluation import record
from benchmarks.evaluation.assets import read_layout
from v3dg import metrics, rasterize
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians

Row = dict[str, Any]
Floats = np.ndarray[Any, Any]

# sizes as px² of the ball per gaussian, for the median group
_SIZES = 1.0, 2.0, 4.0, 8.0, 16.0
# the sizes at which the error of a coarser level exceeds the noise
_COUNTED = slice(2, None)
_DISTANCE = 8.0  # distance of the cameras, in radii
_SH_0 = 0.28209479177387814
_TOLERANCES = 3.0, 4.5, 6.5, 9.4, 13.0
_ALL_TOLERANCES = 1.6, 2.2, 3.0, 3.7, 4.5, 5.4, 6.5, 7.8, 9.4, 11.2, 13.0, 16.0, 20.0, 26.0


@dataclass
class Config:
    assets: tyro.conf.Positional[tuple[Path, ...]]
    """Files of gaussians."""
    refine: tuple[int, ...] = (0,)
    """Numbers of pictures for the refinements to measure."""
    layout: Path | None = None
    """A layout of instances of the first asset."""
    cameras: tuple[int, ...] = (46, 50, 53, 59)
    """Indices of the layout's cameras."""
    widths: tuple[int, ...] = (400, 200, 100, 50)
    """Widths in px of views of single assets."""
    field: int = 0
    """Number of instances on each side of a field; 0 measures no field."""
    sides: int = 8
    """Number of sides from which groups are measured."""
    device: Literal["cpu", "cuda"] = "cuda"
    workers: int = 14
    output: Annotated[str | None, tyro.conf.arg(aliases=["-o"])] = None
    """File of the results."""


@dataclass(frozen=True)
class Rule:
    """A rule that computes weights from measured errors.

    Attributes:
        at_px2: The average size, in px² per gaussian, at which levels should change.
        added_mean: The fraction of the level's mean that is added to each group's
            error.
        limit: The largest factor of a weight.
        by_level: Whether levels may have different weights.
        by_group: Whether the groups of a level may have different weights.
        sides: The number of sides to use; None means all.
    """

    at_px2: float = 6.0
    added_mean: float = 0.2
    limit: float = 2.0
    by_level: bool = True
    by_group: bool = True
    sides: int | None = None


RULES = {
    "level": Rule(by_group=False),
    "group, at 6": Rule(),
    "group, at 4": Rule(at_px2=4.0, added_mean=0.1, limit=4.0),
    "group in its level, at 4": Rule(at_px2=4.0, added_mean=0.1, limit=4.0, by_level=False),
    "group, at 4, four sides": Rule(at_px2=4.0, added_mean=0.2, limit=4.0, sides=4),
}


@dataclass
class Measured:
    """The groups of a level.

    Attributes:
        groups: (G,) the indices of the groups.
        cost: (S, K, G) how much larger the loss of this level is than that of the level
            below, in pictures of S sizes from K sides.
        px2: (S, G) px² of the group's ball per gaussian.
        count: (G,) the numbers of gaussians.
    """

    groups: Floats
    cost: Floats
    px2: Floats
    count: Floats


# ---- measuring


def around(means: Floats) -> tuple[Floats, float]:
    """Return centre and radius of the ball that holds nearly all means."""
    center = np.median(means, axis=0).astype(float)
    return center, float(np.quantile(np.linalg.norm(means - center, axis=1), 0.999))


def outwards(height: float, angle: float) -> Floats:
    flat = math.sqrt(1 - height * height)
    return np.array([flat * math.cos(angle), flat * math.sin(angle), height])


def camera_of(
    center: Floats, radius: float, focal: float, side: int, sides: int, turn: int
) -> Camera:
    angle = math.pi * (1 + math.sqrt(5)) * (side + 0.5) + turn
    direction = outwards(1 - (2 * side + 1) / sides, angle)
    width = math.floor(2 * focal / math.sqrt(_DISTANCE**2 - 1)) + 8
    return Camera.look_at(
        center + _DISTANCE * radius * direction,
        center,
        (0, 0, 1),
        fov_x=2 * math.atan(width / 2 / focal),
        width=width,
        height=width,
        near=0.5 * radius,
    )


def blurred(picture: torch.Tensor) -> torch.Tensor:
    """Distribute each pixel over its neighbours by 1/4, 1/2, 1/4 along both axes."""
    padded = torch.nn.functional.pad(picture.permute(2, 0, 1), (1, 1, 1, 1))
    height, width = picture.shape[:2]
    rows = 0.5 * padded[:, 1:-1] + 0.25 * (padded[:, :height] + padded[:, 2:])
    columns = 0.5 * rows[..., 1:-1] + 0.25 * (rows[..., :width] + rows[..., 2:])
    return columns.permute(1, 2, 0)


class Pictures:
    """Pictures of the levels of a bundle, on a device."""

    def __init__(self, bundle: v3dg.Bundle, device: str) -> None:
        self.bundle = bundle
        self.device = device
        self.leaves = self.level(0)
        self.black = torch.zeros((len(self.leaves), 1, 3), device=device)

    def level(self, number: int) -> Gaussians:
        return self.bundle.level_gaussians(number).torch(self.device)

    def look(self, level: int) -> dict[str, Any]:
        first = self.bundle.level_range(level).start
        clusters = self.bundle.clusters
        return {
            "filter_px2": float(clusters.filter_px2[first]),
            "antialiased": bool(clusters.antialiased[first]),
        }

    @torch.no_grad()
    def draw(self, gaussians: Gaussians, camera: Camera, level: int) -> torch.Tensor:
        color = rasterize(gaussians, camera, background=(1, 1, 1), **self.look(level)).color
        return torch.as_tensor(color).clamp(0, 1)

    def truth(self, camera: Camera, samples: int) -> torch.Tensor:
        color = self.draw(self.leaves, camera.scaled(samples), 0)
        return torch.as_tensor(metrics.box_downsample(color, samples))

    def shares(self, camera: Camera, losses: Sequence[torch.Tensor]) -> torch.Tensor:
        """Return (N, 2) the part of each leaf in two pictures of losses."""
        sh = self.black.clone().requires_grad_()
        leaves = self.leaves
        black = Gaussians(leaves.means, leaves.quats, leaves.scales, leaves.opacities, sh)
        color = rasterize(black, camera, **self.look(0)).color
        weights = torch.stack([*losses, torch.zeros_like(losses[0])], dim=-1)
        (color * weights).sum().backward()
        assert sh.grad is not None
        return sh.grad[:, 0, :2].double() / _SH_0


def measure(bundle: v3dg.Bundle, config: Config) -> dict[int, Measured]:
    """Measure all levels that have at least four groups."""
    pictures = Pictures(bundle, config.device)
    center, radius = around(bundle.level_gaussians(0).means)
    groups = bundle.groups
    clusters = bundle.clusters
    is_made = clusters.own_group >= 0
    count = np.zeros(len(groups.level))
    np.add.at(count, clusters.own_group[is_made], np.diff(clusters.offset)[is_made])
    low = bundle.level_range(0)
    group = clusters.parent_group[low.start : low.stop]
    sizes = np.diff(clusters.offset[low.start : low.stop + 1])
    fine = pictures.leaves
    result = {}
    for level in range(1, bundle.num_levels):
        ids = np.flatnonzero(groups.level == level)
        if len(ids) < 4:
            break
        coarse = pictures.level(level)
        rows = torch.from_numpy(np.repeat(np.searchsorted(ids, group), sizes)).to(config.device)
        px2 = math.pi * (groups.ball[ids, 3].astype(float) / radius / _DISTANCE) ** 2 / count[ids]
        measured = Measured(
            groups=ids,
            cost=np.zeros((len(_SIZES), config.sides, len(ids))),
            px2=np.zeros((len(_SIZES), len(ids))),
            count=count[ids],
        )
        for size, median_px2 in enumerate(_SIZES):
            widest = 700 * math.sqrt(_DISTANCE**2 - 1)
            focal = min(math.sqrt(median_px2 / np.median(px2)), widest)
            measured.px2[size] = px2 * focal**2
            for side in range(config.sides):
                camera = camera_of(center, radius, focal, side, config.sides, size)
                shares = compared(pictures, camera, level, coarse, fine)
                sums = torch.zeros((len(ids), 2), dtype=torch.float64, device=config.device)
                sums.index_add_(0, rows, shares)
                measured.cost[size, side] = (sums[:, 0] - sums[:, 1]).cpu().numpy()
        result[level] = measured
        group = groups.parent[group]
        fine = coarse
    return result


def compared(
    pictures: Pictures, camera: Camera, level: int, coarse: Gaussians, fine: Gaussians
) -> torch.Tensor:
    """Return (N, 2) the losses of a level and of the one below it, distributed over the
    leaves."""
    samples = 8
    if level <= 2:
        samples = 4
    truth = pictures.truth(camera, samples)
    losses = []
    for gaussians, number in ((coarse, level), (fine, level - 1)):
        difference = blurred(pictures.draw(gaussians, camera, number) - truth)
        losses.append(difference.abs().mean(dim=-1) ** 0.7)
    return pictures.shares(camera, losses)


# ---- weights


class Curve:
    """How much the loss rises with one level less, per gaussian that is saved, as a
    function of px² per gaussian."""

    def __init__(self, measured: Measured, cost: Floats) -> None:
        log_px2 = [np.average(np.log(row), weights=measured.count) for row in measured.px2]
        self.px2 = np.exp(log_px2)
        self.cost = np.maximum.accumulate(cost.sum(axis=1) / measured.count.sum())

    def __call__(self, px2: Floats | float) -> Floats:
        slope = (self.cost[-1] - self.cost[-2]) / (self.px2[-1] - self.px2[-2])
        extrapolated = self.cost[-1] + slope * (px2 - self.px2[-1])
        interpolated = np.interp(px2, self.px2, self.cost)
        return np.where(px2 > self.px2[-1], extrapolated, interpolated)


def measured_weights(
    bundle: v3dg.Bundle, levels: dict[int, Measured], rule: Rule
) -> np.ndarray[Any, np.dtype[np.float32]]:
    """Return (G,) weights with which refining any group gains the same per gaussian."""
    weight = bundle.groups.weight.astype(float)
    grid = np.exp(np.linspace(math.log(0.75), math.log(24), 121))
    costs = {n: m.cost[:, : rule.sides].mean(axis=1) for n, m in levels.items()}
    curves = {n: Curve(m, costs[n]) for n, m in levels.items()}
    counts = {n: m.count.sum() for n, m in levels.items()}
    worth = sum(counts[n] * curves[n](rule.at_px2) for n in levels) / sum(counts.values())
    factor = np.ones(1)
    for number, level in levels.items():
        curve = curves[number]
        mean = np.array([curve(px2) * level.count for px2 in level.px2])[_COUNTED].sum(axis=0)
        cost = costs[number][_COUNTED].sum(axis=0)
        relative = np.ones(len(level.count))
        if rule.by_group:
            relative = np.clip(
                (cost + rule.added_mean * mean) / ((1 + rule.added_mean) * mean), 0.05, 20
            )
        px2 = np.array([first_reached(curve, grid, worth / r) for r in relative])
        if not rule.by_level:
            px2 *= rule.at_px2 / first_reached(curve, grid, worth)
        factor = np.clip(rule.at_px2 / px2, 1 / rule.limit, rule.limit)
        weight[level.groups] *= factor
    weight[bundle.groups.level > max(levels)] *= np.median(factor)
    for group, parent in enumerate(bundle.groups.parent):
        if parent >= 0:
            weight[parent] = max(weight[parent], weight[group])
    return weight.astype(np.float32)


def first_reached(curve: Curve, grid: Floats, cost: float) -> float:
    reached = np.flatnonzero(curve(grid) >= cost)
    if len(reached) == 0:
        return float(grid[-1])
    return float(grid[reached[0]])


def reweighted(bundle: v3dg.Bundle, weight: Floats) -> v3dg.Bundle:
    groups = replace(bundle.groups, weight=weight)
    return v3dg.Bundle(bundle.clusters, groups, bundle.gaussians, bundle.config, bundle.codec)


# ---- comparing


@dataclass
class View:
    """Pictures that are compared together.

    Attributes:
        name: The subject of the pictures.
        scene_of: A function that returns the scene for a bundle.
        cameras: Cameras that were not used for the measured weights.
        samples: Samples per side of a pixel of the reference pictures.
    """

    name: str
    scene_of: Callable[[v3dg.Bundle], v3dg.Scene | v3dg.Bundle]
    cameras: list[Camera]
    samples: int


def crop(camera: Camera, width: int, height: int, right: int, down: int) -> Camera:
    left = (camera.width - width) // 2 + right
    top = (camera.height - height) // 2 + down
    K = camera.K.copy()
    K[:2, 2] -= left, top
    return Camera(camera.viewmat, K, width, height, near=camera.near)


def single_views(bundle: v3dg.Bundle, width: int, num_sides: int = 6) -> View:
    center, radius = around(bundle.level_gaussians(0).means)
    cameras = []
    for side in range(num_sides):
        direction = outwards(0.85 - 1.7 * (side + 0.5) / num_sides, 2.4 * side + 0.7)
        camera = Camera.look_at(
            center + 4 * radius * direction,
            center,
            (0, 0, 1),
            fov_x=2 * math.atan(1.1 / math.sqrt(15)),
            width=width,
            height=width,
            near=0.3 * radius,
        )
        cameras.append(camera)
    samples = 8
    if width >= 200:
        samples = 4
    return View(f"{width} px", lambda bundle: bundle, cameras, samples)


def field_views(bundle: v3dg.Bundle, num_sides: int) -> list[View]:
    """Views of instances on a square, from three distances."""
    center, radius = around(bundle.level_gaussians(0).means)
    rng = np.random.default_rng(3)
    matrices = []
    for x in range(num_sides):
        for y in range(num_sides):
            angle = rng.uniform(0, 2 * math.pi)
            matrix = np.eye(4)
            matrix[0, :2] = math.cos(angle), -math.sin(angle)
            matrix[1, :2] = math.sin(angle), math.cos(angle)
            place = np.array([2.2 * (x - num_sides / 2), 2.2 * y, 0]) * radius
            place[:2] += rng.uniform(-0.3, 0.3, 3)[:2] * radius
            matrix[:3, 3] = place - matrix[:3, :3] @ center
            matrices.append(matrix)

    def scene_of(bundle: v3dg.Bundle) -> v3dg.Scene:
        scene = v3dg.Scene()
        scene.add(bundle, matrix=np.array(matrices))
        return scene

    views = []
    for distance, height in ((3, 2.5), (9, 7.0), (24, 18.0)):
        eye = np.array([0.3, -distance, height]) * radius
        target = (0, 12 * radius, 0)
        camera = Camera.look_at(
            eye, target, (0, 0, 1), fov_x=0.9, width=960, height=540, near=0.1 * radius
        )
        cameras = [crop(camera, 320, 180, -150, 60), crop(camera, 320, 180, 120, -30)]
        views.append(View(f"field from {distance} radii", scene_of, cameras, 4))
    return views


def layout_views(layout: Path, bundle: v3dg.Bundle, numbers: Sequence[int]) -> list[View]:
    _, cameras = read_layout(layout, bundle)
    views = []
    for number in numbers:
        camera = list(cameras.values())[number]
        crops = [crop(camera, 320, 180, right, 40) for right in (-300, 250)]
        name = f"{layout.stem}, camera {number}"
        views.append(View(name, lambda bundle: read_layout(layout, bundle)[0], crops, 4))
    return views


def flip_of(pair: tuple[Floats, Floats]) -> float:
    return metrics.flip(*pair)


def curve_of(
    pool: ProcessPoolExecutor, view: View, bundle: v3dg.Bundle, truths: list[Floats], device: str
) -> Floats:
    """Return (T, 2) the mean number of gaussians in the frustum and the mean FLIP at
    each tolerance."""
    scene = view.scene_of(bundle)
    pairs = []
    counts = []
    for tolerance in _ALL_TOLERANCES:
        for camera, truth in zip(view.cameras, truths, strict=True):
            image = v3dg.render(scene, camera, tolerance=tolerance, device=device)
            pairs.append((truth, torch.as_tensor(image.color).cpu().numpy().clip(0, 1)))
            counts.append(image.stats.gaussians_in_frustum)
    flips = list(pool.map(flip_of, pairs, chunksize=2))
    shape = (len(_ALL_TOLERANCES), -1)
    means = [np.reshape(values, shape).mean(axis=1) for values in (counts, flips)]
    return np.stack(means, axis=1)


def fewest(curve: Floats, flip: float) -> float:
    """Return the smallest count on a curve with at most this FLIP; NaN if the curve
    does not reach it."""
    by_count = curve[np.argsort(curve[:, 0])]
    good = np.flatnonzero(by_count[:, 1] <= flip)
    if len(good) == 0 or good[0] == 0:
        return math.nan
    last, first = by_count[good[0] - 1 : good[0] + 1]
    part = (flip - last[1]) / (first[1] - last[1])
    return float(last[0] * (first[0] / last[0]) ** part)


def ratios(old: Floats, new: Floats) -> Row:
    """Return the ratios of FLIP at equal counts and of counts at equal FLIP, for each
    reported tolerance."""
    order = np.argsort(new[:, 0])
    flips = []
    counts = []
    for tolerance in _TOLERANCES:
        count, flip = old[_ALL_TOLERANCES.index(tolerance)]
        log_flip = np.interp(
            math.log(count),
            np.log(new[order, 0]),
            np.log(new[order, 1]),
            left=math.nan,
            right=math.nan,
        )
        flips.append(float(np.exp(log_flip) / flip))
        reached = max(flip, old[:, 1].min() * 1.0001)
        counts.append(fewest(new, reached) / fewest(old, reached))
    return {"flip": rounded(flips), "gaussians": rounded(counts)}


def rounded(values: Sequence[float]) -> list[float | None]:
    """Return a number for JSON, which has no NaN."""
    numbers: list[float | None] = []
    for value in values:
        if math.isnan(value):
            numbers.append(None)
        else:
            numbers.append(round(value, 3))
    return numbers


def mean(rows: Sequence[list[float | None]]) -> list[float | None]:
    means = []
    for column in zip(*rows, strict=True):
        known = [value for value in column if value is not None]
        means.append(sum(known) / len(known) if known else math.nan)
    return rounded(means)


def compare(pool: ProcessPoolExecutor, bundle: v3dg.Bundle, views: list[View], c: Config) -> Row:
    levels = measure(bundle, c)
    bundles = {n: reweighted(bundle, measured_weights(bundle, levels, r)) for n, r in RULES.items()}
    result: Row = {"views": [], "means": {}}
    for view in views:
        truths = [
            metrics.draw_truth(view.scene_of(bundle), camera, c.device, view.samples)
            for camera in view.cameras
        ]
        exact = [truth.astype(np.float32) / 255 for truth in truths]
        old = curve_of(pool, view, bundle, exact, c.device)
        row: Row = {"view": view.name, "built": np.round(old, 5).tolist(), "rules": {}}
        for name, changed in bundles.items():
            row["rules"][name] = ratios(old, curve_of(pool, view, changed, exact, c.device))
        print(view.name, row["rules"]["group, at 4"], flush=True)
        result["views"].append(row)
    for name in RULES:
        of_rule = [row["rules"][name] for row in result["views"]]
        result["means"][name] = {
            k: mean([row[k] for row in of_rule]) for k in ("flip", "gaussians")
        }
    print(json.dumps(result["means"], indent=1), flush=True)
    return result


def main(config: Config) -> None:
    results: Row = {"tolerances": _TOLERANCES, "all_tolerances": _ALL_TOLERANCES, "assets": {}}
    with ProcessPoolExecutor(config.workers, mp_context=get_context("spawn")) as pool:
        for number, path in enumerate(config.assets):
            for steps in config.refine:
                bundle = v3dg.build_bundle(
                    path, device=config.device, progress=False, quality="draft"
                )
                if steps > 0:
                    bundle = v3dg.refine_bundle(
                        bundle, steps=steps, device=config.device, progress=False
                    )
                views = [single_views(bundle, width) for width in config.widths]
                if config.field > 0:
                    views += field_views(bundle, config.field)
                if number == 0 and config.layout is not None:
                    views += layout_views(config.layout, bundle, config.cameras)
                name = f"{path.stem}, {steps} pictures"
                print(name, flush=True)
                results["assets"][name] = compare(pool, bundle, views, config)
                record.write(config.output, results, config.device)


if __name__ == "__main__":
    main(tyro.cli(Config))
