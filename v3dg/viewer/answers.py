"""Messages from the viewer to a page: JSON objects of the types below. `Picture` and
`File` are followed by binary data.

`tests/support/page_protocol.py` generates the page's types from this module and
`messages`.
"""

from __future__ import annotations

from typing import TypeAlias

import msgspec
from msgspec import UNSET, UnsetType

from v3dg.viewer.frame import Settings, Shows
from v3dg.viewer.view import View

Vector: TypeAlias = tuple[float, float, float]
Quaternion: TypeAlias = tuple[float, float, float, float]
Color: TypeAlias = tuple[int, int, int]


class FileCamera(msgspec.Struct):
    """A named camera of the subject's file.

    Attributes:
        photograph: Whether the photograph of this camera is available.
    """

    name: str
    photograph: bool
    view: View


class Limits(msgspec.Struct):
    """The limits of values that the viewer accepts.

    Attributes:
        picture_px: Maximum length of a picture's longer side.
        path_seconds: Maximum duration of a path.
    """

    tolerance: tuple[float, float]
    budget: tuple[int, int]
    gain: tuple[float, float]
    picture_px: int
    path_seconds: float


class Hello(msgspec.Struct, tag="hello"):
    """The first message of a connection.

    Attributes:
        version: Version of the viewer. A web page of another version reloads itself.
        up: The direction that points up in the world.
        asks_up: Whether `up` is only assumed. If so, the web page asks the user.
        settings: The initial settings of a tab.
        defaults: The default of each setting.
    """

    version: str
    up: Vector
    asks_up: bool
    settings: Settings
    defaults: Settings
    limits: Limits
    cameras: list[FileCamera]


class Home(msgspec.Struct):
    """The first view of a tab in a window with a certain aspect ratio.

    Attributes:
        focus: The point around which the camera orbits.
    """

    view: View
    focus: Vector


class Scene(msgspec.Struct, tag="scene"):
    """The subject that the tab shows from now on.

    Attributes:
        center, radius: A ball that contains nearly all of the subject, in world units.
        near: Depth of the near plane, in world units.
        homes: First views for windows from narrow to wide.
        instances: Number of instances.
        has_files: Whether all bundles are in files, so that the scene can be saved.
        writes_files: Whether the server writes new assets next to the file of the
            subject. If not, the browser saves them.
        level_colors: Colour of each level.
        ramp: Colours for values from the smallest to the largest.
        most_counted: Number of gaussians in a pixel that is shown in the last colour of
            the ramp.
        modes: The available display modes.
        shows_cuts: Whether freezing, splitting and picking are available.
        missing_colors: Colours of gaussians that are drawn because zero, one, two or
            three finer levels are missing.
    """

    name: str
    center: Vector
    radius: float
    near: float
    homes: list[Home]
    instances: int
    has_files: bool
    writes_files: bool
    level_colors: list[Color]
    ramp: list[Color]
    most_counted: int
    modes: tuple[Shows, ...]
    shows_cuts: bool
    missing_colors: list[Color]


class Figures(msgspec.Struct):
    """The statistics of a picture.

    Attributes:
        gaussians_selected, gaussians_in_frustum, tolerance, select_ms, draw_ms, levels,
            missing: See `v3dg.Stats`.
        memory_bytes: Memory of the viewer's process in bytes.
    """

    gaussians_selected: int
    gaussians_in_frustum: int
    tolerance: float
    select_ms: float
    draw_ms: float
    levels: tuple[int, ...]
    missing: int
    memory_bytes: int


class Picture(msgspec.Struct, tag="picture"):
    """A picture. The bytes of a JPEG follow.

    Attributes:
        final: Whether this is the last picture for its request.
        number: Number of the request.
        size: Width and height, px.
        view: The viewpoint of the picture.
        range: The values of the darkest and the brightest colour if colours represent
            values.
        distance: Median depth around the middle, in world units. It is null if nothing
            is there, or if it is unknown.
    """

    final: bool
    number: int
    size: tuple[int, int]
    view: View
    shows: Shows
    range: tuple[float, float] | None
    distance: float | None
    figures: Figures


class Failed(msgspec.Struct, tag="failed"):
    """The reason why the requested picture cannot be drawn."""

    text: str


class Notice(msgspec.Struct, tag="notice"):
    """A message for the user. It is shown once."""

    text: str


class Progress(msgspec.Struct, tag="progress"):
    """Progress of the film that is being saved, from 0 to 1."""

    share: float


class Done(msgspec.Struct, tag="done"):
    """The work that the web page requested has ended."""


class File(msgspec.Struct, tag="file"):
    """A file that the browser saves. Its bytes follow."""

    name: str


class Pose(msgspec.Struct):
    """The pose of an instance."""

    position: Vector
    quaternion: Quaternion
    scale: float


class Picked(msgspec.Struct, tag="picked"):
    """The answer to `Pick`: an instance. If there is none, no field is set.

    Attributes:
        box: Minimum and maximum corner of the instance's bundle, in the coordinates of
            the bundle.
        bundle: Name of the bundle's file, or an empty text if the bundle is not in a
            file.
        point: The picked point in the world.
    """

    instance: int | UnsetType = UNSET
    pose: Pose | UnsetType = UNSET
    box: tuple[Vector, Vector] | UnsetType = UNSET
    bundle: str | UnsetType = UNSET
    point: Vector | UnsetType = UNSET


class Play(msgspec.Struct, tag="play"):
    """The views of a path for playback."""

    fps: int
    views: list[View]


Answer: TypeAlias = (
    Hello | Scene | Picture | Failed | Notice | Progress | Done | File | Picked | Play
)


def encode(answer: Answer, data: bytes = b"") -> str | bytes:
    """Return a message as text. With binary data, return the length of the text in four
    bytes (little-endian), the text, and the data."""
    text = msgspec.json.encode(answer)
    if not data:
        return text.decode()
    return len(text).to_bytes(4, "little") + text + data
