"""Checks with clang that what a mutex guards is used only while the mutex is held.

Reads the annotations of csrc/base/thread_annotations.h in every source that includes
base/mutex.h, itself or through a header. Prints what clang found and fails if there is
anything. Sources of the bindings need pybind11 and are left out where it is not
installed.

    python .ci/check_threads.py [--csrc FOLDER] [--list] [SOURCE ...]

A SOURCE is named as below csrc/, for example residency/page_pool.cpp; the default is
all of them.
CLANG names the compiler (default clang++).
"""

import argparse
import importlib.util
import os
import re
import shutil
import subprocess
import sys
import sysconfig
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

CSRC = Path(__file__).parent.parent / "csrc"
MUTEX = "base/mutex.h"
OPTIONS = ["-std=c++20", "-fsyntax-only", "-DV3DG_WITH_CUDA=0"]
WARNINGS = ["-Wno-everything", "-Wthread-safety", "-Wthread-safety-beta", "-Werror"]


def included(path: Path) -> set[str]:
    """Returns the headers of csrc/ that a file includes itself."""
    text = path.read_text(encoding="utf-8")
    return set(re.findall(r'^#include "([^"]+)"', text, re.MULTILINE))


def sources_with_mutexes(csrc: Path) -> list[str]:
    """Returns the sources that include MUTEX, in any number of steps."""
    users = {MUTEX}
    files = {
        str(path.relative_to(csrc)): included(path)
        for path in csrc.rglob("*")
        if path.suffix in {".h", ".cpp"}
    }
    while found := {name for name in files.keys() - users if files[name] & users}:
        users |= found
    return sorted(name for name in users if name.endswith(".cpp"))


def include_options(csrc: Path) -> list[str]:
    options = ["-I", str(csrc)]
    if importlib.util.find_spec("pybind11") is not None:
        import pybind11

        options += ["-isystem", pybind11.get_include()]
        options += ["-isystem", sysconfig.get_path("include")]
    # Clang has a header of OpenMP only with libomp-dev; the one of gcc will do here.
    if compiler := shutil.which("g++"):
        command = [compiler, "-print-file-name=include"]
        folder = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        options += ["-idirafter", folder]
    return options


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("sources", nargs="*", metavar="SOURCE")
    parser.add_argument("--csrc", type=Path, default=CSRC, help="the folder to check")
    parser.add_argument("--list", action="store_true", help="only print the sources")
    options = parser.parse_args()
    sources = options.sources or sources_with_mutexes(options.csrc)
    if options.list:
        print("\n".join(sources))
        return 0

    name = os.environ.get("CLANG", "clang++")
    clang = shutil.which(name)
    if clang is None:
        advice = "install clang, or set CLANG to its name"
        print(f"CLANG: expected a clang++, got {name!r}; {advice}", file=sys.stderr)
        return 2
    if importlib.util.find_spec("pybind11") is None:
        print("pybind11 is not installed: the bindings are not checked")
        sources = [source for source in sources if not source.startswith("bindings/")]

    command = [clang, *OPTIONS, *WARNINGS, *include_options(options.csrc)]

    def check(source: str) -> int:
        return subprocess.run([*command, str(options.csrc / source)], check=False).returncode

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        codes = list(pool.map(check, sources))
    wrong = [source for source, code in zip(sources, codes, strict=True) if code != 0]
    print(f"{len(sources)} sources with mutexes checked, {len(wrong)} wrong", *wrong)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
