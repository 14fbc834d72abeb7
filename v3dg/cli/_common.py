"""Code that the commands share: options, checks of paths, and printing of results."""

import difflib
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from v3dg._numbers import refuse
from v3dg._progress import waiting
from v3dg._urls import beside, cleaned, is_url, shown
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.formats.content import content_of
from v3dg.io import SUFFIXES, asset_file, is_asset_by_content
from v3dg.opening import open_with_cameras
from v3dg.scene import Subject


class UsageError(Exception):
    """Raised for wrong arguments; the exit code is 2."""


# Exceptions that a command reports as one line on stderr. Any other exception is a bug,
# so its traceback is shown.
FAILURES = (OSError, MemoryError, ValueError, RuntimeError, ImportError)


def failure_text(error: BaseException) -> str:
    """Return a one-line description of a failure."""
    if isinstance(error, OSError) and error.strerror:
        if error.filename:
            return f"{error.filename}: {error.strerror}"
        return error.strerror
    if isinstance(error, MemoryError):
        numbers = ""
        if str(error):
            numbers = f" ({error})"
        return f"not enough memory{numbers}; use smaller pictures or a smaller asset"
    return str(error)


def printable(line: str) -> str:
    """Return a line in which control characters are escaped, because file names and
    content of files may contain them."""
    return "".join(map(_printable_letter, line))


def _printable_letter(letter: str) -> str:
    if letter.isprintable():
        return letter
    return letter.encode("unicode_escape").decode()


def tell(text: str) -> None:
    """Print one line on stderr, without the secret parts of URLs."""
    print(printable(" ".join(cleaned(text).split())), file=sys.stderr)


def option(metavar: str, *aliases: str) -> object:
    """Return the annotation of an option whose default is None; its help text describes
    the default."""
    return tyro.conf.arg(metavar=metavar, aliases=aliases or None, help_behavior_hint="")


Flag: TypeAlias = Annotated[bool, tyro.conf.arg(help_behavior_hint="")]
Color: TypeAlias = tuple[float, float, float]
Threads: TypeAlias = Annotated[int | None, option("N")]


@dataclass(kw_only=True)
class Common:
    """Options that every command has."""

    threads: Threads = None
    """Number of CPU threads; all cores by default."""
    json: Flag = False
    """Print the result as JSON."""
    quiet: Flag = False
    """Show no progress."""


@dataclass(kw_only=True)
class OnDevice(Common):
    device: Literal["auto", "cpu", "cuda"] = "auto"
    """Device that computes; auto is a CUDA device if torch can use one, otherwise the
    CPU."""


@dataclass(kw_only=True)
class OnAnyDevice(Common):
    device: Literal["auto", "cpu", "cuda", "webgpu"] = "auto"
    """Device that draws; auto is a CUDA device if torch can use one, otherwise the CPU.
    webgpu draws scenes and bundles on a GPU of any maker, with the package wgpu."""


@dataclass(kw_only=True)
class Pooled:
    """The option for the memory of a pool."""

    memory: Annotated[str, option("SIZE")] = "auto"
    """Memory of the device for pages of bundles, such as 2GB. Pages are read from the
    files as cameras need them. `all` loads everything; `auto` loads everything if it
    fits into the free memory, and otherwise uses half of the free memory."""

    def pool(self) -> str | None:
        """Return the size of the pool as an argument of `Renderer`; None means no
        pool."""
        if self.memory == "all":
            return None
        return self.memory


@dataclass(kw_only=True)
class OnPool(Pooled, OnDevice):
    """Options of commands that draw from a pool."""


@dataclass(kw_only=True)
class Cut:
    """Options for the cut of a bundle or a scene."""

    tolerance: Annotated[float | None, option("PX2")] = None
    """Largest screen area in px² that one gaussian of a coarser cluster may stand for.
    The default is 3; 0 draws full detail."""
    budget: Annotated[int | None, option("N")] = None
    """Largest number of gaussians in one picture. Without --tolerance, the picture is
    as fine as the budget allows."""


def check_usage(name: str, holds: object, expected: str) -> None:
    """Raise UsageError with the message ``name: expected ...`` unless ``holds``."""
    if not holds:
        raise UsageError(f"{name}: expected {expected}")


def check_range(name: str, value: float, minimum: float, maximum: float) -> None:
    check_usage(name, minimum <= value <= maximum, f"{minimum:,} to {maximum:,}, got {value}")


def color_of(value: Color | str) -> Color | None:
    """Return the colour of --background; None if the value is `none`.

    Raises:
        UsageError: The value is not a colour.
    """
    if value == "none":
        return None
    if not isinstance(value, str):
        is_color = all(0 <= part <= 1 for part in value)
        check_usage("--background", is_color, f"three numbers from 0 to 1, got {value}")
        return value
    from PIL import ImageColor

    try:
        red, green, blue, *_ = ImageColor.getrgb(value)
    except ValueError:
        expected = "three numbers from 0 to 1, a colour such as white or #87ceeb, or none"
        raise UsageError(f"--background: expected {expected}, got {value}") from None
    return red / 255, green / 255, blue / 255


def require_file(path: Path, *suffixes: str) -> None:
    if not is_url(path) and not path.exists():
        if path.is_symlink():
            expected = (
                f"a file, got a link to {os.readlink(path)}, which does not exist; repair the link"
            )
        else:
            expected = f"a file, got a path that does not exist{_similar(path)}"
        refuse(path, expected)
    if beside(asset_file(path)).name.lower().endswith(suffixes):
        return
    content = None
    if not is_url(path):
        content = content_of(path)
    is_readable = content is not None and content.suffix in suffixes
    if is_readable and is_asset_by_content(path):
        return
    problem = "another suffix"
    if path.is_dir():
        problem = "a folder"
    elif content is not None:
        problem = content.text
    if is_readable:
        problem += "; rename it to end in that"
    refuse(shown(path), f"a file ending in {', '.join(suffixes)}, got {problem}")


def _similar(path: Path) -> str:
    """Return advice for a file that does not exist: a similar name in its folder, if
    there is one."""
    if path.parent.is_dir():
        names = [name for name in os.listdir(path.parent) if path.with_name(name).exists()]
        similar = difflib.get_close_matches(path.name, names, 1, 0.75)
        if similar:
            return f"; perhaps you meant {path.with_name(similar[0])}"
    return "; check the path"


def open_subject(path: Path, *, show: bool) -> tuple[Subject, dict[str, Camera] | None]:
    """Open a scene with its cameras, a bundle or an asset. With ``show``, report on
    stderr that the file is being read."""
    with waiting(printable(f"reading {shown(path)}"), show=show):
        return open_with_cameras(path)


def check_output(output: Path, *inputs: Path) -> None:
    """Raise an error for an output that is a URL or that would overwrite an input. The
    input may contain more than the output."""
    check_usage(shown(output), not is_url(output), "a local file as output, got a URL")
    for path in inputs:
        is_another = not (output.exists() and path.exists() and output.samefile(path))
        check_usage(
            str(output),
            is_another,
            f"an output that is not the input {shown(path)}, got the same file; choose another "
            "name",
        )


def require_subject(path: Path) -> None:
    """Check that a file exists and has the name of a scene, a bundle or an asset."""
    require_file(path, *SUFFIXES, ".v3dg", ".json")


def level_size(bundle: Bundle, level: int) -> int:
    clusters = bundle.level_range(level)
    return int(bundle.clusters.offset[clusters.stop] - bundle.clusters.offset[clusters.start])


def finite(number: float) -> float | None:
    """Return a number for JSON, which has no infinity; infinity becomes None. A
    tolerance is infinite if the budget is very small."""
    if math.isfinite(number):
        return number
    return None


def print_result(result: Mapping[str, object], lines: Iterable[str], *, as_json: bool) -> None:
    """Print a result on stdout, as JSON or as lines of text."""
    if as_json:
        print(json.dumps(result, indent=1), flush=True)
    else:
        print("\n".join(map(printable, lines)), flush=True)


@dataclass(frozen=True)
class Column:
    """A column of a table: its heading, and the format of its cells for
    `str.format_map`."""

    head: str
    form: str

    def cell(self, row: Mapping[str, object]) -> str:
        """Return the cell of a row; `-` if the row lacks a value."""
        try:
            return printable(self.form.format_map(row))
        # The value is missing, or it is None, which has no numeric format.
        except (KeyError, TypeError):
            return "-"


def table_lines(columns: Sequence[Column], rows: Iterable[Mapping[str, object]]) -> list[str]:
    """Return the lines of a table. The first column is aligned to the left, all others
    to the right."""
    table = [[column.head for column in columns]]
    for row in rows:
        table.append([column.cell(row) for column in columns])
    widths = [max(map(len, cells)) for cells in zip(*table, strict=True)]
    lines = []
    for first_cell, *cells in table:
        aligned = [first_cell.ljust(widths[0])]
        aligned += [cell.rjust(width) for cell, width in zip(cells, widths[1:], strict=True)]
        lines.append("  ".join(aligned).rstrip())
    return lines


def bytes_text(count: int) -> str:
    for factor, unit in ((1 << 30, "GiB"), (1 << 20, "MiB"), (1 << 10, "KiB")):
        if count >= factor:
            return f"{count / factor:.1f} {unit}"
    return f"{count} B"
