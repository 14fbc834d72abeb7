"""Requests: what to draw, as values that are passed from the public functions to the
core. A request has the cut of a picture and what its pixels show."""

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


BLACK = (0.0, 0.0, 0.0)
_PLAIN_TYPES = frozenset({float, int, type(None)})


class CutRequest(NamedTuple):
    """The arguments of `v3dg.select` that describe the cut of a view."""

    tolerance: float | None = None
    budget: int | None = None
    min_level: int = 0
    fade: float | None = None

    @property
    def is_plain(self) -> bool:
        """Whether all values are Python's own numbers. Only then may they be used as
        keys of a cache."""
        return _PLAIN_TYPES.issuperset(map(type, self))

    @property
    def rule(self) -> _core.Rule:
        """Return the rule for the core; raise ValueError if a value is invalid for
        `v3dg.select`."""
        if self.is_plain:
            return _known_rule(*self)
        return _rule(*self)


def _rule(
    tolerance: float | None, budget: int | None, min_level: int, fade: float | None
) -> _core.Rule:
    return rule_of(tolerance, budget, min_level, fade=fade)


# Consecutive pictures usually have equal requests. The cache distinguishes types,
# because True equals 1 but must be rejected.
_known_rule = lru_cache(64, typed=True)(_rule)


@dataclass(frozen=True)
class Look:
    """The colours of a picture, and the choice of its cut. With a pool on a GPU, only
    the colours "appearance" are allowed.

    Attributes:
        shows: Colours as in `v3dg.render`. "error" shows metrics as fractions of the
            tolerance, in grey. "count" replaces depth by the number of gaussians that a
            pixel blends.
        chooser: The camera that the cut is selected for. None means the camera of the
            picture.
        aside: Whether to draw only the pages that were resident for the last picture,
            without bringing in or requesting any.
    """

    shows: ColorBy | Literal["error", "count"] = "appearance"
    chooser: Camera | None = None
    aside: bool = False

    @property
    def is_plain(self) -> bool:
        """Whether the picture has the gaussians' own colours, a cut for its own camera,
        and normal use of pages."""
        return self.shows == "appearance" and self.chooser is None and not self.aside

    def core(self, bundles: Sequence[Bundle]) -> _core.Look | None:
        """Return the look for the compiled operations, for pictures of these bundles;
        None for the default look."""
        if self.is_plain:
            return None
        chooser = None
        if self.chooser is not None:
            chooser = self.chooser.core
        return _core.Look(self.shows, self.palettes(bundles), chooser, self.aside)

    def palettes(self, bundles: Sequence[Bundle]) -> list[NDArray[np.float32]]:
        """Return the colours of each bundle's clusters. They are empty if the gaussians
        keep their own colours."""
        if self.shows not in ("level", "cluster"):
            return []
        palettes = []
        for bundle in bundles:
            palette = residency.palette(bundle, self.shows)
            assert palette is not None
            palettes.append(palette)
        return palettes


class FrameRequest(NamedTuple):
    """The request for one picture.

    Attributes:
        camera: The camera of the picture. The two eyes of a stereo camera share a cut.
        cut: The cut to select.
        shade: The background, and the transmittance at which pixels stop.
        selection: A cut that was selected earlier, which is drawn instead of `cut`.
        look: What the picture shows. None means the frame's own colours.
        sensor: Channels other than colour, and meshes; None for neither.
    """

    camera: Camera | StereoCamera
    cut: CutRequest
    shade: _core.Shade
    selection: Selection | None = None
    look: Look | None = None
    sensor: _core.Sensor | None = None

    def of_eye(self, number: int) -> FrameRequest:
        """Return the request of a stereo camera with the meshes of one eye."""
        if self.sensor is None:
            return self
        return self._replace(sensor=self.sensor.of_eye(number))


def shade_of(
    background: Sequence[float], min_transmittance: float | None, *, is_asset: bool, depth: bool
) -> _core.Shade:
    """Return the shade of a picture for the core; the arguments are those of
    `v3dg.render`.

    By default, pixels of assets stop as in `v3dg.rasterize`. Pixels of cuts stop at a
    transmittance that depends on the tolerance of the cut.
    """
    if background is BLACK and min_transmittance is None:
        return _known_shade(is_asset=is_asset, depth=bool(depth))
    return _shade(background, min_transmittance, is_asset=is_asset, depth=bool(depth))


def _shade(
    background: Sequence[float], min_transmittance: float | None, *, is_asset: bool, depth: bool
) -> _core.Shade:
    if min_transmittance is not None:
        stop = real(
            min_transmittance, "min_transmittance", "a transmittance from 0 to 0.99", 0, 0.99
        )
    elif is_asset:
        stop = _core.stops_before
    else:
        stop = _core.stops_by_cut
    checked_background = list(BLACK)
    if background is not BLACK:
        checked_background = color(background, "background")
    return _core.Shade(background=checked_background, min_transmittance=stop, with_depth=depth)


@lru_cache(4)
def _known_shade(*, is_asset: bool, depth: bool) -> _core.Shade:
    """Return the shade of a picture with default arguments. Most pictures have
    these."""
    return _shade(BLACK, None, is_asset=is_asset, depth=depth)
