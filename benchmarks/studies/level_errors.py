"""Measures whether a metric that is based on measured errors would be better than the
footprint per gaussian.

Each group of a bundle is drawn alone at several sizes, together with its clusters one
level finer and with its leaves (4 x 4 samples per pixel). This gives the gain per
gaussian of one more level of detail, for each size of the group. These gains determine
a cut: the pruning of the tree with the smallest sum of error and lambda x gaussians
(Chou, Lookabaugh and Gray 1989). The cut is compared with the cut of the existing
metric at equal numbers of gaussians, from outside of an object.
docs/notes/experiments/2026-11-22-selection-measured-error.md has the results.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tyro

import v3dg
from benchmarks.evaluation import record
from v3dg import _core, metrics

SIZES = {0.5: 4, 1.0: 4, 2.0: 2, 4.0: 2, 8.0: 1}
"""Sizes of groups, as multiples of the native length of a side; and for each size the
samples per side of a pixel for the leaves."""
_MOST_SAMPLES = 12_000_000  # samples per picture
# Weights of |colour| and |alpha|, the same as in the fit.
_WEIGHTS = np.array([1, 1, 1, 1.5], np.float32) / 3
_FOV = 0.3


@dataclass
class Config:
    bundle: Path
    views: int = 4
    """Number of directions from which each group is drawn."""
    widths: tuple[int, ...] = (700, 350, 176, 90)
    """Widths of the object in px."""
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    output: str | None = None


class Groups:
    """The groups of a bundle: ranges of their gaussians, smallest enclosing balls, and
    gains."""

    def __init__(self, bundle: v3dg.Bundle) -> None:
        self.bundle, self.table, clusters = bundle, bundle.groups, bundle.clusters
        self.kid, self.own = (
            self._runs(links, np.arange(len(clusters)), clusters.offset)
            for links in (clusters.parent_group, clusters.own_group)
        )
        self.leaf = self.kid.copy()
        for level in range(2, bundle.num_levels):
            here, below = (np.flatnonzero(self.table.level == n) for n in (level, level - 1))
            for row, pick in ((0, np.minimum), (1, np.maximum)):
                self.leaf[here, row] = [1 << 60, 0][row]
                pick.at(self.leaf[:, row], self.table.parent[below], self.leaf[below, row])
        asset = bundle.level_gaussians(0)
        spheres = np.concatenate([asset.means, asset.scales.max(1, keepdims=True)], 1)
        self.ball = np.zeros((len(self.table), 4))
        for level in range(1, bundle.num_levels):
            here = np.flatnonzero(self.table.level == level)
            self.ball[here] = _core.bound_spheres(
                spheres, np.append(self.leaf[here, 0], self.leaf[here[-1], 1])
            )
        self.count = np.diff(self.own, axis=1)[:, 0].astype(float)
        self.more = np.diff(self.kid, axis=1)[:, 0] - self.count
        self.all = bundle.gaussians

    def _runs(self, links: Any, clusters: Any, offset: Any) -> Any:
        """Return (G, 2) the start and end of the gaussians of the clusters that `links`
        assigns to each group."""
        runs = np.tile(np.array([1 << 60, 0]), (len(self.table), 1))
        linked = clusters[links >= 0]
        np.minimum.at(runs[:, 0], links[linked], offset[linked])
        np.maximum.at(runs[:, 1], links[linked], offset[linked + 1])
        return runs

    def measure(self, num_views: int) -> None:
        """Compute the gain (G, S) of more detail, an error per additional gaussian; and
        the cover (G,), the sum of alpha over the pixels at twice the native size."""
        self.gain, self.cover = np.zeros((len(self.table), len(SIZES))), np.zeros(len(self.table))
        rng = np.random.default_rng(1)
        turns = [np.linalg.qr(rng.normal(size=(3, 3)))[0] for _ in range(num_views)]
        turns = [turn * np.linalg.det(turn) for turn in turns]
        for level in range(1, self.bundle.num_levels):
            for s, (size, samples) in enumerate(SIZES.items()):
                groups = np.flatnonzero(self.table.level == level)
                radius_px = size * math.sqrt(2 * np.median(self.count[groups]) / math.pi)
                cell = math.ceil(2.4 * radius_px) + 6
                each = max(1, int(_MOST_SAMPLES / (cell * samples) ** 2))
                for first in range(0, len(groups), each):
                    some = groups[first : first + each]
                    for turn in turns:
                        gained, covered = self._compare(some, level, turn, radius_px, cell, samples)
                        self.gain[some, s] += gained / self.more[some] / num_views
                        if size == 2:
                            self.cover[some] += covered / num_views

    def _compare(
        self, groups: Any, level: int, turn: Any, radius_px: float, cell: int, samples: int
    ) -> Any:
        """Draw groups side by side, each in a cell of the picture.

        Returns:
            For each group, summed over its pixels: the decrease of the error by one
                more level of detail, and alpha.
        """
        across = math.ceil(math.sqrt(len(groups)))
        spacing = cell / radius_px
        depth = 12 * across * spacing + 20
        side = across * cell

        def draw(runs: Any, scale: int, filter_px2: float) -> Any:
            index = np.concatenate([np.arange(*run) for run in runs[groups]])
            place = np.repeat(np.arange(len(groups)), np.diff(runs[groups], axis=1)[:, 0])
            part, ball = self.all.subset(index), self.ball[groups][place]
            grid = np.stack([place % across, place // across], 1) - (across - 1) / 2
            means = (part.means - ball[:, :3]) / ball[:, 3:] + spacing * grid @ turn[:2]
            part = replace(
                part,
                means=means.astype(np.float32),
                scales=(part.scales / ball[:, 3:]).astype(np.float32),
            )
            viewmat = np.eye(4)
            viewmat[:3, :3], viewmat[2, 3] = turn, depth
            focal, middle = depth * radius_px * scale, side * scale / 2
            intrinsics = np.array([[focal, 0, middle], [0, focal, middle], [0, 0, 1]])
            camera = v3dg.Camera(viewmat, intrinsics, side * scale, side * scale)
            image = v3dg.rasterize(part, camera, filter_px2=filter_px2, antialiased=filter_px2 > 0)
            return metrics.box_downsample(np.dstack([image.color, image.alpha]), scale)

        def sums(values: Any) -> Any:
            return values.reshape(across, cell, across, cell).sum((1, 3)).ravel()[: len(groups)]

        truth = draw(self.leaf, samples, 0.0)
        own, finer = draw(self.own, 1, 0.05), draw(self.kid, 1, 0.0 if level == 1 else 0.05)
        errors = [sums(np.abs(image - truth) @ _WEIGHTS) for image in (own, finer)]
        return errors[0] - errors[1], sums(truth[..., 3])

    def see(self, cameras: list[v3dg.Camera]) -> None:
        """Compute `visibility`, the fraction of each group that other groups do not
        hide from these cameras, (G,)."""
        import torch

        asset = self.bundle.level_gaussians(0).torch("cpu")
        seen, alone = np.zeros(len(self.table)), np.zeros(len(self.table))
        for camera in cameras:
            sh = torch.zeros(len(asset), 1, 3, requires_grad=True)
            v3dg.rasterize(replace(asset, sh=sh), camera).color.sum().backward()
            assert sh.grad is not None
            weight = np.append(
                0, np.cumsum(sh.grad[:, 0].mean(1).double().numpy() / _core.sh_base0)
            )
            seen += weight[self.leaf[:, 1]] - weight[self.leaf[:, 0]]
            alone += self.cover * (self._size(camera) / 2) ** 2
        self.visibility = seen / alone

    def _size(self, camera: v3dg.Camera) -> Any:
        """Return (G,) the size of each group on screen, as a multiple of the native
        length of a side."""
        distance = np.linalg.norm(self.ball[:, :3] - camera.position, axis=1)
        return camera.fx * self.ball[:, 3] / distance / np.sqrt(2 * self.count / math.pi)

    def cut(self, rule: str, camera: v3dg.Camera, tolerance: float) -> Any:
        """Return the indices of the clusters that a rule selects."""
        if rule in ("old", "visible"):
            weight = self.table.weight.astype(float)
            if rule == "visible":
                weight = self._to_parents(np.maximum, self.visibility / self.count)
            ball = self.table.ball.astype(float)
            x2 = (ball[:, 3] / np.linalg.norm(ball[:, :3] - camera.position, axis=1)) ** 2
            footprint = 2 * math.pi * (1 - np.sqrt(np.maximum(0, 1 - x2))) * camera.fx * camera.fy
            refined = np.where(x2 < 1, footprint, np.inf) * weight > tolerance
        else:
            gain = self._gain_at(camera) * (self.visibility if rule == "seen error" else 1)
            value = (gain - tolerance) * self.more
            refined = self._to_parents(lambda a, b: a + np.maximum(b, 0), value) > 0
            for level in range(self.bundle.num_levels - 2, 0, -1):
                here = np.flatnonzero(self.table.level == level)
                refined[here] &= refined[self.table.parent[here]]
        own, parent = self.bundle.clusters.own_group, self.bundle.clusters.parent_group
        return np.flatnonzero(
            ((own < 0) | ~refined[own]) & ((parent < 0) | refined[parent])
        ).astype(np.int32)

    def _to_parents(self, join: Any, values: Any) -> Any:
        values = values.copy()
        for group in np.flatnonzero(self.table.parent >= 0):  # in the order of levels
            parent = self.table.parent[group]
            values[parent] = join(values[parent], values[group])
        return values

    def _gain_at(self, camera: v3dg.Camera) -> Any:
        """Return (G,) the gain at the size on screen. Gains are interpolated in
        logarithms; beyond the largest measured size they grow with the area."""
        size, known = np.log2(self._size(camera)), np.log2(list(SIZES))
        inside = np.clip(size, known[0], known[-1])
        step = np.minimum((inside - known[0]).astype(int), len(known) - 2)
        rows, u = np.arange(len(size)), inside - known[step]
        a, b = self.gain[rows, step], self.gain[rows, step + 1]
        tiny = 1e-12
        grown = np.exp((1 - u) * np.log(np.maximum(a, tiny)) + u * np.log(np.maximum(b, tiny)))
        gain = np.where((a > 0) & (b > 0), grown, a + u * (b - a))
        return np.where(size > known[-1], gain * 4.0 ** (size - known[-1]), gain)


def main(config: Config) -> None:
    groups = Groups(v3dg.Bundle.open(config.bundle))
    groups.measure(config.views)
    asset = groups.bundle.level_gaussians(0)
    low, high = np.percentile(asset.means, [0.5, 99.5], axis=0)
    middle, extent = (low + high) / 2, 0.8 * float(np.linalg.norm(high - low))
    up = np.array(config.up) / np.linalg.norm(config.up)
    side = np.linalg.svd(up[None])[2][1:]

    def look(angle: float, lift: float, width: int) -> v3dg.Camera:
        direction = 0.9 * (math.cos(angle) * side[0] + math.sin(angle) * side[1]) + lift * up
        eye = middle + direction * extent * 0.75 / math.tan(_FOV / 2)
        px = int(width * 1.5)
        return v3dg.Camera.look_at(eye, middle, up, _FOV, width=px, height=px)

    groups.see([look(2.4 * i, 1.2 - 0.1 * i, 350) for i in range(24)])
    rows = []
    for width in config.widths:
        cameras = [
            look(*place, width) for place in ((0.3, 0.4), (1.9, 0.1), (3.3, 0.6), (5.0, 0.3))
        ]
        truths = [metrics.draw_truth(groups.bundle, camera, "cpu", 4) for camera in cameras]
        for part in (0.5, 0.25, 0.125, 0.06, 0.03):
            target = min(part * math.pi / 8 * width**2, 0.9 * len(asset))
            row = {"width_px": width, "gaussians": round(target)}
            for rule in ("old", "error", "seen error", "visible"):
                row[rule] = round(_mean_flip(groups, rule, cameras, truths, target), 4)
            rows.append(row)
            print(row, flush=True)
    record.write(config.output, {"asset_gaussians": len(asset), "rows": rows})


def _mean_flip(groups: Groups, rule: str, cameras: Any, truths: Any, target: float) -> float:
    """Return the mean FLIP of a rule's cuts that have at most `target` gaussians, as
    many as possible."""
    sizes = np.diff(groups.bundle.clusters.offset)
    scene = v3dg.Scene.of(groups.bundle)
    flips = []
    for camera, truth in zip(cameras, truths, strict=True):
        low, high = 1e-9, 1e9
        for _ in range(40):
            tolerance = math.sqrt(low * high)
            fits = sizes[groups.cut(rule, camera, tolerance)].sum() <= target
            low, high = (low, tolerance) if fits else (tolerance, high)
        ids = groups.cut(rule, camera, high)
        chosen = v3dg.Selection(
            scene, np.zeros(len(ids), np.int32), ids, int(sizes[ids].sum()), high, 0.0
        )
        image = v3dg.render(groups.bundle, camera, cut=chosen, device="cpu").color.clip(0, 1)
        flips.append(metrics.flip(truth.astype(np.float32) / 255, image))
    return float(np.mean(flips))


if __name__ == "__main__":
    main(tyro.cli(Config))
