"""The camera trajectories of the V3DG paper's measurements."""

from __future__ import annotations

import math

from v3dg.cameras import DEFAULT_FOV_X, Camera, VectorLike, turntable

ELEVATIONS = (15.0, 30.0, 45.0, 60.0, 75.0)
"""Elevations of the cameras in degrees above the ground."""
NUM_DIRECTIONS, NUM_DISTANCES = 4, 20


def trajectories(
    center: VectorLike,
    radius: float,
    *,
    fov_x: float = DEFAULT_FOV_X,
    width: int = 1920,
    height: int = 1080,
    near: float = 0.01,
) -> dict[str, Camera]:
    """Return the paper's 400 cameras: 4 directions, 5 elevations and 20 distances, all
    looking at the centre.

    The outer loop is over the directions +y, -x, -y and +x, the next one over
    elevations of 15 to 75 degrees, and the inner one over distances of 1/20 to 20/20 of
    the radius. With the origin and a radius of 9, the cameras are those of the
    published DonutSea. The up axis is z.

    Args:
        center: (3,) point in world space.
        radius: Distance of the farthest cameras; > 0.
        fov_x: Horizontal field of view in radians.

    Returns:
        Cameras by name in this order, "000_camera_0" to "399_camera_19". A name has the
        index of the camera and the index of its distance.

    Raises:
        ValueError: The radius is not a positive number.
    """
    if not (radius > 0 and math.isfinite(radius)):
        raise ValueError(f"radius: expected a positive number, got {radius:g}")
    cameras: dict[str, Camera] = {}
    for direction in range(NUM_DIRECTIONS):
        for elevation in ELEVATIONS:
            for step in range(NUM_DISTANCES):
                distance = radius * (step + 1) / NUM_DISTANCES
                # `turntable` begins at +x and rotates towards +y.
                around = turntable(
                    center,
                    distance,
                    NUM_DIRECTIONS,
                    math.radians(elevation),
                    fov_x=fov_x,
                    width=width,
                    height=height,
                    near=near,
                )
                name = f"{len(cameras):03}_camera_{step}"
                cameras[name] = around[(direction + 1) % NUM_DIRECTIONS]
    return cameras
