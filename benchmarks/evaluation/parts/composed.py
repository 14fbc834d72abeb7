"""Composed scenes (figures 6 and 7 of the paper): the full assets against cuts of their
levels, from near to far."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from benchmarks.evaluation.evaluation import Evaluation, View
from benchmarks.evaluation.markdown import Column, count_text, markdown
from benchmarks.evaluation.measure import Row, crop
from benchmarks.evaluation.summary import Summary
from v3dg._judges import mean_of
from v3dg.metrics import draw_truth
from v3dg.pictures import Picture, contact_sheet
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE

TITLE = "Composed scenes"
ABOUT = (
    "Every gaussian at one sample a pixel against our cut at the default tolerance, same "
    "rasterizer. A row is a distance: the mean over directions and elevations; FLIP and PSNR over "
    "those of the first direction, against the full scene at twice the resolution, box-averaged."
)


def run(evaluation: Evaluation) -> Iterator[dict[str, Any]]:
    """Yield the results so far after each scene."""
    scenes: list[Row] = []
    for name, scene, views in evaluation.composed_scenes():
        rows, pictures = measure(evaluation, scene, views)
        evaluation.save(f"composed_{name}", pictures)
        gaussians = sum(
            len(bundle.level_gaussians(0)) * int((scene.instance_bundle == b).sum())
            for b, bundle in enumerate(scene.bundles)
        )
        scenes.append(
            {"scene": name, "instances": len(scene), "gaussians": gaussians, "views": rows}
        )
        yield {"tolerance": DEFAULT_TOLERANCE, "scenes": scenes}
    if not scenes:
        raise ValueError(
            f"--scenes: expected names of composed scenes, got {' '.join(evaluation.scenes)}"
        )


def measure(evaluation: Evaluation, scene: Scene, views: list[View]) -> tuple[list[Row], Picture]:
    azimuths = sorted({round(view.azimuth, 1) for view in views})[
        : evaluation.settings.judged_directions
    ]
    rows: list[Row] = []
    judged: list[tuple[int, Picture, Picture, Picture]] = []
    for view in views:
        full, ours = (
            evaluation.shoot(scene, view, tolerance, evaluation.settings.composed_repeats)
            for tolerance in (0.0, DEFAULT_TOLERANCE)
        )
        if round(view.azimuth, 1) in azimuths:
            truth = draw_truth(scene, view.camera, evaluation.device)
            judged.append((len(rows), truth, full.picture, ours.picture))
        rows.append({**view.row(), **full.row("full"), **ours.row("ours")})
    pairs = [(truth, picture) for _, truth, *both in judged for picture in both]
    errors = iter(evaluation.judge.errors(pairs))
    for index, *_ in judged:
        for name in ("full", "ours"):
            rows[index] |= {f"{name}_{key}": value for key, value in next(errors).items()}
    return rows, strips(rows, judged, evaluation.settings.panel)


def strips(
    rows: list[Row], judged: list[tuple[int, Picture, Picture, Picture]], side: int
) -> Picture:
    """Return pictures from near, middle and far: reference, full assets, and cut."""
    middle = sorted({rows[index]["elevation"] for index, *_ in judged})
    wanted = middle[len(middle) // 2]
    line = sorted(
        (entry for entry in judged if rows[entry[0]]["elevation"] == wanted),
        key=lambda entry: rows[entry[0]]["distance"],
    )
    chosen = [line[len(line) // 4], line[len(line) // 2], line[-1]]
    return contact_sheet(
        [
            [
                (f"truth, distance {row['distance']:.3g}", crop(truth, side)),
                *(
                    (
                        f"{name}: {count_text(row[f'{name}_in_frustum'])}, FLIP "
                        f"{row[f'{name}_flip']:.4f}",
                        crop(p, side),
                    )
                    for name, p in (("full", full), ("ours", ours))
                ),
            ]
            for index, truth, full, ours in chosen
            for row in [rows[index]]
        ]
    )


_NAMES = ("in_frustum", "ms", "least_ms", "flip", "psnr")


def by_distance(scene: Row) -> list[Row]:
    """Return means over directions and elevations for each distance."""
    groups: dict[float, list[Row]] = {}
    for row in scene["views"]:
        least = {f"{who}_least_ms": row[f"{who}_ms_range"][0] for who in ("full", "ours")}
        groups.setdefault(round(row["distance"], 3), []).append(row | least)
    columns = [f"{who}_{name}" for who in ("full", "ours") for name in _NAMES]
    return [{"distance": d, **mean_of(rows, *columns)} for d, rows in sorted(groups.items())]


COLUMNS = (
    Column("distance", "distance", ".3g"),
    Column("in frustum, full", "full_in_frustum", "count"),
    Column("ours", "ours_in_frustum", "count"),
    Column("ms, full", "full_ms", ".2f"),
    Column("ours", "ours_ms", ".2f"),
    Column("FLIP, full", "full_flip", ".4f"),
    Column("ours", "ours_flip", ".4f"),
    Column("PSNR, full", "full_psnr", ".1f"),
    Column("ours", "ours_psnr", ".1f"),
)


def tables(result: dict[str, Any]) -> str:
    return "\n\n".join(
        f"**{scene['scene']}**: {scene['instances']:,} instances, {count_text(scene['gaussians'])} "
        "gaussians\n\n" + markdown(COLUMNS, by_distance(scene))
        for scene in result["scenes"]
    )


OVERVIEW = (
    "Full is every gaussian at one sample a pixel, ours the cut at the default tolerance, both "
    "drawn by the same rasterizer. Mean is over all distances from near to far, far is the "
    "farthest. FLIP is the error against the full scene at twice the resolution: how different two "
    "pictures look to someone who flips between them, from 0 (not at all) to 1."
)
_OVERVIEW_COLUMNS = (
    Column("scene", "scene"),
    Column("gaussians", "gaussians", "count"),
    *(
        Column(f"{where}: {unit}, {who}" if who == "full" else who, f"{where}_{who}_{key}", form)
        for where in ("mean", "far")
        for key, unit, form in (("ms", "ms", ".2f"), ("flip", "FLIP", ".4f"))
        for who in ("full", "ours")
    ),
)


def overview(result: dict[str, Any]) -> str:
    """Return a table with two rows per scene: the mean over the distances, and the
    farthest view."""
    table = []
    for scene in result["scenes"]:
        rows = by_distance(scene)
        means = mean_of(
            rows, *(f"{who}_{key}" for who in ("full", "ours") for key in ("ms", "flip"))
        )
        table.append(
            {"scene": scene["scene"], "gaussians": scene["gaussians"]}
            | {f"mean_{key}": value for key, value in means.items()}
            | {f"far_{key}": value for key, value in rows[-1].items()}
        )
    return markdown(_OVERVIEW_COLUMNS, table)


def summary(result: dict[str, Any]) -> Summary:
    out = Summary()
    for scene in result["scenes"]:
        rows = by_distance(scene)
        far = rows[-1]
        text = (
            f"{scene['scene']} from its farthest camera: {far['ours_ms']:.2f} ms a frame instead "
            f"of {far['full_ms']:.2f} ({far['full_ms'] / far['ours_ms']:.1f} x) with FLIP "
            f"{far['ours_flip']:.4f} instead of {far['full_flip']:.4f}"
        )
        out.judge(far["ours_ms"] < far["full_ms"] and far["ours_flip"] <= far["full_flip"], text)
        blurred = max(rows, key=lambda row: row["ours_flip"] - row["full_flip"])
        if blurred["ours_flip"] > 1.02 * blurred["full_flip"]:
            out.losses.append(
                f"{scene['scene']} at distance {blurred['distance']:.3g}: FLIP "
                f"{blurred['ours_flip']:.4f} against {blurred['full_flip']:.4f} without levels "
                f"({blurred['ours_ms']:.2f} ms against {blurred['full_ms']:.2f})"
            )
        # The fastest frames are compared, because other work on the machine affects
        # them least.
        slower = [row for row in rows if row["ours_least_ms"] > 1.02 * row["full_least_ms"]]
        if slower:
            worst = max(slower, key=lambda row: row["ours_least_ms"] / row["full_least_ms"])
            out.losses.append(
                f"{scene['scene']} at distance {worst['distance']:.3g}: "
                f"{worst['ours_least_ms']:.2f} ms against {worst['full_least_ms']:.2f} without "
                "levels"
            )
    return out


def plot(result: dict[str, Any], figure: Any) -> None:
    scenes = result["scenes"]
    figure.set_size_inches(12, 3 * len(scenes))
    for axes, scene in zip(figure.subplots(len(scenes), 3, squeeze=False), scenes, strict=True):
        rows = by_distance(scene)
        x = [row["distance"] for row in rows]
        for who, style in (("full", "s--"), ("ours", "o-")):
            axes[0].plot(x, [row[f"{who}_in_frustum"] for row in rows], style, label=who)
            axes[1].plot(x, [1e3 / row[f"{who}_ms"] for row in rows], style, label=who)
            axes[2].plot(x, [row[f"{who}_flip"] for row in rows], style, label=who)
        for panel, label in zip(
            axes, ("gaussians in frustum", "frames a second", "FLIP"), strict=True
        ):
            panel.set(xlabel="distance", ylabel=label, ylim=(0, None), title=scene["scene"])
            panel.grid(alpha=0.3)
        axes[0].legend()
