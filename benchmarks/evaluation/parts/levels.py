"""Levels side by side (figure 10): every level of the asset, for several numbers of steps of the fit."""

from __future__ import annotations

from typing import Any

from v3dg.bench.measure import Row, as_picture
from v3dg.bench.sheet import sheet
from v3dg.bench.stage import Stage, close_view, every
from v3dg.bench.table import Column, count_text, markdown
from v3dg.bench.verdict import Verdict
from v3dg.build import BuildConfig
from v3dg.rasterize import rasterize

TITLE = "Levels side by side"
ABOUT = (
    "Each level alone, at one size, which is far larger than the coarse ones are meant for: what they look "
    "like, not how well they do. FLIP is against the asset itself."
)

_MOST_LEVELS = 7


def run(stage: Stage) -> dict[str, Any]:
    side = stage.settings.panel // 2
    camera = close_view(stage.asset, (side, side))
    truth = as_picture(rasterize(stage.asset, camera).color)
    builds = [("paper, *0", BuildConfig.paper(steps=0, prune_growth=1.0))]
    builds += [(f"paper, {n}", BuildConfig.paper(steps=n)) for n in stage.settings.steps]
    builds += [(f"ours, {n}", BuildConfig(steps=n)) for n in (*stage.settings.steps, BuildConfig().steps)]
    rows: list[Row] = []
    strips = []
    for name, config in builds:
        bundle = stage.build(config).bundle
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
            strip.append((f"{name}: {count_text(len(gaussians))}", as_picture(raster.color)))
            rows.append({"levels": name, "level": level, "gaussians": len(gaussians)})
        strips.append(strip)
    errors = stage.judge.errors((truth, picture) for strip in strips for _, picture in strip)
    for row, error in zip(rows, errors, strict=True):
        row |= error
    stage.save("levels", sheet(strips))
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


def verdict(result: dict[str, Any]) -> Verdict:
    return Verdict()
