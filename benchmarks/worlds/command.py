"""The command `python -m benchmarks world`."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg.cli._common import Flag, Threads, option, print_result


@dataclass
class World:
    """Make a world: its assets, their bundles, and a scene file with 400 cameras."""

    name: tyro.conf.Positional[Literal["donut_sea", "forest", "temples", "crowd"]]
    """World to make, one of the four scenes of the V3DG paper."""
    output: Annotated[Path | None, option("FOLDER", "-o")] = None
    """Folder for the files, created if it does not exist; by default the name of the
    world."""
    scale: Literal["small", "full"] = "small"
    """Size of the world: full is about 100 million gaussians and takes hours on a CPU
    or minutes on a GPU; small takes one or two minutes on a CPU."""
    seed: int = 0
    """Seed of the assets, the layout and the builds."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device for the builds; auto is a CUDA device if torch can use one, else the
    CPU."""
    resume: Flag = False
    """Continue an interrupted run with the bundles and levels that are finished."""
    threads: Threads = None
    """Number of CPU threads; by default one for each core."""
    json: Flag = False
    """Print the result as JSON."""
    quiet: Flag = False
    """Show no progress."""


def run(options: World) -> None:
    from benchmarks import worlds
    from v3dg import _device

    start = time.perf_counter()
    arguments = worlds.SMALL[options.name] if options.scale == "small" else {}
    world = worlds.WORLDS[options.name](**arguments, seed=options.seed)
    try:
        path = worlds.write_world(
            world,
            options.output or Path(options.name),
            seed=options.seed,
            device=_device.resolve(options.device),
            resume=options.resume,
            progress=not options.quiet,
        )
    except KeyboardInterrupt:
        raise KeyboardInterrupt("interrupted; `--resume` continues") from None
    result = {
        "output": str(path),
        "assets": list(world.assets),
        "instances": world.num_instances,
        "gaussians": world.num_gaussians,
        "extent": world.extent,
        "seconds": time.perf_counter() - start,
    }
    text = (
        f"{path}: {world.num_instances:,} instances of {len(world.assets)} assets, "
        f"{world.num_gaussians:,} gaussians, {result['seconds']:.0f} s\n"
        f"draw it with `v3dg render {path} --camera 059_camera_19`"
    )
    print_result(result, text.splitlines(), as_json=options.json)
