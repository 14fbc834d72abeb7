"""The cameras of commands: those of a file, a scene's own, or a turntable around the
subject."""

import math
import os
import re
import sys
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
import tyro

from v3dg._numbers import check, refuse
from v3dg._urls import beside, shown
from v3dg.bundle import Bundle
from v3dg.camera_file import read_cameras
from v3dg.cameras import AXES, DEFAULT_FOV_X, Axis, Camera, VectorLike, turntable
from v3dg.cleaning import ball_of_most, examine
from v3dg.cli._common import (
    check_range,
    check_usage,
    level_size,
    option,
    printable,
    require_subject,
)
from v3dg.gaussians import Array, Gaussians
from v3dg.pictures import MOST_SIDE, check_size
from v3dg.scene import Scene, Subject
from v3dg.scene.file import is_scene
from v3dg.upright import ASSUMED, direction_of, up_of

# Gaussians of the level that a turntable is centred on: enough to find the centre, and
# quick to read.
_ENOUGH_TO_FRAME = 50_000

_DEFAULT_ELEVATION = 20.0  # degrees

# All cameras are made before the first picture is drawn.
_MOST_VIEWS = 10_000


@dataclass(kw_only=True)
class CameraFile:
    """Cameras from a file of another program."""

    cameras: Annotated[Path | None, option("PATH")] = None
    """Use the cameras of this nerfstudio transforms.json, nerfstudio run or COLMAP
    model; `view` offers them with their photographs."""
    distortion: Literal["refuse", "ignore"] = "refuse"
    """Whether lens distortion in that file is an error, or left out of the pictures."""

    def read(self, size: tuple[int, int] = (800, 800)) -> dict[str, Camera]:
        """The cameras of --cameras, with this size if their file has none; empty
        without the option."""
        if self.cameras is None:
            return {}
        cameras = read_cameras(self.cameras, size=size, distortion=self.distortion)
        check(self.cameras, cameras, "cameras, got a file without any")
        return cameras


@dataclass
class ViewOptions(CameraFile):
    """The cameras of the pictures: those of a scene, of a camera file, or of a
    turntable."""

    camera: Annotated[str | None, option("NAME")] = None
    """Draw only this camera of a file with cameras, given by its name or its number in
    the file, from 0."""
    views: Annotated[int | None, option("N")] = None
    """Number of views around the turntable; 1 by default, 8 for `compare`."""
    size: Annotated[tuple[int, int], tyro.conf.arg(metavar="W H")] = (800, 800)
    """Width and height in px of a turntable's pictures, and of cameras whose file has
    no size."""
    elevation: Annotated[float | None, option("DEGREES")] = None
    """Height of the turntable's cameras above the horizon; 20 by default."""
    up: Annotated[Axis | None, option("{x,y,z,-x,-y,-z}")] = None
    """The turntable's axis; by default the one in the file, or a guess.
    """

    def check(self, *subjects: Path) -> None:
        """Refuse wrong subjects, and options that do not apply to them, before anything
        is read."""
        for path in subjects:
            require_subject(path)
        for side in self.size:
            check_range("--size", side, 1, MOST_SIDE)
        file = self.cameras or next(filter(is_scene, subjects), None)
        expected = "--cameras or a scene (.json) to take it from; leave it out"
        check_usage("--camera", self.camera is None or file, expected)
        for name, value in self.turntable().items():
            expected = (
                f"a turntable to set with it, got the cameras of {shown(file or '')}; leave it out"
            )
            check_usage(name, value is None or not file, expected)
        if self.views is not None:
            check_range("--views", self.views, 1, _MOST_VIEWS)
        check_range("--elevation", self.elevation or 0, -89.99, 89.99)

    def turntable(self) -> dict[str, object]:
        """Options of the turntable, by name; None: not given."""
        return {"--views": self.views, "--elevation": self.elevation, "--up": self.up}


# A field of a command's options; on the command line its options stand beside the
# others.
Views: TypeAlias = Annotated[ViewOptions, tyro.conf.OmitArgPrefixes]


def choose_cameras(
    options: ViewOptions,
    path: Path,
    subject: Subject,
    own_cameras: dict[str, Camera] | None,
    views: int = 1,
) -> dict[str, Camera]:
    """The cameras of --cameras, else the subject's own, else a turntable around it, by
    default of `views`."""
    cameras = options.read(options.size) or own_cameras
    if cameras is None and not isinstance(subject, Scene):
        cameras = _around(subject, options, options.views or views)
    if not cameras:
        refuse(shown(path), "cameras, got a file without any; give some with --cameras")
    if options.camera is not None:
        name = _camera_name(options.camera, list(cameras))
        cameras = {name: cameras[name]}
    for name, camera in cameras.items():
        check_size(f"camera {name}", camera.width, camera.height)
    return cameras


def _camera_name(text: str, names: Sequence[str]) -> str:
    """The name of the camera that --camera selects by name or number."""
    if text in names:
        return text
    if text.isdecimal() and int(text) < len(names):
        return names[int(text)]
    choices = ", ".join(names[:8])
    if len(names) > 8:
        choices += " ..."
    raise ValueError(f"--camera: expected one of {choices}, or 0 to {len(names) - 1}, got {text}")


def _around(subject: Bundle | Gaussians, options: ViewOptions, views: int) -> dict[str, Camera]:
    """Cameras around the ball of most gaussians, at a distance that shows nearly all of
    it."""
    means = _means_to_frame(subject)
    centre: VectorLike = (0.0, 0.0, 0.0)
    radius = 1.0
    if len(means):
        centre, radius = ball_of_most(means)
    narrow = math.tan(DEFAULT_FOV_X / 2) * min(1.0, options.size[1] / options.size[0])
    distance = 0.9 * radius / math.sin(math.atan(narrow))
    elevation = _DEFAULT_ELEVATION
    if options.elevation is not None:
        elevation = options.elevation
    cameras = turntable(
        centre,
        distance,
        views,
        math.radians(elevation),
        up=direction_of(options.up or up_of(subject)[0]),
        width=options.size[0],
        height=options.size[1],
        near=min(0.01, 0.01 * distance),
    )
    digits = len(str(views - 1))
    return {f"{i:0{digits}}": camera for i, camera in enumerate(cameras)}


def _means_to_frame(subject: Bundle | Gaussians) -> Array:
    """(N, 3) positions of gaussians that show where the subject is."""
    if isinstance(subject, Gaussians):
        return subject.means[examine(subject).drawable]
    if not subject.num_levels:
        return np.zeros((0, 3), np.float32)
    levels = range(subject.num_levels)
    small_levels = (i for i in levels if level_size(subject, i) <= _ENOUGH_TO_FRAME)
    return subject.level_gaussians(next(small_levels, levels[-1])).means


def choose_up(
    requested: Axis | None, subject: Subject, cameras: Mapping[str, Camera] | None, path: Path
) -> tuple[Axis, list[str]]:
    """The axis that is up: that of --up, or else as `up_of` finds it, with a line that
    says so.

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
    """The line that says which axis is up and why; none without a reason, which is for
    --up."""
    if not reason:
        return []
    return [f"{beside(path).name}: {axis} is up, {reason}; change it with --up"]


def is_at_terminal() -> bool:
    """Whether a user can answer questions; a job in the background would be stopped."""
    is_open = sys.stdin and sys.stdin.isatty() and sys.stderr.isatty()
    return bool(is_open and os.tcgetpgrp(sys.stdin.fileno()) == os.getpgrp())


def ask_up(path: Path, axis: Axis) -> Axis:
    """Ask the user at the terminal which axis is up; Enter, or the end of the input,
    accepts `axis`."""
    while True:
        question = printable(f"{beside(path).name}: which way is up, {', '.join(AXES)}? [{axis}] ")
        print(question, end="", file=sys.stderr, flush=True)
        answer = sys.stdin.readline().strip() or axis
        for choice in AXES:
            if answer == choice:
                return choice


def picture_paths(output: Path, cameras: Collection[str]) -> list[Path]:
    """The paths of the pictures of cameras; if there are several, each path has the
    name of its camera.

    If two paths would be the same, all have the number of their camera in the file
    instead, from 0.
    """
    if len(cameras) == 1:
        return [output]
    names = [re.sub(r"[^\w.-]", "_", name)[:100] for name in cameras]
    if len(set(names)) < len(names):
        names = [str(place) for place in range(len(names))]
    return [output.with_name(f"{output.stem}_{name}{output.suffix}") for name in names]
