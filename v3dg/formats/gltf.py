"""`.glb`: glTF 2.0 with KHR_gaussian_splatting, as float attributes or compressed in `.spz`.

Written is one primitive; read are all primitives that are gaussians, of nodes without transforms. Coordinates
are passed on as they are stored; glTF's have y up.
"""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from v3dg import _files
from v3dg._json import Node, parse_json
from v3dg._numbers import Floats
from v3dg._version import __version__
from v3dg.formats import spz
from v3dg.formats._packing import SH_C0, assemble, check_writable
from v3dg.formats._reading import AssetFile, Claims, check, telling, whole, whole_file
from v3dg.formats._reading import Path as AnyPath
from v3dg.gaussians import Gaussians
from v3dg.rotations import normalised

_NAME = "KHR_gaussian_splatting"
_SPZ = "KHR_gaussian_splatting_compression_spz_2"
_MAGIC, _JSON, _BINARY = 0x46546C67, 0x4E4F534A, 0x004E4942
_BYTE, _FLOAT = 5121, 5126
_DTYPES = {5120: "i1", _BYTE: "u1", 5122: "<i2", 5123: "<u2", _FLOAT: "<f4"}
_TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}
_MOST_GAUSSIANS = 1 << 40
_MOST_JSON = 1 << 20  # bytes


def open_file(path: AnyPath) -> AssetFile:
    """Open a `.glb` file; all of it is read with its first rows."""
    file = _Glb(Path(path))
    return whole_file(path, sum(map(file.count_of, file.primitives)), file.degree, read)


def read(path: AnyPath) -> Gaussians:
    """Read the gaussians of a `.glb` file."""
    file = _Glb(Path(path))
    return Gaussians.concatenate([file.gaussians_of(primitive) for primitive in file.primitives])


def write(path: AnyPath, gaussians: Gaussians) -> None:
    """Write a `.glb` file with float attributes; the order stays."""
    content = encode(check_writable(gaussians))
    with _files.replacing(path) as temporary:
        Path(temporary).write_bytes(content)


def encode(host: Gaussians, *, compressed: bool = False) -> bytes:
    """A `.glb` file, of NumPy gaussians with values that can be held."""
    columns: dict[str, NDArray[Any]] = {"POSITION": host.means, f"{_NAME}:SCALE": host.scales}
    columns[f"{_NAME}:ROTATION"] = np.roll(normalised(host.quats), -1, axis=1).astype(np.float32)
    if compressed:
        color = np.concatenate([host.sh[:, 0] * SH_C0 + 0.5, host.opacities[:, None]], axis=1)
        columns["COLOR_0"] = np.rint(np.clip(color, 0, 1) * 255).astype(np.uint8)
    else:
        columns[f"{_NAME}:OPACITY"] = host.opacities[:, None]
    for i, name in enumerate(_coefficients(host.sh_degree)):
        if i or not compressed:
            columns[name] = host.sh[:, i]
    packed = [b"".join(spz.encode(host))] if compressed else [values.tobytes() for values in columns.values()]
    ends = np.cumsum([0, *map(len, packed)]).tolist()
    accessors: list[dict[str, Any]] = []
    for i, (name, values) in enumerate(columns.items()):
        kind = _FLOAT if values.dtype == np.float32 else _BYTE
        shape = {"componentType": kind, "count": len(host), "type": _TYPES[values.shape[1]]}
        place = {} if compressed else {"bufferView": i}
        accessors.append(shape | place | ({"normalized": True} if kind == _BYTE else {}))
        if name == "POSITION" and len(host):
            accessors[-1] |= {"min": values.min(axis=0).tolist(), "max": values.max(axis=0).tolist()}
    extension: dict[str, Any] = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
    used: dict[str, Any] = {"extensionsUsed": [_NAME]}
    if compressed:
        extension["extensions"] = {_SPZ: {"bufferView": 0}}
        used = {"extensionsUsed": [_NAME, _SPZ], "extensionsRequired": [_NAME, _SPZ]}
    attributes = {name: i for i, name in enumerate(columns)}
    primitive = {"mode": 0, "attributes": attributes, "extensions": {_NAME: extension}}
    document = {
        "asset": {"version": "2.0", "generator": f"v3dg {__version__}"},
        **used,
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "accessors": accessors,
        "bufferViews": [
            {"buffer": 0, "byteOffset": first, "byteLength": len(part)}
            | ({} if compressed else {"target": 34962})  # ARRAY_BUFFER, which validators ask for
            for first, part in zip(ends, packed, strict=False)
        ],
        "buffers": [{"byteLength": ends[-1]}],
    }
    text = json.dumps(document, separators=(",", ":")).encode()
    chunks = _chunk(_JSON, text, b" ") + _chunk(_BINARY, b"".join(packed), b"\0")
    return struct.pack("<III", _MAGIC, 2, 12 + len(chunks)) + chunks


def _chunk(kind: int, content: bytes, padding: bytes) -> bytes:
    """A chunk of the file, filled up to a multiple of four bytes."""
    content += padding * (-len(content) % 4)
    return struct.pack("<II", len(content), kind) + content


def _coefficients(degree: int) -> list[str]:
    """Attributes of spherical harmonics, in order."""
    return [f"{_NAME}:SH_DEGREE_{d}_COEF_{n}" for d in range(degree + 1) for n in range(2 * d + 1)]


class _Glb:
    """A file: its JSON, its binary chunk, and the primitives in it that are gaussians, of one SH degree."""

    def __init__(self, path: Path) -> None:
        self._path, self._claims, self._expanded = path, Claims(), 0
        content = self._claims.read(path)
        check(path, len(content) >= 20, f"a .glb file, glTF 2.0 that is whole, got {len(content)} bytes")
        with telling(path, "a .glb file, glTF 2.0 that is whole"):
            magic, version, total, size, kind = struct.unpack_from("<IIIII", content)
            if (magic, version, total, kind) != (_MAGIC, 2, len(content), _JSON) or size > _MOST_JSON:
                raise ValueError(f"{content[:20].hex(' ')} at the start of {len(content)} bytes")
            self._root = Node(parse_json(content[20 : 20 + size].decode("utf-8")), str(path), "")
        self._blob = memoryview(content)[28 + size :]
        kinds = ("accessors", "bufferViews", "buffers")
        self._arrays = {kind: list(self._root.field(kind).items()) for kind in kinds}
        meshes = self._root.field("meshes").items()
        primitives = (p for mesh in meshes for p in mesh.field("primitives").items())
        self.primitives = [p for p in primitives if p.has("extensions") and p.field("extensions").has(_NAME)]
        check(path, self.primitives, f"a primitive with {_NAME}, got none; meshes are not read")
        for node in self._root.field("nodes").items() if self._root.has("nodes") else ():
            for name in ("matrix", "translation", "rotation", "scale"):
                if node.has(name):
                    raise node.problem(f"expected a node without a transform, got {name}; apply it first")
        attributes = [primitive.field("attributes") for primitive in self.primitives]
        names = {f"{_NAME}:SH_DEGREE_{d}_COEF_0": d for d in (1, 2, 3)}
        degrees = sorted({max((names[n] for n in names if a.has(n)), default=0) for a in attributes})
        check(path, len(degrees) == 1, f"one SH degree in all primitives, got {degrees}")
        self.degree = degrees[0]

    def _item(self, kind: str, node: Node, field: str) -> Node:
        """One of the root's arrays' values, by the number in a field."""
        items = self._arrays[kind]
        return items[whole(node.field(field), f"0 to {len(items) - 1}", 0, len(items) - 1)]

    def count_of(self, primitive: Node) -> int:
        accessor = self._item("accessors", primitive.field("attributes"), "POSITION")
        return whole(accessor.field("count"), "a number of gaussians", 0, _MOST_GAUSSIANS)

    def gaussians_of(self, primitive: Node) -> Gaussians:
        extension = primitive.field("extensions").field(_NAME)
        if extension.has("extensions") and extension.field("extensions").has(_SPZ):
            view = self._item("bufferViews", extension.field("extensions").field(_SPZ), "bufferView")
            content = bytes(self._view(view))
            self._expanded += len(content)  # so that many primitives cannot have one large stream
            most = len(self._blob)
            check(self._path, self._expanded <= most, f"{most} bytes of .spz, got {self._expanded}")
            return spz.decode(self._path, content, self._claims)
        count, attributes = self.count_of(primitive), primitive.field("attributes")
        self._claims.add(self._path, count)

        def column(name: str, width: int) -> Callable[[slice], Floats]:
            return self._column(self._item("accessors", attributes, name), count, width)

        mean, scale = column("POSITION", 3), column(f"{_NAME}:SCALE", 3)
        opacity, quat = column(f"{_NAME}:OPACITY", 1), column(f"{_NAME}:ROTATION", 4)
        sh = [column(name, 3) for name in _coefficients(self.degree)]

        def decode(rows: slice) -> tuple[NDArray[np.floating[Any]], ...]:
            widths = scale(rows)
            advice = "drafts of the extension had their logs; write the file with a newer program"
            check(self._path, not (widths < 0).any(), f"scales of 0 or more, got less; {advice}")
            colors = np.stack([of(rows) for of in sh], axis=1)
            return mean(rows), normalised(np.roll(quat(rows), 1, axis=1)), widths, opacity(rows)[:, 0], colors

        return assemble(count, self.degree, decode)

    def _view(self, view: Node) -> memoryview:
        """The bytes of a view of the binary chunk."""
        whole(view.field("buffer"), "0, the file's own buffer", 0, 0)
        first = _offset(view, len(self._blob))
        most = len(self._blob) - first
        return self._blob[first : first + whole(view.field("byteLength"), f"at most {most} bytes", 0, most)]

    def _column(self, accessor: Node, count: int, width: int) -> Callable[[slice], Floats]:
        """What gives an attribute's rows, in double precision."""
        kind, view = accessor.field("componentType"), self._item("bufferViews", accessor, "bufferView")
        if not isinstance(kind.value, int) or kind.value not in _DTYPES:
            raise kind.error(f"one of {', '.join(map(str, _DTYPES))}")
        if accessor.field("type").value != _TYPES[width]:
            raise accessor.field("type").error(_TYPES[width])
        whole(accessor.field("count"), f"{count}, as POSITION has", count, count)
        dtype, content = np.dtype(_DTYPES[kind.value]), self._view(view)
        size = dtype.itemsize * width
        stride = whole(view.field("byteStride"), "4 to 252", 4, 252) if view.has("byteStride") else size
        first = _offset(accessor, len(content))
        if count and first + (count - 1) * stride + size > len(content):
            raise accessor.problem(f"expected {count} values in its view, got {len(content)} bytes")
        rows = np.ndarray((count, width), dtype, content, first, (stride, dtype.itemsize))
        is_share = dtype.kind != "f" and accessor.has("normalized") and accessor.field("normalized").value
        largest, least = (float(np.iinfo(dtype).max), -1.0) if is_share else (1.0, -np.inf)
        return lambda block: np.maximum(rows[block].astype(np.float64) / largest, least)


def _offset(node: Node, most: int) -> int:
    return whole(node.field("byteOffset"), f"0 to {most}", 0, most) if node.has("byteOffset") else 0
