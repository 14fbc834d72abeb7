import fcntl
import os
import pty
import struct
import subprocess
import sys
import termios
import time

import pytest

from command_line import ENVIRONMENT
from v3dg import _progress

LONG = """
import time
from v3dg import _progress
from v3dg._progress import Bar
with Bar(100, "work", True) as bar:
    for i in range(100):
        time.sleep(0.004)
        bar.update(1, "step %d, with a text that is longer than the terminal is wide" % i)
"""


def test_a_bar_stays_one_line_in_a_narrow_terminal():
    ours, theirs = pty.openpty()
    fcntl.ioctl(theirs, termios.TIOCSWINSZ, struct.pack("HHHH", 10, 40, 0, 0))
    subprocess.run([sys.executable, "-c", LONG], stderr=theirs, env=ENVIRONMENT, check=True)
    shown = os.read(ours, 1 << 16).decode()
    os.close(theirs)
    os.close(ours)
    assert "work, step" in shown
    assert "\n" not in shown
    assert max(map(len, shown.split("\r"))) <= 40


def test_a_log_gets_four_lines():
    done = subprocess.run(
        [sys.executable, "-c", LONG], capture_output=True, text=True, env=ENVIRONMENT, check=True
    )
    assert done.stdout == ""
    assert [line.rsplit(": ")[-1] for line in done.stderr.splitlines()] == [
        "25 %",
        "50 %",
        "75 %",
        "100 %",
    ]


@pytest.mark.parametrize("show", [True, False])
def test_long_work_of_unknown_amount_says_that_it_goes_on(capsys, monkeypatch, show):
    monkeypatch.setattr(_progress, "_PATIENCE_SECONDS", 0.05)
    with _progress.waiting("reading a.ply", show=show):
        time.sleep(0.5)
    assert capsys.readouterr().err == "reading a.ply ...\n" * show


def test_short_work_shows_nothing(capsys):
    with _progress.waiting("reading a.ply", show=True):
        pass
    assert capsys.readouterr().err == ""
