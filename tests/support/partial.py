"""Scenes of which only some pages are resident, as the core's functions take them."""

import numpy as np

from v3dg import _core, _device
from v3dg.select import rule_of

ABSENT = np.iinfo(np.int64).min


def closed_residency(rng, bundle, share=None):
    """(P,) whether each page is there: the last one, and others together with the pages above them."""
    share = rng.choice([0.0, 0.5, 0.8, 0.95, 1.0]) if share is None else share
    parent = bundle.groups.parent
    there = np.append(rng.random(len(parent)) < share, True)
    for g in range(len(parent) - 1, -1, -1):  # parents come later
        there[g] &= there[parent[g]]
    return there


def page_rows(bundle):
    """(P,) of each page the first gaussian and their number; of a bundle without clusters 0 and 0."""
    first = [bundle.clusters.offset[bundle.page_range(p).start] for p in range(bundle.num_pages)]
    ends = [bundle.clusters.offset[bundle.page_range(p).stop] for p in range(bundle.num_pages)]
    if not first:
        return np.zeros(1, np.int64), np.zeros(1, np.int64)
    return np.array(first), np.array(ends) - first


def random_shift(rng, bundle, there):
    """(P,) by how many rows the pages lie behind their place, in any order, and how many rows there are."""
    first, count = page_rows(bundle)
    shift = np.full(len(first), ABSENT)
    row = 0
    for page in rng.permutation(np.flatnonzero(there)):
        row += int(rng.integers(0, 9))
        shift[page] = row - first[page]
        row += int(count[page])
    return shift, row


def table_of(bundle, shift=None):
    """The core's table of a bundle with pages at their places."""
    groups = {name: getattr(bundle.groups, name) for name in ("ball", "weight", "level")}
    return _core.ClusterTable(**(vars(bundle.clusters) | groups), page_shift=shift)


def resident_scene(scene, shifts, device="cpu"):
    """The core's scene of bundles whose pages are at these places."""
    core = _core.ResidentScene(_device.resolve(device).number)
    core.set_bundles([table_of(bundle, shift) for bundle, shift in zip(scene.bundles, shifts, strict=True)])
    poses = scene.positions, scene.quaternions, scene.scales
    core.set_instances(scene.instance_bundle, scene.importance, *poses)
    return core


def rule(tolerance=None, budget=None, min_level=0, fade=None, *, cull=True):
    return rule_of(tolerance, budget, min_level, cull=cull, fade=fade)
