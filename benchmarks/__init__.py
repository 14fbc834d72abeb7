"""Benchmarks of the speed and errors of v3dg, and generators of worlds for them. The
package runs from a checkout and is never installed."""

import sys
from pathlib import Path

# `python -m` puts the checkout first on the path, where its folder v3dg/ would hide the
# installed package. Unless the sources contain a compiled module, the checkout is moved
# to the end.
_ROOT = Path(__file__).resolve().parent.parent
if not any((_ROOT / "v3dg").glob("_core.*.so")):
    sys.path[:] = [entry for entry in sys.path if Path(entry or ".").resolve() != _ROOT] + [
        str(_ROOT)
    ]
