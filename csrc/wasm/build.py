"""Compile the core to WebAssembly: `python csrc/wasm/build.py OUT.wasm`.

The compiler is zig (`pip install ziglang`).
"""

import subprocess
import sys
import tempfile
from pathlib import Path

CSRC = Path(__file__).parents[1]
SOURCES = (
    "wasm/core.cpp",
    "base/isa.cpp",
    "base/thread_pool.cpp",
    "cluster/check_tables.cpp",
    "io/blake2b.cpp",
    "quantize/quantize_cpu.cpp",
    "residency/cluster_bounds.cpp",
    "residency/cluster_table.cpp",
    "select/select_cpu.cpp",
)
# Other systems compile these for several instruction sets, but WebAssembly has only
# one.
LANE_SOURCES = ("io/blake2b_lanes.cpp",)
TARGET = ("-target", "wasm32-wasi", "-msimd128", "-O2")
FLAGS = (
    "-std=c++20",
    "-fvisibility=hidden",
    # Without contraction, decisions have the same bits as on every other system.
    "-ffp-contract=off",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-DNDEBUG",
    "-DV3DG_WITH_CUDA=0",
)
LINK_FLAGS = ("-mexec-model=reactor", "-Wl,--gc-sections,--strip-all")


def build(out: Path) -> None:
    """Write the module to `out`."""
    compiler = [sys.executable, "-m", "ziglang", "c++", *TARGET]
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        objects = []
        for name in (*SOURCES, *LANE_SOURCES):
            flags = [*FLAGS, f"-I{CSRC}"]
            if name in LANE_SOURCES:
                flags.append("-DV3DG_ISA=isa_baseline")
            made = Path(folder) / f"{name.replace('/', '_')}.o"
            subprocess.run([*compiler, *flags, "-c", CSRC / name, "-o", made], check=True)
            objects.append(made)
        subprocess.run([*compiler, *LINK_FLAGS, *objects, "-o", out], check=True)


if __name__ == "__main__":
    build(Path(sys.argv[1]))
