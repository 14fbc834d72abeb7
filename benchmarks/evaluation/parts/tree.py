"""Tree or DAG (table 3 of the paper): gaussians per cluster and clusters per group,
with 8,192 gaussians per group in all cases."""

from __future__ import annotations

from typing import Any

from benchmarks.evaluation.camera_sweep import COLUMNS, as_many_row, build_row, full_row
from benchmarks.evaluation.evaluation import PAPER_TOLERANCE, Evaluation
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.summary import Summary
from v3dg.levels import BuildConfig
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "Tree or DAG"
ABOUT = (
    "The paper's settings with smaller clusters and larger groups (a DAG, where groups mix "
    "clusters of several branches), at its tolerance; and our default, a tree of small clusters."
)

_SHAPES = ((256, 32), (512, 16), (1024, 8), (2048, 4), (4096, 2))


def run(evaluation: Evaluation) -> dict[str, Any]:
    rows = [full_row(evaluation)]
    for cluster_size, group_size in _SHAPES:
        config = BuildConfig.paper(
            cluster_size=cluster_size,
            group_size=group_size,
            min_clusters=group_size,
            steps=evaluation.settings.tree_steps,
        )
        rows.append(
            build_row(evaluation, f"{cluster_size} x {group_size}", config, PAPER_TOLERANCE)
        )
    ours = BuildConfig()
    name = f"ours, {ours.cluster_size} x {ours.group_size}"
    rows.append(build_row(evaluation, name, ours, DEFAULT_TOLERANCE))
    rows.append(as_many_row(evaluation, "ours, as many as 4096 x 2", ours, rows[len(_SHAPES)]))
    return {"rows": rows}


def tables(result: dict[str, Any]) -> str:
    columns = (Column("cluster x group", "levels"), Column("build s", "build_seconds", ".2f"))
    return markdown((*columns, *COLUMNS[2:]), result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    shapes = [row for row in result["rows"][1:] if not row["levels"].startswith("ours")]
    ours, rival = result["rows"][-1], shapes[-1]
    flips = [row["drawn_flip"] for row in shapes]
    out = Summary()
    out.judge(
        ours["drawn_flip"] < rival["drawn_flip"],
        f"tree or DAG makes little difference to the paper's settings (FLIP {min(flips):.4f} to "
        f"{max(flips):.4f}); its tree has FLIP {rival['drawn_flip']:.4f} and "
        f"{rival['drawn_psnr']:.1f} dB, ours with as many gaussians {ours['drawn_flip']:.4f} and "
        f"{ours['drawn_psnr']:.1f} dB",
    )
    return out
