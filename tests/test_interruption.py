"""Commands that are interrupted and builds that are killed at any moment: what they say and leave, and what
resuming makes of it.

V3DG_INTERRUPTS and V3DG_KILLS set how many are; docs/notes/robustness.md has the record of a long run.
"""

import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset

INTERRUPTS = int(os.environ.get("V3DG_INTERRUPTS", "12"))
KILLS = int(os.environ.get("V3DG_KILLS", "3"))
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}
BUILD = [sys.executable, "-m", "v3dg", "build", "asset.ply", "-o", "out.v3dg", "--quiet"]


def started(folder, *options):
    return subprocess.Popen(
        [*BUILD, *options],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(folder, *options):
    process = started(folder, *options)
    _, errors = process.communicate()
    assert process.returncode == 0, errors


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bundle of a build that nothing interrupts, and the seconds it took."""
    folder = tmp_path_factory.mktemp("whole")
    v3dg.write_asset(folder / "asset.ply", make_asset(num_gaussians=2000, seed=0))
    start = time.perf_counter()
    finished(folder)
    return (
        (folder / "asset.ply").read_bytes(),
        (folder / "out.v3dg").read_bytes(),
        time.perf_counter() - start,
    )


def test_killed_builds_leave_nothing_or_all_and_resume_to_the_same_bytes(whole, tmp_path):
    asset, expected, seconds = whole
    (tmp_path / "asset.ply").write_bytes(asset)
    rng = random.Random(0)
    output = tmp_path / "out.v3dg"
    seen = {"killed": 0, "absent": 0, "whole": 0, "to resume": 0, "temporary": 0}
    while seen["killed"] < KILLS:
        process = started(tmp_path, "--resume")
        time.sleep(rng.uniform(0, 1.1 * seconds))
        process.kill()
        process.communicate()
        seen["killed"] += process.returncode != 0
        names = {path.name for path in tmp_path.iterdir()} - {"asset.ply", "out.v3dg", "out.v3dg.partial"}
        # What a bundle or a picture is written to before it gets its name.
        assert all(name.startswith(".out.v3dg.") and name.endswith(".tmp") for name in names), names
        seen["temporary"] += len(names)
        seen["to resume"] += (tmp_path / "out.v3dg.partial").exists()
        if output.exists():
            assert output.read_bytes() == expected
            seen["whole"] += 1
            output.unlink()
        else:
            seen["absent"] += 1
        for name in names:
            (tmp_path / name).unlink()
    finished(tmp_path, "--resume")
    assert output.read_bytes() == expected
    assert sorted(os.listdir(tmp_path)) == ["asset.ply", "out.v3dg"]
    print(seen)  # for the record, with `pytest -s`


def test_two_builds_to_one_path_do_not_disturb_each_other(whole, tmp_path):
    asset, expected, _ = whole
    (tmp_path / "asset.ply").write_bytes(asset)
    processes = [started(tmp_path) for _ in range(2)]
    errors = [process.communicate()[1] for process in processes]
    refused = [error for process, error in zip(processes, errors, strict=True) if process.returncode != 0]
    assert len(refused) < 2
    assert all("out.v3dg.partial: another build is using it" in error for error in refused)
    assert (tmp_path / "out.v3dg").read_bytes() == expected
    assert sorted(os.listdir(tmp_path)) == ["asset.ply", "out.v3dg"]


# Commands, and the seconds that they take at least.
SMALL = ["--size", "64", "48", "--quiet"]
COMMANDS = [
    (["build", "many", "-o", "out", "--quiet"], 3),
    (["info", "asset.v3dg"], 0.6),
    (["render", "asset.v3dg", "--views", "8"], 1.5),
    (["render", "asset.v3dg", "--views", "2", "--threads", "1"], 1.5),
    (["compare", "asset.ply", "asset.v3dg", "--views", "9", *SMALL], 4),
    (["convert", "asset.v3dg", "out.spz"], 0.8),
    (["export", "asset.v3dg", "--quiet"], 0.8),
    (["demo", "--gaussians", "1000", "--instances", "20", *SMALL], 3),
]


@pytest.fixture(scope="module")
def subjects(whole, tmp_path_factory):
    folder = tmp_path_factory.mktemp("subjects")
    (folder / "many").mkdir()
    for name in ("asset.ply", "many/a.ply", "many/b.ply"):
        (folder / name).write_bytes(whole[0])
    (folder / "asset.v3dg").write_bytes(whole[1])
    return folder


def processes_of(session):
    """The command lines of all that a command has started and that is still there."""
    found = []
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, _, its_session, *_ = status.read_text().rpartition(")")[2].split()
            if int(its_session) == session and state != "Z":
                found.append((status.parent / "cmdline").read_text().replace("\0", " "))
        except OSError:
            pass  # it has ended meanwhile
    return found


def test_interrupts_at_any_moment_end_a_command_with_one_line(subjects):
    rng = random.Random(os.environ.get("V3DG_SEED", "0"))
    seen = {}
    there = {path.name for path in subjects.iterdir()}
    for number in range(INTERRUPTS):
        command, seconds = COMMANDS[number % len(COMMANDS)]
        process = subprocess.Popen(
            [sys.executable, "-m", "v3dg", *command],
            cwd=subjects,
            env=ENVIRONMENT,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        )
        # Before that Python itself starts, and prints a traceback.
        while "numpy" not in Path(f"/proc/{process.pid}/maps").read_text():
            time.sleep(0.001)
        time.sleep(rng.uniform(0, rng.choice([0.4, seconds])))
        for _ in range(rng.choice([1, 2])):
            if process.poll() is None:
                rng.choice([os.kill, os.killpg])(process.pid, signal.SIGINT)
            time.sleep(rng.choice([0, 0.01, 0.2]))
        _, errors = process.communicate(timeout=60)
        assert process.returncode in (0, 130), (command, errors)
        assert errors.count("\n") == (process.returncode != 0), (command, errors)
        assert errors.startswith("v3dg: error: interrupted" if process.returncode else ""), (command, errors)
        deadline = time.monotonic() + 5
        while (left := processes_of(process.pid)) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not left, command
        assert not [path for path in subjects.rglob(".*")], command
        seen[command[0], process.returncode] = seen.get((command[0], process.returncode), 0) + 1
    assert {path.name for path in subjects.iterdir()} >= there
    print(seen)


def run_as_command(code, tmp_path):
    """A Python that hears Ctrl-C as commands do, runs the code, and interrupts itself in it."""
    (tmp_path / "slow.py").write_text(
        "import os, signal; os.kill(os.getpid(), signal.SIGINT); done = sum(range(10**6))"
    )
    start = (
        "import os, signal, sys, time; from v3dg import _start; _start.begin(); _start.raise_interrupts()\n"
    )
    return subprocess.run(
        [sys.executable, "-c", start + code],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_an_import_is_finished_before_an_interrupt_is_raised(tmp_path):
    code = "try:\n import slow\n time.sleep(5)\nexcept KeyboardInterrupt:\n print(sys.modules['slow'].done)"
    assert run_as_command(code, tmp_path).stdout == "499999500000\n"


def test_an_interrupt_that_a_destructor_swallows_is_raised_again(tmp_path):
    code = """
class Deaf:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        sum(range(10))
try:
    Deaf()
    time.sleep(5)
except KeyboardInterrupt:
    print("heard")
"""
    done = run_as_command(code, tmp_path)
    assert (done.stdout, done.stderr) == ("heard\n", "")


def test_an_interrupt_does_not_disturb_who_cleans_up_after_another(tmp_path):
    code = """
try:
    try:
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(5)
    finally:
        os.kill(os.getpid(), signal.SIGINT)
        print("cleaned up")
except KeyboardInterrupt:
    print("heard")
try:
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(5)
except KeyboardInterrupt:
    print("heard another")
"""
    assert run_as_command(code, tmp_path).stdout.split("\n")[:3] == ["cleaned up", "heard", "heard another"]
