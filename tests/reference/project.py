"""Projects 3D gaussians to 2D ellipses in the picture, in float64.

Source: Zwicker et al., EWA splatting, 2002, with gsplat 1.5's clamped Jacobian and
opacity compensation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

# Beyond this margin around the image, the Jacobian is clamped. The margin is a fraction
# of half the field of view.
FIELD_OF_VIEW_MARGIN = 0.3


@dataclass(frozen=True)
class Projection:
    mean_px: np.ndarray  # (N,2)
    covariance_px2: np.ndarray  # (N,2,2), filter included
    determinant: np.ndarray  # (N,), the determinant of covariance_px2
    # (N,) factor of the opacity that preserves the integral of a gaussian when the
    # filter is added.
    compensation: np.ndarray
    depth: np.ndarray  # (N,)
    # (N,) whether the gaussian is not before the near plane, is finite, and has a
    # positive area
    is_drawable: np.ndarray


def rotation(quats: np.ndarray) -> np.ndarray:
    """Return rotations (N,3,3) of quaternions (N,4) w,x,y,z of any length: v becomes q
    v q*. Zero means no rotation."""
    quats = np.asarray(quats, np.float64)
    length = np.linalg.norm(quats, axis=1, keepdims=True)
    w, v = np.split(
        np.where(length == 0, [1.0, 0, 0, 0], quats / np.where(length == 0, 1, length)), [1], axis=1
    )
    columns = []
    for axis in np.eye(3):
        e = np.broadcast_to(axis, v.shape)
        twice = 2 * np.cross(v, e)
        columns.append(e + w * twice + np.cross(v, twice))
    return np.stack(columns, axis=2)


def covariance(quats: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """Return the covariances (N,3,3) in the gaussians' own space."""
    axes = rotation(quats) * np.asarray(scales, np.float64)[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def project(gaussians, camera, *, filter_px2: float = 0.0) -> Projection:
    means = np.asarray(gaussians.means, np.float64)
    to_view, origin = camera.viewmat[:3, :3], camera.viewmat[:3, 3]
    # Gaussians behind the camera or with values that are not finite are removed at the
    # end.
    with np.errstate(all="ignore"):
        view = means @ to_view.T + origin
        depth = view[:, 2]
        slope = view[:, :2] / depth[:, None]
        focal, center = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
        size = np.array([camera.width, camera.height], np.float64)
        margin = FIELD_OF_VIEW_MARGIN * 0.5 * size / focal
        bounded = np.clip(slope, -center / focal - margin, (size - center) / focal + margin)
        jacobian = np.zeros((len(means), 2, 3))
        for i in (0, 1):
            jacobian[:, i, i] = focal[i] / depth
            jacobian[:, i, 2] = -focal[i] * bounded[:, i] / depth
        axes = rotation(gaussians.quats) * np.asarray(gaussians.scales, np.float64)[:, None, :]
        # (N,2,3); the projected covariance is rows rows^T
        rows = jacobian @ to_view @ axes
        unfiltered = rows @ rows.transpose(0, 2, 1)
        # The determinant as a sum of squares (Cauchy-Binet) keeps the digits of needles
        # that are seen end-on.
        cross = np.cross(rows[:, 0], rows[:, 1])
        unfiltered_determinant = (cross * cross).sum(1)
        trace = unfiltered[:, 0, 0] + unfiltered[:, 1, 1]
        determinant = unfiltered_determinant + filter_px2 * trace + filter_px2**2
        compensation = np.sqrt(unfiltered_determinant / determinant)
        covariance_px2 = unfiltered + filter_px2 * np.eye(2)
        mean_px = focal * slope + center
        finite = np.isfinite(mean_px).all(1) & np.isfinite(covariance_px2).all((1, 2))
        is_drawable = (depth >= camera.near) & finite & (determinant > 0) & np.isfinite(determinant)
    return Projection(mean_px, covariance_px2, determinant, compensation, depth, is_drawable)
