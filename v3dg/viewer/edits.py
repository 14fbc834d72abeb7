"""New assets that a page requests: checks of their names, and writing of their
files."""

import os
from pathlib import Path

from v3dg._json import is_one_line
from v3dg._numbers import check
from v3dg.gaussians import Gaussians
from v3dg.io import WRITE_SUFFIXES, write_asset


def check_new_name(name: str) -> None:
    """Raise ValueError unless a name is a visible file name without a folder and with
    the suffix of an asset."""
    is_plain = is_one_line(name) and not name.startswith(".") and "/" not in name
    check("name", is_plain and "\\" not in name, f"a file name without a folder, got {name!a}")
    stem_is_there = not name.lower().startswith(WRITE_SUFFIXES)
    is_asset = name.lower().endswith(WRITE_SUFFIXES) and stem_is_there
    check("name", is_asset, f"a name ending in {', '.join(WRITE_SUFFIXES)}, got {name}")


def write_new_asset(folder: Path, name: str, gaussians: Gaussians) -> None:
    """Write an asset to a new file. An existing file is never overwritten.

    Raises:
        ValueError: The file exists, or the format cannot represent a value.
        OSError: The file cannot be written.
    """
    check_new_name(name)
    path = folder / name
    try:
        # An empty file reserves the name first, so that two pages cannot both write it.
        os.close(os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
    except FileExistsError:
        raise ValueError(
            f"{name}: a file with this name already exists; choose another name"
        ) from None
    try:
        write_asset(path, gaussians)
    except BaseException:
        path.unlink(missing_ok=True)
        raise
