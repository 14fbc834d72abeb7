"""A hierarchy of single gaussians as a baseline, after Kerbl et al., A Hierarchical 3D
Gaussian Representation (SIGGRAPH 2024).

This implementation follows the paper. It omits the optimisation against photographs,
because the benchmark's assets have no photographs. The hierarchy is a binary tree that
is built by median splits, down to single gaussians. An inner node merges its two
children by their moments, with weights of opacity times surface. A node is drawn if its
size on screen is at most the target size and its parent's size is larger. Drawn nodes
are interpolated towards their parents, so that pictures change continuously.
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

_SIZES_AT_ONCE = 1 << 25  # number of (instance, node) pairs that are processed together
_MOST_ALPHA = 0.999
_LEAST_STEP_PX = 1e-6


@dataclass(frozen=True, eq=False)
class Hierarchy:
    """M nodes of a hierarchy on the host, level by level from the root.

    Attributes:
        gaussians: The gaussian of each node; opacities of inner nodes may exceed 1, as
            in the paper.
        parent: (M,) index of each node's parent; the root is its own parent.
        num_siblings: (M,) number of children of the node's parent, including the node.
        box: (M, 2, 3) box around the visible extent of the leaves below a node.
        num_leaves: Number of gaussians of the asset. These are the last nodes.
    """

    gaussians: Gaussians
    parent: Ids
    num_siblings: Ids
    box: npt.NDArray[np.float32]
    num_leaves: int


def build_hierarchy(asset: Gaussians) -> Hierarchy:
    """Build the tree of one asset, whose arrays are NumPy arrays."""
    count = len(asset)
    order, offset = _core.median_split(
        asset.means, np.array([0, count]), _core.num_halvings(count, 1)
    )
    depth = (len(offset) - 1).bit_length() - 1
    leaves = asset.subset(order)
    levels = [leaves]
    boxes = [_core.bound_by_boxes(leaves.rows, np.arange(len(leaves) + 1))]
    # Some segments of the last split may be empty; on all levels above, every node has
    # two children.
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
    """Merge segments of one or two gaussians by their moments. Opacity times surface is
    preserved, so merged opacities may exceed 1."""
    merged = Gaussians(*_core.merge(children.rows, first_child, np.arange(len(first_child))))
    weight = np.add.reduceat(children.opacities * _surface(children.scales), first_child[:-1])
    opacities = weight / np.maximum(_surface(merged.scales), np.float32(1e-30))
    return Gaussians(merged.means, merged.quats, merged.scales, opacities, merged.sh)


def _surface(scales: Any) -> Any:
    """Return the surface area of ellipsoids divided by 4 pi, by Thomsen's formula, with
    an error of at most 1.1 %."""
    p = 1.6075
    x, y, z = (scales**p).T
    return ((x * y + x * z + y * z) / 3) ** (1 / p)


# The 24 rotations that map coordinate axes to coordinate axes, as quaternions;
# `_AXIS_AT` has the permutation of axes of each rotation.
_TURNS = np.array(
    [
        np.array(q) / np.linalg.norm(q)
        for q in itertools.product((-1, 0, 1), repeat=4)
        if np.count_nonzero(q) in (1, 2, 4) and next(x for x in q if x) > 0
    ]
)
_AXIS_AT = np.abs(rotation_from_quaternion(_TURNS)).argmax(axis=1)  # (24, 3)


def _match_axes(nodes: Gaussians, level: slice, parent: Ids) -> None:
    """Permute the axes of a level's gaussians such that their rotations are as close as
    possible to the rotations of their parents."""
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
    """The instances of a scene on a device, each drawn from one hierarchy."""

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
        """Select nodes whose size is at most the target and whose parent's size exceeds
        it.

        Returns:
            Indices of instances and of nodes, and each node's interpolation weight
            towards its parent, 0 to 1.
        """
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
        # Size in px, at the nearest point of the box.
        size = focal * self._extent / (square**0.5 + 1e-30)
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
        """Return the gaussians of a cut in world space, interpolated towards their
        parents."""
        instance, node, way = cut
        own, above = self._gather(instance, node), self._gather(instance, self._parent[node])
        # Siblings with this opacity that are drawn over each other together cover as
        # much as their parent does alone.
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
