"""Variants of trainers and other programs are read with their intended meaning, and the
reader reports what is left out."""

import gzip
import io
import json
import re
import shutil
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from test_formats import FIXTURES
from test_ply import (
    Element,
    expected_gaussians,
    ply_bytes,
    random_columns,
    random_gaussians,
)
from v3dg import write_asset
from v3dg.io import asset_bytes, open_asset

SH_C0 = 0.28209479177387814
NORMALS = ["nx", "ny", "nz"]
MEAN = ["x", "y", "z"]
DC = ["f_dc_0", "f_dc_1", "f_dc_2"]
REST = [f"f_rest_{i}" for i in range(45)]
SCALES = ["scale_0", "scale_1", "scale_2"]
ROT = ["rot_0", "rot_1", "rot_2", "rot_3"]

# The order of properties in the files of these programs.
ORDERS = {
    "the 3DGS code, nerfstudio, LichtFeld, OpenSplat, Polycam": [
        *MEAN, *NORMALS, *DC, *REST, "opacity", *SCALES, *ROT,
    ],
    "gsplat, Postshot": [*MEAN, *DC, *REST, "opacity", *SCALES, *ROT],
    "Brush": [*MEAN, *SCALES, "opacity", *ROT, *DC, *REST],
    "SuperSplat": [*MEAN, *ROT, *SCALES, "opacity", *DC, *REST],
    "Scaniverse": [*MEAN, *DC, "opacity", *SCALES, *ROT],
}  # fmt: skip


def read(path):
    """Return all gaussians, without warnings."""
    file = open_asset(path)
    return file.read(0, file.num_gaussians)


def assert_close(found, wanted):
    for name, values in vars(found).items():
        np.testing.assert_allclose(
            values, np.asarray(wanted[name], np.float32), rtol=3e-7, atol=1e-6, err_msg=name
        )


def put(path, columns, encoding="binary_little_endian", others=()):
    path.write_bytes(ply_bytes([Element("vertex", columns), *others], encoding))
    return path


@pytest.mark.parametrize("program", ORDERS)
def test_the_order_of_properties_does_not_matter(tmp_path, program):
    columns = random_columns(20, 3) | {name: np.zeros(20, np.float32) for name in NORMALS}
    columns = {name: columns[name] for name in ORDERS[program]}
    path = put(tmp_path / "a.ply", columns)
    assert_close(read(path), expected_gaussians(columns))
    assert open_asset(path).declared.notes == ()


COLORS = {
    "bytes": ("u1", 255, ("red", "green", "blue")),
    "words": ("u2", 65535, ("red", "green", "blue")),
    "floats": ("f4", 1, ("red", "green", "blue")),
    "halves": ("f2", 1, ("r", "g", "b")),
}


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
@pytest.mark.parametrize("kind", COLORS)
def test_base_colours_stand_for_coefficients(tmp_path, kind, encoding):
    """nerfstudio writes base colours like this with `--ply-color-mode rgb`."""
    dtype, largest, names = COLORS[kind]
    if encoding == "ascii" and dtype == "f2":
        dtype = "f4"  # the name of the half type is as long as that of a float
    rng = np.random.default_rng(0)
    columns = random_columns(20, 0)
    wanted = dict(columns)
    for i, name in enumerate(names):
        del columns[f"f_dc_{i}"]
        color = (rng.uniform(size=20) * largest).astype(dtype)
        columns[name] = color
        wanted[f"f_dc_{i}"] = (color.astype(np.float64) / largest - 0.5) / SH_C0
    path = put(tmp_path / "a.ply", columns, encoding)
    assert_close(read(path), expected_gaussians(wanted))
    (note,) = open_asset(path).declared.notes
    assert note == "Red, green and blue were read as base colours because f_dc_0 is missing."


def test_floats_of_0_to_255_are_no_base_colours(tmp_path):
    columns = {name: c for name, c in random_columns(3, 0).items() if "f_dc" not in name}
    columns |= {name: np.full(3, 200, np.float32) for name in ("red", "green", "blue")}
    with pytest.raises(ValueError, match="expected colours from 0 to 1 in float properties, got"):
        read(put(tmp_path / "a.ply", columns))


def test_coefficients_come_before_base_colours(tmp_path):
    columns = random_columns(20, 1)
    colors = {name: np.full(20, 7, np.uint8) for name in ("red", "green", "blue")}
    path = put(tmp_path / "a.ply", columns | colors)
    assert_close(read(path), expected_gaussians(columns))
    assert open_asset(path).declared.notes == (
        "Properties of vertex that are unknown were ignored: 'red', 'green', 'blue'.",
    )


@pytest.mark.parametrize("encoding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_gaussians_of_2dgs_have_no_thickness(tmp_path, encoding):
    columns = random_columns(20, 1)
    wanted = expected_gaussians(columns)
    wanted["scales"][:, 2] = 0
    del columns["scale_2"]
    path = put(tmp_path / "a.ply", columns, encoding)
    assert_close(read(path), wanted)
    (note,) = open_asset(path).declared.notes
    assert note.startswith("scale_2 is missing, so these are the gaussians of 2DGS")


def test_the_filter_of_mip_splatting_is_applied(tmp_path):
    """The expected values follow `get_scaling_with_3D_filter` and
    `get_opacity_with_3D_filter` in the code of Mip-Splatting."""
    columns = random_columns(20, 1)
    sizes = np.random.default_rng(1).uniform(0, 2, 20).astype(np.float32)
    sizes[0] = 0
    wanted = expected_gaussians(columns)
    squares = wanted["scales"] ** 2
    widened = squares + sizes[:, None].astype(np.float64) ** 2
    wanted["scales"] = np.sqrt(widened)
    wanted["opacities"] *= np.sqrt(squares.prod(axis=1) / widened.prod(axis=1))
    path = put(tmp_path / "a.ply", columns | {"filter_3D": sizes})
    assert_close(read(path), wanted)
    declared = open_asset(path).declared
    assert declared.antialiased is True
    (note,) = declared.notes
    assert note.startswith("filter_3D of Mip-Splatting was applied to scales and opacities; ")


def test_coefficients_of_degree_4_are_left_out(tmp_path):
    columns = random_columns(20, 4)
    wanted = expected_gaussians(columns)
    wanted["sh"] = wanted["sh"][:, :16]
    path = put(tmp_path / "a.ply", columns)
    assert_close(read(path), wanted)
    file = open_asset(path)
    assert file.sh_degree == 3
    assert file.declared.notes == ("Coefficients of SH degree 4 were ignored.",)


def test_what_no_gaussian_has_is_told(tmp_path):
    columns = random_columns(20, 0)
    extra = {f"semantic_{i}": np.zeros(20, np.float32) for i in range(9)}
    extra["lists"] = [np.arange(i % 3, dtype="i4") for i in range(20)]
    delta = Element("delta_vertex_0", {"x": np.zeros(20, np.float32)})
    empty = Element("face", {"a": np.zeros(0, np.float32)})
    path = put(tmp_path / "a.ply", columns | extra, others=[delta, empty])
    assert_close(read(path), expected_gaussians(columns))
    properties, elements = open_asset(path).declared.notes
    names = ", ".join(f"'semantic_{i}'" for i in range(8))
    assert properties == (
        f"Properties of vertex that are unknown were ignored: {names} and 2 more."
    )
    assert elements == "Elements other than vertex were ignored: 'delta_vertex_0'."


@pytest.mark.parametrize("dtype", ["f2", "i8", "u8"])
def test_types_that_the_format_does_not_name_are_read(tmp_path, dtype):
    columns = random_columns(20, 0)
    for name in ("x", "rot_1", "extra"):
        columns[name] = np.arange(20).astype(dtype)
    special = np.array([6e-8, -0.0, 65504, -np.inf], "f2")
    columns["y"] = np.resize(special, 20)
    columns["z"] = np.resize(special, 20).astype(np.float32)
    found = read(put(tmp_path / "a.ply", columns))
    np.testing.assert_array_equal(found.means[:, 0], np.arange(20))
    np.testing.assert_array_equal(found.means[:, 1], found.means[:, 2])
    assert_close(
        replace(found, means=np.zeros((20, 3), np.float32)),
        expected_gaussians(columns | {name: np.zeros(20) for name in MEAN}),
    )


def test_headers_with_carriage_returns_are_read(tmp_path):
    columns = random_columns(20, 1)
    for encoding in ("ascii", "binary_little_endian"):
        content = ply_bytes([Element("vertex", columns)], encoding, newline="\r\n")
        (tmp_path / "a.ply").write_bytes(content)
        assert_close(read(tmp_path / "a.ply"), expected_gaussians(columns))


def test_what_a_compressed_ply_has_besides_is_told(tmp_path):
    asset = random_gaussians(3, 1)
    write_asset(tmp_path / "a.compressed.ply", asset)
    content = (tmp_path / "a.compressed.ply").read_bytes()
    extra = b"element state 2\nproperty uchar flags\nend_header\n"
    content = content.replace(b"end_header\n", extra, 1) + bytes(2)
    (tmp_path / "b.ply").write_bytes(content)
    assert open_asset(tmp_path / "b.ply").declared.notes == (
        "Elements other than chunk, vertex and sh were ignored: 'state'.",
    )
    found = read(tmp_path / "b.ply")
    np.testing.assert_array_equal(found.means, read(tmp_path / "a.compressed.ply").means)


def sog_files(path, change=(), folder=""):
    """Write the files of a SOG to a folder, with some fields of meta.json changed."""
    with zipfile.ZipFile(path) as archive:
        files = {folder + name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files[f"{folder}meta.json"]) | dict(change)
    return files | {f"{folder}meta.json": json.dumps(meta).encode()}


def zipped(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return path


SOG_FIELDS = {
    "nothing": ({}, None, []),
    "splat-transform": ({"model": "antialiased"}, True, []),
    "splat-transform, not": ({"model": "default"}, False, []),
    "others": ({"antialias": True}, True, []),
    "2DGS": ({"model": "2dgs"}, None, ["The gaussians are those of 2DGS; they were read as f"]),
    "a later one": ({"model": "cubes"}, None, ['The model "cubes" is unknown and was ignored.']),
    "a camera": ({"camera": {"fov": 1}}, None, ["Fields of meta.json were ignored: 'camera'."]),
}


@pytest.mark.parametrize("case", SOG_FIELDS)
def test_what_sog_declares_is_told(tmp_path, case):
    change, antialiased, notes = SOG_FIELDS[case]
    files = sog_files(FIXTURES / "sh3.sog", change)
    path = zipped(tmp_path / "a.sog", files)
    declared = open_asset(path).declared
    assert declared.antialiased is antialiased
    assert [note[: len(text)] for note, text in zip(declared.notes, notes, strict=True)] == notes
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    assert open_asset(tmp_path / "meta.json").declared == declared


@pytest.mark.parametrize("folder", ["donut/", "a/b c/"])
def test_a_sog_may_be_zipped_with_its_folder(tmp_path, folder):
    files = sog_files(FIXTURES / "sh3.sog", folder=folder)
    files["__MACOSX/donut/._meta.json"] = b"x"
    files["__MACOSX/donut/meta.json"] = b"x"
    path = zipped(tmp_path / "a.sog", files)
    wanted = read(FIXTURES / "sh3.sog")
    np.testing.assert_array_equal(read(path).means, wanted.means)
    assert open_asset(path).num_gaussians == len(wanted)
    twice = zipped(tmp_path / "b.sog", files | sog_files(FIXTURES / "sh3.sog", folder="other/"))
    with pytest.raises(ValueError, match=r"expected one SOG in the zip, got several: '(donut|a)/"):
        read(twice)
    streamed = zipped(tmp_path / "c.sog", files | {"donut/lod-meta.json": b"{}"})
    with pytest.raises(ValueError, match="got a streamed SOG; unpack the zip and open lod-meta"):
        read(streamed)


def test_a_streamed_sog_declares_what_its_folders_do(tmp_path):
    for number, model in enumerate(("antialiased", "antialiased", "default")):
        folder = tmp_path / str(number)
        folder.mkdir()
        for name, content in sog_files(FIXTURES / "sh3.sog", {"model": model, "x": 1}).items():
            (folder / name).write_bytes(content)

    def declared(numbers):
        files = [f"{number}/meta.json" for number in numbers]
        leaves = [{"lods": {"0": {"file": i, "offset": 0, "count": 64}}} for i in range(len(files))]
        document = {
            "lodLevels": 1, "filenames": files, "tree": {"children": leaves}, "camera": {},
        }  # fmt: skip
        (tmp_path / "lod-meta.json").write_bytes(b"\xef\xbb\xbf" + json.dumps(document).encode())
        return open_asset(tmp_path / "lod-meta.json").declared

    notes = ("Fields of meta.json were ignored: 'x'.",)
    notes += ("Fields of lod-meta.json were ignored: 'camera'.",)
    assert declared([0, 1]).antialiased is True
    assert declared([0, 1]).notes == notes
    assert declared([0, 2]).antialiased is None
    assert declared([0, 2]).notes[2].startswith("Some folders were trained with antialiasing")


def test_a_newer_ksplat_is_told(tmp_path):
    content = bytearray((FIXTURES / "sh3_mkkellogg_0.ksplat").read_bytes())
    (tmp_path / "a.ksplat").write_bytes(content)
    assert open_asset(tmp_path / "a.ksplat").declared.notes == ()
    content[1] = 2
    (tmp_path / "a.ksplat").write_bytes(content)
    assert open_asset(tmp_path / "a.ksplat").declared.notes == (
        "Version 0.2 was read as version 0.1.",
    )


FILES = ["sh3.sog", "sh3_v3.spz", "sh3_v4.spz", "sh3_mkkellogg_0.ksplat", "sh3.glb"]
FILES += ["sh3_mkkellogg_2.ksplat", "sh0_gaussforge.splat"]


def test_only_records_are_recognised_as_a_splat(tmp_path):
    """A `.splat` file has no signature, so it is recognised by the values of its
    records."""
    content = (FIXTURES / "sh0_gaussforge.splat").read_bytes()
    path = tmp_path / "a.ply"
    turned = bytearray(content)
    turned[28:32] = b"\x80\x80\x80\x80"
    negative = bytearray(content)
    negative[12:16] = np.float32(-1).tobytes()
    noise = np.random.default_rng(0).bytes(len(content))
    for wrong in (content[:-1], bytes(turned), bytes(negative), noise):
        path.write_bytes(wrong)
        with pytest.raises(ValueError, match="expected a first line 'ply'"):
            open_asset(path)
    path.write_bytes(content)
    assert len(open_asset(path).read(0, 3)) == 3


@pytest.mark.parametrize("suffix", [".splat", ".ply", ".compressed.ply", ".ksplat", ".spz", ".pt"])
@pytest.mark.parametrize("file", FILES)
def test_misnamed_files_are_recognised(tmp_path, file, suffix):
    path = tmp_path / f"a{suffix}"
    shutil.copyfile(FIXTURES / file, path)
    wanted = open_asset(FIXTURES / file)
    found = open_asset(path)
    np.testing.assert_array_equal(found.read(0, 5).means, wanted.read(0, 5).means)
    own = Path(file).suffix
    if own == suffix:
        assert found.declared == wanted.declared
        return
    named = suffix.removeprefix(".compressed")
    note = f"The name ends in {named}, but the file is a {own}; it was read as such."
    assert found.declared.notes == (note, *wanted.declared.notes)


def test_a_ply_called_splat_is_recognised(tmp_path):
    columns = random_columns(20, 1)
    path = put(tmp_path / "a.splat", columns)
    assert_close(read(path), expected_gaussians(columns))


def test_a_splat_that_begins_like_a_ksplat_is_a_splat(tmp_path):
    """The file begins with values that could be a `.ksplat` header."""
    rows = np.random.default_rng(0).integers(1, 255, (200, 32)).astype(np.uint8)
    rows[0] = np.frombuffer(struct.pack("<BB2xIIIIH10x", 0, 1, 1, 1, 1, 1, 0), np.uint8)
    (tmp_path / "a.splat").write_bytes(rows.tobytes())
    file = open_asset(tmp_path / "a.splat")
    assert file.num_gaussians == 200
    assert file.declared.notes == ()


@pytest.mark.parametrize("name", ["a.zip", "a.gz", "a", "a.bin"])
def test_files_of_unknown_names_are_read_by_their_content(tmp_path, name):
    shutil.copyfile(FIXTURES / "sh3.sog", tmp_path / name)
    file = open_asset(tmp_path / name)
    wanted = open_asset(FIXTURES / "sh3.sog")
    note = "The end of its name is unknown; the file is a .sog and was read as such."
    assert file.declared.notes == (note, *wanted.declared.notes)
    np.testing.assert_array_equal(file.read(0, 10).means, wanted.read(0, 10).means)
    assert asset_bytes(tmp_path / name) == (tmp_path / name).stat().st_size
    (tmp_path / name).write_bytes(gzip.compress(b"ply\nformat ascii 1.0\n"))
    with pytest.raises(ValueError, match=r"this is a gzip of a \.ply; unpack it$"):
        read(tmp_path / name)
    (tmp_path / name).write_bytes(b"PXR-USDC" + bytes(100))
    with pytest.raises(ValueError, match=r"this is a \.usdc, so rename it to end in that$"):
        read(tmp_path / name)


def zip_of(*names):
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w") as archive:
        for name in names:
            archive.writestr(name, b"x")
    return stream.getvalue()


OTHERS = {
    "a web page": (b"\n<!DOCTYPE HTML><html>", "a web page; download the file itself"),
    "a pointer": (b"version https://git-lfs.github.com/spec/v1\n", "a Git LFS pointer instead"),
    "a packed ply": (gzip.compress(b"ply\nformat ascii 1.0\n"), "a gzip of a .ply; unpack it"),
    "a zip of a ply": (zip_of("a/b.ply"), "a zip of 'a/b.ply'; unpack it"),
    "a zip of USD": (zip_of("a.usdc"), "a .usdz"),
    "a picture": (b"\x89PNG\r\n\x1a\n", "a picture"),
    "an old checkpoint": (
        b"\x80\x02\x8a\nl\xfc\x9cF\xf9 j\xa8P\x19.", "a checkpoint of torch before 1.6; save",
    ),
    "a bundle": (struct.pack("<Q", 300) + b'{"__metadata__":{}}', "a file of safetensors"),
}  # fmt: skip


@pytest.mark.parametrize("suffix", [".ply", ".splat", ".sog"])
@pytest.mark.parametrize("case", OTHERS)
def test_files_that_are_no_asset_are_named(tmp_path, case, suffix):
    content, text = OTHERS[case]
    path = tmp_path / f"a{suffix}"
    path.write_bytes(content + bytes(-len(content) % 32))
    with pytest.raises(ValueError, match=re.escape(f"{path}: expected a {suffix}, got {text}")):
        read(path)
