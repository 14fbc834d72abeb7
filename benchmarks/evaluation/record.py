"""The provenance in every recorded result: commit, machine, versions and command."""

from __future__ import annotations

import importlib.metadata
import json
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

from v3dg import _core

_LIBRARIES = ("numpy", "torch", "gsplat", "flip-evaluator")


def provenance(device: str = "cpu") -> dict[str, Any]:
    """Return commit, command, processor, threads, instruction set and versions; also
    the GPU if `device` is one."""
    names = []
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.exists():
        lines = cpuinfo.read_text().splitlines()
        names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    result: dict[str, Any] = {
        "commit": _commit(),
        "command": _command(),
        "processor": names[0] if names else platform.processor(),
        "cores": os.cpu_count(),
        "threads": int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)),
        "isa": _core.isa(),
        "python": platform.python_version(),
    }
    if device == "cuda":
        import torch

        result |= {"gpu": torch.cuda.get_device_name(), "cuda": str(torch.version.cuda)}
    return result | {name: version for name in _LIBRARIES if (version := _version(name))}


def _command() -> str:
    """Return the command line without folders."""
    words = [Path(word).name if os.sep in word else word for word in sys.argv]
    if words[0] == "__main__.py":
        words[0] = f"python -m {Path(sys.argv[0]).parent.name}"
    return " ".join(words)


def _commit() -> str:
    """Return the commit of the checkout that contains this file, with "-dirty" if files
    have changed. Outside a checkout, return the variable V3DG_COMMIT."""
    done = subprocess.run(
        ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"],
        capture_output=True,
        text=True,
        check=False,
    )
    return done.stdout.strip() or os.environ.get("V3DG_COMMIT", "unknown")


def _version(library: str) -> str | None:
    try:
        return importlib.metadata.version(library)
    except importlib.metadata.PackageNotFoundError:
        return None


def write(path: str | Path | None, result: dict[str, Any], device: str = "cpu") -> None:
    """Write a result with its provenance as JSON; do nothing if `path` is None.

    An interrupted call leaves no partial file.
    """
    if path is None:
        return
    path = Path(path)
    temporary = path.with_name(path.name + ".tmp")
    temporary.write_text(
        json.dumps({**provenance(device), **result}, indent=1) + "\n", encoding="utf-8"
    )
    temporary.replace(path)
