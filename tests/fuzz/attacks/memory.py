"""Runs commands with a random memory limit, which is set after their modules are
loaded. They have to succeed or print one line."""

import resource
import sys

from fuzz.attacks.interrupts import COMMANDS, make_large
from fuzz.attacks.pool import Outcome
from fuzz.attacks.program import copied, fault_of, make_files, outcome, run

LIMIT_S = 120
# Before the limit is set, modules are loaded, the threads of OpenMP are started, and
# the stack has grown, because failures of these would end the process without a
# message. NumPy also ends the process if there is no memory for the 64 kB buffers of an
# operation (PyErr_NoMemory in npyiter_allocate_buffers, without the GIL, in version
# 2.4), so these buffers are made small. Pillow does not report which module of a format
# could not be loaded.
PROGRAM = """
import contextlib, importlib, json, pkgutil, resource, sys
import numpy, PIL.Image, zstandard
import v3dg
# No command uses the adapters for simulators, whose packages may be missing.
skipped = ("v3dg.viewer", "v3dg.simulators")
for module in pkgutil.walk_packages(v3dg.__path__, "v3dg."):
    if not module.name.startswith(skipped) and not module.name.endswith("__main__"):
        importlib.import_module(module.name)
from v3dg.cli import main, parse
more = int(sys.argv.pop(1))
parse(sys.argv[1:])
PIL.Image.init()
numpy.setbufsize(16)
camera = v3dg.Camera.look_at((0, -3, 0), (0, 0, 0), width=40, height=30)
from v3dg.donut import make_donut
v3dg.rasterize(make_donut(1000, seed=0), camera)
sys.setrecursionlimit(20_000)
with contextlib.suppress(RecursionError):
    json.loads("[" * 15_000 + "]" * 15_000)
sys.setrecursionlimit(1000)
with open("/proc/self/status") as file:
    has = next(int(line.split()[1]) << 10 for line in file if line.startswith("VmSize:"))
limit = has + more
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
sys.exit(main())
"""


def prepare(shared):
    (shared / "files").mkdir()
    make_files(shared / "files")
    make_large(shared / "files")


class Attack:
    def __init__(self, shared):
        self._shared = shared

    def plan(self, rng, work):
        name = rng.choice([name for name in COMMANDS if not name.startswith("view")])
        more = int(2 ** rng.uniform(14, 29))
        copied(self._shared, work)
        program = [sys.executable, "-c", PROGRAM, str(more)]

        def do():
            ended = run(
                COMMANDS[name], work, program=program, limit_s=90, most=resource.RLIM_INFINITY
            )
            # This message comes from the C library. No program can continue after it.
            if "memory for thread-local data" in ended.err:
                return Outcome("ended by the C library")
            fault = fault_of(ended, codes=(0, 1))
            return outcome(ended, fault and f"with {more >> 10} KiB more: {fault}")

        return name, do
