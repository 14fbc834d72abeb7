"""Levels side by side (figure 10 of the paper): every level of the asset, for several
numbers of steps of the fit."""

from __future__ import annotations

from typing import Any

from benchmarks.evaluation.evaluation import Evaluation, close_view, every
from benchmarks.evaluation.markdown import Column, count_text, markdown
from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.summary import Summary
from v3dg.levels import BuildConfig
from v3dg.pictures import contact_sheet, to_8bit
from v3dg.rasterize import rasterize

TITLE = "Levels side by side"
ABOUT = (
    "Each level alone, at one size, which is far larger than the coarse ones are meant for: what "
    "they look like, not how well they do. FLIP is against the asset itself."
)

_MOST_LEVELS = 7


def run(evaluation: Evaluation) -> dict[str, Any]:
    side = evaluation.settings.panel // 2
    camera = close_view(evaluation.asset, (side, side))
    truth = to_8bit(rasterize(evaluation.asset, camera).color)
    builds = [("paper, *0", BuildConfig.paper(steps=0, prune_growth=1.0))]
    builds += [(f"paper, {n}", BuildConfig.paper(steps=n)) for n in evaluation.settings.steps]
    builds += [
        (f"ours, {n}", BuildConfig(steps=n))
        for n in (*evaluation.settings.steps, BuildConfig().steps)
    ]
    rows: list[Row] = []
    strips = []
    for name, config in builds:
        bundle = evaluation.build(config).bundle
        strip = []
        for level in every(range(bundle.num_levels), _MOST_LEVELS):
            gaussians = bundle.level_gaussians(level)
            first = bundle.level_range(level)[0]
            raster = rasterize(
                gaussians,
                camera,
                filter_px2=float(bundle.clusters.filter_px2[first]),
                antialiased=bool(bundle.clusters.antialiased[first]),
            )
            strip.append((f"{name}: {count_text(len(gaussians))}", to_8bit(raster.color)))
            rows.append({"levels": name, "level": level, "gaussians": len(gaussians)})
        strips.append(strip)
    errors = evaluation.judge.errors((truth, picture) for strip in strips for _, picture in strip)
    for row, error in zip(rows, errors, strict=True):
        row |= error
    evaluation.save("levels", contact_sheet(strips))
    return {"rows": rows}


_COLUMNS = (
    Column("levels, steps", "levels"),
    Column("level", "level"),
    Column("gaussians", "gaussians", "count"),
    Column("FLIP", "flip", ".4f"),
    Column("PSNR", "psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    return markdown(_COLUMNS, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    return Summary()
