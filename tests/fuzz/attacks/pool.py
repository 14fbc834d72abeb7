"""Runs the tries of one kind in child processes, so that a crash, a hang or a fault
affects only one try.

A kind is a module. It has LIMIT_S, the maximum seconds of a try, `prepare(shared)`,
which writes data for all children to a folder, and a class `Attack(shared)`. The method
`plan(rng, work)` prepares a try in the empty folder `work`. It returns a short
description, by which findings are counted together, and a function that performs the
try and returns an `Outcome`.
"""

import collections
import contextlib
import dataclasses
import json
import os
import queue
import re
import select
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

HERE = Path(__file__).resolve().parent
TESTS = HERE.parents[1]
KEPT_OF_ONE_SORT = 3
QUOTE = ": '"  # the text after this distinguishes faults of the same kind


@dataclasses.dataclass
class Outcome:
    """The result of a try."""

    name: str
    fault: str | None = None  # one line about the fault; None if there was none
    is_low: bool = False  # whether the fault is only a message that could say more
    megabytes: float = 0.0  # peak memory; the child measures it if it does the work itself


def environment():
    """Return the environment of a child, which finds v3dg and the tests, and has no
    more threads than there are children."""
    given = [
        os.path.abspath(path) for path in os.environ.get("PYTHONPATH", "").split(os.pathsep) if path
    ]
    imported = [TESTS, TESTS / "support", TESTS / "files"]
    paths = [*given, *imported, TESTS.parent if has_module() else None]
    return os.environ | {
        "PYTHONPATH": os.pathsep.join(str(path) for path in paths if path),
        "OMP_NUM_THREADS": "1",
    }


def has_module():
    """Return whether the compiled module is beside the sources; otherwise the installed
    package is attacked."""
    return any((TESTS.parent / "v3dg").glob("_core.*.so"))


class Child:
    """A process that performs tries. If a try ends it, it is started again."""

    def __init__(self, kind, seed, shared, work, limit_s):
        self._command = [
            sys.executable,
            str(HERE / "child.py"),
            kind,
            str(seed),
            str(shared),
            str(work),
        ]
        self._limit_s, self._log = limit_s, Path(f"{work}.log")
        self._process = None

    def do(self, number):
        """Return the child's record of a try, or a record of how the try ended the
        child."""
        if self._process is None:
            self._start()
        self._process.stdin.write(f"{number}\n".encode())
        what, end = "", time.monotonic() + self._limit_s + 60
        while line := self._line(end):
            record = json.loads(line)
            if "outcome" in record:
                return record
            what = record["what"]
        log = self._log.read_text(errors="replace")
        if not what:
            raise RuntimeError(f"try {number} could not be prepared: {log}")
        code = (
            self._process.wait() if self._process.poll() is not None or self._has_ended() else None
        )
        self.close()
        hangs = code is None or "Timeout (" in log
        name = "hang" if hangs else "crash" if code and code < 0 else "end"
        how = (
            f"after {self._limit_s} s"
            if hangs
            else f"{signal.Signals(-code).name}"
            if code < 0
            else f"code {code}"
        )
        place = re.findall(r'File "([^"]+)", line (\d+) in (\w+)', _stack_of(log))
        at = (
            " in " + " < ".join(f"{Path(f).name}:{n} {w}" for f, n, w in place[:3])
            if place
            else log[-200:]
        )
        return {
            "what": what,
            "outcome": name,
            "fault": f"{name} {how}{at}",
            "megabytes": 0,
            "seconds": 0,
            "log": log,
        }

    def _start(self):
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                self._command,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                env=environment(),
                cwd=self._log.parent,  # files with relative names are written here
                start_new_session=True,
                bufsize=0,  # `select` does not see data in a buffer
            )

    def _line(self, end):
        while (left := end - time.monotonic()) > 0:
            if select.select([self._process.stdout], [], [], left)[0]:
                return self._process.stdout.readline()
        return b""

    def _has_ended(self):
        try:
            self._process.wait(5)
        except subprocess.TimeoutExpired:
            return False
        return True

    def close(self):
        if self._process is not None:
            self._process.stdin.close()
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self._process.pid, signal.SIGKILL)
            self._process.wait()
            self._process.stdout.close()
            self._process = None


def _quick_folder():
    """Return a folder in memory if there is enough of it. Each try writes files, and a
    disk would slow it down."""
    shared = "/dev/shm"
    return shared if os.path.isdir(shared) and shutil.disk_usage(shared).free > 2 << 30 else None


def _stack_of(log):
    """Return the stack of the thread that caused the crash. If that thread is unknown,
    return the main thread's stack, which comes last."""
    log = (
        log.rsplit("Current thread ", 1)[-1]
        if "Current thread " in log
        else log.rsplit("Thread 0x", 1)[-1]
    )
    return log.split("\n\n", 1)[0]


def attack(kind, numbers, *, seconds, seed=0, kept=None, children=None):
    """Run the tries with these numbers until the time is over, and summarise them as
    JSON values."""
    start = time.monotonic()
    children = children or max(2, len(os.sched_getaffinity(0)))
    with tempfile.TemporaryDirectory(prefix="v3dg-attack-", dir=_quick_folder()) as folder:
        shared = Path(folder) / "shared"
        shared.mkdir()
        prepared = [sys.executable, str(HERE / "child.py"), kind, str(seed), str(shared)]
        limit_s = float(
            subprocess.run(prepared, env=environment(), check=True, capture_output=True).stdout
        )
        todo, lock, records = iter(numbers), threading.Lock(), queue.Queue()
        results = _Results(kind, seed, kept)

        def go_on(place):
            work = Path(folder) / f"work_{place}"
            child = Child(kind, seed, shared, work, limit_s)
            try:
                while time.monotonic() - start < seconds:
                    with lock:
                        number = next(todo, None)
                    if number is None:
                        return
                    record = child.do(number)
                    with lock:
                        results.add(number, record, work)
            except BaseException as error:
                records.put(error)
            finally:
                child.close()

        threads = [threading.Thread(target=go_on, args=(place,)) for place in range(children)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        if not records.empty():
            raise records.get()
    return results.summary(time.monotonic() - start)


class _Results:
    def __init__(self, kind, seed, kept):
        self._kind, self._seed, self._kept = kind, seed, kept
        self._outcomes, self._findings, self._low = collections.Counter(), {}, {}
        self._tries, self._most, self._longest = 0, (0.0, ""), (0.0, "")

    def add(self, number, record, work):
        self._tries += 1
        self._outcomes[record["outcome"]] += 1
        self._most = max(self._most, (round(record["megabytes"], 1), f"{number}: {record['what']}"))
        self._longest = max(
            self._longest, (round(record["seconds"], 2), f"{number}: {record['what']}")
        )
        if record["fault"] is None:
            return
        sort = re.sub(r"[\d.]+", "0", f"{record['what']}: {record['fault'].split(QUOTE)[0][:60]}")
        finding = (self._low if record.get("is_low") else self._findings).setdefault(
            sort, {"what": record["what"], "fault": record["fault"], "count": 0, "numbers": []}
        )
        finding["count"] += 1
        if len(finding["numbers"]) < KEPT_OF_ONE_SORT:
            finding["numbers"].append(number)
            self._keep(number, record, work)

    def _keep(self, number, record, work):
        if self._kept is None:
            return
        folder = Path(self._kept) / self._kind / f"{self._seed}-{number}"
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(
            work, folder / "files", symlinks=True, ignore=_what_is_no_file, dirs_exist_ok=True
        )
        again = f"python tests/fuzz/attack.py {self._kind} --seed {self._seed} --only {number}"
        text = json.dumps({**record, "again": again}, indent=1)
        (folder / "record.json").write_text(text, encoding="utf-8")

    def summary(self, seconds):
        return {
            "kind": self._kind,
            "seed": self._seed,
            "tries": self._tries,
            "seconds": round(seconds, 1),
            "outcomes": dict(self._outcomes.most_common()),
            "most_megabytes": self._most,
            "longest_seconds": self._longest,
            "findings": list(self._findings.values()),
            "low": list(self._low.values()),
        }


def _what_is_no_file(folder, names):
    paths = {name: os.path.join(folder, name) for name in names}
    return [
        name
        for name, p in paths.items()
        if not (os.path.isfile(p) or os.path.isdir(p) or os.path.islink(p))
    ]
