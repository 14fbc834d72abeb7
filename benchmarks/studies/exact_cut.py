"""Checks that each path from a leaf to a root has exactly one selected cluster, by
counting the paths on which this is false.

tests/support/exact_cut.py defines a trial and how paths are counted.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "support"))

from exact_cut import run_trials
from v3dg import Bundle


def main(arguments=None):
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--trials", type=int, default=10_000_000)
    parser.add_argument(
        "--bundle", type=Path, help=(".v3dg file to select from; by default random trees")
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--partial",
        action="store_true",
        help=(
            "select only from a random set of loaded pages, in which the pages above a page are "
            "loaded, too"
        ),
    )
    parser.add_argument("--device", default="cpu", choices=["cpu", "cuda"])
    parser.add_argument(
        "--fades",
        action="store_true",
        help=("fade between levels, and check that the weights on a path add up to 1"),
    )
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args(arguments)

    bundles = [Bundle.open(arguments.bundle)] if arguments.bundle else None
    result = {
        "bundle": str(arguments.bundle) if arguments.bundle else "random trees",
        **run_trials(
            arguments.trials,
            bundles,
            seed=arguments.seed,
            device=arguments.device,
            partial=arguments.partial,
            fades=arguments.fades,
        ),
    }
    print(
        json.dumps(result)
        if arguments.json
        else "\n".join(f"{key}: {value}" for key, value in result.items())
    )
    return 1 if result["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
