"""`python -m benchmarks evaluate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from v3dg.cli._common import Flag, Threads, UsageError, option, print_result, require_file


@dataclass
class Evaluate:
    """Measure speed against error, beside peers, and write JSON, tables and pictures
    (docs/results.md)."""

    output: Annotated[Path, tyro.conf.arg(aliases=["-o"], metavar="FOLDER")] = Path("evaluation")
    """Folder for the results; made if it is not there."""
    preset: Literal["small", "full"] = "small"
    """small takes minutes on two cores, full needs a GPU."""
    parts: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Parts of the evaluation to run; all if not given."""
    scenes: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME...")] = ()
    """Composed scenes to draw; all if not given."""
    asset: Annotated[Path | None, option("PATH")] = None
    """Trained asset, a .ply file, in place of the one that is made here."""
    layout: Annotated[Path | None, option("PATH")] = None
    """Published layout (.json) of the instances of that asset and of cameras."""
    peers: Annotated[Path | None, option("FOLDER")] = None
    """Levels of that asset that other tools made (described in
    benchmarks/evaluation/parts/merging.py)."""
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device to build and draw on; auto is a CUDA device if there is one and torch can
    use it."""
    seed: int = 0
    """Seed of assets, layouts and builds."""
    threads: Threads = None
    """CPU threads; all if not given."""
    json: Flag = False
    """Print the results as JSON."""
    quiet: Flag = False
    """Show no progress."""


def run(options: Evaluate) -> None:
    for path, suffix in ((options.asset, ".ply"), (options.layout, ".json")):
        if path is not None:
            require_file(path, suffix)
    if options.layout is not None and options.asset is None:
        raise UsageError("--layout: expected --asset with it, the asset that it places")
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
