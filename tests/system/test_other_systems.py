"""The parts of the core that depend on the operating system compile for Windows and
macOS. On this system, a program compiled from them prints the same with any number of
threads."""

import importlib.util
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CSRC = ROOT / "csrc"
BUILDS = [path for name in ("ci/cpp", "dev", "cpu") if (path := ROOT / "build" / name).is_dir()]
# The only sources of the core that may use functions of the operating system directly.
SEAMS = (
    "base/isa.cpp",
    "base/process.cpp",
    "base/thread_pool.cpp",
    "io/hashed_read.cpp",
    "io/ply_header.cpp",
    "io/windows_file.cpp",
)
TARGETS = ("x86_64-windows-gnu", "aarch64-macos", "x86_64-macos")

pytestmark = pytest.mark.skipif(not CSRC.is_dir(), reason="an installed package has no sources")


@pytest.mark.skipif(
    importlib.util.find_spec("ziglang") is None, reason="needs zig: pip install ziglang"
)
@pytest.mark.parametrize("target", TARGETS)
def test_what_differs_between_systems_compiles(target, tmp_path):
    flags = ["-std=c++20", "-Wall", "-Wextra", "-Werror", "-DV3DG_WITH_CUDA=0", f"-I{CSRC}"]
    command = [sys.executable, "-m", "ziglang", "c++", "-target", target, *flags, "-c"]
    for name in SEAMS:
        made = tmp_path / "made.o"
        done = subprocess.run(
            [*command, CSRC / name, "-o", made], capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        assert made.stat().st_size > 0
        made.unlink()


@pytest.fixture(scope="module")
def printed():
    """Return a function that runs the program and returns its lines."""
    if not BUILDS:
        pytest.skip("needs a build by a preset: cmake --preset cpu")
    build = ["cmake", "--build", BUILDS[0], "--target", "portable_core"]
    subprocess.run(build, check=True, capture_output=True)

    def lines(folder, threads):
        environment = {**os.environ, "OMP_NUM_THREADS": str(threads), "V3DG_ISA": "baseline"}
        done = subprocess.run(
            [BUILDS[0] / "portable_core"],
            cwd=folder,
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        )
        return done.stdout.splitlines()

    return lines


def test_the_program_of_other_systems_runs_here(printed, tmp_path):
    alone = printed(tmp_path, 1)
    assert alone[0] == "threads sound, sum 10000, error 4001"
    assert alone[-1] == "missing file: error 2"
    assert printed(tmp_path, 3) == alone
