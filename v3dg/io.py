"""Reads and writes assets. The end of a file's name selects the format, a module of
v3dg.formats."""

import os
import pathlib
import re
import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Literal, TypeAlias, TypeVar, get_args

from v3dg._numbers import check, check_type, one_of
from v3dg._urls import FileAtUrl, beside, folder_of, in_parts, is_url, reading, shown
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

# Functions that open files, by the end of the file's name; the first match is used.
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
# Writers, by the end of the file's name. Writers of packed formats return the gaussians
# in the order of the file.
_WRITERS: dict[str, Callable[..., Gaussians | None]] = {
    ".compressed.ply": ply.write_compressed,
    ".ply": ply.write,
    ".spz": spz.write,
    ".glb": gltf.write,
    **dict.fromkeys(usd.SUFFIXES, usd.write),
    ".sog": sog.write,
}
# The axis that points up in a file, by the end of the file's name. Gaussians are
# converted to the axes of these formats.
_UP: dict[str, Axis] = dict.fromkeys((".spz", ".glb", *usd.SUFFIXES), "y")
# Functions that list all files of an asset, by the end of the file's name.
_FILES: dict[str, Callable[[pathlib.Path], list[pathlib.Path]]] = {
    "lod-meta.json": streamed_sog.files,
    "meta.json": sog.files,
    ".gltf": gltf.files,
    "": lambda path: [path],
}

# The ranges of values in quantised formats, by the end of the file's name.
_PACKED: dict[str, Limits] = {
    ".compressed.ply": compressed_ply.LIMITS,
    ".spz": spz.LIMITS,
    ".sog": Limits(),
}

# Files of formats that consist of a folder. The first one describes the whole folder.
_FOLDER_INDICES = ("lod-meta.json", "meta.json")

# Checkpoints of gsplat (one for each GPU) and of nerfstudio, and the files that the
# code of the 3DGS paper writes.
_RUNS = (
    "ckpts/ckpt_*.pt",
    "nerfstudio_models/step-*.ckpt",
    "point_cloud/iteration_*/point_cloud.ply",
)

SUFFIXES = tuple(_READERS)
"""The ends of file names that `read_asset` accepts."""

WRITE_SUFFIXES = tuple(_WRITERS)
"""The ends of file names that `write_asset` accepts."""


def asset_file(path: AnyPath) -> AnyPath:
    """Return the file that describes the asset in a folder: its `lod-meta.json`, or
    else its `meta.json`. The path of anything but a folder is returned unchanged."""
    if is_url(path):
        return path
    for name in _FOLDER_INDICES:
        index = pathlib.Path(path) / name
        if index.is_file():
            return index
    return path


def is_asset_by_content(path: AnyPath) -> bool:
    """Return whether a local file is an asset by its content. Only formats count that
    can be read whatever the name of the file."""
    content = content_of(path)
    # USD does not count, because its library chooses the encoding by the suffix.
    return content is not None and content.suffix not in ("", *usd.SUFFIXES)


def subject_name(path: AnyPath) -> str:
    """Return the name of the subject in a file or at a URL. It is the name of the file
    without its suffix. For a file whose name is always the same, such as
    `lod-meta.json`, it is the name of the folder."""
    path = asset_file(path)
    file = beside(path)
    if file.name.lower() in _FOLDER_INDICES:
        folder = folder_of(path)
        if folder:
            return folder
    return file.stem


def read_asset(path: AnyPath) -> Gaussians:
    """Read an asset; the end of the file's name determines the format
    (docs/formats.md):

    - `.ply`, as trainers write it, of SH degree 0 to 3: ascii, or binary of either byte
      order. Properties may be in any order and of any scalar type; other properties are
      ignored. Log scales and opacity logits are converted in double precision and
      rounded once. Quaternions are normalised, except zero quaternions, which stay
      zero. Values that are not finite are kept. Reading needs little more memory than
      the result. A compressed `.ply`, of PlayCanvas and SuperSplat, is recognised by
      its content.
    - `.glb` and `.gltf`, glTF with KHR_gaussian_splatting, also with embedded `.spz`:
      the gaussians of the scene, placed by its nodes.
    - `.usd`, `.usda`, `.usdc` and `.usdz`, OpenUSD. This needs the extra `usd`, and its
      library determines which files can be read.
    - `.splat`, of antimatter15; `.ksplat`, of mkkellogg; `.spz`, of Niantic, version 1
      to 4; `.sog`, of PlayCanvas, version 2, or the `meta.json` of an unpacked one;
      `lod-meta.json` of a streamed SOG, of which the finest level is read; `.hier`, of
      H3DG, of which the leaves are read.
    - `.pt`, `.ckpt` and `.pth`, checkpoints of gsplat's trainer, of nerfstudio's
      splatfacto and of the code of the 3DGS paper and 2DGS. Only tensors are read; no
      code of the pickle is run.

    If the content of a file has another of these formats than its name, or its name has
    no known end, the content determines the format. Of a folder, its `lod-meta.json` or
    `meta.json` is read.

    If the file declares whether the gaussians were trained with antialiasing,
    `Gaussians.antialiased` of the result has that value.

    With the extra `fsspec`, the file may be at a URL, unless it refers to other files.
    It is downloaded once per process.

    Gaussians of formats with defined axes (`.spz`, glTF, OpenUSD) are rotated,
    including their harmonics, to the axes of trainers' `.ply`: right, down, forward.
    All other formats keep the coordinates of the file. Each part of the content that is
    ignored or converted causes a `v3dg.cleaning.AssetWarning`. Memory and time are
    bounded by the size of the file (docs/robustness.md).

    Raises:
        ValueError: The end of the name is unknown, or the content is invalid.
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
    """Return an asset; if it is a file, read it first."""
    if isinstance(asset, str | os.PathLike):
        return read_asset(asset)
    return asset


def open_asset(path: AnyPath) -> AssetFile:
    """Open an asset in any format of `read_asset` for reading it in parts. The errors
    are those of `read_asset`.

    `.ply`, `.splat` and `.compressed.ply` are read row by row. For other formats, the
    first read loads all rows.
    """
    path = asset_file(path)
    reader = _of_name(path, _READERS)
    if reader is None and not is_url(path) and is_asset_by_content(path):
        return _open_unnamed(path)
    reader = _by_name(path, _READERS)
    at_url = in_parts(path)
    if isinstance(at_url, FileAtUrl):
        return _open_fetched(at_url, reader)
    reader, notes = _by_content(at_url, reader)
    return _noted(reader(at_url), notes)


def _open_unnamed(path: AnyPath) -> AssetFile:
    """Open a file whose suffix is unknown. Its content selects the reader."""
    content = content_of(path)
    assert content is not None
    note = f"The end of its name is unknown; the file is {content.text} and was read as such."
    return _noted(_READERS[content.suffix](path), (note,))


def _by_content(path: AnyPath, reader: _Reader) -> tuple[_Reader, tuple[str, ...]]:
    """Return the function that opens a file. If its content has another format than its
    name, return the function for the content, and a note about this. Raise ValueError
    if no reader supports the content."""
    content = content_of(path)
    if content is None or _READERS.get(content.suffix) is reader:
        return reader, ()
    name = beside(path).name.lower()
    ending = next(ending for ending in _READERS if name.endswith(ending))
    check(path, is_asset_by_content(path), f"a {ending}, got {content.text}")
    note = f"The name ends in {ending}, but the file is {content.text}; it was read as such."
    return _READERS[content.suffix], (note,)


def _noted(file: AssetFile, notes: tuple[str, ...]) -> AssetFile:
    """Return the file with some notes added in front of its own."""
    return replace(file, declared=replace(file.declared, notes=(*notes, *file.declared.notes)))


def _open_fetched(at_url: FileAtUrl, reader: _Reader) -> AssetFile:
    """Return an asset at a URL. The local copy exists as long as the result. Error
    texts name the URL."""
    with reading(at_url) as local:
        reader, notes = _by_content(local, reader)
        if reader is gltf.open_file:
            # If a document at a URL refers to other files, they are read neither from
            # the server nor from this machine.
            is_alone = len(gltf.files(pathlib.Path(local))) == 1
            expected = "the URL of an asset in one file, got one that refers to other files"
            check(shown(at_url), is_alone, f"{expected}; download its folder")
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
    """Return the files of the last checkpoint of a run of gsplat, nerfstudio or the
    code of the 3DGS paper. Together they are one asset."""
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
    """Return the size in bytes of a readable asset, including all existing files to
    which it refers."""
    path = asset_file(path)
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
    """Write an asset. An existing file is replaced only when the new one is complete.

    The end of the name selects the format (docs/formats.md lists the losses of each):

    - `.ply`: the original layout without its normals, which are always zero: x y z,
      f_dc, f_rest (channel by channel), opacity (logit), scale (log), rot. An opacity
      of 1 is written as the logit 20, an opacity of 0 as the logit -110, and a scale of
      0 as the logarithm -110. These are finite, and are read back as exactly 1, 0 and
      0.
    - `.compressed.ply`: 16 bytes per gaussian, and one byte per coefficient of higher
      SH. Gaussians are reordered.
    - `.spz`: version 3, or the given `version`.
    - `.glb`: glTF 2.0 with KHR_gaussian_splatting, in float32.
    - `.usd`, `.usda`, `.usdc`, `.usdz`: OpenUSD, one ParticleField3DGaussianSplat in
      float32.
    - `.sog`: version 2. Gaussians are reordered.

    For `.spz`, `.glb` and OpenUSD, gaussians are rotated so that y points up. The other
    formats have no defined axes, so coordinates are written unchanged.

    Args:
        gaussians: The asset, or the path of its file.
        up: The axis of the gaussians that points up: -y in most trained assets, and in
            all that `read_asset` has rotated.
        antialiased: Whether the gaussians were trained with antialiasing. The file
            declares it, if its format can (docs/formats.md). None uses
            `Gaussians.antialiased`.
        encoding: Encoding of a `.ply`; other formats have only one.
        version: Version of a `.spz`; 3 if None. Viewers from before 2025 need version
            2; version 4 needs viewers from 2026 or later.

    Raises:
        ValueError: The end of the name or the encoding is unknown, or the format cannot
            represent a value: a negative scale or an opacity outside [0, 1]. All
            formats except `.ply` also reject values that are not finite and zero
            quaternions.
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
    """Write an asset as `write_asset` does, read it back, and return what the file has
    lost. Return None for formats of float32 numbers, which lose nothing."""
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
    """Write an asset.

    For a packed format, return the gaussians in the order of the file.
    """
    write = _by_name(path, _WRITERS)
    if version is not None:
        check(
            "version",
            write is spz.write,
            f"None for {os.fspath(path)}, which is not a .spz, got {version}; leave it out",
        )
        write = partial(spz.write, version=version)
    if write is ply.write:
        one_of(encoding, "encoding", get_args(PlyEncoding))
        write = partial(ply.write, encoding=encoding)
    else:
        expected = (
            f"the default for {os.fspath(path)}, which is not a .ply, got {encoding!r}; leave it "
            "out"
        )
        check("encoding", encoding == "binary_little_endian", expected)
    one_of(up, "up", AXES)
    if turned_up(path) is not None:
        write = partial(write, up=up)
    return write(path, gaussians)


def turned_up(path: AnyPath) -> Axis | None:
    """Return the axis that points up in a file that `write_asset` writes. It depends on
    the end of the name. Return None for formats without defined axes."""
    return _of_name(path, _UP)


def _of_name(path: AnyPath, formats: Mapping[str, Format]) -> Format | None:
    """Return the first value in a table whose key is the end of a file's name, or
    None."""
    name = beside(path).name.lower()
    for ending, value in formats.items():
        if name.endswith(ending):
            return value
    return None


def _by_name(path: AnyPath, formats: Mapping[str, Format]) -> Format:
    """Return the result of `_of_name`; raise ValueError if no end matches."""
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
            advice += ", so rename it to end in that"
    raise ValueError(
        f"{shown(path)}: expected a file name that ends in {', '.join(formats)}{advice}"
    )
