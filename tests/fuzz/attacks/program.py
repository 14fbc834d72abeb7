"""Starts the command line as users do, and checks how it ends and what it leaves
behind."""

import contextlib
import dataclasses
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np

import v3dg
from fuzz.attacks.pool import Outcome
from random_bundle import random_gaussians

COMMAND = [sys.executable, "-m", "v3dg"]
# limit of the address space, so that a program cannot take all memory of the machine
MOST_BYTES = 8 << 30
# Lines of output that are not errors: those of OpenMP's runtime about its settings,
# names of assets that a command reads, progress bars, and the line that there was no
# memory for the thread that shows the progress.
PROGRESS = re.compile(r"libgomp: |v3dg: warning: tqdm:|\[\d+/\d+\] |failed: |.*: \d+ %$|$")
ERROR = "v3dg: error: "


def make_files(folder):
    """Create small subjects of each kind, with names that commands use."""
    rng = np.random.default_rng(0)
    asset = random_gaussians(rng, 300, 1)
    for name in ("a.ply", "a.spz", "a.sog", "a.compressed.ply"):
        v3dg.write_asset(folder / name, asset)
    config = v3dg.BuildConfig(steps=2, num_views=4, cluster_size=64)
    bundle = v3dg.build_bundle(asset, config=config, device="cpu", progress=False)
    bundle.write(folder / "a.v3dg")
    scene = v3dg.Scene()
    scene.add(bundle, positions=rng.normal(size=(5, 3)) * 3)
    eyes = {name: (0, -9 - i, 2) for i, name in enumerate(("left", "right", "far"))}
    cameras = {
        name: v3dg.Camera.look_at(eye, (0, 0, 0), width=40, height=30) for name, eye in eyes.items()
    }
    v3dg.write_scene(folder / "scene.json", scene, ["a.v3dg"], cameras)
    v3dg.write_cameras(folder / "cameras.json", cameras)
    odd = ("a/b", "a:b", "a_b", "../x", "é\u202e", "x" * 300, " ", ".", "A/B")
    v3dg.write_scene(folder / "odd.json", scene, ["a.v3dg"], dict.fromkeys(odd, cameras["left"]))
    (folder / "many").mkdir()
    for i in range(3):
        v3dg.write_asset(folder / "many" / f"{i}.ply", random_gaussians(rng, 100, 0))
    pixels = rng.random((30, 40, 3)).astype(np.float32)
    from v3dg.pictures import write_picture

    write_picture(folder / "a.png", pixels)
    write_picture(folder / "b.png", pixels[::-1])


@dataclasses.dataclass
class Ended:
    """How a program ended."""

    code: int | None  # None if it did not end and was killed
    out: str
    err: str
    seconds: float
    megabytes: float
    left: list[str]  # processes that it started and left behind
    was_long: bool = False


def run(
    arguments,
    folder,
    *,
    limit_s,
    meddle=None,
    program=COMMAND,
    environment=None,
    closed=(),
    out=None,
    most=MOST_BYTES,
):
    """Start a program in its own session, let `meddle` do something to it, and return
    how it ends.

    If the program exceeds the time limit, it is interrupted as by Ctrl-C, and killed if
    that does not help.
    """
    logs = [folder.parent / f"{folder.name}.{end}" for end in ("out", "err")]
    files = [log.open("wb") for log in logs]

    def before():
        # background jobs of a shell ignore SIGINT
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
        for descriptor in closed:
            os.close(descriptor)

    start = time.monotonic()
    process = subprocess.Popen(
        [*program, *arguments],
        cwd=folder,
        env=os.environ if environment is None else environment,
        stdin=subprocess.DEVNULL,
        stdout=files[0] if out is None else out,
        stderr=files[1],
        start_new_session=True,
        preexec_fn=before,
    )
    for file in files:
        file.close()
    if meddle is not None:
        meddle(process, logs[0])
    usage = _wait(process, start + limit_s)
    was_long = usage is None
    if was_long:
        process.send_signal(signal.SIGINT)
        usage = _wait(process, time.monotonic() + 10)
    seconds = time.monotonic() - start
    left = _in_session(process.pid)
    for pid in [*left, *([process.pid] if usage is None else [])]:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    if usage is None:
        process.wait()
    texts = [log.read_bytes().decode(errors="backslashreplace") for log in logs]
    code = None if usage is None else process.returncode
    megabytes = 0 if usage is None else usage.ru_maxrss / 1024
    return Ended(code, *texts, seconds, megabytes, list(left.values()), was_long)


def _wait(process, end):
    while time.monotonic() < end:
        pid, status, usage = os.wait4(process.pid, os.WNOHANG)
        if pid:
            process.returncode = os.waitstatus_to_exitcode(status)
            return usage
        time.sleep(0.004)
    return None


def is_running(process):
    """Return whether a process is running, without reaping it, because its exit code is
    read elsewhere."""
    return os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None


def _in_session(leader, patience_s=2):
    """Return the processes that remain in a session a moment after its first process
    has ended."""
    end = time.monotonic() + patience_s
    while True:
        found = {}
        for stat in Path("/proc").glob("[0-9]*/stat"):
            with contextlib.suppress(OSError):
                name, rest = stat.read_text().rsplit(")", 1)
                state, _, _, session = rest.split()[:4]
                if int(session) == leader and int(stat.parent.name) != leader and state != "Z":
                    found[int(stat.parent.name)] = name.split("(", 1)[1]
        if not found or time.monotonic() > end:
            return found
        time.sleep(0.05)


def shown_lines(text):
    """Return the lines that a terminal finally shows, where later lines overwrite
    earlier ones."""
    lines = [line.rstrip().rsplit("\r", 1)[-1] for line in text.split("\n")]
    return [line for line in lines if line.strip()]


def fault_of(ended, *, codes=(0, 1, 2), is_heard=True):
    """Return the fault in the way in which a command ended, or None."""
    if ended.code is None:
        return f"no end, and Ctrl-C did not help: {ended.err[-200:]!a}"
    if ended.code < 0:
        return f"crash {signal.Signals(-ended.code).name}: {ended.err[-300:]!a}"
    for word in (
        "Traceback",
        "Warning",
        "Exception ignored",
        "Error in sys",
        "terminate called",
        "Fatal",
    ):
        if word in ended.err:
            return f"{word}: {' '.join(ended.err.split())[-250:]!a}"
    if ended.was_long:
        return "did not end by itself"
    if ended.code not in codes:
        return f"code {ended.code}: {ended.err[-200:]!a}"
    lines = [line for line in shown_lines(ended.err) if not PROGRESS.match(line)]
    if ended.code and is_heard and not (len(lines) == 1 and lines[0].startswith(ERROR)):
        return f"code {ended.code} and not one line: {ended.err[-300:]!a}"
    for line in (*lines, *ended.out.split("\n")):
        if not line.replace("\t", " ").isprintable():
            return f"control characters: {line[:200]!a}"
    return f"left behind: {ended.left}" if ended.left else None


def outcome(ended, fault):
    name = "fault" if fault else f"code {ended.code}"
    return Outcome(name, fault, megabytes=ended.megabytes)


def names_in(folder):
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if not path.is_dir()}


def copied(shared, work):
    """Return copies of the subjects for this try."""
    shutil.copytree(shared / "files", work, dirs_exist_ok=True, symlinks=True)
    return work


def documents(text):
    """Return the JSON document of a result, or None."""
    try:
        return json.loads(text)
    except ValueError:
        return None
