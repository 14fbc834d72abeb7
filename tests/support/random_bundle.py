"""Random small bundles with valid tables: trees and DAG-like groupings of any shape,
nested balls."""

import numpy as np

from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.gaussians import Gaussians


def random_gaussians(rng, count, sh_degree=0):
    """Return gaussians with values of about one; their appearance does not matter."""
    quats = rng.normal(size=(count, 4))
    quats /= np.maximum(np.linalg.norm(quats, axis=1, keepdims=True), 1e-9)
    return Gaussians(
        means=rng.normal(size=(count, 3)).astype(np.float32),
        quats=quats.astype(np.float32),
        scales=rng.uniform(0.01, 0.2, (count, 3)).astype(np.float32),
        opacities=rng.uniform(0, 1, count).astype(np.float32),
        sh=rng.normal(size=(count, (sh_degree + 1) ** 2, 3)).astype(np.float32),
    )


def random_links(rng, num_levels, max_fan=3):
    """Return own and parent group and level of clusters, and parent and level of
    groups, from the last level down."""
    # Each cluster of the last level is a pair (own, parent), numbered later.
    levels = [[(-1, -1)] * int(rng.integers(1, max_fan + 1))]
    groups = []  # for each level from the last one: (parent, number of clusters below)
    for _ in range(num_levels - 1):
        clusters, made = levels[-1], []
        owners = []
        for c, (_, parent) in enumerate(clusters):
            may_join = c > 0 and clusters[c - 1][1] == parent and rng.random() < 0.5
            if not may_join:
                made.append((parent, int(rng.integers(1, max_fan + 1))))
            owners.append(len(made) - 1)
        levels[-1] = [(own, parent) for own, (_, parent) in zip(owners, clusters, strict=True)]
        groups.append(made)
        levels.append([(-1, g) for g, (_, fan) in enumerate(made) for _ in range(fan)])
    levels.reverse()
    groups.reverse()
    first = np.concatenate([[0], np.cumsum([len(made) for made in groups])]).astype(int)

    # returns the index of group g among the groups that make `level`
    def number(g, level):
        return -1 if g < 0 else first[level - 1] + g

    rows = [
        (number(own, level), number(parent, level + 1), level)
        for level, clusters in enumerate(levels)
        for own, parent in clusters
    ]
    group_rows = [
        (number(parent, level + 1), level)
        for level, made in enumerate(groups, start=1)
        for parent, _ in made
    ]
    return np.array(rows, np.int32).reshape(-1, 3), np.array(group_rows, np.int32).reshape(-1, 2)


def random_groups(rng, parent, level):
    """Return balls and weights that nest as required, from the bottom up."""
    count = len(parent)
    ball = rng.normal(size=(count, 4)).astype(np.float32)
    ball[:, 3] = rng.uniform(1e-3, 1, count)
    weight = rng.uniform(0.001, 1, count).astype(np.float32)
    for g in range(count):  # groups are ordered by level, so those below are final
        above = parent[g]
        if above >= 0:
            distance = np.linalg.norm(ball[above, :3].astype(np.float64) - ball[g, :3])
            needed = np.float32((distance + np.float64(ball[g, 3])) * (1 + 4e-6))
            ball[above, 3] = max(ball[above, 3], np.nextafter(needed, np.float32(np.inf)))
            weight[above] = max(weight[above], weight[g])
    error = rng.uniform(0, 0.1, (count, 2)).astype(np.float32)
    return Groups(ball=ball, weight=weight, parent=parent, level=level, error=error)


def random_bundle(
    seed=0, *, num_levels=3, sh_degree=0, max_cluster=5, max_fan=3, config=None, codec="float32"
):
    """Return a valid bundle; clusters may be empty. ``num_levels`` 0 gives a bundle
    without clusters."""
    rng = np.random.default_rng(seed)
    if num_levels:
        links, group_links = random_links(rng, num_levels, max_fan)
    else:
        links, group_links = np.empty((0, 3), np.int32), np.empty((0, 2), np.int32)
    count = len(links)
    offset = np.concatenate([[0], np.cumsum(rng.integers(0, max_cluster + 1, count))]).astype(
        np.int64
    )
    gaussians = random_gaussians(rng, int(offset[-1]), sh_degree)
    box = np.zeros((count, 2, 3), np.float32)
    for c in range(count):
        means = gaussians.means[offset[c] : offset[c + 1]]
        if len(means):
            box[c] = means.min(0) - 0.6, means.max(0) + 0.6
    clusters = Clusters(
        offset=offset,
        level=np.ascontiguousarray(links[:, 2]),
        own_group=np.ascontiguousarray(links[:, 0]),
        parent_group=np.ascontiguousarray(links[:, 1]),
        box=box,
        filter_px2=rng.choice(np.array([0, 0.1, 0.3], np.float32), count),
        antialiased=rng.integers(0, 2, count).astype(np.uint8),
    )
    parent, level = (np.ascontiguousarray(column) for column in group_links.T)
    return Bundle(clusters, random_groups(rng, parent, level), gaussians, config, codec)
