"""OpenUSD: gaussians as prims `ParticleField3DGaussianSplat`, with Pixar's usd-core.

Written is one prim; read are all prims that are there, where their transforms put them. Of levels of detail,
the first is read. Coordinates are passed on as they are stored.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np

from v3dg import _extras, _files
from v3dg.cameras import is_rotation
from v3dg.formats._packing import check_writable, normalised
from v3dg.formats._reading import AssetFile, telling
from v3dg.formats._reading import Path as AnyPath
from v3dg.gaussians import Gaussians
from v3dg.rotations import quaternion_from_rotation

SUFFIXES = (".usd", ".usda", ".usdc")
_SH = "radiance:sphericalHarmonics"


@cache
def pxr() -> Any:
    """The package `pxr`; ImportError says how to get it."""
    for part in ("Usd", "UsdGeom", "UsdLod", "UsdVol", "Vt"):  # which become its attributes
        _extras.load(f"pxr.{part}")
    return _extras.load("pxr")


def open_file(path: AnyPath) -> AssetFile:
    """Open a USD file, which is read whole."""
    gaussians = read(path)
    return AssetFile(path, len(gaussians), gaussians.sh_degree, lambda a, b: gaussians.subset(slice(a, b)))


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a USD file."""
    usd = pxr()
    os.close(_files.open_regular(path))
    with telling(path, "OpenUSD with gaussians of one SH degree, without instances"):
        stage, parts = usd.Usd.Stage.Open(os.fspath(path)), []
        walk = iter(usd.Usd.PrimRange.Stage(stage))
        for prim in walk:
            root = prim.GetParent()
            if prim.IsA(usd.UsdGeom.PointInstancer):
                raise ValueError(f"instances in {prim.GetPath()}")
            if root.HasAPI(usd.UsdLod.RootAPI) and prim != root.GetChildren()[0]:
                walk.PruneChildren()
            elif prim.IsA(usd.UsdVol.ParticleField3DGaussianSplat):
                parts.append(_gaussians_of(usd, prim))
        if not parts:
            raise ValueError("no ParticleField3DGaussianSplat")
        return Gaussians.concatenate(parts)


def _gaussians_of(usd: Any, prim: Any) -> Gaussians:
    def column(name: str) -> Any:
        values = prim.GetAttribute(name).Get()
        if values is None:  # in half precision
            values = prim.GetAttribute(f"{name}h").Get()
        return np.array(values, np.float32)

    means, degree = column("positions"), prim.GetAttribute(f"{_SH}Degree").Get()
    gaussians = Gaussians(
        means=means,
        quats=normalised(np.roll(column("orientations"), 1, axis=1)).astype(np.float32),
        scales=column("scales"),
        opacities=column("opacities"),
        sh=column(f"{_SH}Coefficients").reshape(len(means), (degree + 1) ** 2, 3),
    )
    # USD has vectors as rows.
    matrix = np.array(usd.UsdGeom.XformCache().GetLocalToWorldTransform(prim)).T
    if np.array_equal(matrix, np.eye(4)):
        return gaussians
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not (scale > 0 and is_rotation(matrix[:3, :3] / scale)):
        raise ValueError(f"a transform of {prim.GetPath()} that is no rotation, translation and one scale")
    return gaussians.transform(quaternion_from_rotation(matrix[:3, :3] / scale), matrix[:3, 3], scale)


def write(path: AnyPath, gaussians: Gaussians) -> None:
    """Write a USD file of one prim; the order stays."""
    host, stage = check_writable(gaussians), new_stage("Y")
    stage.SetDefaultPrim(define(stage, "/gaussians", host))
    export(stage, path)


def new_stage(up: Literal["Y", "Z"]) -> Any:
    """An empty stage in metres; Y is up where nothing is known, as USD has it."""
    usd = pxr()
    stage = usd.Usd.Stage.CreateInMemory()
    usd.UsdGeom.SetStageUpAxis(stage, up)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def export(stage: Any, path: AnyPath) -> None:
    """Write a stage to a file, in the encoding that the name stands for, once all of it is there."""
    with _files.replacing(path) as temporary, tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / f"stage{Path(path).suffix.lower()}"  # whose name tells USD the encoding
        stage.GetRootLayer().Export(os.fspath(file))
        shutil.copyfile(file, temporary)


def define(stage: Any, path: str, host: Gaussians) -> Any:
    """Define a prim of a stage that is gaussians, of NumPy and with values that can be held."""
    usd = pxr()
    prim = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, path).GetPrim()
    reach = 3 * host.scales.max(axis=1, keepdims=True, initial=0.0)
    extent = [(host.means - reach).min(axis=0), (host.means + reach).max(axis=0)] if len(host) else []
    vectors, quats = usd.Vt.Vec3fArray.FromNumpy, np.roll(normalised(host.quats), -1, axis=1)
    values = {
        "positions": vectors(host.means),
        "orientations": usd.Vt.QuatfArray.FromNumpy(quats.astype(np.float32)),
        "scales": vectors(host.scales),
        "opacities": usd.Vt.FloatArray.FromNumpy(host.opacities),
        f"{_SH}Degree": host.sh_degree,
        f"{_SH}Coefficients": vectors(host.sh.reshape(-1, 3)),
        "extent": vectors(np.array(extent, np.float32).reshape(-1, 3)),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    return prim
