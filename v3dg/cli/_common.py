"""What several commands do: read files, print results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from v3dg.bundle import Bundle
    from v3dg.gaussians import Gaussians


class UsageError(Exception):
    """Arguments that cannot be meant; exit code 2."""


def load_asset_or_bundle(path: Path) -> Gaussians | Bundle:
    from v3dg.bundle import Bundle
    from v3dg.io import load

    return Bundle.open(path) if path.suffix == ".v3dg" else load(path)


def require_file(path: Path, *suffixes: str) -> None:
    if path.suffix not in suffixes:
        raise ValueError(f"{path}: expected a file ending in {', '.join(suffixes)}")
    if not path.exists():
        raise ValueError(f"{path}: expected a file, got nothing there; check the path")


def level_size(bundle: Bundle, level: int) -> int:
    clusters = bundle.level_range(level)
    return int(bundle.clusters.offset[clusters.stop] - bundle.clusters.offset[clusters.start])


def print_result(as_json: bool, result: dict[str, Any], text: Callable[[], str]) -> None:
    print(json.dumps(result, indent=1) if as_json else text())


def table_lines(header: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table: the first column to the left, the others to the right."""
    widths = [max(len(row[i]) for row in (header, *rows)) for i in range(len(header))]
    return [
        "  ".join(
            cell.rjust(w) if i else cell.ljust(w) for i, (cell, w) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in (header, *rows)
    ]


def bytes_text(count: int) -> str:
    for factor, unit in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"
