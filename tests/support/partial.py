"""Scenes with only some resident pages, as inputs of the core's functions."""

import numpy as np

from v3dg import _core, _device
from v3dg.select import rule_of

ABSENT = np.iinfo(np.int64).min
ARRIVAL_FRAMES = 8  # frames over which a page fades in
NEVER, LONG_AGO = np.iinfo(np.int32).max, -ARRIVAL_FRAMES


def closed_residency(rng, bundle, share=None):
    """Return (P,) whether each page is resident: the last one, and others together with
    the pages above them."""
    share = rng.choice([0.0, 0.5, 0.8, 0.95, 1.0]) if share is None else share
    parent = bundle.groups.parent
    there = np.append(rng.random(len(parent)) < share, True)
    for g in range(len(parent) - 1, -1, -1):  # parents have larger indices
        there[g] &= there[parent[g]]
    return there


def page_rows(bundle):
    """Return (P,) the first gaussian of each page and their number; 0 and 0 for a
    bundle without clusters."""
    first = [bundle.clusters.offset[bundle.page_range(p).start] for p in range(bundle.num_pages)]
    ends = [bundle.clusters.offset[bundle.page_range(p).stop] for p in range(bundle.num_pages)]
    if not first:
        return np.zeros(1, np.int64), np.zeros(1, np.int64)
    return np.array(first), np.array(ends) - first


def random_shift(rng, bundle, there):
    """Return (P,) the shift in rows of each page, in random order, and the number of
    rows."""
    first, count = page_rows(bundle)
    shift = np.full(len(first), ABSENT)
    row = 0
    for page in rng.permutation(np.flatnonzero(there)):
        row += int(rng.integers(0, 9))
        shift[page] = row - first[page]
        row += int(count[page])
    return shift, row


def random_begins(rng, bundle):
    """Return (P,) the frames after which pages fade in, none before the page above it,
    and a frame in which some fade."""
    parent = bundle.groups.parent
    begins = np.full(len(parent) + 1, LONG_AGO, np.int32)
    for g in range(len(parent) - 1, -1, -1):  # parents have larger indices
        above = int(begins[parent[g]])
        if above == NEVER or rng.random() < 0.05:
            begins[g] = NEVER
        elif above >= 0 or rng.random() < 0.3:
            begins[g] = above + ARRIVAL_FRAMES + rng.integers(0, 4)
    known = begins[(begins >= 0) & (begins < NEVER)]
    return begins, int(rng.choice(known) if len(known) else 0) + int(
        rng.integers(1, ARRIVAL_FRAMES)
    )


def arrived(begins, frame):
    """Return (P,) how far pages have faded in, 0 to 1."""
    return np.clip(frame - begins.astype(np.int64), 0, ARRIVAL_FRAMES) / ARRIVAL_FRAMES


def table_of(bundle, shift=None, begins=None):
    """Return the core's table of a bundle with these page shifts."""
    groups = {name: getattr(bundle.groups, name) for name in ("ball", "weight", "level")}
    return _core.ClusterTable(
        **(vars(bundle.clusters) | groups), page_shift=shift, page_begins=begins
    )


def resident_scene(scene, shifts, device="cpu", begins=None):
    """Return the core's scene of bundles with these page shifts and fades."""
    core = _core.ResidentScene(_device.resolve(device).number)
    pages = zip(scene.bundles, shifts, begins or [None] * len(shifts), strict=True)
    core.set_bundles([table_of(*of_bundle) for of_bundle in pages])
    poses = scene.positions, scene.quaternions, scene.scales
    core.set_instances(scene.instance_bundle, scene.importance, *poses)
    return core


def rule(tolerance=None, budget=None, min_level=0, fade=None, *, cull=True, frame=0):
    checked = rule_of(tolerance, budget, min_level, cull=cull, fade=fade)
    return _core.Rule(
        tolerance_px2=checked.tolerance_px2,
        budget=budget,
        min_level=min_level,
        footprint="solid_angle",
        culls=cull,
        fade=fade or 1.0,
        frame=frame,
    )
