"""Draws a robot of triangles in the middle of a room into a z-buffer, by casting
rays."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

import v3dg

Floats = NDArray[np.float64]

_SIDES = 12  # number of sides of a limb
_SUN = np.array([0.4, -0.5, 0.77])
_COLOURS = np.array([[0.3, 0.3, 0.34], [0.9, 0.45, 0.1], [0.7, 0.7, 0.72]])
_FIRST_PART = 1000  # first id of the robot's parts, larger than the ids of the scene


def draw_robot(cameras: list[v3dg.Camera], device: str) -> v3dg.MeshLayer:
    """Return pictures (B, H, W) of the robot for cameras of one size, on the device."""
    triangles, part = _robot()
    layers = [_draw(triangles, part, camera) for camera in cameras]
    color, depth, normal, instance = (np.stack(planes) for planes in zip(*layers, strict=True))
    if device == "cpu":
        return v3dg.MeshLayer(color, depth, normal=normal, instance=instance)
    import torch

    planes = [torch.tensor(plane, device=device) for plane in (color, depth, normal, instance)]
    return v3dg.MeshLayer(planes[0], planes[1], normal=planes[2], instance=planes[3])


def _robot() -> tuple[Floats, NDArray[np.int32]]:
    """Return the triangles (T, 3, 3) of an arm on a base, and the index (T,) of each
    triangle's part."""
    joints = np.array(
        [[0, 0, 0], [0, 0, 0.5], [0.05, 0, 1.15], [0.55, 0.1, 1.3], [0.85, 0.15, 1.0]]
    )
    radii = [0.28, 0.16, 0.12, 0.09]
    limbs = [_limb(joints[k], joints[k + 1], radius) for k, radius in enumerate(radii)]
    part = np.concatenate([np.full(len(limb), k, np.int32) for k, limb in enumerate(limbs)])
    return np.concatenate(limbs), part


def _limb(start: Floats, end: Floats, radius: float) -> Floats:
    """Return the triangles of a closed cone between two points."""
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    side /= np.linalg.norm(side)
    angles = np.linspace(0, 2 * math.pi, _SIDES + 1)
    ring = np.cos(angles)[:, None] * side + np.sin(angles)[:, None] * np.cross(axis, side)
    low = start + radius * ring
    high = end + 0.8 * radius * ring
    triangles = []
    for a, b, c, d in zip(low[:-1], low[1:], high[:-1], high[1:], strict=True):
        triangles += [[a, b, d], [a, d, c], [start, b, a], [end, c, d]]
    return np.array(triangles)


def _draw(
    triangles: Floats, part: NDArray[np.int32], camera: v3dg.Camera
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.int32]]:
    """Return colour, depth, normal and id of each pixel.

    Depth is 0 where the robot is not visible.
    """
    view = (triangles @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).astype(np.float32)
    rows, columns = np.mgrid[: camera.height, : camera.width] + 0.5
    x = (columns - camera.cx) / camera.fx
    y = (rows - camera.cy) / camera.fy
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3).astype(np.float32)
    # The intersection of Möller and Trumbore (1997), with the eye at the origin.
    first = view[:, 1] - view[:, 0]
    second = view[:, 2] - view[:, 0]
    normal = np.cross(first, second)
    facing = rays @ normal.T
    safe = np.where(np.abs(facing) > 1e-12, facing, 1)
    depth = (view[:, 0] * normal).sum(axis=1) / safe
    u = rays @ np.cross(second, view[:, 0]).T / safe
    v = rays @ np.cross(view[:, 0], first).T / safe
    is_hit = (np.abs(facing) > 1e-12) & (u >= 0) & (v >= 0) & (u + v <= 1)
    is_hit &= depth > camera.near
    depth = np.where(is_hit, depth, np.inf)
    nearest = depth.argmin(axis=1)
    shape = (camera.height, camera.width)
    depth = depth.min(axis=1).reshape(shape)
    is_seen = np.isfinite(depth)
    unit = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    light = 0.3 + 0.7 * np.abs(unit @ (camera.viewmat[:3, :3] @ _SUN))
    color = (_COLOURS[part % len(_COLOURS)] * light[:, None])[nearest].reshape(*shape, 3)
    towards_eye = -np.sign(np.take_along_axis(facing, nearest[:, None], axis=1))
    normals = (unit[nearest] * towards_eye).reshape(*shape, 3)
    ids = (_FIRST_PART + part)[nearest].reshape(shape).astype(np.int32)
    return (
        color.astype(np.float32),
        np.where(is_seen, depth, 0).astype(np.float32),
        normals.astype(np.float32),
        ids,
    )
