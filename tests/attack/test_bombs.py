"""Small files that claim or expand to much. The memory of readers stays below the
limits in docs/robustness.md. A separate process reads each file within a minute, and
the system measures its peak memory.
"""

import gzip
import io
import json
import os
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
import zstandard
from PIL import Image

from test_formats import FIXTURES
from test_ply import header as ply_header
from test_ply import vertex_lines
from v3dg import Gaussians, write_asset
from v3dg.formats import sog

FREE_GAUSSIANS = 1 << 18
# These are the limits in docs/robustness.md.
BASE, PER_BYTE, PER_BYTE_OF_JSON, PER_GAUSSIAN = 100_000_000, 8, 40, 400

CHILD = """
import sys, warnings
from pathlib import Path
warnings.simplefilter("error")
import v3dg
warnings.simplefilter("ignore", v3dg.cleaning.AssetWarning)
for warm_up in sys.argv[2:]:  # what is imported late
    v3dg.read_asset(warm_up)
def kib(name):
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith(name))
Path("/proc/self/clear_refs").write_text("5")  # the peak is forgotten
before = kib("VmRSS")
try:
    found = f"read {len(v3dg.read_asset(sys.argv[1]))}"
except (ValueError, OSError) as error:
    found = f"refused {error}"
print((kib("VmHWM") - before) << 10, found)
"""
WARM_UP = [FIXTURES / name for name in ("sh3.ply", "sh3.sog", "sh3_v3.spz", "sh3_v4.spz")]


def read_apart(path):
    """Read a file in a separate process; return the bytes of memory that this took, and
    the outcome."""
    done = subprocess.run(
        [sys.executable, "-c", CHILD, path, *WARM_UP],
        capture_output=True,
        text=True,
        timeout=60,
        check=True,
    )
    peak, _, found = done.stdout.partition(" ")
    return int(peak), found.strip()


def equal_gaussians(count, degree=0):
    """Return equal gaussians, because their file is as small as a file of so many
    gaussians can be."""
    one = Gaussians(
        np.ones((1, 3), np.float32),
        np.array([[1, 0, 0, 0]], np.float32),
        np.full((1, 3), 0.1, np.float32),
        np.ones(1, np.float32),
        np.zeros((1, (degree + 1) ** 2, 3), np.float32),
    )
    return one.subset(np.zeros(count, int))


def zipped(files, compression=zipfile.ZIP_DEFLATED):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as bundle:
        for name, content in files.items():
            bundle.writestr(name, content)
    return stream.getvalue()


def picture(width, height, kind="WEBP", **options):
    stream = io.BytesIO()
    Image.new("RGBA", (width, height), (1, 2, 3, 252)).save(stream, kind, **options)
    return stream.getvalue()


def sog_files(made, degree=0, **changes):
    """Return the entries of a `.sog` file of equal gaussians that claims any number of
    them."""
    files = sog.encode(equal_gaussians(made, degree))
    meta = json.loads(files["meta.json"])
    for key, value in changes.items():
        *parts, last = key.split("__")
        target = meta
        for part in parts:
            target = target[part]
        target[last] = value
    return files | {"meta.json": json.dumps(meta).encode()}


def meta_of_sog(**changes):
    return {"meta.json": sog_files(1, **changes)["meta.json"]}


HUGE = picture(16383, 16383, lossless=True)
MANY = 10_000_000
JSON_BOMB = b'{"version":2,"count":1,"x":[' + b"[]," * (1 << 25) + b"[]]}"


def lying_zip():
    """Return a zip file with a member that claims 100 bytes and expands to 256 MB."""
    content = bytearray(zipped({"meta.json": bytes(1 << 28)}))
    for place, offset in ((content.index(b"PK\3\4"), 22), (content.rindex(b"PK\1\2"), 24)):
        content[place + offset : place + offset + 4] = struct.pack("<I", 100)
    return bytes(content)


def canvas(width, height):
    """Return a small picture in a file that claims to be a part of a large picture."""
    small = picture(4, 4, lossless=True)[12:]
    sides = (width - 1).to_bytes(3, "little") + (height - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<IB3x", 10, 0x10) + sides + small
    return b"RIFF" + struct.pack("<I", len(body)) + body


def many_members():
    """Return the directory of a zip file with many entries of 47 bytes each."""
    entry = struct.pack("<4s4B4HL2L5H2L", b"PK\1\2", 20, 0, 20, 0, *[0] * 7, 1, *[0] * 6) + b"a"
    end = struct.pack("<4s4H2LH", b"PK\5\6", 0, 0, 65535, 65535, 100_000 * len(entry), 4, 0)
    return b"PK\3\4" + 100_000 * entry + end


SOG = {
    "pictures larger than the count": lambda: zipped(
        sog_files(9) | dict.fromkeys(["quats.webp", "scales.webp"], HUGE)
    ),
    "pictures larger than the count, in many bytes": lambda: zipped(
        sog_files(9) | dict.fromkeys(["quats.webp", "scales.webp"], HUGE + bytes(1_000_000))
    ),
    "pictures that Pillow warns of": lambda: zipped(
        sog_files(9)
        | dict.fromkeys(["quats.webp", "scales.webp"], picture(10_000, 10_000, lossless=True))
    ),
    "a canvas larger than its picture": lambda: zipped(
        sog_files(9) | {"scales.webp": canvas(16384, 16384)}
    ),
    "a palette larger than its count": lambda: zipped(
        sog_files(9, 3) | {"shN_centroids.webp": picture(960, 16383, lossless=True)}
    ),
    "pictures of another format": lambda: zipped(
        sog_files(9) | {"quats.webp": picture(9999, 9999, "PNG")}
    ),
    "equal gaussians": lambda: zipped(
        dict.fromkeys(sog_files(1), picture(4000, 2600, lossless=True)) | meta_of_sog(count=MANY)
    ),
    "equal gaussians that are believed": lambda: zipped(sog_files(FREE_GAUSSIANS, 3)),
    "meta.json that expands": lambda: zipped({"meta.json": JSON_BOMB}),
    "meta.json of many names": lambda: zipped(sog_files(9, means__files=["a"] * (1 << 18))),
    "meta.json of many fields": lambda: zipped(sog_files(9) | {"meta.json": many_fields()}),
    "a picture that expands": lambda: zipped(sog_files(9) | {"quats.webp": bytes(1 << 28)}),
    "a member that lies": lying_zip,
    "many members": many_members,
}


def many_fields():
    fields = ",".join(f'"{i}":0' for i in range(99_000))
    return b'{"version":2,"count":9,' + fields.encode() + b"}"


def spz_header(count, version=3, degree=0):
    return struct.pack("<IIIBBBB", 0x5053474E, version, count, degree, 12, 0, 0)


def spz_of_zstd(count, num_bytes, degree=0):
    """Return streams of zeros that may expand to more than they claim."""
    sizes = [count * width for width in (9, 1, 3, 3, 4, 45)][: 6 if degree else 5]
    streams = [zstandard.ZstdCompressor().compress(bytes(num_bytes or size)) for size in sizes]
    table = b"".join(
        struct.pack("<QQ", len(s), size) for s, size in zip(streams, sizes, strict=True)
    )
    start = bytearray(spz_header(count, 4, degree) + struct.pack("<I", 32) + bytes(12))
    start[15] = len(sizes)
    return bytes(start) + table + b"".join(streams)


SPZ = {
    "equal gaussians": lambda: gzip.compress(spz_header(MANY) + bytes(MANY * 20), 6),
    "equal gaussians that are believed": lambda: gzip.compress(
        spz_header(FREE_GAUSSIANS, degree=3) + bytes(FREE_GAUSSIANS * 65)
    ),
    "a count alone": lambda: gzip.compress(spz_header(2**32 - 1)),
    "what follows": lambda: gzip.compress(spz_header(1) + bytes(20) + bytes(1 << 28)),
    "many streams": lambda: (
        gzip.compress(spz_header(1) + bytes(20)) + gzip.compress(bytes(1 << 28))
    ),
    "a name without end": lambda: b"\x1f\x8b\x08\x08" + bytes(6) + b"a" * (1 << 20),
    "zstd of equal gaussians": lambda: spz_of_zstd(MANY, None),
    "zstd of equal gaussians that are believed": lambda: spz_of_zstd(FREE_GAUSSIANS, None, 3),
    "zstd streams that lie": lambda: spz_of_zstd(1, 1 << 26),
}


def checkpoint(**changes):
    count = changes.pop("count", 9)
    shapes = {
        "means": (3,),
        "scales": (3,),
        "quats": (4,),
        "opacities": (),
        "sh0": (1, 3),
        "shN": (15, 3),
    }
    splats = {name: torch.zeros(count, *shape) for name, shape in shapes.items()} | changes
    stream = io.BytesIO()
    torch.save({"splats": splats}, stream)
    return stream.getvalue()


def expanded(count):
    one = {"means": torch.zeros(1, 3), "scales": torch.zeros(1, 3), "quats": torch.zeros(1, 4)}
    rest = {"opacities": torch.zeros(1), "sh0": torch.zeros(1, 1, 3), "shN": torch.zeros(1, 15, 3)}
    return {name: tensor.expand(count, *tensor.shape[1:]) for name, tensor in (one | rest).items()}


def repacked(content, compression=zipfile.ZIP_STORED, **members):
    source = zipfile.ZipFile(io.BytesIO(content))
    files = {name: source.read(name) for name in source.namelist()}
    return zipped(
        files | {f"archive/{name}": value for name, value in members.items()}, compression
    )


def pickled(body):
    return repacked(checkpoint(), **{"data.pkl": b"\x80\x02" + body + b"."})


def tuple_bomb(end):
    """Return a pickle of a tuple that contains the last tuple twice, 60 times over. A
    reader that visits all items visits 2^60."""
    nested = b")q\x00" + b"".join(
        b"h" + bytes([i]) * 1 + b"h" + bytes([i]) + b"\x86q" + bytes([i + 1]) for i in range(60)
    )
    return b"}" + nested + end


SHARED_SHAPE = (
    b"(" + b"K\x01" * 100_000 + b"tq\x00"
    + b"ctorch._utils\n_rebuild_tensor_v2\nq\x01"
    + b"(X\x07\0\0\0storagectorch\nFloatStorage\nX\x01\0\0\0\x30X\x03\0\0\0cpuK\x01tQq\x02"
    + b"h\x01(h\x02K\x00h\x00h\x00tR" * 60_000
)  # fmt: skip

CHECKPOINT = {
    "expanded tensors": lambda: checkpoint(**expanded(MANY)),
    "one expanded tensor": lambda: checkpoint(shN=torch.zeros(1, 15, 3).expand(9, 15, 3)),
    "equal gaussians in deflated tensors": lambda: repacked(
        checkpoint(count=1 << 20), zipfile.ZIP_DEFLATED
    ),
    "equal gaussians that are believed": lambda: repacked(
        checkpoint(count=4000), zipfile.ZIP_DEFLATED
    ),
    "a pickle that expands": lambda: repacked(
        checkpoint(), zipfile.ZIP_DEFLATED, **{"data.pkl": b"N0" * (1 << 26)}
    ),
    "a pickle of objects": lambda: pickled(b"}" * ((1 << 20) - 3)),
    "a pickle of steps": lambda: pickled(b"N" * ((1 << 20) - 3)),
    "a distant place of the memo": lambda: pickled(b"Nr\xff\xff\xff\x7f"),
    "a tuple as a key": lambda: pickled(tuple_bomb(b"Ns")),
    "a tuple as splats": lambda: pickled(b"X\x06\0\0\0splats" + tuple_bomb(b"\x86")),
    "a long shape that many share": lambda: pickled(SHARED_SHAPE),
    "a member that lies": lying_zip,
    "a meta tensor": lambda: checkpoint(means=torch.zeros(MANY, 3, device="meta")),
    "a sparse tensor": lambda: checkpoint(means=torch.zeros(9, 3).to_sparse_coo()),
    "a nested tensor": lambda: checkpoint(means=torch.nested.nested_tensor([torch.zeros(3)] * 9)),
}


def ksplat_of_one_high_degree():
    """Return a file in which one empty section of degree 2 makes all other sections
    store zeros."""
    count = 40_000
    head = bytearray(4096)
    struct.pack_into("<BB2xI8xIH", head, 0, 0, 1, 2, count, 1)
    sections = [bytearray(1024), bytearray(1024)]
    struct.pack_into("<IIIIfH2xI4xIIH", sections[0], 0, 0, 0, 1, 0, 1.0, 12, 0, 0, 0, 2)
    struct.pack_into("<IIIIfH2xI4xIIH", sections[1], 0, count, count, count, 1, 1.0, 12, 0, 1, 0, 0)
    return bytes(head) + b"".join(map(bytes, sections)) + bytes(12 + 24 * count)


PLY = {
    "gaussians": lambda: ply_header(*vertex_lines(10**12)),
    "gaussians as text": lambda: ply_header(*vertex_lines(10**12), format_line="format ascii 1.0"),
    "elements": lambda: ply_header(*(f"element a{i} 99999999" for i in range(3000))),
    "packed gaussians": lambda: (
        (FIXTURES / "sh0.compressed.ply")
        .read_bytes()
        .replace(b"element vertex 300", b"element vertex 999999999999")
    ),
    "packed elements": lambda: ply_header(
        "element vertex 1",
        "property uint packed_position",
        *(f"property uchar a{i}" for i in range(3000)),
    ),
}


def glb_of(document, blob=b""):
    """Return a `.glb` file with this JSON and this binary chunk."""
    text = document if isinstance(document, bytes) else json.dumps(document).encode()
    chunks = struct.pack("<II", len(text), 0x4E4F534A) + text
    chunks += struct.pack("<II", len(blob), 0x004E4942) + blob
    return struct.pack("<III", 0x46546C67, 2, 12 + len(chunks)) + chunks


def glb_of_one_stream(times):
    """Return a file with many primitives that share one large stream of a single
    gaussian."""
    stream = gzip.compress(spz_header(1) + bytes(20)) + bytes(1 << 20)
    extension = {"extensions": {"KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}}}
    primitive = {"attributes": {"POSITION": 0}, "extensions": {"KHR_gaussian_splatting": extension}}
    document = {
        "meshes": [{"primitives": [primitive] * times}],
        "accessors": [{"count": 1}],
        "bufferViews": [{"buffer": 0, "byteLength": len(stream)}],
        "buffers": [{}],
    }
    return glb_of(document, stream)


def glb_of_zeros(nodes, count, times=1, **fields):
    """Return a file of many gaussians whose accessors store no numbers."""
    names = ("SCALE", "ROTATION", "OPACITY", "SH_DEGREE_0_COEF_0")
    attributes = {f"KHR_gaussian_splatting:{name}": i for i, name in enumerate(names, 1)}
    primitive = {
        "attributes": {"POSITION": 0, **attributes},
        "extensions": {"KHR_gaussian_splatting": {}},
    }
    kinds = ("VEC3", "VEC3", "VEC4", "SCALAR", "VEC3")
    accessor = {"componentType": 5126, "count": count, **fields}
    document = {
        "nodes": nodes,
        "meshes": [{"primitives": [primitive] * times}],
        "accessors": [{**accessor, "type": kind} for kind in kinds],
        "bufferViews": [{"buffer": 0, "byteLength": 16}],
        "buffers": [{}],
    }
    return glb_of(document, bytes(16))


GLB = {
    "many accessors": lambda: glb_of(b'{"accessors":[' + b"{}," * 1_000_000 + b"{}]}"),
    "many accessors in 1 MiB": lambda: glb_of(
        b'{"buffers":[],"bufferViews":[],"meshes":[],"accessors":[' + b"{}," * 300_000 + b"{}]}"
    ),
    "one stream many times": lambda: glb_of_one_stream(4000),
    "many nodes": lambda: glb_of(b'{"nodes":[' + b"{}," * 340_000 + b"{}]}"),
    "a chain of nodes": lambda: glb_of(
        {"nodes": [{"children": [i + 1]} for i in range(40_000)] + [{}]}
    ),
    "a mesh of many nodes": lambda: glb_of_zeros([{"mesh": 0}] * 80_000, 1000),
    "many primitives": lambda: glb_of_zeros([{"mesh": 0}], 1 << 17, 10_000),
    "many meshes of many extensions": lambda: glb_of({"extensionsUsed": ["x"] * 200_000}),
    "a sparse accessor": lambda: glb_of_zeros(
        [{"mesh": 0}],
        FREE_GAUSSIANS,
        sparse={"count": FREE_GAUSSIANS, "indices": {"bufferView": 0, "componentType": 5125}},
    ),
    "zeros that are believed": lambda: glb_of_zeros([{"mesh": 0}], FREE_GAUSSIANS),
}

BOMBS = {
    **{f"glb: {name}": ("a.glb", make) for name, make in GLB.items()},
    **{f"sog: {name}": ("a.sog", make) for name, make in SOG.items()},
    **{f"spz: {name}": ("a.spz", make) for name, make in SPZ.items()},
    **{f"checkpoint: {name}": ("a.pt", make) for name, make in CHECKPOINT.items()},
    **{f"ply: {name}": ("a.ply", make) for name, make in PLY.items()},
    "ksplat: a high degree without gaussians": ("a.ksplat", ksplat_of_one_high_degree),
    "ksplat: sections": (
        "a.ksplat",
        lambda: struct.pack("<BB2xI8xIH", 0, 1, 2**32 - 1, 9, 1) + bytes(1 << 20),
    ),
    "splat: zeros": ("a.splat", lambda: bytes(32 * 50_000)),
}
READ = ["splat: zeros", "ksplat: a high degree without gaussians", "spz: many streams"]


def assert_bounded(path, num_bytes):
    peak, found = read_apart(path)
    # the limit in docs/robustness.md
    print(f"{num_bytes:,} bytes, {peak >> 20} MiB, {found}")
    believed = FREE_GAUSSIANS + num_bytes
    count = int(found.split()[1]) if found.startswith("read") else 0
    assert count <= believed
    per_byte = PER_BYTE_OF_JSON if path.suffix == ".json" else PER_BYTE
    assert peak <= BASE + per_byte * num_bytes + PER_GAUSSIAN * count
    if not count:
        assert found.startswith(f"refused {path.parent}")
        assert found.isprintable()
    return found


@pytest.mark.filterwarnings("ignore:The PyTorch API of nested tensors")
@pytest.mark.parametrize("case", BOMBS)
def test_a_bomb_is_refused_or_cheap(tmp_path, case):
    name, make = BOMBS[case]
    (tmp_path / name).write_bytes(make())
    found = assert_bounded(tmp_path / name, (tmp_path / name).stat().st_size)
    is_read = "believed" in case or case in READ
    assert found.startswith("read" if is_read else f"refused {tmp_path}")


def streamed(folder, names, leaves=None, tree=None, **others):
    """Return a lod-meta.json. Each leaf consists of the number of a file, an offset and
    a count."""
    runs = [dict(zip(("file", "offset", "count"), leaf, strict=True)) for leaf in leaves or []]
    tree = tree or {"children": [{"lods": {"0": run}} for run in runs]}
    path = folder / "lod-meta.json"
    path.write_text(json.dumps({"version": 1, "filenames": names, "tree": tree, **others}))
    return path


def deep_and_wide(folder):
    """Return a tree of nodes whose places would fill ten gigabytes if they were written
    out."""
    tree = '{"children":[' * 400 + ",".join(["{}"] * 1_000_000) + "]}" * 400
    path = folder / "lod-meta.json"
    path.write_text('{"filenames":[],"tree":' + tree + "}")
    return path


def one_file(folder, make_name, times):
    """Return an asset whose tree takes all gaussians of one file of 60,000 under many
    names."""
    names = [make_name(i) for i in range(times)]
    for name in names[1:]:
        if not (folder / name).exists():
            (os.link if "hard" in name else os.symlink)(folder / "a.sog", folder / name)
    return streamed(folder, names, [(i, 0, 60_000) for i in range(times)])


STREAMED = {
    "a name 300 times": lambda folder: one_file(folder, lambda i: "a.sog", 300),
    "a name 20,000 times": lambda folder: one_file(folder, lambda i: "a.sog", 20_000),
    "a name spelled 20,000 times": lambda folder: one_file(
        folder, lambda i: "./" * i + "a.sog", 2000
    ),
    "300 links": lambda folder: one_file(folder, lambda i: f"{i}.sog" if i else "a.sog", 300),
    "300 hard links": lambda folder: one_file(
        folder, lambda i: f"hard{i}.sog" if i else "a.sog", 300
    ),
    "a tree": deep_and_wide,
    "many objects": lambda folder: streamed(folder, [{"a": 0}] * 200_000),
    "a long number of a level": lambda folder: streamed(
        folder, [], tree={"lods": {"1" * 5000: {}}}
    ),
    "a run": lambda folder: streamed(folder, ["a.sog"], [(0, 0, 1 << 32)]),
    "runs": lambda folder: streamed(folder, ["a.sog"], [(0, 0, 60_000)] * 10_000),
}


@pytest.mark.parametrize("case", STREAMED)
def test_a_streamed_bomb_is_refused_or_cheap(tmp_path, case):
    write_asset(tmp_path / "a.sog", equal_gaussians(60_000))
    path = STREAMED[case](tmp_path)
    sizes = {(file.stat().st_ino, file.stat().st_size) for file in tmp_path.iterdir()}
    assert assert_bounded(path, sum(size for _, size in sizes)).startswith("refused")


def test_a_name_that_is_there_many_times_is_read_once(tmp_path):
    write_asset(tmp_path / "a.sog", equal_gaussians(60_000))
    path = streamed(tmp_path, ["a.sog"] * 300, [(i, 200 * i, 200) for i in range(300)])
    assert assert_bounded(path, path.stat().st_size) == "read 60000"


@pytest.mark.parametrize("degree", [0, 3])
@pytest.mark.parametrize("name", ["a.sog", "a.spz", "a.compressed.ply", "a.ply"])
def test_equal_gaussians_read_back_however_many(tmp_path, name, degree):
    """A constant picture has 74 bytes whatever its size. If that is too few for the
    number of gaussians, the writer adds padding."""
    write_asset(tmp_path / name, equal_gaussians(FREE_GAUSSIANS + 50_000, degree))
    assert assert_bounded(tmp_path / name, (tmp_path / name).stat().st_size) == "read 312144"


@pytest.mark.parametrize("part", ["means", "quats", "scales", "opacities", "sh"])
def test_one_constant_picture_is_read(tmp_path, part):
    """Files of point clouds and captures by other programs contain such pictures."""
    rng = np.random.default_rng(0)
    asset = equal_gaussians(70_000, 1)
    for other in {"means", "quats", "scales", "opacities", "sh"} - {part}:
        values = getattr(asset, other)
        values[:] = rng.uniform(0.1, 0.9, values.shape)
    write_asset(tmp_path / "a.sog", asset)
    assert assert_bounded(tmp_path / "a.sog", (tmp_path / "a.sog").stat().st_size) == "read 70000"


def test_pictures_of_the_size_that_other_writers_round_to_are_read(tmp_path):
    """A square picture with a power of two as side has up to four times as many pixels
    as gaussians."""
    files = {
        name: picture(1024, 1024, lossless=True) for name in sog_files(9) if name != "meta.json"
    }
    (tmp_path / "a.sog").write_bytes(zipped(files | meta_of_sog(count=FREE_GAUSSIANS - 9)))
    assert assert_bounded(tmp_path / "a.sog", 0).startswith("read")
