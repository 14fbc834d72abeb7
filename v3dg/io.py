"""Reads and writes gaussians by file name; each format is a module of v3dg.formats."""

import os
import pathlib
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias, TypeVar, get_args

from v3dg._numbers import check, check_type, one_of
from v3dg._urls import FileAtUrl, beside, folder_of, in_parts, reading, shown
from v3dg.cameras import AXES, Axis
from v3dg.cleaning import AssetWarning, coarse_note
from v3dg.formats import (
    _axes,
    checkpoint,
    compressed_ply,
    gltf,
    hier,
    ksplat,
    ply,
    sog,
    splat,
    spz,
    streamed_sog,
    usd,
)
from v3dg.formats._declared import declare
from v3dg.formats._losses import Losses, losses
from v3dg.formats._packing import Limits
from v3dg.formats._reading import AnyPath, AssetFile, bytes_of
from v3dg.formats.content import content_of
from v3dg.formats.ply import PlyEncoding
from v3dg.gaussians import Gaussians

Format = TypeVar("Format")
_Reader: TypeAlias = Callable[[AnyPath], AssetFile]

# Readers by the end of a file's name; the first that matches is used.
_READERS: dict[str, _Reader] = {
    ".ply": ply.open_file,
    ".splat": splat.open_file,
    ".ksplat": ksplat.open_file,
    ".spz": spz.open_file,
    **dict.fromkeys((".glb", ".gltf"), gltf.open_file),
    ".hier": hier.open_file,
    **dict.fromkeys(usd.SUFFIXES, usd.open_file),
    ".sog": sog.open_file,
    "lod-meta.json": streamed_sog.open_file,
    "meta.json": sog.open_file,
    **dict.fromkeys((".ckpt", ".pt", ".pth"), checkpoint.open_file),
}
# Writers by the same; those of packed formats return the gaussians in the file's order.
_WRITERS: dict[str, Callable[..., Gaussians | None]] = {
    ".compressed.ply": ply.write_compressed,
    ".ply": ply.write,
    ".spz": spz.write,
    ".glb": gltf.write,
    **dict.fromkeys(usd.SUFFIXES, usd.write),
    ".sog": sog.write,
}
# Ends of the names of files that have axes, to which gaussians are turned, and the axis
# that is up there.
_UP: dict[str, Axis] = dict.fromkeys((".spz", ".glb", *usd.SUFFIXES), "y")
# Functions that list the files of an asset that may have several.
_FILES: dict[str, Callable[[pathlib.Path], list[pathlib.Path]]] = {
    "lod-meta.json": streamed_sog.files,
    "meta.json": sog.files,
    ".gltf": gltf.files,
    "": lambda path: [path],
}

# Ends of the names of packed files, and what these can hold.
_PACKED: dict[str, Limits] = {
    ".compressed.ply": compressed_ply.LIMITS,
    ".spz": spz.LIMITS,
    ".sog": Limits(),
}

# Checkpoints of gsplat, one for each GPU, and of nerfstudio, and what the code of the
# 3DGS paper writes.
_RUNS = (
    "ckpts/ckpt_*.pt",
    "nerfstudio_models/step-*.ckpt",
    "point_cloud/iteration_*/point_cloud.ply",
)

SUFFIXES = tuple(_READERS)
"""Ends of the names of files that `read_asset` reads."""

WRITE_SUFFIXES = tuple(_WRITERS)
"""Ends of the names of files that `write_asset` writes."""


def subject_name(path: AnyPath) -> str:
    """Return the name of the subject in a file or at a URL: the file's name without its
    suffix, or the folder's name if all files of that kind have the same name, such as
    `lod-meta.json`."""
    file = beside(path)
    if file.name.lower() in ("lod-meta.json", "meta.json"):
        folder = folder_of(path)
        if folder:
            return folder
    return file.stem


def read_asset(path: AnyPath) -> Gaussians:
    """Read an asset; the end of the file's name determines the format
    (docs/formats.md):

    - `.ply`, as trainers write it: ascii or binary of either byte order, its properties
      in any order and of any scalar type, among others that are ignored, for SH degree
      0 to 3. Files hold log scales and logit opacities; memory gets values, each
      computed in double precision and rounded once. Quaternions are normalised, except
      those of length zero, which stay as they are. Values that are not finite are
      passed on. Little more memory is needed than for the result. A compressed `.ply`,
      of PlayCanvas and SuperSplat, is recognised by its content.
    - `.glb` and `.gltf`, glTF with KHR_gaussian_splatting, also compressed as `.spz`:
      the gaussians of the scene, where its nodes place them; the leaves of `.hier`, of
      H3DG.
    - `.usd`, `.usda`, `.usdc` and `.usdz`, OpenUSD, with the extra `usd`, whose library
      bounds what is read.
    - `.splat`, of antimatter15; `.ksplat`, of mkkellogg; `.spz`, of Niantic, version 1
      to 4; `.sog` of PlayCanvas, version 2, or the `meta.json` of one that is not in a
      zip; the finest level of streamed SOG, by its `lod-meta.json`.
    - `.pt`, `.ckpt` and `.pth`, checkpoints of gsplat's trainer, of nerfstudio's
      splatfacto and of the code of the 3DGS paper and 2DGS, from which nothing but
      tensors is taken.

    A file whose bytes are those of another of these formats is read as such.

    Whether the gaussians were trained with antialiasing is read from the files that can
    say it, see `Gaussians.antialiased`.

    With the extra `fsspec`, the file may be at a URL, which is fetched once per
    process, unless it refers to other files.

    Files of formats that have axes (`.spz`, glTF, OpenUSD) are turned, with their
    harmonics, to those of trainers' `.ply`: right, down, forward. Coordinates of all
    others are those of the file. What a file declares that was not understood is a
    `v3dg.cleaning.AssetWarning` each. Memory and time are bounded by the size of the
    file (docs/robustness.md).

    Raises:
        ValueError: The name is unknown, or the content does not match it; the message
            says what was expected and what was found.
        OSError: The file cannot be opened or read (FileNotFoundError,
            IsADirectoryError, ...).
    """
    file = open_asset(path)
    gaussians = file.read(0, file.num_gaussians)
    declared = file.declared
    coarse = coarse_note(gaussians)
    if coarse is not None:
        declared = replace(declared, notes=(*declared.notes, coarse))
    for note in declared.notes:
        warnings.warn(f"{shown(path)}: {note}", AssetWarning, stacklevel=2)
    return declare(gaussians.trained(antialiased=declared.antialiased), declared)


def loaded(asset: Gaussians | AnyPath) -> Gaussians:
    """Return an asset, after reading it if a file is given."""
    if isinstance(asset, str | os.PathLike):
        return read_asset(asset)
    return asset


def open_asset(path: AnyPath) -> AssetFile:
    """Open an asset of any kind that `read_asset` reads, to read it in parts; errors as
    there.

    `.ply`, `.splat` and `.compressed.ply` are read row by row. Of the others, reading
    the first rows takes the memory for all.
    """
    reader = _by_name(path, _READERS)
    at_url = in_parts(path)
    if isinstance(at_url, FileAtUrl):
        return _open_fetched(at_url, reader)
    reader, notes = _by_content(at_url, reader)
    return _noted(reader(at_url), notes)


def _by_content(path: AnyPath, reader: _Reader) -> tuple[_Reader, tuple[str, ...]]:
    """The reader of a file whose bytes may be those of another format than its name
    says, and a note that then says so. ValueError if they are those of a format that is
    not read."""
    content = content_of(path)
    if content is None or _READERS.get(content.suffix) is reader:
        return reader, ()
    name = beside(path).name.lower()
    ending = next(ending for ending in _READERS if name.endswith(ending))
    is_readable = content.suffix not in ("", *usd.SUFFIXES)  # USD takes it from the name
    check(path, is_readable, f"a {ending}, got {content.text}")
    note = f"Its name ends in {ending}, but it is {content.text}, and was read as such."
    return _READERS[content.suffix], (note,)


def _noted(file: AssetFile, notes: tuple[str, ...]) -> AssetFile:
    """The file, with notes in front of its own."""
    return replace(file, declared=replace(file.declared, notes=(*notes, *file.declared.notes)))


def _open_fetched(at_url: FileAtUrl, reader: _Reader) -> AssetFile:
    """An asset at a URL, whose local copy exists as long as this object; errors name
    the URL."""
    with reading(at_url) as local:
        reader, notes = _by_content(local, reader)
        if reader is gltf.open_file:
            # Nothing that a document at a URL names is read, here or there.
            is_alone = len(gltf.files(pathlib.Path(local))) == 1
            expected = "the URL of an asset in one file, got one that names others"
            check(shown(at_url), is_alone, f"{expected}; fetch the folder")
        file = _noted(reader(local), notes)
        whole = None
        if at_url.needs_name:
            whole = file.read(0, file.num_gaussians)

    def read(first: int, last: int) -> Gaussians:
        if whole is not None:
            return whole.subset(slice(first, last))
        with reading(at_url):
            return file.read(first, last)

    return replace(file, path=os.fspath(at_url), read=read)


def run_files(folder: pathlib.Path) -> list[pathlib.Path]:
    """Return the last checkpoint of a run of gsplat, nerfstudio or the code of the 3DGS
    paper; its files are one asset."""
    steps: dict[int, list[pathlib.Path]] = {}
    for pattern in _RUNS:
        for file in sorted(folder.glob(pattern)):
            match = re.search(r"(?:step-|ckpt_|iteration_)(\d+)", "/".join(file.parts[-2:]))
            step = -1
            if match:
                step = int(match[1])
            steps.setdefault(step, []).append(file)
    if not steps:
        return []
    return steps[max(steps)]


def asset_bytes(path: AnyPath) -> int:
    """Return the size on disk of a readable asset, including the existing files that it
    names."""
    names = _by_name(path, _FILES)
    at_url = in_parts(path)
    if isinstance(at_url, FileAtUrl):
        return at_url.num_bytes
    return bytes_of(names(pathlib.Path(path)))


def write_asset(
    path: AnyPath,
    gaussians: Gaussians | AnyPath,
    *,
    up: Axis = _axes.MEMORY_UP,
    antialiased: bool | None = None,
    encoding: PlyEncoding = "binary_little_endian",
    version: Literal[2, 3, 4] | None = None,
) -> None:
    """Write an asset; an existing file is replaced in one step once everything is
    written.

    The end of the name determines the format (docs/formats.md lists what each one
    loses):

    - `.ply`: the original layout without its normals, which are always zero: x y z,
      f_dc, f_rest (channel by channel), opacity (logit), scale (log), rot. An opacity
      of 1 is written as logit 20 and of 0 as logit -110, a scale of 0 as log -110:
      finite, and they read back as exactly 1, 0 and 0.
    - `.compressed.ply`: 16 bytes a gaussian and one a coefficient of higher SH. The
      order changes.
    - `.spz`: version 3, or another.
    - `.glb`: glTF 2.0 with KHR_gaussian_splatting, of float32 numbers.
    - `.usd`, `.usda`, `.usdc`, `.usdz`: OpenUSD, a ParticleField3DGaussianSplat of
      float32 numbers.
    - `.sog`: version 2. The order changes.

    Gaussians are turned so that what is up is y in `.spz`, `.glb` and OpenUSD; the
    other formats have no axes, and are written as the gaussians are.

    Args:
        gaussians: The asset, or its file.
        up: The axis that is up among the gaussians; -y as in most trained assets, and
            in all that `read_asset` has turned.
        antialiased: Whether the gaussians were trained with antialiasing, which the
            file then declares (docs/formats.md); None for what the gaussians say, see
            `Gaussians.trained`.
        encoding: Encoding of a `.ply`; other formats have only one.
        version: Version of a `.spz`; 3 if None. Version 2 is for viewers from before
            2025, 4 for those since 2026.

    Raises:
        ValueError: The name or the encoding is unknown, or the format cannot hold a
            value: a negative scale or an opacity outside [0, 1]; in all formats but
            `.ply` also values that are not finite, and quaternions of length zero.
        OSError: The file cannot be written.
    """
    gaussians = loaded(gaussians)
    check_type("gaussians", gaussians, Gaussians, "Gaussians")
    if antialiased is not None:
        gaussians = gaussians.trained(antialiased=antialiased)
    _write(path, gaussians, up, encoding, version)


def write_measured(
    path: AnyPath,
    gaussians: Gaussians,
    *,
    up: Axis = _axes.MEMORY_UP,
    version: Literal[2, 3, 4] | None = None,
) -> Losses | None:
    """Write an asset as `write_asset` does, read it back, and return what the file
    lacks of it; None for formats of float32 numbers, which lose nothing."""
    written = _write(path, gaussians, up, "binary_little_endian", version)
    limits = _of_name(path, _PACKED)
    if written is None or limits is None:
        return None
    if turned_up(path) is not None:
        written = _axes.turned(written, _axes.axes_of_up(up), _axes.MEMORY)
    file = open_asset(path)
    return losses(written, file.read(0, file.num_gaussians), limits)


def _write(
    path: AnyPath,
    gaussians: Gaussians,
    up: Axis,
    encoding: PlyEncoding,
    version: Literal[2, 3, 4] | None,
) -> Gaussians | None:
    """Write an asset; returns the gaussians of a packed file in its order."""
    write = _by_name(path, _WRITERS)
    if version is not None:
        check(
            "version",
            write is spz.write,
            f"None for {os.fspath(path)}, which is not a .spz, got {version}",
        )
        write = partial(spz.write, version=version)
    if write is ply.write:
        one_of(encoding, "encoding", get_args(PlyEncoding))
        write = partial(ply.write, encoding=encoding)
    else:
        expected = f"the default for {os.fspath(path)}, which is not a .ply, got {encoding!r}"
        check("encoding", encoding == "binary_little_endian", expected)
    one_of(up, "up", AXES)
    if turned_up(path) is not None:
        write = partial(write, up=up)
    return write(path, gaussians)


def turned_up(path: AnyPath) -> Axis | None:
    """Return the axis that is up in a file that `write_asset` writes, by its name; None
    for formats without axes."""
    return _of_name(path, _UP)


def _of_name(path: AnyPath, formats: Mapping[str, Format]) -> Format | None:
    """Return what a table has for the first of its endings that a file's name has; None
    without one."""
    name = beside(path).name.lower()
    for ending, value in formats.items():
        if name.endswith(ending):
            return value
    return None


def _by_name(path: AnyPath, formats: Mapping[str, Format]) -> Format:
    """Return what `_of_name` does; ValueError if the name has none of the endings."""
    value = _of_name(path, formats)
    if value is not None:
        return value
    advice = ""
    if formats is not _WRITERS:
        advice = "; v3dg.open opens bundles (.v3dg) and scenes (.json)"
        content = content_of(path)
        if content is not None:
            advice = f"; this is {content.text}"
        if content is not None and content.suffix:
            advice += ", so let its name end so"
    raise ValueError(
        f"{shown(path)}: expected a file name that ends in {', '.join(formats)}{advice}"
    )
