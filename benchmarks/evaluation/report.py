"""The command `python -m benchmarks report`, which turns recorded results into a short
page, a page with all tables, and plots."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.evaluation.parts import NAMES, part
from v3dg.cli._common import Flag


@dataclass
class Report:
    """Make two pages with plots from results of `evaluate`: an overview, and all
    tables."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with results of `evaluate`. If several folders have a part, the first one
    counts."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("results.md")
    """Overview page to write; it states where v3dg is better and where it is not."""
    tables: Annotated[Path, tyro.conf.arg(metavar="PATH")] = Path("evaluation.md")
    """Page to write with all tables and pictures."""
    no_plots: Flag = False
    """Draw no plots, so that matplotlib is not needed. Existing plots in the folders
    remain."""


BY_HAND = "<!-- written by hand from here on -->"

HOW = (
    "Error is FLIP (67 pixels per degree) and PSNR to the full scene at twice the resolution, "
    "box-averaged. Times are medians of single frames after a warm-up, selection included, from an "
    "idle device to an idle device; a picture is checked before its time counts. The JSON that a "
    "run writes has the spread and every view."
)


def read_results(folder: Path) -> dict[str, dict[str, Any]]:
    """Return results by part, in the order of the parts.

    Raises:
        ValueError: The folder has no results.
    """
    paths = {name: folder / f"{name}.json" for name in NAMES}
    results = {
        name: json.loads(path.read_text(encoding="utf-8"))
        for name, path in paths.items()
        if path.exists()
    }
    if not results:
        raise ValueError(
            f"{folder}: expected results such as {NAMES[0]}.json, got none; run `python -m "
            "benchmarks evaluate` first"
        )
    return results


def page(folders: Sequence[Path], output: Path, tables: Path) -> str:
    """Return the overview page: a table, a picture, and sentences from the parts.

    Links to pictures and to the page of tables are relative to the folder of `output`.
    """
    sections = [(folder, read_results(folder)) for folder in folders]
    # The first folder that has a part counts.
    measured = {
        name: (folder, r) for folder, results in reversed(sections) for name, r in results.items()
    }
    wins, losses = _sentences(measured, place(next(iter(sections[0][1].values()))))
    machines = [machine(list(results.values())) for _, results in sections]
    lines = [
        "# Results",
        *_overview(measured, output),
        "",
        "All tables and pictures, with the command and the commit of each, are in "
        f"[the evaluation]({Path(os.path.relpath(tables, output.parent)).as_posix()}).",
        "",
        "## Where we win",
        "",
        *(wins or ["Nowhere in what was measured."]),
        "",
        "## Where we do not",
        "",
        *(losses or ["Nowhere in what was measured."]),
        "",
        "## How it is measured",
        "",
        HOW,
        "",
        "This part of the page is written by `python -m benchmarks report` from recorded JSON, "
        "never by hand. "
        f"It was measured on {'. What was not measured there was measured on '.join(machines)}.",
    ]
    return "\n".join(lines) + "\n"


def _overview(measured: dict[str, tuple[Path, dict[str, Any]]], output: Path) -> list[str]:
    """Return the table and the picture at the beginning of the overview page."""
    lines = []
    if "composed" in measured:
        _, result = measured["composed"]
        composed = part("composed")
        lines += [
            "",
            composed.overview(result),
            "",
            f"Drawn on {place(result)}. {composed.OVERVIEW}",
        ]
    if "tolerance" in measured:
        folder, result = measured["tolerance"]
        if (folder / "tolerance.png").exists():
            picture = Path(os.path.relpath(folder, output.parent), "tolerance.png").as_posix()
            caption = (
                f"Milliseconds a frame against FLIP on {place(result)}, a point for each tolerance."
            )
            lines += ["", f"![{part('tolerance').TITLE}]({picture})", "", caption]
    return lines


def _sentences(
    measured: dict[str, tuple[Path, dict[str, Any]]], home: str
) -> tuple[list[str], list[str]]:
    """Return Markdown lists of where v3dg is better and where it is not, in the order
    of the parts."""
    wins: list[str] = []
    losses: list[str] = []
    for name in [name for name in NAMES if name in measured]:
        _, result = measured[name]
        summary = part(name).summary(result)
        where = "" if place(result) == home else f" (on {place(result)})"
        wins += [f"- {sentence}{where}" for sentence in summary.wins]
        losses += [f"- {sentence}{where}" for sentence in summary.losses]
    return wins, losses


def tables_page(folders: Sequence[Path], output: Path) -> str:
    """Return the page with all tables. Links to pictures are relative to the page's
    folder."""
    lines = [
        "# The evaluation",
        "",
        "All tables of the evaluation, written by `python -m benchmarks report` from recorded "
        "JSON, never by hand.",
        "",
        HOW,
    ]
    for folder in folders:
        results = read_results(folder)
        lines += ["", f"## {heading(next(iter(results.values())))}"]
        lines += ["", f"Measured on {machine(list(results.values()))}."]
        for name, result in results.items():
            lines += _part_lines(name, result, Path(os.path.relpath(folder, output.parent)), folder)
    return "\n".join(lines) + "\n"


def place(result: dict[str, Any]) -> str:
    """Return the name of the GPU, or the number of CPU threads."""
    return str(result.get("gpu") or f"{result['threads']} CPU threads")


def machine(results: Sequence[dict[str, Any]]) -> str:
    """Return the device and versions of results from one machine, and the commits of
    all results."""
    first = results[0]
    where = first.get("gpu") or f"{first['threads']} threads of {first['processor']}"
    commits = list(dict.fromkeys(result["commit"] for result in results))
    versions = [f"Python {first['python']}"]
    versions += [f"{name} {first[name]}" for name in ("torch", "gsplat") if name in first]
    noun = "commit" if len(commits) == 1 else "commits"
    return f"{where}, {noun} {', '.join([*commits, *versions])}"


def heading(result: dict[str, Any]) -> str:
    return f"{result['preset'].capitalize()} preset, {place(result)}, {result['asset']} asset"


def _part_lines(name: str, result: dict[str, Any], link: Path, folder: Path) -> list[str]:
    module = part(name)
    lines = ["", f"### {module.TITLE}", "", module.ABOUT, "", module.tables(result)]
    if (folder / f"{name}.png").exists():
        lines += ["", f"![{module.TITLE}]({(link / name).as_posix()}.png)"]
    for picture in result["pictures"]:
        lines += ["", f"![{Path(picture).stem.replace('_', ' ')}]({(link / picture).as_posix()})"]
    command = f"`{result['command']}`, seed {result['seed']}, commit {result['commit']}"
    return [*lines, "", f"Measured in {result['seconds']:.0f} s by {command}."]


def draw_plots(folder: Path) -> None:
    """Write <part>.png for each result that has a plot."""
    from matplotlib.figure import Figure

    for name, result in read_results(folder).items():
        module = part(name)
        if hasattr(module, "plot"):
            figure = Figure(figsize=(7, 4.5), layout="constrained")
            module.plot(result, figure)
            figure.savefig(folder / f"{name}.png", dpi=90, metadata={"Software": None})


def written_by_hand(page: Path) -> str:
    """Return the end of a page from the marker `BY_HAND` on, including the marker; an
    empty string without a marker."""
    text = page.read_text(encoding="utf-8") if page.exists() else ""
    _, marker, rest = text.partition(BY_HAND)
    return "\n" + marker + rest if marker else ""


def run(options: Report) -> None:
    for folder in options.folders:
        if not options.no_plots:
            draw_plots(folder)
    short = page(options.folders, options.output, options.tables)
    short += written_by_hand(options.output)
    options.output.write_text(short, encoding="utf-8")
    options.tables.write_text(tables_page(options.folders, options.tables), encoding="utf-8")
