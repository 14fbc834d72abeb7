"""`v3dg doctor`."""

import contextlib
import os
import platform
import re
import shutil
import subprocess
import webbrowser
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata

from v3dg import _core, _device
from v3dg._extras import EXTRAS
from v3dg._version import __version__
from v3dg.cli._common import Common, print_result

_PATIENCE_S = 20  # for an answer of a program


@dataclass
class Doctor(Common):
    """Say what of this machine v3dg can use, what is missing, what that would be for, and how to get it."""


def run(options: Doctor) -> None:
    findings = list(_findings())
    result = [
        {"part": part, "found": found, "missing": None if found else advice}
        for part, found, advice in findings
    ]
    width = max(len(part) for part, _, _ in findings)
    lines = [f"{part:<{width}}  {found or f'missing, {advice}'}" for part, found, advice in findings]
    print_result(options.json, {"parts": result}, lines)


def _findings() -> Iterator[tuple[str, str | None, str]]:
    """Each part's name, and what there is of it, or else what it would be for and how to get it."""
    built = f"{'with' if _core.has_cuda else 'without'} CUDA, {_core.isa()}, {os.cpu_count()} CPU cores"
    yield "v3dg", f"{__version__} {built}, in {os.path.dirname(_core.__file__)}", ""
    yield "Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}", ""
    compiler = _answer(os.environ.get("CXX", "c++"), "--version")
    yield "compiler", compiler, "to build from source: apt install g++, or as your system has it"
    nvcc = os.environ.get("CUDACXX") or shutil.which("nvcc") or "/usr/local/cuda/bin/nvcc"
    advice = "12.4 or newer, to build with CUDA: https://developer.nvidia.com/cuda-downloads"
    yield "CUDA toolkit", _answer(nvcc, "--version", line=-2), advice
    gpu = _answer("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")
    yield "GPU, driver", gpu, "to draw and build with CUDA; the CPU can do all of it, too"
    missing = _device.missing_for_cuda()
    yield "CUDA", None if missing else "works", f"to draw and build on a GPU: {missing}"
    for requirement, purpose in EXTRAS.values():
        name, version = re.split(r"[\[>]", requirement)[0], None
        with contextlib.suppress(metadata.PackageNotFoundError):
            version = metadata.version(name)
        yield name, version, f"for {purpose}: pip install '{requirement}'"
    browser = None
    with contextlib.suppress(webbrowser.Error):
        browser = getattr(webbrowser.get(), "name", "there")
    yield "web browser", browser, "or no screen: open the address that `v3dg view` prints in any browser"


def _answer(*command: str, line: int = 0) -> str | None:
    """A line of what a program prints; None where it is not there or fails."""
    with contextlib.suppress(OSError, subprocess.SubprocessError, IndexError):
        done = subprocess.run(command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True)
        return done.stdout.splitlines()[line].strip()
    return None
