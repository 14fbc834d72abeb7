"""The evaluation: speed against error, and peers in the same run; `v3dg bench` on the command line."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from v3dg.bench.parts import NAMES, part
from v3dg.bench.record import write
from v3dg.bench.settings import PRESETS
from v3dg.bench.stage import Stage

__all__ = ["NAMES", "PRESETS", "Stage", "part", "run"]


def run(stage: Stage, preset: str, names: Sequence[str], *, quiet: bool = False) -> dict[str, dict[str, Any]]:
    """Run parts, each of which writes <part>.json as it ends; returns what they measured.

    Raises:
        ValueError: A name is not of a part.
    """
    modules = {name: part(name) for name in names}
    stage.folder.mkdir(parents=True, exist_ok=True)
    stage.warm_up()
    results = {}
    try:
        for name, module in modules.items():
            start = time.perf_counter()
            stage.pictures = []
            found = module.run(stage)
            for result in [found] if isinstance(found, dict) else found:
                seconds = time.perf_counter() - start
                results[name] = {
                    **{"part": name, "preset": preset, "device": stage.device, "seed": stage.seed},
                    **{"asset": stage.asset_name, "asset_gaussians": len(stage.asset)},
                    **{"seconds": round(seconds, 1), "pictures": stage.pictures},
                    **result,
                }
                write(stage.folder / f"{name}.json", results[name], stage.device)
            if not quiet:
                print(f"{name}: {seconds:.1f} s", file=sys.stderr, flush=True)
    finally:
        stage.judge.close()
    return results
