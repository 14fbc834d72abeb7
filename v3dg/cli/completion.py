"""`v3dg completion`."""

import contextlib
import io
import json
from dataclasses import dataclass
from typing import Literal

import tyro

from v3dg.cli._common import Common

# Replacements in tyro's scripts that complete file names if neither a command nor an
# option matches.
_OR_FILES = {
    "bash": ("complete -F", "complete -o default -F"),
    "zsh": ('[[ "$completions" ==', '[[ -z "$completions" || "$completions" =='),
    "fish": ("complete --no-files", "complete"),
}


@dataclass
class Completion(Common):
    """Print a shell script that completes commands, options and files (docs/install.md
    says where to put it)."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """Shell that will run the script."""


def run(options: Completion) -> None:
    from v3dg.cli import parse

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        parse(["--tyro-write-completion", options.shell, "-"])
    text = script.getvalue().replace(*_OR_FILES[options.shell])
    if options.json:
        text = json.dumps({"shell": options.shell, "script": text})
    print(text)
