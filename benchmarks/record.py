"""What every recorded result says of itself: commit, machine, command."""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from v3dg import _core


def provenance() -> dict[str, Any]:
    """Commit, command, processor, threads and instruction set of this run."""
    folder = Path(__file__).parent
    commit = subprocess.run(
        ["git", "-C", folder, "describe", "--always", "--dirty", "--abbrev=12"],
        capture_output=True,
        text=True,
    ).stdout.strip()
    lines = Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return {
        "commit": commit or "unknown",
        "command": " ".join(Path(a).name if os.sep in a else a for a in sys.argv),
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "threads": int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)),
        "isa": _core.isa(),
        "python": platform.python_version(),
    }


def write(path: str | None, result: dict[str, Any]) -> None:
    """Write a result with its provenance as JSON; to nowhere if `path` is None."""
    if path is not None:
        Path(path).write_text(json.dumps({**provenance(), **result}, indent=1) + "\n")
