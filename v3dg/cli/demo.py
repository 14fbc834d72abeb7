"""`v3dg demo`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from v3dg.cli._common import Flag, Threads, option, print_result


@dataclass
class Demo:
    """Build an asset that v3dg makes itself, place it 2,000 times, draw it from near to far, and measure."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="PATH")] = Path("v3dg_demo.png")
    """Picture to write, .png or .jpg."""
    gaussians: int = 50_000
    """Gaussians of the asset."""
    instances: int = 2000
    """Number of instances of it."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="W H")] = (380, 440)
    """Width and height of one panel in px."""
    tolerance: Annotated[float | None, option("PX2")] = None
    """Screen area in px² that one gaussian of a coarser cluster may stand for."""
    seed: int = 0
    """Seed of the asset, of the field and of the build."""
    threads: Threads = None
    """CPU threads; all if not given."""
    json: Flag = False
    """Print the numbers as JSON."""
    quiet: Flag = False
    """Show no progress."""


def run(options: Demo) -> None:
    from v3dg.demo import run_demo, table_text
    from v3dg.select import DEFAULT_TOLERANCE

    result = run_demo(
        options.output,
        num_gaussians=options.gaussians,
        instances=options.instances,
        size=options.size,
        tolerance=DEFAULT_TOLERANCE if options.tolerance is None else options.tolerance,
        seed=options.seed,
        progress=not options.quiet,
    )
    print_result(
        options.json,
        result.as_dict(),
        lambda: f"{table_text(result)}\n\nwrote {result.picture} in {result.seconds:.0f} s",
    )
