"""Cameras of a refinement, found without photographs: around an object, at eyes inside
a place, or both.

A camera outside a room would only show its walls from behind, and a camera inside a
solid object would show nothing. So the free places that a subject surrounds
(`v3dg.framing`) decide. A house in a garden has such places, but is also seen from
outside. It is recognised because much of what is seen from outside is far from all
places inside.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import numpy.typing as npt

from v3dg._json import JsonObject
from v3dg._numbers import Floats, one_of
from v3dg.bundle import Bundle
from v3dg.cameras import Camera
from v3dg.framing import surroundings
from v3dg.upright import direction_of, up_of

SeenFrom = Literal["auto", "outside", "inside", "both"]
"""Where a subject is seen from; "auto" detects it."""

RECORDED = ("eyes", "outside", "units")
"""Names of entries in the config that depend on the gaussians: those of
`Viewpoints.record`, and the number of units."""

_NUM_EYES = 96
# The cameras at an eye are a quarter turn apart, and look up and down in turn by this
# angle. With this field of view, they together show all directions except a cone at
# each pole.
_CAMERAS_PER_EYE = 4
_PITCH = math.radians(15)
_FIELD = math.radians(90)
# The angle between the cameras of successive eyes. It is the golden angle, so that no
# direction repeats.
_TURN = math.pi * (3 - math.sqrt(5))
# Only the aspect ratio of the picture matters.
_PIXELS = 512
# The distance of cameras around a subject from its centre, in radii. The pictures show
# a ball with this fraction of the gaussians.
_DISTANCE = 2.5
_SHARE = 0.99
# The near depth, in radii.
_NEAR = 0.002
# For a subject with places inside: the fraction of what is seen from outside that is
# not its walls. Above this value, it counts as seen from outside, too.
_LEAST_OUTER = 0.08
# A camera is used for a part of a subject if it sees at least this fraction of the
# part's gaussians.
_LEAST_SEEN = 0.05


@dataclass(frozen=True)
class Viewpoints:
    """Where the pictures of a refinement are taken from.

    Attributes:
        cameras: The cameras; empty for pictures from all directions.
        num_eyes: The number of eyes inside.
    """

    cameras: tuple[Camera, ...] = ()
    num_eyes: int = 0

    @property
    def record(self) -> JsonObject:
        """Return the entries for the config of a bundle.

        Pictures from all directions have none.
        """
        if self.num_eyes == 0:
            return {}
        is_outside_too = len(self.cameras) > self.num_eyes * _CAMERAS_PER_EYE
        return {"eyes": self.num_eyes, "outside": is_outside_too}

    @property
    def text(self) -> str:
        """Return a description for users.

        It is empty for pictures from all directions.
        """
        return text_of(self.record)


def text_of(record: JsonObject) -> str:
    """Return the description of a refinement from its entries in a config."""
    if "eyes" not in record:
        return ""
    if record["outside"]:
        return f"seen from outside and from inside: {record['eyes']} eyes"
    return f"seen from inside: {record['eyes']} eyes"


def viewpoints_of(bundle: Bundle, seen_from: SeenFrom) -> Viewpoints:
    """Return the viewpoints of a bundle.

    Raises:
        ValueError: `seen_from` is not a valid value, or it is "inside" or "both" and
            there is no place inside.
    """
    one_of(seen_from, "seen_from", get_args(SeenFrom))
    if seen_from == "outside":
        return Viewpoints()
    axis, _ = up_of(bundle)
    up = np.array(direction_of(axis))
    room = surroundings(bundle, axis)
    if room is None:
        if seen_from == "auto":
            return Viewpoints()
        raise ValueError(
            f"seen_from: expected outside or auto, got {seen_from}: this subject surrounds no "
            "place from which it can be seen; give cameras instead"
        )
    middle, radius = _ball(bundle)
    eyes = _spread(room.places)
    inside_cameras = tuple(
        camera
        for number, eye in enumerate(eyes)
        for camera in _cameras_at(eye, up, number * _TURN, radius)
    )
    if seen_from == "auto":
        seen_from = "inside"
        if room.outer_share > _LEAST_OUTER:
            seen_from = "both"
    if seen_from == "inside":
        return Viewpoints(inside_cameras, len(eyes))
    outer_cameras = _cameras_around(middle, radius, len(inside_cameras))
    return Viewpoints((*inside_cameras, *outer_cameras), len(eyes))


def cameras_that_see(bundle: Bundle, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """Return the cameras that see at least the fraction `_LEAST_SEEN` of a bundle's
    leaves, or all cameras if none does."""
    leaves = bundle.level_range(0)
    middle = np.asarray(bundle.clusters.box[leaves.start : leaves.stop], np.float64).mean(axis=1)
    weight = np.diff(bundle.clusters.offset)[leaves.start : leaves.stop]
    seeing = tuple(
        camera
        for camera in cameras
        if weight[_is_in_picture(camera, middle)].sum() >= _LEAST_SEEN * weight.sum()
    )
    return seeing or tuple(cameras)


def _is_in_picture(camera: Camera, points: Floats) -> npt.NDArray[np.bool_]:
    """Return (N,) whether each point is in front of a camera and inside its picture.
    Lens distortion is ignored."""
    x, y, depth = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).T
    depth = np.where(depth > camera.near, depth, np.nan)
    column = camera.fx * x / depth + camera.cx
    row = camera.fy * y / depth + camera.cy
    is_inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    return np.asarray(is_inside)


def _ball(bundle: Bundle) -> tuple[Floats, float]:
    """Return the centre and the radius of a ball around nearly all gaussians."""
    means = np.asarray(bundle.level_gaussians(0).means, np.float64)
    middle = np.median(means, axis=0)
    radius = float(np.quantile(np.linalg.norm(means - middle, axis=1), _SHARE))
    return middle, radius


def _spread(places: Floats) -> Floats:
    """Return at most `_NUM_EYES` of the places. The first is the one in the middle;
    each of the others is the farthest from those before it."""
    middle = places.mean(axis=0)
    number = int(np.square(places - middle).sum(axis=1).argmin())
    numbers = [number]
    distances = np.square(places - places[number]).sum(axis=1)
    while len(numbers) < min(_NUM_EYES, len(places)):
        number = int(distances.argmax())
        numbers.append(number)
        distances = np.minimum(distances, np.square(places - places[number]).sum(axis=1))
    return places[numbers]


def _cameras_at(eye: Floats, up: Floats, azimuth: float, radius: float) -> list[Camera]:
    """Return the cameras of an eye, which look in all directions."""
    front = np.eye(3)[int(np.abs(up).argmin())]
    front = front - up * (up @ front)
    front /= np.linalg.norm(front)
    aside = np.cross(up, front)
    cameras = []
    for number in range(_CAMERAS_PER_EYE):
        angle = azimuth + 2 * math.pi * number / _CAMERAS_PER_EYE
        level = math.cos(angle) * front + math.sin(angle) * aside
        pitch = _PITCH * (1 - 2 * (number % 2))
        forward = math.cos(pitch) * level + math.sin(pitch) * up
        cameras.append(
            Camera.look_at(
                eye,
                eye + radius * forward,
                up,
                _FIELD,
                width=_PIXELS,
                height=_PIXELS,
                near=_NEAR * radius,
            )
        )
    return cameras


def _cameras_around(middle: Floats, radius: float, count: int) -> list[Camera]:
    """Return cameras in evenly spread directions, each of which sees a whole ball."""
    field = 2 * math.atan(1 / math.sqrt(_DISTANCE**2 - 1))
    cameras = []
    for number in range(count):
        height = 1 - (2 * number + 1) / count
        flat = math.sqrt(1 - height**2)
        angle = number * _TURN
        outwards = np.array([flat * math.cos(angle), flat * math.sin(angle), height])
        top = np.eye(3)[int(np.abs(outwards).argmin())]
        cameras.append(
            Camera.look_at(
                middle + _DISTANCE * radius * outwards,
                middle,
                top,
                field,
                width=_PIXELS,
                height=_PIXELS,
                near=_NEAR * radius,
            )
        )
    return cameras
