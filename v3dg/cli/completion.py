"""`v3dg completion`."""

import ast
import contextlib
import io
import json
import re
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

import tyro

from v3dg.cli._common import Common

_Shell: TypeAlias = Literal["bash", "zsh", "fish"]
# The completions of a command, in tyro's format: nested dicts and lists.
_Spec: TypeAlias = dict[str, object]

# Replacements in tyro's scripts. With them, file names are completed if neither a
# command nor an option matches.
_OR_FILES = {
    "bash": ("complete -F", "complete -o default -F"),
    "zsh": ('[[ "$completions" ==', '[[ -z "$completions" || "$completions" =='),
    "fish": ("complete --no-files", "complete"),
}
# The line of tyro's scripts that contains all commands and options as a Python literal.
_SPEC = re.compile(r"^COMPLETION_SPEC = (.*)$", re.MULTILINE)
_BASH_MATCH = 'matches+=("$completion")'


@dataclass
class Completion(Common):
    """Print a shell script that completes commands, options and file names
    (docs/install.md describes how to install it)."""

    shell: tyro.conf.Positional[_Shell]
    """The shell for the script."""


def run(options: Completion) -> None:
    from v3dg.cli import parse

    script = io.StringIO()
    with contextlib.redirect_stdout(script), contextlib.suppress(SystemExit):
        parse(["--tyro-write-completion", options.shell, "-"])
    text = _plain(script.getvalue(), options.shell).replace(*_OR_FILES[options.shell])
    # An empty completion must not count as a match. Otherwise, file names would not be
    # completed.
    text = text.replace(_BASH_MATCH, f'[[ -z "$completion" ]] || {_BASH_MATCH}')
    if options.json:
        text = json.dumps({"shell": options.shell, "script": text})
    print(text)


def _plain(script: str, shell: _Shell) -> str:
    """Return a script that completes names without their help texts, and without None
    as a value of optional options."""
    match = _SPEC.search(script)
    if match is None:
        raise RuntimeError(
            "completion: tyro wrote an unknown kind of script; install an earlier version of tyro"
        )
    literal = match[1]
    if shell == "fish":  # the script for fish is in double quotes
        literal = re.sub(r"\\(.)", r"\1", literal)
    spec = cast(_Spec, ast.literal_eval(literal))
    _simplify(spec)
    literal = repr(spec)
    if shell == "fish":
        literal = re.sub(r'([\\"$])', r"\\\1", literal)
    return script[: match.start(1)] + literal + script[match.end(1) :]


def _simplify(spec: _Spec) -> None:
    """Remove help texts and None from the completions of a command and of its
    subcommands."""
    spec["description"] = ""
    for option in cast(list[_Spec], spec["options"]):
        option["description"] = ""
        if "choices" in option:
            choices = set(cast(list[str], option["choices"])) - {"None"}
            option["choices"] = sorted(choices, key=lambda name: (name[:1] == "-", name))
    for command in cast(dict[str, _Spec], spec["subcommands"]).values():
        _simplify(command)
