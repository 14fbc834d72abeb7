"""What several commands do: read files, print results."""

import difflib
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import tyro

from v3dg._numbers import check
from v3dg._urls import beside, cleaned, is_url, shown
from v3dg.bundle import Bundle
from v3dg.io import SUFFIXES


class UsageError(Exception):
    """Arguments that cannot be meant; exit code 2."""


# What a command may fail with, in one line on stderr; else there is a mistake of ours to be seen.
FAILURES = (OSError, MemoryError, ValueError, RuntimeError, ImportError)


def failure_text(error: BaseException) -> str:
    """One line that says what failed."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if isinstance(error, MemoryError):
        numbers = f" ({error})" if str(error) else ""
        return f"not enough memory{numbers}; use smaller pictures or a smaller asset"
    return str(error)


def printable(line: str) -> str:
    """A line with escapes for what a terminal would obey: text of files and their names may hold anything."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)


def tell(text: str) -> None:
    """Print one line on stderr, of URLs only what cannot be secret."""
    print(printable(" ".join(cleaned(text).split())), file=sys.stderr)


def option(metavar: str, *aliases: str) -> Any:
    """Annotation of an option that is None where it is not given, of which its help says what that means."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases or None, help_behavior_hint="")


Flag: TypeAlias = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Threads: TypeAlias = Annotated[int | None, option("N")]


@dataclass(kw_only=True)
class Common:
    """Options of every command."""

    threads: Threads = None
    """CPU threads; all if not given."""
    json: Flag = False
    """Print the result as JSON."""
    quiet: Flag = False
    """Show no progress."""


@dataclass(kw_only=True)
class OnDevice(Common):
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Where to compute; auto is a CUDA device where there is one and torch can use it."""


@dataclass(kw_only=True)
class OnPool(OnDevice):
    memory: Annotated[str, option("SIZE")] = "auto"
    """Draw from so much memory of the device, as 2GB, with pages read from the files as cameras need them.
    all: from as much as it takes. auto: so if that fits into what is free, else from half of what is free."""

    def pool(self) -> str | None:
        return None if self.memory == "all" else self.memory


@dataclass(kw_only=True)
class Cut:
    """Which cut of a bundle or a scene is drawn."""

    tolerance: Annotated[float | None, option("PX2")] = None
    """Screen area in px² that one gaussian of a coarser cluster may stand for; 3 if not given, 0: all."""
    budget: Annotated[int | None, option("N")] = None
    """Most gaussians to draw in one picture; without a tolerance, the picture is as fine as that allows."""


def check_usage(name: str, holds: object, expected: str) -> None:
    """Raise UsageError, which names an option and says what was expected and found, unless it holds."""
    if not holds:
        raise UsageError(f"{name}: expected {expected}")


def check_range(name: str, value: float, least: float, most: float) -> None:
    check_usage(name, least <= value <= most, f"{least:,} to {most:,}, got {value}")


def require_file(path: Path, *suffixes: str) -> None:
    check(path, is_url(path) or path.exists(), f"a file, got a path where there is none{_similar(path)}")
    got = "a folder" if path.is_dir() else "another name"
    is_known = beside(path).name.lower().endswith(suffixes)
    check(shown(path), is_known, f"a file ending in {', '.join(suffixes)}, got {got}")


def _similar(path: Path) -> str:
    """What may be meant in place of a file that is not there."""
    names = os.listdir(path.parent) if path.parent.is_dir() else []
    meant = difflib.get_close_matches(path.name, names, 1, 0.75)
    return f"; perhaps you meant {path.with_name(meant[0])}" if meant else "; check it"


def check_output(output: Path, *inputs: Path) -> None:
    """Refuse to write over a file that is read: what is written may be less than what is there."""
    for path in inputs:
        is_another = not (output.exists() and path.exists() and output.samefile(path))
        check_usage(
            str(output), is_another, f"another file than {shown(path)}, which is read; choose another name"
        )


def require_subject(path: Path) -> None:
    """Check that a file is there and is a scene, a bundle or an asset by its name."""
    require_file(path, *SUFFIXES, ".v3dg", ".json")


def level_size(bundle: Bundle, level: int) -> int:
    clusters = bundle.level_range(level)
    return int(bundle.clusters.offset[clusters.stop] - bundle.clusters.offset[clusters.start])


def finite(number: float) -> float | None:
    """A number as JSON has it, which knows no infinity: that of a budget can be infinite."""
    return number if math.isfinite(number) else None


def print_result(as_json: bool, result: dict[str, Any], lines: Iterable[str]) -> None:
    print(json.dumps(result, indent=1) if as_json else "\n".join(map(printable, lines)), flush=True)


def table_lines(columns: str, rows: Iterable[Mapping[str, Any]]) -> list[str]:
    """Lines of a table: by `HEAD = CELL; ...`, how cells show a row; `-` where that lacks a value.

    The first column is to the left, the others to the right.
    """
    forms = dict(column.split(" = ") for column in columns.split("; "))
    table = [list(forms), *([_cell(form, row) for form in forms.values()] for row in rows)]
    first, *others = (max(map(len, column)) for column in zip(*table, strict=True))
    line = "  ".join([f"{{:<{first}}}", *(f"{{:>{width}}}" for width in others)])
    return [line.format(*row).rstrip() for row in table]


def _cell(form: str, row: Mapping[str, Any]) -> str:
    try:
        return printable(form.format_map(row))
    except (KeyError, TypeError):  # there is none, or None, which has no format
        return "-"


def bytes_text(count: int) -> str:
    for factor, unit in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"
