"""Small files that would be expensive to read. Each function returns an invalid `Good`,
and the expected outcome."""

import functools
import gzip
import io
import json
import pickle
import struct
import zlib
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image

import v3dg
from fuzz.attacks.good_files import Good, checkpoint_bytes, streamed, zip_entries
from fuzz.targets import zip_bytes
from random_bundle import random_bundle, random_gaussians
from test_formats import FIXTURES
from test_ply import header as ply_header
from test_ply import vertex_lines
from v3dg.formats import sog


@functools.cache
def constant_webp(side):
    stream = io.BytesIO()
    Image.new("RGBA", (side, side), (7, 8, 9, 252)).save(
        stream, "WEBP", lossless=True, exact=True, method=0
    )
    return stream.getvalue()


@functools.cache
def constant_png(width, height, mode=6):
    """Return zeros that are packed row by row, so that creating them takes no
    memory."""

    def chunk(name, body):
        return (
            struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))
        )

    packer, row = zlib.compressobj(9), bytes(1 + width * (4 if mode == 6 else 3))
    packed = b"".join([*(packer.compress(row) for _ in range(height)), packer.flush()])
    header = struct.pack(">IIBBBBB", width, height, 8, mode, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")
    )


@functools.cache
def small_sog():
    return sog.encode(random_gaussians(np.random.default_rng(0), 40, 1))


def sog_of_large_pictures(rng):
    """Constant pictures have few bytes and many pixels. Padding makes a file look large
    enough for them."""
    side = rng.choice((2048, 3000, 4096))
    picture = rng.choice((constant_webp, lambda side: constant_png(side, side)))(side)
    files = dict(small_sog())
    meta = json.loads(files["meta.json"])
    if rng.random() < 0.5:
        meta["count"] = rng.choice((40, side * side, side * side - 7))
    padding = bytes(rng.choice((0, side * side // 64, (1 << 24) - (1 << 20))))
    for name in files:
        if name.endswith(".webp") and (name != "shN_centroids.webp" or rng.random() < 0.5):
            files[name] = picture + padding
    files["meta.json"] = json.dumps(meta).encode()
    compression = rng.choice((0, 8, 8))
    if compression == 0:
        files = {n: c if n == "meta.json" else c[: len(picture) + 4096] for n, c in files.items()}
    return "sog", {"a.sog": zip_bytes(files.items(), compression)}


def sog_with_one_picture_for_all(rng):
    files = dict(small_sog())
    side = rng.choice((1000, 2000))
    meta = json.loads(files["meta.json"])
    del meta["shN"]
    for name in ("means", "scales", "quats", "sh0"):
        meta[name]["files"] = ["p.webp"] * len(meta[name]["files"])
    meta["count"] = side * side
    entries = [("meta.json", json.dumps(meta).encode()), ("p.webp", constant_webp(side))]
    return "sog", {"a.sog": zip_bytes(entries, 8)}


def sog_of_many_entries(rng):
    entries = [
        *small_sog().items(),
        *((f"{i}.webp", b"") for i in range(rng.choice((1000, 40_000)))),
    ]
    return "sog", {"a.sog": zip_bytes(entries)}


def streamed_with_repeated_names(rng):
    """One folder is listed many times. Its pictures are constant or small."""
    good = streamed(0, names=["0/meta.json"] * rng.choice((300, 3000, 20_000)))
    side = rng.choice((0, 250, 2000))
    if not side:
        return "streamed", good.files
    meta = json.loads(good.files["0/meta.json"]) | {"count": side * side}
    index = json.loads(good.content)
    for leaf in index["tree"]["children"]:
        leaf["lods"]["0"]["count"] = rng.choice((1, side * side))
    pictures = {f"0/{n}": constant_webp(side) for n in small_sog() if n.endswith(".webp")}
    texts = {"lod-meta.json": json.dumps(index).encode(), "0/meta.json": json.dumps(meta).encode()}
    return "streamed", {**good.files, **pictures, **texts}


def streamed_with_deep_tree(rng):
    good = json.loads(streamed(1).content)
    depth = rng.choice((500, 900, 20_000))
    text = json.dumps(good["tree"]["children"][0])
    tree = '{"children": [' * depth + text + "]}" * depth
    files = streamed(1).files
    index = '{"version": 1, "filenames": ["0/meta.json"], "tree": ' + tree + "}"
    return "streamed", {**files, "lod-meta.json": index.encode()}


def streamed_with_overlapping_runs(rng):
    """All leaves refer to the same gaussians."""
    good = streamed(1)
    index = json.loads(good.content)
    index["tree"]["children"] *= rng.choice((40, 5000))
    return "streamed", {**good.files, "lod-meta.json": json.dumps(index).encode()}


def spz_of_zeros(rng):
    count = rng.choice((1 << 20, 1 << 22, 1 << 24))
    body = struct.pack("<IIIBBBB", 0x5053474E, rng.choice((2, 3)), count, 0, 12, 0, 0)
    packer = zlib.compressobj(9, zlib.DEFLATED, 31)
    parts, left = [packer.compress(body)], count * 20
    zeros = bytes(1 << 20)
    while left > 0:
        parts.append(packer.compress(zeros[: min(left, len(zeros))]))
        left -= len(zeros)
    return "spz", {"a.spz": b"".join([*parts, packer.flush()])}


def spz_with_a_long_tail(rng):
    """The file has few gaussians, followed by much data."""
    good = gzip.decompress((FIXTURES / "sh0_v3.spz").read_bytes())
    return "spz", {"a.spz": gzip.compress(good + bytes(rng.choice((1 << 20, 1 << 26))), 9, mtime=0)}


def spz_of_long_frames(rng):
    """zstd compresses zeros better than deflate does."""
    import zstandard

    count, streams = rng.choice((1 << 16, 1 << 22)), []
    for width in (9, 1, 3, 3, 4):
        packer = zstandard.ZstdCompressor(19, write_content_size=rng.random() < 0.5)
        packed = packer.compress(bytes(width * count * rng.choice((1, 1, 16))))
        streams.append((packed, width * count))
    header = (
        struct.pack("<IIIBBBB", 0x5053474E, 4, count, 0, 12, 0, len(streams))
        + struct.pack("<I", 32)
        + bytes(12)
    )
    table = b"".join(struct.pack("<QQ", len(packed), size) for packed, size in streams)
    return "spz", {
        "a.spz": header
        + table
        + b"".join(packed for packed, _ in streams)
        + bytes(rng.choice((0, 1 << 20)))
    }


def _tensors(rng, count=None):
    count = count or rng.choice((1 << 20, 1 << 24, 1 << 30))
    shapes = {
        "means": 3,
        "scales": 3,
        "quats": 4,
        "opacities": 0,
        "sh0": (1, 3),
        "shN": (rng.choice((0, 15)), 3),
    }
    return {
        name: torch.ones(()).expand(
            count, *(((rest,) if rest else ()) if isinstance(rest, int) else rest)
        )
        for name, rest in shapes.items()
    }


def checkpoint_of_expanded_tensors(rng):
    """The file contains one number, and a tensor of a billion elements that all refer
    to it."""
    return "checkpoint", {"a.pt": checkpoint_bytes(_tensors(rng))}


def checkpoint_of_overlapping_tensors(rng):
    """Every tensor contains all numbers of the file, at many positions."""
    tensors, base = _tensors(rng, 1 << 18), torch.rand((1 << 18) + 64)
    for name in rng.sample(list(tensors), rng.randrange(1, 7)):
        tensors[name] = base.as_strided(tensors[name].shape, [1] * tensors[name].ndim)
    return "checkpoint", {"a.pt": checkpoint_bytes(tensors)}


def checkpoint_of_odd_tensors(rng):
    good = {name: tensor[:7].clone() for name, tensor in _tensors(rng, 1 << 10).items()}
    odd = {
        "meta": lambda t: t.to("meta"),
        "sparse": lambda t: t.to_sparse(),
        "sparse csr": lambda t: t.reshape(len(t), -1).to_sparse_csr(),
        "nested": lambda t: torch.nested.nested_tensor([t, t[:2]]),
        "half": lambda t: t.half(),
        "bfloat": lambda t: t.bfloat16(),
        "complex": lambda t: t.to(torch.complex64),
        "double": lambda t: t.double() * 1e300,
        "quantized": lambda t: torch.quantize_per_tensor(t.contiguous(), 0.1, 0, torch.quint8),
        "float8": lambda t: t.to(torch.float8_e4m3fn),
        "conj": lambda t: t.to(torch.complex64).conj(),
        "negative": lambda t: torch._neg_view(t.clone()),
        "parameter": torch.nn.Parameter,
        "empty": lambda t: t[:0],
        "many dimensions": lambda t: t.reshape(*([1] * 60), *t.shape),
        "wide": lambda t: torch.zeros(0).expand(0).as_strided((0, 1 << 62), (0, 0)),
    }
    kind = rng.choice(list(odd))
    good[rng.choice(list(good))] = odd[kind](good[rng.choice(list(good))])
    return "checkpoint", {"a.pt": checkpoint_bytes(good)}


def checkpoint_with_a_long_pickle(rng):
    """Return a compressed pickle that contains the same item many times."""
    entries = [(e.filename, c) for e, c in zip_entries(checkpoint_bytes(_tensors(rng, 3)))]
    num = rng.choice((1 << 20, 1 << 24, 1 << 26))
    body = rng.choice(
        (b"]" * num + b".", b"\x80\x02](" + b"K\0" * num + b"e.", b"\x80\x02]" + b"(l" * num + b".")
    )
    body = rng.choice((body, pickle.dumps([0] * (num >> 4), 2), b"\x80\x02" + b"N0" * num + b"}."))
    entries = [(name, body if name.endswith("data.pkl") else content) for name, content in entries]
    return "checkpoint", {"a.pt": zip_bytes(entries, 8)}


def ply_claims(rng):
    count = rng.choice((10**6, 10**9, 10**12, 1 << 63))
    lines = vertex_lines(count)
    ascii_line = {"format_line": "format ascii 1.0"} if rng.random() < 0.5 else {}
    content = ply_header(*lines, **ascii_line) + bytes(rng.choice((0, 1000, 100_000)))
    return "ply", {"a.ply": content}


def ply_of_many_elements(rng):
    many = [f"element e{i} {rng.choice((0, 1, 10**12))}" for i in range(rng.choice((1000, 60_000)))]
    return "ply", {"a.ply": ply_header(*many, *vertex_lines(0))}


def compressed_claims(rng):
    count = rng.choice((10**7, 10**10))
    lines = [f"element chunk {count // 256}"]
    lines += [f"property float {end}_{axis}" for end in ("min", "max") for axis in "xyz"]
    lines += [
        f"element vertex {count}",
        *(f"property uint packed_{n}" for n in ("position", "rotation", "scale", "color")),
    ]
    return "compressed", {"a.ply": ply_header(*lines) + bytes(1000)}


def scene_of_bundles_in_turn(rng):
    names = {name: f"{name}.v3dg" for name in "abcde"}
    count = rng.choice((2000, 20_000, 50_000))
    instances = [{"bundle": "abcde"[i % 5], "position": [i, 0, 0]} for i in range(count)]
    document = {"format": "v3dg-scene", "version": 1, "bundles": names, "instances": instances}
    bundle = bundle_bytes()
    return "scene", {
        "scene.json": json.dumps(document).encode(),
        **{f"{n}.v3dg": bundle for n in "abcde"},
    }


def scene_of_many_bundles(rng):
    """The scene refers to one file by thousands of different names."""
    names = {f"b{i}": rng.choice(("a.v3dg", "./a.v3dg")) for i in range(rng.choice((500, 5000)))}
    instances = [{"bundle": name, "position": [0, 0, 0]} for name in names]
    document = {"format": "v3dg-scene", "version": 1, "bundles": names, "instances": instances}
    return "scene", {"scene.json": json.dumps(document).encode(), "a.v3dg": bundle_bytes()}


def cameras_of_many_frames(rng):
    frame = {"file_path": "a", "transform_matrix": np.eye(4).tolist()}
    document = {
        "camera_angle_x": 0.8,
        "w": 64,
        "h": 48,
        "frames": [frame] * rng.choice((1000, 20_000)),
    }
    return "cameras", {"transforms.json": json.dumps(document).encode()}


@functools.cache
def bundle_bytes():
    with TemporaryDirectory() as folder:
        path = Path(folder) / "a.v3dg"
        random_bundle(3).write(path)
        return path.read_bytes()


def picture_of_zeros(rng):
    width, height = rng.choice(
        ((1500, 1500), (12_000, 12_000), (20_000, 20_000), (100_000, 1), (1, 1_000_000))
    )
    picture = constant_png(width, height, rng.choice((2, 6)))
    return "picture", {"a.png": picture, "b.png": rng.choice((picture, constant_png(8, 8)))}


def picture_that_claims(rng):
    picture = bytearray(constant_png(8, 8))
    picture[16:24] = struct.pack(
        ">II", rng.choice((1 << 31, 100_000, 30_000)) - 1, rng.choice((1, 30_000, 100_000))
    )
    picture[29:33] = struct.pack(">I", zlib.crc32(picture[12:29]))
    return "picture", {"a.png": bytes(picture), "b.png": constant_png(8, 8)}


def picture_of_another_program(rng):
    """Pillow passes such files to other programs, or reads them with plugins."""
    eps = (
        b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\n"
        b"0 0 8 8 rectfill showpage\n%%EOF\n"
    )
    frames, stream = [Image.new("RGB", (8, 8), c) for c in ("red", "blue")], io.BytesIO()
    frames[0].save(
        stream, rng.choice(("PNG", "GIF", "TIFF")), save_all=True, append_images=frames[1:]
    )
    others = (
        eps,
        stream.getvalue(),
        b"P6\n8 8\n255\n" + bytes(192),
        b"P3 9999999999 9 9\n",
        b"8BPS\0\1" + bytes(200),
    )
    return "picture", {"a.png": rng.choice((eps, *others)), "b.png": constant_png(8, 8)}


BOMBS = (
    sog_of_large_pictures,
    sog_with_one_picture_for_all,
    sog_of_many_entries,
    streamed_with_repeated_names,
    streamed_with_deep_tree,
    streamed_with_overlapping_runs,
    spz_of_zeros,
    spz_with_a_long_tail,
    spz_of_long_frames,
    checkpoint_of_expanded_tensors,
    checkpoint_of_overlapping_tensors,
    checkpoint_of_odd_tensors,
    checkpoint_with_a_long_pickle,
    ply_claims,
    ply_of_many_elements,
    compressed_claims,
    scene_of_bundles_in_turn,
    scene_of_many_bundles,
    cameras_of_many_frames,
    picture_of_zeros,
    picture_that_claims,
    picture_of_another_program,
)


def written_with_constants(rng, folder):
    """Assets whose values are mostly equal must be readable after they were written."""
    count, degree = rng.choice((1, 2, 300, 20_000, 70_000)), rng.choice((0, 0, 1))
    asset = random_gaussians(np.random.default_rng(rng.getrandbits(32)), count, degree)
    for name in rng.sample(("means", "quats", "scales", "opacities", "sh"), rng.randrange(6)):
        getattr(asset, name)[...] = getattr(asset, name)[0]
    suffix = rng.choice((".sog", ".sog", ".spz", ".compressed.ply", ".ply"))
    v3dg.write_asset(folder / f"a{suffix}", asset)
    kind = suffix[1:].replace("compressed.ply", "compressed")
    return Good(kind, {f"a{suffix}": (folder / f"a{suffix}").read_bytes()}), count
