"""The axis that is up: read from a file, or guessed from cameras, from a ground plane,
or by convention."""

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
"""The reason that `up_of` returns if nothing is known."""

# With fewer cameras, all of them may be tilted.
_MIN_CAMERAS = 3
# Cosine of the largest angle, 26 degrees, between an axis and a direction that is taken
# for it.
_NEAR_AN_AXIS = 0.9
# Largest ratio of the thickness of a ground to its smaller extent, as standard
# deviations.
_FLAT = 0.55


class FoundUp(NamedTuple):
    """The axis that is up in a subject.

    Attributes:
        axis: The axis.
        reason: Why, as a phrase.
        is_guessed: Whether it is only what gaussians or cameras themselves show.
    """

    axis: Axis
    reason: str
    is_guessed: bool = False


def direction_of(axis: Axis) -> tuple[float, float, float]:
    """The unit vector along an axis."""
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
    """Return the axis that is up in a subject, and the reason, as a phrase.

    The first of these that applies: the axis in the file of a scene or a bundle; the
    direction in which the tops of three or more cameras point; z for other scenes; what
    the file of an asset declares; the normal of the plane in which the gaussians of
    level 0 mostly lie, if it is along y or z, as -y or z; else -y, as in most trained
    assets.

    Args:
        cameras: Cameras that look at the subject, by name.
        declared: What the file of an asset declares; None for that of the file which
            `read_asset` read it from.
    """
    axis, reason, _ = found_up(subject, cameras, declared=declared)
    return axis, reason


def found_up(
    subject: Subject,
    cameras: Mapping[str, Camera] | None = None,
    *,
    declared: Declared | None = None,
) -> FoundUp:
    """Return what `up_of` does, and whether it is guessed."""
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
    """Turn gaussians of which an axis is up so that -y is, as `write_asset` and viewers
    of files without axes take it; colours turn, too.

    Raises:
        ValueError: `up` is no axis.
    """
    return _axes.turned(gaussians.numpy(), _axes.axes_of_up(up), _axes.MEMORY)


def _middles(subject: Bundle | Gaussians) -> Floats:
    """Return the centres (N, 3) of gaussians of level 0, or of the clusters of a
    bundle, of which no page is read."""
    if isinstance(subject, Gaussians):
        return np.asarray(subject.means[:: max(len(subject) // 100_000, 1)], np.float64)
    if not subject.num_levels:
        return np.zeros((0, 3))
    return np.asarray(subject.clusters.box[: subject.level_range(0).stop].mean(axis=1), np.float64)


def _flat_axis(points: Floats) -> Axis | None:
    """Return the axis along the normal of the plane that the points lie in, ignoring
    outliers; None if they lie in no plane."""
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) < 16:
        return None
    low, high = np.percentile(points, (5, 95), axis=0)
    points = points[((points >= low) & (points <= high)).all(axis=1)]  # at least ten
    variances, directions = np.linalg.eigh(np.cov(points.T))
    axis = int(np.abs(directions[:, 0]).argmax())
    is_flat = variances[0] < _FLAT**2 * variances[1]
    if axis == 0 or not is_flat or abs(directions[axis, 0]) < _NEAR_AN_AXIS:
        return None
    if axis == 2:
        return "z"
    return "-y"
