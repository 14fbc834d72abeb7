"""OpenUSD: gaussians as prims `ParticleField3DGaussianSplat`, with Pixar's usd-core.

One prim is written. All prims are read and transformed, into one asset, or into an
asset each with the poses of its instances. Of levels of detail, the first is read.
Coordinates are passed on as they are stored.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg.cameras import Axis, Floats, is_rotation
from v3dg.formats._declared import Declared
from v3dg.formats._packing import check_writable
from v3dg.formats._reading import AnyPath, AssetFile, value_errors
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised, quaternion_from_rotation

if TYPE_CHECKING:
    from pxr import Sdf, Usd

SUFFIXES = (".usd", ".usda", ".usdc")
_Pose: TypeAlias = tuple[tuple[float, float, float, float], Floats, float]
_ANTIALIASED = "antialiased"  # in the custom data of a prim: the schema has no place for it
_SH = "radiance:sphericalHarmonics"
_HALVES = (
    "positions",
    "orientations",
    "scales",
    "opacities",
    f"{_SH}Coefficients",
)  # or in half precision
_COLUMNS = (f"{_SH}Degree", *_HALVES, *(f"{name}h" for name in _HALVES))


@cache
def pxr() -> ModuleType:
    """The package `pxr`; ImportError says how to get it."""
    for part in (
        "Usd",
        "UsdGeom",
        "UsdLod",
        "UsdVol",
        "Vt",
    ):  # importing them makes them attributes
        _extras.load(f"pxr.{part}")
    package: ModuleType = _extras.load("pxr")
    return package


def open_file(path: AnyPath) -> AssetFile:
    """Open a USD file, which is read whole."""
    gaussians = read(path)

    def read_rows(first: int, last: int) -> Gaussians:
        return gaussians.subset(slice(first, last))

    declared = Declared(antialiased=gaussians.antialiased)
    return AssetFile(path, len(gaussians), gaussians.sh_degree, read_rows, declared=declared)


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a USD file as one asset."""
    with _opened(path, "OpenUSD with gaussians of one SH degree, without instances") as (usd, root):
        for prim in _prims(usd, root):
            if prim.IsA(usd.UsdGeom.PointInstancer):
                raise ValueError(f"instances in {prim.GetPath()}; open it as a scene")
        parts = []
        for prim, matrix in _placed(usd, root):
            gaussians = _gaussians_of(prim)
            if not np.array_equal(matrix, np.eye(4)):
                gaussians = gaussians.transform(*_similarity(prim, matrix))
            parts.append(gaussians)
        return Gaussians.concatenate(parts)


def has_instances(path: AnyPath) -> bool:
    """Whether instances make a USD file a scene."""
    with _opened(path, "OpenUSD with gaussians") as (usd, root):
        kind = usd.UsdGeom.PointInstancer
        return any(prim.IsInstanceProxy() or prim.IsA(kind) for prim in _prims(usd, root))


def read_world(path: AnyPath) -> tuple[list[Gaussians], list[int], list[_Pose], Axis]:
    """Read the distinct assets of a USD file, asset and pose of each instance, and the
    axis that is up.

    Prims whose values come from the same place are one asset, as references to it are.
    """
    asset_from_path: dict[Sdf.Path, int] = {}
    asset_from_source: dict[tuple[object, ...], int] = {}
    assets: list[Gaussians] = []
    asset_from_instance: list[int] = []
    poses: list[_Pose] = []
    with _opened(path, "OpenUSD with gaussians and instances of them") as (usd, root):
        for prim, matrix in _placed(usd, root):
            path_of_prim = prim.GetPath()
            if path_of_prim not in asset_from_path:
                stacks = [prim.GetAttribute(name).GetPropertyStack() for name in _COLUMNS]
                source = tuple(
                    (stack[0].layer.identifier, stack[0].path) for stack in stacks if stack
                )
                if source not in asset_from_source:
                    asset_from_source[source] = len(assets)
                    assets.append(_gaussians_of(prim))
                asset_from_path[path_of_prim] = asset_from_source[source]
            asset_from_instance.append(asset_from_path[path_of_prim])
            poses.append(_similarity(prim, matrix))
        if not assets:
            raise ValueError("no instances")
        up = usd.UsdGeom.GetStageUpAxis(root.GetStage()).lower()
        return assets, asset_from_instance, poses, up


@contextlib.contextmanager
def _opened(path: AnyPath, expected: str) -> Iterator[tuple[ModuleType, Usd.Prim]]:
    """The package `pxr`, and the root of the prims of a file; ValueError unless some
    are gaussians."""
    check(
        path, Path(path).suffix.lower() in SUFFIXES, f"a file name ending in {', '.join(SUFFIXES)}"
    )
    usd = pxr()
    os.close(_files.open_regular(path))
    with value_errors(path, expected):
        stage = usd.Usd.Stage.Open(os.fspath(path))
        if not any(_prims(usd, stage.GetPseudoRoot())):
            raise ValueError("no ParticleField3DGaussianSplat")
        yield usd, stage.GetPseudoRoot()


def _prims(usd: ModuleType, root: Usd.Prim) -> Iterator[Usd.Prim]:
    """Prims of gaussians and instancers at and below a root, without those of coarser
    levels."""
    walk = iter(usd.Usd.PrimRange(root, usd.Usd.TraverseInstanceProxies()))
    for prim in walk:
        parent = prim.GetParent()
        is_instancer = prim.IsA(usd.UsdGeom.PointInstancer)
        is_coarse = parent and parent.HasAPI(usd.UsdLod.RootAPI) and prim != parent.GetChildren()[0]
        if is_instancer or is_coarse:  # prims below an instancer are only drawn as its instances
            walk.PruneChildren()
        if not is_coarse and (is_instancer or prim.IsA(usd.UsdVol.ParticleField3DGaussianSplat)):
            yield prim


def _placed(usd: ModuleType, root: Usd.Prim) -> Iterator[tuple[Usd.Prim, Floats]]:
    """Prims of gaussians, each with the (4, 4) matrix from it, or from an instance of
    it, to the root."""
    root_from_world = np.linalg.inv(_to_world(usd, root))
    time = usd.Usd.TimeCode.EarliestTime()
    for prim in _prims(usd, root):
        matrix = root_from_world @ _to_world(usd, prim)
        if not prim.IsA(usd.UsdGeom.PointInstancer):
            yield prim, matrix
            continue
        instancer = usd.UsdGeom.PointInstancer(prim)
        targets = map(
            prim.GetStage().GetPrimAtPath, instancer.GetPrototypesRel().GetForwardedTargets()
        )
        prototypes = [list(_placed(usd, target)) for target in targets]
        kinds = np.array(instancer.GetProtoIndicesAttr().Get(time))
        kinds = kinds[np.array(instancer.ComputeMaskAtTime(time) or np.ones(len(kinds)), bool)]
        poses = np.array(instancer.ComputeInstanceTransformsAtTime(time, time)).reshape(-1, 4, 4)
        for kind, pose in zip(kinds.tolist(), poses.transpose(0, 2, 1), strict=True):
            for part, part_matrix in prototypes[kind]:
                yield part, matrix @ pose @ part_matrix


def _to_world(usd: ModuleType, prim: Usd.Prim) -> Floats:
    # USD multiplies row vectors by matrices.
    return np.transpose(np.array(usd.UsdGeom.XformCache().GetLocalToWorldTransform(prim)))


def _similarity(prim: Usd.Prim, matrix: Floats) -> _Pose:
    """Quaternion, translation and scale of a (4, 4) matrix that places a prim."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not (scale > 0 and is_rotation(matrix[:3, :3] / scale)):
        raise ValueError(
            f"a transform of {prim.GetPath()} that is no rotation, translation and one scale"
        )
    return quaternion_from_rotation(matrix[:3, :3] / scale), matrix[:3, 3], scale


def _gaussians_of(prim: Usd.Prim) -> Gaussians:
    def column(name: str) -> NDArray[np.float32]:
        values = prim.GetAttribute(name).Get()
        if values is None:  # stored in half precision, under another name
            values = prim.GetAttribute(f"{name}h").Get()
        return np.array(values, np.float32)

    means = column("positions")
    degree = prim.GetAttribute(f"{_SH}Degree").Get()
    gaussians = Gaussians(
        means=means,
        quats=normalised(np.roll(column("orientations"), 1, axis=1)).astype(np.float32),
        scales=column("scales"),
        opacities=column("opacities"),
        sh=column(f"{_SH}Coefficients").reshape(len(means), (degree + 1) ** 2, 3),
    )
    antialiased = prim.GetCustomDataByKey(_ANTIALIASED)
    if isinstance(antialiased, bool):
        return gaussians.trained(antialiased=antialiased)
    return gaussians


def write(path: AnyPath, gaussians: Gaussians) -> None:
    """Write a USD file of one prim; the order stays."""
    host = check_writable(gaussians)
    stage = new_stage("Y")
    stage.SetDefaultPrim(define(stage, "/gaussians", host))
    export(stage, path)


def new_stage(up: Literal["Y", "Z"]) -> Usd.Stage:
    """An empty stage in metres; Y is USD's default for the axis that is up."""
    usd = pxr()
    stage = usd.Usd.Stage.CreateInMemory()
    usd.UsdGeom.SetStageUpAxis(stage, up)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def export(stage: Usd.Stage, path: AnyPath) -> None:
    """Write a stage to a file in one step, in the encoding that belongs to the
    suffix."""
    with _files.replacing(path) as temporary, tempfile.TemporaryDirectory() as folder:
        # USD takes the encoding from the suffix.
        file = Path(folder) / f"stage{Path(path).suffix.lower()}"
        stage.GetRootLayer().Export(os.fspath(file))
        shutil.copyfile(file, temporary)


def define(stage: Usd.Stage, path: str, host: Gaussians) -> Usd.Prim:
    """Define a prim of gaussians on a stage; ``host`` has passed `check_writable`."""
    usd = pxr()
    prim = usd.UsdVol.ParticleField3DGaussianSplat.Define(stage, path).GetPrim()
    reach = 3 * host.scales.max(axis=1, keepdims=True, initial=0.0)
    extent = np.zeros((0, 3), np.float32)
    if len(host):
        extent = np.array(
            [(host.means - reach).min(axis=0), (host.means + reach).max(axis=0)], np.float32
        )
    vectors = usd.Vt.Vec3fArray.FromNumpy
    quats = np.roll(normalised(host.quats), -1, axis=1)
    values = {
        "positions": vectors(host.means),
        "orientations": usd.Vt.QuatfArray.FromNumpy(quats.astype(np.float32)),
        "scales": vectors(host.scales),
        "opacities": usd.Vt.FloatArray.FromNumpy(host.opacities),
        f"{_SH}Degree": host.sh_degree,
        f"{_SH}Coefficients": vectors(host.sh.reshape(-1, 3)),
        "extent": vectors(extent),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(value)
    if host.antialiased is not None:
        prim.SetCustomDataByKey(_ANTIALIASED, host.antialiased)
    return prim
