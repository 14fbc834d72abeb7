"""Comparison with levels of the same asset that are only merged, not fitted: pairs
merged by their moments, and the output of other tools.

The other tools run beforehand on the asset of the evaluation. Their output is read from
the folder of peers, from files named <asset>_<tool>_<percent>.ply:

    splat-transform -g cpu -w donut.ply -d 50% peers/donut_splat-transform_50.ply
    splat-transform -g cpu -w donut.ply --decimate-adaptive 50% \\
        peers/donut_adaptive_50.ply
    node benchmarks/studies/spark_levels.mjs donut.ply peers 50 25 12.5 6.25 1

The file seconds.json in that folder has the duration of each run, such as
{"splat-transform": {"50": 1.0}}.
"""

from __future__ import annotations

import json
import math
import re
from typing import Any

import numpy as np

from benchmarks.evaluation.camera_sweep import build_row, full_row
from benchmarks.evaluation.evaluation import Evaluation
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row, tolerance_for
from benchmarks.evaluation.summary import Summary
from v3dg._judges import mean_of
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.io import read_asset
from v3dg.levels import BuildConfig
from v3dg.metrics import draw_truth, psnr
from v3dg.pictures import Picture, to_8bit
from v3dg.rasterize import rasterize
from v3dg.render import render
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE, select

TITLE = "Against merging alone"
ABOUT = (
    "Levels of which each is the one below, merged in pairs by their moments (our own start, not "
    "fitted), and the same tree fitted: equal counts at every tolerance. Where other tools' files "
    "are given, also those, one asset alone: at the size at which our cut has as many gaussians as "
    "they left, and enlarged."
)

_TOLERANCES = (1.0, 3.0, 8.0, 16.0)
_VIEWS = 8
_FOV = math.radians(50)
_LARGE_PX = 400


def run(evaluation: Evaluation) -> dict[str, Any]:
    rows = [full_row(evaluation)]
    for tolerance in _TOLERANCES:
        rows.append(build_row(evaluation, "merged", BuildConfig(steps=0), tolerance))
        rows.append(build_row(evaluation, "ours", BuildConfig(), tolerance))
    return {"rows": rows, "peers": [] if evaluation.peers is None else peer_rows(evaluation)}


def peer_rows(evaluation: Evaluation) -> list[Row]:
    assert evaluation.peers is not None
    seconds_path = evaluation.peers / "seconds.json"
    seconds = json.loads(seconds_path.read_text(encoding="utf-8")) if seconds_path.exists() else {}
    bundle = evaluation.build().bundle
    rows = []
    for path in sorted(evaluation.peers.glob(f"{evaluation.asset_name}_*.ply")):
        found = re.fullmatch(rf"{re.escape(evaluation.asset_name)}_(.+)_([0-9.]+)", path.stem)
        if found is None:
            raise ValueError(
                f"{path}: expected a name like {evaluation.asset_name}_TOOL_50.ply; rename the "
                "file or move it out of the folder"
            )
        tool, percent = found.groups()
        theirs = read_asset(path)
        footprint = footprint_of_cut(bundle, len(theirs))
        row: Row = {
            "tool": tool,
            "percent": float(percent),
            "seconds": seconds.get(tool, {}).get(percent),
            "theirs_gaussians": len(theirs),
        }
        for where, px2 in (("cut", footprint), ("large", None)):
            errors = compare(evaluation, bundle, theirs, px2)
            row |= {f"{where}_{name}": value for name, value in errors.items()}
        rows.append(row)
    return sorted(rows, key=lambda row: (row["tool"], -row["percent"]))


def view_camera(bundle: Bundle, view: int, footprint_px2: float | None) -> Camera:
    """Return a camera around the asset. Its picture has the large size or, if a
    footprint is given, the size at which the asset's ball covers that many px²."""
    means = bundle.level_gaussians(0).means
    center = (means.min(axis=0) + means.max(axis=0)).astype(np.float64) / 2
    radius = float(np.linalg.norm(means - center, axis=1).max())
    # Directions form a spiral on the sphere, from 50 degrees below the horizon to 50
    # degrees above.
    z = 0.77 * (2 * (view + 0.5) / _VIEWS - 1)
    angle = math.pi * (3 - math.sqrt(5)) * view
    side = math.sqrt(1 - z * z)
    direction = np.array([side * math.cos(angle), side * math.sin(angle), z])
    fov, size = _FOV, _LARGE_PX
    distance = 1.05 * radius / math.sin(fov / 2)
    if footprint_px2 is not None:
        x2 = (radius / distance) ** 2
        focal = math.sqrt(footprint_px2 / (2 * math.pi * x2 / (1 + math.sqrt(1 - x2))))
        size = math.ceil(2 * focal * math.tan(fov / 2))
        fov = 2 * math.atan(size / (2 * focal))
    eye = center + distance * direction
    return Camera.look_at(eye, center, fov_x=fov, width=size, height=size, near=1e-3 * distance)


def footprint_of_cut(bundle: Bundle, count: int) -> float:
    """Return the footprint in px² of the asset's ball at which the default cut has
    `count` gaussians on average over the views."""
    scene = Scene.of(bundle)
    low, high = 1.0, 64.0 * count
    for _ in range(24):
        middle = math.sqrt(low * high)
        cameras = [view_camera(bundle, view, middle) for view in range(_VIEWS)]
        mean = np.mean(
            [
                select(scene, c, tolerance=DEFAULT_TOLERANCE, device="cpu").num_gaussians
                for c in cameras
            ]
        )
        low, high = (middle, high) if mean <= count else (low, middle)
    return low


def compare(
    evaluation: Evaluation, bundle: Bundle, theirs: Any, footprint_px2: float | None
) -> Row:
    """Return FLIP and PSNR, averaged over the views, of three pictures: all gaussians,
    `theirs`, and our cut with at most as many gaussians as `theirs`."""
    scene = Scene.of(bundle)
    coarser = bundle.level_range(1)[0] if bundle.num_levels > 1 else 0
    own_filter = (
        float(bundle.clusters.filter_px2[coarser]),
        bool(bundle.clusters.antialiased[coarser]),
    )
    pairs: list[tuple[Picture, Picture]] = []
    counts = []
    for view in range(_VIEWS):
        camera = view_camera(bundle, view, footprint_px2)
        truth = draw_truth(bundle, camera, "cpu")
        ours = render(
            bundle, camera, tolerance=tolerance_for(scene, camera, len(theirs)), device="cpu"
        )
        counts.append(ours.stats.gaussians_selected)
        # The level of the other tool is drawn without a filter, like the asset, and
        # with our filter; the better picture counts.
        drawn = [
            to_8bit(rasterize(theirs, camera, filter_px2=px2, antialiased=compensated).color)
            for px2, compensated in ((0.0, False), own_filter)
        ]
        their_best = max(drawn, key=lambda p: psnr(truth / np.float32(255), p / np.float32(255)))
        full = to_8bit(render(bundle, camera, tolerance=0.0, device="cpu").color)
        pairs += [(truth, full), (truth, their_best), (truth, to_8bit(ours.color))]
    errors = evaluation.judge.errors(pairs)
    row: Row = {"size_px": camera.width, "ours_gaussians": float(np.mean(counts))}
    for k, who in enumerate(("full", "theirs", "ours")):
        row |= {
            f"{who}_{key}": value for key, value in mean_of(errors[k::3], "flip", "psnr").items()
        }
    return row


_COLUMNS = (
    Column("levels", "levels"),
    Column("tolerance", "tolerance", "g"),
    Column("build s", "build_seconds", ".2f"),
    Column("in frustum", "drawn_in_frustum", "count"),
    Column("ms", "drawn_ms", ".2f"),
    Column("FLIP", "drawn_flip", ".4f"),
    Column("PSNR", "drawn_psnr", ".2f"),
)
_PEER_COLUMNS = (
    Column("tool", "tool"),
    Column("kept %", "percent", "g"),
    Column("its seconds", "seconds", ".1f"),
    Column("gaussians", "theirs_gaussians", "count"),
    Column("ours", "cut_ours_gaussians", "count"),
    Column("*cut*: px", "cut_size_px"),
    Column("FLIP, full", "cut_full_flip", ".4f"),
    Column("theirs", "cut_theirs_flip", ".4f"),
    Column("ours", "cut_ours_flip", ".4f"),
    Column("PSNR, theirs", "cut_theirs_psnr", ".1f"),
    Column("ours", "cut_ours_psnr", ".1f"),
    Column("*large*: FLIP, theirs", "large_theirs_flip", ".4f"),
    Column("ours", "large_ours_flip", ".4f"),
    Column("PSNR, theirs", "large_theirs_psnr", ".1f"),
    Column("ours", "large_ours_psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    text = markdown(_COLUMNS, result["rows"])
    if result["peers"]:
        text += "\n\n" + markdown(_PEER_COLUMNS, result["peers"])
    return text


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    merged, ours = (
        next(r for r in result["rows"] if r["levels"] == name and r["tolerance"] == 8.0)
        for name in ("merged", "ours")
    )
    out.judge(
        ours["drawn_flip"] < merged["drawn_flip"],
        f"at tolerance 8, levels that are only merged have FLIP {merged['drawn_flip']:.4f}, fitted "
        f"ones with as many gaussians {ours['drawn_flip']:.4f}; the fit costs "
        f"{ours['build_seconds'] - merged['build_seconds']:.1f} s of build",
    )
    for tool in sorted({row["tool"] for row in result["peers"]}):
        rows = [row for row in result["peers"] if row["tool"] == tool]
        for where, text in (
            ("cut", "at the size at which the level is drawn"),
            ("large", f"enlarged to {_LARGE_PX} px"),
        ):
            won = [row for row in rows if row[f"{where}_ours_flip"] < row[f"{where}_theirs_flip"]]
            lost = [row for row in rows if row not in won]
            if won:
                out.wins.append(
                    f"against {tool}, {text}: our FLIP is lower with {percents(won)} kept"
                )
            if lost:
                out.losses.append(
                    f"against {tool}, {text}: our FLIP is higher with {percents(lost)} kept"
                )
    return out


def percents(rows: list[Row]) -> str:
    return ", ".join(f"{row['percent']:g} %" for row in rows)


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, style in (("merged", "s--"), ("ours", "o-")):
        rows = [row for row in result["rows"] if row["levels"] == name]
        axes.plot(
            [r["drawn_in_frustum"] for r in rows],
            [r["drawn_flip"] for r in rows],
            style,
            label=name,
        )
    full = result["rows"][0]
    axes.plot(full["drawn_in_frustum"], full["drawn_flip"], "*", markersize=12, label="full")
    axes.set(xlabel="gaussians in frustum", ylabel="FLIP", xscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
