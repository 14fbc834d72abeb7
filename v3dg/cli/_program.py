"""A program of several commands: parses, runs one, and turns what may fail into one line and an exit code."""

from __future__ import annotations

import contextlib
import functools
import io
import operator
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, TypeAlias

import tyro

from v3dg._version import __version__
from v3dg.cli._common import FAILURES, UsageError, failure_text

# Options and what runs on them, by the command's name, in the order of the help.
Commands: TypeAlias = Mapping[str, tuple[type[Any], Callable[[Any], None]]]


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
        caught = io.StringIO()
        try:
            with contextlib.redirect_stderr(caught):
                parsed = tyro.cli(
                    functools.reduce(operator.or_, subcommands),
                    prog=self.name,
                    description=self.description,
                    args=arguments,
                    config=(tyro.conf.FlagCreatePairsOff,),
                )
        except SystemExit as stop:
            if not stop.code:
                raise
            raise UsageError(self._one_line(caught.getvalue())) from None
        return parsed

    def _one_line(self, boxed: str) -> str:
        """The text of the first box that tyro drew, without its rules and its title."""
        lines = [line.strip("│╭╮╰╯─ ").strip() for line in boxed.splitlines()[1:]]
        rule = next((i for i, line in enumerate(lines) if not line), len(lines))
        rest = " ".join(line for line in lines[rule:] if line).replace("run:", "run")
        help_at = rest.find(f"run {self.name}")
        hint = rest[help_at:].split("--help")[0] if help_at >= 0 else f"run {self.name} "
        return " ".join(lines[:rule]).rstrip(".") + f"; {hint}--help"

    def main(self, arguments: Sequence[str] | None = None) -> int:
        """Run one command, by default the one this program was started with, and return its exit code."""
        is_program = arguments is None
        arguments = sys.argv[1:] if arguments is None else arguments
        if list(arguments) == ["--version"]:
            print(f"v3dg {__version__}")
            return 0
        try:
            options = self.parse(arguments)
            if is_program:
                _set_threads(getattr(options, "threads", None))
            run = next(run for kind, run in self.commands.values() if isinstance(options, kind))
            run(options)
            sys.stdout.flush()
        except UsageError as error:
            return _fail(str(error), 2)
        except KeyboardInterrupt as stop:
            return _fail(str(stop) or "interrupted", 130)
        except BrokenPipeError:  # the reader of our output has gone: nobody is left to tell
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return 1
        except FAILURES as error:
            return _fail(failure_text(error), 1)
        return 0


def _set_threads(threads: int | None) -> None:
    """Start this process anew with that many threads: OpenMP reads the number once, when it is loaded."""
    if threads is None:
        return
    if threads < 1:
        raise UsageError(f"--threads: expected at least 1, got {threads}")
    if os.environ.get("OMP_NUM_THREADS") != str(threads):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        os.execv(sys.executable, [sys.executable, *sys.orig_argv[1:]])


def _fail(message: str, code: int) -> int:
    print(f"v3dg: error: {' '.join(message.split())}", file=sys.stderr)
    return code
