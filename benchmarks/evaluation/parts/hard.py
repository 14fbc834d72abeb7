"""Assets that are hard for level of detail: lines as thin as hair, a sky of huge soft
gaussians, and a dense tree."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from benchmarks.evaluation.assets import hair_lines, sky_dome
from benchmarks.evaluation.evaluation import FOV_X, Evaluation, close_distance
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row, tolerance_for
from benchmarks.evaluation.summary import Summary
from benchmarks.worlds.procedural import make_tree
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.levels import BuildConfig
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, contact_sheet, to_8bit
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "Thin structures, sky, foliage"
ABOUT = (
    "One asset alone, from near and from far (the sky from within). The first row of a view is the "
    "default tolerance; the others compare our fitted levels with merging alone at equal counts. "
    "Full is every gaussian, one sample a pixel; the truth has eight samples a side."
)

_SHARES = (0.5, 0.25, 0.1)
_FAR = 4.0
_LEAST_PX = 32
_SUPERSAMPLING = 8  # samples per side of a pixel; hair is far thinner than half a pixel
_NOTICED_FLIP = 1e-3


def assets(evaluation: Evaluation) -> Iterator[tuple[str, Gaussians, dict[str, Camera]]]:
    count = evaluation.settings.hard_gaussians
    lines = hair_lines(count, seed=evaluation.seed)
    yield "hair-thin lines", lines, cameras_around(evaluation, lines)
    side = evaluation.settings.panel
    within = Camera.look_at((0, 0, 0.1), (1, 0, 0.5), fov_x=1.2, width=side, height=side, near=1e-3)
    yield "sky dome", sky_dome(count, seed=evaluation.seed), {"within": within}
    tree = make_tree(count, seed=evaluation.seed)
    yield "dense tree", tree, cameras_around(evaluation, tree)
    yield evaluation.asset_name, evaluation.asset, cameras_around(evaluation, evaluation.asset)


def cameras_around(evaluation: Evaluation, asset: Gaussians) -> dict[str, Camera]:
    center, distance = close_distance(asset)
    direction = np.array([0.2, -0.8, 0.55])

    def camera(factor: float) -> Camera:
        # This camera has as many px² per gaussian as the camera at the larger distance,
        # without the empty part of its picture.
        side = max(_LEAST_PX, round(evaluation.settings.panel / factor))
        eye = center + factor * distance * direction
        return Camera.look_at(
            eye,
            center,
            fov_x=2 * math.atan(math.tan(FOV_X / 2) / factor),
            width=side,
            height=side,
            near=1e-3 * distance,
        )

    return {"near": camera(1.0), "far": camera(_FAR)}


def run(evaluation: Evaluation) -> dict[str, Any]:
    rows: list[Row] = []
    strips: list[list[tuple[str, Picture]]] = []
    jobs: list[tuple[Picture, Picture]] = []
    for name, asset, cameras in assets(evaluation):
        own = None if asset is evaluation.asset else asset
        fitted = Scene.of(evaluation.build(asset=own).bundle)
        merged = Scene.of(evaluation.build(BuildConfig(steps=0), own).bundle)
        for where, camera in cameras.items():
            truth = draw_truth(fitted, camera, evaluation.device, _SUPERSAMPLING)

            def draw(
                scene: Scene, tolerance: float, camera: Camera = camera
            ) -> tuple[Picture, int]:
                image = render(scene, camera, tolerance=tolerance, device=evaluation.device)
                return to_8bit(image.color), image.stats.gaussians_in_frustum

            full, count = draw(fitted, 0.0)
            strip = [("truth", truth), ("full", full)]
            for share in (None, *_SHARES):
                wanted = int(count * (share or 1))
                tolerance = (
                    DEFAULT_TOLERANCE if share is None else tolerance_for(fitted, camera, wanted)
                )
                (ours, ours_count), (theirs, _) = draw(fitted, tolerance), draw(merged, tolerance)
                jobs += [(truth, full), (truth, ours), (truth, theirs)]
                row = {
                    "asset": name,
                    "view": where,
                    "share": share,
                    "tolerance": round(tolerance, 3),
                }
                rows.append(row | {"full_in_frustum": count, "ours_in_frustum": ours_count})
                if share in (None, _SHARES[-1]) or ours_count > wanted:
                    text = f"{ours_count / count:.0%}"
                    strip += [(f"ours, {text}", ours), (f"merged, {text}", theirs)]
                # The cut is already the coarsest one that selection allows, because the
                # eye is inside the balls of the remaining groups.
                if ours_count > wanted:
                    break
            strip[0] = f"{name}, {where}: truth", truth
            strips.append(
                [(text, enlarged(picture, evaluation.settings.panel)) for text, picture in strip]
            )
    errors = iter(evaluation.judge.errors(jobs))
    for row in rows:
        for who in ("full", "ours", "merged"):
            row |= {f"{who}_{key}": value for key, value in next(errors).items()}
    evaluation.save("hard", contact_sheet(strips))
    return {"rows": rows}


def enlarged(picture: Picture, side: int) -> Picture:
    """Return the picture with every pixel repeated to a square, so that the picture has
    about `side` px per side."""
    factor = max(1, side // picture.shape[0])
    return picture.repeat(factor, 0).repeat(factor, 1)


_COLUMNS = (
    Column("asset", "asset"),
    Column("view", "view"),
    Column("tolerance", "tolerance", "g"),
    Column("in frustum, full", "full_in_frustum", "count"),
    Column("ours", "ours_in_frustum", "count"),
    Column("FLIP, full", "full_flip", ".4f"),
    Column("ours", "ours_flip", ".4f"),
    Column("merged", "merged_flip", ".4f"),
    Column("PSNR, full", "full_psnr", ".1f"),
    Column("ours", "ours_psnr", ".1f"),
    Column("merged", "merged_psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    return markdown(_COLUMNS, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    for row in result["rows"]:
        count = f"{row['ours_in_frustum']:,} of {row['full_in_frustum']:,}"
        what = f"{row['asset']} ({row['view']}), {count} gaussians"
        if row["share"] is None and row["ours_flip"] > row["full_flip"] + _NOTICED_FLIP:
            out.losses.append(f"{what}: FLIP {row['ours_flip']:.4f}, of all {row['full_flip']:.4f}")
        if row["ours_flip"] > row["merged_flip"] + _NOTICED_FLIP:
            out.losses.append(
                f"{what}: FLIP {row['ours_flip']:.4f} fitted, {row['merged_flip']:.4f} merely "
                "merged"
            )
    return out
