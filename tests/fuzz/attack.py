#!/usr/bin/env python3
"""Attacks v3dg with broken files, unusual commands and calls, signals, threads and
limits, and keeps the inputs that show a fault.

    python tests/fuzz/attack.py all --seconds 3600
    python tests/fuzz/attack.py files commands --tries 500 --seed 7
    python tests/fuzz/attack.py files --seed 7 --only 123

Each kind of attack is a module in attacks/, which describes what it tries and what is
right. Tries are numbered, and the same seed and number give the same try. For each kind
a line of JSON is printed, with the numbers of the tries that found a fault. Their files
are kept in build/attack/KIND/SEED-NUMBER. The exit code is 1 if a fault was found.
Findings that are only "low", which are messages that could say more, are counted
separately.
"""

import argparse
import json
import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent.parent))

from fuzz.attacks.pool import attack

# Fractions of the time if all kinds run. Kinds that find faults quickly need the least
# time.
KINDS = {
    "files": 0.3,
    "commands": 0.15,
    "misuses": 0.05,
    "interrupts": 0.25,
    "kills": 0.1,
    "bounded": 0.05,
    "threads": 0.03,
    "settling": 0.1,
    "memory": 0.07,
    "exports": 0.05,
    "servers": 0.05,
    "ends": 0.1,
    "headers": 0.03,
    "extreme_numbers": 0.05,
}
KEPT = Path(__file__).parents[2] / "build" / "attack"


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "kinds", nargs="+", choices=[*KINDS, "all"], metavar="KIND", help=", ".join(KINDS)
    )
    parser.add_argument("--seconds", type=float, default=600, help="for all kinds together")
    parser.add_argument("--tries", type=int, help="of each kind, if the time suffices")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, metavar="NUMBER", help="this try alone")
    options = parser.parse_args()
    kinds = list(KINDS) if "all" in options.kinds else options.kinds
    share = options.seconds / sum(KINDS[kind] for kind in kinds)
    numbers = range(options.tries or sys.maxsize) if options.only is None else [options.only]
    has_found = False
    for kind in kinds:
        summary = attack(kind, numbers, seconds=share * KINDS[kind], seed=options.seed, kept=KEPT)
        print(json.dumps(summary), flush=True)
        has_found |= bool(summary["findings"])
    return int(has_found)


if __name__ == "__main__":
    sys.exit(main())
