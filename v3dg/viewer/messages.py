"""Messages from a web page to the viewer: JSON objects of the types below, with bounded
numbers. Anything else is rejected.

`tests/support/page_protocol.py` generates the page's types from this module and
`answers`.
"""

import math
from typing import Annotated, Literal

import msgspec

from v3dg.cameras import Axis
from v3dg.viewer.answers import Limits
from v3dg.viewer.edits import check_new_name
from v3dg.viewer.frame import Settings, Shows
from v3dg.viewer.pacing import Request, scaled
from v3dg.viewer.path import CameraPath
from v3dg.viewer.view import View

# Maximum length, in px, of the longer side of a picture, whatever window size the web
# page sends.
MOST_PIXELS = 4096
# Maximum size of a message in bytes. The web page sends dropped files in pieces.
MOST_BYTES = 1 << 20
# Maximum duration of a path in seconds. There is a maximum because all views are
# computed before the work can be stopped.
MOST_PATH_SECONDS = 600.0
MOST_TOLERANCE = 1e6
MOST_GAUSSIANS = 1 << 40
MOST_GAIN = 50.0
LIMITS = Limits(
    tolerance=(0.0, MOST_TOLERANCE),
    budget=(1, MOST_GAUSSIANS),
    gain=(1.0, MOST_GAIN),
    picture_px=MOST_PIXELS,
    path_seconds=MOST_PATH_SECONDS,
)

# The limits also exclude NaN.
_Number = Annotated[float, msgspec.Meta(ge=-1e15, le=1e15)]
_Vector = tuple[_Number, _Number, _Number]
_Quaternion = tuple[_Number, _Number, _Number, _Number]
_Pixels = Annotated[int, msgspec.Meta(ge=1, le=1 << 20)]
_Share = Annotated[float, msgspec.Meta(ge=0, le=1)]
_Seconds = Annotated[float, msgspec.Meta(ge=0.01)]
_Name = Annotated[str, msgspec.Meta(min_length=1, max_length=200, pattern=r"^[^/\\\x00]+$")]
_MOST_STOPS = 10_000
_DEFAULTS = Settings()


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
    """The content and quality of a picture."""

    shows: Shows = _DEFAULTS.shows
    tolerance: Annotated[float, msgspec.Meta(ge=0, le=MOST_TOLERANCE)] = _DEFAULTS.tolerance
    budget: Annotated[int, msgspec.Meta(ge=1, le=MOST_GAUSSIANS)] | None = _DEFAULTS.budget
    min_level: Annotated[int, msgspec.Meta(ge=0, le=64)] = _DEFAULTS.min_level
    fade: Annotated[float, msgspec.Meta(ge=1, le=4)] | None = _DEFAULTS.fade
    gain: Annotated[float, msgspec.Meta(ge=1, le=MOST_GAIN)] = _DEFAULTS.gain
    split: _Share = _DEFAULTS.split
    frozen: _View | None = None
    background: tuple[_Share, _Share, _Share] = _DEFAULTS.background

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
            background=self.background,
        )


class Look(msgspec.Struct, tag="look", forbid_unknown_fields=True):
    """Requests a picture. It replaces the previous request.

    Attributes:
        size: Width and height of the picture in px.
        number: Identifies the pictures that answer this request.
    """

    view: _View
    size: tuple[_Pixels, _Pixels]
    settings: _Settings = msgspec.field(default_factory=_Settings)
    number: Annotated[int, msgspec.Meta(ge=0, le=1 << 53)] = 0

    def request(self) -> Request:
        """Return the request, with its size limited to `MOST_PIXELS`."""
        size = scaled(self.size, min(1.0, MOST_PIXELS / max(self.size)))
        return Request(self.view.view(), size, self.settings.settings(), self.number)


class Pick(msgspec.Struct, tag="pick", forbid_unknown_fields=True):
    """Asks for the instance at a point of the picture, or for the pose of a given
    instance.

    Attributes:
        at: The point, as fractions of the width and the height from the upper left
            corner.
        instance: The instance to describe. If it is given, the point is ignored.
    """

    look: Look
    place: tuple[_Share, _Share] = msgspec.field(default=(0.5, 0.5), name="at")
    instance: Annotated[int, msgspec.Meta(ge=0)] | None = None


class Move(msgspec.Struct, tag="move", forbid_unknown_fields=True):
    """Sets the pose of an instance."""

    instance: Annotated[int, msgspec.Meta(ge=0)]
    position: _Vector
    quaternion: _Quaternion
    scale: Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]

    def __post_init__(self) -> None:
        _check_rotation(self.quaternion)


class Save(msgspec.Struct, tag="save", forbid_unknown_fields=True):
    """Requests a file, or the views of a path for playback.

    Attributes:
        what: The file: a picture, a film of the path, its cameras, or the scene.
        look: The content and the size of pictures.
        up: The axis that points up, for a scene file. It is null for other directions.
        path: The views of the path, each with the seconds since the previous view.
    """

    output: Literal["picture", "film", "cameras", "scene", "play"] = msgspec.field(name="what")
    look: Look
    up: Axis | None
    path: Annotated[list[tuple[_Seconds, _View]], msgspec.Meta(max_length=_MOST_STOPS)]

    def __post_init__(self) -> None:
        total = sum(seconds for seconds, _ in self.path)
        if total > MOST_PATH_SECONDS:
            raise ValueError(f"path: expected at most {MOST_PATH_SECONDS} s, got {total:.1f} s")

    def camera_path(self) -> CameraPath:
        return CameraPath([(seconds, stop.view()) for seconds, stop in self.path])


class Crop(msgspec.Struct, tag="crop", forbid_unknown_fields=True):
    """Requests a new asset from the gaussians of a bundle whose centres are inside a
    box, or from all others.

    Attributes:
        instance: An instance of the bundle.
        box: Minimum and maximum corner in the coordinates of the bundle.
        name: Name of the file. Its end selects the format.
    """

    instance: Annotated[int, msgspec.Meta(ge=0)]
    box: tuple[_Vector, _Vector]
    keep: Literal["inside", "outside"]
    name: _Name

    def __post_init__(self) -> None:
        check_new_name(self.name)


class Stop(msgspec.Struct, tag="stop", forbid_unknown_fields=True):
    """Ends the work that `Save` started."""


class Open(msgspec.Struct, tag="open", forbid_unknown_fields=True):
    """Announces a file. Its bytes follow as binary data, and then the file is shown.

    Attributes:
        size: Size of the file in bytes.
    """

    name: _Name
    size: Annotated[int, msgspec.Meta(ge=1, le=1 << 38)]


Message = Look | Pick | Move | Save | Crop | Stop | Open
read_message = msgspec.json.Decoder(Message).decode


def _check_rotation(wxyz: tuple[float, ...]) -> None:
    length = math.hypot(*wxyz)
    if abs(length - 1) > 1e-3:
        raise ValueError(f"quaternion: expected a length of 1, got {length:.4g}")
