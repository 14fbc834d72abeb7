"""Runs random command lines. Each has to end by itself with exit code 0, or with 1 or 2
and one line that states the reason."""

import os
import signal
import stat
import time

from fuzz.attacks.program import copied, documents, fault_of, is_running, make_files, outcome, run

LIMIT_S = 150
LONG_S = 60  # in seconds; all commands here are small

NUMBERS = (
    "0",
    "1",
    "2",
    "3",
    "-1",
    "1.5",
    "1e3",
    "nan",
    "inf",
    "-inf",
    "1e400",
    "1e-320",
    "2147483647",
    "2147483648",
)
NUMBERS += (
    "4294967295",
    "4294967296",
    "18446744073709551616",
    "9" * 400,
    "0x10",
    "١",
    "",
    " ",
    "a",
    "-",
    "1_0",
    "+2",
)
WORDS = (
    "auto",
    "cpu",
    "cuda",
    "cuda:9",
    "",
    "é",
    "a\nb",
    "\x1b[31m",
    "x" * 5000,
    "-",
    "--",
    "z",
    "all",
    "paper",
    "level",
)
SUBJECTS = (
    "a.ply",
    "a.spz",
    "a.sog",
    "a.compressed.ply",
    "a.v3dg",
    "a.v3dg",
    "scene.json",
    "odd.json",
    "many",
    "a.png",
)
ODD_SUBJECTS = (
    ".",
    "",
    "/dev/null",
    "/dev/zero",
    "absent.ply",
    "a.ply/x.ply",
    "pipe.ply",
    "loop.ply",
    "link.v3dg",
    "folder.ply",
)
ODD_SUBJECTS += (
    "empty.v3dg",
    "noise.spz",
    "noise.json",
    "-x.ply",
    "x" * 300 + ".ply",
    "lying.v3dg",
    "\udcff.ply",
    "cameras.json",
)
OUTPUTS = (
    "out.png",
    "out.jpg",
    "out.v3dg",
    "out.ply",
    "out.spz",
    "out.sog",
    "out.compressed.ply",
    "out",
    "sub/out.png",
)
OUTPUTS += (
    "a.ply",
    "a.v3dg",
    "a.png",
    ".",
    "/",
    "/dev/full",
    "/proc/x.png",
    "folder.ply",
    "pipe.ply",
    "link.v3dg",
    "",
    "o" * 300 + ".ply",
)
# The options, each with what it takes: a number, a word, a path, or nothing.
VIEWS = {
    "--cameras": "p",
    "--distortion": "w",
    "--camera": "w",
    "--views": "n",
    "--size": "nn",
    "--elevation": "n",
    "--up": "w",
}
CUT = {"--tolerance": "n", "--budget": "n"}
OPTIONS = {
    "build": {
        "-o": "o",
        "--config": "w",
        "--cluster-size": "n",
        "--seed": "n",
        "--up": "w",
        "--device": "w",
        "--strict": "",
        "--resume": "",
    },
    "info": {},
    "render": {
        "-o": "o",
        **CUT,
        "--min-level": "n",
        "--fade": "n",
        "--color-by": "w",
        "--background": "nnn",
        "--device": "w",
        **VIEWS,
    },
    "view": {"--host": "w", "--port": "n", "--up": "w", "--no-browser": "", **CUT, "--device": "w"},
    "compare": {
        "-o": "o",
        "--pictures": "w",
        **CUT,
        "--supersample": "n",
        "--device": "w",
        **VIEWS,
    },
    "convert": {"--level": "n", **CUT, "--outside": "w", **VIEWS},
    "export": {"-o": "o", "--chunk": "n", "--up": "w", "--overwrite": ""},
    "demo": {
        "-o": "o",
        "--gaussians": "n",
        "--instances": "n",
        "--size": "nn",
        "--tolerance": "n",
        "--seed": "n",
    },
    "completion": {},
}
COMMON = {"--threads": "n", "--json": "", "--quiet": ""}
LACKING = {"info": {"--threads", "--quiet"}, "render": {"--quiet"}, "view": {"--json", "--quiet"}}
LACKING |= {"convert": {"--quiet"}, "completion": {*COMMON}}
NUM_SUBJECTS = {"compare": 2, "demo": 0, "completion": 0}
FITTING = {
    "--size": ("20", "33", "64"),
    "--views": ("1", "2", "3"),
    "--gaussians": ("50", "300"),
    "--instances": ("1", "9"),
    "--supersample": ("1", "2"),
    "--chunk": ("100", "1000"),
    "--port": ("0",),
    "--background": ("0", "0.5", "1"),
    "--device": ("auto", "cpu"),
    "--config": ("default",),
    "--up": ("x", "z", "-y"),
    "--color-by": ("level", "cluster"),
    "--camera": ("0", "left", "far"),
    "--host": ("127.0.0.1", "localhost", "::1"),
    "--cameras": ("cameras.json", "a.ply"),
    "--threads": ("1", "2"),
}
ENVIRONMENTS = (
    {"LC_ALL": "C", "PYTHONUTF8": "0"},
    {"PYTHONIOENCODING": "ascii"},
    {"TERM": "dumb", "COLUMNS": "1"},
    {"COLUMNS": "-3", "LINES": "x"},
    {"HOME": "/dev/null", "TMPDIR": "/absent"},
    {"OMP_NUM_THREADS": "0"},
    {"OMP_NUM_THREADS": "two"},
    {"OMP_NUM_THREADS": "3,2"},
    {"PYTHONOPTIMIZE": "2"},
    {"CUDA_VISIBLE_DEVICES": "none"},
    {"V3DG_ISA": "z80"},
    {"PATH": ""},
    {"PYTHONHASHSEED": "7", "PYTHONUNBUFFERED": "1"},
)


def prepare(shared):
    (shared / "files").mkdir()
    make_files(shared / "files")
    odd = shared / "files"
    (odd / "folder.ply").mkdir()
    (odd / "loop.ply").symlink_to("loop.ply")
    (odd / "link.v3dg").symlink_to("a.v3dg")
    (odd / "empty.v3dg").touch()
    (odd / "-x.ply").write_bytes((odd / "a.ply").read_bytes())
    for name in ("noise.spz", "noise.json"):
        (odd / name).write_bytes(os.urandom(3000))
    import v3dg

    bundle = v3dg.Bundle.open(odd / "a.v3dg")
    made_with = {**bundle.config, "dropped": 5, "seed": "\x1b]0;owned\x07", "é\n\x9b": [None] * 3}
    v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, made_with).write(
        odd / "lying.v3dg"
    )


class Attack:
    def __init__(self, shared):
        self._shared = shared

    def plan(self, rng, work):
        copied(self._shared, work)
        os.mkfifo(work / "pipe.ply")
        command = rng.choice([*OPTIONS, *(name for name in OPTIONS if name != "completion")])
        arguments = _arguments(rng, command)
        environment = os.environ | (rng.choice(ENVIRONMENTS) if rng.random() < 0.15 else {})
        closed = rng.choice(((0,), (1,), (2,), (1, 2), (0, 1, 2))) if rng.random() < 0.1 else ()
        is_full = not closed and rng.random() < 0.04
        modes = _change_outputs(rng, work, arguments) if rng.random() < 0.25 else {}
        trap = work / "trap"
        if rng.random() < 0.05:
            for name in ("out.v3dg.partial", "a.v3dg.partial"):
                (work / name).symlink_to(trap)
        (work / "arguments.txt").write_text(ascii(arguments))

        def do():
            with open("/dev/full", "wb") as full:
                ended = run(
                    arguments,
                    work,
                    limit_s=LONG_S,
                    environment=environment,
                    closed=closed,
                    out=full if is_full else None,
                    meddle=_interrupt_server if command == "view" else None,
                )
            codes = (0, 1, 2, 130) if command == "view" else (0, 1, 2)
            fault = fault_of(ended, codes=codes, is_heard=2 not in closed)
            if fault is None and ended.code == 0:
                fault = _fault_of_files(work, command, arguments, ended, modes)
            if fault is None and trap.exists():
                fault = "a link that led nowhere was followed"
            return outcome(ended, fault)

        return command, do


def _arguments(rng, command):
    arguments = [command]
    for _ in range(NUM_SUBJECTS.get(command, 1)):
        arguments.append(rng.choice(SUBJECTS) if rng.random() < 0.8 else rng.choice(ODD_SUBJECTS))
    if command == "export" and rng.random() < 0.7:
        arguments[1] = rng.choice(("a.v3dg", "lying.v3dg"))
    if command == "compare" and "a.png" in arguments and rng.random() < 0.8:
        arguments[1:] = ["a.png", "b.png"]
    if command == "convert":
        arguments.append(rng.choice(OUTPUTS[3:7]) if rng.random() < 0.7 else rng.choice(OUTPUTS))
    if command == "completion":
        arguments.append(rng.choice(("bash", "zsh", "fish", *WORDS)))
    kinds = {**OPTIONS[command], **COMMON}
    if rng.random() < 0.9:
        kinds = {name: kinds[name] for name in kinds if name not in LACKING.get(command, ())}
    # Outputs are small unless a size was chosen.
    if command in ("demo", "render", "compare") and "b.png" not in arguments:
        arguments += (
            ["--size", "24", "20"]
            if command != "demo"
            else ["--gaussians", "60", "--instances", "5", "--size", "24", "20"]
        )
    for name in rng.sample(list(kinds), min(len(kinds), rng.choice((0, 1, 1, 2, 3, 4)))):
        arguments.append(name)
        for kind in kinds[name]:
            fits = rng.random() < 0.75
            if name in FITTING and fits:
                arguments.append(rng.choice(FITTING[name]))
            elif kind == "n":
                arguments.append(
                    rng.choice(
                        ("0", "1", "2", "5.5", "100") if fits and name not in FITTING else NUMBERS
                    )
                )
            elif kind in "op":
                arguments.append(rng.choice(OUTPUTS if kind == "o" else SUBJECTS + ODD_SUBJECTS))
            else:
                arguments.append(rng.choice(WORDS))
    if rng.random() < 0.03:
        arguments.insert(
            rng.randrange(len(arguments) + 1),
            rng.choice(("--help", "--version", "--", "-h", "\udcff", "--json=3", "--frobnicate")),
        )
    if rng.random() < 0.03:
        rng.shuffle(arguments)
    return [argument.replace("\0", "") for argument in arguments]


def _change_outputs(rng, work, arguments):
    """Check that an overwritten file keeps its permissions."""
    modes = {}
    for name in set(arguments) & set(OUTPUTS[:7]):
        mode = rng.choice((0o600, 0o640, 0o666))
        (work / name).write_bytes(b"before")
        (work / name).chmod(mode)
        modes[name] = mode
    return modes


def _interrupt_server(process, out):
    """Interrupt the server when it has printed its address. If its stdout is closed,
    wait for the time that this takes."""
    end = time.monotonic() + 10
    while is_running(process) and time.monotonic() < end and b"http://" not in out.read_bytes():
        time.sleep(0.02)
    time.sleep(0.1)
    if is_running(process):
        process.send_signal(signal.SIGINT)


def _fault_of_files(work, command, arguments, ended, modes):
    for name, mode in modes.items():
        now = stat.S_IMODE((work / name).stat().st_mode)
        if now != mode:
            return f"a file of mode {mode:o} has now {now:o}"
    result = documents(ended.out) if "--json" in arguments else None
    if command == "render" and isinstance(result, dict):
        pictures = [os.path.realpath(work / row["picture"]) for row in result["pictures"]]
        if len(set(pictures)) < len(pictures):
            return f"{len(pictures)} pictures in {len(set(pictures))} files"
        if not all(map(os.path.isfile, pictures)):
            return "a picture that is named is not there"
    return None
