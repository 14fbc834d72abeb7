"""The parts of the evaluation, a module each.

A part has a TITLE, a sentence or two ABOUT what it asks, and three functions:
run(evaluation) measures and returns what JSON can hold, or yields it again each time
that it knows more; tables(result) gives that as Markdown; summary(result) says in a
sentence or two where we win and where we do not. Where there is something to plot,
plot(result, figure) draws it.
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
"""In order of importance, in which they are run."""


def part(name: str) -> Any:
    """The module of a part.

    Raises:
        ValueError: There is no such part.
    """
    if name not in NAMES:
        raise ValueError(f"parts: expected some of {', '.join(NAMES)}, got {name}")
    return importlib.import_module(f"benchmarks.evaluation.parts.{name}")
