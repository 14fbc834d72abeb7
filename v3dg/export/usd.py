"""Exports scenes and bundles as OpenUSD: the levels of detail with UsdLod, and
instances as a PointInstancer."""

import math
import os
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from v3dg import _files
from v3dg._numbers import check, one_of
from v3dg.bundle import Bundle
from v3dg.cameras import Axis
from v3dg.export import _common
from v3dg.formats import usd
from v3dg.formats._packing import check_writable
from v3dg.opening import File, opened
from v3dg.rotations import quaternion_from_rotation
from v3dg.scene import Scene
from v3dg.select import DEFAULT_TOLERANCE
from v3dg.upright import up_of

if TYPE_CHECKING:
    from pxr import Usd

# Pixels of the picture for which levels have the default tolerance.
_PIXELS = 1920 * 1080
_LEAST = 1e-30  # smallest distance, to avoid a division by 0
_INSTANCES = "/world/instances"


def write_usd(
    subject: Scene | Bundle | File, path: str | os.PathLike[str], *, up: Axis | None = None
) -> int:
    """Write a scene or a bundle as OpenUSD, and return the size of the file in bytes.
    Needs the extra `usd`.

    Each bundle is a prim with UsdLod's LODRootAPI. Its children are the levels, finest
    first, as ParticleField3DGaussianSplat. A level is replaced by the next coarser one
    at the distance at which half of the groups that make the coarser level fall below
    the default tolerance, in a picture of 1920 x 1080 px. A scene is a PointInstancer
    of such prims. Positions are float32. Importance, opacity and tint of instances are
    left out, the latter two with a warning.

    Args:
        subject: A scene or a bundle, or the path of its file.
        path: File to write, .usd, .usda, .usdc or .usdz.
        up: The axis that points up in the world, which is rotated to z; None uses the
            axis of `v3dg.upright.up_of`.

    Raises:
        ImportError: usd-core is not installed.
        ValueError: The suffix is unknown, there is nothing to export, or a gaussian has
            invalid values.
        OSError: The file cannot be written.

    Source: Pixar, OpenUSD 26.11, UsdVol and UsdLod.
    """
    one_of(Path(path).suffix.lower(), "path", usd.SUFFIXES)
    _files.make_folder(Path(path))
    content = opened(subject)
    pxr = usd.pxr()
    scene = Scene.of(content)
    scene = _common.exported(scene, "OpenUSD")
    check("scene", len(scene), "at least one instance to export, got none; add an instance")
    stage = usd.new_stage("Z")
    world = pxr.UsdGeom.Xform.Define(stage, "/world")
    stage.SetDefaultPrim(world.GetPrim())
    w, *xyz = quaternion_from_rotation(_common.rotation_to(up or up_of(content)[0], "z"))
    world.AddOrientOp().Set(pxr.Gf.Quatf(w, *xyz))
    names = _common.distinct(pxr.Tf.MakeValidIdentifier(name) for name in _common.names_of(scene))
    if isinstance(content, Scene):
        places = [f"{_INSTANCES}/{name}" for name in names]
        _define_instances(stage, places, scene)
    else:
        places = [f"/world/{name}" for name in names]
    for place, bundle in zip(places, scene.bundles, strict=True):
        _define_levels(stage, place, bundle)
    usd.export(stage, path)
    return os.stat(path).st_size


def _define_instances(stage: "Usd.Stage", prototypes: list[str], scene: Scene) -> None:
    pxr = usd.pxr()
    vectors = pxr.Vt.Vec3fArray.FromNumpy
    quaternions = np.roll(scene.quaternions, -1, axis=1).astype(np.float32)  # x y z w
    scales = np.repeat(scene.scales[:, None], 3, axis=1).astype(np.float32)
    instancer = pxr.UsdGeom.PointInstancer.Define(stage, _INSTANCES)
    instancer.CreatePrototypesRel().SetTargets(prototypes)
    instancer.CreateProtoIndicesAttr(pxr.Vt.IntArray.FromNumpy(scene.instance_bundle))
    instancer.CreatePositionsAttr(vectors(scene.positions.astype(np.float32)))
    instancer.CreateOrientationsfAttr(pxr.Vt.QuatfArray.FromNumpy(quaternions))
    instancer.CreateScalesAttr(vectors(scales))


def _define_levels(stage: "Usd.Stage", place: str, bundle: Bundle) -> None:
    pxr = usd.pxr()
    root = pxr.UsdGeom.Xform.Define(stage, place).GetPrim()
    for level in range(bundle.num_levels):
        usd.define(stage, f"{place}/level_{level}", check_writable(bundle.level_gaussians(level)))
    if bundle.num_levels < 2:
        return
    low = bundle.clusters.box[:, 0].min(axis=0)
    high = bundle.clusters.box[:, 1].max(axis=0)
    radius = float(np.linalg.norm(high - low)) / 2
    detail = _common.detail_of(bundle)
    # The fraction of the picture that the ball around the box covers at the distance at
    # which level 1 becomes fine enough.
    share = math.pi * DEFAULT_TOLERANCE / _PIXELS * (radius / max(detail["reach"], _LEAST)) ** 2
    sizes = [share / detail["ratio"] ** (2 * level) for level in range(bundle.num_levels - 1)]
    heuristic = pxr.UsdLod.ScreenSizeHeuristic.Define(stage, f"/lod{place.replace('/', '_')}")
    heuristic.CreateThresholdsAttr(sizes)
    heuristic.CreateExtentAttr(pxr.Vt.Vec3fArray.FromNumpy(np.array([low, high], np.float32)))
    heuristic.CreateLodDomainAttr(pxr.UsdLod.Tokens.imaging)
    pxr.UsdLod.RootAPI.Apply(root).CreateLodHeuristicsRel().SetTargets([heuristic.GetPath()])
