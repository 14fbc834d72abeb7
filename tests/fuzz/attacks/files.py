"""Broken files for every reader. Each has to be read, or refused with one line that
names the file, at a bounded cost.

Most tries change a valid file: its bytes, its compressed content, or the file itself
while it is read. Other files are made to cost much, or are damaged in a way that must
be detected.
"""

import contextlib
import io
import os
import re
import sys
import time
import warnings
from pathlib import Path

import torch
from PIL import Image

import v3dg
from fuzz.attacks import bombs, changes, damages
from fuzz.attacks.good_files import good_files
from fuzz.attacks.memory_use import Watch, limit_growth
from fuzz.attacks.pool import Outcome
from v3dg.camera_file import CameraWarning
from v3dg.cleaning import AssetWarning
from v3dg.cli import main

LIMIT_S = 60  # in seconds; a longer try counts as a hang
# The bounds in docs/robustness.md on the additional memory of a reader: MB, bytes per
# byte on disk, per gaussian and per byte of JSON, and bytes per pixel of a compared
# picture.
MOST_MB, A_BYTE, A_GAUSSIAN, A_BYTE_OF_JSON, A_PIXEL = 100, 8, 400, 40, 250
# The number of gaussians that a file of any size may have. Larger files may have one
# per byte.
BELIEVED = 1 << 18
# Time limits on one core: seconds, and seconds per million bytes and per million
# gaussians. Other work on the machine slows a try down.
MOST_SECONDS, A_MILLION = 5, 3
ARRAYS = ("means", "quats", "scales", "opacities", "sh")


def prepare(shared):
    pass


def _put_ghostscript(folder):
    """Put a program called gs that records its start first on PATH."""
    program = folder / "gs"
    program.write_text(f"#!/bin/sh\ntouch {folder}/was_started\necho 10.0\n")
    program.chmod(0o755)
    os.environ["PATH"] = f"{folder}{os.pathsep}{os.environ['PATH']}"
    return folder / "was_started"


def compare_picture(path):
    """Compare the picture with the one in the same folder."""
    said = io.StringIO()
    beside = path.with_name("b.png")
    with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
        code = main(
            ["compare", str(path), str(beside), "-o", str(path.with_name("out.png")), "--quiet"]
        )
    if code:
        raise ValueError(re.sub("^v3dg: error: ", "", said.getvalue().rstrip("\n")))
    return []


def read_picture(path):
    compare_picture(path)
    with Image.open(path) as picture:
        return [range(picture.width * picture.height)]


def read_bundle(path):
    bundle = v3dg.Bundle.open(path)
    return [getattr(bundle.gaussians, name) for name in ARRAYS]


def read_asset(path):
    asset = v3dg.read_asset(path)
    return [getattr(asset, name) for name in ARRAYS]


def read_scene(path):
    scene, _ = v3dg.read_scene(path)
    return [scene.positions]


def read_cameras(path):
    return [camera.viewmat for camera in v3dg.read_cameras(path, size=(64, 48)).values()]


READERS = {
    "bundle": read_bundle,
    "scene": read_scene,
    "cameras": read_cameras,
    "colmap": read_cameras,
    "picture": read_picture,
}


class Attack:
    def __init__(self, shared):
        own = shared / f"child_{os.getpid()}"
        own.mkdir()
        self._good = good_files(own)
        self._started = _put_ghostscript(own)
        self._arrays, self._num_calls = {}, {}
        for kind in self._good:  # modules that are imported late are imported here
            self._known(kind, 0, own)
        torch.set_num_threads(1)
        limit_growth(6 << 30)

    def _known(self, kind, index, folder):
        """Return the content of a valid file."""
        if (kind, index) not in self._arrays:
            good = self._good[kind][index]
            self._arrays[kind, index] = _reader(kind)(_put(folder / f"{kind}_{index}", good.files))
        return self._arrays[kind, index]

    def plan(self, rng, work):
        kind = rng.choice([*self._good, "checkpoint", "sog", "bundle"])
        index = rng.randrange(len(self._good[kind]))
        good = self._good[kind][index]
        action = rng.random()
        if action < 0.03:
            bomb = rng.choice(bombs.BOMBS)
            kind, files = bomb(rng)
            return f"{kind}: {bomb.__name__}", self._reading(kind, work, files)
        if action < 0.05:
            good, count = bombs.written_with_constants(rng, work)
            return f"{good.kind}: written by us", self._reading(
                good.kind, work, good.files, must="read", count=count
            )
        if action < 0.12:
            kind, what, files, must, arrays = damages.damaged(rng)
            return f"{kind}: {what}", self._reading(kind, work, files, must=must, arrays=arrays)
        arrays = self._known(kind, index, work)
        if action < 0.22:
            return f"{kind}: changed while it is read", self._while_it_is_changed(
                rng, kind, index, work
            )
        other = rng.choice(rng.choice([*self._good.values()])).content
        own = changes.OWN.get(kind, changes.bytes_changed)
        change = own if rng.random() < 0.5 else rng.choice(changes.BYTES)
        files = good.files
        if len(files) > 1 and rng.random() < 0.3:  # the other files
            name = rng.choice(list(files)[1:])
            files = {**files, name: changes.bytes_changed(files[name], rng, other)}
            if rng.random() < 0.2:
                del files[name]
        else:
            files = good.with_content(change(good.content, rng, other)).files
        is_noticed = good.is_hashed and change in (
            changes.flipped,
            changes.truncated,
            changes.overwritten,
        )
        if rng.random() < 0.03:  # gets the suffix of another kind
            name = rng.choice(
                (
                    "a.ply",
                    "a.spz",
                    "a.splat",
                    "a.ksplat",
                    "a.sog",
                    "a.pt",
                    "meta.json",
                    "A.PLY",
                    "a.v3dg",
                )
            )
            kind = "bundle" if name.endswith("v3dg") else "ply"
            files, is_noticed = {name: files[good.name], **files}, False
        what = f"{kind}: {getattr(change, '__name__', 'own')}"
        return what, self._reading(kind, work, files, arrays=arrays if is_noticed else None)

    def _reading(self, kind, work, files, *, must="any", arrays=None, count=None):
        path, read = _put(work, files), _reader(kind)
        num_bytes = sum(map(len, files.values()))
        num_json = sum(len(content) for name, content in files.items() if name.endswith(".json"))

        def do():
            watch, start = Watch(), time.process_time()
            found, text, fault = _tried(read, path)
            seconds, megabytes = time.process_time() - start, watch.megabytes()
            num, each = len(found[0]) if found else 0, A_PIXEL if kind == "picture" else A_GAUSSIAN
            most = MOST_MB + (A_BYTE * num_bytes + A_BYTE_OF_JSON * num_json + each * num) / 1e6
            longest = MOST_SECONDS + A_MILLION * (num_bytes + num) / 1e6
            cost = f"for {num_bytes} bytes and {num} gaussians or pixels"
            if fault is None and megabytes > most:
                fault = f"held {megabytes:.0f} MB of {most:.0f} {cost}"
            if fault is None and seconds > longest:
                fault = f"took {seconds:.0f} s of {longest:.0f} {cost}"
            if fault is None and kind not in READERS and num > BELIEVED + num_bytes:
                fault = f"{num} gaussians of {num_bytes} bytes"
            if fault is None and must == "refused" and found is not None:
                fault = "was read, and should be refused"
            if fault is None and must == "read" and found is None:
                fault = f"was refused, and should be read: {text}"
            if fault is None and count is not None and len(found[0]) != count:
                fault = f"expected {count} gaussians, got {len(found[0])}"
            if (
                fault is None
                and arrays is not None
                and found is not None
                and not _are_same(found, arrays)
            ):
                fault = "was read, but not as it was before the damage"
            if self._started.exists():
                self._started.unlink()
                fault = "another program was started"
            name = "fault" if fault else "refused" if found is None else "read"
            return Outcome(name, fault, megabytes=megabytes)

        return do

    def _while_it_is_changed(self, rng, kind, index, work):
        """At one of the calls of the reader, the file is truncated, extended,
        overwritten, replaced or removed."""
        good = self._good[kind][index]
        path = _put(work, good.files)
        # The name may then be a pipe, and opening it to find its size would wait.
        read = compare_picture if kind == "picture" else _reader(kind)
        if (kind, index) not in self._num_calls:
            with _at_call(None, lambda: None) as calls:
                read(path)
            self._num_calls[kind, index] = max(1, calls[0])
        call = rng.randrange(self._num_calls[kind, index])
        victim = (
            path.with_name(Path(rng.choice(list(good.files))).name) if rng.random() < 0.2 else path
        )
        size = rng.randrange(len(good.content))
        action = rng.choice(
            (
                lambda: os.truncate(victim, size),
                lambda: os.truncate(victim, 0),
                lambda: os.truncate(victim, 1 << 22),
                lambda: victim.write_bytes(good.content[size:]),
                lambda: os.unlink(victim),
                lambda: (os.unlink(victim), os.mkfifo(victim)),
                lambda: (os.unlink(victim), os.mkdir(victim)),
                lambda: (os.unlink(victim), os.symlink("/dev/zero", victim)),
            )
        )

        def do():
            with _at_call(call, action):
                found, _, fault = _tried(read, path)
            return Outcome("fault" if fault else "refused" if found is None else "read", fault)

        return do


@contextlib.contextmanager
def _at_call(number, action):
    """Run an action at the call with this number.

    Calls of Python functions, and calls from Python to C, are counted.
    """
    calls = [0]

    def count(*_):
        if calls[0] == number:
            with contextlib.suppress(OSError):
                action()
        calls[0] += 1

    sys.setprofile(count)
    try:
        yield calls
    finally:
        sys.setprofile(None)


def _reader(kind):
    return READERS.get(kind, read_asset)


def _put(folder, files):
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content)
    return folder / next(iter(files))


def _tried(read, path):
    """Return the content or None, the text of the error, and the fault if there is
    one."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        # warnings about content that is not read
        warnings.simplefilter("ignore", AssetWarning)
        # and warnings about images that are left out
        warnings.simplefilter("ignore", CameraWarning)
        try:
            return read(path), "", None
        except MemoryError as error:
            return None, str(error), f"MemoryError: {error}"
        except (ValueError, OSError) as error:
            return None, str(error), _fault_of_text(error, path)
        except BaseException as error:
            if isinstance(error, KeyboardInterrupt):
                raise
            return None, str(error), f"{type(error).__name__}: {str(error)[:150]!a}"


def _fault_of_text(error, path):
    text = str(error)
    named = path.parent.name if path.name in text or os.fspath(path.parent) in text else ""
    if type(error) not in (ValueError, *_OS_ERRORS):
        return f"{type(error).__name__}: {text[:150]!a}"
    if not text.isprintable():
        return f"not one line of text: {text[:150]!a}"
    if not named:
        return f"the file is not named: {text[:150]!a}"
    return f"too long, {len(text)} characters: {text[:80]}" if len(text) > 1000 else None


_OS_ERRORS = (OSError, FileNotFoundError, IsADirectoryError, NotADirectoryError, PermissionError)


def _are_same(found, arrays):
    return len(found) == len(arrays) and all(
        a.shape == b.shape and a.tobytes() == b.tobytes()
        for a, b in zip(found, arrays, strict=True)
    )
