"""The page of `pairs`: tables of our errors relative to the best other tool at equal
numbers of gaussians, and plots."""

from __future__ import annotations

import json
import os
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from benchmarks.evaluation.markdown import Column, count_text, markdown

Row = dict[str, Any]

_OURS = ("ours", "refined", "merged")
_COLUMNS = 3
_STYLES = {
    "ours": ("o-", "tab:blue", "ours"),
    "refined": ("o-", "navy", "ours, refined"),
    "merged": ("s--", "tab:cyan", "ours, merged only"),
    "d": ("^-", "tab:orange", "splat-transform -d"),
    "adaptive": ("v-", "tab:red", "splat-transform --decimate-adaptive"),
    "spark": ("D-", "tab:green", "Spark"),
    "published": ("P:", "tab:purple", "published by its makers"),
    "all": ("-", "0.4", "every gaussian, one sample a pixel"),
}
_ABOUT = """# Levels at equal counts and several sizes

Written by `python -m benchmarks.studies.pairs report` from recorded JSON, never by hand.

The native size of a level is 2 px² per gaussian. For an object, the area is the footprint of its ball. For a
scene, it is the whole picture, and as large a share of the level's gaussians counts as of the asset's
gaussians is in the picture. (Groups of a bundle are fitted at 2 px² per gaussian of their own balls, which
overlap and hide each other, so their native size is a quarter to half of the size that is called 1 here.)
Each level is drawn at several times that size, along a side, by the same renderer, and compared
with every gaussian at 4 x 4 samples a pixel: FLIP (67 pixels per degree), PSNR and SSIM, means of {views}
views, windows of at most {widest} px. *Ours* is the finest cut with at most as many gaussians as the other
level has (of a scene, as many as it has in each picture), interpolated between two cuts where groups are too
large to meet that; *refined* the same after `v3dg refine` (a scene by other cameras in it), *merged* without
the fit. Others are splat-transform 3.7.0 (`-d`, `--decimate-adaptive`), Spark 2.2.0 for assets of SH degree
0, and the levels that an asset's makers published, drawn plain; the best of them counts, for each count and
size anew. Of a scene each counts alone, because levels of one share of a scene have different numbers of
gaussians in a picture.
"""


@dataclass
class Report:
    """Make a page with tables and plots from the results of `measure`."""

    results: tyro.conf.Positional[Path]
    """A file pairs.json."""
    output: Annotated[Path, tyro.conf.arg(aliases=["-o"])] = Path("pairs.md")
    plots: Path | None = None
    """Folder for the plots; by default none are drawn."""


def best_others(rows: Sequence[Row], which: str = "ours") -> list[Row]:
    """Return a row for each pair that other tools have, too, with our error and the
    smallest error of another tool."""
    pairs: dict[tuple[Any, ...], dict[str, Row]] = {}
    for row in rows:
        pairs.setdefault((row["asset"], row["level"], row["factor"]), {})[row["method"]] = row
    out = []
    for (asset, level, factor), by_method in pairs.items():
        others = [row for name, row in by_method.items() if name not in (*_OURS, "all")]
        if not others or which not in by_method:
            continue
        best, ours = min(others, key=lambda row: row["flip"]), by_method[which]
        row = {
            "asset": asset,
            "level": level,
            "factor": factor,
            "count": ours["count"],
            "others": best["gaussians"],
            "best": best["method"],
        }
        row |= {"gaussians": ours["gaussians"], "width": ours["width"]}
        for name in ("flip", "psnr", "ssim"):
            row |= {f"ours_{name}": ours[name], f"best_{name}": best[name]}
        row["ratio"] = _ratio(ours["flip"], best["flip"])
        if "merged" in by_method:
            row["to_merged"] = _ratio(ours["flip"], by_method["merged"]["flip"])
        out.append(row)
    return out


def _ratio(ours: float, theirs: float) -> float:
    return ours / theirs if theirs > 0 else float(ours > 0) + 1


def overview(rows: Sequence[Row], which: str = "ours") -> str:
    """Return a table with a line for each asset.

    With several assets, further lines combine all assets: all pairs, pairs from half
    the native size on, and the pairs of each size.
    """
    pairs = best_others(rows, which)
    names = list(dict.fromkeys(row["asset"] for row in pairs))
    lines = [_line(name, [row for row in pairs if row["asset"] == name]) for name in names]
    if len(names) > 1:
        lines.append(_line("all", pairs))
        larger = [row for row in pairs if row["factor"] >= 0.5]
        lines += [_line("all, from x0.5 on", larger)] if larger else []
        for factor in sorted({row["factor"] for row in pairs}):
            lines.append(
                _line(f"all, x{factor:g}", [row for row in pairs if row["factor"] == factor])
            )
    return markdown(_OVERVIEW, lines)


_OVERVIEW = (
    Column("asset", "asset"),
    Column("pairs", "pairs"),
    Column("FLIP, ours / best other: mean", "mean", ".3f"),
    Column("at most 1", "won", ".0%"),
    Column("at most 1.05", "nearly", ".0%"),
    Column("worst", "worst", ".2f"),
    Column("where", "where"),
    Column("FLIP, ours / merged: mean", "merged", ".3f"),
    Column("worst", "merged_worst", ".2f"),
    Column("PSNR, ours less theirs", "psnr", "+.2f"),
    Column("SSIM", "ssim", "+.4f"),
)


def _line(name: str, pairs: Sequence[Row]) -> Row:
    def mean(values: list[float]) -> float | None:
        return statistics.fmean(values) if values else None

    worst = max(pairs, key=lambda row: row["ratio"])
    line = {"asset": name, "pairs": len(pairs), "worst": worst["ratio"]}
    line["where"] = f"{_level(worst)} at x{worst['factor']:g}, {worst['best']}"
    line |= {"mean": mean([row["ratio"] for row in pairs])}
    to_merged = [row["to_merged"] for row in pairs if "to_merged" in row]
    line |= {"merged": mean(to_merged), "merged_worst": max(to_merged, default=None)}
    for key, most in (("won", 1.0), ("nearly", 1.05)):
        line[key] = sum(row["ratio"] <= most for row in pairs) / len(pairs)
    for key in ("psnr", "ssim"):
        both = [(row[f"ours_{key}"], row[f"best_{key}"]) for row in pairs]
        line[key] = mean(
            [ours - theirs for ours, theirs in both if ours is not None and theirs is not None]
        )
    return line


def _level(row: Row) -> str:
    return row["level"] if isinstance(row["level"], str) else f"{row['level']:g} %"


def table(pairs: Sequence[Row]) -> str:
    """Return the table of one asset. Numbers of gaussians are rows and sizes are
    columns; cells have our FLIP, the best other tool's FLIP, and the ratio."""
    factors = sorted({row["factor"] for row in pairs})
    lines: dict[Any, Row] = {}
    for row in sorted(pairs, key=lambda row: -row["count"]):
        line = lines.setdefault(row["level"], {"level": _level(row), "others": row["others"]})
        line["gaussians"] = row["gaussians"]
        line[f"{row['factor']:g}"] = (
            f"{row['ours_flip']:.4f} / {row['best_flip']:.4f} = {row['ratio']:.2f}"
        )
    columns = [
        Column("kept", "level"),
        Column("theirs", "others", "count"),
        Column("ours", "gaussians", "count"),
    ]
    return markdown(
        [*columns, *(Column(f"x{f:g}", f"{f:g}") for f in factors)], list(lines.values())
    )


def rows_of(recorded: Row) -> list[Row]:
    """Return the rows of a result. They are stored as dicts, or as lists with the names
    of the columns in "columns"."""
    columns = recorded.get("columns")
    if columns is None:
        return list(recorded["rows"])
    return [dict(zip(columns, row, strict=True)) for row in recorded["rows"]]


def report(options: Report) -> None:
    recorded = json.loads(options.results.read_text(encoding="utf-8"))
    rows = rows_of(recorded)
    parts = {"As they are built": "ours"}
    if any(row["method"] == "refined" for row in rows):
        parts[f"Refined in {recorded['changes']['refine']:,} steps"] = "refined"
    pairs = {which: best_others(rows, which) for which in parts.values()}
    machine = ", ".join(str(recorded[key]) for key in ("gpu", "processor") if key in recorded)
    sections = [
        _ABOUT.format(**recorded["settings"]),
        f"Measured on {machine}, commit {recorded['commit']}, by `{recorded['command']}`.",
        *(["", recorded["note"]] if "note" in recorded else []),
    ]
    for title, which in parts.items():
        sections += ["", f"## {title}", "", overview(rows, which)]
    for name in dict.fromkeys(row["asset"] for of_part in pairs.values() for row in of_part):
        sections += ["", f"## {name}"]
        for title, which in parts.items():
            of_asset = [row for row in pairs[which] if row["asset"] == name]
            if of_asset:
                sections += ["", f"{title}, FLIP, ours / best other:", "", table(of_asset)]
        if options.plots is not None:
            options.plots.mkdir(parents=True, exist_ok=True)
            path = options.plots / f"pairs_{name}.png"
            plot([row for row in rows if row["asset"] == name], path)
            link = Path(os.path.relpath(path, options.output.parent)).as_posix()
            sections += ["", f"![{name}: count against error at several sizes]({link})"]
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text("\n".join(sections) + "\n", encoding="utf-8")


def plot(rows: Sequence[Row], path: Path) -> None:
    """Plot FLIP, and PSNR below it, against the number of gaussians, for each size.
    Three sizes are side by side, so that the plot fits a page."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot, ticker

    factors = sorted({row["factor"] for row in rows})
    blocks = -(-len(factors) // _COLUMNS)
    figure, axes = pyplot.subplots(
        2 * blocks,
        _COLUMNS,
        figsize=(9, 0.9 + 4.6 * blocks),
        sharex=True,
        squeeze=False,
        layout="constrained",
    )
    for line, (key, label) in enumerate(
        (("flip", "FLIP (less is better)"), ("psnr", "PSNR, dB (more is better)"))
    ):
        panels = axes[line::2].ravel()
        for panel, factor in zip(panels, factors, strict=False):
            _draw(panel, [row for row in rows if row["factor"] == factor], key)
            panel.sharey(panels[0])
            panel.label_outer()
            panel.set_title(f"{factor:g} times its own size", fontsize=10)
        for panel in panels[len(factors) :]:
            panel.set_axis_off()
        if key == "flip":
            panels[0].set_yscale("log")
            panels[0].yaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5), numticks=12))
            panels[0].yaxis.set_major_formatter("{x:g}")
            panels[0].yaxis.set_minor_formatter(ticker.NullFormatter())
        for panel in panels[::_COLUMNS]:
            panel.set_ylabel(label)
    for panel in axes[-1]:
        panel.set_xlabel("gaussians of the level in the picture")
        panel.xaxis.set_major_formatter(lambda x, _: count_text(int(x)))
    total = max((row["gaussians"] for row in rows if row["method"] == "all"), default=0)
    figure.suptitle(f"{rows[0]['asset']}, {count_text(total)} gaussians in a picture", fontsize=12)
    figure.legend(
        *axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=3, fontsize=10
    )
    figure.savefig(path, dpi=110)
    pyplot.close(figure)


def _draw(panel: Any, rows: Sequence[Row], key: str) -> None:
    """Plot one curve per method from rows of one picture size. Only numbers of
    gaussians at which another tool has a level are plotted."""
    counts = {
        row["level"]: row["gaussians"] for row in rows if row["method"] not in (*_OURS, "all")
    }
    for method, (style, color, label) in _STYLES.items():
        points = sorted(
            (counts[row["level"]], row[key])
            for row in rows
            if row["method"] == method and row["level"] in counts and row[key] is not None
        )
        if points:
            panel.plot(
                *zip(*points, strict=True), style, color=color, label=label, markersize=4, lw=1.3
            )
    panel.set_xscale("log")
    panel.grid(alpha=0.3, which="both", lw=0.5)
