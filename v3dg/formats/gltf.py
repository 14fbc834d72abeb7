"""glTF 2.0 with KHR_gaussian_splatting, `.glb` or `.gltf`. The gaussians are
attributes, or a compressed `.spz`.

The writer writes one primitive. The reader reads all gaussians of a scene, placed by
their nodes. Both convert between the axes in memory and those of glTF, which are left,
up, forward.
"""

import json
import struct
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._version import __version__
from v3dg.cameras import Axis
from v3dg.formats import _axes, spz
from v3dg.formats._declared import Declared
from v3dg.formats._gltf_accessors import BYTE, FLOAT, TYPES
from v3dg.formats._gltf_document import BINARY_CHUNK, JSON_CHUNK, MAGIC, Document
from v3dg.formats._gltf_primitives import NAME, SPZ, coefficients
from v3dg.formats._gltf_scene import Scene
from v3dg.formats._packing import SH_C0, check_writable
from v3dg.formats._reading import AnyPath, AssetFile, whole_file
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_ARRAY_BUFFER = 34962

JsonObject: TypeAlias = dict[str, object]


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.glb` or `.gltf` file. The first read loads all of it."""
    document = Document(Path(path))
    scene = Scene(document)
    declared = Declared(_axes.MEMORY_UP, "as in glTF", scene.antialiased, tuple(scene.notes))
    return whole_file(path, scene.count, scene.degree, read, document.buffer_files(), declared)


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a `.glb` or `.gltf` file."""
    return _axes.turned(Scene(Document(Path(path))).read(), _axes.GLTF, _axes.MEMORY)


def files(path: Path) -> list[Path]:
    """Return the document itself and the files of its buffers."""
    return [path, *Document(path).buffer_files()]


def write(path: AnyPath, gaussians: Gaussians, *, up: Axis = _axes.MEMORY_UP) -> None:
    """Write a `.glb` file with float attributes, in the order of the gaussians. `up` is
    the axis of the gaussians that points up."""
    content = encode(_axes.turned(check_writable(gaussians), _axes.axes_of_up(up), _axes.GLTF))
    with _files.replacing(path) as temporary:
        Path(temporary).write_bytes(content)


def encode(host: Gaussians, *, compressed: bool = False) -> bytes:
    """Return the content of a `.glb` file. The gaussians must be on the host, have the
    axes of the file, and contain only values that the format can store. If compressed,
    the file has the form of the draft that CesiumJS reads."""
    columns = _columns(host, compressed=compressed)
    if compressed:
        parts = [b"".join(spz.encode(host))]
    else:
        parts = [values.tobytes() for values in columns.values()]
    accessors = []
    for i, (name, values) in enumerate(columns.items()):
        view: int | None = i
        if compressed:
            view = None
        accessors.append(_accessor(name, values, view))
    extension: JsonObject = {}
    if not compressed:
        # Compressed files lack these properties. With them, readers that implement the
        # released extension would convert the axes of the `.spz`, but CesiumJS would
        # not.
        extension |= {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    if host.antialiased is not None:
        extension["extras"] = {"antialiased": host.antialiased}
    document: JsonObject = {"asset": {"version": "2.0", "generator": f"v3dg {__version__}"}}
    document["extensionsUsed"] = [NAME]
    if compressed:
        extension["extensions"] = {SPZ: {"bufferView": 0}}
        document["extensionsUsed"] = [NAME, SPZ]
        document["extensionsRequired"] = [NAME, SPZ]
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {NAME: extension}}
    document["scene"] = 0
    document["scenes"] = [{"nodes": [0]}]
    document["nodes"] = [{"mesh": 0}]
    document["meshes"] = [{"primitives": [primitive]}]
    document["accessors"] = accessors
    document["bufferViews"] = _buffer_views(parts, are_arrays=not compressed)
    document["buffers"] = [{"byteLength": sum(map(len, parts))}]
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(JSON_CHUNK, text, b" ") + _chunk(BINARY_CHUNK, b"".join(parts), b"\0")
    return struct.pack("<III", MAGIC, 2, 12 + len(chunks)) + chunks


def _columns(host: Gaussians, *, compressed: bool) -> dict[str, NDArray[np.generic]]:
    """Return the attributes of gaussians by name, (N, width). If they are compressed,
    return only those that are not in the `.spz`."""
    columns: dict[str, NDArray[np.generic]] = {
        "POSITION": host.means,
        f"{NAME}:SCALE": host.scales,
    }
    columns[f"{NAME}:ROTATION"] = np.roll(normalised(host.quats), -1, axis=1).astype(np.float32)
    if compressed:
        color = np.concatenate([host.sh[:, 0] * SH_C0 + 0.5, host.opacities[:, None]], axis=1)
        columns["COLOR_0"] = np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)
    else:
        columns[f"{NAME}:OPACITY"] = host.opacities[:, None]
    for i, name in enumerate(coefficients(host.sh_degree)):
        if i or not compressed:
            columns[f"{NAME}:{name}"] = host.sh[:, i]
    return columns


def _accessor(name: str, values: NDArray[np.generic], view: int | None) -> JsonObject:
    """Return the accessor of an attribute. `view` is the index of its buffer view, or
    None for compressed gaussians."""
    kind = BYTE
    if values.dtype == np.float32:
        kind = FLOAT
    accessor: JsonObject = {
        "componentType": kind,
        "count": len(values),
        "type": TYPES[values.shape[1]],
    }
    if view is not None:
        accessor["bufferView"] = view
    if kind == BYTE:
        accessor["normalized"] = True
    if name == "POSITION" and len(values):
        accessor["min"] = values.min(axis=0).tolist()
        accessor["max"] = values.max(axis=0).tolist()
    return accessor


def _buffer_views(parts: list[bytes], *, are_arrays: bool) -> list[JsonObject]:
    """Return the buffer views of the parts of the binary chunk."""
    views = []
    offset = 0
    for part in parts:
        view: JsonObject = {"buffer": 0, "byteOffset": offset, "byteLength": len(part)}
        if are_arrays:
            view["target"] = _ARRAY_BUFFER  # validators require this
        views.append(view)
        offset += len(part)
    return views


def _chunk(kind: int, content: bytes, padding: bytes) -> bytes:
    """Return a chunk of the file, padded to a multiple of four bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content
