"""Tolerances (table 1 of the paper, lower half): milliseconds against FLIP, for levels
with the paper's settings and with ours."""

from __future__ import annotations

from typing import Any

from benchmarks.evaluation import gpu
from benchmarks.evaluation.camera_sweep import COLUMNS, build_row, full_row, sweep_row
from benchmarks.evaluation.evaluation import Evaluation, paper_tolerance
from benchmarks.evaluation.markdown import markdown
from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.summary import Summary
from v3dg.levels import BuildConfig
from v3dg.pictures import to_8bit
from v3dg.select import select

TITLE = "Tolerance: time against error"
ABOUT = (
    "The same scene, views and rasterizer for both bundles: the paper's settings (4,096 gaussians "
    "a cluster, its tolerances) and ours. A row is a mean over the distances; full is every "
    "gaussian, one sample a pixel."
)

_PAPER_TAUS = (512, 1024, 2048, 4096, 8192)
_TOLERANCES = (0.5, 1.0, 2.0, 3.0, 4.4, 8.0, 16.0)


def run(evaluation: Evaluation) -> dict[str, Any]:
    rows = [full_row(evaluation)]
    sweeps = (
        ("paper", BuildConfig.paper(), [paper_tolerance(tau) for tau in _PAPER_TAUS]),
        ("ours", BuildConfig(), _TOLERANCES),
    )
    for name, config, tolerances in sweeps:
        rows += [build_row(evaluation, name, config, tolerance) for tolerance in tolerances]
    if evaluation.device == "cuda" and gpu.has_gsplat():
        rows.append(gsplat_row(evaluation))
    return {"rows": rows}


def gsplat_row(evaluation: Evaluation) -> Row:
    """Return the row of gsplat, which draws every gaussian of the scene from world
    space."""
    import torch

    every_one = select(
        evaluation.full_scene,
        evaluation.camera_sweep[0].camera,
        tolerance=0.0,
        cull=False,
        device="cpu",
    )
    placed = every_one.gaussians(device="cuda")
    pictures, rows = [], []
    for view, ours in zip(evaluation.camera_sweep, evaluation.full_sweep, strict=True):
        with torch.no_grad():
            pictures.append(to_8bit(gpu.gsplat_picture(placed, view.camera, packed=True)[0]))
        timed = gpu.time_gsplat(placed, view.camera, evaluation.settings.repeats)
        rows.append({**ours.row("drawn"), **view.row(), **timed.row("drawn")})
    truths = (evaluation.truth(i) for i in range(len(rows)))
    errors = evaluation.judge.errors(zip(truths, pictures, strict=True))
    for row, error in zip(rows, errors, strict=True):
        row |= {f"drawn_{key}": value for key, value in error.items()}
    torch.cuda.empty_cache()
    return sweep_row(evaluation, "gsplat, full", 0.0, rows)


def tables(result: dict[str, Any]) -> str:
    return markdown(COLUMNS, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    by_name: dict[str, list[Row]] = {}
    for row in result["rows"]:
        by_name.setdefault(row["levels"], []).append(row)
    full = by_name["full"][0]
    good = [row for row in by_name["ours"] if row["drawn_flip"] <= full["drawn_flip"]]
    out = Summary()
    if good:
        best = max(good, key=lambda row: row["acceleration"])
        out.judge(
            best["acceleration"] > 1,
            f"our cut at tolerance {best['tolerance']:g} takes {best['drawn_ms']:.2f} ms where all "
            f"gaussians take {full['drawn_ms']:.2f} ms ({best['acceleration']:.1f} x), at FLIP "
            f"{best['drawn_flip']:.4f} against {full['drawn_flip']:.4f}",
        )
    else:
        out.judge(
            False,
            f"no tolerance of ours reaches the FLIP of all gaussians, {full['drawn_flip']:.4f}",
        )
    for paper in by_name["paper"]:
        rivals = [row for row in by_name["ours"] if row["drawn_flip"] <= paper["drawn_flip"]]
        if paper["tolerance"] == paper_tolerance(2048):
            quickest = min(rivals, key=lambda row: row["drawn_ms"], default=None)
            text = (
                f"the paper's levels at its tolerance of 2048 take {paper['drawn_ms']:.2f} ms at "
                f"FLIP {paper['drawn_flip']:.4f}"
            )
            if quickest is None:
                out.judge(False, f"{text}, which no tolerance of ours reaches")
            else:
                out.judge(
                    quickest["drawn_ms"] < paper["drawn_ms"],
                    f"{text}, ours {quickest['drawn_ms']:.2f} ms at {quickest['drawn_flip']:.4f}",
                )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, style in (("paper", "s--"), ("ours", "o-")):
        rows = [row for row in result["rows"] if row["levels"] == name]
        axes.plot([r["drawn_ms"] for r in rows], [r["drawn_flip"] for r in rows], style, label=name)
        for r in rows:
            axes.annotate(f"{r['tolerance']:g}", (r["drawn_ms"], r["drawn_flip"]), fontsize=7)
    for row in result["rows"]:
        if row["levels"] in ("full", "gsplat, full"):
            axes.plot(row["drawn_ms"], row["drawn_flip"], "*", markersize=12, label=row["levels"])
    axes.set(xlabel="ms a frame (mean over the distances)", ylabel="FLIP", xscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
