"""Programs that end in various ways while daemon threads are in all kinds of calls.
They have to end soon, with the right exit code."""

import re
import signal
import sys
import time
from pathlib import Path

import numpy as np

import v3dg
from fuzz.attacks.ending_program import WORK
from fuzz.attacks.pool import Outcome, environment
from fuzz.attacks.program import copied, outcome, run
from random_bundle import random_gaussians

LIMIT_S = 120
SOON_S = 15  # in seconds, on a busy machine
PROGRAM = [sys.executable, str(Path(__file__).with_name("ending_program.py"))]
# Exit codes by the way in which a program ends. An interrupt in an exit handler is
# printed and ignored.
ENDINGS = {
    "return": {0},
    "sys.exit": {3},
    "exception": {1},
    "SIGTERM": {-signal.SIGTERM},
    "SIGTERM exits": {3},
    "SIGINT twice": {-signal.SIGINT, 1},
    "handler renders": {0},
    "handler starts threads": {0},
    "last handler renders": {0},
    "thread that is waited for": {0},
}
ABORTS = (
    "terminate called",
    "FATAL: exception",
    "Fatal Python error",
    "Segmentation",
    "pybind11::handle",
)


def prepare(shared):
    (shared / "files").mkdir()
    asset = random_gaussians(np.random.default_rng(0), 3000, 1)
    v3dg.write_asset(shared / "files" / "a.ply", asset)
    config = v3dg.BuildConfig(steps=1, num_views=2, cluster_size=64)
    bundle = v3dg.build_bundle(asset, config=config, device="cpu", progress=False)
    bundle.write(shared / "files" / "a.v3dg")


class Attack:
    def __init__(self, shared):
        self._shared = shared

    def plan(self, rng, work):
        name = rng.choice(list(WORK))
        ending = rng.choice(list(ENDINGS))
        num_threads = 1 if name == "viewer" else rng.choice((1, 2, 4))
        seconds = rng.choice((0.0, rng.uniform(0, 0.02), rng.uniform(0, 0.3)))
        gap = rng.choice((0.0, rng.uniform(0, 0.02), rng.uniform(0, 0.3)))
        copied(self._shared, work)

        def do():
            return ended(work, name, ending, num_threads, seconds, gap)

        return f"{name}, {ending}", do


def ended(folder, work, ending, num_threads, seconds, gap):
    """Return the outcome of a program in a folder with the files of `prepare`."""
    arguments = [work, ending, str(num_threads), str(seconds), str(gap)]
    # Threads of OpenMP also work while the program ends.
    several = environment() | {"OMP_NUM_THREADS": "2"}
    end = run(arguments, folder, program=PROGRAM, limit_s=60, environment=several)
    now = time.monotonic()
    said = re.search(r"^ends ([\d.]+)$", end.out, re.MULTILINE)
    if said is None:
        return outcome(end, f"did not begin to end: {end.err[-300:]!a}")
    if end.code is None or end.was_long:
        return outcome(end, "did not end by itself")
    if end.code not in ENDINGS[ending]:
        return outcome(end, f"code {end.code}: {end.err[-300:]!a}")
    for word in ABORTS:
        if word in end.err:
            return outcome(end, f"{word}: {end.err[-300:]!a}")
    if now - float(said[1]) > gap + SOON_S:
        return outcome(end, f"ended only after {now - float(said[1]):.0f} s")
    return Outcome(f"code {end.code}", megabytes=end.megabytes)
