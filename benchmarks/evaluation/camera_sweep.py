"""Rows of the tables about builds: means over the distances of the camera sweep."""

from __future__ import annotations

from benchmarks.evaluation.evaluation import Evaluation
from benchmarks.evaluation.markdown import Column
from benchmarks.evaluation.measure import Row, tolerance_for
from v3dg._judges import mean_of
from v3dg.levels import BuildConfig


def full_row(evaluation: Evaluation) -> Row:
    """Return the row for every gaussian at one sample per pixel."""
    return sweep_row(evaluation, "full", 0.0, evaluation.sweep_rows(evaluation.full_sweep, "drawn"))


def build_row(evaluation: Evaluation, name: str, config: BuildConfig, tolerance: float) -> Row:
    """Build with these settings; return the means over the sweep at this tolerance, and
    the cost of the build."""
    built = evaluation.build(config)
    shots = evaluation.shoot_sweep(evaluation.place(built.bundle), tolerance)
    row = sweep_row(evaluation, name, tolerance, evaluation.sweep_rows(shots, "drawn"))
    return {**row, "steps": config.steps, "build_seconds": round(built.seconds, 3)}


def as_many_row(evaluation: Evaluation, name: str, config: BuildConfig, rival: Row) -> Row:
    """Return the means for this build, drawn in each view with at most as many
    gaussians as in `rival`."""
    built = evaluation.build(config)
    scene = evaluation.place(built.bundle)
    shots = [
        evaluation.shoot(scene, view, tolerance_for(scene, view.camera, of_rival["drawn_selected"]))
        for view, of_rival in zip(evaluation.camera_sweep, rival["sweep"], strict=True)
    ]
    row = sweep_row(evaluation, name, None, evaluation.sweep_rows(shots, "drawn"))
    return {**row, "steps": config.steps, "build_seconds": round(built.seconds, 3)}


def sweep_row(evaluation: Evaluation, name: str, tolerance: float | None, sweep: list[Row]) -> Row:
    means = mean_of(
        sweep, "drawn_selected", "drawn_in_frustum", "drawn_ms", "drawn_flip", "drawn_psnr"
    )
    full = mean_of(
        [shot.row("drawn") for shot in evaluation.full_sweep], "drawn_in_frustum", "drawn_ms"
    )
    return {
        "levels": name,
        "tolerance": tolerance,
        **means,
        "share": round(means["drawn_in_frustum"] / full["drawn_in_frustum"], 5),
        "acceleration": round(full["drawn_ms"] / means["drawn_ms"], 3),
        "sweep": sweep,
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
