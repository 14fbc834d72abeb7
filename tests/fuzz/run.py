"""Fuzz the .ply reader, which is C++, for some time, and keep the inputs that reach all
it reached.

    python tests/fuzz/run.py SECONDS

It is guided by coverage and needs clang++ (CLANG names another one). It works in
build/fuzz; what stops it is there as crash-*. Inputs go to tests/fuzz/corpus, which
attack/test_fuzz.py replays. What is not C++ is attack.py's.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1] / "files"))


import numpy as np

from test_ply import HOSTILE, Element, ply_bytes, random_columns

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
MAX_BYTES, KEPT_BYTES = 8192, 1000
LARGEST_SEED = 10_000  # bytes; a few of the broken files are made large


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


def compiled(folder):
    sources = [
        HERE / "fuzz_ply.cpp",
        ROOT / "csrc/base/threads.cpp",
        *(
            ROOT / "csrc/io" / f"ply_{part}.cpp"
            for part in ("fields", "header", "read", "rows", "text")
        ),
    ]
    checks = ["-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=undefined"]
    program = folder / "fuzz_ply"
    compiler = os.environ.get("CLANG", "clang++")
    options = ["-std=c++20", "-g", "-O1", *checks, "-fopenmp", "-I", str(ROOT / "csrc")]
    subprocess.run([compiler, *options, *map(str, sources), "-o", str(program)], check=True)
    return str(program)


def keep(corpus, archive, max_bytes):
    """The same inputs give the same archive."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(corpus.iterdir()):
            if path.stat().st_size <= max_bytes:
                file.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)


def main():
    (seconds,) = sys.argv[1:]
    folder = ROOT / "build" / "fuzz" / "ply"
    seeds, found, kept = (folder / name for name in ("seeds", "found", "kept"))
    for path in (seeds, found, kept):
        path.mkdir(parents=True, exist_ok=True)
    for i, content in enumerate(ply_seeds()):
        (seeds / f"seed_{i:02}").write_bytes(content)
    archive = HERE / "corpus" / "ply.zip"
    zipfile.ZipFile(archive).extractall(found)
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    program = compiled(folder)
    options = [
        "-timeout=30",
        "-print_final_stats=1",
        f"-max_len={MAX_BYTES}",
        f"-max_total_time={seconds}",
    ]
    start = [program, *options, f"-dict={HERE / 'ply.dict'}", str(found), str(seeds)]
    subprocess.run(start, cwd=folder, env=environment, check=True)
    for path in kept.iterdir():
        path.unlink()
    merge = [
        program,
        "-set_cover_merge=1",
        f"-max_len={KEPT_BYTES}",
        str(kept),
        str(found),
        str(seeds),
    ]
    subprocess.run(merge, cwd=folder, env=environment, check=True)
    keep(kept, archive, KEPT_BYTES)


if __name__ == "__main__":
    main()
