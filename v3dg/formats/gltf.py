"""`.glb`: glTF 2.0 with KHR_gaussian_splatting, as float attributes or compressed in
`.spz`.

The writer writes one primitive; the reader reads all primitives of gaussians, of nodes
without transforms. Both turn gaussians: the axes of glTF are left, up, forward.
"""

import json
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._json import Node, parse_json
from v3dg._numbers import Floats
from v3dg._version import __version__
from v3dg.cameras import Axis
from v3dg.formats import _axes, spz
from v3dg.formats._declared import Declared
from v3dg.formats._packing import SH_C0, assemble, check_writable
from v3dg.formats._reading import (
    AnyPath,
    AssetFile,
    Claims,
    check,
    integer_of,
    value_errors,
    whole_file,
)
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_NAME = "KHR_gaussian_splatting"
_SPZ = "KHR_gaussian_splatting_compression_spz_2"
_MAGIC = 0x46546C67  # "glTF"
_JSON = 0x4E4F534A  # "JSON"
_BINARY = 0x004E4942  # "BIN\0"
_BYTE = 5121
_FLOAT = 5126
_ARRAY_BUFFER = 34962
_DTYPES = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MOST_GAUSSIANS = 1 << 40
_MOST_JSON = 1 << 20  # bytes

JsonObject: TypeAlias = dict[str, object]


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.glb` file; all of it is read with its first rows."""
    file = _Glb(Path(path))
    opened = whole_file(path, sum(map(file.count_of, file.primitives)), file.degree, read)
    return replace(opened, declared=Declared(up=_axes.MEMORY_UP, up_reason="as in glTF"))


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a `.glb` file."""
    file = _Glb(Path(path))
    gaussians = Gaussians.concatenate(
        [file.gaussians_of(primitive) for primitive in file.primitives]
    )
    return _axes.turned(gaussians, _axes.GLTF, _axes.MEMORY)


def write(path: AnyPath, gaussians: Gaussians, *, up: Axis = _axes.MEMORY_UP) -> None:
    """Write a `.glb` file with float attributes, of gaussians of which `up` is up; the
    order stays."""
    content = encode(_axes.turned(check_writable(gaussians), _axes.axes_of_up(up), _axes.GLTF))
    with _files.replacing(path) as temporary:
        Path(temporary).write_bytes(content)


def encode(host: Gaussians, *, compressed: bool = False) -> bytes:
    """A `.glb` file of NumPy gaussians with the axes of the file, whose values the
    format can hold."""
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
    extension: JsonObject = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    document: JsonObject = {"asset": {"version": "2.0", "generator": f"v3dg {__version__}"}}
    document["extensionsUsed"] = [_NAME]
    if compressed:
        extension["extensions"] = {_SPZ: {"bufferView": 0}}
        document["extensionsUsed"] = [_NAME, _SPZ]
        document["extensionsRequired"] = [_NAME, _SPZ]
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {_NAME: extension}}
    document["scene"] = 0
    document["scenes"] = [{"nodes": [0]}]
    document["nodes"] = [{"mesh": 0}]
    document["meshes"] = [{"primitives": [primitive]}]
    document["accessors"] = accessors
    document["bufferViews"] = _buffer_views(parts, are_arrays=not compressed)
    document["buffers"] = [{"byteLength": sum(map(len, parts))}]
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(_JSON, text, b" ") + _chunk(_BINARY, b"".join(parts), b"\0")
    return struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks


def _columns(host: Gaussians, *, compressed: bool) -> dict[str, NDArray[np.generic]]:
    """The attributes of gaussians by name, (N, width); if compressed, those that `.spz`
    does not replace."""
    columns: dict[str, NDArray[np.generic]] = {
        "POSITION": host.means,
        f"{_NAME}:SCALE": host.scales,
    }
    columns[f"{_NAME}:ROTATION"] = np.roll(normalised(host.quats), -1, axis=1).astype(np.float32)
    if compressed:
        color = np.concatenate([host.sh[:, 0] * SH_C0 + 0.5, host.opacities[:, None]], axis=1)
        columns["COLOR_0"] = np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)
    else:
        columns[f"{_NAME}:OPACITY"] = host.opacities[:, None]
    for i, name in enumerate(_coefficients(host.sh_degree)):
        if i or not compressed:
            columns[name] = host.sh[:, i]
    return columns


def _accessor(name: str, values: NDArray[np.generic], view: int | None) -> JsonObject:
    """The accessor of an attribute and its buffer view; None for gaussians that are
    compressed."""
    kind = _BYTE
    if values.dtype == np.float32:
        kind = _FLOAT
    accessor: JsonObject = {
        "componentType": kind,
        "count": len(values),
        "type": _TYPES[values.shape[1]],
    }
    if view is not None:
        accessor["bufferView"] = view
    if kind == _BYTE:
        accessor["normalized"] = True
    if name == "POSITION" and len(values):
        accessor["min"] = values.min(axis=0).tolist()
        accessor["max"] = values.max(axis=0).tolist()
    return accessor


def _buffer_views(parts: list[bytes], *, are_arrays: bool) -> list[JsonObject]:
    """The views of the parts of the binary chunk, one after another."""
    views = []
    offset = 0
    for part in parts:
        view: JsonObject = {"buffer": 0, "byteOffset": offset, "byteLength": len(part)}
        if are_arrays:
            view["target"] = _ARRAY_BUFFER  # validators ask for it
        views.append(view)
        offset += len(part)
    return views


def _chunk(kind: int, content: bytes, padding: bytes) -> bytes:
    """A chunk of the file, padded to a multiple of four bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content


def _coefficients(degree: int) -> list[str]:
    """Attributes of spherical harmonics, in order."""
    return [f"{_NAME}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


class _Glb:
    """A file: its JSON, its binary chunk, and the primitives in it that are gaussians,
    of one SH degree."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._claims = Claims()
        self._expanded = 0  # bytes of `.spz` that were decoded
        content = self._claims.read(path)
        check(
            path,
            len(content) >= 20,
            f"a .glb file, glTF 2.0 that is whole, got {len(content)} bytes",
        )
        with value_errors(path, "a .glb file, glTF 2.0 that is whole"):
            magic, version, total, size, kind = struct.unpack_from("<IIIII", content)
            if (magic, version, total, kind) != (
                _MAGIC,
                2,
                len(content),
                _JSON,
            ) or size > _MOST_JSON:
                raise ValueError(f"{content[:20].hex(' ')} at the start of {len(content)} bytes")
            self._root = Node(parse_json(content[20 : 20 + size].decode("utf-8")), str(path), "")
        self._blob = memoryview(content)[28 + size :]
        kinds = ("accessors", "bufferViews", "buffers")
        self._arrays = {kind: list(self._root.field(kind).items()) for kind in kinds}
        meshes = self._root.field("meshes").items()
        self.primitives = []
        for mesh in meshes:
            for primitive in mesh.field("primitives").items():
                if primitive.has("extensions") and primitive.field("extensions").has(_NAME):
                    self.primitives.append(primitive)
        check(path, self.primitives, f"a primitive with {_NAME}, got none; meshes are not read")
        self._check_nodes()
        self.degree = self._sh_degree()

    def _check_nodes(self) -> None:
        """Raise ValueError for a node with a transform."""
        if not self._root.has("nodes"):
            return
        for node in self._root.field("nodes").items():
            for name in ("matrix", "translation", "rotation", "scale"):
                if node.has(name):
                    raise node.problem(
                        f"expected a node without a transform, got {name}; apply it first"
                    )

    def _sh_degree(self) -> int:
        """The SH degree of the primitives; ValueError if they differ."""
        attributes = [primitive.field("attributes") for primitive in self.primitives]
        degrees = sorted(set(map(_sh_degree_of, attributes)))
        check(self._path, len(degrees) == 1, f"one SH degree in all primitives, got {degrees}")
        return degrees[0]

    def _item(self, kind: str, node: Node, field: str) -> Node:
        """The item of one of the root's arrays whose number is in a field of the
        node."""
        items = self._arrays[kind]
        return items[integer_of(node.field(field), f"0 to {len(items) - 1}", 0, len(items) - 1)]

    def count_of(self, primitive: Node) -> int:
        accessor = self._item("accessors", primitive.field("attributes"), "POSITION")
        return integer_of(accessor.field("count"), "a number of gaussians", 0, _MOST_GAUSSIANS)

    def gaussians_of(self, primitive: Node) -> Gaussians:
        extension = primitive.field("extensions").field(_NAME)
        if extension.has("extensions") and extension.field("extensions").has(_SPZ):
            view = self._item(
                "bufferViews", extension.field("extensions").field(_SPZ), "bufferView"
            )
            content = bytes(self._view(view))
            # Limited, so that many primitives cannot share one large stream.
            self._expanded += len(content)
            limit = len(self._blob)
            check(
                self._path, self._expanded <= limit, f"{limit} bytes of .spz, got {self._expanded}"
            )
            return spz.decode(self._path, content, self._claims)
        count = self.count_of(primitive)
        attributes = primitive.field("attributes")
        self._claims.add(self._path, count)

        def column(name: str, width: int) -> Callable[[slice], Floats]:
            return self._column(self._item("accessors", attributes, name), count, width)

        mean = column("POSITION", 3)
        scale = column(f"{_NAME}:SCALE", 3)
        opacity = column(f"{_NAME}:OPACITY", 1)
        quat = column(f"{_NAME}:ROTATION", 4)
        sh = [column(name, 3) for name in _coefficients(self.degree)]

        def decode(rows: slice) -> tuple[NDArray[np.floating], ...]:
            widths = scale(rows)
            advice = "drafts of the extension had their logs; write the file with a newer program"
            check(self._path, not (widths < 0).any(), f"scales of 0 or more, got less; {advice}")
            colors = np.stack([coefficient(rows) for coefficient in sh], axis=1)
            return (
                mean(rows),
                normalised(np.roll(quat(rows), 1, axis=1)),
                widths,
                opacity(rows)[:, 0],
                colors,
            )

        return assemble(count, self.degree, decode)

    def _view(self, view: Node) -> memoryview:
        """The bytes of a view of the binary chunk."""
        integer_of(view.field("buffer"), "0, the file's own buffer", 0, 0)
        first = _offset(view, len(self._blob))
        limit = len(self._blob) - first
        num_bytes = integer_of(view.field("byteLength"), f"at most {limit} bytes", 0, limit)
        return self._blob[first : first + num_bytes]

    def _column(self, accessor: Node, count: int, width: int) -> Callable[[slice], Floats]:
        """A function from a slice to these rows of an attribute, in double
        precision."""
        kind = accessor.field("componentType")
        view = self._item("bufferViews", accessor, "bufferView")
        if not isinstance(kind.value, int) or kind.value not in _DTYPES:
            raise kind.error(f"one of {', '.join(map(str, _DTYPES))}")
        if accessor.field("type").value != _TYPES[width]:
            raise accessor.field("type").error(_TYPES[width])
        integer_of(accessor.field("count"), f"{count}, as POSITION has", count, count)
        dtype = np.dtype(_DTYPES[kind.value])
        content = self._view(view)
        size = dtype.itemsize * width
        stride = size
        if view.has("byteStride"):
            stride = integer_of(view.field("byteStride"), "4 to 252", 4, 252)
        first = _offset(accessor, len(content))
        if count and first + (count - 1) * stride + size > len(content):
            raise accessor.problem(f"expected {count} values in its view, got {len(content)} bytes")
        rows = np.ndarray((count, width), dtype, content, first, (stride, dtype.itemsize))
        divisor = 1.0
        lower_bound = -np.inf
        if dtype.kind != "f" and accessor.has("normalized") and accessor.field("normalized").value:
            divisor = float(np.iinfo(dtype).max)
            lower_bound = -1.0
        return lambda block: np.maximum(rows[block].astype(np.float64) / divisor, lower_bound)


def _sh_degree_of(attributes: Node) -> int:
    """The SH degree of a primitive, by the names of its attributes."""
    for degree in (3, 2, 1):
        if attributes.has(f"{_NAME}:SH_DEGREE_{degree}_COEF_0"):
            return degree
    return 0


def _offset(node: Node, limit: int) -> int:
    if not node.has("byteOffset"):
        return 0
    return integer_of(node.field("byteOffset"), f"0 to {limit}", 0, limit)
