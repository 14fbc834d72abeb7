"""The command line as a user starts it, and other Python processes that tests start."""

import os
import subprocess
import sys
from pathlib import Path

import v3dg

PACKAGE = str(Path(v3dg.__file__).parents[1])
# The package under test, wherever the command starts.
ENVIRONMENT = os.environ | {"PYTHONPATH": PACKAGE}
# Also the modules that tests import (pytest's `pythonpath`), for a process that runs a
# part of a test.
TESTS = Path(__file__).parents[1]
IMPORTED = [entry for entry in sys.path if Path(entry).is_relative_to(TESTS)]
TESTS_ENVIRONMENT = os.environ | {
    "PYTHONPATH": os.pathsep.join([*IMPORTED, PACKAGE, os.environ.get("PYTHONPATH", "")])
}
COMMAND = [sys.executable, "-m", "v3dg"]


def run(*arguments, cwd=None):
    command = [*COMMAND, *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, cwd=cwd, env=ENVIRONMENT)


def fails(code, message, *arguments, cwd):
    """Run a command that must fail with one line on stderr and an exit code, without
    creating files in the folder."""
    before = sorted(os.listdir(cwd))
    done = run(*arguments, cwd=cwd)
    assert done.returncode == code, done.stderr
    assert done.stdout == ""
    assert done.stderr.startswith("v3dg: error: ")
    assert done.stderr.count("\n") == 1
    assert message in done.stderr
    assert sorted(os.listdir(cwd)) == before
