"""Tests run on the installed package, unless a compiled module lies beside the sources
(see CMakePresets)."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent
IS_COMPILED_HERE = any((ROOT / "v3dg").glob("_core.*.so"))

if not IS_COMPILED_HERE:
    # `python -m pytest` puts the folder that it runs in first, where v3dg/ would hide
    # the installed package.
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]
if str(ROOT) not in sys.path:
    sys.path.append(str(ROOT))  # for benchmarks/


@pytest.fixture(scope="session", autouse=not IS_COMPILED_HERE)
def outside_the_source_folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the source folder out of the way of the Pythons that tests start, too."""
    before = Path.cwd()
    os.chdir(tmp_path_factory.mktemp("elsewhere"))
    yield
    os.chdir(before)
