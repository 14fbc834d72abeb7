"""The cameras of commands: a camera placed by options, cameras from a file, those of a
scene, or first views of the subject."""

import math
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
import tyro

from v3dg._numbers import check
from v3dg._urls import beside, shown
from v3dg.camera_file import read_cameras
from v3dg.cameras import AXES, Axis, Camera, near_of
from v3dg.cli._common import (
    check_range,
    check_usage,
    option,
    printable,
    require_subject,
)
from v3dg.framing import DEFAULT_ELEVATION, frame_subject
from v3dg.pictures import MOST_SIDE, SUFFIXES, check_size
from v3dg.scene import Subject
from v3dg.scene.file import is_scene
from v3dg.upright import ASSUMED, direction_of, up_of

_DEFAULT_FOV = 45.0  # degrees
_DEFAULT_SIZE = (800, 800)

# Limited because all cameras are created before the first picture is drawn.
_MOST_VIEWS = 10_000


@dataclass(kw_only=True)
class CameraFile:
    """Options for cameras from a file of another program."""

    cameras: Annotated[Path | None, option("PATH")] = None
    """Use the cameras of this nerfstudio transforms.json, nerfstudio run or COLMAP
    model. `view` offers them together with their photographs."""
    distortion: Literal["draw", "ignore"] = "draw"
    """Whether pictures have the lens distortion of that file, or it is ignored."""

    def read(self, size: tuple[int, int] = (800, 800)) -> dict[str, Camera]:
        """Return the cameras of --cameras; empty without that option. `size` is used if
        the file has no size."""
        if self.cameras is None:
            return {}
        cameras = read_cameras(self.cameras, size=size, distortion=self.distortion)
        check(self.cameras, cameras, "cameras, got a file with none")
        return cameras


@dataclass
class ViewOptions(CameraFile):
    """Options for the cameras of pictures: a camera placed by options, cameras from a
    file or a scene, or first views of the subject."""

    eye: Annotated[tuple[float, float, float] | None, option("X Y Z")] = None
    """Look from this point in world space."""
    target: Annotated[tuple[float, float, float] | None, option("X Y Z")] = None
    """Look from --eye to this point; by default to the middle of the subject."""
    fov: Annotated[float | None, option("DEGREES")] = None
    """Field of view of --eye across the width of the picture in degrees; 45 by
    default."""
    link: Annotated[str | None, tyro.conf.arg(name="at", metavar="LINK", help_behavior_hint="")] = (
        None
    )
    """Use the camera of a link: the address of a page of `v3dg view`, in quotes."""
    camera: Annotated[str | None, option("NAME")] = None
    """Draw only this one of several cameras, by its name or its number, from 0."""
    views: Annotated[int | None, option("N")] = None
    """Number of views around an object, or around the viewer inside a room; 1 by
    default, 8 for `compare`."""
    size: Annotated[tuple[int, int] | None, option("W H")] = None
    """Width and height in px of pictures for which the file of the camera has no size;
    800 800 by default, and 1600 800 for pictures of all directions."""
    elevation: Annotated[float | None, option("DEGREES")] = None
    """Elevation of the cameras around the subject above the horizon in degrees; 20 by
    default."""
    up: Annotated[Axis | None, option("{x,y,z,-x,-y,-z}")] = None
    """The axis that points up for --eye and for views around the subject; by default
    the one in the file, or a guess."""

    @property
    def frame_size(self) -> tuple[int, int]:
        """The width and height of pictures of cameras without a size."""
        return self.size or _DEFAULT_SIZE

    def check(self, *subjects: Path) -> None:
        """Raise an error for invalid subjects, and for options that do not apply to
        them, before anything is read."""
        for path in subjects:
            require_subject(path)
        for side in self.frame_size:
            check_range("--size", side, 1, MOST_SIDE)
        for name, value in (("--target", self.target), ("--fov", self.fov)):
            check_usage(name, value is None or self.eye, "--eye together with it, got no --eye")
        check_range("--fov", self.fov or _DEFAULT_FOV, 0.001, 179)
        sources = {"--eye": self.eye, "--at": self.link, "--cameras": self.cameras}
        names = [name for name, value in sources.items() if value is not None]
        check_usage(", ".join(names), len(names) < 2, "only one of these options, got several")
        is_placed = self.eye is not None or self.link is not None
        has_file = self.cameras is not None or any(map(is_scene, subjects))
        expected = "--cameras or a scene (.json) that has cameras, got none; leave it out"
        fits = self.camera is None or (has_file and not is_placed)
        check_usage("--camera", fits, expected)
        if self.cameras is not None:
            self.check_turntable(f"the cameras of {shown(self.cameras)}")
        elif names:
            self.check_turntable(names[0])
        if self.views is not None:
            check_range("--views", self.views, 1, _MOST_VIEWS)
        check_range("--elevation", self.elevation or 0, -89.99, 89.99)

    def check_turntable(self, source: str) -> None:
        """Raise UsageError if options for views around the subject are combined with
        other cameras."""
        for name, value in self.turntable().items():
            is_used = name == "--up" and self.eye is not None
            expected = f"a subject without cameras, got {source}; leave it out"
            check_usage(name, value is None or is_used, expected)

    def turntable(self) -> dict[str, object]:
        """Return the options for views around the subject, by name; None for options
        that were not given."""
        return {"--views": self.views, "--elevation": self.elevation, "--up": self.up}

    def needs_up(self, own_cameras: Mapping[str, Camera] | None) -> bool:
        """Return whether the up axis must be known for the cameras."""
        has_cameras = self.link is not None or self.cameras is not None or bool(own_cameras)
        return self.eye is not None or not has_cameras


# The type of a field in the options of a command. On the command line, its options have
# no prefix.
Views: TypeAlias = Annotated[ViewOptions, tyro.conf.OmitArgPrefixes]


def choose_cameras(
    options: ViewOptions,
    path: Path,
    subject: Subject,
    own_cameras: dict[str, Camera] | None,
    views: int = 1,
) -> dict[str, Camera]:
    """Return the camera of --eye or --at; else the cameras of --cameras; else those of
    the subject; else first views of the subject (`views` of them by default)."""
    if options.link is not None:
        cameras = {"link": _linked(options.link, options.frame_size)}
    elif options.eye is not None:
        cameras = {"eye": _placed(options, subject)}
    else:
        cameras = options.read(options.frame_size)
        if not cameras and own_cameras:
            options.check_turntable(f"the cameras of {shown(path)}")
            cameras = own_cameras
    if not cameras:
        refuse_without = "a scene with cameras, got a subject without; leave it out"
        check_usage("--camera", options.camera is None, refuse_without)
        cameras = _around(subject, options, options.views or views)
    if options.camera is not None:
        name = _camera_name(options.camera, list(cameras))
        cameras = {name: cameras[name]}
    for name, camera in cameras.items():
        check_size(f"camera {name}", camera.width, camera.height)
    return cameras


def _linked(link: str, size: tuple[int, int]) -> Camera:
    """Return the camera of a link to the viewer's page."""
    from v3dg.viewer.link import read_link

    place = read_link(link)
    near = 0.01
    if place.focus is not None:
        distance = float(np.linalg.norm(np.subtract(place.focus, place.view.position)))
        near = near_of(distance)
    return replace(place.view, aspect=size[0] / size[1]).camera(*size, near)


def _placed(options: ViewOptions, subject: Subject) -> Camera:
    """Return the camera of --eye."""
    assert options.eye is not None
    up = direction_of(options.up or up_of(subject)[0])
    width, height = options.frame_size
    target = options.target
    if target is None:
        x, y, z = frame_subject(subject).center.tolist()
        target = (x, y, z)
    return Camera.look_at(
        options.eye,
        target,
        up,
        math.radians(options.fov or _DEFAULT_FOV),
        width=width,
        height=height,
    )


def _camera_name(text: str, names: Sequence[str]) -> str:
    """Return the name of the camera that --camera selects by its name or number."""
    if text in names:
        return text
    if text.isdecimal() and int(text) < len(names):
        return names[int(text)]
    choices = ", ".join(names[:8])
    if len(names) > 8:
        choices += " ..."
    raise ValueError(
        f"--camera: expected one of {choices}, or a number from 0 to {len(names) - 1}, got {text}"
    )


def _around(subject: Subject, options: ViewOptions, views: int) -> dict[str, Camera]:
    """Return the first views of a subject, around an object or inside a room.

    Without --views, a single view is closer to the subject than views of a turntable.
    """
    elevation = DEFAULT_ELEVATION
    if options.elevation is not None:
        elevation = math.radians(options.elevation)
    up = direction_of(options.up or up_of(subject)[0])
    framing = frame_subject(subject)
    if options.views is None and views == 1:
        return {"0": framing.camera(up, *options.frame_size, elevation=elevation)}
    cameras = framing.turntable(up, views, *options.frame_size, elevation=elevation)
    digits = len(str(views - 1))
    return {f"{i:0{digits}}": camera for i, camera in enumerate(cameras)}


def choose_up(
    requested: Axis | None, subject: Subject, cameras: Mapping[str, Camera] | None, path: Path
) -> tuple[Axis, list[str]]:
    """Return the up axis, from --up or else from `up_of`, and lines that state the
    reason.

    If the axis is unknown, a user at a terminal is asked.
    """
    if requested:
        return requested, []
    axis, reason = up_of(subject, cameras)
    if reason == ASSUMED and is_at_terminal():
        axis = ask_up(path, axis)
        reason = "as you answered"
    return axis, lines_of_up(path, axis, reason)


def lines_of_up(path: Path, axis: Axis, reason: str) -> list[str]:
    """Return a line with the up axis and the reason for it; no line if the reason is
    empty, as with --up."""
    if not reason:
        return []
    return [f"{beside(path).name}: {axis} is up, {reason}; change it with --up"]


def is_at_terminal() -> bool:
    """Return whether a user at a terminal can answer questions. A background job cannot
    ask, because reading from the terminal would stop it."""
    is_open = sys.stdin and sys.stdin.isatty() and sys.stderr.isatty()
    return bool(is_open and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp())


def ask_up(path: Path, axis: Axis) -> Axis:
    """Ask the user at the terminal for the up axis. Enter, or the end of the input,
    accepts `axis`."""
    while True:
        question = printable(
            f"{beside(path).name}: which axis points up, {', '.join(AXES)}? [{axis}] "
        )
        print(question, end="", file=sys.stderr, flush=True)
        answer = sys.stdin.readline().strip() or axis
        for choice in AXES:
            if answer == choice:
                return choice


def picture_paths(output: Path, cameras: Collection[str]) -> list[Path]:
    """Return the path of the picture for each camera. If there are several cameras,
    each path contains the camera's name.

    If two paths would be equal, all contain the cameras' numbers instead, from 0.
    """
    if len(cameras) == 1:
        return [output]
    names = [_file_stem(name) for name in cameras]
    if len(set(names)) < len(names):
        names = [str(place) for place in range(len(names))]
    return [output.with_name(f"{output.stem}_{name}{output.suffix}") for name in names]


def _file_stem(name: str) -> str:
    """Return the name of a camera as part of a file name, without the suffix of its
    photograph."""
    photograph = Path(name)
    if photograph.suffix.lower() in SUFFIXES and photograph.stem:
        name = str(photograph.with_suffix(""))
    return re.sub(r"[^\w.-]", "_", name)[:100]
