"""Common properties of all readers and writers: for any damage, an error says what is
wrong and where. Damage that is specific to one format is tested with that format.
"""

import ast
import contextlib
import gzip
import itertools
import json
import os
import pickle
import resource
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
import torch

import v3dg
from gltf_files import GltfFile
from random_bundle import random_bundle, random_gaussians
from test_camera_file import CAPTURE
from test_formats import FIXTURES, gsplat_tensors, hier_of
from test_ply import HOSTILE, Element, ply_bytes, random_columns, vertex_lines
from test_ply import header as ply_header
from test_scene_file import GOOD, flat_layout, published_layout
from v3dg import Gaussians
from v3dg.io import open_asset
from v3dg.pictures import write_picture

BUNDLE = random_bundle(1)
OF_DEGREE_3 = random_gaussians(np.random.default_rng(1), 40, 3)
BUNDLES = {"sub/donut.v3dg": BUNDLE, "donut.ply": BUNDLE, "oak": BUNDLE, "donut": BUNDLE}


def read_scene(path):
    return v3dg.read_scene(path, bundles=BUNDLES)


def read_asset(path):
    """Return all gaussians, after checking that reading them in parts gives the same
    gaussians, or also fails with an explanation."""

    def read_in_parts(path):
        file = open_asset(path)
        cuts = [0, file.num_gaussians // 2, file.num_gaussians]
        return Gaussians.concatenate(
            [file.read(first, last) for first, last in itertools.pairwise(cuts)]
        )

    try:
        whole = v3dg.read_asset(path)
    except (ValueError, OSError) as expected:
        with pytest.raises((ValueError, OSError)) as error:
            read_in_parts(path)
        for text in (str(error.value), str(expected)):
            assert text.isprintable()
            assert os.path.basename(path) in text or "\0" in os.fspath(path)
        raise
    parts = read_in_parts(path)
    for name, array in vars(whole).items():
        np.testing.assert_array_equal(array, getattr(parts, name))


def read_bundle(path):
    return v3dg.Bundle.open(path).gaussians


def bundle_content(folder):
    BUNDLE.write(folder / "whole.v3dg")
    return (folder / "whole.v3dg").read_bytes()


def written(path):
    v3dg.write_asset(path, BUNDLE.level_gaussians(0))
    return path.read_bytes()


def gltf_content(path):
    file = GltfFile()
    file.nodes({"mesh": file.mesh(BUNDLE.level_gaussians(0)), "translation": [1, 2, 3]})
    return file.write(path).read_bytes()


def checkpoint(path):
    torch.save({"splats": gsplat_tensors(BUNDLE.level_gaussians(0))}, path)
    return path.read_bytes()


# The name of a file, the content of a valid one, and the function that reads it.
READERS = {
    "ply": (
        "a.ply",
        lambda _: ply_bytes([Element("vertex", random_columns(2, 0))], "ascii"),
        read_asset,
    ),
    "bundle": ("a.v3dg", bundle_content, read_bundle),
    "scene": ("a.json", lambda _: json.dumps(GOOD).encode(), read_scene),
    "layout": ("a.json", lambda _: json.dumps(published_layout()).encode(), read_scene),
    "flat layout": ("a.json", lambda _: json.dumps(flat_layout()).encode(), read_scene),
    "compressed ply": ("a.ply", lambda folder: written(folder / "w.compressed.ply"), read_asset),
    "spz": ("a.spz", lambda folder: written(folder / "w.spz"), read_asset),
    "spz 4": ("a.spz", lambda _: (FIXTURES / "sh3_v4.spz").read_bytes(), read_asset),
    "ksplat": (
        "a.ksplat",
        lambda _: (FIXTURES / "sh3_mkkellogg_2.ksplat").read_bytes(),
        read_asset,
    ),
    "sog": ("a.sog", lambda _: (FIXTURES / "sh3.sog").read_bytes(), read_asset),
    "glb": ("a.glb", lambda folder: written(folder / "w.glb"), read_asset),
    "gltf": ("a.gltf", lambda folder: gltf_content(folder / "w.gltf"), read_asset),
    "hier": ("a.hier", lambda _: hier_of(OF_DEGREE_3, half=False), read_asset),
    "half hier": ("a.hier", lambda _: hier_of(OF_DEGREE_3, half=True), read_asset),
    "checkpoint": ("a.pt", lambda folder: checkpoint(folder / "w.pt"), read_asset),
    "cameras": ("a.json", lambda _: json.dumps(CAPTURE).encode(), v3dg.read_cameras),
}


def assert_refused(read, path):
    """Assert that it raises an error that a user can act on: one line that names the
    file."""
    with pytest.raises((ValueError, OSError)) as error:
        read(path)
    text = str(error.value)
    assert path.name in text
    assert text.isprintable()


@pytest.mark.parametrize("reader", READERS)
def test_good_files_are_read(tmp_path, reader):
    """If the readers refused undamaged files, the tests below would show nothing."""
    name, content, read = READERS[reader]
    (tmp_path / name).write_bytes(content(tmp_path))
    read(tmp_path / name)
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / name).symlink_to(tmp_path / name)
    read(tmp_path / "links" / name)


CONTENTS = {
    "nothing": lambda good: b"",
    "one zero": lambda good: b"\0",
    "a line feed": lambda good: b"\n",
    "zeros": lambda good: bytes(1 << 16),
    "ones": lambda good: b"\xff" * (1 << 16),
    "noise": lambda good: np.random.default_rng(0).bytes(1 << 16),
    "text": lambda good: "Käse und Brot\n".encode() * 100,
    "latin-1": lambda good: "Käse und Brot\n".encode("latin-1") * 100,
    "utf-16": lambda good: "Käse und Brot\n".encode("utf-16") * 100,
    "good after two byte order marks": lambda good: 2 * b"\xef\xbb\xbf" + good,
    "good after a zero": lambda good: b"\0" + good,
    "good after a space": lambda good: b" \xa0" + good,
    "good but packed": gzip.compress,
    "good backwards": lambda good: good[::-1],
    "good without its first half": lambda good: good[len(good) // 2 :],
    "good with every byte increased": lambda good: bytes((byte + 1) % 256 for byte in good),
    "a program": lambda good: b"\x7fELF\x02\x01\x01" + bytes(1000),
    "a pickle": lambda good: pickle.dumps({"means": [1.0, 2.0]}),
    "an archive": lambda good: b"PK\x03\x04" + bytes(1000),
    "a number": lambda good: b"3",
    "a list": lambda good: b"[]",
    "an object": lambda good: b"{}",
    "a long list": lambda good: b"[" + b"0," * 100_000 + b"0]",
    "a deep list": lambda good: b"[" * 100_000 + b"]" * 100_000,
    "deep objects": lambda good: b'{"a":' * 100_000 + b"1" + b"}" * 100_000,
    "a long number": lambda good: b"1" * 100_000,
}


@pytest.mark.parametrize("reader", READERS)
def test_only_text_may_have_a_byte_order_mark(tmp_path, reader):
    """Programs on Windows write such a mark before JSON."""
    name, content, read = READERS[reader]
    (tmp_path / name).write_bytes(b"\xef\xbb\xbf" + content(tmp_path))
    if name.endswith((".json", ".gltf")):
        read(tmp_path / name)
    else:
        assert_refused(read, tmp_path / name)


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("content", CONTENTS)
def test_other_content_is_refused(tmp_path, reader, content):
    name, good, read = READERS[reader]
    (tmp_path / name).write_bytes(CONTENTS[content](good(tmp_path)))
    assert_refused(read, tmp_path / name)


@pytest.mark.parametrize(
    ("reader", "other"),
    [(a, b) for a in READERS for b in READERS if READERS[a][2] is not READERS[b][2]],
)
def test_files_of_another_kind_are_refused(tmp_path, reader, other):
    name, _, read = READERS[reader]
    (tmp_path / name).write_bytes(READERS[other][1](tmp_path))
    assert_refused(read, tmp_path / name)


def link(target):
    return lambda path: path.symlink_to(target)


PLACES = {
    "missing": lambda path: None,
    "a folder": Path.mkdir,
    "a link to a folder": link("/"),
    "a pipe": os.mkfifo,
    "a link to a device": link("/dev/null"),
    "a link to an endless device": link("/dev/zero"),
    "a link to nothing": link("absent"),
    "a link to itself": lambda path: path.symlink_to(path),
    "a file that cannot be read": link("/proc/self/mem"),
}


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("place", PLACES)
def test_other_places_are_refused(tmp_path, reader, place):
    name, _, read = READERS[reader]
    PLACES[place](tmp_path / name)
    assert_refused(read, tmp_path / name)


@pytest.mark.parametrize("reader", READERS)
def test_impossible_names_are_refused(tmp_path, reader):
    name, good, read = READERS[reader]
    (tmp_path / name).write_bytes(good(tmp_path))
    assert_refused(read, tmp_path / name / name)  # a path below a file
    assert_refused(read, tmp_path / ("x" * 300 + name))
    with pytest.raises(ValueError, match="null"):
        read(os.fspath(tmp_path) + "/\0" + name)


@contextlib.contextmanager
def without_privileges():
    """Run as a user whom file permissions restrict."""
    is_root = os.geteuid() == 0
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)


def let_others_look(folder):
    """Open a temporary folder to every user, with the folders above it that pytest
    created for its own user. A process of pytest-xdist has one more of these."""
    folders = [folder, *folder.parents]
    names = [path.name.startswith("pytest-of-") for path in folders]
    top = names.index(True) if any(names) else 2
    for path in folders[: top + 1]:
        path.chmod(0o755)


@pytest.mark.parametrize("reader", READERS)
def test_unreadable_files_are_named(tmp_path, reader):
    name, good, read = READERS[reader]
    path = tmp_path / name
    path.write_bytes(good(tmp_path))
    path.chmod(0)
    with without_privileges(), pytest.raises(PermissionError, match=name):
        read(path)


@pytest.mark.parametrize("reader", READERS)
def test_every_truncation_is_refused(tmp_path, reader):
    name, content, read = READERS[reader]
    good = content(tmp_path)
    # A text that lacks its last digits still ends with a number, so truncation begins
    # before it.
    last = good.rfind(b" ") + 1 if reader == "ply" else len(good)
    # The tests of bundles truncate at every offset. Readers of the other formats ignore
    # most bytes.
    step = {"bundle": 37, "sog": 37, "ksplat": 37, "checkpoint": 37, "gltf": 37}.get(reader, 1)
    for size in range(0, last, step):
        (tmp_path / name).write_bytes(good[:size])
        assert_refused(read, tmp_path / name)


@pytest.mark.parametrize("reader", ["scene", "layout", "flat layout", "cameras"])
def test_changed_bytes_of_json_never_do_worse_than_an_error(tmp_path, reader):
    name, content, read = READERS[reader]
    good = content(tmp_path)
    for place in range(len(good)):
        for value in b'\0\x80"9-[{x':
            (tmp_path / name).write_bytes(good[:place] + bytes([value]) + good[place + 1 :])
            try:
                read(tmp_path / name)
            except (ValueError, FileNotFoundError) as error:
                assert str(error).startswith(f"{name}: ")  # noqa: PT017 (either outcome is right)


JSON_TEXTS = {
    "a key twice": (b'{"format": 1, "format": 2}', 'the key "format" occurs twice'),
    "a key twice far down": (b'{"a": [{"b": 1, "b": 1}]}', 'the key "b" occurs twice'),
    "NaN": (b'{"a": NaN}', "NaN is not a JSON number"),
    "-Infinity": (b'{"a": [-Infinity]}', "-Infinity is not a JSON number"),
    "no quotes": (b"{a: 1}", "Expecting property name"),
    "single quotes": (b"{'a': 1}", "Expecting property name"),
    "a comment": (b'{"a": 1 // one\n}', "Expecting ',' delimiter"),
    "a comma too many": (b'{"a": 1,}', "got a file that does not parse"),
    "a tab in a string": (b'{"a\tb": 1}', "Invalid control character"),
    "an unknown escape": (rb'{"a": "\x41"}', "Invalid \\escape"),
    "two documents": (b"{} {}", "Extra data"),
    "a leading zero": (b'{"a": 01}', "Expecting ',' delimiter"),
    "more digits than are safe": (
        b'{"a": ' + b"9" * 10_000 + b"}",
        "got a file that does not parse",
    ),
    "bytes that are no UTF-8": (b'{"a": "\xff"}', "can't decode byte 0xff"),
    "UTF-8 of a surrogate": (b'{"a": "\xed\xa0\x80"}', "can't decode byte 0xed"),
    "overlong UTF-8": (b'{"a": "\xc0\xaf"}', "can't decode byte 0xc0"),
}


@pytest.mark.parametrize("read", [read_scene, v3dg.read_cameras])
@pytest.mark.parametrize("case", JSON_TEXTS)
def test_loose_json_is_refused(tmp_path, read, case):
    content, message = JSON_TEXTS[case]
    (tmp_path / "a.json").write_bytes(content)
    with pytest.raises(
        ValueError, match=r"^a\.json: expected JSON, got a file that does not parse: "
    ) as error:
        read(tmp_path / "a.json")
    assert message in str(error.value)


SURROGATE = "\ud800"


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (
            ["bundles", "donut"],
            SURROGATE,
            "bundles.donut: expected a string without control characters",
        ),
        (
            ["cameras", 0, "name"],
            SURROGATE,
            "cameras[0].name: expected a string without control characters",
        ),
        (
            ["cameras", 0, "name"],
            "a\nb",
            "cameras[0].name: expected a string without control characters",
        ),
        (["a\nb"], 3, '"a\\nb": expected one of format, version, bundles, instances, cameras'),
        (["a" * 99], 3, f'"{"a" * 56}...: expected one of format, version'),
        (["version"], True, "version: expected version 1"),
        (["instances", 0, "position", 0], float("1e400"), None),
        (["cameras", 0, "width"], 1e30, "cameras[0].width: expected at most 1048576 px"),
        (["cameras", 0, "width"], -0.0, "cameras[0].width: expected a positive whole number"),
        (["cameras", 1, "viewmat"], [[1e200] * 4] * 4, "cameras[1].viewmat: expected a rotation"),
        (["cameras", 1, "K", 0, 0], 1e-400, "cameras[1].K: expected positive focal lengths"),
    ],
)
def test_extreme_values_of_a_scene_are_refused(tmp_path, place, value, message):
    document = json.loads(json.dumps(GOOD))
    target = document
    for key in place[:-1]:
        target = target[key]
    target[place[-1]] = value
    text = json.dumps(document).replace("Infinity", "1e400")
    (tmp_path / "a.json").write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=r"^a\.json: ") as error:
        read_scene(tmp_path / "a.json")
    assert (message or "instances[0].position[0]: expected a finite number") in str(error.value)
    assert str(error.value).isprintable()


CLAIMS = {
    "gaussians": ("a.ply", ply_header(*vertex_lines(10**12))),
    "gaussians as text": (
        "a.ply",
        ply_header(*vertex_lines(10**12), format_line="format ascii 1.0"),
    ),
    "list items": (
        "a.ply",
        ply_header("element face 1", "property list uint double n", *vertex_lines(0))
        + b"\xff" * 40,
    ),
    "rows of another element": (
        "a.ply",
        ply_header("element face 99999999999999", "property int a"),
    ),
    "header bytes of a bundle": ("a.v3dg", (1 << 40).to_bytes(8, "little") + bytes(100)),
    "clusters": (
        "a.v3dg",
        (lambda text: len(text).to_bytes(8, "little") + text)(
            json.dumps(
                {
                    "__metadata__": {
                        "format": "v3dg",
                        "version": "1",
                        "sh_degree": "0",
                        "config": "{}",
                    },
                    **{
                        name: {"dtype": "U8", "shape": [1 << 40], "data_offsets": [0, 1 << 40]}
                        for name in ("pages", "clusters.level", "groups.parent", "pages.bytes")
                    },
                }
            ).encode()
        ),
    ),
}


@pytest.mark.parametrize("claim", CLAIMS)
def test_claims_of_a_header_cost_no_memory(tmp_path, claim):
    name, content = CLAIMS[claim]
    path = tmp_path / name
    path.write_bytes(content)
    read = v3dg.read_asset if name.endswith(".ply") else read_bundle
    assert_refused(read, path)  # import late modules before memory is measured
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    tracemalloc.start()
    try:
        assert_refused(read, path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert peak < 1 << 20
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 1 << 14  # KiB


def test_nothing_that_is_read_can_be_executed():
    """No module that reads files has a function that executes content."""
    forbidden = {"pickle", "marshal", "shelve", "eval", "exec", "compile", "__import__", "yaml"}
    for path in Path(v3dg.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            names = {alias.name for alias in node.names} if isinstance(node, ast.Import) else set()
            if isinstance(node, ast.ImportFrom):
                names.add(node.module)
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                names.add(node.func.id)
            assert not names & forbidden, f"{path.name}, line {node.lineno}"
            is_load = isinstance(node, ast.Call) and ast.unparse(node.func) in (
                "np.load",
                "torch.load",
            )
            assert not is_load or "weights_only=True" in ast.unparse(node), (
                f"{path.name}, line {node.lineno}"
            )


ASSET = random_gaussians(np.random.default_rng(0), 200)
CAMERA = v3dg.Camera.look_at((0, -5, 0), (0, 0, 0), width=8, height=8)
WRITERS = {
    "ply": ("a.ply", lambda path: v3dg.write_asset(path, ASSET)),
    "bundle": ("a.v3dg", BUNDLE.write),
    "scene": ("a.json", lambda path: v3dg.write_scene(path, v3dg.Scene.of(BUNDLE), ["b.v3dg"])),
    "compressed ply": ("a.compressed.ply", lambda path: v3dg.write_asset(path, ASSET)),
    "spz": ("a.spz", lambda path: v3dg.write_asset(path, ASSET)),
    "glb": ("a.glb", lambda path: v3dg.write_asset(path, ASSET)),
    "cameras": ("a.json", lambda path: v3dg.write_cameras(path, {"a": CAMERA})),
    "picture": ("a.png", lambda path: write_picture(path, np.zeros((8, 8, 3), np.float32))),
}


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("place", ["a folder", "a pipe", "a link to a device"])
def test_writing_to_what_is_no_file_is_refused(tmp_path, writer, place):
    name, write = WRITERS[writer]
    PLACES[place](tmp_path / name)
    assert_refused(write, tmp_path / name)
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("writer", WRITERS)
def test_writing_below_nothing_or_a_file_is_refused(tmp_path, writer):
    name, write = WRITERS[writer]
    assert_refused(write, tmp_path / "absent" / name)
    (tmp_path / "file").touch()
    assert_refused(write, tmp_path / "file" / name)
    assert os.listdir(tmp_path) == ["file"]


@pytest.mark.parametrize("writer", WRITERS)
def test_writing_to_a_read_only_folder_is_refused(tmp_path, writer):
    name, write = WRITERS[writer]
    (tmp_path / name).write_bytes(b"before")
    let_others_look(tmp_path)
    tmp_path.chmod(0o555)
    try:
        with without_privileges():
            assert_refused(write, tmp_path / name)
    finally:
        tmp_path.chmod(0o755)
    assert (tmp_path / name).read_bytes() == b"before"
    assert os.listdir(tmp_path) == [name]


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("num_bytes", [0, 40])
def test_a_full_disk_is_named_and_leaves_what_was_there(tmp_path, writer, num_bytes):
    name, write = WRITERS[writer]
    (tmp_path / name).write_bytes(b"before")
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        with pytest.raises(OSError, match=f"File too large: '.*{name}'"):
            write(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert (tmp_path / name).read_bytes() == b"before"
    assert os.listdir(tmp_path) == [name]


def test_enough_is_tried():
    """There are at least two hundred broken inputs, not counting changed bytes and
    truncations."""
    here = len(READERS) * (len(CONTENTS) + len(PLACES) + 4) + 2 * len(JSON_TEXTS) + len(CLAIMS)
    assert here + len(HOSTILE) > 200
