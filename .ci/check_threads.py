"""Checks with clang that every guarded field is used only while its mutex is held.

Clang reads the annotations of csrc/base/thread_annotations.h in every source that
includes base/mutex.h, directly or through a header. The script prints clang's findings
and fails if there are any. Sources of the bindings need pybind11, and sources of CUDA
need the CUDA runtime's header; they are left out if these are not installed.

    python .ci/check_threads.py [--csrc FOLDER] [--list] [SOURCE ...]

A SOURCE is a path below csrc/, for example residency/page_pool.cpp; by default all are
checked. CLANG names the compiler (default clang++).
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
# Many sources include these headers, whose mutexes are used only in the headers. Clang
# checks a header in every source that includes it, so one source suffices.
ENCLOSED = frozenset({"base/first_error.h", "bindings/drawing.h"})
CUDA_RUNTIME = "cuda_runtime.h"
OPTIONS = ["-std=c++20", "-fsyntax-only", "-DV3DG_WITH_CUDA=0"]
WARNINGS = ["-Wno-everything", "-Wthread-safety", "-Wthread-safety-beta", "-Werror"]


def included(path: Path) -> set[str]:
    """Returns the headers that a file includes directly."""
    text = path.read_text(encoding="utf-8")
    return set(re.findall(r'^#include ["<]([^">]+)[">]', text, re.MULTILINE))


def users_of(header: str, csrc: Path, *, without: frozenset[str] = frozenset()) -> set[str]:
    """Returns the files that include a header, directly or through headers."""
    users = {header}
    files = {
        str(path.relative_to(csrc)): included(path)
        for path in csrc.rglob("*")
        if path.suffix in {".h", ".cpp"}
    }
    for name in without:
        files.pop(name, None)
    while found := {name for name in files.keys() - users if files[name] & users}:
        users |= found
    return users


def sources_of(names: set[str]) -> list[str]:
    return sorted(name for name in names if name.endswith(".cpp"))


def sources_with_mutexes(csrc: Path) -> list[str]:
    """Returns the files to check; a header is one of them if no source includes it."""
    users = users_of(MUTEX, csrc, without=ENCLOSED)
    sources = set(sources_of(users))
    for header in ENCLOSED:
        sources |= set(sources_of(users_of(header, csrc))[:1])
    headers = users - sources - {MUTEX}
    return sorted(sources | {name for name in headers if not sources_of(users_of(name, csrc))})


def cuda_headers() -> Path | None:
    """Returns the folder with the CUDA runtime's header, which is found from the path
    of nvcc."""
    nvcc = shutil.which("nvcc")
    folders = [Path("/usr/local/cuda/include")]
    if nvcc is not None:
        folders.insert(0, Path(nvcc).resolve().parent.parent / "include")
    return next((folder for folder in folders if (folder / CUDA_RUNTIME).is_file()), None)


def include_options(csrc: Path) -> list[str]:
    options = ["-I", str(csrc), "-I", str(CSRC.parent / "include")]
    if importlib.util.find_spec("pybind11") is not None:
        import pybind11

        options += ["-isystem", pybind11.get_include()]
        options += ["-isystem", sysconfig.get_path("include")]
    if (cuda := cuda_headers()) is not None:
        options += ["-isystem", str(cuda)]
    # Clang has a header of OpenMP only if libomp-dev is installed. Otherwise GCC's
    # header is used, without an attribute whose argument Clang does not support.
    if compiler := shutil.which("g++"):
        command = [compiler, "-print-file-name=include"]
        folder = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        options += ["-idirafter", folder, "-D__malloc__(function)="]
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
    if cuda_headers() is None:
        print("CUDA's headers are not installed: the sources of CUDA are not checked")
        of_cuda = users_of(CUDA_RUNTIME, options.csrc)
        sources = [source for source in sources if source not in of_cuda]

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
