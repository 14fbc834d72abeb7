"""Fuzzes the .ply reader or the C library, which are C++, for some time. Stores a set
of inputs that together reach all code that was reached.

    python tests/fuzz/run.py SECONDS [ply | c_library]

The fuzzers are guided by coverage. They need clang++ (CLANG names another compiler),
and for the C library nlohmann/json.hpp. They work in build/fuzz and write inputs that
crash to crash-* in that folder. Other inputs are stored in tests/fuzz/corpus, and
attack/test_fuzz.py replays them; for the C library, unit/c_interface/test_c_files.py
does so. attack.py fuzzes the code that is not C++.
"""

import argparse
import os
import re
import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "support"))
sys.path.insert(0, str(Path(__file__).parents[1] / "files"))


import numpy as np

import c_library
from test_ply import HOSTILE, Element, ply_bytes, random_columns

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
GOLDEN = HERE.parent / "golden"
CHECKS = ["-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=undefined"]
PLY_SOURCES = {
    "threads.cpp",
    *(f"ply_{n}.cpp" for n in ("fields", "header", "read", "rows", "text")),
}
MAX_BYTES = {"ply": 8192, "c_library": 16384}
KEPT_BYTES = {"ply": 1000, "c_library": 12000}
# limit in bytes, because a few of the broken files are intentionally large
LARGEST_SEED = 10_000


def ply_seeds():
    for encoding in ("ascii", "binary_little_endian", "binary_big_endian"):
        for degree in (0, 1):
            columns = random_columns(2, degree)
            with_list = {"n": [np.arange(2, dtype="i4")] * 2, **columns}
            wide = {name: column.astype("f8") for name, column in columns.items()}
            face = Element("face", {"indices": [np.arange(3, dtype="u2")]})
            yield ply_bytes([Element("vertex", columns)], encoding)
            yield ply_bytes([Element("vertex", wide)], encoding, "\r\n")
            yield ply_bytes([face, Element("vertex", with_list), face], encoding)
    yield from (content for content, _ in HOSTILE.values() if len(content) <= LARGEST_SEED)


def c_library_seeds():
    """Return bundles of all versions, and the inputs that the fuzzers of the Python
    readers kept."""
    yield from (path.read_bytes() for path in sorted(GOLDEN.glob("*.v3dg")))
    for name in ("bundle", "scene"):
        with zipfile.ZipFile(HERE / "corpus" / f"{name}.zip") as archive:
            yield from map(archive.read, archive.namelist())


def cmake_sources(*names):
    """Return the sources in lists of CMakeLists.txt."""
    text = (ROOT / "CMakeLists.txt").read_text(encoding="utf-8")
    for name in names:
        yield from (ROOT / path for path in re.search(rf"set\({name}\s([^)]*)\)", text)[1].split())


def c_library_sources(folder):
    """Return the sources of the C library. Sources that are compiled for several
    instruction sets are compiled only for the basic one here."""
    yield from cmake_sources("V3DG_CUT_SOURCES", "V3DG_C_SOURCES")
    for isa in ("baseline", "avx2", "avx512"):
        for source in cmake_sources("V3DG_CUT_SIMD_SOURCES"):
            wrapped = folder / f"{source.stem}_{isa}.cpp"
            wrapped.write_text(f'#define V3DG_ISA isa_{isa}\n#include "{source}"\n')
            yield wrapped


def compiled(folder, target="ply"):
    """Compile the fuzzer of a target and return its path."""
    options = ["-std=c++20", "-g", "-O1", *CHECKS, "-fopenmp", "-I", str(ROOT / "csrc")]
    if target == "ply":
        sources = [*cmake_sources("V3DG_SOURCES"), ROOT / "csrc" / "base" / "threads.cpp"]
        sources = [path for path in sources if path.name in PLY_SOURCES]
    else:
        sources = list(c_library_sources(folder))
        options += ["-I", str(ROOT / "include"), "-ffp-contract=off", "-pthread"]
        if c_library.json_folder() is not None:
            options += ["-isystem", str(c_library.json_folder())]
    program = folder / f"fuzz_{target}"
    sources.append(HERE / f"fuzz_{target}.cpp")
    compiler = os.environ.get("CLANG", "clang++")
    subprocess.run([compiler, *options, *map(str, sources), "-o", str(program)], check=True)
    return str(program)


def keep(corpus, archive, max_bytes):
    """Store inputs in an archive whose bytes depend only on them."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(corpus.iterdir()):
            if path.stat().st_size <= max_bytes:
                file.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("seconds", type=int)
    parser.add_argument("target", nargs="?", default="ply", choices=SEEDS)
    options = parser.parse_args()
    target = options.target
    folder = ROOT / "build" / "fuzz" / target
    seeds, found, kept = (folder / name for name in ("seeds", "found", "kept"))
    for path in (seeds, found, kept):
        path.mkdir(parents=True, exist_ok=True)
    for i, content in enumerate(SEEDS[target]()):
        (seeds / f"seed_{i:02}").write_bytes(content)
    archive = HERE / "corpus" / f"{target}.zip"
    if archive.exists():
        zipfile.ZipFile(archive).extractall(found)
    # the inputs for scenes refer to this bundle
    shutil.copy(GOLDEN / "bundle_3_quantized.v3dg", folder / "a.v3dg")
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    program = compiled(folder, target)
    command = [
        program,
        "-timeout=30",
        "-print_final_stats=1",
        f"-max_len={MAX_BYTES[target]}",
        f"-max_total_time={options.seconds}",
        f"-dict={HERE / f'{target}.dict'}",
        str(found),
        str(seeds),
    ]
    subprocess.run(command, cwd=folder, env=environment, check=True)
    for path in kept.iterdir():
        path.unlink()
    merge = [
        program,
        "-set_cover_merge=1",
        f"-max_len={KEPT_BYTES[target]}",
        str(kept),
        str(found),
        str(seeds),
    ]
    subprocess.run(merge, cwd=folder, env=environment, check=True)
    keep(kept, archive, KEPT_BYTES[target])


SEEDS = {"ply": ply_seeds, "c_library": c_library_seeds}

if __name__ == "__main__":
    main()
