"""What is asked for: the cut of a picture and what its pixels show, as values that go
from API to core."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

from v3dg import _core
from v3dg._numbers import color, real
from v3dg.select import rule_of

if TYPE_CHECKING:
    from collections.abc import Sequence

# Of pictures with levels, whose own error is far larger; docs/cuda.md has what it
# saves.
DEFAULT_MIN_TRANSMITTANCE = 1e-3
BLACK = (0.0, 0.0, 0.0)
_PLAIN_TYPES = frozenset({float, int, type(None)})


class CutRequest(NamedTuple):
    """Which cut of a view is wanted, as users say it; the arguments are those of
    `v3dg.select`."""

    tolerance: float | None = None
    budget: int | None = None
    min_level: int = 0
    fade: float | None = None

    @property
    def is_plain(self) -> bool:
        """Whether all values are Python's own numbers, by which results can be
        remembered."""
        return _PLAIN_TYPES.issuperset(map(type, self))

    @property
    def rule(self) -> _core.Rule:
        """The request as the core takes it; ValueError where a number is not as
        `v3dg.select` has it."""
        if self.is_plain:
            return _known_rule(self.tolerance, self.budget, self.min_level, self.fade)
        return _rule(self.tolerance, self.budget, self.min_level, self.fade)


def _rule(
    tolerance: float | None, budget: int | None, min_level: int, fade: float | None
) -> _core.Rule:
    return rule_of(tolerance, budget, min_level, fade=fade)


# Pictures that follow each other mostly ask for the same. By type as well as by value,
# because True, which is refused, equals 1.
_known_rule = lru_cache(64, typed=True)(_rule)


def shade_of(
    background: Sequence[float], min_transmittance: float | None, is_asset: bool, depth: bool
) -> _core.Shade:
    """The shade of a picture as the core takes it; the arguments are those of
    `v3dg.render`.

    A transmittance below 0 makes pixels stop where `v3dg.rasterize` has them stop,
    which is the default of assets.
    """
    if min_transmittance is not None:
        stop = real(min_transmittance, "min_transmittance", "a share of light, 0 to 0.99", 0, 0.99)
    elif is_asset:
        stop = -1.0
    else:
        stop = DEFAULT_MIN_TRANSMITTANCE
    checked_background = list(BLACK)
    if background is not BLACK:
        checked_background = color(background, "background")
    return _core.Shade(
        background=checked_background, min_transmittance=stop, with_depth=bool(depth)
    )
