"""`python -m benchmarks report`: from recorded results to a page with plots."""

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
    """Make a page with plots of what `evaluate` has recorded."""

    folders: tyro.conf.Positional[tuple[Path, ...]]
    """Folders with results of `evaluate`; the first one is what the page begins with."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("results.md")
    """Page to write."""
    no_plots: Flag = False
    """Leave the plots in the folders as they are; drawing them wants matplotlib."""


def read_results(folder: Path) -> dict[str, dict[str, Any]]:
    """Results by part, in the order of parts.

    Raises:
        ValueError: There are none.
    """
    paths = {name: folder / f"{name}.json" for name in NAMES}
    results = {
        name: json.loads(path.read_text(encoding="utf-8")) for name, path in paths.items() if path.exists()
    }
    if not results:
        raise ValueError(
            f"{folder}: expected results such as {NAMES[0]}.json; run `python -m benchmarks evaluate` first"
        )
    return results


def page(folders: Sequence[Path], output: Path) -> str:
    """The page; pictures are linked relative to where it will be."""
    sections = [(folder, read_results(folder)) for folder in folders]
    machines = [machine(list(results.values())) for _, results in sections]
    # The first folder counts; the others for parts that it does not have.
    measured = {name: result for _, results in reversed(sections) for name, result in results.items()}
    home = place(next(iter(sections[0][1].values())))
    wins, losses = [], []
    for name, result in measured.items():
        summary = part(name).summary(result)
        where = "" if place(result) == home else f" (on {place(result)})"
        wins.append([sentence + where for sentence in summary.wins])
        losses.append([sentence + where for sentence in summary.losses])
    lines = [
        "# Results",
        "",
        f"**Where we win**: {_heads(wins)} ([all](#where-we-win)).",
        "",
        f"**Where we do not**: {_heads(losses)} ([all](#where-we-do-not)).",
        "",
        "Written by `python -m benchmarks report` from recorded JSON, never by hand; here on "
        f"{'; what is not measured there, on '.join(machines)}.",
        "",
        "## Where we win",
        "",
        *(f"- {sentence}" for sentences in wins for sentence in sentences),
        "",
        "## Where we do not",
        "",
        *(f"- {sentence}" for sentences in losses for sentence in sentences),
        "",
        "## How it is measured",
        "",
        "Error is FLIP (67 pixels per degree) and PSNR to the full scene at twice the resolution, "
        "box-averaged. Times are medians of single frames after a warm-up, selection included, from an "
        "idle device to an idle device; a picture is checked before its time counts. The JSON that a "
        "run writes has the spread and every view.",
    ]
    for folder, results in sections:
        lines += ["", f"## {heading(next(iter(results.values())))}"]
        for name, result in results.items():
            lines += _part_lines(name, result, Path(os.path.relpath(folder, output.parent)), folder)
    return "\n".join(lines) + "\n"


def _heads(sentences_of_parts: Sequence[Sequence[str]]) -> str:
    """The first sentences of the first parts that have some: what a reader in a hurry gets."""
    return "; ".join([s[0] for s in sentences_of_parts if s][:4]) or "nowhere in what was measured"


def place(result: dict[str, Any]) -> str:
    """The device in a few words."""
    return str(result.get("gpu") or f"{result['threads']} CPU threads")


def machine(results: Sequence[dict[str, Any]]) -> str:
    """Device and versions of results from one machine, and all their commits."""
    first = results[0]
    where = first.get("gpu") or f"{first['threads']} threads of {first['processor']}"
    commits = list(dict.fromkeys(result["commit"] for result in results))
    versions = [f"Python {first['python']}"]
    versions += [f"{name} {first[name]}" for name in ("torch", "gsplat") if name in first]
    return f"{where}, {'commit' if len(commits) == 1 else 'commits'} {', '.join([*commits, *versions])}"


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
    """Write <part>.png for each result that has something to plot."""
    from matplotlib.figure import Figure

    for name, result in read_results(folder).items():
        module = part(name)
        if hasattr(module, "plot"):
            figure = Figure(figsize=(7, 4.5), layout="constrained")
            module.plot(result, figure)
            figure.savefig(folder / f"{name}.png", dpi=90, metadata={"Software": None})


def run(options: Report) -> None:
    for folder in options.folders:
        if not options.no_plots:
            draw_plots(folder)
    options.output.write_text(page(options.folders, options.output), encoding="utf-8")
