"""The evaluation: speed and error of v3dg and of other tools, measured in one run.

`python -m benchmarks evaluate` starts it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from typing import Any

from benchmarks.evaluation.evaluation import Evaluation
from benchmarks.evaluation.parts import NAMES, part
from benchmarks.evaluation.record import write
from benchmarks.evaluation.settings import PRESETS

__all__ = ["NAMES", "PRESETS", "Evaluation", "part", "run"]


def run(
    evaluation: Evaluation, preset: str, names: Sequence[str], *, quiet: bool = False
) -> dict[str, dict[str, Any]]:
    """Run parts, each of which writes <part>.json when it ends; return their results.

    Raises:
        ValueError: There is no part of this name.
    """
    modules = {name: part(name) for name in names}
    evaluation.folder.mkdir(parents=True, exist_ok=True)
    evaluation.warm_up()
    results = {}
    try:
        for name, module in modules.items():
            start = time.perf_counter()
            evaluation.pictures = []
            found = module.run(evaluation)
            for result in [found] if isinstance(found, dict) else found:
                seconds = time.perf_counter() - start
                results[name] = {
                    **{
                        "part": name,
                        "preset": preset,
                        "device": evaluation.device,
                        "seed": evaluation.seed,
                    },
                    **{"asset": evaluation.asset_name, "asset_gaussians": len(evaluation.asset)},
                    **{"seconds": round(seconds, 1), "pictures": evaluation.pictures},
                    **result,
                }
                write(evaluation.folder / f"{name}.json", results[name], evaluation.device)
            if not quiet:
                print(f"{name}: {seconds:.1f} s", file=sys.stderr, flush=True)
    finally:
        evaluation.judge.close()
    return results
