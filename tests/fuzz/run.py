"""Run a fuzzer for some time, and keep the inputs that reach all it reached.

    python tests/fuzz/run.py ply|bundle|scene|formats SECONDS

The .ply fuzzer is C++ and wants clang++ (CLANG names another one), the others want atheris. They work in
build/fuzz; what stops one is there as crash-*. Inputs go to tests/fuzz/corpus, which test_fuzz.py replays.
"""

import os
import subprocess
import sys
import zipfile
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
MAX_BYTES = {"ply": 8192, "bundle": 20_000, "scene": 8192, "formats": 4096}
KEPT_BYTES = {"ply": 1000, "bundle": 10_000, "scene": 3000, "formats": 3000}


def command_of(name, folder):
    if name != "ply":
        return [str(HERE / f"fuzz_{name}.py")]
    sources = [HERE / "fuzz_ply.cpp", *(ROOT / "csrc/io" / f"ply_{part}.cpp" for part in ("header", "read"))]
    checks = ["-fsanitize=fuzzer,address,undefined", "-fno-sanitize-recover=undefined"]
    program = folder / "fuzz_ply"
    compiler = os.environ.get("CLANG", "clang++")
    options = ["-std=c++17", "-g", "-O1", *checks, "-fopenmp", "-I", str(ROOT / "csrc")]
    subprocess.run([compiler, *options, *map(str, sources), "-o", str(program)], check=True)
    return [str(program)]


def keep(corpus, archive, max_bytes):
    """The same inputs give the same archive."""
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as file:
        for path in sorted(corpus.iterdir()):
            if path.stat().st_size <= max_bytes:
                file.writestr(zipfile.ZipInfo(path.name), path.read_bytes(), zipfile.ZIP_DEFLATED)


def main():
    name, seconds = sys.argv[1:]
    folder = ROOT / "build" / "fuzz" / name
    found, kept = folder / "found", folder / "kept"
    for path in (found, kept):
        path.mkdir(parents=True, exist_ok=True)
    archive = HERE / "corpus" / f"{name}.zip"
    if archive.exists():
        zipfile.ZipFile(archive).extractall(found)
    environment = os.environ | {
        "OMP_NUM_THREADS": "1",
        # Each input is a file for a moment: a disk would be most of the time.
        **({"TMPDIR": "/dev/shm"} if Path("/dev/shm").is_dir() else {}),
        # Merging starts the program anew by its own name, and with it the interpreter.
        "PATH": os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]]),
    }
    subprocess.run([sys.executable, str(HERE / "make_seeds.py"), str(folder / "seeds")], check=True)
    command = command_of(name, folder)
    start = [
        "-timeout=30",
        f"-max_len={MAX_BYTES[name]}",
        "-print_final_stats=1",
        f"-max_total_time={seconds}",
    ]
    words = HERE / f"{name}.dict"
    start += [f"-dict={words}"] if words.exists() else []
    seeds = str(folder / "seeds" / name)
    subprocess.run(
        [*command, *start, str(found), seeds],
        cwd=folder,
        env=environment,
        check=True,
    )
    for path in kept.iterdir():
        path.unlink()
    subprocess.run(
        [*command, "-set_cover_merge=1", f"-max_len={KEPT_BYTES[name]}", str(kept), str(found), seeds],
        cwd=folder,
        env=environment,
        check=True,
    )
    archive.parent.mkdir(exist_ok=True)
    keep(kept, archive, KEPT_BYTES[name])


if __name__ == "__main__":
    main()
