"""A program with several commands. It parses the command line, runs one command, and
reports a failure as one line and an exit code."""

import ast
import contextlib
import dataclasses
import difflib
import functools
import inspect
import io
import itertools
import operator
import os
import re
import shutil
import signal
import sys
import textwrap
import typing
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias, cast

import tyro

from v3dg import _core, _start, _system
from v3dg._version import __version__
from v3dg.cli._common import FAILURES, UsageError, check_range, failure_text, tell

# Each command has its own class of options, and a function that takes an instance of
# that class.
Options: TypeAlias = Any
# Commands by name, in the order in which the help lists them.
Commands: TypeAlias = Mapping[str, tuple[type[Options], Callable[[Options], None]]]

INTERRUPTED = 130  # exit code
_HELP = ("-h", "--help", "--tyro-write-completion", "--tyro-print-completion")

# More than the number of cores of any machine. There is a limit because OpenMP ends the
# process if the system cannot create a thread.
_MOST_THREADS = 1024
_LEAST_COLUMNS = 40


@dataclass(frozen=True)
class Program:
    """The name of a program, the description in its help, and its commands."""

    name: str
    description: str
    commands: Commands

    def parse(self, arguments: Sequence[str]) -> Options:
        """Parse the command line.

        An error of tyro with several lines is shortened to one.
        """
        if any(argument in _HELP for argument in arguments):
            self.join_help()
        subcommands: list[Options] = [
            Annotated[options, tyro.conf.subcommand(name)]
            for name, (options, _) in self.commands.items()
        ]
        if "" in arguments:  # an empty path would mean the working directory
            number = list(arguments).index("") + 1
            raise UsageError(f"argument {number} is empty; is a shell variable unset?")
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

    def join_help(self) -> None:
        """Join the docstring of each option to one line, because tyro keeps line breaks
        before indented lines."""
        for options, _ in self.commands.values():
            for kind in options.__mro__[:-1]:
                _join_help(kind)

    def _one_line(self, boxed: str, arguments: Sequence[str]) -> str:
        """Return the message for a wrong command line. It is about an unknown command
        or option, or else it is the text of tyro's first box."""
        if not arguments:
            return f"{_text_of_first_box(boxed)}; run {self.name} --help"
        command = arguments[0]
        if command not in self.commands:
            names = list(self.commands)
            text = f"COMMAND: expected {', '.join(names)}, got {command}"
            return f"{text}{_suggestion(command, names)}; run {self.name} --help"
        text = self._unknown_option(command, arguments[1:]) or _text_of_first_box(boxed)
        return f"{text}; run {self.name} {command} --help"

    def _unknown_option(self, command: str, arguments: Sequence[str]) -> str | None:
        """Return the message for the first option that the command does not have, or
        None."""
        options = self._options(command)
        for argument in arguments:
            name = argument.partition("=")[0].replace("_", "-")
            if name.startswith("--") and name not in options:
                text = f"{name}: expected an option of {self.name} {command}, got none"
                return f"{text}{_suggestion(name, options)}"
        return None

    def _options(self, command: str) -> list[str]:
        """Return the names of the options of a command, from its help."""
        with contextlib.redirect_stdout(io.StringIO()) as printed, contextlib.suppress(SystemExit):
            self.parse([command, "--help"])
        return re.findall(r"--[a-z][a-z-]*", printed.getvalue())

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run one command and return its exit code. ``arguments`` are the words of the
        command line. By default, they are those of this process."""
        if arguments is None:
            warnings.showwarning = lambda message, *_, **__: tell(f"v3dg: warning: {message}")
        code = 0
        try:
            code = self._run(arguments)
            code = _flush(code)
        # Either the command was interrupted, or Ctrl-C was pressed after it had ended.
        except KeyboardInterrupt:
            if arguments is not None:
                raise
            code = code or _fail("interrupted", INTERRUPTED)
        if arguments is None:
            # At the end of the process, signals are ignored.
            for number in _system.SIGNALS:
                signal.signal(number, signal.SIG_IGN)
            if code == INTERRUPTED:
                os._exit(code)  # does not wait for other threads
        return code

    def _run(self, arguments: Sequence[str] | None) -> int:
        words = sys.argv[1:]
        if arguments is not None:
            words = list(arguments)
        try:
            if words == ["--version"]:
                print(f"v3dg {__version__}")
                return 0
            options = self.parse(words)
            if arguments is None:
                _set_threads(getattr(options, "threads", None))
                _start.raise_interrupts()
            next(run for kind, run in self.commands.values() if isinstance(options, kind))(options)
        except SystemExit:  # tyro raises this after it has printed the help
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


@functools.cache
def _join_help(kind: type[Options]) -> None:
    """Copy the docstring of each option in a class to the annotation of the option, as
    one line."""
    annotations = inspect.get_annotations(kind)
    (source,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    for field, docstring in itertools.pairwise(cast(ast.ClassDef, source).body):
        match field, docstring:
            case (
                ast.AnnAssign(target=ast.Name(id=name)),
                ast.Expr(value=ast.Constant(value=str(text))),
            ):
                joined = tyro.conf.arg(help=" ".join(text.split()))
                annotations[name] = Annotated[annotations[name], joined]
    kind.__annotations__ = annotations
    for annotation in annotations.values():
        group = typing.get_args(annotation)[:1]
        if group and dataclasses.is_dataclass(group[0]):
            for nested in cast(type, group[0]).__mro__[:-1]:
                _join_help(nested)


@contextlib.contextmanager
def _legible_width() -> Iterator[None]:
    """Increase the width of the terminal to a minimum, because tyro does not terminate
    with 5 columns."""
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


def _suggestion(name: str, choices: Sequence[str]) -> str:
    """Return the end of a message that suggests the choice most similar to an unknown
    name. If no choice is similar, return an empty text."""
    similar = difflib.get_close_matches(name, choices, 1, 0.7)
    if similar:
        return f"; perhaps you meant {similar[0]}"
    return ""


def _text_of_first_box(boxed: str) -> str:
    """Return the text of the first box that tyro prints, in plain words."""
    lines = [line.strip("│╭╮╰╯─ ").strip() for line in boxed.splitlines()[1:]]
    end = next((i for i, line in enumerate(lines) if not line), len(lines))
    return _plainly(" ".join(lines[:end]).rstrip("."))


def _plainly(text: str) -> str:
    """Return a message of tyro without Python's types and None, and with choices in a
    fixed order."""
    if match := re.match(r"Error parsing (--[a-z-]+): (.*)", text):
        expected = "whole numbers"
        if "float" in match[2].lower():
            expected = "numbers"
        if numbers := re.search(r"{(\w+(?: \w+)+)}", match[2]):
            expected = f"{len(numbers[1].split())} {expected}"
        return f"{match[1]}: expected {expected}, got " + ", ".join(re.findall("'.*?'", match[2]))
    if match := re.match(r"Missing from [^:]*: (\S+) (.*?)\.? \(required\)", text):
        return f"{match[1]}: expected {match[2][:1].lower()}{match[2][1:]}, got nothing"
    if match := re.match(r"invalid choice (.*) for argument '(.*)'. Expected one of (.*)", text):
        choices = set(re.findall(r"'(.*?)'", match[3])) - {"None"}
        expected = ", ".join(sorted(choices, key=lambda name: (name[0] == "-", name)))
        return f"{match[2]}: expected one of {expected}, got {match[1]}"
    if match := re.match(
        r"Missing value for argument '(?:.*/)?(--.*)'. Expected (\d) values", text
    ):
        return f"{match[1]}: expected {match[2]} value{'s' * (match[2] != '1')}, got fewer"
    return text


def _set_threads(threads: int | None) -> None:
    """Restart this process with a number of threads, because OpenMP only reads that
    number once, when it is loaded. Without OpenMP, the first parallel loop reads it."""
    if threads is None:
        return
    check_range("--threads", threads, 1, _MOST_THREADS)
    if os.environ.get("OMP_NUM_THREADS") != str(threads):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        if not _core.has_openmp:
            return
        # Ctrl-C stays blocked until the new process can handle it.
        _system.block_signals({signal.SIGINT})
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _flush(code: int) -> int:
    """Flush stdout, and return the exit code.

    If flushing fails, the exit code becomes 1.
    """
    try:
        sys.stdout.flush()
    except OSError as error:
        # At exit, Python flushes stdout again, which must not fail.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        # A closed pipe is not an error, because its reader does not want more output.
        if code == 0 and not isinstance(error, BrokenPipeError):
            return _fail(f"stdout: {error.strerror}", 1)
        return code or 1
    return code


def _fail(message: str, code: int) -> int:
    tell(f"v3dg: error: {message}")
    return code
