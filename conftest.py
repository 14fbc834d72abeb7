"""Tests run on the installed package, unless a compiled module lies beside the sources (see CMakePresets)."""

import os
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent

if not any((ROOT / "v3dg").glob("_core.*.so")):
    # `python -m pytest` puts the folder that it runs in first, where v3dg/ would hide the installed package.
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != ROOT]
    os.environ["PYTHONSAFEPATH"] = "1"  # the same for the processes that tests start
