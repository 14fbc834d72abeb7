"""Ctrl-C at difficult moments, and two builds with the same output. fuzz/attack.py
tries all other moments."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import v3dg
from benchmarks.worlds.procedural import make_asset

ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}


def started(folder):
    return subprocess.Popen(
        [sys.executable, "-m", "v3dg", "build", "asset.ply", "-o", "out.v3dg", "--quiet"],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def test_two_builds_to_one_path_do_not_disturb_each_other(tmp_path):
    alone, shared = tmp_path / "alone", tmp_path / "shared"
    for folder in (alone, shared):
        folder.mkdir()
        v3dg.write_asset(folder / "asset.ply", make_asset(num_gaussians=2000, seed=0))
    processes = [started(folder) for folder in (alone, shared, shared)]
    errors = [process.communicate()[1] for process in processes]
    refused = [
        error for process, error in zip(processes, errors, strict=True) if process.returncode != 0
    ]
    assert len(refused) < 2
    assert all("out.v3dg.partial: another build is using it" in error for error in refused)
    assert (shared / "out.v3dg").read_bytes() == (alone / "out.v3dg").read_bytes()
    assert sorted(os.listdir(shared)) == ["asset.ply", "out.v3dg"]


def run_as_command(code, tmp_path, begin="_start.raise_interrupts()"):
    """Run code in a Python process that handles Ctrl-C like a command, and that
    interrupts itself."""
    (tmp_path / "slow.py").write_text(
        "import os, signal; os.kill(os.getpid(), signal.SIGINT); done = sum(range(10**6))"
    )
    start = f"import os, signal, sys, time; from v3dg import _start; _start.begin(); {begin}\n"
    return subprocess.run(
        [sys.executable, "-c", start + code],
        cwd=tmp_path,
        env=ENVIRONMENT,
        capture_output=True,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def test_interrupts_before_a_command_runs_are_told_once(tmp_path):
    code = """
interrupt, write = lambda: os.kill(os.getpid(), signal.SIGINT), os.write
os.write = lambda *what: (write(*what), interrupt(), sum(range(1000)))
interrupt()
time.sleep(5)
"""
    done = run_as_command(code, tmp_path, begin="")
    assert (done.returncode, done.stderr) == (130, "v3dg: error: interrupted\n")


def test_an_interrupt_that_comes_by_another_thread_waits_until_this_one_hears(tmp_path):
    code = """
import threading
threading.Thread(target=time.sleep, args=(6,), daemon=True).start()
try:
    heard = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGALRM})
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(0.1)
    print("not disturbed")
    signal.pthread_sigmask(signal.SIG_SETMASK, heard)
    time.sleep(5)
except KeyboardInterrupt:
    print("heard")
"""
    assert run_as_command(code, tmp_path).stdout == "not disturbed\nheard\n"


def test_an_interrupt_that_waits_is_forgotten_at_the_end(tmp_path):
    code = """
from v3dg import _system
from v3dg.cli import main
_system.AGAIN_AFTER_S = 0.5  # long enough to end before
import slow
sys.argv[1:] = ["--version"]
main()
time.sleep(1)
print("done")
"""
    done = run_as_command(code, tmp_path)
    assert (done.returncode, done.stdout.split("\n")[1:]) == (0, ["done", ""]), done.stderr


def test_an_import_is_finished_before_an_interrupt_is_raised(tmp_path):
    code = (
        "try:\n import slow\n time.sleep(5)\n"
        "except KeyboardInterrupt:\n print(sys.modules['slow'].done)"
    )
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
    assert run_as_command(code, tmp_path).stdout.split("\n")[:3] == [
        "cleaned up",
        "heard",
        "heard another",
    ]
