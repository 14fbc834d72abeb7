"""Options for gaussians with invalid values: leave them out, or raise an error."""

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
    """Options for gaussians with invalid values: values that are not finite, negative
    scales, opacities outside 0 to 1, or zero rotations."""

    drop_bad: Flag = False
    """Leave out gaussians with invalid values, and print how many there are."""
    strict: Flag = False
    """Fail if the input has invalid values. By default, values that are not finite are
    kept in a .ply. Other formats cannot store them, so writing them fails."""

    def check(self) -> None:
        """Raise UsageError for options that contradict each other."""
        is_one = not (self.drop_bad and self.strict)
        check_usage(
            "--strict", is_one, "only one of --strict and --drop-bad, got both; leave out one"
        )


Faults: TypeAlias = Annotated[FaultOptions, tyro.conf.OmitArgPrefixes]


@dataclass(frozen=True)
class Checked:
    """The gaussians to write, the number of gaussians that were left out for each kind
    of invalid value, and a line about invalid values. The line is empty if there are
    none."""

    gaussians: Gaussians
    dropped: dict[str, int]
    note: str


def checked(options: FaultOptions, gaussians: Gaussians, subject: Path, output: Path) -> Checked:
    """Apply the options. If the output cannot store the invalid values, raise a
    ValueError that names the input."""
    findings = examine(gaussians)
    is_unrotated = has_no_rotation(gaussians)
    is_wrong = findings.wrong | is_unrotated
    num_wrong = int(is_wrong.sum())
    if not num_wrong:
        return Checked(gaussians, {}, "")
    counts = {kind: count for kind, count in findings.counts.items() if kind != "transparent"}
    if is_unrotated.any():
        counts["quats_zero"] = int(is_unrotated.sum())
    text = f"{num_wrong:,} of {len(gaussians):,} gaussians have invalid values: {_text(counts)}"
    if options.drop_bad:
        return Checked(gaussians.subset(~is_wrong), counts, f"{shown(subject)}: left out: {text}")
    advice = "leave them out with --drop-bad"
    if options.strict:
        raise ValueError(f"{shown(subject)}: {text}; {advice} instead of --strict")
    if not _holds(output, gaussians):
        raise ValueError(f"{shown(subject)}: {text}, which {output.name} cannot store; {advice}")
    return Checked(gaussians, {}, f"{shown(subject)}: {text}, which {output.name} keeps; {advice}")


def _holds(output: Path, gaussians: Gaussians) -> bool:
    """Return whether a file with this name can store the invalid values of gaussians.
    Only a `.ply` can, if the values have a logarithm or a logit."""
    name = output.name.lower()
    if not name.endswith(".ply") or name.endswith(".compressed.ply"):
        return False
    has_logs = not (gaussians.scales < 0).any()
    is_opacity = (gaussians.opacities >= 0) & (gaussians.opacities <= 1)
    return bool(has_logs and (is_opacity | np.isnan(gaussians.opacities)).all())


def _text(counts: Mapping[str, int]) -> str:
    """Return counts of invalid values as text."""
    texts = []
    for kind, count in counts.items():
        if kind == "quats_zero":
            texts.append(f"{count:,} {_NO_ROTATION}")
        else:
            texts.append(describe({kind: count}))
    return ", ".join(texts)
