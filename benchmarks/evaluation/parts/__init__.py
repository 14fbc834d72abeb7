"""The parts of the evaluation, one module each.

A part has a TITLE, a sentence or two ABOUT its question, and three functions.
run(evaluation) measures and returns JSON values, or yields them again whenever there
are more. tables(result) returns them as Markdown. summary(result) says in a sentence or
two where we win and where we do not. If there is something to plot, plot(result,
figure) draws it.
"""

from __future__ import annotations

import importlib
from typing import Any

NAMES = (
    "tolerance",
    "composed",
    "fit",
    "hierarchy",
    "merging",
    "clipping",
    "tree",
    "motion",
    "hard",
    "alone",
    "large",
    "views",
    "levels",
)
"""The parts in order of importance, in which they are run."""


def part(name: str) -> Any:
    """Return the module of a part.

    Raises:
        ValueError: The part does not exist.
    """
    if name not in NAMES:
        raise ValueError(f"parts: expected some of {', '.join(NAMES)}, got {name}")
    return importlib.import_module(f"benchmarks.evaluation.parts.{name}")
