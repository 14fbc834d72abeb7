"""A program of several commands: parses, runs one, and turns what may fail into one line and an exit code."""

import contextlib
import difflib
import functools
import io
import operator
import os
import re
import shutil
import signal
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import tyro

from v3dg import _start
from v3dg._version import __version__
from v3dg.cli._common import FAILURES, UsageError, check_range, check_usage, failure_text, tell

# Options and what runs on them, by the command's name, in the order of the help.
Commands: TypeAlias = Mapping[str, tuple[type[Any], Callable[[Any], None]]]

INTERRUPTED = 130  # exit code

# More than any machine has cores; where the system refuses one, OpenMP ends the process.
_MOST_THREADS = 1024
_LEAST_COLUMNS = 40


@dataclass(frozen=True)
class Program:
    """What is typed to start it, what its help begins with, and its commands."""

    name: str
    description: str
    commands: Commands

    def parse(self, arguments: Sequence[str]) -> Any:
        """Parse the command line; tyro's boxed message becomes one line."""
        subcommands: Any = [
            Annotated[options, tyro.conf.subcommand(name)] for name, (options, _) in self.commands.items()
        ]
        # A shell's variable that is not set; as a path it would be the working folder, and all in it.
        check_usage("arguments", "" not in arguments, "no empty one, got ''; check what was to stand there")
        caught = io.StringIO()
        try:
            with contextlib.redirect_stderr(caught), _legible_width():
                return tyro.cli(
                    functools.reduce(operator.or_, subcommands),
                    prog=self.name,
                    description=self.description,
                    args=arguments,
                    config=(tyro.conf.FlagCreatePairsOff,),
                )
        except SystemExit as stop:
            if not stop.code:
                raise
            raise UsageError(self._one_line(caught.getvalue(), arguments)) from None

    def _one_line(self, boxed: str, arguments: Sequence[str]) -> str:
        """The text of the first box that tyro drew, or which name is unknown, and what may be meant."""
        lines = [line.strip("│╭╮╰╯─ ").strip() for line in boxed.splitlines()[1:]]
        rule = next((i for i, line in enumerate(lines) if not line), len(lines))
        text, asked = _plainly(" ".join(lines[:rule]).rstrip(".")), self.name
        known, slips = list(self.commands), arguments[:1]
        if slips and slips[0] not in known:
            text = f"COMMAND: expected {', '.join(known)}, got {slips[0]}"
        elif slips:
            asked, known = f"{self.name} {slips[0]}", self._options(slips[0])
            names = [name.partition("=")[0].replace("_", "-") for name in arguments[1:]]
            slips = [name for name in names if name.startswith("--") and name not in known]
            text = f"{slips[0]}: expected an option of {asked}, got none" if slips else text
        meant = difflib.get_close_matches(slips[0], known, 1, 0.7) if slips else []
        return f"{text}{f'; perhaps you meant {meant[0]}' if meant else ''}; run {asked} --help"

    def _options(self, command: str) -> list[str]:
        """Names of the options that the help of a command has."""
        with contextlib.redirect_stdout(io.StringIO()) as told, contextlib.suppress(SystemExit):
            self.parse([command, "--help"])
        return re.findall(r"--[a-z][a-z-]*", told.getvalue())

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run one command, by default the one this program was started with, and return its exit code."""
        if arguments is None:
            warnings.showwarning = lambda message, *_, **__: tell(f"v3dg: warning: {message}")
        code = 0
        try:
            code = self._run(arguments)
            code = _flush(code)
        except KeyboardInterrupt:  # when the command was over, or had been interrupted before
            if arguments is not None:
                raise
            code = code or _fail("interrupted", INTERRUPTED)
        if arguments is None:
            for number in _start.SIGNALS:  # what was to be done is done
                signal.signal(number, signal.SIG_IGN)
            if code == INTERRUPTED:
                os._exit(code)  # whatever threads are still at
        return code

    def _run(self, arguments: Sequence[str] | None) -> int:
        given = sys.argv[1:] if arguments is None else list(arguments)
        try:
            if given == ["--version"]:
                print(f"v3dg {__version__}")
                return 0
            options = self.parse(given)
            if arguments is None:
                _set_threads(getattr(options, "threads", None))
                _start.raise_interrupts()
            next(run for kind, run in self.commands.values() if isinstance(options, kind))(options)
        except SystemExit:  # after the help
            return 0
        except UsageError as error:
            return _fail(str(error), 2)
        except KeyboardInterrupt as stop:
            return _fail(str(stop) or "interrupted", INTERRUPTED)
        except BrokenPipeError:
            return 1
        except FAILURES as error:
            return _fail(failure_text(error), 1)
        return 0


@contextlib.contextmanager
def _legible_width() -> Iterator[None]:
    """Have a narrow terminal taken for one with room for a few words: in 5 columns, tyro finds no end."""
    if shutil.get_terminal_size().columns >= _LEAST_COLUMNS:
        yield
        return
    columns = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = str(_LEAST_COLUMNS)
    try:
        yield
    finally:
        del os.environ["COLUMNS"]
        if columns is not None:
            os.environ["COLUMNS"] = columns


def _plainly(text: str) -> str:
    """What tyro says of a value, without types of Python, and its choices in one order, without None."""
    if match := re.match(r"Error parsing (--[a-z-]+): (.*)", text):
        expected = "numbers" if "float" in match[2].lower() else "whole numbers"
        return f"{match[1]}: expected {expected}, got " + ", ".join(re.findall("'.*?'", match[2]))
    if match := re.match(r"Missing from [^:]*: (\S+) (.*?)\.? \(required\)", text):
        return f"{match[1]}: expected {match[2][:1].lower()}{match[2][1:]}, got nothing"
    if match := re.match(r"invalid choice (.*) for argument '(.*)'. Expected one of (.*)", text):
        known = set(re.findall(r"'(.*?)'", match[3])) - {"None"}
        expected = ", ".join(sorted(known, key=lambda name: (name[0] == "-", name)))
        return f"{match[2]}: expected one of {expected}, got {match[1]}"
    if match := re.match(r"Missing value for argument '(?:.*/)?(--.*)'. Expected (\d) values", text):
        return f"{match[1]}: expected {match[2]} value{'s' * (match[2] != '1')}, got fewer"
    return text


def _set_threads(threads: int | None) -> None:
    """Start this process anew with that many threads: OpenMP reads the number once, when it is loaded."""
    if threads is None:
        return
    check_range("--threads", threads, 1, _MOST_THREADS)
    if os.environ.get("OMP_NUM_THREADS") != str(threads):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        # Until the next process is ready to hear Ctrl-C, it waits.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _flush(code: int) -> int:
    """Write out what was printed; the exit code, which says if that fails."""
    try:
        sys.stdout.flush()
    except OSError as error:
        # Python flushes once more at its end, and has to find a place for it.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        # Where the reader of our output has gone, nobody is left to tell.
        is_to_tell = code == 0 and not isinstance(error, BrokenPipeError)
        code = _fail(f"stdout: {error.strerror}", 1) if is_to_tell else code or 1
    return code


def _fail(message: str, code: int) -> int:
    tell(f"v3dg: error: {message}")
    return code
