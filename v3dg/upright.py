"""Which axis is up: what a file says, or else a guess from cameras, from a ground plane, or by custom."""

import os
from collections.abc import Mapping
from typing import Any

import numpy as np

from v3dg._numbers import Floats
from v3dg._urls import beside
from v3dg.bundle import Bundle
from v3dg.cameras import AXES, Axis, Camera
from v3dg.gaussians import Gaussians
from v3dg.scene import Scene, Subject

ASSUMED = "as most trained assets have it"
"""What `up_of` says where nothing tells."""

# Fewer cameras may all lie on their sides.
_FEWEST_CAMERAS = 3
# Cosine of the angle to an axis, within which a direction is taken to mean it: 26 degrees.
_NEAR_AN_AXIS = 0.9
# A ground is at most so thick, as standard deviations, beside how far it reaches in its narrower direction.
_FLAT = 0.55


def direction_of(axis: Axis) -> tuple[float, float, float]:
    """The unit vector along an axis."""
    x, y, z = ((-1.0 if axis[0] == "-" else 1.0) * (axis[-1] == name) for name in "xyz")
    return x, y, z


def up_of(
    subject: Subject, cameras: Mapping[str, Camera] | None = None, path: str | os.PathLike[str] = ""
) -> tuple[Axis, str]:
    """Return the axis that is up in a subject, and how that is known, as a phrase.

    In this order: what the file of a scene or a bundle says; where the tops of three or more cameras point
    together; z for other scenes; y for glTF; the plane in which the gaussians of level 0 mostly lie, if it is
    across y or z; else -y, which is what most trained assets have. Planes are taken to be up as custom has
    it: z, or -y.

    Args:
        cameras: That look at it, by name.
        path: Of its file, whose kind may tell.
    """
    config = subject.config if isinstance(subject, Bundle) else {}
    noted: Any = subject.up if isinstance(subject, Scene) else config.get("up")
    if noted in AXES:
        return noted, "as its file says"
    tops = np.array([-camera.viewmat[1, :3] for camera in (cameras or {}).values()]).reshape(-1, 3)
    if len(tops) >= _FEWEST_CAMERAS:
        top = tops.mean(axis=0)
        heights = [float(np.dot(top, direction_of(axis))) for axis in AXES]
        if max(heights) > _NEAR_AN_AXIS * max(float(np.linalg.norm(top)), 0.5):
            return AXES[int(np.argmax(heights))], f"guessed from {len(tops)} cameras"
    if isinstance(subject, Scene):
        return "z", "as scenes have it"
    if beside(path).name.lower().endswith(".glb"):
        return "y", "as glTF has it"
    flat = _flat_axis(_middles(subject))
    if flat is not None:
        return flat, "guessed from the plane of its gaussians"
    return "-y", ASSUMED


def _middles(subject: Bundle | Gaussians) -> Floats:
    """(N, 3) where the gaussians of level 0 are: of a bundle, its clusters, which need no pages."""
    if isinstance(subject, Gaussians):
        return np.asarray(subject.means[:: max(len(subject) // 100_000, 1)], np.float64)
    if not subject.num_levels:
        return np.zeros((0, 3))
    return np.asarray(subject.clusters.box[: subject.level_range(0).stop].mean(axis=1), np.float64)


def _flat_axis(points: Floats) -> Axis | None:
    """The axis across the plane that points lie in, if they do; far outliers do not count."""
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
    return "z" if axis == 2 else "-y"
