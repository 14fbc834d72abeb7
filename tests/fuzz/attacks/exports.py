"""Exports into unusual folders. Files of other programs must stay unchanged, and after
a failure the previous content must be complete.

A folder contains files and folders of a user, links, files with several names, earlier
exports that may be changed, records that list files of others, and sometimes the bundle
that is exported. Everything below the work folder is compared before and after, by
kinds, permissions, targets of links and hashes.
"""

import contextlib
import hashlib
import io
import json
import os
import shutil
import stat
import threading
from pathlib import Path

import v3dg
from fuzz.attacks.pool import Outcome
from random_bundle import random_bundle
from v3dg.cli import main
from v3dg.export import write_site, write_streamed_sog, write_tiles

LIMIT_S = 120
RECORD = "v3dg-export.json"

WRITERS = {"sog": write_streamed_sog, "site": write_site, "tiles": write_tiles}
ERRORS = (ValueError, OSError, RuntimeError)
# Names that exports use, and other names.
OURS = (
    "index.html",
    "lod-meta.json",
    "site.json",
    "tileset.json",
    "settings.json",
    "playcanvas.min.mjs",
)
BELOW = (
    "0_0/meta.json",
    "0_0/sh0.webp",
    "1_0/meta.json",
    "a/tileset.json",
    "a/0_0.glb",
    "a/asset.glb",
)
OTHERS = (
    ".git/HEAD",
    ".git/objects/ab/cd",
    "thesis.tex",
    "data/cities.json",
    "cesium/Cesium.js",
    "0_0/a.txt",
)
ODD = (
    "new\nline",
    "é\u202e",
    "x" * 200,
    " ",
    "-o",
    "a/b/c/d/e",
    "0_0/.hidden",
    "A/tileset.json",
    "v3dg-export",
)
NAMES = (*OURS, *BELOW, *OTHERS, *ODD)
LEADING_OUT = (
    "../outside/0",
    "../../x.json",
    "a/../../outside/0",
    "./index.html",
    "a//tileset.json",
    ".git/HEAD",
    "thesis.tex",
    "\0.json",
    "a/b/c/d.json",
    RECORD,
)


def prepare(shared):
    for seed, name in enumerate(("a", "b")):
        random_bundle(seed, num_levels=2 + seed, max_cluster=20).write(shared / f"{name}.v3dg")
    scene = v3dg.Scene()
    bundles = [v3dg.Bundle.open(shared / f"{name}.v3dg") for name in ("a", "b")]
    scene.add([*bundles, bundles[0]], positions=[[0, 0, 0], [5, 0, 0], [0, 5, 0]])
    v3dg.write_scene(shared / "town.json", scene, ["a.v3dg", "b.v3dg"])


def snapshot(folder):
    """Return a description of each file below a folder, by its name, without following
    links."""
    entries = {}
    for place, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = os.path.join(place, name)
            status = os.lstat(path)
            content = ""
            if stat.S_ISLNK(status.st_mode):
                content = os.readlink(path)
            elif stat.S_ISREG(status.st_mode):
                content = hashlib.sha256(Path(path).read_bytes()).hexdigest()
            entries[os.path.relpath(path, folder)] = (status.st_mode, content)
    return entries


def is_file(entry):
    return stat.S_ISREG(entry[0])


def is_link(entry):
    return stat.S_ISLNK(entry[0])


class Attack:
    def __init__(self, shared):
        self._shared, self._references = shared, {}

    def plan(self, rng, work):
        folder = work / "project"
        (work / "outside" / "deep").mkdir(parents=True)
        for number in range(4):
            (work / "outside" / str(number)).write_text(f"outside {number}")
        (work / "outside" / "deep" / "meta.json").write_text("outside, deep")
        subject = self._subject(rng, work, folder)
        recorded = self._fill(rng, work, folder)
        kind = rng.choice(list(WRITERS if subject.suffix == ".v3dg" else ("site", "tiles")))
        overwrite = rng.random() < 0.4
        output = self._output(rng, work, folder)
        way = rng.choices(
            ("call", "command", "stopped", "failing", "two at once"), (4, 4, 3, 3, 1)
        )[0]
        moment = rng.randrange(1, 40)
        written = self._reference(kind, subject, work)
        what = f"{way}, {kind}{', overwriting' if overwrite else ''}"

        def do():
            before = snapshot(work)
            with _in(work / "cwd"):
                error = _export(way, kind, subject, output, overwrite, moment)
            after = snapshot(work)
            if way == "two at once":
                fault = fault_of_changes(before, after, recorded, written, overwrite)
                return Outcome("fault" if fault else "both ended", fault)
            fault = fault_of(before, after, recorded, written, error, overwrite)
            if fault is None and isinstance(error, str) and "\n" in error:
                fault = f"an error of several lines: {error!a}"
            is_stopped = error is not None and (
                "KeyboardInterrupt" in error or os.strerror(28) in error
            )
            name = "stopped" if is_stopped else "refused" if error else "exported"
            return Outcome("fault" if fault else name, fault)

        return what, do

    def _subject(self, rng, work, folder):
        """Return the subject of the export.

        It is in a separate folder or in the output folder.
        """
        (work / "cwd").mkdir()
        place = folder / rng.choice(("", "0_0", "data")) if rng.random() < 0.1 else work / "input"
        place.mkdir(parents=True, exist_ok=True)
        for file in self._shared.iterdir():
            shutil.copyfile(file, place / file.name)
        return place / rng.choice(("a.v3dg", "b.v3dg", "town.json"))

    def _fill(self, rng, work, folder):
        """Put files into the folder. Return, by name, those that exports wrote and that
        were not changed."""
        if rng.random() < 0.1 and not folder.exists():
            return {}
        recorded = {}
        folder.mkdir(exist_ok=True)
        folder.chmod(rng.choice((0o755, 0o700, 0o2750, 0o777)))
        acts = [self._put_file, self._put_link, self._put_other_name, self._put_odd]
        if rng.random() < 0.7:
            with contextlib.suppress(*ERRORS):
                kind = rng.choice(list(WRITERS))
                WRITERS[kind](
                    v3dg.Bundle.open(self._shared / rng.choice(("a.v3dg", "b.v3dg"))), folder
                )
                recorded = {name: entry for name, entry in snapshot(folder).items()}
        for _ in range(rng.choice((0, 0, 1, 2, 8))):
            rng.choice(acts)(rng, work, folder)
        if rng.random() < 0.3 and recorded:
            self._change(rng, folder, recorded)
        claims = self._tamper(rng, work, folder) if rng.random() < 0.3 else set()
        if rng.random() < 0.2:
            self._put_hidden(rng, work, folder)
        now = snapshot(folder)
        same = {name: entry for name, entry in recorded.items() if now.get(name) == entry}
        return same | {
            name: now[name] for name in (*claims, RECORD) if name in now and not is_link(now[name])
        }

    def _put_file(self, rng, work, folder):
        path = folder / rng.choice(NAMES)
        with contextlib.suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            if not os.path.lexists(path):
                path.write_text(f"mine {rng.random()}")

    def _put_link(self, rng, work, folder):
        targets = ("../outside", "../outside/0", "../outside/absent", ".", "..", "/", "loop")
        with contextlib.suppress(OSError):
            path = folder / rng.choice((*NAMES, "0_0", "1_0", "a", RECORD, "loop"))
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_file() and rng.random() < 0.5:
                path.unlink()
            os.symlink(rng.choice(targets), path)

    def _put_other_name(self, rng, work, folder):
        """Add a hard link: here to a file elsewhere, or elsewhere to a file here."""
        with contextlib.suppress(OSError):
            path = folder / rng.choice(NAMES)
            path.parent.mkdir(parents=True, exist_ok=True)
            if path.is_file():
                os.link(path, work / "outside" / f"of_{rng.randrange(1000)}", follow_symlinks=False)
            else:
                os.link(work / "outside" / "1", path)

    def _put_odd(self, rng, work, folder):
        with contextlib.suppress(OSError):
            path = folder / rng.choice((*OURS, "0_0", "a", "b", "empty", "1_0/meta.json"))
            path.parent.mkdir(parents=True, exist_ok=True)
            rng.choice((Path.mkdir, os.mkfifo))(path)

    def _change(self, rng, folder, recorded):
        for name in rng.sample(sorted(recorded), min(2, len(recorded))):
            path = folder / name
            if path.is_file() and not path.is_symlink() and name != RECORD:
                rng.choice((lambda p: p.write_text("changed"), Path.unlink))(path)

    def _tamper(self, rng, work, folder):
        """Change or create the record; return the names that it may list."""
        path = folder / RECORD
        if path.is_symlink() or path.is_dir() or (path.exists() and not path.is_file()):
            return set()
        try:
            record = json.loads(path.read_text())
        except (OSError, ValueError):
            record = {"format": "v3dg-export", "version": 1, "folders": [], "files": {}}
        act = rng.randrange(5)
        if act == 0:
            content = bytearray(json.dumps(record).encode())
            for _ in range(rng.choice((1, 3))):
                content[rng.randrange(len(content))] = rng.randrange(256)
            path.write_bytes(content[: rng.choice((len(content), rng.randrange(len(content) + 1)))])
            return set()
        if act == 1:
            name = rng.choice((*LEADING_OUT, str(work / "outside" / "0")))
            record["files"][name] = _claim(b"outside 0")
        elif act == 2:
            record["folders"].append(rng.choice((*LEADING_OUT, str(work / "outside" / "deep"))))
        elif act == 3:  # with another content
            record["files"]["data/cities.json"] = _claim(b"of another city")
            record["folders"].append("data")
        else:
            (folder / "data").mkdir(exist_ok=True)
            (folder / "data" / "towns.json").write_text("a town")
            record["files"]["data/towns.json"] = _claim(b"a town")
        path.write_text(json.dumps(record))
        return {"data/towns.json", "data"} if act == 4 else set()

    def _put_hidden(self, rng, work, folder):
        """Add files that look like the remains of an interrupted export and refer to
        another folder."""
        hidden = folder / f".v3dg-export.{rng.randrange(1 << 64):016x}.tmp"
        act = rng.randrange(4)
        if act == 0:
            hidden.symlink_to("../outside")
            return
        hidden.mkdir()
        name = rng.choice(LEADING_OUT)
        record = {"format": "v3dg-export", "version": 1, "folders": ["deep"], "files": {}}
        if act == 1:
            record["files"][name] = _claim(b"outside 0")
            (hidden / "new").mkdir()
        elif act == 2:
            record["files"]["deep/meta.json"] = _claim(b"outside, deep")
            (hidden / "new").symlink_to("../../outside")
            (hidden / "old").symlink_to("../../outside")
        else:
            (hidden / "old").mkdir()
            (hidden / "old" / "notes.txt").write_text("mine")
            return
        (hidden / RECORD).write_text(json.dumps(record))

    def _output(self, rng, work, folder):
        way = rng.randrange(4)
        if way == 0:
            (work / "link").symlink_to("project")
            return work / "link"
        return (folder, Path("../project"), folder / "." / ".." / "project")[way - 1]

    def _reference(self, kind, subject, work):
        """Return, by name, the files that an export writes to a new folder."""
        key = kind, subject.name
        if key not in self._references:
            place = work.parent / f"{work.name}_{kind}_{subject.stem}"
            WRITERS[kind](self._shared / subject.name, place)
            self._references[key] = snapshot(place)
        return self._references[key]


@contextlib.contextmanager
def _in(folder):
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


def _claim(content):
    return [len(content), hashlib.blake2b(content, digest_size=16).hexdigest()]


def _export(way, kind, subject, output, overwrite, moment):
    """Return the error of an export, or None."""
    more = {"overwrite": True} if overwrite else {}
    if way == "command":
        said = io.StringIO()
        arguments = ["export", str(subject), "-o", str(output), "--quiet"]
        arguments += ["--to", "tiles"] if kind == "tiles" else []
        # `export` writes the page with streamed SOG; its other kind is a separate
        # function.
        if kind != "sog":
            arguments += ["--overwrite"] if overwrite else []
            with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
                code = main(arguments)
            return said.getvalue().rstrip("\n") if code else None
    if way == "two at once":
        threads = [
            threading.Thread(target=_export, args=("call", kind, subject, output, overwrite, 0))
            for _ in range(2)
        ]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        return None
    with _stopped(way, moment):
        try:
            WRITERS[kind](subject, output, **more)
        except (*ERRORS, KeyboardInterrupt) as error:
            return str(error) or type(error).__name__
    return None


@contextlib.contextmanager
def _stopped(way, moment):
    """Make a rename fail, or interrupt the export after it."""
    rename, count = os.rename, 0

    def moved(*arguments, **options):
        nonlocal count
        count += 1
        if way == "failing" and count == moment:
            raise OSError(28, os.strerror(28))
        rename(*arguments, **options)
        if way == "stopped" and count == moment:
            raise KeyboardInterrupt

    os.rename = moved
    try:
        yield
    finally:
        os.rename = rename


def fault_of(before, after, recorded, written, error, overwrite):
    """Return the fault, if any, in everything below the work folder after an export
    that may not have ended."""
    files = {name: entry for name, entry in written.items() if is_file(entry) and name != RECORD}
    missing = [
        name
        for name, entry in files.items()
        if after.get(f"project/{name}", (0, ""))[1] != entry[1]
    ]
    changes = _differs(before, after)
    has_ended = error is None or (error == "KeyboardInterrupt" and not missing)
    if not has_ended:
        return f"failed ({error[:80]!a}), and there are changes: {changes[:3]}" if changes else None
    return (
        f"ended, and is not whole: {missing[:3]}"
        if missing
        else fault_of_changes(before, after, recorded, written, overwrite)
    )


def fault_of_changes(before, after, recorded, written, overwrite):
    """Return the fault if other files were changed, or if new files are not those of
    the export."""
    for path in _differs(before, after):
        name = path.removeprefix("project/") if path.startswith("project/") else None
        old, new = before.get(path), after.get(path)
        is_new = old is None and (name in written or path == "project")
        is_replaced = (
            overwrite
            and name in written
            and None not in (old, new)
            and is_file(old)
            and is_file(new)
        )
        if not (is_new or is_replaced or name in recorded):
            return f"touched {path!a}: {old} is now {new}"
    return None


def _differs(before, after):
    return sorted(
        name for name in before.keys() | after.keys() if before.get(name) != after.get(name)
    )
