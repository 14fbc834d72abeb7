"""A hierarchy of single gaussians as a baseline: Kerbl et al., A Hierarchical 3D
Gaussian Representation.

Written from the paper (SIGGRAPH 2024), without its optimisation against photographs,
which these assets do not have. A binary tree by median splits, down to single
gaussians. An inner node merges its two children by their moments, weighted by opacity
times surface. A node is drawn if its size on screen is at most the target and its
parent's is not; it is interpolated towards its parent, so that nothing jumps.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from benchmarks.evaluation.measure import like
from v3dg import _core, _device
from v3dg.cameras import Camera
from v3dg.gaussians import Gaussians
from v3dg.rotations import rotation_from_quaternion
from v3dg.scene import Scene

Ids = npt.NDArray[np.int64]

_SIZES_AT_ONCE = 1 << 25  # (instance, node) pairs
_MOST_ALPHA = 0.999
_LEAST_STEP_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """M nodes, level by level from the root, on the host.

    Attributes:
        gaussians: The gaussian of each node; opacities of inner nodes may exceed 1, as
            in the paper.
        parent: (M,) the node above; the root is its own parent.
        num_siblings: (M,) children of the parent, the node itself included.
        box: (M, 2, 3) box around the visible extent of the leaves below.
        num_leaves: Number of the asset's gaussians, which are the last nodes.
    """

    gaussians: Gaussians
    parent: Ids
    num_siblings: Ids
    box: npt.NDArray[np.float32]
    num_leaves: int


def build_hierarchy(asset: Gaussians) -> Hierarchy:
    """Build the tree of one asset, given as NumPy arrays."""
    count = len(asset)
    order, offset = _core.median_split(
        asset.means, np.array([0, count]), _core.num_halvings(count, 1)
    )
    depth = (len(offset) - 1).bit_length() - 1
    leaves = asset.subset(order)
    levels = [leaves]
    boxes = [_core.bound_by_boxes(leaves.rows, np.arange(len(leaves) + 1))]
    # Some of the segments after the last split are empty; above it, every node has two
    # children.
    parents = [np.repeat(np.arange(len(offset) - 1), np.diff(offset)) // 2]
    for k in range(depth - 1, -1, -1):
        first_child = offset[::2].copy() if k == depth - 1 else 2 * np.arange(2**k + 1)
        levels.append(_merge(levels[-1], first_child))
        low, high = boxes[-1].swapaxes(0, 1)
        starts = first_child[:-1]
        boxes.append(
            np.stack([np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)], 1)
        )
        parents.append(np.arange(2**k) // 2)
    first = np.concatenate([[0], np.cumsum([len(level) for level in reversed(levels)])])
    parent = np.concatenate(
        [p + first[max(k - 1, 0)] for k, p in enumerate(reversed(parents))], dtype=np.int64
    )
    nodes = Gaussians.concatenate(levels[::-1])
    for k in range(1, depth + 1):
        _match_axes(nodes, slice(int(first[k]), int(first[k + 1])), parent)
    siblings = np.bincount(parent[1:], minlength=len(parent))[parent]
    return Hierarchy(
        nodes, parent, np.maximum(siblings, 1), np.concatenate(boxes[::-1]), len(leaves)
    )


def _merge(children: Gaussians, first_child: Ids) -> Gaussians:
    """Join segments of one or two gaussians by their moments; opacity times surface is
    preserved, even beyond opacity 1."""
    merged = Gaussians(*_core.merge(children.rows, first_child, np.arange(len(first_child))))
    weight = np.add.reduceat(children.opacities * _surface(children.scales), first_child[:-1])
    opacities = weight / np.maximum(_surface(merged.scales), np.float32(1e-30))
    return Gaussians(merged.means, merged.quats, merged.scales, opacities, merged.sh)


def _surface(scales: Any) -> Any:
    """Return the surface area of ellipsoids over 4 pi, after Thomsen, within 1.1 %."""
    p = 1.6075
    x, y, z = (scales**p).T
    return ((x * y + x * z + y * z) / 3) ** (1 / p)


# The 24 rotations that map axes to axes, as quaternions, and the permutation of axes of
# each.
_TURNS = np.array(
    [
        np.array(q) / np.linalg.norm(q)
        for q in itertools.product((-1, 0, 1), repeat=4)
        if np.count_nonzero(q) in (1, 2, 4) and next(x for x in q if x) > 0
    ]
)
_AXIS_AT = np.abs(rotation_from_quaternion(_TURNS)).argmax(axis=1)  # (24, 3)


def _match_axes(nodes: Gaussians, level: slice, parent: Ids) -> None:
    """Permute the axes of a level's gaussians so that their rotations are closest to
    their parents'."""
    child = nodes.quats[level] / np.linalg.norm(nodes.quats[level], axis=1, keepdims=True)
    above = nodes.quats[parent[level]]
    back = child * [1, -1, -1, -1]
    agreement = _product(back, above) @ _TURNS.T
    best = np.abs(agreement).argmax(axis=1)
    sign = np.where(np.take_along_axis(agreement, best[:, None], 1) < 0, -1, 1)
    nodes.quats[level] = sign * _product(child, _TURNS[best])
    nodes.scales[level] = np.take_along_axis(nodes.scales[level], _AXIS_AT[best], 1)


def _product(a: Any, b: Any) -> Any:
    aw, ax, ay, az = a.T
    bw, bx, by, bz = b.T
    return np.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=1,
    )


class HierarchyScene:
    """One hierarchy in all instances of a scene, on a device."""

    def __init__(self, hierarchy: Hierarchy, scene: Scene, device: str) -> None:
        self.scene, self._device = scene, _device.resolve(device)
        self._nodes = _device.place(hierarchy.gaussians, self._device)
        self._library: Any = _device.library_of(self._nodes.means)
        self._box = self._place(hierarchy.box)
        self._extent = self._library.amax(self._box[:, 1] - self._box[:, 0], 1)
        self._siblings = self._place(hierarchy.num_siblings)
        self._parent = self._library.asarray(hierarchy.parent)
        if self._device.is_cuda:
            self._parent = self._parent.to(str(self._device))
        self._first_leaf = len(hierarchy.parent) - hierarchy.num_leaves

    def _place(self, values: Any) -> Any:
        return like(values, self._nodes.means)

    def cut(self, camera: Camera, target_px: float) -> tuple[Any, Any, Any]:
        """Return instances, nodes, and the interpolation of each towards its parent,
        for nodes of at most this size."""
        scene = self.scene
        eyes = (
            np.einsum("ij,ijk->ik", camera.position - scene.positions, scene.rotations)
            / scene.scales[:, None]
        )
        at_once = max(1, _SIZES_AT_ONCE // len(self._extent))
        parts = [
            self._cut_some(self._place(eyes[i : i + at_once]), camera.fx, target_px, i)
            for i in range(0, len(eyes), at_once)
        ]
        instance, node, way = (self._library.concatenate(p) for p in zip(*parts, strict=True))
        return instance, node, way

    def _cut_some(
        self, eyes: Any, focal: float, target_px: float, first: int
    ) -> tuple[Any, Any, Any]:
        low, high = self._box[:, 0], self._box[:, 1]
        square = 0.0
        for axis in range(3):
            eye = eyes[:, axis, None]
            square = square + ((low[:, axis] - eye).clip(0) + (eye - high[:, axis]).clip(0)) ** 2
        size = focal * self._extent / (square**0.5 + 1e-30)  # of the nearest point of the box, px
        fits = size <= target_px
        fits[:, self._first_leaf :] = True
        above = fits[:, self._parent]
        above[:, 0] = False
        instance, node = self._library.where(fits & ~above)
        own = size[instance, node]
        parents = size[instance, self._parent[node]]
        way = ((target_px - own) / (parents - own).clip(_LEAST_STEP_PX)).clip(0, 1)
        way[node == 0] = 0
        return instance + first, node, way

    def gaussians(self, cut: tuple[Any, Any, Any]) -> Gaussians:
        """Return the nodes of a cut in the world, interpolated towards their
        parents."""
        instance, node, way = cut
        own, above = self._gather(instance, node), self._gather(instance, self._parent[node])
        # This opacity makes siblings that are drawn over each other as their parent
        # cover together what it covers.
        shared = 1 - (1 - above.opacities.clip(0, _MOST_ALPHA)) ** (1 / self._siblings[node])
        to = way[:, None]
        return Gaussians(
            own.means + to * (above.means - own.means),
            own.quats + to * (above.quats - own.quats),
            own.scales + to * (above.scales - own.scales),
            own.opacities + way * (shared - own.opacities),
            own.sh + to[..., None] * (above.sh - own.sh),
        )

    def _gather(self, instance: Any, rows: Any) -> Gaussians:
        scene = self.scene
        gathered = _core.gather(
            bundles=[self._nodes.rows],
            instances=_core.Instances(
                bundle=np.zeros(len(scene), np.int32),
                positions=scene.positions,
                quaternions=scene.quaternions,
                scales=scene.scales,
                importance=scene.importance,
            ),
            instance=_device.to_host(instance).astype(np.int32),
            first_row=_device.to_host(rows).astype(np.int64),
            offset=np.arange(len(instance) + 1),
            device=self._device.number,
        )
        return Gaussians(*gathered)
