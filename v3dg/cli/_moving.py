"""Options for moving the gaussians that a command writes: scale, rotate, translate."""

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np
import tyro

from v3dg.cameras import Floats
from v3dg.cli._common import UsageError, check_usage, option
from v3dg.gaussians import Gaussians

_TURNS = "AXIS:DEGREES such as z:90, or quaternion:W,X,Y,Z"


@dataclass(kw_only=True)
class MoveOptions:
    """Options for moving gaussians. They are scaled about the origin, then rotated
    about the origin, then translated. `v3dg info` shows the axes."""

    scale: Annotated[float | None, option("S")] = None
    """Multiply positions and sizes by this factor."""
    rotate: Annotated[str | None, option("AXIS:DEGREES")] = None
    """Rotate by degrees about an axis, such as z:90, or by quaternion:W,X,Y,Z. Colours
    are rotated, too."""
    translate: Annotated[tuple[float, float, float] | None, option("X Y Z")] = None
    """Translate by this vector, after --scale and --rotate."""

    def option_names(self) -> list[str]:
        """Return the names of those of these options that were given."""
        values = {
            "--scale": self.scale,
            "--rotate": self.rotate,
            "--translate": self.translate,
        }
        return [name for name, value in values.items() if value is not None]

    def check(self) -> None:
        """Raise an error for invalid values, before anything is read."""
        if self.scale is not None:
            is_size = math.isfinite(self.scale) and self.scale > 0
            check_usage("--scale", is_size, f"a number above 0, got {self.scale}")
        if self.rotate is not None:
            _quaternion(self.rotate)
        if self.translate is not None:
            is_finite = all(map(math.isfinite, self.translate))
            check_usage("--translate", is_finite, f"finite numbers, got {self.translate}")

    def moved(self, gaussians: Gaussians) -> Gaussians:
        """Return the gaussians after scaling, rotation and translation. Without these
        options, return the same object."""
        if not self.option_names():
            return gaussians
        quaternion = np.array([1.0, 0.0, 0.0, 0.0])
        if self.rotate is not None:
            quaternion = _quaternion(self.rotate)
        position = self.translate or (0.0, 0.0, 0.0)
        scale = 1.0
        if self.scale is not None:
            scale = self.scale
        return gaussians.transform(quaternion, position, scale)


Moves: TypeAlias = Annotated[MoveOptions, tyro.conf.OmitArgPrefixes]


def _quaternion(text: str) -> Floats:
    """Return the quaternion (4,) w x y z for a value of --rotate."""
    kind, _, numbers_text = text.partition(":")
    try:
        numbers = [float(number) for number in numbers_text.split(",")]
    except ValueError:
        raise UsageError(f"--rotate: expected {_TURNS}, got {text}") from None
    is_finite = all(map(math.isfinite, numbers))
    if kind in ("x", "y", "z") and len(numbers) == 1 and is_finite:
        half = math.radians(numbers[0]) / 2
        quaternion = np.array([math.cos(half), 0.0, 0.0, 0.0])
        quaternion[1 + "xyz".index(kind)] = math.sin(half)
        return quaternion
    is_quaternion = kind == "quaternion" and len(numbers) == 4 and is_finite and any(numbers)
    check_usage("--rotate", is_quaternion, f"{_TURNS}, got {text}")
    return np.array(numbers)
