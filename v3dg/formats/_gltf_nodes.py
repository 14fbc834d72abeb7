"""Finds the meshes of a glTF file's scene, and the transforms of the nodes that place
them.

Source: glTF 2.0, sections 3.5.2 (node hierarchy) and 3.5.3 (transformations);
KHR_gaussian_splatting, Dependencies on glTF (allowed transforms).
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from v3dg._json import Node
from v3dg._numbers import Floats
from v3dg.formats._gltf_document import Document, name_text
from v3dg.formats._packing import assemble
from v3dg.gaussians import Gaussians
from v3dg.rotations import (
    normalised,
    quaternion_from_rotation,
    quaternions_from_rotations,
    rotation_from_quaternion,
)

_INSTANCING = "EXT_mesh_gpu_instancing"
_PARTS = ("translation", "rotation", "scale")
# Largest difference of a rotation's determinant from 1, and largest relative difference
# of scales that count as equal. Matrices come from float32.
_MOST_SHEAR = 1e-4
_MOST_SPREAD = 1e-5


@dataclass(frozen=True, eq=False)
class Placement:
    """A mesh, and the (4, 4) matrix from mesh to scene coordinates; None for the
    identity.

    Attributes:
        node: The node that places the mesh, or the mesh itself if there are no nodes.
    """

    mesh: int
    matrix: Floats | None
    node: Node


def placements(document: Document) -> tuple[list[Placement], list[str]]:
    """Return the placements of the default scene's meshes, in the order of its nodes,
    and notes about other scenes."""
    meshes = range(len(document.array("meshes")))
    if document.array("scenes"):
        number = 0
        if document.root.has("scene"):
            number = document.index("scenes", document.root.field("scene"))
        scene = document.item("scenes", number)
        roots: list[int] = []
        if scene.has("nodes"):
            roots = [document.index("nodes", item) for item in scene.field("nodes").items()]
        return list(_walk(document, roots)), _scene_notes(document, number)
    if document.array("nodes"):
        return list(_walk(document, _roots(document))), []
    return [Placement(mesh, None, document.item("meshes", mesh)) for mesh in meshes], []


def _scene_notes(document: Document, number: int) -> list[str]:
    """Return a note if there are other scenes, which are ignored."""
    count = len(document.array("scenes"))
    if count == 1:
        return []
    scene = document.item("scenes", number)
    name = ""
    if scene.has("name") and isinstance(scene.field("name").value, str):
        name = f" ({name_text(scene.field('name').value)})"
    return [f"Scene {number} of {count}{name} is read, and the others are ignored."]


def _roots(document: Document) -> list[int]:
    """Return the nodes that have no parent."""
    is_child = np.zeros(len(document.array("nodes")), bool)
    for index in range(len(is_child)):
        for child in _children(document, document.item("nodes", index)):
            is_child[child] = True
    return [int(root) for root in np.flatnonzero(~is_child)]


def _children(document: Document, node: Node) -> list[int]:
    if not node.has("children"):
        return []
    return [document.index("nodes", item) for item in node.field("children").items()]


def _walk(document: Document, roots: list[int]) -> Iterator[Placement]:
    """Yield the meshes of nodes and their descendants. Each node is visited at most
    once, so that time and memory are bounded by the size of the document."""
    is_met = np.zeros(len(document.array("nodes")), bool)
    stack: list[tuple[int, Floats | None]] = [(root, None) for root in reversed(roots)]
    while stack:
        index, parent = stack.pop()
        node = document.item("nodes", index)
        if is_met[index]:
            raise node.problem("expected at most one parent and no cycle, got a second parent")
        is_met[index] = True
        matrix = _product(parent, _local_matrix(node))
        if node.has("mesh"):
            if node.has("extensions") and node.field("extensions").has(_INSTANCING):
                raise node.problem(
                    f"expected one mesh, got {_INSTANCING}, which this reader does not support"
                )
            yield Placement(document.index("meshes", node.field("mesh")), matrix, node)
        stack += [(child, matrix) for child in reversed(_children(document, node))]


def _product(parent: Floats | None, local: Floats | None) -> Floats | None:
    if parent is None:
        return local
    if local is None:
        return parent
    with np.errstate(over="ignore", invalid="ignore"):  # checked in `placed`
        return np.asarray(parent @ local)


def _local_matrix(node: Node) -> Floats | None:
    """Return the transform of a node as a (4, 4) matrix; None for the identity."""
    parts = [name for name in _PARTS if node.has(name)]
    if node.has("matrix"):
        if parts:
            raise node.problem(f"expected a matrix or {parts[0]}, got both")
        matrix = np.array(node.field("matrix").vector(16)).reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1), rtol=0, atol=1e-6):
            last = " ".join(f"{value:g}" for value in matrix[3])
            raise node.problem(f"expected a matrix with the last row 0 0 0 1, got {last}")
    else:
        matrix = np.eye(4)
        if node.has("rotation"):
            matrix[:3, :3] = _rotation_of(node.field("rotation"))
        if node.has("scale"):
            matrix[:3, :3] *= node.field("scale").vector(3)
        if node.has("translation"):
            matrix[:3, 3] = node.field("translation").vector(3)
    if np.array_equal(matrix, np.eye(4)):
        return None
    return np.asarray(matrix)


def _rotation_of(node: Node) -> Floats:
    """Return the (3, 3) matrix of a quaternion x y z w."""
    x, y, z, w = node.vector(4)
    quaternion = np.array([w, x, y, z])
    if not quaternion.any():
        raise node.error("a quaternion of length 1")
    return rotation_from_quaternion(normalised(quaternion))


def placed(gaussians: Gaussians, placement: Placement) -> Gaussians:
    """Return the gaussians of a mesh in scene coordinates. A transform other than a
    rotation, a translation and positive scales is a ValueError that names the node."""
    matrix = placement.matrix
    if matrix is None:
        return gaussians
    with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
        lengths = np.linalg.norm(matrix[:3, :3], axis=0)
        rotation = matrix[:3, :3] / lengths
        determinant = float(np.linalg.det(rotation))
    expected = "expected a rotation, a translation and positive scales"
    if not (np.isfinite(matrix).all() and (lengths > 0).all() and np.isfinite(lengths).all()):
        raise placement.node.problem(
            f"{expected}, got a scale of 0 or a number that overflows; correct the node"
        )
    if determinant < 0:
        raise placement.node.problem(f"{expected}, got a reflection; apply it to the file first")
    if not abs(determinant - 1) <= _MOST_SHEAR:
        raise placement.node.problem(f"{expected}, got a shear; apply it to the file first")
    scale = float(np.cbrt(lengths.prod()))
    if lengths.max() > lengths.min() * (1 + _MOST_SPREAD):
        gaussians = _stretched(gaussians, lengths)
        scale = 1.0
    return gaussians.transform(quaternion_from_rotation(rotation), matrix[:3, 3], scale)


def _stretched(gaussians: Gaussians, factors: Floats) -> Gaussians:
    """Return gaussians after scaling space by a factor along each axis; colours stay
    the same.

    The new scales are the singular values of the scaled axes of each gaussian.

    Source: KHR_gaussian_splatting, Splat Reconstruction.
    """

    def decode(rows: slice) -> tuple[Floats, ...]:
        means = gaussians.means[rows].astype(np.float64) * factors
        quats = gaussians.quats[rows].astype(np.float64)
        scales = gaussians.scales[rows].astype(np.float64)
        axes = rotation_from_quaternion(normalised(quats)) * scales[:, None, :]
        axes *= factors[:, None]
        # Gaussians whose values are not finite cannot be drawn. They are not changed.
        is_good = np.isfinite(axes).all(axis=(1, 2))
        rotations, lengths, _ = np.linalg.svd(axes[is_good])
        rotations[:, :, 2] *= np.sign(np.linalg.det(rotations))[:, None]
        quats[is_good] = quaternions_from_rotations(rotations)
        scales[is_good] = lengths
        return means, quats, scales, gaussians.opacities[rows], gaussians.sh[rows]

    stretched = assemble(len(gaussians), gaussians.sh_degree, decode)
    return stretched.trained(antialiased=gaussians.antialiased)
