"""The page of `peers`: tables of times, errors and memory, from one or more recorded
results.

    python -m benchmarks.studies.peers.report peers.json -o docs/notes/peers.md

"Ours" is the faster of `v3dg.Renderer` and `v3dg.rasterize` in the same row, if both
were measured.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.evaluation.markdown import Column, markdown

Row = dict[str, Any]

_OURS, _LIKE_GSPLAT = "v3dg", "v3dg, 1e-4"
_ABOUT = """# Note: other rasterizers

Written by `python -m benchmarks.studies.peers.report` from recorded JSON, never by hand.

All draw the same gaussians, whole, in processes that follow each other on one {gpu}. A time is the median of
single calls, from an idle device to an idle device, Python included. PSNR is to float64, in eight windows of
{window} px; gigabytes are what the process has on the device, its gaussians included. In each row gsplat is
the quicker of its packed and unpacked modes, ours the quicker of `Renderer` and `rasterize`. The filter is
the variance, in px², that is added on the screen: 0.3 as assets are trained, 0 for instances. At *1e-4* our
pixels stop where everyone's do.

{peers}
"""


@dataclass
class Report:
    results: tyro.conf.Positional[tuple[Path, ...]]
    """Output files of `peers`; if a row is in several files, the last one counts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("peers.md")


def family(row: Row) -> str:
    """Return the renderer of a row. All modes of a renderer have the same name."""
    if row["renderer"].startswith(_OURS):
        return _LIKE_GSPLAT if row["renderer"].endswith("1e-4") else _OURS
    return str(row["renderer"]).replace(" packed", "")


def quickest(rows: list[Row], key: tuple[str, ...]) -> dict[tuple[Any, ...], dict[str, Row]]:
    """Return the fastest row of every renderer for each picture."""
    found: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        if row["job"].endswith("again"):
            continue
        everyone = found.setdefault(tuple(row[name] for name in key), {})
        mine = everyone.get(family(row))
        if mine is None or row["ms"] < mine["ms"]:
            everyone[family(row)] = row
    return found


def ratio(everyone: dict[str, Row]) -> float | None:
    """Return our time divided by the time of the fastest other renderer; None if one of
    them is missing."""
    peers = [row["ms"] for name, row in everyone.items() if not name.startswith(_OURS)]
    return everyone[_OURS]["ms"] / min(peers) if peers and _OURS in everyone else None


def frame_tables(rows: list[Row]) -> list[str]:
    key = ("scene", "view", "width", "filter_px2")
    pictures = quickest(rows, key)
    names = list(dict.fromkeys(name for everyone in pictures.values() for name in everyone))
    about = [
        Column("scene", "scene"),
        Column("view", "view"),
        Column("px", "width"),
        Column("filter", "filter_px2", "g"),
    ]
    tables: dict[str, list[Row]] = {name: [] for name in ("ms", "psnr", "gigabytes")}
    for place, everyone in pictures.items():
        for value, table in tables.items():
            row = dict(zip(key, place, strict=True))
            row |= {name: found.get(value) for name, found in everyone.items()}
            table.append(row | {"ratio": ratio(everyone)})
    columns = [Column(name, name, ".3f") for name in names]
    return [
        "\n## Frames: milliseconds\n",
        markdown([*about, *columns, Column("ours / fastest", "ratio", ".2f")], tables["ms"]),
        "\n## Frames: PSNR to float64, dB\n",
        markdown([*about, *(Column(name, name, ".1f") for name in names)], tables["psnr"]),
        "\n## Frames: gigabytes\n",
        markdown([*about, *(Column(name, name, ".1f") for name in names)], tables["gigabytes"]),
    ]


def training_table(rows: list[Row], gradients: list[Row]) -> str:
    """Return the table of training steps of each scene, with the largest distance of
    each renderer's gradients to float64."""
    worst = {row["renderer"]: max(row["relative_l2"].values()) for row in gradients}
    table = []
    for everyone in quickest(rows, ("scene", "width")).values():
        for row in everyone.values():
            mine = everyone.get(_OURS)
            share = mine["ms"] / row["ms"] if mine and row is not mine else None
            table.append(row | {"ratio": share, "worst": worst.get(row["renderer"])})
    columns = [
        Column("scene", "scene"),
        Column("gaussians", "gaussians", "count"),
        Column("renderer", "renderer"),
        Column("forward, ms", "forward_ms", ".3f"),
        Column("forward and backward, ms", "ms", ".3f"),
        Column("ours / theirs", "ratio", ".2f"),
        Column("GB", "gigabytes", ".1f"),
        Column("gradients, relative L2", "worst", ".1e"),
    ]
    return markdown(columns, table)


def page(results: list[Row]) -> str:
    rows = {
        kind: [row for r in results for row in r[kind]]
        for kind in ("frame", "training", "gradients")
    }
    about = results[-1]
    differs = {name: said for result in results for name, said in result["differs"].items()}
    versions = {job: said for result in results for job, said in result["versions"].items()}
    peers = [f"- {name}: {said}." for name, said in differs.items()]
    peers += [f"- `{job}` is {said}." for job, said in versions.items()]
    commits = ", ".join(dict.fromkeys(result["commit"] for result in results))
    parts = [
        _ABOUT.format(
            gpu=about.get("gpu", about["processor"]), window=about["window"], peers="\n".join(peers)
        ),
        f"Measured at {commits}, torch {about.get('torch')}, CUDA {about.get('cuda')}:\n",
        *(f"- `{result['command']}`" for result in results),
        *frame_tables(latest(rows["frame"])),
        "\n## Training\n",
        "A step starts from logarithms of scales and logits of opacities; the filter is 0.3 px². "
        "Gradients\nare those of few gaussians in a small picture; of the five inputs the one "
        "farthest off counts.\n",
        training_table(latest(rows["training"]), rows["gradients"]),
    ]
    failures = [row for result in results for row in result["failure"]]
    if failures:
        parts += ["\n## What failed\n", *(f"- {failure_text(row)}" for row in failures)]
    return "\n".join(parts) + "\n"


def latest(rows: list[Row]) -> list[Row]:
    """Return the rows, without rows that are replaced by later rows."""
    keys = ("job", "renderer", "scene", "view", "width", "filter_px2")
    return list({tuple(row[name] for name in keys): row for row in rows}.values())


def failure_text(row: Row) -> str:
    place = [
        str(row[name]) for name in ("renderer", "scene", "view", "width", "part") if name in row
    ]
    colon = ": " if place else ""
    reason = row["error"].splitlines()[0][:200]
    return f"{row['job']}{colon}{', '.join(place)}: {reason}"


def main(report: Report) -> None:
    report.output.write_text(
        page([json.loads(path.read_text()) for path in report.results]), encoding="utf-8"
    )


if __name__ == "__main__":
    main(tyro.cli(Report))
