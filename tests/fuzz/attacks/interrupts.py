"""Sends Ctrl-C at a random moment of every command, once or twice, to one process or to
all processes of the terminal.

The command has to end soon, with one line and exit code 130 unless it had finished. It
must leave no process behind, and write each of its files completely or not at all.
"""

import contextlib
import os
import re
import shutil
import signal
import socket
import time

import numpy as np
from PIL import Image

import v3dg
from fuzz.attacks.program import (
    ERROR,
    PROGRESS,
    Ended,
    copied,
    fault_of,
    is_running,
    make_files,
    names_in,
    outcome,
    run,
    shown_lines,
)
from random_bundle import random_gaussians

LIMIT_S = 100
PACKAGE = os.path.dirname(v3dg.__file__) + os.sep
# Before Ctrl-C is handled, only Python's start and the import of one small module of
# ours run.
NOTE = re.compile(r"\S+\.\w+: ")  # a command reports this about a file
OURS = re.compile(re.escape(PACKAGE) + r"(?!__init__\.py\", line 3, |_start\.py)")
SOON_S = 15  # in seconds, on a busy machine

SMALL = ["--size", "40", "30", "--quiet"]
COMMANDS = {
    "build": ["build", "large.ply", "-o", "out.v3dg", "--quiet", "--device", "cpu"],
    "build, told": ["build", "large.ply", "-o", "out.v3dg", "--device", "cpu"],
    "build of many": ["build", "many", "-o", "outs", "--quiet", "--device", "cpu"],
    "compare": ["compare", "a.ply", "a.v3dg", "-o", "out.png", "--views", "8", *SMALL],
    "compare all": [
        "compare",
        "a.ply",
        "a.v3dg",
        "-o",
        "out.png",
        "--views",
        "8",
        "--pictures",
        "all",
        *SMALL,
    ],
    "render": ["render", "a.v3dg", "-o", "out.png", "--views", "30", "--size", "200", "150"],
    "render scene": ["render", "scene.json", "-o", "out.png"],
    "convert": ["convert", "large.ply", "out.sog"],
    "convert to spz": ["convert", "large.ply", "out.spz"],
    "convert to ply": ["convert", "large.ply", "out.ply"],
    "export": ["export", "a.v3dg", "-o", "web", "--chunk", "100", "--quiet"],
    "demo": [
        "demo",
        "-o",
        "out.png",
        "--gaussians",
        "2000",
        "--instances",
        "50",
        "--size",
        "60",
        "60",
        "--quiet",
    ],
    "info": ["info", "large.ply"],
    "view": ["view", "a.v3dg", "--port", "0"],
    "view, connected": ["view", "scene.json", "--port", "0"],
}


def prepare(shared):
    (shared / "files").mkdir()
    make_files(shared / "files")
    make_large(shared / "files")


def make_large(folder):
    v3dg.write_asset(folder / "large.ply", random_gaussians(np.random.default_rng(1), 6000, 1))


class Attack:
    def __init__(self, shared):
        self._shared, self._whole = shared, {}

    def plan(self, rng, work):
        name = rng.choice(list(COMMANDS))
        how = rng.choice(("once", "once", "twice", "twice", "group", "group twice"))
        if name not in self._whole and not name.startswith("view"):
            self._whole[name] = self._of_nothing(name, work)
        seconds = 2.0 if name.startswith("view") else self._whole[name][0]
        # Many moments are at the start, while modules are imported.
        moment = rng.uniform(0, rng.choice((0.5, seconds)))
        gap = rng.choice((0, rng.uniform(0, 0.05), rng.uniform(0, 0.5)))
        before = names_in(copied(self._shared, work))

        def meddle(process, out):
            with contextlib.ExitStack() as connections:
                _wait_for(process, out, moment, name, connections)
                for _ in range(2 if "twice" in how else 1):
                    if is_running(process):
                        (os.killpg if "group" in how else os.kill)(process.pid, signal.SIGINT)
                    time.sleep(gap)

        def do():
            start = time.monotonic()
            ended = run(COMMANDS[name], work, limit_s=moment + gap + 60 + SOON_S, meddle=meddle)
            fault = _fault(ended, name) or self._fault_of_files(name, work, before)
            if fault is None and time.monotonic() - start > moment + 2 * gap + SOON_S + seconds:
                fault = f"ended only after {time.monotonic() - start:.0f} s"
            return outcome(ended, fault and f"{how}, after {moment:.2f} s: {fault}")

        return name, do

    def _of_nothing(self, name, work):
        """Return the duration of an uninterrupted command in seconds, and the files
        that it writes."""
        place = work.parent / f"{work.name}_whole"
        place.mkdir()
        before = names_in(copied(self._shared, place))
        ended = run(COMMANDS[name], place, limit_s=60)
        assert ended.code == 0, ended
        made = {path: (place / path).read_bytes() for path in names_in(place) - before}
        shutil.rmtree(place)
        return ended.seconds, made

    def _fault_of_files(self, name, work, before):
        made = self._whole.get(name, (0, {}))[1]
        for path in names_in(work) - before:
            if path.endswith(".v3dg.partial"):
                continue
            if path not in made:
                return f"left {path}"
            if name == "demo":  # the output contains durations
                with Image.open(work / path) as picture:
                    picture.load()
            elif (work / path).read_bytes() != made[path]:
                return f"{path} is not what it is without an interrupt"
        web = [path for path in made if path.startswith("web/")]
        if 0 < len([path for path in web if (work / path).exists()]) < len(web):
            return "left a part of the folder"
        return None


def _wait_for(process, out, moment, name, connections):
    """Wait for the moment. For the viewer, the moment is often after it has begun to
    listen, and other connections exist then."""
    end = time.monotonic() + moment
    if name == "view, connected":
        port, patience = None, time.monotonic() + 20
        while port is None and is_running(process) and time.monotonic() < patience:
            text = out.read_text()
            port = (
                text.split("localhost:" if "localhost:" in text else "127.0.0.1:")[1].split()[0]
                if "http" in text
                else None
            )
            time.sleep(0.02)
        if port is not None:
            connections.enter_context(
                contextlib.closing(socket.create_connection(("127.0.0.1", int(port))))
            )
            with contextlib.suppress(ImportError):
                from viewer_client import Tab

                connections.enter_context(Tab(int(port)))
        end = time.monotonic() + moment / 4
    while time.monotonic() < end and is_running(process):
        time.sleep(0.002)


def _fault(ended: Ended, name):
    if ended.was_long:
        return "did not end by itself" + (f", and left behind: {ended.left}" if ended.left else "")
    if ended.code == -signal.SIGINT and not ended.err:
        # the signal came before Python handled it
        return f"left behind: {ended.left}" if ended.left else None
    if "KeyboardInterrupt" in ended.err and ERROR not in ended.err and not OURS.search(ended.err):
        # The signal came before any of our code ran.
        return f"left behind: {ended.left}" if ended.left else None
    is_view = name.startswith("view")
    fault = fault_of(ended, codes=(0, 130), is_heard=not is_view)
    lines = [line for line in shown_lines(ended.err) if not PROGRESS.match(line)]
    if ended.code == 0:  # a command that ends also prints warnings about its files
        lines = [line for line in lines if not NOTE.match(line)]
    if fault is None and len(lines) > (ended.code != 0):
        fault = f"{len(lines)} lines: {ended.err[-200:]!a}"
    return fault
