"""What several commands do: read files, print results."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeAlias

import tyro

from v3dg.io import SUFFIXES

if TYPE_CHECKING:
    from v3dg.bundle import Bundle
    from v3dg.gaussians import Gaussians


class UsageError(Exception):
    """Arguments that cannot be meant; exit code 2."""


# What a command may fail with, in one line on stderr; else there is a mistake of ours to be seen.
FAILURES = (OSError, MemoryError, ValueError, RuntimeError, ImportError)


def failure_text(error: BaseException) -> str:
    """One line that says what failed."""
    if isinstance(error, OSError) and error.filename:
        text = f"{error.filename}: {error.strerror}"
    elif isinstance(error, MemoryError):
        numbers = f" ({error})" if str(error) else ""
        text = f"not enough memory{numbers}; use smaller pictures or a smaller asset"
    else:
        text = str(error)
    return " ".join(text.split())


def option(metavar: str, *aliases: str) -> Any:
    """Annotation of an option that is None where it is not given, of which its help says what that means."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases or None, help_behavior_hint="")


Flag: TypeAlias = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Threads: TypeAlias = Annotated[int | None, option("N")]


def load_asset_or_bundle(path: Path) -> Gaussians | Bundle:
    from v3dg.bundle import Bundle
    from v3dg.io import read_asset

    return Bundle.open(path) if path.suffix == ".v3dg" else read_asset(path)


def require_file(path: Path, *suffixes: str) -> None:
    if not path.exists():
        raise ValueError(f"{path}: expected a file, got a path where there is none; check it")
    if not path.name.lower().endswith(suffixes):
        raise ValueError(f"{path}: expected a file ending in {', '.join(suffixes)}")


def require_subject(path: Path) -> None:
    """Check that a file is there and is a scene, a bundle or an asset by its name."""
    require_file(path, *SUFFIXES, ".v3dg", ".json")


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
