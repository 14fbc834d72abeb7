"""`v3dg demo`."""

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from v3dg.cli._common import (
    Column,
    Common,
    check_output,
    check_range,
    option,
    print_result,
    table_lines,
)
from v3dg.demo import run_demo
from v3dg.select import DEFAULT_TOLERANCE, rule_of

_COLUMNS = [
    Column("drawn", "{name}, distance {distance:g}"),
    Column("gaussians", "{gaussians:,}"),
    Column("select ms", "{select_ms:.1f}"),
    Column("draw ms", "{draw_ms:.1f}"),
    Column("FLIP", "{flip:.4f}"),
    Column("PSNR", "{psnr:.2f}"),
]


@dataclass
class Demo(Common):
    """Make an asset, build its bundle, place 2,000 instances, draw them at several
    distances, and measure the pictures."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("v3dg_demo.png")
    """Picture to write, .png or .jpg."""
    keep: Annotated[Path | None, option("FOLDER")] = None
    """Store the asset, its bundle and the scene in this folder for further use."""
    gaussians: int = 50_000
    """Number of gaussians in the asset."""
    instances: int = 2000
    """Number of instances of the asset."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="W H")] = (380, 440)
    """Width and height of a panel in px."""
    tolerance: float = DEFAULT_TOLERANCE
    """Largest screen area in px² that one gaussian of a coarser cluster may stand
    for."""
    seed: int = 0
    """Seed of the asset, of its placement and of the build."""


def run(options: Demo) -> None:
    check_output(options.output)
    check_range("--gaussians", options.gaussians, 1000, 10_000_000)
    check_range("--instances", options.instances, 1, 1_000_000)
    for side in options.size:
        check_range("--size", side, 16, 4096)
    check_range("--seed", options.seed, 0, (1 << 58) - 1)
    rule_of(options.tolerance, budget=None, min_level=0)
    result = run_demo(
        options.output,
        num_gaussians=options.gaussians,
        instances=options.instances,
        size=options.size,
        tolerance=options.tolerance,
        seed=options.seed,
        progress=not options.quiet,
        keep=options.keep,
    )
    panels = [
        {"name": name, "distance": column["distance"], **column[name]}
        for column in result["columns"]
        for name in ("full", "bundle")
    ]
    lines = [
        f"{options.instances:,} instances of {options.gaussians:,} gaussians, {result['levels']} "
        f"levels built in {result['build_seconds']:.1f} s, tolerance {options.tolerance:g} px²",
        "",
        *table_lines(_COLUMNS, panels),
        "",
        f"wrote {result['picture']} in {result['seconds']:.0f} s",
        *_advice(result["kept"]),
    ]
    print_result(result, lines, as_json=options.json)


def _advice(files: Sequence[str]) -> list[str]:
    """Return lines with commands for the files that were kept."""
    if not files:
        return []
    asset, bundle, scene = map(shlex.quote, files)
    return ["", "to go on:", f"  v3dg view {scene}", f"  v3dg compare {asset} {bundle}"]
