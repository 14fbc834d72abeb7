"""Steadiness: a zoom through the scene, and how much more a frame differs from the next than it has to."""

from __future__ import annotations

import itertools
import statistics
from typing import Any

import numpy as np

from v3dg.bench.measure import Picture, Row, as_picture, draw_truth
from v3dg.bench.sheet import crop, sheet
from v3dg.bench.stage import Stage, orbit_view
from v3dg.bench.table import Column, markdown
from v3dg.bench.verdict import Verdict
from v3dg.render import render
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "A zoom through the scene, and popping"
ABOUT = (
    "The camera comes nearer by half a per cent a frame. FLIP between a frame and the next, less that of "
    "the true pictures: what flickers or pops. The full scene at one sample a pixel flickers by aliasing "
    "alone."
)

_NEARER = 0.995


def run(stage: Stage) -> dict[str, Any]:
    scene = stage.place(stage.build().bundle)
    start = stage.line[-1]
    views = [
        orbit_view(start.azimuth, start.elevation, start.distance * _NEARER**k, stage.settings.size)
        for k in range(stage.settings.motion_frames)
    ]
    frames: dict[str, list[Picture]] = {
        "truth": [draw_truth(scene, view.camera, stage.device) for view in views]
    }
    for name, tolerance in (("full", 0.0), ("ours", DEFAULT_TOLERANCE)):
        frames[name] = [
            as_picture(render(scene, view.camera, tolerance=tolerance, device=stage.device).color)
            for view in views
        ]
    steps = {
        name: [e["flip"] for e in stage.judge.errors(itertools.pairwise(p))] for name, p in frames.items()
    }
    rows = [summary(name, steps[name], steps["truth"], steps["full"]) for name in ("truth", "full", "ours")]
    worst = int(np.argmax(np.array(steps["ours"]) - np.array(steps["truth"])))
    side = stage.settings.panel
    stage.save(
        "motion_worst",
        sheet(
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
    return {"nearer": _NEARER, "frames": len(views), "worst_pair": worst, "steps": steps, "rows": rows}


def difference(a: Picture, b: Picture) -> Picture:
    picture: Picture = np.minimum(4 * np.abs(a.astype(np.int16) - b), 255).astype(np.uint8)
    return picture


def summary(name: str, steps: list[float], truth: list[float], full: list[float]) -> Row:
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


def tables(result: dict[str, Any]) -> str:
    return markdown(_COLUMNS, result["rows"])


def verdict(result: dict[str, Any]) -> Verdict:
    _, full, ours = result["rows"]
    out = Verdict()
    out.judge(
        ours["above_truth"] <= full["above_truth"],
        f"in a zoom, consecutive frames of ours differ by FLIP {ours['above_truth']:+.4f} more than the "
        f"truth's do, those of the full scene by {full['above_truth']:+.4f}",
    )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    axes = figure.subplots()
    for name, steps in result["steps"].items():
        axes.plot(steps, label=name)
    axes.set(xlabel="frame", ylabel="FLIP to the next frame", ylim=(0, None))
    axes.legend()
    axes.grid(alpha=0.3)
