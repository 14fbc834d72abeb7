"""Options for editing the gaussians that a command writes: add files, crop, delete,
drop, and change the SH degree."""

import os
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import tyro

from v3dg import editing
from v3dg.bundle import Bundle
from v3dg.cli._common import Flag, UsageError, check_usage, option, require_file
from v3dg.gaussians import Gaussians
from v3dg.io import SUFFIXES
from v3dg.opening import open as open_subject
from v3dg.rotations import quaternion_from_angles

_SHAPES = "box:X0,Y0,Z0,X1,Y1,Z1 or sphere:X,Y,Z,RADIUS"
_PLACEMENT = "X,Y,Z or X,Y,Z,SCALE or X,Y,Z,SCALE,RX,RY,RZ"


@dataclass(kw_only=True)
class EditOptions:
    """Edits of the written gaussians, in this order: outliers are dropped from each
    file; the files are placed, joined and moved as a whole; the result is cropped; and
    the other limits are applied. Coordinates of crops are those of the result, as `v3dg
    info` shows them for a .ply."""

    add: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, option("FILE@X,Y,Z")] = ()
    """Add another asset or bundle, placed at X,Y,Z in the frame of the first. A fourth
    number scales it, and three more numbers rotate it, in degrees about x, then y, then
    z. Can be repeated."""
    drop_outliers: Flag = False
    """Drop gaussians that are more than 20 median distances away from the median. `v3dg
    info` counts them."""
    crop: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, option("SHAPE")] = ()
    """Keep only gaussians in box:X0,Y0,Z0,X1,Y1,Z1 (opposite corners; inf means no
    limit) or in sphere:X,Y,Z,RADIUS. If the option is repeated, keep only gaussians
    that are in all of them."""
    delete: Annotated[tuple[str, ...], tyro.conf.UseAppendAction, option("SHAPE")] = ()
    """Delete gaussians in a box or a sphere, which are specified as for --crop. Can be
    repeated."""
    min_opacity: Annotated[float | None, option("X")] = None
    """Drop gaussians with an opacity below X, from 0 to 1."""
    degree: Annotated[Literal[0, 1, 2, 3] | None, option("{0,1,2,3}")] = None
    """Write spherical harmonics of this degree. Higher degrees are removed, and missing
    ones are zero, for programs that only read files of degree 3."""

    def option_names(self) -> list[str]:
        """Return the names of those of these options that were given."""
        options = {
            "--add": self.add,
            "--drop-outliers": self.drop_outliers,
            "--crop": self.crop,
            "--delete": self.delete,
            "--min-opacity": self.min_opacity is not None,
            "--degree": self.degree is not None,
        }
        return [name for name, value in options.items() if value]

    def check(self) -> None:
        """Raise an error for invalid values, before anything is read."""
        for text in self.add:
            require_file(_Addition.parse(text).path, *SUFFIXES, ".v3dg")
        for text in self.crop:
            _Shape.parse("--crop", text)
        for text in self.delete:
            _Shape.parse("--delete", text)
        if self.min_opacity is not None:
            is_opacity = 0 <= self.min_opacity <= 1
            check_usage(
                "--min-opacity", is_opacity, f"a number from 0 to 1, got {self.min_opacity}"
            )

    def added_paths(self) -> list[Path]:
        """Return the files of --add."""
        return [_Addition.parse(text).path for text in self.add]


Edits: TypeAlias = Annotated[EditOptions, tyro.conf.OmitArgPrefixes]


class Editor:
    """Applies the editing options of a command, and counts the gaussians that they
    remove."""

    def __init__(self, options: EditOptions) -> None:
        self._options = options
        self._num_before = 0
        self._left_out: dict[str, int] = {}
        self._degree_before = 0
        self._degree_after = 0

    def joined(self, gaussians: Gaussians) -> Gaussians:
        """Return the gaussians together with those of the added files. Outliers of each
        file are dropped if the option is given."""
        parts = [self._without_outliers(gaussians)]
        for text in self._options.add:
            addition = _Addition.parse(text)
            parts.append(addition.placed(self._without_outliers(addition.read())))
        return editing.join(parts)

    def trimmed(self, gaussians: Gaussians) -> Gaussians:
        """Return the gaussians that remain after crops and limits, with the chosen SH
        degree."""
        options = self._options
        remaining = gaussians
        for text in options.crop:
            remaining = self._count("crop", remaining, _Shape.parse("--crop", text).crop("inside"))
        for text in options.delete:
            remaining = self._count(
                "delete", remaining, _Shape.parse("--delete", text).crop("outside")
            )
        if options.min_opacity is not None:
            limit = options.min_opacity
            remaining = self._count(
                "min_opacity", remaining, lambda part: editing.drop_transparent(part, limit)
            )
        if len(gaussians) and not len(remaining):
            names = ", ".join(options.option_names())
            raise ValueError(
                f"{names}: nothing remains of {len(gaussians):,} gaussians ({self._counts()}); "
                "v3dg info shows their positions"
            )
        self._degree_before = remaining.sh_degree
        self._degree_after = remaining.sh_degree
        if options.degree is not None:
            self._degree_after = options.degree
            remaining = editing.to_degree(remaining, options.degree)
        return remaining

    def result(self) -> dict[str, object]:
        """Return the counts for the JSON result of a command. Without editing options,
        there are none."""
        if not self._options.option_names():
            return {}
        return {"added": len(self._options.add), "left_out": dict(self._left_out)}

    def lines(self) -> list[str]:
        """Return lines that describe what was added and removed."""
        lines = []
        if self._options.add:
            lines.append(f"{1 + len(self._options.add)} files joined")
        if self._left_out:
            num_left_out = sum(self._left_out.values())
            numbers = f"{num_left_out:,} of {self._num_before:,} gaussians"
            lines.append(f"left out {numbers}: {self._counts()}")
        if self._degree_after < self._degree_before:
            lines.append(f"SH reduced from degree {self._degree_before} to {self._degree_after}")
        if self._degree_after > self._degree_before:
            lines.append(
                f"SH extended from degree {self._degree_before} to {self._degree_after} with zeros"
            )
        return lines

    def _without_outliers(self, gaussians: Gaussians) -> Gaussians:
        self._num_before += len(gaussians)
        if not self._options.drop_outliers:
            return gaussians
        return self._count("outliers", gaussians, editing.drop_outliers)

    def _count(
        self, reason: str, gaussians: Gaussians, edit: Callable[[Gaussians], Gaussians]
    ) -> Gaussians:
        edited = edit(gaussians)
        num_left_out = self._left_out.get(reason, 0) + len(gaussians) - len(edited)
        self._left_out[reason] = num_left_out
        return edited

    def _counts(self) -> str:
        texts = {
            "outliers": "outliers",
            "crop": "outside of --crop",
            "delete": "inside of --delete",
            "min_opacity": f"with an opacity below {self._options.min_opacity}",
        }
        return ", ".join(f"{count:,} {texts[reason]}" for reason, count in self._left_out.items())


@dataclass(frozen=True)
class _Addition:
    """A file and its placement in the frame of the first file."""

    path: Path
    position: tuple[float, float, float]
    scale: float
    angles: tuple[float, float, float]

    @staticmethod
    def parse(text: str) -> "_Addition":
        """Parse a value of --add. If the whole value is the name of an existing file,
        there is no placement."""
        name, separator, numbers_text = text.rpartition("@")
        if not separator or os.path.exists(text) or "/" in numbers_text:
            return _Addition(Path(text), (0.0, 0.0, 0.0), 1.0, (0.0, 0.0, 0.0))
        numbers = _numbers("--add", numbers_text, f"FILE@{_PLACEMENT}", text, (3, 4, 7))
        scale = 1.0
        angles = (0.0, 0.0, 0.0)
        if len(numbers) > 3:
            scale = numbers[3]
        if len(numbers) == 7:
            angles = (numbers[4], numbers[5], numbers[6])
        is_finite = all(abs(number) < float("inf") for number in numbers)
        check_usage(
            "--add", is_finite and scale > 0, f"a finite position and a positive scale, got {text}"
        )
        return _Addition(Path(name), (numbers[0], numbers[1], numbers[2]), scale, angles)

    def read(self) -> Gaussians:
        """Return the asset in the file, or level 0 of the bundle."""
        subject = open_subject(self.path)
        if isinstance(subject, Bundle):
            return subject.level_gaussians(0)
        if not isinstance(subject, Gaussians):
            raise UsageError(f"--add: expected an asset or a bundle, got the scene {self.path}")
        return subject

    def placed(self, gaussians: Gaussians) -> Gaussians:
        is_moved = any(self.position) or any(self.angles) or self.scale != 1
        if not is_moved:
            return gaussians
        quaternion = quaternion_from_angles(self.angles)
        return gaussians.transform(quaternion, self.position, self.scale)


@dataclass(frozen=True)
class _Shape:
    """A box or a sphere."""

    kind: Literal["box", "sphere"]
    numbers: tuple[float, ...]

    @staticmethod
    def parse(name: str, text: str) -> "_Shape":
        kind, _, numbers_text = text.partition(":")
        if kind == "box":
            numbers = _numbers(name, numbers_text, _SHAPES, text, (6,))
            is_box = all(map(_is_ordered, numbers[:3], numbers[3:]))
            check_usage(
                name, is_box, f"the smaller value of each coordinate first in box:..., got {text}"
            )
            return _Shape("box", numbers)
        check_usage(name, kind == "sphere", f"{_SHAPES}, got {text}")
        numbers = _numbers(name, numbers_text, _SHAPES, text, (4,))
        is_sphere = all(abs(number) < float("inf") for number in numbers) and numbers[3] > 0
        check_usage(name, is_sphere, f"a finite centre and a positive radius, got {text}")
        return _Shape("sphere", numbers)

    def crop(self, part: editing.Part) -> Callable[[Gaussians], Gaussians]:
        if self.kind == "box":
            low = self.numbers[:3]
            high = self.numbers[3:]
            return lambda gaussians: editing.crop_box(gaussians, low, high, keep=part)
        center = self.numbers[:3]
        radius = self.numbers[3]
        return lambda gaussians: editing.crop_sphere(gaussians, center, radius, keep=part)


def _is_ordered(low: float, high: float) -> bool:
    return low <= high


def _numbers(
    name: str, numbers_text: str, expected: str, text: str, counts: Iterable[int]
) -> tuple[float, ...]:
    """Parse numbers separated by commas. Raise UsageError for NaN, and if their count
    is not in `counts`."""
    try:
        numbers = tuple(map(float, numbers_text.split(",")))
    except ValueError:
        raise UsageError(f"{name}: expected {expected}, got {text}") from None
    is_whole = len(numbers) in counts and all(number == number for number in numbers)
    check_usage(name, is_whole, f"{expected}, got {text}")
    return numbers
