"""Steadiness: the changes between consecutive frames of a zoom through the scene,
beyond those of the reference."""

from __future__ import annotations

import itertools
import statistics
from typing import Any

import numpy as np

from benchmarks.evaluation.evaluation import Evaluation, orbit_view
from benchmarks.evaluation.markdown import Column, markdown
from benchmarks.evaluation.measure import Row, crop
from benchmarks.evaluation.steadiness import Cut, compare, paths_from
from benchmarks.evaluation.summary import Summary
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, contact_sheet, to_8bit
from v3dg.render import render
from v3dg.select import DEFAULT_FADE, DEFAULT_TOLERANCE

TITLE = "A zoom through the scene, and popping"
ABOUT = (
    "The camera comes nearer by half a per cent a frame. FLIP between a frame and the next, less "
    "that of the true pictures: what flickers or pops. The full scene at one sample a pixel "
    "flickers by aliasing alone. This mean over whole pictures cannot see a single cluster that is "
    "replaced at once; docs/fades.md measures that."
)
_DRIFT = (
    "The camera comes nearer by a twentieth of a per cent a frame. Of each frame and the next the "
    "tile of 16 px in which the error changes most, root mean square in 255ths: what is seen of a "
    "cluster's exchange."
)

_NEARER = 0.995


def run(evaluation: Evaluation) -> dict[str, Any]:
    scene = evaluation.place(evaluation.build().bundle)
    start = evaluation.camera_sweep[-1]
    views = [
        orbit_view(
            start.azimuth, start.elevation, start.distance * _NEARER**k, evaluation.settings.size
        )
        for k in range(evaluation.settings.motion_frames)
    ]
    frames: dict[str, list[Picture]] = {
        "truth": [draw_truth(scene, view.camera, evaluation.device) for view in views]
    }
    for name, tolerance in (("full", 0.0), ("ours", DEFAULT_TOLERANCE)):
        frames[name] = [
            to_8bit(render(scene, view.camera, tolerance=tolerance, device=evaluation.device).color)
            for view in views
        ]
    steps = {
        name: [e["flip"] for e in evaluation.judge.errors(itertools.pairwise(p))]
        for name, p in frames.items()
    }
    rows = [
        steps_row(name, steps[name], steps["truth"], steps["full"])
        for name in ("truth", "full", "ours")
    ]
    worst = int(np.argmax(np.array(steps["ours"]) - np.array(steps["truth"])))
    side = evaluation.settings.panel
    evaluation.save(
        "motion_worst",
        contact_sheet(
            [
                [
                    (f"{name}, frame {worst}", crop(p[worst], side)),
                    (f"frame {worst + 1}", crop(p[worst + 1], side)),
                    ("difference x 4", crop(difference(p[worst], p[worst + 1]), side)),
                ]
                for name, p in frames.items()
            ]
        ),
    )
    drift = paths_from(start.camera, np.zeros(3), evaluation.settings.motion_frames)[0]
    cuts: dict[str, Cut] = {
        "full": {"tolerance": 0.0},
        "ours": {},
        "ours, fading": {"fade": DEFAULT_FADE},
    }
    return {
        "nearer": _NEARER,
        "frames": len(views),
        "worst_pair": worst,
        "steps": steps,
        "rows": rows,
        "drift": compare(scene, drift, cuts, evaluation.device),
    }


def difference(a: Picture, b: Picture) -> Picture:
    picture: Picture = np.minimum(4 * np.abs(a.astype(np.int16) - b), 255).astype(np.uint8)
    return picture


def steps_row(name: str, steps: list[float], truth: list[float], full: list[float]) -> Row:
    above = [step - own for step, own in zip(steps, truth, strict=True)]
    return {
        "frames": name,
        "step_flip": round(statistics.fmean(steps), 5),
        "above_truth": round(statistics.fmean(above), 5),
        "worst_above_truth": round(max(above), 5),
        "above_full": round(statistics.fmean(s - f for s, f in zip(steps, full, strict=True)), 5),
    }


_COLUMNS = (
    Column("frames", "frames"),
    Column("FLIP to the next", "step_flip", ".4f"),
    Column("less the truth's", "above_truth", "+.4f"),
    Column("the worst pair", "worst_above_truth", "+.4f"),
    Column("less the full scene's own (popping)", "above_full", "+.4f"),
)


_DRIFT_COLUMNS = (
    Column("drift", "cut"),
    Column("gaussians", "gaussians", ",.0f"),
    Column("worst tile, mean", "tile_mean", ".2f"),
    Column("99 %", "tile_p99", ".2f"),
    Column("worst", "tile_worst", ".2f"),
    Column("PSNR", "psnr", ".2f"),
)


def tables(result: dict[str, Any]) -> str:
    zoom = markdown(_COLUMNS, result["rows"])
    if "drift" not in result:  # older recordings have no drift
        return zoom
    return "\n\n".join([zoom, _DRIFT, markdown(_DRIFT_COLUMNS, result["drift"])])


def summary(result: dict[str, Any]) -> Summary:
    _, full, ours = result["rows"]
    out = Summary()
    out.judge(
        ours["above_truth"] <= full["above_truth"],
        f"in a zoom, the FLIP between consecutive frames differs from the truth's by "
        f"{ours['above_truth']:+.4f} for our cut and by {full['above_truth']:+.4f} for the full "
        "scene",
    )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, steps in result["steps"].items():
        axes.plot(steps, label=name)
    axes.set(xlabel="frame", ylabel="FLIP to the next frame", ylim=(0, None))
    axes.legend()
    axes.grid(alpha=0.3)
