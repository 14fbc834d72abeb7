"""One large asset (figure 12), over the distances: no instances, one tree."""

from __future__ import annotations

import math
from typing import Any

from v3dg.bench.assets import many_copies
from v3dg.bench.measure import draw_truth
from v3dg.bench.parts import composed
from v3dg.bench.sheet import crop, sheet
from v3dg.bench.stage import Stage, View, close_distance
from v3dg.bench.table import count_text, markdown
from v3dg.bench.verdict import Verdict
from v3dg.build import BuildConfig
from v3dg.cameras import Camera
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "One large asset"
ABOUT = (
    "Copies of the asset side by side, turned and scaled at random, built and drawn as one asset; seen from "
    "ever farther away, at the default tolerance."
)

_ELEVATION = 45.0


def run(stage: Stage) -> dict[str, Any]:
    asset = many_copies(stage.asset, stage.settings.large_copies, seed=stage.seed)
    built = stage.build(BuildConfig(steps=stage.settings.large_steps), asset)
    center, distance = close_distance(asset)
    width, height = stage.settings.size
    rows, pairs, strips = [], [], []
    for d in range(stage.settings.distances):
        away = 2 * distance * (d + 1) / stage.settings.distances
        e = math.radians(_ELEVATION)
        eye = center + away * _direction(e)
        camera = Camera.look_at(eye, center, width=width, height=height, near=1e-3 * away)
        view = View(270.0, _ELEVATION, away, camera)
        full, ours = (stage.shoot(built.bundle, view, t) for t in (0.0, DEFAULT_TOLERANCE))
        truth = draw_truth(built.bundle, camera, stage.device)
        pairs += [(truth, full.picture), (truth, ours.picture)]
        rows.append({**view.row(), **full.row("full"), **ours.row("ours")})
    errors = iter(stage.judge.errors(pairs))
    for row in rows:
        for name in ("full", "ours"):
            row |= {f"{name}_{key}": value for key, value in next(errors).items()}
    side = stage.settings.panel
    for k in sorted({len(rows) // 4, len(rows) // 2, len(rows) - 1}):
        truth, full_picture, ours_picture = pairs[2 * k][0], pairs[2 * k][1], pairs[2 * k + 1][1]
        strips.append(
            [
                (f"truth, distance {rows[k]['distance']:.3g}", crop(truth, side)),
                (f"full, FLIP {rows[k]['full_flip']:.4f}", crop(full_picture, side)),
                (f"ours, FLIP {rows[k]['ours_flip']:.4f}", crop(ours_picture, side)),
            ]
        )
    stage.save("large", sheet(strips))
    return {
        "tolerance": DEFAULT_TOLERANCE,
        "gaussians": len(asset),
        "steps": stage.settings.large_steps,
        "build_seconds": round(built.seconds, 2),
        "scenes": [{"scene": "one large asset", "views": rows}],
    }


def _direction(elevation: float) -> Any:
    import numpy as np

    return np.array([0.0, -math.cos(elevation), math.sin(elevation)])


def tables(result: dict[str, Any]) -> str:
    return (
        f"{count_text(result['gaussians'])} gaussians, built in {result['build_seconds']:.1f} s with "
        f"{result['steps']} steps.\n\n"
        + markdown(composed.COLUMNS, composed.by_distance(result["scenes"][0]))
    )


def verdict(result: dict[str, Any]) -> Verdict:
    return composed.verdict(result)


plot = composed.plot
