"""Sends SIGKILL at a random moment of a build, a save or a conversion. Afterwards the
file has to be missing, unchanged or complete.

A build that is then resumed, sometimes with another asset, has to give the same bytes
as one that was not interrupted.
"""

import os
import random
import signal
import sys
import time
from functools import partial

import numpy as np

import v3dg
from fuzz.attacks.pool import Outcome
from fuzz.attacks.program import COMMAND, fault_of, is_running, names_in, outcome, run
from random_bundle import random_gaussians

LIMIT_S = 200

SAVE = "import sys, v3dg; v3dg.Bundle.open(sys.argv[1]).write(sys.argv[2])"
KINDS = {
    "build": (
        [
            *COMMAND,
            "build",
            "asset.ply",
            "-o",
            "out.v3dg",
            "--quiet",
            "--device",
            "cpu",
            "--resume",
        ],
        "out.v3dg",
    ),
    "save": ([sys.executable, "-c", SAVE, "large.v3dg", "out.v3dg"], "out.v3dg"),
    **{
        f"convert to {end}": ([*COMMAND, "convert", "large.v3dg", f"out.{end}"], f"out.{end}")
        for end in ("ply", "compressed.ply", "spz", "sog")
    },
}
WEIGHTS = (4, 2, 1, 1, 1, 1)


def prepare(shared):
    for seed, name in enumerate(("asset.ply", "other.ply", "large.ply")):
        count = 20_000 if name == "large.ply" else 1500
        v3dg.write_asset(shared / name, random_gaussians(np.random.default_rng(seed), count, 1))
    config = v3dg.BuildConfig(steps=0)
    asset = v3dg.read_asset(shared / "large.ply")
    v3dg.build_bundle(asset, config=config, device="cpu", progress=False).write(
        shared / "large.v3dg"
    )


class Attack:
    kinds, weights = KINDS, WEIGHTS
    files = ("large.v3dg",)

    def __init__(self, shared):
        self._shared, self._whole = shared, {}

    def plan(self, rng, work):
        (what,) = rng.choices(list(self.kinds), self.weights)
        program, name = self.kinds[what]
        seconds, _ = self._of_nothing(what, "asset.ply", work)
        self._of_nothing(what, "other.ply", work)
        before = self._put(work, "asset.ply")
        is_replaced = rng.random() < 0.5  # a file exists already
        if is_replaced:
            (work / name).write_bytes(b"before")
        moments = [rng.uniform(0, 1.05 * seconds) for _ in range(rng.choice((1, 1, 2, 4)))]
        # Another asset replaces the one that is built, perhaps with its date or an
        # older date.
        swaps = what.startswith("build") and rng.random() < 0.4
        date = rng.choice((None, 0, os.stat(work / "asset.ply").st_mtime_ns))

        def do():
            found, whole = "", {b"before", self._of_nothing(what, "asset.ply", work)[1]}
            for moment in moments:
                ended = run([], work, program=program, limit_s=60, meddle=partial(_kill, moment))
                if ended.code not in (0, -signal.SIGKILL):
                    return outcome(
                        ended, fault_of(ended) or f"code {ended.code}: {ended.err[-200:]!a}"
                    )
                found = f" from {_left(work, name)}" if _left(work, name) else ""
                fault = _fault_of_files(work, before, name, whole, is_replaced)
                if fault is not None:
                    return Outcome("fault", f"after {moment:.2f} s: {fault}")
            if swaps:
                os.unlink(work / "asset.ply")
                (work / "asset.ply").write_bytes((self._shared / "other.ply").read_bytes())
                if date is not None:
                    os.utime(work / "asset.ply", ns=(date, date))
            ended = run([], work, program=program, limit_s=60)
            if (
                swaps
                and ended.code == 1
                and f"{name}.partial: expected levels of this build" in ended.err
            ):  # the file is missing, as expected
                (work / f"{name}.partial").unlink()
                ended = run([], work, program=program, limit_s=60)
            fault = fault_of(ended, codes=(0,))
            expected = self._of_nothing(what, "other.ply" if swaps else "asset.ply", work)[1]
            if fault is None and (work / name).read_bytes() != expected:
                swapped = ", but of the asset before" if swaps else ""
                fault = f"not the bytes of one that nothing stopped{swapped}"
            if fault is None and _left(work, name):
                fault = f"{_left(work, name)} is left beside a whole bundle"
            result = outcome(ended, fault)
            result.name += found
            return result

        return what, do

    def _put(self, work, asset):
        work.mkdir(exist_ok=True)
        for name, source in (("asset.ply", asset), *zip(self.files, self.files, strict=True)):
            (work / name).write_bytes((self._shared / source).read_bytes())
        return names_in(work)

    def _of_nothing(self, what, asset, work):
        """Return the seconds and the bytes of an uninterrupted run."""
        key = what, asset if what.startswith("build") else ""
        if key not in self._whole:
            program, name = self.kinds[what]
            place = work.parent / f"{work.name}_{random.randrange(1 << 60):x}"
            self._put(place, asset)
            ended = run([], place, program=program, limit_s=60)
            assert ended.code == 0, ended
            self._whole[key] = ended.seconds, (place / name).read_bytes()
        return self._whole[key]


def _left(work, name):
    """Return the file that an unfinished build left."""
    return " and ".join(end for end in ("partial", "scratch") if (work / f"{name}.{end}").exists())


def _kill(moment, process, _):
    end = time.monotonic() + moment
    while time.monotonic() < end and is_running(process):
        time.sleep(0.001)
    os.killpg(process.pid, signal.SIGKILL)


def _fault_of_files(work, before, name, whole, is_replaced):
    """Return the fault unless the file is unchanged or complete, and the other files
    are known to be unfinished."""
    for path in names_in(work) - before - {name, f"{name}.partial"}:
        # the next build that ends removes this file
        if path.startswith(f"{name}.scratch"):
            continue
        if not (path.startswith(f".{name}") and path.endswith(".tmp")):
            return f"left {path}"
        (work / path).unlink()
    if not (work / name).exists():
        return f"{name} has gone" if is_replaced else None
    return (
        None
        if (work / name).read_bytes() in whole
        else f"{name} is neither what was there nor whole"
    )
