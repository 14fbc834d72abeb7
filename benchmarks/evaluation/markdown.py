"""Markdown tables from the rows of a result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from benchmarks.evaluation.measure import Row


@dataclass(frozen=True)
class Column:
    """A column of a table: the title, the key in a row, and the format, such as ".3f"
    or "count"."""

    title: str
    key: str
    format: str = ""

    def text(self, row: Row) -> str:
        value: Any = row.get(self.key)
        if value is None:
            return "-"
        if self.format == "count":
            return count_text(value)
        return format(value, self.format)


def count_text(count: float) -> str:
    """Return a count with three digits, such as 940, 12.3 k or 4.56 M."""
    for factor, unit in ((1e9, " G"), (1e6, " M"), (1e3, " k")):
        if count >= factor:
            return f"{count / factor:.3g}{unit}"
    return f"{count:g}"


def markdown(columns: Sequence[Column], rows: Sequence[Row]) -> str:
    lines = [" | ".join(column.title for column in columns), " | ".join("---" for _ in columns)]
    lines += [" | ".join(column.text(row) for column in columns) for row in rows]
    return "\n".join(f"| {line} |" for line in lines)
