"""One large asset in a single tree, without instances (figure 12 of the paper), at
several distances."""

from __future__ import annotations

import math
from typing import Any

from benchmarks.evaluation.assets import many_copies
from benchmarks.evaluation.evaluation import Evaluation, View, close_distance
from benchmarks.evaluation.markdown import count_text, markdown
from benchmarks.evaluation.measure import crop
from benchmarks.evaluation.parts import composed
from benchmarks.evaluation.summary import Summary
from v3dg.cameras import Camera
from v3dg.levels import BuildConfig
from v3dg.metrics import draw_truth
from v3dg.pictures import contact_sheet
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "One large asset"
ABOUT = (
    "Copies of the asset side by side, turned and scaled at random, built and drawn as one asset; "
    "seen from ever farther away, at the default tolerance."
)

_ELEVATION = 45.0


def run(evaluation: Evaluation) -> dict[str, Any]:
    asset = many_copies(evaluation.asset, evaluation.settings.large_copies, seed=evaluation.seed)
    built = evaluation.build(BuildConfig(steps=evaluation.settings.large_steps), asset)
    center, distance = close_distance(asset)
    width, height = evaluation.settings.size
    rows, pairs, strips = [], [], []
    for d in range(evaluation.settings.distances):
        away = 2 * distance * (d + 1) / evaluation.settings.distances
        e = math.radians(_ELEVATION)
        eye = center + away * _direction(e)
        camera = Camera.look_at(eye, center, width=width, height=height, near=1e-3 * away)
        view = View(270.0, _ELEVATION, away, camera)
        full, ours = (evaluation.shoot(built.bundle, view, t) for t in (0.0, DEFAULT_TOLERANCE))
        truth = draw_truth(built.bundle, camera, evaluation.device)
        pairs += [(truth, full.picture), (truth, ours.picture)]
        rows.append({**view.row(), **full.row("full"), **ours.row("ours")})
    errors = iter(evaluation.judge.errors(pairs))
    for row in rows:
        for name in ("full", "ours"):
            row |= {f"{name}_{key}": value for key, value in next(errors).items()}
    side = evaluation.settings.panel
    for k in sorted({len(rows) // 4, len(rows) // 2, len(rows) - 1}):
        truth, full_picture, ours_picture = pairs[2 * k][0], pairs[2 * k][1], pairs[2 * k + 1][1]
        strips.append(
            [
                (f"truth, distance {rows[k]['distance']:.3g}", crop(truth, side)),
                (f"full, FLIP {rows[k]['full_flip']:.4f}", crop(full_picture, side)),
                (f"ours, FLIP {rows[k]['ours_flip']:.4f}", crop(ours_picture, side)),
            ]
        )
    evaluation.save("large", contact_sheet(strips))
    return {
        "tolerance": DEFAULT_TOLERANCE,
        "gaussians": len(asset),
        "steps": evaluation.settings.large_steps,
        "build_seconds": round(built.seconds, 2),
        "scenes": [{"scene": "one large asset", "views": rows}],
    }


def _direction(elevation: float) -> Any:
    import numpy as np

    return np.array([0.0, -math.cos(elevation), math.sin(elevation)])


def tables(result: dict[str, Any]) -> str:
    return (
        f"{count_text(result['gaussians'])} gaussians, built in {result['build_seconds']:.1f} s "
        f"with {result['steps']} steps.\n\n"
        + markdown(composed.COLUMNS, composed.by_distance(result["scenes"][0]))
    )


def summary(result: dict[str, Any]) -> Summary:
    return composed.summary(result)


plot = composed.plot
