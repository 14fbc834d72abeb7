"""Rows of tables in which each is a build, drawn over the line of views: the means over the distances."""

from __future__ import annotations

from v3dg.bench.measure import Row, mean_of, tolerance_for
from v3dg.bench.stage import Stage
from v3dg.bench.table import Column
from v3dg.build import BuildConfig


def full_row(stage: Stage) -> Row:
    """Every gaussian, one sample a pixel."""
    return summary(stage, "full", 0.0, stage.line_rows(stage.full_line, "drawn"))


def build_row(stage: Stage, name: str, config: BuildConfig, tolerance: float) -> Row:
    """What this build gives at this tolerance, and what it took."""
    built = stage.build(config)
    shots = stage.shoot_line(stage.place(built.bundle), tolerance)
    row = summary(stage, name, tolerance, stage.line_rows(shots, "drawn"))
    return {**row, "steps": config.steps, "build_seconds": round(built.seconds, 3)}


def as_many_row(stage: Stage, name: str, config: BuildConfig, rival: Row) -> Row:
    """What this build gives with at most as many gaussians as another row has, view by view."""
    built = stage.build(config)
    scene = stage.place(built.bundle)
    shots = [
        stage.shoot(scene, view, tolerance_for(scene, view.camera, of_rival["drawn_selected"]))
        for view, of_rival in zip(stage.line, rival["line"], strict=True)
    ]
    row = summary(stage, name, None, stage.line_rows(shots, "drawn"))
    return {**row, "steps": config.steps, "build_seconds": round(built.seconds, 3)}


def summary(stage: Stage, name: str, tolerance: float | None, line: list[Row]) -> Row:
    means = mean_of(line, "drawn_selected", "drawn_in_frustum", "drawn_ms", "drawn_flip", "drawn_psnr")
    full = mean_of([shot.row("drawn") for shot in stage.full_line], "drawn_in_frustum", "drawn_ms")
    return {
        "levels": name,
        "tolerance": tolerance,
        **means,
        "share": round(means["drawn_in_frustum"] / full["drawn_in_frustum"], 5),
        "acceleration": round(full["drawn_ms"] / means["drawn_ms"], 3),
        "line": line,
    }


COLUMNS = (
    Column("levels", "levels"),
    Column("tolerance, px²/gaussian", "tolerance", "g"),
    Column("in frustum", "drawn_in_frustum", "count"),
    Column("share", "share", ".1%"),
    Column("ms", "drawn_ms", ".2f"),
    Column("acceleration", "acceleration", ".2f"),
    Column("FLIP", "drawn_flip", ".4f"),
    Column("PSNR", "drawn_psnr", ".2f"),
)
