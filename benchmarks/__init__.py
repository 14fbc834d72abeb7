"""Speeds and errors of v3dg, and worlds to measure them on; run from a checkout, never
installed."""

import sys
from pathlib import Path

# `python -m` puts the checkout first, where v3dg/ would hide the installed package.
# Unless a compiled module lies beside the sources, the checkout is moved to the end.
_ROOT = Path(__file__).resolve().parent.parent
if not any((_ROOT / "v3dg").glob("_core.*.so")):
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != _ROOT] + [
        str(_ROOT)
    ]
