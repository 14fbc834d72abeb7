"""Options for gaussians with wrong values: leave them out, or refuse them."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, TypeAlias

import numpy as np
import tyro

from v3dg._urls import shown
from v3dg.cleaning import describe, examine, has_no_rotation
from v3dg.cli._common import Flag, check_usage
from v3dg.gaussians import Gaussians

_NO_ROTATION = "with a rotation of length zero"


@dataclass(kw_only=True)
class FaultOptions:
    """Gaussians with wrong values: not finite, with negative scales, opacities outside
    of 0 to 1, or rotations of length zero."""

    drop_bad: Flag = False
    """Leave out gaussians with wrong values, and say how many."""
    strict: Flag = False
    """Refuse an input with wrong values; by default a .ply keeps what is not finite,
    and other formats, which cannot hold it, refuse it."""

    def check(self) -> None:
        """Refuse options that contradict each other."""
        is_one = not (self.drop_bad and self.strict)
        check_usage("--strict", is_one, "it or --drop-bad, got both; leave out one")


Faults: TypeAlias = Annotated[FaultOptions, tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True)
class Checked:
    """Gaussians to write, how many were left out because of wrong values, by kind, and
    a line that says so, or that they were kept; empty without any."""

    gaussians: Gaussians
    dropped: dict[str, int]
    note: str


def checked(options: FaultOptions, gaussians: Gaussians, subject: Path, output: Path) -> Checked:
    """Apply the options; ValueError names the file whose wrong values cannot be
    written."""
    findings = examine(gaussians)
    is_unrotated = has_no_rotation(gaussians)
    is_wrong = findings.wrong | is_unrotated
    num_wrong = int(is_wrong.sum())
    if not num_wrong:
        return Checked(gaussians, {}, "")
    counts = {kind: count for kind, count in findings.counts.items() if kind != "transparent"}
    if is_unrotated.any():
        counts["quats_zero"] = int(is_unrotated.sum())
    text = f"{num_wrong:,} of {len(gaussians):,} gaussians have wrong values: {_text(counts)}"
    if options.drop_bad:
        return Checked(gaussians.subset(~is_wrong), counts, f"{shown(subject)}: left out: {text}")
    advice = "leave them out with --drop-bad"
    if options.strict:
        raise ValueError(f"{shown(subject)}: {text}; {advice} instead of --strict")
    if not _holds(output, gaussians):
        raise ValueError(f"{shown(subject)}: {text}, which {output.name} cannot hold; {advice}")
    return Checked(gaussians, {}, f"{shown(subject)}: {text}, which {output.name} keeps; {advice}")


def _holds(output: Path, gaussians: Gaussians) -> bool:
    """Return whether a file of this name can hold the gaussians' wrong values: a `.ply`
    stores logs and logits, so it holds values that have them."""
    name = output.name.lower()
    if not name.endswith(".ply") or name.endswith(".compressed.ply"):
        return False
    has_logs = not (gaussians.scales < 0).any()
    is_opacity = (gaussians.opacities >= 0) & (gaussians.opacities <= 1)
    return bool(has_logs and (is_opacity | np.isnan(gaussians.opacities)).all())


def _text(counts: Mapping[str, int]) -> str:
    """Counts of kinds in words."""
    texts = []
    for kind, count in counts.items():
        if kind == "quats_zero":
            texts.append(f"{count:,} {_NO_ROTATION}")
        else:
            texts.append(describe({kind: count}))
    return ", ".join(texts)
