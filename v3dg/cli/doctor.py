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
from typing import NamedTuple

from v3dg import _core, _device
from v3dg._extras import EXTRAS
from v3dg._version import __version__
from v3dg.cli._common import Common, print_result
from v3dg.render.webgpu.gpu import Gpu

_PATIENCE_S = 20  # time limit in seconds for the answer of a program


@dataclass
class Doctor(Common):
    """List the software and hardware that v3dg can use. For missing parts, print their
    purpose and how to get them."""


def run(options: Doctor) -> None:
    findings = list(_findings())
    result = []
    for finding in findings:
        missing = None
        if not finding.version:
            missing = finding.advice
        result.append({"part": finding.part, "found": finding.version, "missing": missing})
    width = max(len(finding.part) for finding in findings)
    lines = []
    for finding in findings:
        text = finding.version or f"missing, {finding.advice}"
        lines.append(f"{finding.part:<{width}}  {text}")
    print_result({"parts": result}, lines, as_json=options.json)


class _Finding(NamedTuple):
    """A part of the machine's software or hardware that v3dg can use."""

    part: str
    version: str | None  # a description of the installed part; None if it is missing
    advice: str  # the purpose of the part, and how to get it


def _findings() -> Iterator[_Finding]:
    cuda = "without CUDA"
    if _core.has_cuda:
        cuda = "with CUDA"
    folder = os.path.dirname(_core.__file__)
    version = f"{__version__} {cuda}, {_core.isa()}, {os.cpu_count()} CPU cores, in {folder}"
    yield _Finding("v3dg", version, "")
    python = f"{platform.python_version()} on {platform.system()} {platform.machine()}"
    yield _Finding("Python", python, "")
    compiler = _answer(os.environ.get("CXX", "c++"), "--version")
    yield _Finding(
        "compiler", compiler, "to build from source: apt install g++, or your system's package"
    )
    nvcc = os.environ.get("CUDACXX") or shutil.which("nvcc") or "/usr/local/cuda/bin/nvcc"
    advice = "12.4 or newer, to build with CUDA: https://developer.nvidia.com/cuda-downloads"
    yield _Finding("CUDA toolkit", _answer(nvcc, "--version", line=-2), advice)
    gpu = _answer("nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader")
    yield _Finding(
        "GPU, driver", gpu, "to draw and build with CUDA; the CPU can do the same, but slower"
    )
    missing = _device.missing_for_cuda()
    status = None
    if not missing:
        status = "works"
    yield _Finding("CUDA", status, f"to draw and build on a GPU: {missing}")
    yield _webgpu()
    for extra in EXTRAS.values():
        name = re.split(r"[\[>]", extra.requirement)[0]
        installed: str | None = None
        with contextlib.suppress(metadata.PackageNotFoundError):
            installed = metadata.version(name)
        yield _Finding(name, installed, f"for {extra.purpose}: pip install '{extra.requirement}'")
    browser = None
    with contextlib.suppress(webbrowser.Error):
        browser = getattr(webbrowser.get(), "name", "there")
    advice = (
        "if there is no browser or no screen, open the address that `v3dg view` prints in any "
        "browser"
    )
    yield _Finding("web browser", browser, advice)


def _webgpu() -> _Finding:
    """Return the adapter of WebGPU."""
    try:
        return _Finding("WebGPU", Gpu().name, "")
    except (ImportError, RuntimeError) as error:
        return _Finding("WebGPU", None, f"to draw on GPUs of any maker: {error}")


def _answer(*command: str, line: int = 0) -> str | None:
    """Return a line of a program's output; None if the program is missing or fails."""
    with contextlib.suppress(OSError, subprocess.SubprocessError, IndexError):
        process = subprocess.run(
            command, capture_output=True, text=True, timeout=_PATIENCE_S, check=True
        )
        return process.stdout.splitlines()[line].strip()
    return None
