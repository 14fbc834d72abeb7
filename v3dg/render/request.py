"""What is asked for: the cut of a picture and what its pixels show, as values that go
from API to core."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING, Literal, NamedTuple

from v3dg import _core
from v3dg._numbers import color, real
from v3dg.residency import residency
from v3dg.select import rule_of

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    from numpy.typing import NDArray

    from v3dg.bundle import Bundle
    from v3dg.cameras import Camera, StereoCamera
    from v3dg.false_color import ColorBy
    from v3dg.select import Selection

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
            return _known_rule(*self)
        return _rule(*self)


def _rule(
    tolerance: float | None, budget: int | None, min_level: int, fade: float | None
) -> _core.Rule:
    return rule_of(tolerance, budget, min_level, fade=fade)


# Pictures that follow each other mostly ask for the same. By type as well as by value,
# because True, which is refused, equals 1.
_known_rule = lru_cache(64, typed=True)(_rule)


@dataclass(frozen=True)
class Look:
    """What a picture of a pool shows in place of the frame's own colours, and of which
    cut; anything but "appearance" is for the CPU alone.

    Attributes:
        shows: Colours as in `v3dg.render`; "error" shows the share of the tolerance
            that metrics take, as grey, and "count" the number of gaussians that a pixel
            is blended of, in place of depth.
        chooser: The camera whose cut is drawn; None for the camera of the picture.
        aside: Draw what was resident for the last picture, and neither bring pages in
            nor ask for any.
    """

    shows: ColorBy | Literal["error", "count"] = "appearance"
    chooser: Camera | None = None
    aside: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether it shows the gaussians themselves, of the cut for who looks."""
        return self.shows == "appearance" and self.chooser is None and not self.aside

    def core(self, bundles: Sequence[Bundle]) -> _core.Look | None:
        """The look for the compiled operations, of pictures of these bundles; None
        where it is that of the gaussians themselves."""
        if self.is_plain:
            return None
        chooser = None
        if self.chooser is not None:
            chooser = self.chooser.core
        return _core.Look(self.shows, self.palettes(bundles), chooser, self.aside)

    def palettes(self, bundles: Sequence[Bundle]) -> list[NDArray[np.float32]]:
        """The colours of each bundle's clusters; none where the bundles have no colours
        of their own."""
        if self.shows not in ("level", "cluster"):
            return []
        palettes = []
        for bundle in bundles:
            palette = residency.palette(bundle, self.shows)
            assert palette is not None
            palettes.append(palette)
        return palettes


class FrameRequest(NamedTuple):
    """One picture that is asked of a frame.

    Attributes:
        camera: Who looks; the two eyes of a stereo camera share a cut.
        cut: Which cut is selected.
        shade: What is behind gaussians, and when a pixel stops.
        selection: A cut that was selected before, to be drawn in place of `cut`.
        look: What it shows; None for the frame's own colours.
    """

    camera: Camera | StereoCamera
    cut: CutRequest
    shade: _core.Shade
    selection: Selection | None = None
    look: Look | None = None


def shade_of(
    background: Sequence[float], min_transmittance: float | None, is_asset: bool, depth: bool
) -> _core.Shade:
    """The shade of a picture as the core takes it; the arguments are those of
    `v3dg.render`.

    A transmittance below 0 makes pixels stop where `v3dg.rasterize` has them stop,
    which is the default of assets.
    """
    if background is BLACK and min_transmittance is None:
        return _known_shade(is_asset, bool(depth))
    return _shade(background, min_transmittance, is_asset, bool(depth))


def _shade(
    background: Sequence[float], min_transmittance: float | None, is_asset: bool, depth: bool
) -> _core.Shade:
    if min_transmittance is not None:
        stop = real(min_transmittance, "min_transmittance", "a share of light, 0 to 0.99", 0, 0.99)
    elif is_asset:
        stop = -1.0
    else:
        stop = DEFAULT_MIN_TRANSMITTANCE
    checked_background = list(BLACK)
    if background is not BLACK:
        checked_background = color(background, "background")
    return _core.Shade(background=checked_background, min_transmittance=stop, with_depth=depth)


@lru_cache(4)
def _known_shade(is_asset: bool, depth: bool) -> _core.Shade:
    """The shade of pictures that say nothing of it, which most do."""
    return _shade(BLACK, None, is_asset, depth)
