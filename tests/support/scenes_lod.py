"""Bundles with a realistic layout in space, random poses and cameras, for the tests of
selection."""

import itertools

import numpy as np

from v3dg import Bundle, Camera, Clusters, Gaussians, Groups, Scene, _core
from v3dg.residency import residency
from v3dg.select import rule_of

REACH = 3.33  # standard deviations at which the alpha of an opaque gaussian falls below 1/255


def rotation_matrices(quats):
    """Return (N,3,3) rotations of (N,4) w x y z of any length."""
    w, x, y, z = (np.asarray(quats, np.float64) / np.linalg.norm(quats, axis=1, keepdims=True)).T
    return np.array(
        [
            [w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z],
        ]
    ).transpose(2, 0, 1)


def covariances(gaussians):
    axes = rotation_matrices(gaussians.quats) * gaussians.scales[:, None, :].astype(np.float64)
    return axes @ axes.transpose(0, 2, 1)


def box_of(gaussians):
    """Return the box (2,3) of means and their extents, in float32, rounded outwards."""
    if len(gaussians) == 0:
        return np.zeros((2, 3), np.float32)
    reach = REACH * np.sqrt(np.diagonal(covariances(gaussians), axis1=1, axis2=2))
    lo, hi = (gaussians.means - reach).min(axis=0), (gaussians.means + reach).max(axis=0)
    lo32, hi32 = lo.astype(np.float32), hi.astype(np.float32)
    return np.stack(
        [np.nextafter(lo32, np.float32(-np.inf)), np.nextafter(hi32, np.float32(np.inf))]
    )


def blob(rng, count, *, origin=0.0, size=1.0, sh_degree=0):
    """Return gaussians of all shapes in and around a ball; some are needles or
    plates."""
    scales = size * np.exp(rng.normal(-3, 1, (count, 1)) + rng.normal(0, 1, (count, 3)))
    quats = rng.normal(size=(count, 4)) + 1e-3
    return Gaussians(
        means=(np.asarray(origin) + size * rng.normal(size=(count, 3))).astype(np.float32),
        quats=quats.astype(np.float32),
        scales=scales.astype(np.float32),
        opacities=rng.uniform(0.05, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, (sh_degree + 1) ** 2, 3)).astype(np.float32),
    )


def lod_bundle(rng, asset, cluster_size, *, group_size=2, past_root=2, filter_px2=0.1):
    """Return a bundle with the layout of a build: median split, groups of neighbours,
    half the gaussians per level.

    A group of ``group_size`` clusters is reduced to half as many clusters, at least
    one. Once one cluster is left, it is halved for ``past_root`` further levels.
    """
    halvings = _core.num_halvings(len(asset), cluster_size)
    order, leaf_offset = _core.median_split(asset.means, np.array([0, len(asset)]), halvings)
    level = [asset.subset(order[a:b]) for a, b in itertools.pairwise(leaf_offset)]
    # A unit is a tuple of the clusters that one group made, that group (-1 for none),
    # and the ball that must be contained.
    units = [([cluster], -1, None) for cluster in level]
    clusters, balls, weights, group_level, group_parent, links = [], [], [], [], [], []
    depth = 0
    while True:
        is_last = len(units) == 1 and (depth > 0 or len(level) == 1) and past_root == 0
        made = []
        members = max(1, group_size // max(1, len(units[0][0])))
        runs = [units[i : i + members] for i in range(0, len(units), members)]
        for run in runs:
            g = -1 if is_last else len(balls)
            below = [cluster for unit, _, _ in run for cluster in unit]
            for unit, own, _ in run:
                for cluster in unit:
                    clusters.append(cluster)
                    links.append((own, g, depth))
                if own >= 0:
                    group_parent[own] = g
            if is_last:
                continue
            together = Gaussians.concatenate(below)
            inner = [ball for _, own, ball in run if own >= 0]
            if inner:
                spheres = np.ascontiguousarray(np.stack(inner))
            else:
                radii = together.scales.max(axis=1, initial=0.0, keepdims=True)
                spheres = np.concatenate([together.means, radii], axis=1)
            ball = _core.bound_spheres(spheres, np.array([0, len(spheres)]))[0]
            keep = together.subset(
                np.sort(rng.permutation(len(together))[: max(1, len(together) // 2)])
            )
            num_made = max(1, len(below) // 2)
            parts = [keep.subset(part) for part in np.array_split(np.arange(len(keep)), num_made)]
            below_weights = [weights[own] for _, own, _ in run if own >= 0]
            balls.append(ball)
            weights.append(max([1 / max(1, len(keep)), *below_weights]))
            group_level.append(depth + 1)
            group_parent.append(-1)
            made.append((parts, g, ball))
        if is_last:
            break
        if len(units) == 1:
            past_root -= 1
        units, depth = made, depth + 1
    table = np.array(links, np.int32).reshape(-1, 3)
    own, parent, levels = (np.ascontiguousarray(column) for column in table.T)
    offset = np.concatenate([[0], np.cumsum([len(c) for c in clusters])]).astype(np.int64)
    return Bundle(
        Clusters(
            offset=offset,
            level=levels,
            own_group=own,
            parent_group=parent,
            box=np.stack([box_of(c) for c in clusters]),
            filter_px2=np.where(levels > 0, filter_px2, 0).astype(np.float32),
            antialiased=(levels > 0).astype(np.uint8),
        ),
        Groups(
            ball=np.array(balls, np.float32).reshape(-1, 4),
            weight=np.array(weights, np.float32),
            parent=np.array(group_parent, np.int32),
            level=np.array(group_level, np.int32),
            error=np.full((len(balls), 2), np.nan, np.float32),
        ),
        Gaussians.concatenate(clusters),
    )


def random_scene(rng, bundle, count, *, spread=5.0, origin=0.0, log_scale=1.0):
    scene = Scene()
    scene.add(
        bundle,
        positions=np.asarray(origin) + spread * rng.normal(size=(count, 3)),
        quaternions=rng.normal(size=(count, 4)) + 1e-6,
        scales=np.exp(log_scale * rng.normal(size=count)),
    )
    return scene


def random_camera(rng, *, distance=5.0, origin=0.0, width=64, height=48, **change):
    eye = np.asarray(origin) + distance * rng.normal(size=3)
    target = np.asarray(origin) + rng.normal(size=3)
    fov_x = float(rng.uniform(0.2, 2.4))
    return Camera.look_at(
        eye, target, rng.normal(size=3), fov_x, width=width, height=height, **change
    )


def turned(camera, rng):
    """Return the camera with another view direction."""
    axis = rng.normal(size=3)
    return Camera.look_at(
        camera.position,
        camera.position + axis,
        rng.normal(size=3),
        width=camera.width,
        height=camera.height,
    )


def instances_of(scene):
    """Return the instances for the core's functions, on the host."""
    return _core.Instances(
        bundle=scene.instance_bundle,
        positions=scene.positions,
        quaternions=scene.quaternions,
        scales=scene.scales,
        importance=scene.importance,
    )


def group_metrics(subject, camera, *, footprint="solid_angle"):
    """Return the metrics of the groups of each instance, (G,) in px², which tolerances
    are compared with."""
    scene = Scene.of(subject)
    tables = [residency.table(bundle) for bundle in scene.bundles]
    rule = rule_of(0.0, None, 0, footprint, cull=False)
    metric, offset = _core.group_metrics(tables, instances_of(scene), camera.core, rule)
    return np.split(metric, offset[1:-1]) if len(scene) else []
