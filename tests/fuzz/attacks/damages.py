"""Damage that must be detected, and unusual files that must be read because other
programs write them."""

import functools
import io
import json
import struct
import zipfile

import numpy as np
import torch

from fuzz.attacks.good_files import checkpoint_bytes, streamed, zip_entries
from fuzz.targets import zip_bytes
from random_bundle import random_gaussians
from test_formats import FIXTURES, gsplat_tensors
from v3dg.formats import sog


def damaged(rng):
    """Return the kind, the change, the files, the expected outcome ("read", "refused"
    or "any"), and the expected arrays."""
    make = rng.choice(DAMAGES)
    kind, files, must, *arrays = make(rng)
    return kind, make.__name__, files, must, arrays[0] if arrays else None


@functools.cache
def _asset():
    return random_gaussians(np.random.default_rng(5), 60, 1)


@functools.cache
def _checkpoint():
    """Return a checkpoint, and the result of reading it."""
    import tempfile
    from pathlib import Path

    import v3dg

    content = checkpoint_bytes(gsplat_tensors(_asset()))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pt"
        path.write_bytes(content)
        asset = v3dg.read_asset(path)
    return content, [
        getattr(asset, name) for name in ("means", "quats", "scales", "opacities", "sh")
    ]


def _with_entries(change, compression=0):
    entries = [(e.filename, content) for e, content in zip_entries(_checkpoint()[0])]
    return {"a.pt": zip_bytes([change(*entry) for entry in entries], compression)}


def storage_cut_short(rng):
    """A tensor's storage has fewer bytes than its numbers need."""
    number, share = rng.randrange(5), rng.random()

    def cut(name, content):
        return name, content[: int(share * len(content))] if name.endswith(
            f"/data/{number}"
        ) else content

    return "checkpoint", _with_entries(cut), "refused"


def other_byte_order(_):
    def swapped(name, content):
        if name.endswith("byteorder"):
            return name, b"big"
        return name, np.frombuffer(
            content, "<f4"
        ).byteswap().tobytes() if "/data/" in name else content

    return "checkpoint", _with_entries(swapped), "any", _checkpoint()[1]


def unknown_byte_order(rng):
    def other(name, content):
        return name, rng.choice((b"", b"middle", b"big\0")) if name.endswith(
            "byteorder"
        ) else content

    return "checkpoint", _with_entries(other), "any", _checkpoint()[1]


def zipped_anew(_):
    return (
        "checkpoint",
        _with_entries(lambda *entry: entry, zipfile.ZIP_DEFLATED),
        "any",
        _checkpoint()[1],
    )


def storage_changed(rng):
    """A byte of the numbers is changed, which only the CRC detects."""
    content = bytearray(_checkpoint()[0])
    entry = rng.choice([e for e, c in zip_entries(bytes(content)) if "/data/" in e.filename and c])
    name_bytes, extra = struct.unpack_from("<HH", content, entry.header_offset + 26)
    place = entry.header_offset + 30 + name_bytes + extra + rng.randrange(entry.file_size)
    content[place] ^= 1 << rng.randrange(8)
    return "checkpoint", {"a.pt": bytes(content)}, "refused"


def written_as_before_zips(rng):
    content = checkpoint_bytes(gsplat_tensors(_asset()), _use_new_zipfile_serialization=False)
    content = rng.choice((content, content[: rng.randrange(len(content))]))
    return "checkpoint", {"a.pt": content}, "any", _checkpoint()[1]


def storage_shared(_):
    """Two tensors with one storage are valid, and trainers save such files."""
    tensors = gsplat_tensors(_asset())
    sh = torch.cat([tensors["sh0"], tensors["shN"]], 1)
    tensors |= {"sh0": sh[:, :1], "shN": sh[:, 1:]}
    return "checkpoint", {"a.pt": checkpoint_bytes(tensors)}, "read", _checkpoint()[1]


def _compressed_without(names):
    content = (FIXTURES / "sh0.compressed.ply").read_bytes()
    header, body = content.split(b"end_header\n", 1)
    lines = header.split(b"\n")
    floats = [line.split()[-1].decode() for line in lines if line.startswith(b"property float")]
    chunks = int(next(line for line in lines if line.startswith(b"element chunk")).split()[-1])
    table = np.frombuffer(body, "<f4", chunks * len(floats)).reshape(chunks, -1)
    kept = [i for i, name in enumerate(floats) if name not in names]
    lines = [line for line in lines if not line or line.split()[-1].decode() not in names]
    rest = body[table.nbytes :]
    return {"a.ply": b"\n".join(lines) + b"end_header\n" + table[:, kept].tobytes() + rest}


def bounds_missing(rng):
    """Some bounds of colours, or one of positions or scales, are missing from a
    compressed .ply file."""
    colors = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]
    others = [
        f"{end}{kind}_{axis}" for end in ("min", "max") for kind in ("", "_scale") for axis in "xyz"
    ]
    names = rng.sample(colors, rng.randrange(1, 6)) if rng.random() < 0.7 else [rng.choice(others)]
    return "compressed", _compressed_without(names), "refused"


def colors_without_bounds(_):
    """Older files have no bounds of colours."""
    names = [f"{end}_{axis}" for end in ("min", "max") for axis in "rgb"]
    return "compressed", _compressed_without(names), "read"


def environment_of_another_type(rng):
    value = rng.choice((None, False, 3, [], {}, "", "../x", "0", True))
    must = "read" if value is None else "refused"
    return "streamed", streamed(2, environment=value).files, must


def filenames_missing(rng):
    good = streamed(2)
    name = rng.choice([name for name in good.files if name != good.name])
    return "streamed", {n: c for n, c in good.files.items() if n != name}, "refused"


def picture_of_another_sog(rng):
    """A picture is replaced by a file of another size, mode or kind."""
    files = dict(sog.encode(_asset()))
    from PIL import Image

    def picture(kind, mode, size):
        stream = io.BytesIO()
        Image.new(mode, size, 3).save(stream, kind)
        return stream.getvalue()

    name = rng.choice([name for name in files if name != "meta.json"])
    size = rng.choice(((1, 1), (8, 8), (7, 3), (64, 64), (192, 1)))
    files[name] = rng.choice(
        (
            picture("PNG", rng.choice(("L", "RGB", "RGBA", "P", "I;16", "1", "LA")), size),
            picture("GIF", "P", size),
            picture("BMP", "RGB", size),
            files[rng.choice(list(files))],
            b"",
        )
    )
    return "sog", {"a.sog": zip_bytes(files.items())}, "any"


def value_of_another_type(rng):
    """Each field of a SOG's meta.json in turn gets a value of another type."""
    files = dict(sog.encode(_asset()))
    meta = json.loads(files["meta.json"])
    holder, key = rng.choice(
        [(meta, key) for key in meta]
        + [(v, k) for v in meta.values() if isinstance(v, dict) for k in v]
    )
    holder[key] = rng.choice(
        (
            None,
            True,
            -1,
            1.5,
            1e400,
            1 << 64,
            "",
            "1",
            [],
            [[]],
            {},
            [None] * 256,
            ["/etc/passwd"] * 2,
            "\n",
        )
    )
    files["meta.json"] = json.dumps(meta).encode()
    return "sog", {"a.sog": zip_bytes(files.items())}, "any"


def digits_of_a_camera(rng):
    matrix = np.eye(4).tolist()
    document = {
        "camera_angle_x": 0.8,
        "w": 64,
        "h": 48,
        "frames": [{"file_path": "a", "transform_matrix": matrix}],
    }
    value = rng.choice((5e-324, 1e-310, 3.141592653589793, 1e308, -0.0, 1 << 70, "0.8", True, None))
    target = rng.choice((document, document["frames"][0]))
    target[
        rng.choice(
            ("camera_angle_x", "camera_angle_y", "w", "h", "fl_x", "fl_y", "cx", "cy", "near", "k1")
        )
    ] = value
    return "cameras", {"transforms.json": json.dumps(document).encode()}, "any"


def digits_of_a_scene(rng):
    value = rng.choice((5e-324, 1e-310, 1e39, 1e308, 3.2, -0.0, 1 << 70, "1", True, None))
    camera = {
        "name": "a",
        "width": 64,
        "height": 48,
        "eye": [0, -8, 2],
        "target": [0, 0, 0],
        "fov_x": 1.0,
    }
    instance = {"bundle": "a", "position": [0, 0, 0], "scale": 1.0, "importance": 1.0}
    target = rng.choice((camera, instance))
    target[
        rng.choice(
            ("fov_x", "width", "near", "eye")
            if target is camera
            else ("scale", "importance", "position")
        )
    ] = value
    document = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"a": "a.v3dg"},
        "instances": [instance],
        "cameras": [camera],
    }
    from fuzz.attacks.bombs import bundle_bytes

    return "scene", {"scene.json": json.dumps(document).encode(), "a.v3dg": bundle_bytes()}, "any"


DAMAGES = (
    storage_cut_short,
    other_byte_order,
    unknown_byte_order,
    zipped_anew,
    storage_changed,
    written_as_before_zips,
    storage_shared,
    bounds_missing,
    colors_without_bounds,
    environment_of_another_type,
    filenames_missing,
    picture_of_another_sog,
    value_of_another_type,
    digits_of_a_camera,
    digits_of_a_scene,
)
