"""Determines the axis that points up. It comes from a file, from cameras, from a ground
plane, or from a convention."""

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from v3dg._numbers import Floats
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis, Camera
from v3dg.formats import _axes
from v3dg.formats._declared import Declared, declared_of
from v3dg.gaussians import Gaussians
from v3dg.scene import Scene, Subject

ASSUMED = "as in most trained assets"
"""The reason that `up_of` returns if the axis is unknown and only assumed."""

# With fewer cameras than this, all of them may be tilted.
_MIN_CAMERAS = 3
# A direction counts as parallel to an axis if the cosine of the angle between them
# exceeds this value (26 degrees).
_NEAR_AN_AXIS = 0.9
# Maximum thickness of a ground plane relative to its smaller extent. Both are standard
# deviations.
_FLAT = 0.55


class FoundUp(NamedTuple):
    """The axis that points up in a subject.

    Attributes:
        axis: The axis.
        reason: The source of the axis, as a phrase.
        is_guessed: Whether the axis was only derived from gaussians or cameras.
    """

    axis: Axis
    reason: str
    is_guessed: bool = False


def direction_of(axis: Axis) -> tuple[float, float, float]:
    """Return the unit vector along an axis."""
    sign = 1.0
    if axis[0] == "-":
        sign = -1.0
    x, y, z = (sign * (axis[-1] == name) for name in "xyz")
    return x, y, z


def up_of(
    subject: Subject,
    cameras: Mapping[str, Camera] | None = None,
    *,
    declared: Declared | None = None,
) -> tuple[Axis, str]:
    """Return the axis of a subject that points up, and the source of that information
    as a phrase.

    These sources are tried in this order: the axis that the file of a scene or a bundle
    declares; the common upward direction of three or more cameras; z, if the subject is
    a scene; the axis that the file of an asset declares; the normal of a plane that
    contains most gaussians of level 0, if the normal is parallel to y (then -y is up)
    or z; finally -y, as in most trained assets.

    Args:
        cameras: Cameras that look at the subject, by name.
        declared: The declarations of the asset's file. None uses those of the file from
            which `read_asset` read the asset.
    """
    axis, reason, _ = found_up(subject, cameras, declared=declared)
    return axis, reason


def found_up(
    subject: Subject,
    cameras: Mapping[str, Camera] | None = None,
    *,
    declared: Declared | None = None,
) -> FoundUp:
    """Return the result of `up_of`, and whether it is guessed."""
    recorded: object = None
    if isinstance(subject, Scene):
        recorded = subject.up
    elif isinstance(subject, Bundle):
        recorded = subject.config.get("up")
    if isinstance(recorded, str) and recorded in AXES:
        return FoundUp(recorded, "as its file says")
    tops = np.array([-camera.viewmat[1, :3] for camera in (cameras or {}).values()]).reshape(-1, 3)
    if len(tops) >= _MIN_CAMERAS:
        top = tops.mean(axis=0)
        heights = [float(np.dot(top, direction_of(axis))) for axis in AXES]
        if max(heights) > _NEAR_AN_AXIS * max(float(np.linalg.norm(top)), 0.5):
            axis = AXES[int(np.argmax(heights))]
            return FoundUp(axis, f"guessed from {len(tops)} cameras", is_guessed=True)
    if isinstance(subject, Scene):
        return FoundUp("z", "as in most scenes")
    if declared is None and isinstance(subject, Gaussians):
        declared = declared_of(subject)
    if declared is not None and declared.up is not None:
        return FoundUp(declared.up, declared.up_reason, is_guessed=declared.up_is_guessed)
    flat = _flat_axis(_middles(subject))
    if flat is None:
        return FoundUp("-y", ASSUMED)
    return FoundUp(flat, "guessed from the plane of its gaussians", is_guessed=True)


def turned_upright(gaussians: Gaussians, up: Axis) -> Gaussians:
    """Return gaussians rotated so that -y points up. Currently, the axis `up` points
    up. `write_asset`, and viewers of formats without axes, assume that -y is up.
    Colours are rotated, too.

    Raises:
        ValueError: `up` is not the name of an axis.
    """
    return _axes.turned(gaussians.numpy(), _axes.axes_of_up(up), _axes.MEMORY)


def _middles(subject: Bundle | Gaussians) -> Floats:
    """Return the centres (N, 3) of gaussians of level 0. For a bundle, return the
    centres of its clusters, which requires no page."""
    if isinstance(subject, Gaussians):
        return np.asarray(subject.means[:: max(len(subject) // 100_000, 1)], np.float64)
    if not subject.num_levels:
        return np.zeros((0, 3))
    return np.asarray(subject.clusters.box[: subject.level_range(0).stop].mean(axis=1), np.float64)


def _flat_axis(points: Floats) -> Axis | None:
    """Return the axis parallel to the normal of the plane in which the points lie,
    ignoring outliers. Return None if they do not lie in a plane."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 16:
        return None
    low, high = np.percentile(points, (5, 95), axis=0)
    # At least ten points remain.
    points = points[((points >= low) & (points <= high)).all(axis=1)]
    variances, directions = np.linalg.eigh(np.cov(points.T))
    axis = int(np.abs(directions[:, 0]).argmax())
    is_flat = variances[0] < _FLAT**2 * variances[1]
    if axis == 0 or not is_flat or abs(directions[axis, 0]) < _NEAR_AN_AXIS:
        return None
    if axis == 2:
        return "z"
    return "-y"
