"""What a page may say to the viewer: JSON of these kinds, with numbers in bounds, and
nothing else."""

import math
from typing import Annotated, Literal

import msgspec

from v3dg.cameras import Axis
from v3dg.select import DEFAULT_FADE
from v3dg.viewer.frame import Settings, Shows
from v3dg.viewer.pacing import Request, scaled
from v3dg.viewer.path import CameraPath
from v3dg.viewer.view import View

# Of a picture's longer side, however large a window the page claims to have.
MOST_PIXELS = 4096
# In which the page sends files that were dropped onto it.
MOST_BYTES = 1 << 20

# Bounds keep out what is not a number, too.
_Number = Annotated[float, msgspec.Meta(ge=-1e15, le=1e15)]
_Vector = tuple[_Number, _Number, _Number]
_Quaternion = tuple[_Number, _Number, _Number, _Number]
_Pixels = Annotated[int, msgspec.Meta(ge=1, le=1 << 20)]
_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Seconds = Annotated[float, msgspec.Meta(ge=0.01)]
_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$")]
_MOST_STOPS = 10_000
# Of a path: all its views are made before it is stopped or saved.
_MOST_SECONDS = 600.0


class _View(msgspec.Struct, forbid_unknown_fields=True):
    wxyz: _Quaternion
    position: _Vector
    fov_y: Annotated[float, msgspec.Meta(ge=1e-4, le=3.14)]
    aspect: Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]

    def __post_init__(self) -> None:
        _check_rotation(self.wxyz)

    def view(self) -> View:
        return View(self.wxyz, self.position, self.fov_y, self.aspect)


class _Settings(msgspec.Struct, forbid_unknown_fields=True):
    """As in `Settings`."""

    shows: Shows = "appearance"
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=1e6)] = 3.0
    budget: Annotated[int, msgspec.Meta(ge=1, le=1 << 40)] | None = None
    min_level: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    gain: Annotated[float, msgspec.Meta(ge=1, le=50)] = 5.0
    fade: Annotated[float, msgspec.Meta(ge=1, le=4)] | None = DEFAULT_FADE
    split: _Share = 0.0
    frozen: _View | None = None

    def settings(self) -> Settings:
        frozen: View | None = None
        if self.frozen is not None:
            frozen = self.frozen.view()
        return Settings(
            shows=self.shows,
            tolerance=self.tolerance,
            budget=self.budget,
            min_level=self.min_level,
            fade=self.fade,
            gain=self.gain,
            split=self.split,
            frozen=frozen,
        )


class Look(msgspec.Struct, tag="look", forbid_unknown_fields=True):
    """What the page shows from now on."""

    view: _View
    size: tuple[_Pixels, _Pixels]
    settings: _Settings = msgspec.field(default_factory=_Settings)
    number: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)] = 0

    def request(self) -> Request:
        """What is to be drawn; the size is what can be drawn."""
        size = scaled(self.size, min(1.0, MOST_PIXELS / max(self.size)))
        return Request(self.view.view(), size, self.settings.settings(), self.number)


class Pick(msgspec.Struct, tag="pick", forbid_unknown_fields=True):
    """Asks what is at a place of the picture, or where an instance is.

    The place is in shares of width and height from the upper left.
    """

    look: Look
    place: tuple[_Share, _Share] = msgspec.field(default=(0.5, 0.5), name="at")
    instance: Annotated[int, msgspec.Meta(ge=0)] | None = None


class Move(msgspec.Struct, tag="move", forbid_unknown_fields=True):
    """Gives an instance a pose."""

    instance: Annotated[int, msgspec.Meta(ge=0)]
    position: _Vector
    quaternion: _Quaternion
    scale: Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]

    def __post_init__(self) -> None:
        _check_rotation(self.quaternion)


class Save(msgspec.Struct, tag="save", forbid_unknown_fields=True):
    """Asks for a file; or, to play it, for the views of a path: stops with the seconds
    to each."""

    output: Literal["picture", "film", "cameras", "scene", "play"] = msgspec.field(name="what")
    look: Look
    up: Axis | None
    path: Annotated[list[tuple[_Seconds, _View]], msgspec.Meta(max_length=_MOST_STOPS)]

    def __post_init__(self) -> None:
        if sum(seconds for seconds, _ in self.path) > _MOST_SECONDS:
            raise ValueError(f"path: expected at most {_MOST_SECONDS} s")

    def camera_path(self) -> CameraPath:
        return CameraPath([(seconds, stop.view()) for seconds, stop in self.path])


class Stop(msgspec.Struct, tag="stop", forbid_unknown_fields=True):
    """Ends what `Save` began."""


class Open(msgspec.Struct, tag="open", forbid_unknown_fields=True):
    """Says that so many bytes of a file follow, which is then shown."""

    name: _Name
    size: Annotated[int, msgspec.Meta(ge=1, le=1 << 38)]


Message = Look | Pick | Move | Save | Stop | Open
read_message = msgspec.json.Decoder(Message).decode


def _check_rotation(wxyz: tuple[float, ...]) -> None:
    if abs(math.hypot(*wxyz) - 1) > 1e-3:
        raise ValueError("expected a rotation")
