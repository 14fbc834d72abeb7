"""OpenUSD: gaussians as prims `ParticleField3DGaussianSplat`, with Pixar's usd-core.

Written is one prim; read are all prims that are there, where their transforms put them: as one asset, or
each of them once and where it stands. Of levels of detail, the first is read. Coordinates are passed on as
they are stored.
"""

import contextlib
import os
import shutil
import tempfile
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, Literal, TypeAlias

import numpy as np

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg.cameras import Axis, Floats, is_rotation
from v3dg.formats._packing import check_writable
from v3dg.formats._reading import AssetFile, telling
from v3dg.formats._reading import Path as AnyPath
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised, quaternion_from_rotation

SUFFIXES = (".usd", ".usda", ".usdc")
_Pose: TypeAlias = tuple[tuple[float, float, float, float], Floats, float]
_SH = "radiance:sphericalHarmonics"
_HALVES = ("positions", "orientations", "scales", "opacities", f"{_SH}Coefficients")  # or in half precision
_COLUMNS = (f"{_SH}Degree", *_HALVES, *(f"{name}h" for name in _HALVES))


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
    """Read the gaussians of a USD file as one asset."""
    with _opened(path, "OpenUSD with gaussians of one SH degree, without instances") as (usd, root):
        for prim in _prims(usd, root):
            if prim.IsA(usd.UsdGeom.PointInstancer):
                raise ValueError(f"instances in {prim.GetPath()}; open it as a scene")
        parts = []
        for prim, matrix in _placed(usd, root):
            gaussians = _gaussians_of(prim)
            is_moved = not np.array_equal(matrix, np.eye(4))
            parts.append(gaussians.transform(*_similarity(prim, matrix)) if is_moved else gaussians)
        return Gaussians.concatenate(parts)


def has_instances(path: AnyPath) -> bool:
    """Whether instances make a USD file a scene."""
    with _opened(path, "OpenUSD with gaussians") as (usd, root):
        kind = usd.UsdGeom.PointInstancer
        return any(prim.IsInstanceProxy() or prim.IsA(kind) for prim in _prims(usd, root))


def read_world(path: AnyPath) -> tuple[list[Gaussians], list[int], list[_Pose], Axis]:
    """Read what is in a USD file once each; which of it has an instance where; and what is up.

    Prims whose values come from the same place are one asset, as references to it are.
    """
    numbers: dict[Any, int] = {}  # by path, and by where values come from
    assets, which, poses = list[Gaussians](), list[int](), list[_Pose]()
    with _opened(path, "OpenUSD with gaussians and instances of them") as (usd, root):
        for prim, matrix in _placed(usd, root):
            if prim.GetPath() not in numbers:
                stacks = [prim.GetAttribute(name).GetPropertyStack() for name in _COLUMNS]
                source = tuple((stack[0].layer.identifier, stack[0].path) for stack in stacks if stack)
                if source not in numbers:
                    numbers[source] = len(assets)
                    assets.append(_gaussians_of(prim))
                numbers[prim.GetPath()] = numbers[source]
            which.append(numbers[prim.GetPath()])
            poses.append(_similarity(prim, matrix))
        if not assets:
            raise ValueError("no instances")
        return assets, which, poses, usd.UsdGeom.GetStageUpAxis(root.GetStage()).lower()


@contextlib.contextmanager
def _opened(path: AnyPath, expected: str) -> Iterator[tuple[Any, Any]]:
    """The package, and the root of a file's prims, of which some must be gaussians."""
    check(path, Path(path).suffix.lower() in SUFFIXES, f"a file name ending in {', '.join(SUFFIXES)}")
    usd = pxr()
    os.close(_files.open_regular(path))
    with telling(path, expected):
        stage = usd.Usd.Stage.Open(os.fspath(path))
        if not any(_prims(usd, stage.GetPseudoRoot())):
            raise ValueError("no ParticleField3DGaussianSplat")
        yield usd, stage.GetPseudoRoot()


def _prims(usd: Any, root: Any) -> Iterator[Any]:
    """Gaussians and instancers of the prims from a root on."""
    walk = iter(usd.Usd.PrimRange(root, usd.Usd.TraverseInstanceProxies()))
    for prim in walk:
        parent, is_instancer = prim.GetParent(), prim.IsA(usd.UsdGeom.PointInstancer)
        is_coarse = parent and parent.HasAPI(usd.UsdLod.RootAPI) and prim != parent.GetChildren()[0]
        if is_instancer or is_coarse:  # what is below an instancer is drawn where its instances are
            walk.PruneChildren()
        if not is_coarse and (is_instancer or prim.IsA(usd.UsdVol.ParticleField3DGaussianSplat)):
            yield prim


def _placed(usd: Any, root: Any) -> Iterator[tuple[Any, Floats]]:
    """Prims of gaussians, and what takes each, or an instance of it, to the frame of the root."""
    from_root, time = np.linalg.inv(_to_world(usd, root)), usd.Usd.TimeCode.EarliestTime()
    for prim in _prims(usd, root):
        matrix = from_root @ _to_world(usd, prim)
        if not prim.IsA(usd.UsdGeom.PointInstancer):
            yield prim, matrix
            continue
        instancer = usd.UsdGeom.PointInstancer(prim)
        targets = map(prim.GetStage().GetPrimAtPath, instancer.GetPrototypesRel().GetForwardedTargets())
        prototypes = [list(_placed(usd, target)) for target in targets]
        kinds = np.array(instancer.GetProtoIndicesAttr().Get(time))
        kinds = kinds[np.array(instancer.ComputeMaskAtTime(time) or np.ones(len(kinds)), bool)]
        poses = np.array(instancer.ComputeInstanceTransformsAtTime(time, time)).reshape(-1, 4, 4)
        for kind, pose in zip(kinds.tolist(), poses.transpose(0, 2, 1), strict=True):
            yield from ((inside, matrix @ pose @ of) for inside, of in prototypes[kind])


def _to_world(usd: Any, prim: Any) -> Floats:
    # USD has vectors as rows.
    return np.transpose(np.array(usd.UsdGeom.XformCache().GetLocalToWorldTransform(prim)))


def _similarity(prim: Any, matrix: Floats) -> _Pose:
    """Quaternion, translation and scale of a (4, 4) matrix that places a prim."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not (scale > 0 and is_rotation(matrix[:3, :3] / scale)):
        raise ValueError(f"a transform of {prim.GetPath()} that is no rotation, translation and one scale")
    return quaternion_from_rotation(matrix[:3, :3] / scale), matrix[:3, 3], scale


def _gaussians_of(prim: Any) -> Gaussians:
    def column(name: str) -> Any:
        values = prim.GetAttribute(name).Get()
        if values is None:  # in half precision
            values = prim.GetAttribute(f"{name}h").Get()
        return np.array(values, np.float32)

    means, degree = column("positions"), prim.GetAttribute(f"{_SH}Degree").Get()
    return Gaussians(
        means=means,
        quats=normalised(np.roll(column("orientations"), 1, axis=1)).astype(np.float32),
        scales=column("scales"),
        opacities=column("opacities"),
        sh=column(f"{_SH}Coefficients").reshape(len(means), (degree + 1) ** 2, 3),
    )


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
