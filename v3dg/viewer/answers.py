"""What the viewer says to a page: JSON of these kinds; bytes follow `Picture` and
`File`.

`tests/support/page_protocol.py` makes the page's types of this module and `messages`.
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
    """A camera of the file.

    Attributes:
        photograph: Whether the picture that it took is there.
    """

    name: str
    photograph: bool
    view: View


class Limits(msgspec.Struct):
    """The smallest and the largest values that the viewer takes.

    Attributes:
        picture_px: The longer side of a picture, at most.
        path_seconds: The length of a path, at most.
    """

    tolerance: tuple[float, float]
    budget: tuple[int, int]
    gain: tuple[float, float]
    picture_px: int
    path_seconds: float


class Hello(msgspec.Struct, tag="hello"):
    """The first message of a connection.

    Attributes:
        version: Version of the viewer; a page of another one loads itself anew.
        up: The direction that is up, in the world.
        asks_up: Whether `up` is only assumed, so that the page asks.
        home: A view of all of the scene.
        settings: What a tab begins with.
        defaults: What a setting is that nobody has asked for.
    """

    version: str
    up: Vector
    asks_up: bool
    home: View
    settings: Settings
    defaults: Settings
    limits: Limits
    cameras: list[FileCamera]


class Scene(msgspec.Struct, tag="scene"):
    """What the tab shows from now on.

    Attributes:
        center, radius: A ball that holds nearly all of it, world units.
        near: Distance of the near plane, world units.
        instances: How many there are.
        has_files: Whether all its bundles are files, so that it can be saved.
        writes_files: Whether the server writes new assets, beside the file that is
            shown; otherwise the browser saves them.
        level_colors: Colour of each level.
        ramp: Colours from the smallest value to the largest.
        most_counted: Gaussians in a pixel that get the last colour of the ramp.
        modes: What can be shown.
        shows_cuts: Whether cuts can be frozen, split and picked from.
        missing_colors: Colours of gaussians of whose pages none, one, two and three
            levels are missing.
    """

    name: str
    center: Vector
    radius: float
    near: float
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
    """What a picture cost.

    Attributes:
        gaussians_selected, gaussians_in_frustum, tolerance, select_ms, draw_ms, levels,
        missing: As in `v3dg.Stats`.
        memory_bytes: Memory that the viewer's process holds.
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
    """A picture, as the bytes of a JPEG.

    Attributes:
        final: Whether no other picture follows for the same request.
        number: Number of the request.
        size: Width and height, px.
        view: From where it is seen.
        range: The values of the darkest and the brightest colour, where colours are
            values.
        distance: How deep what is in its middle mostly is, world units; null where
            nothing is, or not known.
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
    """Says why the picture that was asked for is not drawn."""

    text: str


class Notice(msgspec.Struct, tag="notice"):
    """Something for a person to read, once."""

    text: str


class Progress(msgspec.Struct, tag="progress"):
    """How far the film that is saved is, 0 to 1."""

    share: float


class Done(msgspec.Struct, tag="done"):
    """The work that the page asked for has ended."""


class File(msgspec.Struct, tag="file"):
    """A file to save, as bytes."""

    name: str


class Pose(msgspec.Struct):
    """Where an instance is."""

    position: Vector
    quaternion: Quaternion
    scale: float


class Picked(msgspec.Struct, tag="picked"):
    """The instance that was asked about; all fields are unset if there is none.

    Attributes:
        box: Lower and upper corner of its bundle, in the bundle's own coordinates.
        bundle: Name of the bundle's file; empty if the bundle is not in a file.
        point: The place that was picked, in the world.
    """

    instance: int | UnsetType = UNSET
    pose: Pose | UnsetType = UNSET
    box: tuple[Vector, Vector] | UnsetType = UNSET
    bundle: str | UnsetType = UNSET
    point: Vector | UnsetType = UNSET


class Play(msgspec.Struct, tag="play"):
    """The views of a path, to be flown along."""

    fps: int
    views: list[View]


Answer: TypeAlias = (
    Hello | Scene | Picture | Failed | Notice | Progress | Done | File | Picked | Play
)


def encode(answer: Answer, data: bytes = b"") -> str | bytes:
    """Return a message as text; with bytes, as the length of the text in four bytes
    (little-endian), the text, and the bytes."""
    text = msgspec.json.encode(answer)
    if not data:
        return text.decode()
    return len(text).to_bytes(4, "little") + text + data
