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
    """Make the levels of a bundle look more like its asset, small and large, which
    takes far longer than building it."""

    bundle: tyro.conf.Positional[Path]
    """Bundle that `v3dg build` made (.v3dg)."""
    output: tyro.conf.Positional[Path]
    """Bundle to write (.v3dg)."""
    steps: Annotated[int, tyro.conf.arg(metavar="N")] = 30_000
    """Pictures of cuts that are compared with the asset's, one after another."""
    cameras: Annotated[Path | None, _common.option("PATH")] = None
    """A file or folder of cameras from which the asset is seen, as for `v3dg render`:
    for a room, which is seen from inside. All around if not given."""
    drop: Annotated[float, tyro.conf.arg(metavar="SHARE")] = 0.02
    """The least seen gaussians of a level are dropped, up to this share of what is seen
    of it; 0: none."""
    seed: int = 0
    """The same seed gives the same file, byte for byte, on the same kind of device and
    any threads."""


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
