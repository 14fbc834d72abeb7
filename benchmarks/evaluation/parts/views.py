"""Original views (table 5 of the paper). These are close views, as in training. Levels
must lose nothing there."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.evaluation.evaluation import Evaluation, View, close_distance
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row
from benchmarks.evaluation.summary import Summary
from v3dg._judges import mean_of
from v3dg.bundle import Bundle
from v3dg.cameras import turntable
from v3dg.metrics import draw_truth
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "Original views"
ABOUT = (
    "Assets that fill the picture, as in the views that assets are trained for, from all sides: "
    "our cut against the full asset, of which it should be no different, and both against the "
    "asset at twice the resolution."
)

_ELEVATION = 30.0
_NOTICED_DB = 0.01


def run(evaluation: Evaluation) -> dict[str, Any]:
    return {
        "tolerance": DEFAULT_TOLERANCE,
        "rows": [row_of(evaluation, name, bundle) for name, bundle in evaluation.close_bundles()],
    }


def row_of(evaluation: Evaluation, name: str, bundle: Bundle) -> Row:
    asset = bundle.level_gaussians(0)
    center, distance = close_distance(asset)
    side = evaluation.settings.close_px
    cameras = turntable(
        center,
        distance,
        evaluation.settings.close_views,
        math.radians(_ELEVATION),
        width=side,
        height=side,
        near=1e-3 * distance,
    )
    rows = []
    for camera in cameras:
        view = View(0.0, _ELEVATION, distance, camera)
        full, ours = (
            evaluation.shoot(bundle, view, tolerance) for tolerance in (0.0, DEFAULT_TOLERANCE)
        )
        truth = draw_truth(bundle, camera, evaluation.device)
        same, of_full, of_ours = evaluation.judge.errors(
            ((full.picture, ours.picture), (truth, full.picture), (truth, ours.picture))
        )
        row = {**full.row("full"), **ours.row("ours"), "psnr_to_full": same["psnr"]}
        row |= {"full_psnr": of_full["psnr"], "ours_psnr": of_ours["psnr"]}
        rows.append(row)
    means = mean_of(
        rows,
        "full_in_frustum",
        "ours_in_frustum",
        "full_ms",
        "ours_ms",
        "psnr_to_full",
        "full_psnr",
        "ours_psnr",
    )
    return {
        "asset": name,
        "gaussians": len(asset),
        "views": len(rows),
        "same_pictures": sum(row["psnr_to_full"] is None for row in rows),
        "share": round(means["ours_in_frustum"] / means["full_in_frustum"], 4),
        "acceleration": round(means["full_ms"] / means["ours_ms"], 3),
        **means,
    }


_COLUMNS = (
    Column("asset", "asset"),
    Column("gaussians", "gaussians", "count"),
    Column("share drawn", "share", ".1%"),
    Column("ms, full", "full_ms", ".2f"),
    Column("ours", "ours_ms", ".2f"),
    Column("acceleration", "acceleration", ".2f"),
    Column("PSNR, full", "full_psnr", ".2f"),
    Column("ours", "ours_psnr", ".2f"),
    Column("ours to full", "psnr_to_full", ".1f"),
    Column("views", "views"),
    Column("equal to the bit", "same_pictures"),
)


def tables(result: dict[str, Any]) -> str:
    return markdown(_COLUMNS, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    worst = max(result["rows"], key=_drop)
    out.judge(
        _drop(worst) <= _NOTICED_DB,
        f"in close views, {min(row['share'] for row in result['rows']):.0%} or more of an asset's "
        f"gaussians are drawn; PSNR falls by at most {max(0.0, _drop(worst)):.2f} dB "
        f"({worst['asset']})",
    )
    return out


def _drop(row: Row) -> float:
    """Return the PSNR that the cut loses against the full asset, in dB."""
    return float(row["full_psnr"] - row["ours_psnr"])
