"""OpenUSD: gaussians as prims `ParticleField3DGaussianSplat`, with Pixar's usd-core.

The writer writes one prim. The reader reads and transforms all prims, into one asset
or, for a scene, into several assets with the poses of their instances. It reads the
first of several levels of detail, and the first of values that change with time. It
ignores prims that are invisible or not meant to be drawn. An asset is converted from
the axes of the stage to those in memory; a scene keeps the axes of the stage.

Source: Pixar, OpenUSD 26.11, the schemas of UsdVol, and Usdz File Format Specification.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import replace
from enum import Enum
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Literal, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _extras, _files
from v3dg._numbers import check
from v3dg.cameras import Axis, Floats, is_rotation
from v3dg.editing import join
from v3dg.formats import _axes
from v3dg.formats._color_space import conversion_note, srgb_from_linear
from v3dg.formats._declared import Declared
from v3dg.formats._packing import check_writable
from v3dg.formats._reading import AnyPath, AssetFile, listed, value_errors
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised, quaternion_from_rotation

if TYPE_CHECKING:
    from pxr import Sdf, Usd

SUFFIXES = (".usd", ".usda", ".usdc", ".usdz")
# The axes of a stage by its up axis; the cameras of a stage look along -z.
_AXES = {"Y": _axes.OPENGL, "Z": _axes.Z_UP}
_Pose: TypeAlias = tuple[tuple[float, float, float, float], Floats, float]
# The custom data of a prim for antialiasing, because the schema has no attribute for
# it.
_ANTIALIASED = "antialiased"
_SH = "radiance:sphericalHarmonics"
_HALVES = (
    "positions",
    "orientations",
    "scales",
    "opacities",
    f"{_SH}Coefficients",
)  # or in half precision
_COLUMNS = (f"{_SH}Degree", *_HALVES, *(f"{name}h" for name in _HALVES))
# Attributes that do not affect the appearance of gaussians, or that other functions
# read.
_HINTS = ("projectionModeHint", "sortingModeHint")
_COLOR_SPACE = "colorSpace:name"
_KNOWN = (*_COLUMNS, *_HINTS, _COLOR_SPACE, "extent", "visibility", "purpose", "xformOpOrder")
# Names of colour spaces of UsdColorSpaceAPI, those of glTF, and shorter ones of
# MaterialX. Colours in sRGB, or without a colour space, are read as they are.
_WRITTEN_COLOR_SPACE = "srgb_rec709_scene"
_SRGB = ("", _WRITTEN_COLOR_SPACE, "srgb_rec709_display", "srgb_texture", "raw", "data", "unknown")
_LINEAR = ("lin_rec709_scene", "lin_rec709_display", "lin_rec709")
_MAX_DEGREE = 3  # coefficients of higher degrees are dropped
_MOST_DEGREE = 100


class _Kernel(Enum):
    """The particle shapes that can be read as gaussians."""

    ELLIPSOID = "ParticleFieldKernelGaussianEllipsoidAPI"
    SURFLET = "ParticleFieldKernelGaussianSurfletAPI"  # flat along its z axis


class _Column(NamedTuple):
    """The values of an attribute for the particles of a prim; None if the default of
    the schema applies."""

    values: NDArray[np.float32] | None
    note: str = ""


@cache
def pxr() -> ModuleType:
    """Return the package `pxr`; if it is missing, the ImportError says how to install
    it."""
    for part in (
        "Usd",
        "UsdGeom",
        "UsdLod",
        "UsdUtils",
        "UsdVol",
        "Vt",
    ):  # importing these modules makes them attributes of the package
        _extras.load(f"pxr.{part}")
    package: ModuleType = _extras.load("pxr")
    return package


def open_file(path: AnyPath) -> AssetFile:
    """Open a USD file. All of it is read at once."""
    gaussians, declared = read(path)

    def read_rows(first: int, last: int) -> Gaussians:
        return gaussians.subset(slice(first, last))

    return AssetFile(path, len(gaussians), gaussians.sh_degree, read_rows, declared=declared)


def read(path: AnyPath) -> tuple[Gaussians, Declared]:
    """Read the gaussians of a USD file as one asset, together with what the file
    declares."""
    with _opened(path, "OpenUSD with gaussians, without instances") as (usd, root):
        for prim in _prims(usd, root):
            if prim.IsA(usd.UsdGeom.PointInstancer):
                raise ValueError(f"instances in {prim.GetPath()}; open it as a scene")
        parts = []
        notes = _left_out(usd, root)
        for prim, matrix in _placed(usd, root):
            gaussians, notes_of_prim = _gaussians_of(usd, prim)
            if not np.array_equal(matrix, np.eye(4)):
                gaussians = gaussians.transform(*_similarity(prim, matrix))
            parts.append(gaussians)
            notes += notes_of_prim
        letter = str(usd.UsdGeom.GetStageUpAxis(root.GetStage()))
        if letter not in _AXES:
            raise ValueError(f"the up axis {letter[:20]!a}; only Y and Z can be read")
        gaussians = _axes.turned(join(parts), _AXES[letter], _axes.MEMORY)
        declared = _declared(usd, root.GetStage(), letter, notes)
        return gaussians, replace(declared, antialiased=gaussians.antialiased)


def _declared(usd: ModuleType, stage: Usd.Stage, letter: str, notes: list[str]) -> Declared:
    """Return what a stage declares, together with the notes about its prims; `letter`
    is the stage's up axis."""
    unit = usd.UsdGeom.GetStageMetersPerUnit(stage)
    distinct = list(dict.fromkeys(notes))
    if usd.UsdGeom.StageHasAuthoredMetersPerUnit(stage) and unit != 1:
        distinct.append(f"Its unit is {unit:g} m; coordinates stay in that unit.")
    reason = f"as its stage says ({letter} is up in the file)"
    if not stage.HasAuthoredMetadata("upAxis"):
        reason = f"as in OpenUSD ({letter} is up in the file)"
    return Declared(up=_axes.MEMORY_UP, up_reason=reason, notes=tuple(distinct))


def has_instances(path: AnyPath) -> bool:
    """Return whether a USD file has instances and is therefore a scene."""
    with _opened(path, "OpenUSD with gaussians") as (usd, root):
        kind = usd.UsdGeom.PointInstancer
        return any(prim.IsInstanceProxy() or prim.IsA(kind) for prim in _prims(usd, root))


def read_world(path: AnyPath) -> tuple[list[Gaussians], list[int], list[_Pose], Axis]:
    """Read a USD file as a scene: its distinct assets, the asset and the pose of each
    instance, and the up axis.

    Prims whose values come from the same place in the file are one asset, for example
    references to one prim.
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
                    assets.append(_gaussians_of(usd, prim)[0])
                asset_from_path[path_of_prim] = asset_from_source[source]
            asset_from_instance.append(asset_from_path[path_of_prim])
            poses.append(_similarity(prim, matrix))
        if not assets:
            raise ValueError("a file without gaussians")
        up = usd.UsdGeom.GetStageUpAxis(root.GetStage()).lower()
        return assets, asset_from_instance, poses, up


@contextlib.contextmanager
def _opened(path: AnyPath, expected: str) -> Iterator[tuple[ModuleType, Usd.Prim]]:
    """Yield the package `pxr` and the root prim of a file; raise ValueError if no prim
    has gaussians."""
    check(
        path, Path(path).suffix.lower() in SUFFIXES, f"a file name ending in {', '.join(SUFFIXES)}"
    )
    usd = pxr()
    os.close(_files.open_regular(path))
    if Path(path).suffix.lower() == ".usdz":
        _check_package(path)
    with value_errors(path, expected):
        stage = usd.Usd.Stage.Open(os.fspath(path))
        root = stage.GetPseudoRoot()
        if not any(_prims(usd, root)):
            raise ValueError(" ".join(["no ParticleField3DGaussianSplat.", *_left_out(usd, root)]))
        yield usd, root


def _check_package(path: AnyPath) -> None:
    """Raise ValueError unless a file is a zip that begins with a USD layer and whose
    members are all uncompressed: the library reads them in place."""
    with value_errors(path, "a .usdz, which is a zip"), zipfile.ZipFile(path) as package:
        members = package.infolist()
    is_layer = bool(members) and members[0].filename.endswith(SUFFIXES[:3])
    names = listed(member.filename for member in members) or "nothing"
    check(path, is_layer, f"a .usdz whose first file is a layer of USD, got {names}")
    for member in members:
        is_stored = member.compress_type == zipfile.ZIP_STORED and not member.flag_bits & 1
        has_size = member.compress_size == member.file_size
        expected = f"{member.filename!a} uncompressed in the .usdz"
        check(path, is_stored and has_size, f"{expected}, got compressed or encrypted data")


def _prims(usd: ModuleType, root: Usd.Prim) -> Iterator[Usd.Prim]:
    """Yield all prims of gaussians and all instancers at or below a root that are meant
    to be drawn; coarser levels of detail are skipped."""
    walk = iter(usd.Usd.PrimRange(root, usd.Usd.TraverseInstanceProxies()))
    for prim in walk:
        is_instancer = prim.IsA(usd.UsdGeom.PointInstancer)
        is_left_out = _is_coarse(usd, prim) or _is_hidden(usd, prim)
        # Prims below an instancer are drawn only as its instances.
        if is_instancer or is_left_out:
            walk.PruneChildren()
        if not is_left_out and (is_instancer or _kernel(usd, prim) is not None):
            yield prim


def _is_coarse(usd: ModuleType, prim: Usd.Prim) -> bool:
    """Return whether a prim is a level of detail other than the first."""
    parent = prim.GetParent()
    return bool(parent and parent.HasAPI(usd.UsdLod.RootAPI) and prim != parent.GetChildren()[0])


def _is_hidden(usd: ModuleType, prim: Usd.Prim) -> bool:
    """Return whether a prim and everything below it are not drawn: invisible prims,
    proxies, and guides for editing."""
    imageable = usd.UsdGeom.Imageable(prim)
    if not imageable:
        return False
    time = usd.Usd.TimeCode.EarliestTime()
    is_invisible = imageable.GetVisibilityAttr().Get(time) == usd.UsdGeom.Tokens.invisible
    purposes = (usd.UsdGeom.Tokens.proxy, usd.UsdGeom.Tokens.guide)
    return is_invisible or imageable.GetPurposeAttr().Get() in purposes


def _kernel(usd: ModuleType, prim: Usd.Prim) -> _Kernel | None:
    """Return the shape of a prim's particles; None if the particles are not
    gaussians."""
    if prim.IsA(usd.UsdVol.ParticleField):
        for kernel in _Kernel:
            if prim.HasAPI(getattr(usd.UsdVol, kernel.value)):
                return kernel
    return None


def _left_out(usd: ModuleType, root: Usd.Prim) -> list[str]:
    """Return a sentence for each part of the stage that is ignored."""
    hidden: list[str] = []
    particles: list[str] = []
    unread: list[str] = []
    walk = iter(usd.Usd.PrimRange(root, usd.Usd.TraverseInstanceProxies()))
    for prim in walk:
        path = str(prim.GetPath())
        if _is_coarse(usd, prim):
            walk.PruneChildren()
        elif _is_hidden(usd, prim):
            hidden.append(path)
            walk.PruneChildren()
        elif prim.IsA(usd.UsdVol.ParticleField) and _kernel(usd, prim) is None:
            particles.append(path)
        elif prim.IsA(usd.UsdGeom.Gprim) and _kernel(usd, prim) is None:
            unread.append(path)
    notes = []
    if hidden:
        notes.append(
            f"Prims that are invisible or not meant to be drawn were ignored: {listed(hidden)}."
        )
    if particles:
        notes.append(f"Particles that are not gaussians were ignored: {listed(particles)}.")
    if unread:
        notes.append(f"Other geometry was ignored: {listed(unread)}.")
    return notes


def _placed(usd: ModuleType, root: Usd.Prim) -> Iterator[tuple[Usd.Prim, Floats]]:
    """Yield each prim of gaussians with a (4, 4) matrix from the coordinates of the
    prim to those of the root. A prim with instances is yielded once for each
    instance."""
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
    # The matrix is transposed, because USD multiplies row vectors by matrices.
    cache = usd.UsdGeom.XformCache(usd.Usd.TimeCode.EarliestTime())
    return np.transpose(np.array(cache.GetLocalToWorldTransform(prim)))


def _similarity(prim: Usd.Prim, matrix: Floats) -> _Pose:
    """Return the quaternion, the translation and the scale of a (4, 4) matrix that
    places a prim; raise ValueError for other transforms."""
    scale = float(np.cbrt(np.linalg.det(matrix[:3, :3])))
    if not (scale > 0 and is_rotation(matrix[:3, :3] / scale)):
        raise ValueError(
            f"a transform of {prim.GetPath()} that is more than a rotation, a translation and "
            "one scale"
        )
    return quaternion_from_rotation(matrix[:3, :3] / scale), matrix[:3, 3], scale


def _gaussians_of(usd: ModuleType, prim: Usd.Prim) -> tuple[Gaussians, list[str]]:
    """Return the gaussians of a prim, and notes about values that are ignored or
    converted."""
    means = _column(usd, prim, "positions", None).values
    if means is None:
        means = np.zeros((0, 3), np.float32)
    count = len(means)
    degree = _degree(usd, prim)
    columns = {
        name: _column(usd, prim, name, count) for name in ("orientations", "scales", "opacities")
    }
    harmonics = _column(usd, prim, f"{_SH}Coefficients", count * (degree + 1) ** 2)
    notes = [column.note for column in (*columns.values(), harmonics) if column.note]
    notes += _notes_of(usd, prim)
    # Absent or ignored attributes have the defaults of the schema.
    quats = np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))
    if columns["orientations"].values is not None:
        quats = np.roll(columns["orientations"].values, 1, axis=1)
    scales = columns["scales"].values
    if scales is None:
        scales = np.ones((count, 3), np.float32)
    if _kernel(usd, prim) is _Kernel.SURFLET:
        scales = scales * np.array([1, 1, 0], np.float32)
        notes.append("Flat gaussians (surflets) were read as ellipsoids of no thickness.")
    opacities = columns["opacities"].values
    if opacities is None:
        opacities = np.ones(count, np.float32)
    sh = np.zeros((count, 1, 3), np.float32)
    if harmonics.values is not None:
        sh = harmonics.values.reshape(count, (degree + 1) ** 2, 3)
    if degree > _MAX_DEGREE:
        notes.append(f"Coefficients above SH degree {_MAX_DEGREE} were ignored.")
        sh = sh[:, : (_MAX_DEGREE + 1) ** 2]
    gaussians = Gaussians(
        means=means,
        quats=normalised(quats).astype(np.float32),
        scales=scales,
        opacities=opacities,
        sh=np.ascontiguousarray(sh),
    )
    if harmonics.values is not None:
        gaussians = _in_srgb(prim, gaussians, notes)
    return gaussians.trained(antialiased=_antialiased(prim)), notes


def _in_srgb(prim: Usd.Prim, gaussians: Gaussians, notes: list[str]) -> Gaussians:
    """Return the gaussians of a prim with colours in sRGB. A sentence about any other
    colour space is appended to the notes."""
    color_space = _color_space(prim)
    if color_space in _LINEAR:
        notes.append(conversion_note(color_space))
        return srgb_from_linear(gaussians)
    if color_space not in _SRGB:
        notes.append(f"The colour space {color_space[:40]!a} was read as sRGB.")
    return gaussians


def _color_space(prim: Usd.Prim) -> str:
    """Return the name of the colour space of a prim's coefficients; empty if nothing
    declares one. The attribute's own metadata is stronger than UsdColorSpaceAPI on the
    prim, which is stronger than on its ancestors."""
    for name in (f"{_SH}Coefficients", f"{_SH}Coefficientsh"):
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasColorSpace():
            return str(attribute.GetColorSpace())
    while prim:
        attribute = prim.GetAttribute(_COLOR_SPACE)
        if attribute and attribute.HasAuthoredValue():
            return str(attribute.Get())
        prim = prim.GetParent()
    return ""


def _antialiased(prim: Usd.Prim) -> bool | None:
    value = prim.GetCustomDataByKey(_ANTIALIASED)
    if isinstance(value, bool):
        return value
    return None


def _degree(usd: ModuleType, prim: Usd.Prim) -> int:
    """Return the SH degree of a prim; the default of the schema is 3."""
    degree = _value(usd, prim, f"{_SH}Degree")
    if degree is None:  # a prim without a degree has no coefficients, either
        return 0
    if not isinstance(degree, int) or not 0 <= degree <= _MOST_DEGREE:
        raise ValueError(f"an invalid SH degree, {degree}, in {prim.GetPath()}")
    return degree


def _column(usd: ModuleType, prim: Usd.Prim, name: str, count: int | None) -> _Column:
    """Return the first `count` values of an attribute in single precision or, if it is
    missing, of its variant in half precision. The schema ignores an attribute with
    fewer values."""
    stored = _value(usd, prim, name)
    if stored is None:
        stored = _value(usd, prim, f"{name}h")
    if stored is None:
        return _Column(None)
    values: NDArray[np.float32] = np.array(stored, np.float32)
    if count is None or len(values) == count:
        return _Column(values)
    lengths = f"{len(values)} values of {name} for {count} in {prim.GetPath()}"
    if len(values) < count:
        return _Column(None, f"{lengths} are too few, so the default of the schema was used.")
    return _Column(values[:count], f"{lengths} are too many, so the last values were ignored.")


def _value(usd: ModuleType, prim: Usd.Prim, name: str) -> object:
    """Return the first value of an attribute; None if the prim does not have the
    attribute or a value for it."""
    attribute = prim.GetAttribute(name)
    if not attribute:
        return None
    return attribute.Get(usd.Usd.TimeCode.EarliestTime())


def _notes_of(usd: ModuleType, prim: Usd.Prim) -> list[str]:
    """Return sentences about other properties of a prim's gaussians that are
    ignored."""
    notes = []
    authored = prim.GetAuthoredAttributes()
    is_moving = usd.UsdGeom.Xformable(prim).TransformMightBeTimeVarying() or any(
        attribute.GetNumTimeSamples() > 1 for attribute in authored
    )
    if is_moving:
        notes.append("Values change with time; the first ones were read.")
    for name in _HINTS:
        attribute = prim.GetAttribute(name)
        if attribute and attribute.HasAuthoredValue():
            value = str(attribute.Get())
            default = str(prim.GetPrimDefinition().GetAttributeFallbackValue(name))
            if value != default:
                notes.append(f"The hint {name} is {value[:40]!a} and was ignored.")
    names = [attribute.GetName() for attribute in authored]
    unread = [name for name in names if name not in _KNOWN and not name.startswith("xformOp:")]
    if unread:
        notes.append(f"Attributes of gaussians were ignored: {listed(unread)}.")
    return notes


def write(path: AnyPath, gaussians: Gaussians, *, up: Axis = _axes.MEMORY_UP) -> None:
    """Write a USD file with one prim, in the order of the gaussians. `up` is the axis
    of the gaussians that points up."""
    host = _axes.turned(check_writable(gaussians), _axes.axes_of_up(up), _AXES["Y"])
    stage = new_stage("Y")
    stage.SetDefaultPrim(define(stage, "/gaussians", host))
    export(stage, path)


def new_stage(up: Literal["Y", "Z"]) -> Usd.Stage:
    """Return an empty stage in metres; `up` is the axis that points up."""
    usd = pxr()
    stage = usd.Usd.Stage.CreateInMemory()
    usd.UsdGeom.SetStageUpAxis(stage, up)
    usd.UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    return stage


def export(stage: Usd.Stage, path: AnyPath) -> None:
    """Write a stage to a file, which appears only when it is complete. The suffix
    selects the encoding."""
    with _files.replacing(path) as temporary, tempfile.TemporaryDirectory() as folder:
        # USD chooses the encoding by the suffix of the file.
        suffix = Path(path).suffix.lower()
        layer = Path(folder) / f"stage{suffix}"
        if suffix == ".usdz":
            layer = Path(folder) / "stage.usdc"
        stage.GetRootLayer().Export(os.fspath(layer))
        file = layer
        if suffix == ".usdz":
            file = Path(folder) / "stage.usdz"
            usd = pxr()
            with value_errors(path, "a .usdz to be written"):
                is_made = usd.UsdUtils.CreateNewUsdzPackage(os.fspath(layer), os.fspath(file))
                if not is_made:
                    raise ValueError("an error of OpenUSD; write a .usdc instead")
        shutil.copyfile(file, temporary)


def define(stage: Usd.Stage, path: str, host: Gaussians) -> Usd.Prim:
    """Define a prim of gaussians on a stage; ``host`` must have passed
    `check_writable`."""
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
    # Without these a reader that goes by primvars takes one coefficient for each
    # gaussian; NVIDIA's requirement VG.035 asks for both.
    harmonics = usd.UsdGeom.Primvar(prim.GetAttribute(f"{_SH}Coefficients"))
    harmonics.SetInterpolation(usd.UsdGeom.Tokens.vertex)
    harmonics.SetElementSize((host.sh_degree + 1) ** 2)
    usd.Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(_WRITTEN_COLOR_SPACE)
    if host.antialiased is not None:
        prim.SetCustomDataByKey(_ANTIALIASED, host.antialiased)
    return prim
