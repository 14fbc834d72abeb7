"""Local splatting (table 1 of the paper, upper half): how much the fit of the levels
improves them, by number of steps."""

from __future__ import annotations

from typing import Any

from benchmarks.evaluation.camera_sweep import COLUMNS, build_row, full_row
from benchmarks.evaluation.evaluation import PAPER_TOLERANCE, Evaluation
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.summary import Summary
from v3dg.levels import BuildConfig
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "What the fit gives"
ABOUT = (
    "Levels fitted with so many steps of Adam; \\*0 is the paper's start without growing scales. "
    "The paper's settings at its tolerance of 2048, ours at the default; build time is of the one "
    "asset."
)


def run(evaluation: Evaluation) -> dict[str, Any]:
    steps = evaluation.settings.steps
    rows = [
        full_row(evaluation),
        build_row(
            evaluation, "paper, *0", BuildConfig.paper(steps=0, prune_growth=1.0), PAPER_TOLERANCE
        ),
    ]
    rows += [
        build_row(evaluation, "paper", BuildConfig.paper(steps=n), PAPER_TOLERANCE) for n in steps
    ]
    ours = (*steps, BuildConfig().steps)
    rows += [build_row(evaluation, "ours", BuildConfig(steps=n), DEFAULT_TOLERANCE) for n in ours]
    return {"rows": rows}


def tables(result: dict[str, Any]) -> str:
    columns = (
        Column("levels", "levels"),
        Column("steps", "steps"),
        Column("build s", "build_seconds", ".2f"),
    )
    return markdown((*columns, *COLUMNS[2:]), result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    ours = [row for row in result["rows"] if row["levels"] == "ours"]
    unfitted, fitted = ours[0], ours[-1]
    out = Summary()
    out.judge(
        fitted["drawn_flip"] < unfitted["drawn_flip"],
        f"fitting our levels takes {fitted['build_seconds']:.1f} s of build instead of "
        f"{unfitted['build_seconds']:.1f} s and brings FLIP from {unfitted['drawn_flip']:.4f} to "
        f"{fitted['drawn_flip']:.4f}",
    )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, style in (("paper", "s--"), ("ours", "o-")):
        rows = [row for row in result["rows"] if row["levels"] == name]
        axes.plot(
            [r["build_seconds"] for r in rows], [r["drawn_flip"] for r in rows], style, label=name
        )
        for r in rows:
            axes.annotate(f"{r['steps']}", (r["build_seconds"], r["drawn_flip"]), fontsize=7)
    axes.axhline(result["rows"][0]["drawn_flip"], color="gray", linestyle=":", label="full")
    axes.set(xlabel="build, s", ylabel="FLIP", xscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
