"""glTF files of gaussians, built from parts so that a test can change any part."""

import base64
import json
import struct

import numpy as np

from random_bundle import random_gaussians
from v3dg.formats import spz

NAME = "KHR_gaussian_splatting"
FLOAT = 5126
DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", FLOAT: "<f4"}
TYPES = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}


class GltfFile:
    """A document, and the bytes of its first buffer."""

    def __init__(self):
        self.blob = bytearray()
        self.document = {
            "asset": {"version": "2.0"},
            "extensionsUsed": [NAME],
            "accessors": [],
            "bufferViews": [],
            "buffers": [{"byteLength": 0}],
            "meshes": [],
        }

    def view(self, content, **fields):
        """Return the index of a new buffer view with these bytes."""
        self.blob += bytes(-len(self.blob) % 4)
        view = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content), **fields}
        self.blob += content
        self.document["bufferViews"].append(view)
        return len(self.document["bufferViews"]) - 1

    def accessor(self, values, kind=FLOAT, **fields):
        """Return the index of a new accessor of values (N, width) in a separate
        view."""
        rows = np.asarray(values).reshape(len(values), -1).astype(DTYPES[kind])
        return self.bare_accessor(rows, kind, bufferView=self.view(rows.tobytes()), **fields)

    def bare_accessor(self, rows, kind=FLOAT, **fields):
        """Return the index of a new accessor without a view, for values of this
        shape."""
        accessor = {"componentType": kind, "count": len(rows), "type": TYPES[rows.shape[1]]}
        self.document["accessors"].append({**accessor, **fields})
        return len(self.document["accessors"]) - 1

    def attributes(self, gaussians, prefix=f"{NAME}:"):
        """Return the attributes of gaussians by name."""
        names = [f"SH_DEGREE_{d}_COEF_{n}" for d in range(4) for n in range(2 * d + 1)]
        values = {
            "POSITION": gaussians.means,
            f"{prefix}SCALE": gaussians.scales,
            f"{prefix}ROTATION": np.roll(gaussians.quats, -1, axis=1),
            f"{prefix}OPACITY": gaussians.opacities,
        }
        for k in range(gaussians.sh.shape[1]):
            values[prefix + names[k]] = gaussians.sh[:, k]
        return {name: self.accessor(array) for name, array in values.items()}

    def primitive(self, attributes, **properties):
        """Return a primitive of gaussians with these attributes."""
        extension = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display", **properties}
        return {"mode": 0, "attributes": attributes, "extensions": {NAME: extension}}

    def mesh(self, *parts):
        """Return the index of a new mesh of gaussians, or of primitives."""
        primitives = [
            part if isinstance(part, dict) else self.primitive(self.attributes(part))
            for part in parts
        ]
        self.document["meshes"].append({"primitives": primitives})
        return len(self.document["meshes"]) - 1

    def nodes(self, *nodes, roots=(0,)):
        """Set the nodes, and a scene that has some of them."""
        self.document.update(nodes=list(nodes), scenes=[{"nodes": list(roots)}], scene=0)
        return self

    def write(self, path, uri=None):
        """Write a `.glb`, or a `.gltf` whose buffer is in a data: URI or in a separate
        file."""
        buffer = self.document["buffers"][0]
        buffer["byteLength"] = len(self.blob)
        if path.suffix == ".gltf":
            data = "data:application/octet-stream;base64," + base64.b64encode(self.blob).decode()
            buffer["uri"] = uri or data
            path.write_text(json.dumps(self.document))
        else:
            path.write_bytes(glb_bytes(self.document, bytes(self.blob)))
        return path


def file_of_every_part():
    """Return a file with every kind of part that a reader visits: ten gaussians in two
    meshes."""
    asset = random_gaussians(np.random.default_rng(0), 5, 1)
    file = GltfFile()
    attributes = file.attributes(asset)
    part = {
        "count": 1,
        "indices": {"bufferView": file.view(b"\x02"), "componentType": 5121},
        "values": {"bufferView": file.view(bytes(12))},
    }
    attributes["POSITION"] = file.bare_accessor(asset.means, sparse=part)
    plain = file.primitive(attributes, colorSpace="lin_rec709_display", extras={})
    plain["indices"] = file.accessor(np.arange(5), 5123)
    stream = {"bufferView": file.view(b"".join(spz.encode(asset, 2)))}
    packed = file.primitive({}, extensions={f"{NAME}_compression_spz_2": stream})
    packed["attributes"]["POSITION"] = file.bare_accessor(asset.means)
    matrix = [2, 0, 0, 0, 0, 3, 0, 0, 0, 0, 4, 0, 1, 1, 1, 1]
    file.nodes(
        {"children": [1, 2], "rotation": [0, 0, 0, 1], "scale": [2, 2, 2]},
        {"mesh": file.mesh(plain), "translation": [1, 2, 3]},
        {"mesh": file.mesh(packed), "matrix": matrix},
    )
    file.document["bufferViews"][0]["byteStride"] = 12
    file.document["extensionsRequired"] = [NAME]
    return file


def glb_bytes(document, blob=b""):
    """Return the bytes of a `.glb` with this JSON and this binary chunk."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    blob += bytes(-len(blob) % 4)
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks
