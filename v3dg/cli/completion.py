"""`v3dg completion`."""

import contextlib
import io
from dataclasses import dataclass
from typing import Literal

import tyro

# What to change in tyro's scripts, so that files are completed where neither a command nor an option fits.
_OR_FILES = {
    "bash": ("complete -F", "complete -o default -F"),
    "zsh": ('[[ "$completions" ==', '[[ -z "$completions" || "$completions" =='),
    "fish": ("complete --no-files", "complete"),
}


@dataclass
class Completion:
    """Print a script that completes commands, options and files (docs/install.md says where to put it)."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """Shell that will read it."""


def run(options: Completion) -> None:
    from v3dg.cli import parse

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        parse(["--tyro-write-completion", options.shell, "-"])
    print(script.getvalue().replace(*_OR_FILES[options.shell]))
