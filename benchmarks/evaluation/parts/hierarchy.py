"""Comparison with a hierarchy of single gaussians (H3DG; table 2 and figure 9 of the
paper) at equal numbers of gaussians."""

from __future__ import annotations

import time
from typing import Any

from benchmarks.evaluation.evaluation import Evaluation
from benchmarks.evaluation.hierarchy import HierarchyScene, build_hierarchy
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row, crop, time_ms, tolerance_for
from benchmarks.evaluation.summary import Summary
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, contact_sheet, to_8bit
from v3dg.rasterize import rasterize

TITLE = "Against a hierarchy of single gaussians"
ABOUT = (
    "Kerbl et al. 2024, from the published description, without the optimisation against "
    "photographs; a part of the main scene. Its cut for several sizes on screen, ours with at most "
    "as many gaussians; both cuts as plain arrays through the same rasterizer. Its selection and "
    "interpolation are array operations here, not a kernel, so compare the rasterizer's times "
    "first."
)

_TARGETS_PX = (1.0, 2.0, 4.0, 8.0, 16.0)


def run(evaluation: Evaluation) -> dict[str, Any]:
    built = evaluation.build()
    scene = evaluation.place(built.bundle, evaluation.settings.hierarchy_instances)
    start = time.perf_counter()
    hierarchy = build_hierarchy(evaluation.asset)
    build_seconds = time.perf_counter() - start
    theirs = HierarchyScene(hierarchy, scene, evaluation.device)
    view = evaluation.camera_sweep[len(evaluation.camera_sweep) // 2]
    truth = draw_truth(scene, view.camera, evaluation.device)
    rows: list[Row] = []
    pictures: list[tuple[Picture, Picture]] = []
    repeats = evaluation.settings.repeats
    for target_px in _TARGETS_PX:
        chosen = theirs.gaussians(theirs.cut(view.camera, target_px))
        tolerance = tolerance_for(scene, view.camera, len(chosen))
        ours = evaluation.shoot(scene, view, tolerance)
        picture = to_8bit(rasterize(chosen, view.camera).color)
        raster = time_ms(lambda: rasterize(chosen, view.camera), evaluation.device, repeats)  # noqa: B023
        whole = time_ms(
            lambda: rasterize(theirs.gaussians(theirs.cut(view.camera, target_px)), view.camera),  # noqa: B023
            evaluation.device,
            repeats,
        )
        rows.append(
            {
                "target_px": target_px,
                "tolerance": round(tolerance, 4),
                "theirs_selected": len(chosen),
            }
            | raster.row("theirs_raster")
            | whole.row("theirs")
            | {"ours_raster_ms": round(ours.stats.draw_ms, 3)}
            | ours.row("ours")
        )
        pictures.append((picture, ours.picture))
    errors = iter(evaluation.judge.errors((truth, p) for both in pictures for p in both))
    for row in rows:
        for name in ("theirs", "ours"):
            row |= {f"{name}_{key}": value for key, value in next(errors).items()}
    side = evaluation.settings.panel
    evaluation.save(
        "hierarchy",
        contact_sheet(
            [
                [
                    ("truth", crop(truth, side)),
                    (f"hierarchy, FLIP {row['theirs_flip']:.4f}", crop(their_picture, side)),
                    (f"ours, FLIP {row['ours_flip']:.4f}", crop(our_picture, side)),
                ]
                for row, (their_picture, our_picture) in list(zip(rows, pictures, strict=True))[
                    1::2
                ]
            ]
        ),
    )
    return {
        **view.row(),
        "instances": len(scene),
        "ours_build_seconds": round(built.seconds, 3),
        "theirs_build_seconds": round(build_seconds, 3),
        "theirs_build_device": "cpu",
        "rows": rows,
    }


_COLUMNS = (
    Column("target, px", "target_px", "g"),
    Column("gaussians, hierarchy", "theirs_selected", "count"),
    Column("ours", "ours_selected", "count"),
    Column("rasterize ms, hierarchy", "theirs_raster_ms", ".2f"),
    Column("ours", "ours_raster_ms", ".2f"),
    Column("whole ms, hierarchy", "theirs_ms", ".2f"),
    Column("ours", "ours_ms", ".2f"),
    Column("FLIP, hierarchy", "theirs_flip", ".4f"),
    Column("ours", "ours_flip", ".4f"),
    Column("PSNR, hierarchy", "theirs_psnr", ".1f"),
    Column("ours", "ours_psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    builds = (
        f"Build: ours {result['ours_build_seconds']:.2f} s on {result['device']}, the hierarchy "
        f"{result['theirs_build_seconds']:.2f} s on {result['theirs_build_device']}."
    )
    return builds + "\n\n" + markdown(_COLUMNS, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    row = result["rows"][2]
    out.judge(
        row["ours_flip"] < row["theirs_flip"],
        f"a hierarchy of single gaussians has FLIP {row['theirs_flip']:.4f} with "
        f"{row['theirs_selected']:,.0f} gaussians, our cut {row['ours_flip']:.4f} with "
        f"{row['ours_selected']:,.0f}",
    )
    out.judge(
        result["ours_build_seconds"] <= result["theirs_build_seconds"],
        f"a hierarchy of single gaussians is built in {result['theirs_build_seconds']:.1f} s, our "
        f"bundle in {result['ours_build_seconds']:.1f} s",
    )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for who, style in (("theirs", "s--"), ("ours", "o-")):
        axes.plot(
            [row[f"{who}_selected"] for row in result["rows"]],
            [row[f"{who}_flip"] for row in result["rows"]],
            style,
            label="hierarchy" if who == "theirs" else who,
        )
    axes.set(xlabel="gaussians", ylabel="FLIP", xscale="log")
    axes.legend()
    axes.grid(alpha=0.3)
