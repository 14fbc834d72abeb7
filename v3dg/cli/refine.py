"""`v3dg refine`."""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from v3dg._files import check_folder
from v3dg.bundle import Bundle
from v3dg.cli import _common
from v3dg.cli._views import CameraFile
from v3dg.refine import refine_bundle


@dataclass(kw_only=True)
class Refine(CameraFile, _common.OnDevice):
    """Make the levels of a bundle look more like its asset at all sizes, which takes
    far longer than building it."""

    bundle: tyro.conf.Positional[Path]
    """Bundle that `v3dg build` made (.v3dg)."""
    output: tyro.conf.Positional[Path]
    """Bundle to write (.v3dg)."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 30_000
    """Number of pictures of cuts that are compared with pictures of the asset."""
    cameras: Annotated[Path | None, _common.option("PATH")] = None
    """A file or folder of cameras, as for `v3dg render`, for assets such as a room,
    which is seen from inside. By default the asset is seen from all around."""
    drop: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.02
    """Drop the least visible gaussians of each level, up to this share of the level's
    visibility; 0 keeps all."""
    seed: int = 0
    """Seed of random numbers; the same seed gives the same file, byte for byte, on the
    same kind of device, with any number of threads."""


def run(options: Refine) -> None:
    _common.require_file(options.bundle, ".v3dg")
    _common.check_usage(
        str(options.output), options.output.suffix == ".v3dg", "a file name ending in .v3dg"
    )
    check_folder(options.output)
    _common.check_output(options.output, options.bundle)
    cameras = list(options.read().values())
    start = time.perf_counter()
    refined = refine_bundle(
        Bundle.open(options.bundle),
        cameras=cameras,
        steps=options.steps,
        drop=options.drop,
        seed=options.seed,
        device=options.device,
        progress=not options.quiet,
    )
    refined.write(options.output)
    seconds = time.perf_counter() - start
    result = {"output": str(options.output), "steps": options.steps, "seconds": seconds}
    line = f"{options.output}: {options.steps:,} steps, {seconds:.1f} s"
    _common.print_result(result, [line], as_json=options.json)
