"""The command `python -m benchmarks evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg.cli._common import Flag, Threads, UsageError, option, print_result, require_file


@dataclass
class Evaluate:
    """Measure speed and error of v3dg and of other tools, and write JSON, tables and
    pictures (docs/results.md explains them)."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("evaluation")
    """Folder for the results; created if it does not exist."""
    preset: Literal["small", "full"] = "small"
    """Amount of work: small takes minutes on two cores, full needs a GPU."""
    parts: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Parts of the evaluation to run; by default all."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Composed scenes to draw; by default all."""
    asset: Annotated[Path | None, option("PATH")] = None
    """Trained asset, a .ply file, to use instead of the generated one."""
    layout: Annotated[Path | None, option("PATH")] = None
    """Published layout (.json) with instances of that asset and cameras."""
    peers: Annotated[Path | None, option("FOLDER")] = None
    """Folder with levels of that asset made by other tools
    (benchmarks/evaluation/parts/merging.py describes the files)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device for builds and pictures; auto is a CUDA device if torch can use one, else
    the CPU."""
    seed: int = 0
    """Seed of the assets, layouts and builds."""
    threads: Threads = None
    """Number of CPU threads; by default one for each core."""
    json: Flag = False
    """Print the results as JSON."""
    quiet: Flag = False
    """Show no progress."""


def run(options: Evaluate) -> None:
    for path, suffix in ((options.asset, ".ply"), (options.layout, ".json")):
        if path is not None:
            require_file(path, suffix)
    if options.layout is not None and options.asset is None:
        raise UsageError(
            "--layout: expected together with --asset, got no --asset; give the asset that the "
            "layout places"
        )
    from benchmarks import evaluation
    from v3dg import _device

    results = evaluation.run(
        evaluation.Evaluation(
            evaluation.PRESETS[options.preset],
            "cuda" if _device.resolve(options.device).is_cuda else "cpu",
            options.output,
            seed=options.seed,
            scenes=options.scenes,
            asset_path=options.asset,
            layout_path=options.layout,
            peers=options.peers,
        ),
        options.preset,
        options.parts or evaluation.NAMES,
        quiet=options.quiet,
    )

    def text() -> str:
        sections = [
            f"## {evaluation.part(name).TITLE}\n\n{evaluation.part(name).tables(result)}"
            for name, result in results.items()
        ]
        return "\n\n".join(
            [*sections, f"Plots and a page: python -m benchmarks report {options.output}"]
        )

    print_result(results, text().splitlines(), as_json=options.json)
