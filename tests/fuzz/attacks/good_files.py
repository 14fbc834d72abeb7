"""One small valid file of each kind that is read, which attacks change: its path, and
the other files that belong to it."""

import dataclasses
import io
import json
import struct
import zipfile
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import v3dg
from gltf_files import file_of_every_part
from random_bundle import random_bundle, random_gaussians
from test_camera_file import CAPTURE, PATH
from test_formats import FIXTURES, gsplat_tensors
from test_ply import Element, ply_bytes, random_columns
from v3dg.formats import sog


@dataclasses.dataclass(frozen=True)
class Good:
    """Files by their paths. The reader is given the first one."""

    kind: str
    files: dict
    # Whether the format detects every change of its bytes; then only the original
    # content may be read.
    is_hashed: bool = False

    @property
    def name(self):
        return next(iter(self.files))

    @property
    def content(self):
        return self.files[self.name]

    def with_content(self, content):
        return dataclasses.replace(self, files={**self.files, self.name: content})


def good_files(folder):
    """Return some files of each kind, by the kind."""
    made = {}
    for good in (
        *_ply(),
        *_formats(folder),
        *_checkpoints(),
        *_bundles(folder),
        *_json(folder),
        *_pictures(),
    ):
        made.setdefault(good.kind, []).append(good)
    return made


def _ply():
    for degree, encoding in enumerate(("ascii", "binary_little_endian", "binary_big_endian")):
        columns = random_columns(5, degree)
        face = Element("face", {"indices": [np.arange(3, dtype="u2")]})
        elements = [face, Element("vertex", columns)] if degree else [Element("vertex", columns)]
        yield Good("ply", {"a.ply": ply_bytes(elements, encoding)})
        yield Good("ply", {"a.ply": ply_bytes([_of_another_trainer(degree)], encoding)})


def _of_another_trainer(degree):
    """Return files with base colours, flat gaussians, filters and numbers of other
    types."""
    columns = random_columns(5, degree)
    for i, name in enumerate(("red", "green", "blue")):
        del columns[f"f_dc_{i}"]
        columns[name] = np.arange(5, dtype="u1")
    del columns["scale_2"]
    columns["filter_3D"] = np.full(5, 0.5, "f2")
    return Element("vertex", columns | {"label": np.arange(5, dtype="i8")})


def _formats(folder):
    for degree, suffix in (
        (0, ".compressed.ply"),
        (2, ".compressed.ply"),
        (0, ".spz"),
        (3, ".spz"),
        (1, ".sog"),
    ):
        path = folder / f"good{suffix}"
        v3dg.write_asset(
            path, random_gaussians(np.random.default_rng(degree), 300 // (degree + 1), degree)
        )
        kind = suffix[1:].replace("compressed.ply", "compressed")
        yield Good(kind, {f"a{suffix}": path.read_bytes()}, is_hashed=suffix in (".spz", ".sog"))
    for path in sorted(FIXTURES.iterdir()):
        kind = path.suffix[1:]
        if kind in ("splat", "ksplat", "spz", "sog", "glb"):
            is_hashed = kind == "sog" or path.read_bytes()[:2] == b"\x1f\x8b"
            yield Good(kind, {f"a.{kind}": path.read_bytes()}, is_hashed=is_hashed)
    file = file_of_every_part()
    document = file.write(folder / "good.gltf", "a.bin").read_bytes()
    yield Good("gltf", {"a.gltf": document, "a.bin": bytes(file.blob)})
    parts = sog.encode(random_gaussians(np.random.default_rng(1), 40, 1))
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name, content in parts.items():
            archive.writestr(f"folder/{name}", content)
    yield Good("sog", {"a.sog": stream.getvalue()}, is_hashed=True)
    yield Good("sog_folder", {"meta.json": parts.pop("meta.json"), **parts})
    yield streamed(4)


def streamed(num_folders, names=None, **more):
    """Return a streamed SOG with folders of 40 gaussians, one leaf each."""
    parts = sog.encode(random_gaussians(np.random.default_rng(2), 40, 0))
    names = names or [f"{i}/meta.json" for i in range(num_folders)]
    box = {"min": [-9.0] * 3, "max": [9.0] * 3}
    leaves = [
        {"bound": box, "lods": {"0": {"file": i, "offset": 0, "count": 40}}}
        for i in range(len(names))
    ]
    index = {
        "version": 1,
        "filenames": names,
        "tree": {"bound": box, "children": leaves},
    }
    files = {"lod-meta.json": json.dumps(index | more).encode()}
    for name in dict.fromkeys(names):
        files |= {f"{Path(name).parent}/{part}": content for part, content in parts.items()}
    return Good("streamed", files)


def checkpoint_bytes(tensors, **options):
    stream = io.BytesIO()
    torch.save({"step": 3, "splats": tensors}, stream, **options)
    return stream.getvalue()


def _checkpoints():
    tensors = gsplat_tensors(random_gaussians(np.random.default_rng(3), 50, 1))
    yield Good("checkpoint", {"a.pt": checkpoint_bytes(tensors)}, is_hashed=True)
    names = {"sh0": "features_dc", "shN": "features_rest"}
    values = {
        f"_model.gauss_params.{names.get(name, name)}": tensor for name, tensor in tensors.items()
    }
    stream = io.BytesIO()
    torch.save({"pipeline": values}, stream)
    yield Good("checkpoint", {"a.ckpt": stream.getvalue()}, is_hashed=True)
    order = ("means", "sh0", "shN", "scales", "quats", "opacities")
    captured = (1, *(tensors[name] for name in order), *[torch.zeros(2)] * 3, {}, 2.0)
    stream = io.BytesIO()
    torch.save((captured, 30000), stream)
    yield Good("checkpoint", {"a.pth": stream.getvalue()}, is_hashed=True)
    colors = {name: tensors[name] for name in ("means", "scales", "quats", "opacities")}
    colors["colors"] = tensors["sh0"][:, 0]
    settings = b"antialiased: true\nmodel_type: 2dgs\n"
    files = {"a.pt": checkpoint_bytes(colors), "cfg.yml": settings}
    yield Good("checkpoint", files)  # the settings are not part of the hash


def _bundles(folder):
    for seed, levels in ((0, 1), (1, 3), (2, 4)):
        path = folder / "good.v3dg"
        random_bundle(seed, num_levels=levels, sh_degree=seed % 2, config={"seed": seed}).write(
            path
        )
        yield Good("bundle", {"a.v3dg": path.read_bytes()}, is_hashed=True)


def _json(folder):
    bundle = (folder / "good.v3dg").read_bytes()
    beside = {"a.v3dg": bundle, "sub/b.v3dg": bundle}
    documents = list(_documents())
    for document in documents[:3]:
        yield Good("scene", {"scene.json": document, **beside})
    others = [json.dumps(document).encode() for document in (PATH, [CAMERA_OF_3DGS] * 2)]
    for document in (json.dumps(CAPTURE).encode(), *documents[3:], *others):
        yield Good("cameras", {"transforms.json": document})
    yield from _models_of_colmap()


CAMERA_OF_3DGS = {
    "id": 0,
    "img_name": "a",
    "width": 64,
    "height": 48,
    "position": [0, 0, -5],
    "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "fy": 50,
    "fx": 50,
}


def _models_of_colmap():
    """Return models with two images of one camera, binary and as text."""
    lens = struct.pack("<QIiQQ4d", 1, 1, 1, 64, 48, 50, 50, 32, 24)
    image = struct.pack("<7dI", 1, 0, 0, 0, 0, 0, 5, 1) + b"a b.jpg\0" + bytes(8)
    images = struct.pack("<QI", 2, 1) + image + struct.pack("<I", 2) + image
    yield Good("colmap", {"images.bin": images, "cameras.bin": lens})
    text = b"# images\n1 1 0 0 0 0 0 5 1 a b.jpg\n\n2 1 0 0 0 0 0 5 1 c.jpg\n1 2 -1\n"
    yield Good("colmap", {"images.txt": text, "cameras.txt": b"1 PINHOLE 64 48 50 50 32 24\n"})


def _documents():
    """Return three scenes and two camera files, one of each kind that is read."""
    pose = {"position": [1, 2, 3], "quaternion": [1, 0, 0, 0.5], "scale": 2}
    matrix = [[1, 0, 0, 0], [0, 0, -1, -5], [0, 1, 0, 1], [0, 0, 0, 1]]
    size = {"width": 64, "height": 48}
    scene = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"a": "a.v3dg", "b": "sub/b.v3dg"},
        "instances": [{"bundle": "a", **pose}, {"bundle": "b", "position": [0, 0, 0]}],
        "cameras": [
            {
                "name": "eye",
                **size,
                "eye": [0, -8, 2],
                "target": [0, 0, 0],
                "up": [0, 0, 1],
                "fov_x": 1,
            },
            {
                "name": "matrices",
                **size,
                "near": 0.1,
                "viewmat": matrix,
                "K": np.diag([50, 50, 1]).tolist(),
            },
        ],
    }
    flat = {
        "name": "Sea",
        "asset": "a",
        "convention": "camera to world",
        "instances": [pose],
        "cameras": [{"name": "0", **size, "fov_x": 0.8, "fov_y": 0.6, "transform_matrix": matrix}],
    }
    camera = {
        "camera_name": "0",
        "camera_width": 64,
        "camera_height": 48,
        "transform_matrix": matrix,
    }
    angles = {"camera_angle_x": 0.8, "camera_angle_y": 0.6}
    instance = {"positions": [1, 2, 3], "quaternions": [1, 0, 0, 0], "scale": 2}
    asset = {
        "asset_kind": "k",
        "asset_name": "a",
        "ply_suffix": "p/fused.ply",
        "instances": [instance],
    }
    layouts = {
        "layouts": [{"layout_name": "0", "assets": [asset], "cameras": [{**camera, **angles}] * 2}]
    }
    frames = [{"file_path": f"{i}.png", "transform_matrix": matrix} for i in range(2)]
    lens = {
        "camera_model": "OPENCV",
        "fl_x": 50,
        "fl_y": 60,
        "cx": 32,
        "cy": 24,
        "w": 64,
        "h": 48,
        "k1": 0,
    }
    documents = (scene, flat, layouts, {**lens, "frames": frames}, {**angles, "frames": frames})
    yield from (json.dumps(document).encode() for document in documents)


def _pictures():
    rng = np.random.default_rng(4)
    picture = Image.fromarray(rng.integers(0, 255, (24, 32, 3), np.uint8))
    for name, kind in (("a.png", "PNG"), ("a.jpg", "JPEG"), ("a.png", "JPEG")):
        stream, beside = io.BytesIO(), io.BytesIO()
        picture.save(stream, kind)
        picture.save(beside, "PNG")
        yield Good("picture", {name: stream.getvalue(), "b.png": beside.getvalue()})


def zip_entries(content):
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return [(entry, archive.read(entry)) for entry in archive.infolist()]
