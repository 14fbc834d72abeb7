"""Selection of clusters in double precision, one cluster and one gaussian at a time."""

from __future__ import annotations

import math

import numpy as np


def footprint_px2(ball: np.ndarray, eye: np.ndarray, focal_px2: float) -> float:
    """Return the area on the screen of the solid angle of a ball. It is infinite if the
    eye is inside the ball."""
    center, radius = np.float64(ball[:3]), float(ball[3])
    distance = float(np.linalg.norm(center - eye))
    if distance <= radius:
        return math.inf
    # This is 2 pi (1 - cos a), where a is the ball's angular radius. It is written with
    # sin^2, because 1 - cos a loses all digits for distant balls.
    return 4 * math.pi * math.sin(0.5 * math.asin(radius / distance)) ** 2 * focal_px2


def paper_footprint_px2(
    ball: np.ndarray, eye: np.ndarray, forward: np.ndarray, focal_px2: float
) -> float:
    depth = float((np.float64(ball[:3]) - eye) @ forward)
    return math.pi * float(ball[3]) ** 2 * focal_px2 / depth**2 if depth != 0 else math.inf


def eye_in_instance(scene, i: int, camera) -> np.ndarray:
    return scene.rotations[i].T @ (camera.position - scene.positions[i]) / scene.scales[i]


def metrics(scene, i: int, camera, footprint: str = "solid_angle") -> list[float]:
    """Return the metric of each group in px²: the area on the screen that one of its
    gaussians represents."""
    groups = scene.bundles[scene.instance_bundle[i]].groups
    eye = eye_in_instance(scene, i, camera)
    forward = scene.rotations[i].T @ camera.viewmat[2, :3]
    focal_px2 = camera.fx * camera.fy
    areas = [
        footprint_px2(ball, eye, focal_px2)
        if footprint == "solid_angle"
        else paper_footprint_px2(ball, eye, forward, focal_px2)
        for ball in groups.ball
    ]
    return [area * float(weight) for area, weight in zip(areas, groups.weight, strict=True)]


def cut(scene, camera, tolerance: float, footprint: str = "solid_angle") -> list[tuple[int, int]]:
    """Return the (instance, cluster) pairs for which the metric of the cluster's own
    group is within the tolerance, and that of its parent group is not."""
    pairs = []
    for i in range(len(scene)):
        clusters = scene.bundles[scene.instance_bundle[i]].clusters
        metric = metrics(scene, i, camera, footprint)
        for c, (own, parent) in enumerate(
            zip(clusters.own_group, clusters.parent_group, strict=True)
        ):
            own_metric = -1.0 if own < 0 else metric[own]
            parent_fits = parent >= 0 and metric[parent] <= tolerance
            if own_metric <= tolerance and not parent_fits:
                pairs.append((i, c))
    return pairs


def paths(clusters, groups) -> list[list[int]]:
    """Yield every path from a leaf to a root as a list of clusters. From each group it
    contains one of the clusters that the group made."""
    made = {}
    for c, own in enumerate(clusters.own_group):
        made.setdefault(int(own), []).append(c)

    def upwards(c: int) -> list[list[int]]:
        parent = int(clusters.parent_group[c])
        return (
            [[c]]
            if parent < 0
            else [[c, *rest] for above in made[parent] for rest in upwards(above)]
        )

    return [path for leaf in made.get(-1, []) for path in upwards(leaf)]


def touches_image(mean: np.ndarray, covariance: np.ndarray, filter_px2: float, camera) -> bool:
    """Return whether a gaussian of opacity 1 reaches alpha 1/255 somewhere in the
    image.

    `mean` (3,) and `covariance` (3,3) are in camera space. The projection is linearised
    at the mean. As in gsplat, the slope of the linearisation is clamped to 0.15 image
    sizes beyond the image.
    """
    x, y, z = mean
    if z < camera.near:
        return False
    half_x, half_y = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    u = float(
        np.clip(
            x / z,
            -camera.cx / camera.fx - 0.3 * half_x,
            (camera.width - camera.cx) / camera.fx + 0.3 * half_x,
        )
    )
    v = float(
        np.clip(
            y / z,
            -camera.cy / camera.fy - 0.3 * half_y,
            (camera.height - camera.cy) / camera.fy + 0.3 * half_y,
        )
    )
    jacobian = np.array(
        [[camera.fx / z, 0, -camera.fx * u / z], [0, camera.fy / z, -camera.fy * v / z]]
    )
    cov = jacobian @ covariance @ jacobian.T + filter_px2 * np.eye(2)
    reach = math.sqrt(2 * math.log(255))
    px, py = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    dx, dy = reach * math.sqrt(cov[0, 0]), reach * math.sqrt(cov[1, 1])
    return px + dx > 0 and px - dx < camera.width and py + dy > 0 and py - dy < camera.height
