"""The parts of the evaluation, one module each.

A part has two texts, TITLE and ABOUT, which state its question, and three functions.
`run(evaluation)` measures, and returns JSON values or yields them repeatedly as they
grow. `tables(result)` returns the values as Markdown tables. `summary(result)` returns
sentences about where v3dg is better and where it is not. A part may also have
`plot(result, figure)`, which draws a plot.
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
"""The parts in the order in which they run, the most important first."""


def part(name: str) -> Any:
    """Return the module of a part.

    Raises:
        ValueError: There is no part of this name.
    """
    if name not in NAMES:
        raise ValueError(f"parts: expected some of {', '.join(NAMES)}, got {name}")
    return importlib.import_module(f"benchmarks.evaluation.parts.{name}")
