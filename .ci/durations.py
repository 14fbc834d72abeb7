"""Prints the durations of tests as Markdown: those of the slowest tests and of folders,
and the fraction of tests that end within five minutes.

    python .ci/durations.py build/ci/tests.xml

The file is the output of `pytest --junit-xml`.
"""

from __future__ import annotations

import sys
import xml.etree.ElementTree as ElementTree
from collections import Counter
from pathlib import Path

HEAVIEST = 25
SOON_SECONDS = 300


def durations_of(path: Path) -> dict[str, float]:
    """Return the duration of each test in seconds, by its module and name."""
    durations: dict[str, float] = {}
    for case in ElementTree.parse(path).iter("testcase"):
        name = f"{case.get('classname')}::{case.get('name')}"
        durations[name] = durations.get(name, 0.0) + float(case.get("time", "0"))
    return durations


def folder_of(name: str) -> str:
    """Return the folder of a test module, such as `tests/unit/core` for
    `tests.unit.core.test_select::test_x`."""
    module = name.partition("::")[0].split(".")
    return "/".join(part for part in module if not part.startswith(("test_", "Test")))


def table(title: str, seconds: dict[str, float]) -> list[str]:
    rows = sorted(seconds.items(), key=lambda item: -item[1])
    return [
        "",
        f"| {title} | seconds |",
        "| --- | ---: |",
        *(f"| {n} | {s:.1f} |" for n, s in rows),
    ]


def main(path: Path) -> int:
    durations = durations_of(path)
    folders: Counter[str] = Counter()
    for name, seconds in durations.items():
        folders[folder_of(name)] += seconds
    soon = 0
    total = 0.0
    for seconds in sorted(durations.values()):
        total += seconds
        soon += total <= SOON_SECONDS
    share = soon / max(len(durations), 1)
    heaviest = dict(sorted(durations.items(), key=lambda item: -item[1])[:HEAVIEST])
    print(f"{len(durations)} tests took {sum(durations.values()):.0f} s.")
    print(f"The quickest {share:.0%} of them take {SOON_SECONDS} s together.")
    print("\n".join([*table("folder", dict(folders)), *table("test", heaviest)]))
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1])))
