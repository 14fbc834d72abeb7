"""`v3dg completion`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import tyro


@dataclass
class Completion:
    """Print a script that completes commands and options: `eval "$(v3dg completion bash)"`."""

    shell: tyro.conf.Positional[Literal["bash", "zsh", "fish"]]
    """Shell that is to read it."""


def run(options: Completion) -> None:
    from v3dg.cli import parse

    parse(["--tyro-write-completion", options.shell, "-"])
