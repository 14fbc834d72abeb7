"""Comparison with clipping at equal counts. Clipping omits gaussians that are small on
screen, like gsplat's `radius_clip`."""

from __future__ import annotations

from typing import Any

from benchmarks.evaluation.evaluation import Evaluation, View
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row, clip_radius_for, crop, screen_radii
from benchmarks.evaluation.summary import Summary
from v3dg.pictures import Picture, contact_sheet, to_8bit
from v3dg.rasterize import rasterize
from v3dg.select import select

TITLE = "Against clipping what is small"
ABOUT = (
    "gsplat's `radius_clip` leaves out gaussians whose radius on screen is small. The clip that "
    "leaves as many in the frustum as our cut has, by gsplat's rule, both drawn by our rasterizer."
)

_TOLERANCES = (3.0, 8.0, 16.0)


def run(evaluation: Evaluation) -> dict[str, Any]:
    scene = evaluation.place(evaluation.build().bundle)
    views = [len(evaluation.camera_sweep) // 2, len(evaluation.camera_sweep) - 1]
    rows: list[Row] = []
    pictures: list[tuple[Picture, Picture]] = []
    for index in views:
        view = evaluation.camera_sweep[index]
        for tolerance in _TOLERANCES:
            ours = evaluation.shoot(scene, view, tolerance)
            clip, count, picture = clipped(evaluation, view, ours.stats.gaussians_in_frustum)
            rows.append(
                {
                    **view.row(),
                    "view": index,
                    "tolerance": tolerance,
                    "clip_px": round(clip, 4),
                    "clipped_in_frustum": count,
                }
                | ours.row("ours")
            )
            pictures.append((ours.picture, picture))
    pairs = [
        (evaluation.truth(row["view"]), p)
        for row, both in zip(rows, pictures, strict=True)
        for p in both
    ]
    errors = iter(evaluation.judge.errors(pairs))
    for row in rows:
        for name in ("ours", "clipped"):
            row |= {f"{name}_{key}": value for key, value in next(errors).items()}
    side = evaluation.settings.panel
    evaluation.save(
        "clipping",
        contact_sheet(
            [
                [
                    ("truth", crop(evaluation.truth(row["view"]), side)),
                    (f"ours, FLIP {row['ours_flip']:.4f}", crop(ours_picture, side)),
                    (
                        f"clipped below {row['clip_px']:.2g} px, FLIP {row['clipped_flip']:.4f}",
                        crop(clipped_picture, side),
                    ),
                ]
                for row, (ours_picture, clipped_picture) in zip(rows, pictures, strict=True)
                if row["tolerance"] != _TOLERANCES[0]
            ]
        ),
    )
    return {"rows": rows}


def clipped(evaluation: Evaluation, view: View, count: int) -> tuple[float, int, Picture]:
    """Clip the full scene to at most this many gaussians in the picture.

    Returns:
        The clip radius in px, the number of gaussians, and the picture.
    """
    everything = select(evaluation.full_scene, view.camera, tolerance=0.0, device="cpu").gaussians(
        device=evaluation.device
    )
    radii = screen_radii(everything, view.camera)
    clip = clip_radius_for(radii, count)
    kept = radii > clip
    left = everything.subset(
        kept.nonzero()[0] if evaluation.device == "cpu" else kept.nonzero()[:, 0]
    )
    return clip, int(kept.sum()), to_8bit(rasterize(left, view.camera).color)


_TABLE = (
    Column("distance", "distance", ".3g"),
    Column("tolerance", "tolerance", "g"),
    Column("clip, px", "clip_px", ".2f"),
    Column("in frustum, ours", "ours_in_frustum", "count"),
    Column("clipped", "clipped_in_frustum", "count"),
    Column("FLIP, ours", "ours_flip", ".4f"),
    Column("clipped", "clipped_flip", ".4f"),
    Column("PSNR, ours", "ours_psnr", ".1f"),
    Column("clipped", "clipped_psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    return markdown(_TABLE, result["rows"])


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    row = max(result["rows"], key=lambda row: (row["distance"], row["tolerance"]))
    out.judge(
        row["ours_flip"] < row["clipped_flip"],
        f"with {row['ours_in_frustum']:,} gaussians in the frustum, clipping small gaussians has "
        f"FLIP {row['clipped_flip']:.4f}, our cut {row['ours_flip']:.4f}",
    )
    return out
