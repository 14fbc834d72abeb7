"""Against a hierarchy of single gaussians (H3DG; table 2 and figure 9), at equal numbers of gaussians."""

from __future__ import annotations

import time
from typing import Any

from v3dg.bench.hierarchy import HierarchyScene, build_hierarchy
from v3dg.bench.measure import Picture, Row, as_picture, draw_truth, time_ms, tolerance_for
from v3dg.bench.sheet import crop, sheet
from v3dg.bench.stage import Stage
from v3dg.bench.table import Column, markdown
from v3dg.bench.verdict import Verdict
from v3dg.rasterize import rasterize

TITLE = "Against a hierarchy of single gaussians"
ABOUT = (
    "Kerbl et al. 2024, from the published description, without the optimisation against photographs; a "
    "part of the main scene. Its cut for several sizes on screen, ours with at most as many gaussians; both "
    "cuts as plain arrays through the same rasterizer. Its selection and interpolation are array operations "
    "here, not a kernel, so compare the rasterizer's times first."
)

_TARGETS_PX = (1.0, 2.0, 4.0, 8.0, 16.0)


def run(stage: Stage) -> dict[str, Any]:
    built = stage.build()
    scene = stage.place(built.bundle, stage.settings.hierarchy_instances)
    start = time.perf_counter()
    hierarchy = build_hierarchy(stage.asset)
    build_seconds = time.perf_counter() - start
    theirs = HierarchyScene(hierarchy, scene, stage.device)
    view = stage.line[len(stage.line) // 2]
    truth = draw_truth(scene, view.camera, stage.device)
    rows: list[Row] = []
    pictures: list[tuple[Picture, Picture]] = []
    repeats = stage.settings.repeats
    for target_px in _TARGETS_PX:
        chosen = theirs.gaussians(theirs.cut(view.camera, target_px))
        tolerance = tolerance_for(scene, view.camera, len(chosen))
        ours = stage.shoot(scene, view, tolerance)
        picture = as_picture(rasterize(chosen, view.camera).color)
        raster = time_ms(lambda: rasterize(chosen, view.camera), stage.device, repeats)  # noqa: B023
        whole = time_ms(
            lambda: rasterize(theirs.gaussians(theirs.cut(view.camera, target_px)), view.camera),  # noqa: B023
            stage.device,
            repeats,
        )
        rows.append(
            {"target_px": target_px, "tolerance": round(tolerance, 4), "theirs_selected": len(chosen)}
            | raster.row("theirs_raster")
            | whole.row("theirs")
            | {"ours_raster_ms": round(ours.stats.draw_ms, 3)}
            | ours.row("ours")
        )
        pictures.append((picture, ours.picture))
    errors = iter(stage.judge.errors((truth, p) for both in pictures for p in both))
    for row in rows:
        for name in ("theirs", "ours"):
            row |= {f"{name}_{key}": value for key, value in next(errors).items()}
    side = stage.settings.panel
    stage.save(
        "hierarchy",
        sheet(
            [
                [
                    ("truth", crop(truth, side)),
                    (f"hierarchy, FLIP {row['theirs_flip']:.4f}", crop(their_picture, side)),
                    (f"ours, FLIP {row['ours_flip']:.4f}", crop(our_picture, side)),
                ]
                for row, (their_picture, our_picture) in list(zip(rows, pictures, strict=True))[1::2]
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


def verdict(result: dict[str, Any]) -> Verdict:
    out = Verdict()
    row = result["rows"][2]
    out.judge(
        row["ours_flip"] < row["theirs_flip"],
        f"at equal counts ({row['ours_selected']:,}) a hierarchy of single gaussians is at FLIP "
        f"{row['theirs_flip']:.4f}, ours at {row['ours_flip']:.4f}",
    )
    out.judge(
        result["ours_build_seconds"] <= result["theirs_build_seconds"],
        f"a hierarchy of single gaussians is built in {result['theirs_build_seconds']:.1f} s, our bundle in "
        f"{result['ours_build_seconds']:.1f} s",
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
