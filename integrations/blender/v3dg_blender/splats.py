"""Data blocks that contain the gaussians of a cut.

Blender 5.3 and later draw point clouds of the type GAUSSIAN_SPLAT. Their attributes,
as Blender's own import of .ply files makes them:

    position       FLOAT_VECTOR  mean
    rotation       QUATERNION    w x y z
    scale          FLOAT_VECTOR  standard deviations
    radiance:base  FLOAT4        SH coefficients of degree 0, opacity from 0 to 1
    radiance:sh_k  FLOAT_VECTOR  SH coefficient k + 1 of red, green and blue

Blender evaluates SH in the frame of the object, adds 1/2, and takes the result as sRGB,
which it converts to the linear colours of a render. Earlier versions have none of this.
For them, a cut is a mesh of points, at which a node group draws ellipsoids.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import bpy
import numpy as np

from . import ellipsoids
from .cuts import Cut, gaussians_of

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    import v3dg

    Floats = npt.NDArray[np.float32]

SH_C0 = 0.28209479177387814
"""SH basis function of degree 0."""

CUT = "v3dg_cut"
"""Custom property of a data block: the digest of its cut."""

EMPTY = "nothing in view"
"""Digest of the data block of an object that shows nothing."""


def has_splats() -> bool:
    """Return whether this version of Blender draws splats itself."""
    kind = bpy.types.PointCloud.bl_rna.properties.get("type")
    return kind is not None and "GAUSSIAN_SPLAT" in kind.enum_items


def data_blocks() -> dict[str, bpy.types.ID]:
    """Return the data blocks of cuts in the file, by digest."""
    blocks = bpy.data.meshes
    if has_splats():
        blocks = bpy.data.pointclouds
    return {block[CUT]: block for block in blocks if CUT in block and not block.library}


def ensure_blocks(cuts: Iterable[Cut]) -> dict[str, bpy.types.ID]:
    """Return a data block for each cut, by digest, and an empty one for `EMPTY`. Blocks
    that the file already has are reused."""
    blocks = data_blocks()
    missing = [cut for cut in cuts if cut.digest not in blocks]
    for cut, gaussians in zip(missing, gaussians_of(missing), strict=True):
        blocks[cut.digest] = _new_block(gaussians, cut.digest)
    if EMPTY not in blocks:
        blocks[EMPTY] = _new_block(None, EMPTY)
    return blocks


def drop_unused() -> None:
    """Remove the data blocks of cuts that no object shows."""
    unused = [block for block in data_blocks().values() if block.users == 0]
    bpy.data.batch_remove(unused)


def _new_block(gaussians: v3dg.Gaussians | None, digest: str) -> bpy.types.ID:
    count = 0
    if gaussians is not None:
        count = len(gaussians)
    name = f"v3dg cut of {count}"
    if has_splats():
        block = bpy.data.pointclouds.new(name)
        block.type = "GAUSSIAN_SPLAT"
        block.resize(count)
    else:
        block = bpy.data.meshes.new(name)
        block.vertices.add(count)
        block.materials.append(ellipsoids.material())
    block[CUT] = digest
    if gaussians is not None:
        _fill(block, gaussians)
    return block


def _fill(block: bpy.types.ID, gaussians: v3dg.Gaussians) -> None:
    sh = np.asarray(gaussians.sh, np.float32)
    opacities = np.asarray(gaussians.opacities, np.float32)[:, None]
    _write(block, "position", "FLOAT_VECTOR", np.asarray(gaussians.means, np.float32))
    quats = np.asarray(gaussians.quats, np.float32)
    # Blender does not normalise quaternions.
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    _write(block, "rotation", "QUATERNION", quats)
    _write(block, "scale", "FLOAT_VECTOR", np.asarray(gaussians.scales, np.float32))
    if has_splats():
        _write(block, "radiance:base", "FLOAT4", np.concatenate([sh[:, 0], opacities], axis=1))
        for number in range(1, sh.shape[1]):
            _write(block, f"radiance:sh_{number - 1}", "FLOAT_VECTOR", sh[:, number])
    else:
        colors = linear_of_srgb(sh[:, 0] * SH_C0 + 0.5)
        _write(block, "radiance", "FLOAT_COLOR", np.concatenate([colors, opacities], axis=1))
    block.update_tag()


# The property of an element that has its value, by the type of the attribute.
_VALUES = {
    "FLOAT_VECTOR": "vector",
    "QUATERNION": "value",
    "FLOAT4": "vector",
    "FLOAT_COLOR": "color",
}


def _write(block: bpy.types.ID, name: str, kind: str, values: Floats) -> None:
    attribute = block.attributes.get(name)
    if attribute is None:
        attribute = block.attributes.new(name, kind, "POINT")
    attribute.data.foreach_set(_VALUES[kind], np.ascontiguousarray(values, np.float32).ravel())


def linear_of_srgb(colors: Floats) -> Floats:
    """Return the linear values of sRGB colours, clamped at 0 (IEC 61966-2-1)."""
    clamped = np.maximum(colors, 0)
    curve = ((clamped + 0.055) / 1.055) ** 2.4
    return np.where(clamped <= 0.04045, clamped / 12.92, curve).astype(np.float32)
