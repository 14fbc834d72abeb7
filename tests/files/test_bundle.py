import contextlib
import copy
import dataclasses
import errno
import hashlib
import itertools
import json
import os
import pickle
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.numpy import save_file

import v3dg
from file_hash import file_hash
from golden import golden_bundles
from random_bundle import random_bundle, random_gaussians
from v3dg import _core
from v3dg.bundle import Bundle, Clusters, Groups
from v3dg.bundle import file as bundle_file
from v3dg.bundle.codec import CODECS
from v3dg.bundle.format import SCHEMA
from v3dg.gaussians import Gaussians

TABLE_NAMES = [name for name, *_ in SCHEMA]
ATTRIBUTES = ("means", "quats", "scales", "opacities", "sh")
FORMAT_PAGE = Path(__file__).parents[2] / "docs" / "format.md"
DTYPES = {"I64": "<i8", "I32": "<i4", "F32": "<f4", "U8": "u1"}
some_bundles = st.builds(
    random_bundle,
    st.integers(0, 2**32 - 1),
    num_levels=st.integers(0, 5),
    sh_degree=st.integers(0, 3),
    max_cluster=st.sampled_from([0, 1, 5, 200]),
    codec=st.sampled_from(sorted(CODECS)),
)


def page_content(bundle, page):
    """Return the bytes of a page without padding."""
    gaussians, clusters = bundle.read_page(page), bundle.page_range(page)
    if bundle.codec == "quantized":
        offset = bundle.clusters.offset[clusters.start : clusters.stop + 1]
        return _core.encode_page(gaussians.rows, offset - offset[0]).tobytes()
    return b"".join(getattr(gaussians, name).tobytes() for name in ATTRIBUTES)


def alignment_of(bundle):
    return 16 if bundle.codec == "quantized" else 4096


def assert_same_gaussians(a, b):
    for name in ATTRIBUTES:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=True)


def assert_same_tables(a, b):
    for table in ("clusters", "groups"):
        for name, array in vars(getattr(a, table)).items():
            np.testing.assert_array_equal(array, getattr(getattr(b, table), name), strict=True)


@pytest.fixture(params=CODECS)
def saved(tmp_path, request):
    """A small bundle of three levels, and its file."""
    bundle = random_bundle(3, config={"seed": 3}, codec=request.param)
    path = tmp_path / "small.v3dg"
    bundle.write(path)
    return bundle, path


class Reads:
    """Counts the bytes that this process reads."""

    def __init__(self):
        self.num_bytes = 0

    def _look(self):
        """Return the count of the operating system, and the number of bytes that
        reading this count adds to it."""
        text = Path("/proc/self/io").read_text()
        return int(re.search(r"^rchar: (\d+)$", text, re.MULTILINE)[1]), len(text)

    @property
    def num_bytes(self):
        count, own = self._look()
        found = count - self._before
        self._before += own
        return found

    @num_bytes.setter
    def num_bytes(self, value):
        assert value == 0
        self._before = sum(self._look())


@pytest.fixture
def reads():
    return Reads()


def split_file(data):
    """Return a file's header as a dict, and its tensors as arrays that can be
    changed."""
    header_bytes = int.from_bytes(data[:8], "little")
    header = json.loads(data[8 : 8 + header_bytes])
    tensors = {}
    for name, tensor in header.items():
        if name != "__metadata__":
            first, end = (8 + header_bytes + offset for offset in tensor["data_offsets"])
            tensors[name] = (
                np.frombuffer(data[first:end], DTYPES[tensor["dtype"]])
                .reshape(tensor["shape"])
                .copy()
            )
    return header, tensors


def join_file(header, tensors):
    """Return the file of this header and of these tensors in the header's order, with
    the correct hash."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    version = re.search(rb'"version": "([0-9]{1,9})"', text)
    text += b" " * (-(8 + len(text)) % (16 if b'"codec": "quantized"' in text else 4096))
    head = len(text).to_bytes(8, "little") + text
    tables = b"".join(tensors[name].tobytes() for name in TABLE_NAMES if name in tensors)
    digest = file_hash(head + tables, int(version[1]) if version else 3)
    return head + tensors["pages"].tobytes() + tables + digest


def open_changed(path, change):
    """Open the file after ``change(header, tensors)``; its hash is correct."""
    header, tensors = split_file(path.read_bytes())
    header = change(header, tensors) or header
    path.write_bytes(join_file(header, tensors))
    return Bundle.open(path)


# Round trips.


@settings(max_examples=50)
@given(bundle=some_bundles)
def test_what_is_saved_is_opened(tmp_path_factory, bundle):
    path = tmp_path_factory.mktemp("round_trip") / "a.v3dg"
    bundle.write(path)
    opened = Bundle.open(path)
    assert_same_tables(bundle, opened)
    for cluster in range(len(bundle.clusters)):
        assert_same_gaussians(bundle.cluster_gaussians(cluster), opened.cluster_gaussians(cluster))
    for level in range(bundle.num_levels):
        assert_same_gaussians(bundle.level_gaussians(level), opened.level_gaussians(level))
    for page in range(bundle.num_pages):
        assert_same_gaussians(bundle.read_page(page), opened.read_page(page))
    assert_same_gaussians(bundle.gaussians, opened.gaussians)
    assert opened.config == bundle.config


@settings(max_examples=20)
@given(bundle=some_bundles)
def test_official_reader_sees_the_same(tmp_path_factory, bundle):
    path = tmp_path_factory.mktemp("official") / "a.v3dg"
    bundle.write(path)
    with safe_open(path, "np") as file:
        assert file.metadata()["format"] == "v3dg"
        for table in ("clusters", "groups"):
            for name, array in vars(getattr(bundle, table)).items():
                np.testing.assert_array_equal(
                    file.get_tensor(f"{table}.{name}"), array, strict=True
                )
        pages = file.get_slice("pages")
        places = [*file.get_tensor("pages.offset").tolist(), pages.get_shape()[0]]
        for page, (first, end) in enumerate(itertools.pairwise(places)):
            if first < end:  # an empty tensor cannot be sliced
                content = page_content(bundle, page)
                assert pages[first:end].tobytes() == content + bytes(end - first - len(content))


@settings(max_examples=20)
@given(bundle=some_bundles)
def test_reader_of_the_format_page_reads_it(tmp_path_factory, bundle):
    (code,) = re.findall(r"```python\n(.*?)```", FORMAT_PAGE.read_text(encoding="utf-8"), re.DOTALL)
    scope = {}
    exec(compile(code, str(FORMAT_PAGE), "exec"), scope)
    path = tmp_path_factory.mktemp("docs") / "a.v3dg"
    bundle.write(path)
    metadata, tables, read_page = scope["read_bundle"](path)
    assert int(metadata["sh_degree"]) == bundle.sh_degree
    np.testing.assert_array_equal(tables["clusters.box"], bundle.clusters.box)
    for page in range(bundle.num_pages):
        assert_same_gaussians(Gaussians(*map(np.array, read_page(page))), bundle.read_page(page))


def test_format_page_lists_the_tables_in_file_order(saved):
    text = FORMAT_PAGE.read_text(encoding="utf-8")
    documented = re.findall(r"^\| `([a-z0-9_.]+)` \| (\w+) \[", text, re.MULTILINE)
    header, _ = split_file(saved[1].read_bytes())
    del header["__metadata__"]
    in_file = sorted(header.items(), key=lambda item: item[1]["data_offsets"])
    only_of_floats = re.findall(
        r"^\| `([a-z0-9_.]+)` \| .*; only with float32 \|$", text, re.MULTILINE
    )
    assert len(only_of_floats) == 2
    has_floats = saved[0].codec == "float32"
    expected = [
        (name, dtype) for name, dtype in documented if has_floats or name not in only_of_floats
    ]
    assert expected == [(name, tensor["dtype"]) for name, tensor in in_file]


def test_same_bundle_gives_same_bytes(saved, tmp_path):
    _, path = saved
    again, from_file, loaded = (
        tmp_path / name for name in ("again.v3dg", "from_file.v3dg", "loaded.v3dg")
    )
    random_bundle(3, config={"seed": 3}, codec=saved[0].codec).write(again)
    Bundle.open(path).write(from_file)
    opened = Bundle.open(path)
    assert len(opened.gaussians) == opened.num_gaussians
    opened.write(loaded)
    assert path.read_bytes() == again.read_bytes() == from_file.read_bytes() == loaded.read_bytes()


def test_pages_are_aligned(saved):
    bundle, path = saved
    alignment = alignment_of(bundle)
    data = path.read_bytes()
    data_start = 8 + int.from_bytes(data[:8], "little")
    header, tensors = split_file(data)
    assert data_start % alignment == 0
    assert header["pages"]["data_offsets"][0] == 0
    for page, offset in enumerate(tensors["pages.offset"].tolist()):
        assert offset % alignment == 0
        assert data[data_start + offset :].startswith(page_content(bundle, page))


def test_a_page_is_the_clusters_of_one_parent_group():
    bundle = random_bundle(5, num_levels=4)
    assert bundle.num_pages == len(bundle.groups) + 1
    for page in range(bundle.num_pages):
        parents = bundle.clusters.parent_group[bundle.page_range(page)]
        assert set(parents.tolist()) == {page if page < len(bundle.groups) else -1}


def test_torch_gaussians_are_kept_as_numpy(saved):
    torch = pytest.importorskip("torch")
    bundle, _ = saved
    tensors = Gaussians(*(torch.from_numpy(getattr(bundle.gaussians, name)) for name in ATTRIBUTES))
    assert_same_gaussians(
        Bundle(bundle.clusters, bundle.groups, tensors).gaussians, bundle.gaussians
    )


def tables_of(bundle):
    return [*vars(bundle.clusters).values(), *vars(bundle.groups).values()]


def test_opened_gaussians_can_be_written(saved):
    opened = Bundle.open(saved[1])
    assert all(
        array.flags.aligned for array in (*tables_of(opened), *vars(opened.gaussians).values())
    )
    assert all(array.flags.writeable for array in vars(opened.gaussians).values())


def test_tables_cannot_be_changed_after_they_were_checked(saved):
    """Drawing trusts the tables: a wrong offset would read outside the bundle's
    memory."""
    bundle, path = saved
    built = v3dg.build_bundle(
        bundle.level_gaussians(0), config=v3dg.BuildConfig(steps=0), progress=False
    )
    opened = Bundle.open(path)
    copies = [copy.copy(bundle), copy.deepcopy(bundle), copy.copy(opened), copy.deepcopy(opened)]
    copies += [pickle.loads(pickle.dumps(some)) for some in (bundle, opened)]
    tables = Clusters(*map(np.copy, vars(bundle.clusters).values()))
    for some in (bundle, opened, built, *copies, Bundle(tables, bundle.groups, bundle.gaussians)):
        for array in tables_of(some):
            with pytest.raises(ValueError, match="read-only"):
                array[...] = 0
        for name in ("clusters", "groups"):
            with pytest.raises(AttributeError):
                setattr(some, name, getattr(bundle, name))


def test_arrays_that_tables_were_made_of_stay_their_owner_s(saved):
    bundle, _ = saved
    offset = bundle.clusters.offset.copy()
    made = Bundle(
        dataclasses.replace(bundle.clusters, offset=offset), bundle.groups, bundle.gaussians
    )
    offset[:] = 2**40
    np.testing.assert_array_equal(made.clusters.offset, bundle.clusters.offset)


def test_threads_read_large_bundles(tmp_path):
    bundle = random_bundle(1, num_levels=6, sh_degree=1, max_cluster=100)
    path = tmp_path / "a.v3dg"
    bundle.write(path)
    assert_same_gaussians(Bundle.open(path).gaussians, bundle.gaussians)


def test_reads_go_on_where_the_system_stops(saved, monkeypatch):
    bundle, path = saved
    preadv = os.preadv
    monkeypatch.setattr(
        os, "preadv", lambda fd, buffers, offset: preadv(fd, [buffers[0][:100]], offset)
    )
    assert_same_gaussians(Bundle.open(path).gaussians, bundle.gaussians)


def test_copies_go_through_pickle(saved):
    bundle, path = saved
    for original in (bundle, Bundle.open(path)):
        copy = pickle.loads(pickle.dumps(original))
        assert_same_tables(copy, bundle)
        assert_same_gaussians(copy.gaussians, bundle.gaussians)


# Pages that are read when they are needed.


def test_opening_reads_no_page(saved, reads):
    _, path = saved
    _, tensors = split_file(path.read_bytes())
    reads.num_bytes = 0
    Bundle.open(path)
    assert reads.num_bytes == path.stat().st_size - tensors["pages"].nbytes


def test_a_cluster_reads_its_page_once(saved, reads):
    bundle, path = saved
    opened = Bundle.open(path)
    page = int(np.argmax([len(opened.page_range(p)) for p in range(opened.num_pages)]))
    _, tensors = split_file(path.read_bytes())
    reads.num_bytes = 0
    for cluster in opened.page_range(page):
        assert_same_gaussians(opened.cluster_gaussians(cluster), bundle.cluster_gaussians(cluster))
    places = [*tensors["pages.offset"].tolist(), len(tensors["pages"])]
    assert len(opened.page_range(page)) > 1
    assert reads.num_bytes == places[page + 1] - places[page] > 0


def test_a_level_reads_its_pages_only(saved, reads):
    bundle, path = saved
    opened = Bundle.open(path)
    for level in range(bundle.num_levels):
        reads.num_bytes = 0
        assert_same_gaussians(opened.level_gaussians(level), bundle.level_gaussians(level))
        assert reads.num_bytes == opened.info()["levels"][level]["bytes"]


def test_a_sparse_file_of_ten_gigabytes_opens(tmp_path, reads):
    """A page has one cluster, as in builds, and 40 MB, so that the tables stay
    small."""
    num_levels, per_cluster = 256, 200_000
    level = np.arange(num_levels, dtype=np.int32)
    ball = np.zeros((num_levels - 1, 4), np.float32)
    ball[:, 3] = 1.01 ** np.arange(num_levels - 1)
    clusters = Clusters(
        offset=np.arange(num_levels + 1) * per_cluster,
        level=level,
        own_group=level - np.int32(1),
        parent_group=np.append(level[:-1], np.int32(-1)),
        box=np.zeros((num_levels, 2, 3), np.float32),
        filter_px2=np.zeros(num_levels, np.float32),
        antialiased=np.zeros(num_levels, np.uint8),
    )
    groups = Groups(
        ball=ball,
        weight=np.ones(num_levels - 1, np.float32),
        parent=np.append(level[1:-1], np.int32(-1)),
        level=level[1:],
        error=np.zeros((num_levels - 1, 2), np.float32),
    )
    page_bytes = per_cluster * 236
    page_file_bytes = page_bytes + -page_bytes % 4096
    tensors = {f"clusters.{name}": array for name, array in vars(clusters).items()}
    tensors |= {f"groups.{name}": array for name, array in vars(groups).items()}
    tensors |= {
        "pages.offset": np.arange(num_levels) * page_file_bytes,
        "pages.bytes": np.full(num_levels, page_bytes),
        "pages.first_cluster": level,
        "pages.num_clusters": np.ones(num_levels, np.int32),
        "pages.hash": np.zeros((num_levels, 16), np.uint8),
    }
    end = num_levels * page_file_bytes
    header = {
        "__metadata__": {"format": "v3dg", "version": "1", "sh_degree": "3", "config": "{}"},
        "pages": {"dtype": "U8", "shape": [end], "data_offsets": [0, end]},
    }
    names = {np.dtype(dtype): name for name, dtype in DTYPES.items()}
    tensors["hash"] = np.zeros(16, np.uint8)
    for name in (*TABLE_NAMES, "hash"):
        array = tensors[name]
        offsets = [end, end + array.nbytes]
        header[name] = {
            "dtype": names[array.dtype],
            "shape": list(array.shape),
            "data_offsets": offsets,
        }
        end += array.nbytes
    parts = join_file(header, tensors | {"pages": np.empty(0, np.uint8)})
    data_start = 8 + int.from_bytes(parts[:8], "little")
    path = tmp_path / "large.v3dg"
    with open(path, "wb") as file:
        file.write(parts[:data_start])
        file.seek(num_levels * page_file_bytes, os.SEEK_CUR)
        file.write(parts[data_start:])
    assert path.stat().st_size > 10e9

    reads.num_bytes = 0
    bundle = Bundle.open(path)
    assert bundle.info()["bytes"] == path.stat().st_size
    assert reads.num_bytes < 100_000
    with pytest.raises(
        ValueError, match=r"large.v3dg: page 7 \(gaussians \d+ to \d+\): the hash does not"
    ):
        bundle.cluster_gaussians(7)
    assert reads.num_bytes < 100_000 + page_file_bytes


# Damage.


def test_every_truncation_is_refused(saved):
    _, path = saved
    for size in reversed(range(path.stat().st_size)):
        os.truncate(path, size)
        with pytest.raises(ValueError, match=r"small\.v3dg: "):
            Bundle.open(path)


def test_a_changed_byte_anywhere_is_noticed(saved):
    _, path = saved
    data = path.read_bytes()
    data_start = 8 + int.from_bytes(data[:8], "little")
    pages_end = data_start + split_file(data)[1]["pages"].nbytes
    rng = np.random.default_rng(0)
    places = {
        *range(0, 1500),
        *range(pages_end, len(data)),
        *rng.integers(0, len(data), 1000).tolist(),
    }
    with open(path, "r+b", buffering=0) as file:
        for place in sorted(places):
            os.pwrite(file.fileno(), bytes([data[place] ^ (1 << rng.integers(8))]), place)
            with pytest.raises(ValueError, match=r"small\.v3dg: ") as caught:
                assert Bundle.open(path).gaussians is None
            assert "\n" not in str(caught.value)
            if data_start <= place < pages_end:
                assert "page" in str(caught.value)
            os.pwrite(file.fileno(), data[place : place + 1], place)
    Bundle.open(path)


def test_other_pages_of_a_damaged_file_can_be_read(saved):
    bundle, path = saved
    data = bytearray(path.read_bytes())
    data_start = 8 + int.from_bytes(data[:8], "little")
    _, tensors = split_file(bytes(data))
    page = int(np.argmax(np.diff([*tensors["pages.offset"], len(tensors["pages"])])))
    data[data_start + int(tensors["pages.offset"][page])] ^= 1
    path.write_bytes(data)
    opened = Bundle.open(path)
    clusters = opened.page_range(page)
    first, last = bundle.clusters.offset[[clusters[0], clusters[-1] + 1]]
    message = rf"small\.v3dg: page {page} \(gaussians {first} to {last - 1}\): the hash does not"
    with pytest.raises(ValueError, match=message):
        opened.read_page(page)
    for other in set(range(opened.num_pages)) - {page}:
        assert_same_gaussians(opened.read_page(other), bundle.read_page(other))


def test_truncation_after_opening_is_named(saved):
    _, path = saved
    opened = Bundle.open(path)
    os.truncate(path, 8 + int.from_bytes(path.read_bytes()[:8], "little") + 1)
    with pytest.raises(ValueError, match=r"small\.v3dg: .*truncated"):
        assert opened.gaussians is None


def test_damage_of_a_file_with_an_odd_name_is_told(tmp_path):
    path = tmp_path / os.fsdecode(b"\xff.v3dg")
    random_bundle(3).write(path)
    content = bytearray(path.read_bytes())
    content[8 + int.from_bytes(content[:8], "little")] ^= 1
    path.write_bytes(content)
    with pytest.raises(
        ValueError, match=r"\.v3dg: page 0 \(gaussians 0 to \d+\): the hash does not match"
    ):
        Bundle.open(path).read_page(0)


def test_a_page_that_the_system_cannot_read_is_named(saved, tmp_path):
    """A folder can be opened, but not read."""
    opened = Bundle.open(saved[1])
    folder = os.open(tmp_path, os.O_RDONLY)
    os.dup2(folder, opened._file._fd)
    os.close(folder)
    with pytest.raises(
        IsADirectoryError, match=r"page 0 \(gaussians 0 to \d+\): Is a directory: '.*small"
    ):
        opened.read_page(0)


# Malicious files.


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "expected a bundle, got a file of only 0 bytes"),
        (b"1234567", "expected a bundle, got a file of only 7 bytes"),
        (b"ply\nformat ascii 1.0\n", "header: expected a bundle"),
        ((2**64 - 1).to_bytes(8, "little"), "header: expected a bundle"),
        ((2).to_bytes(8, "little") + b"[]", "header: expected a JSON object"),
        ((2).to_bytes(8, "little") + b"{}", "format: expected 'v3dg', got null"),
        ((2).to_bytes(8, "little") + b"\xff\xfe", "header: expected JSON"),
        ((100_000).to_bytes(8, "little") + b"[" * 100_000, "header: expected JSON"),
        ((13).to_bytes(8, "little") + b'{"a":1,"a":2}', "header: expected JSON.*twice"),
        ((9).to_bytes(8, "little") + b'{"a":NaN}', "header: expected JSON.*NaN"),
        ((5010).to_bytes(8, "little") + b'{"a": ' + b"1" * 5000 + b"   }", "header: expected JSON"),
    ],
)
def test_what_is_not_a_bundle_is_refused(tmp_path, content, message):
    path = tmp_path / "x.v3dg"
    path.write_bytes(content)
    with pytest.raises(ValueError, match=rf"x\.v3dg: {message}") as caught:
        Bundle.open(path)
    assert "\n" not in str(caught.value)


def test_other_safetensors_files_are_refused(tmp_path):
    save_file({"weights": np.zeros(3)}, tmp_path / "x.safetensors")
    with pytest.raises(
        ValueError,
        match=r"x\.safetensors: format: expected 'v3dg', got null; the file is not a bundle",
    ):
        Bundle.open(tmp_path / "x.safetensors")


def test_missing_file_and_special_files_are_refused(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.v3dg"):
        Bundle.open(tmp_path / "none.v3dg")
    os.mkfifo(tmp_path / "pipe")
    for path in (tmp_path, tmp_path / "pipe"):
        with pytest.raises(ValueError, match="expected a file, got a directory, a device"):
            Bundle.open(path)


def test_newer_version_asks_for_an_update(saved, monkeypatch):
    _, path = saved

    def newer(header, tensors):
        header["__metadata__"] = {"format": "v3dg", "version": "4"}
        header["unheard_of"] = None

    monkeypatch.chdir(path.parent)
    path.rename("x.v3dg")
    with pytest.raises(
        ValueError, match=r"^x\.v3dg: version: expected at most 3, got 4; update v3dg$"
    ):
        open_changed(Path("x.v3dg"), newer)


def with_entry(name, **values):
    def change(header, tensors):
        header[name].update(values)

    return change


def with_metadata(**values):
    def change(header, tensors):
        header["__metadata__"].update(values)

    return change


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (with_metadata(version="0"), "version: expected an integer of at least 1"),
        (with_metadata(version="-1"), "version: expected an integer"),
        (with_metadata(version="١"), "version: expected an integer"),
        (with_metadata(version=1), "version: expected an integer"),
        (with_metadata(version="9" * 1000), "version: expected an integer"),
        (with_metadata(codec="zip"), 'codec: expected a known codec, got "zip"'),
        (with_metadata(codec=["float32"]), "codec: expected a known codec, got"),
        (with_metadata(sh_degree="4"), "sh_degree: expected '0' to '3', got \"4\""),
        (with_metadata(sh_degree="1"), "clusters.offset.* expected at most|pages"),
        (with_metadata(config="[]"), "config: expected a JSON object"),
        (with_metadata(config="{"), "config: expected JSON"),
        (with_metadata(config='{"a":Infinity}'), "config: expected JSON"),
        (with_metadata(config=None), "config: expected JSON in a string"),
        (
            lambda header, _: header.pop("groups.ball") and None,
            "groups.ball: expected .*, got null",
        ),
        (
            lambda header, _: header.pop("clusters.level") and None,
            "clusters.level: expected a one-dimensional tensor",
        ),
        (
            lambda header, _: header.update(extra=header["hash"]),
            '"extra": expected only tensors',
        ),
        (lambda header, _: header.update(pages=7), "pages: expected a one-dimensional tensor"),
        (with_entry("pages", shape=[-4096]), "pages: expected a one-dimensional tensor"),
        (with_entry("pages", shape=[True]), "pages: expected a one-dimensional tensor"),
        (with_entry("pages", shape=[4096.0]), "pages: expected a one-dimensional tensor"),
        (with_entry("pages", shape=[2**70]), "size: expected more than"),
        (with_entry("clusters.level", shape=[2**62]), "size: expected more than"),
        (
            with_entry("groups.parent", shape=[0]),
            "clusters.level|groups.ball|pages|clusters.offset",
        ),
        (with_entry("pages", data_offsets=[0, 0]), "pages: expected"),
        (with_entry("groups.ball", dtype="F64"), "groups.ball: expected"),
        (with_entry("groups.ball", shape=[1, 4]), "groups.ball: expected"),
        (with_entry("clusters.offset", data_offsets=[0, 2**64]), "clusters.offset: expected"),
        (with_entry("hash", data_offsets=[0, 16]), "hash: expected"),
    ],
)
def test_wrong_header_is_refused(saved, change, message):
    with pytest.raises(ValueError, match=rf"small\.v3dg: ({message})") as caught:
        open_changed(saved[1], change)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400


def with_value(name, row, value):
    def change(header, tensors):
        tensors[name][row] = value

    return change


def assert_refuses_table(path, name, row, value, message):
    with pytest.raises(ValueError, match=rf"small\.v3dg: ({message})") as caught:
        open_changed(path, with_value(name, row, value))
    assert "\n" not in str(caught.value)


def assert_opens_or_is_refused(path):
    try:
        opened = Bundle.open(path)
        message = f"{path}: " if len(opened.gaussians) == opened.num_gaussians else ""
    except ValueError as error:
        message = str(error)
    assert message.startswith(f"{path}: ")
    assert "\n" not in message


BIG = 2**31 - 1


@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        ("clusters.offset", 0, 1, r"clusters.offset\[0\]: expected 0, got 1"),
        (
            "clusters.offset",
            1,
            2**62,
            r"clusters.offset\[2\]: expected offsets that never decrease",
        ),
        ("clusters.offset", -1, 2**62, r"clusters.offset\[-1\]: expected at most"),
        ("clusters.offset", slice(1, None), -5, r"clusters.offset\[1\]: expected offsets"),
        ("clusters.level", 0, 1, r"clusters.level\[0\]: expected 0, got 1"),
        ("clusters.level", 1, BIG, r"clusters.level\[1\]: expected the level before"),
        ("clusters.level", -1, -1, r"clusters.level\[\d+\]: expected the level before"),
        ("clusters.own_group", 0, 0, r"clusters.own_group\[0\]: expected -1, got 0"),
        ("clusters.own_group", -1, BIG, r"clusters.own_group\[\d+\]: expected a group of level 2"),
        ("clusters.own_group", -1, -1, r"clusters.own_group\[\d+\]: expected a group of level 2"),
        (
            "clusters.parent_group",
            0,
            -1,
            r"clusters.parent_group\[0\]: expected a group of level 1, got -1",
        ),
        (
            "clusters.parent_group",
            0,
            BIG,
            r"clusters.parent_group\[0\]: expected a group of level 1",
        ),
        ("clusters.parent_group", -1, 0, r"clusters.parent_group\[\d+\]: expected -1, got 0"),
        (
            "clusters.parent_group",
            0,
            1,
            r"clusters.parent_group\[1\]: expected parents in ascending order",
        ),
        ("clusters.box", 0, np.nan, r"clusters.box\[0\]: expected finite"),
        ("clusters.filter_px2", 1, -0.5, r"clusters.filter_px2\[1\]: expected 0 or more, got -0.5"),
        ("clusters.filter_px2", 1, np.inf, r"clusters.filter_px2\[1\]: expected 0 or more"),
        ("clusters.antialiased", 2, 2, r"clusters.antialiased\[2\]: expected 0 or 1, got 2"),
        ("groups.ball", (0, 0), np.nan, r"groups.ball\[0\]: expected finite"),
        ("groups.ball", (0, 3), -1, r"groups.ball\[0\]: expected a radius"),
        ("groups.ball", (0, 3), 1e30, r"groups.ball\[0\]: expected a ball inside"),
        ("groups.weight", 0, 0, r"groups.weight\[0\]: expected a positive"),
        (
            "groups.weight",
            0,
            1e30,
            r"groups.weight\[0\]: expected at most the weight of the group above",
        ),
        ("groups.parent", 0, 0, r"groups.parent\[0\]: expected a group of level 2, got 0"),
        ("groups.parent", 0, -2, r"groups.parent\[0\]: expected a group of level 2"),
        ("groups.parent", -1, BIG, r"groups.parent\[\d+\]: expected -1"),
        ("groups.level", 0, 0, r"clusters.own_group|groups.level|clusters.parent_group"),
        ("groups.level", 0, BIG, r"clusters.own_group|groups.level|clusters.parent_group"),
        ("groups.error", 0, -1, r"groups.error\[0\]: expected 0 or more"),
        (
            "pages.offset",
            1,
            0,
            r"pages.offset\[1\]: expected (4096|96), which follows from the clusters, got 0",
        ),
        ("pages.offset", -1, 2**63 - 1, r"pages.offset\[\d+\]: expected"),
        ("pages.first_cluster", 1, 0, r"pages.first_cluster\[1\]: expected"),
    ],
)
def test_wrong_table_is_refused(saved, name, row, value, message):
    assert_refuses_table(saved[1], name, row, value, message)


@pytest.mark.parametrize(
    ("name", "row", "value", "message"),
    [
        ("pages.bytes", 0, 2**62, r"pages|size"),
        ("pages.num_clusters", 0, -1, r"pages.num_clusters\[0\]: expected"),
    ],
)
@pytest.mark.parametrize("version", [1, 3])
def test_wrong_table_that_only_float32_has_is_refused(tmp_path, version, name, row, value, message):
    path = tmp_path / "small.v3dg"
    path.write_bytes(golden_bundles.path_of(version, "float32").read_bytes())
    assert_refuses_table(path, name, row, value, message)


@settings(max_examples=80)
@given(data=st.data())
def test_random_tables_open_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fuzz") / "small.v3dg"
    random_bundle(3).write(path)
    header, tensors = split_file(path.read_bytes())
    name = data.draw(st.sampled_from([name for name in TABLE_NAMES if name != "pages.hash"]))
    values = tensors[name].reshape(-1)
    limits = (-(2.0**60), 2.0**60) if values.dtype.kind == "f" else np.iinfo(values.dtype)
    number = (
        st.floats(width=32)
        if values.dtype.kind == "f"
        else st.one_of(st.integers(max(limits.min, -3), 30), st.integers(limits.min, limits.max))
    )
    for _ in range(data.draw(st.integers(1, 3))):
        values[data.draw(st.integers(0, len(values) - 1))] = data.draw(number)
    path.write_bytes(join_file(header, tensors))
    assert_opens_or_is_refused(path)


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=8,
)


@settings(max_examples=80)
@given(data=st.data())
def test_random_headers_open_or_are_refused(tmp_path_factory, data):
    path = tmp_path_factory.mktemp("fuzz") / "small.v3dg"
    random_bundle(3).write(path)
    header, tensors = split_file(path.read_bytes())
    name = data.draw(st.sampled_from(sorted(header)))
    key = data.draw(st.sampled_from([None, *sorted(header[name])]))
    value = data.draw(json_values)
    if key is None:
        header[name] = value
    else:
        header[name][key] = value
    path.write_bytes(join_file(header, tensors))
    assert_opens_or_is_refused(path)


# Quantised pages.


@pytest.mark.parametrize(
    ("version", "codec"), [(1, "float32"), (2, "quantized"), (3, "float32"), (3, "quantized")]
)
def test_golden_files_of_all_versions_are_read(version, codec, tmp_path):
    """Files of old versions stay readable with the same bits. New files have the newest
    version."""
    path, bundle = golden_bundles.path_of(version, codec), golden_bundles.bundle_of(codec)
    opened = Bundle.open(path)
    info = opened.info()
    assert (info["version"], info["codec"], info["bytes"]) == (version, codec, path.stat().st_size)
    assert_same_tables(opened, bundle)
    assert_same_gaussians(opened.gaussians, bundle.gaussians)
    opened.write(tmp_path / "again.v3dg")
    newest = golden_bundles.path_of(3, codec)
    assert (tmp_path / "again.v3dg").read_bytes() == newest.read_bytes()


@pytest.mark.parametrize(("version", "codec"), [(1, "float32"), (2, "quantized"), (3, "float32")])
def test_damage_of_tables_is_found_in_all_versions(version, codec, tmp_path):
    data = bytearray(golden_bundles.path_of(version, codec).read_bytes())
    path = tmp_path / "damaged.v3dg"
    # one byte of the file's hash, and one of a page's hash
    for place in (len(data) - 1, len(data) - 17):
        data[place] ^= 1
        path.write_bytes(data)
        with pytest.raises(ValueError, match="hash: does not match the header and the tables"):
            Bundle.open(path)
        data[place] ^= 1


def test_a_bundle_is_rounded_when_it_is_made():
    kept = random_bundle(7, sh_degree=2, max_cluster=40)
    bundle = random_bundle(7, sh_degree=2, max_cluster=40, codec="quantized")
    assert kept.codec == "float32"
    difference = np.abs(bundle.gaussians.means - kept.gaussians.means).max()
    assert 0 < difference < np.ptp(kept.gaussians.means) / 1000
    again = Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec="quantized")
    assert_same_gaussians(again.gaussians, bundle.gaussians)
    filled = np.diff(bundle.clusters.offset) > 0
    expected = _core.bound_by_boxes(bundle.gaussians.rows, bundle.clusters.offset)
    np.testing.assert_array_equal(bundle.clusters.box[filled], expected[filled])
    with pytest.raises(ValueError, match="codec: expected 'float32' or 'quantized', got 'zip'"):
        random_bundle(7, codec="zip")


def test_values_that_have_no_code_are_refused():
    bundle = random_bundle(3)
    bundle.gaussians.scales[4, 1] = np.inf
    with pytest.raises(
        ValueError, match="gaussians: expected finite values, got infinite or NaN ones in row 4"
    ):
        Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec="quantized")


def test_unknown_codecs_ask_for_an_update(tmp_path):
    random_bundle(3, codec="quantized").write(tmp_path / "a.v3dg")
    (tmp_path / "2.v3dg").write_bytes(golden_bundles.path_of(2, "quantized").read_bytes())
    for name, codecs in (
        ("a", ("later", None, 3, ["quantized"])),
        ("2", ("later", "float32", None)),
    ):
        for codec in codecs:
            message = rf"{name}\.v3dg: codec: expected a known codec, got .*; update"
            with pytest.raises(ValueError, match=message):
                open_changed(tmp_path / f"{name}.v3dg", with_metadata(codec=codec))
    with pytest.raises(ValueError, match=r"a\.v3dg: pages.bytes: expected .*, got null$"):
        open_changed(tmp_path / "a.v3dg", with_metadata(codec="float32"))


@settings(max_examples=80)
@given(data=st.data())
def test_random_pages_are_finite_gaussians_or_refused(tmp_path_factory, data):
    """The hashes are computed after the change, as if the writer intended this
    content."""
    path = tmp_path_factory.mktemp("pages") / "small.v3dg"
    bundle = random_bundle(3, sh_degree=data.draw(st.integers(0, 3)), codec="quantized")
    bundle.write(path)
    header, tensors = split_file(path.read_bytes())
    pages = tensors["pages"]
    for _ in range(data.draw(st.integers(1, 3))):
        first = data.draw(st.integers(0, len(pages) - 1))
        noise = data.draw(st.binary(min_size=1, max_size=60))
        pages[first : first + len(noise)] = np.frombuffer(noise, np.uint8)[: len(pages) - first]
    for page, (first, end) in enumerate(itertools.pairwise([*tensors["pages.offset"], len(pages)])):
        digest = hashlib.blake2b(pages[first:end].tobytes(), digest_size=16).digest()
        tensors["pages.hash"][page] = np.frombuffer(digest, np.uint8)
    path.write_bytes(join_file(header, tensors))
    opened = Bundle.open(path)
    message = r"small\.v3dg: page \d+ \(.*\): cluster \d+ of the page: expected finite ranges"
    for page in range(opened.num_pages):
        gaussians = None
        with contextlib.suppress(ValueError):
            gaussians = opened.read_page(page)
        if gaussians is None:
            with pytest.raises(ValueError, match=message):
                opened.read_page(page)
        else:
            assert all(np.isfinite(array).all() for array in vars(gaussians).values())
            assert (gaussians.scales > 0).all()


# Saving.


class Stop(BaseException):
    """Simulates any interruption of a write, such as Ctrl-C."""


def test_an_interrupted_save_changes_nothing(saved, monkeypatch):
    bundle, path = saved
    before = path.read_bytes()
    num_calls = 0

    def stop_at_second(*arguments):
        nonlocal num_calls
        num_calls += 1
        if num_calls == 2:
            raise Stop
        return bundle_file.write_pages(*arguments)

    monkeypatch.setattr("v3dg.bundle.bundle._RUN_BYTES", 1)
    monkeypatch.setattr("v3dg.bundle.bundle.write_pages", stop_at_second)
    for target in (path, path.with_name("new.v3dg")):
        num_calls = 0
        with pytest.raises(Stop):
            bundle.write(target)
    assert os.listdir(path.parent) == [path.name]
    assert path.read_bytes() == before


def test_a_full_disk_is_named_and_leaves_nothing(saved, monkeypatch):
    bundle, path = saved
    before = path.read_bytes()

    def full(fd):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device.*small\.v3dg"):
        bundle.write(path)
    assert os.listdir(path.parent) == [path.name]
    assert path.read_bytes() == before


def test_a_half_written_file_is_refused_and_replaced(saved):
    """After a power failure, a temporary file remains, which is never read as a
    bundle."""
    bundle, path = saved
    leftover = path.with_name(".small.v3dg.0123456789abcdef.tmp")
    leftover.write_bytes(path.read_bytes()[:-100])
    bundle.write(path)
    with pytest.raises(ValueError, match="truncated"):
        Bundle.open(leftover)
    assert_same_gaussians(Bundle.open(path).gaussians, bundle.gaussians)


def test_save_refuses_what_is_not_a_file(saved, tmp_path):
    bundle, _ = saved
    os.mkfifo(tmp_path / "pipe.v3dg")
    (tmp_path / "null.v3dg").symlink_to(os.devnull)
    for name in ("pipe.v3dg", "null.v3dg"):
        with pytest.raises(ValueError, match="expected the path of a file"):
            bundle.write(tmp_path / name)
    (tmp_path / "folder.v3dg").mkdir()
    with pytest.raises(IsADirectoryError, match=r"folder\.v3dg"):
        bundle.write(tmp_path / "folder.v3dg")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        bundle.write(tmp_path / "nowhere" / "a.v3dg")


def test_save_follows_a_link(saved, tmp_path):
    _, path = saved
    link = tmp_path / "link.v3dg"
    link.symlink_to(path)
    random_bundle(8).write(link)
    assert link.is_symlink()
    assert Bundle.open(path).num_gaussians == random_bundle(8).num_gaussians


def test_saving_over_an_open_bundle_does_not_change_it(saved):
    bundle, path = saved
    opened = Bundle.open(path)
    opened.write(path)
    random_bundle(4).write(path)
    assert_same_gaussians(opened.gaussians, bundle.gaussians)


def test_long_names_can_be_saved(saved, tmp_path):
    bundle, _ = saved
    for name in ("x" * 250 + ".v3dg", "ü" * 120 + ".v3dg"):
        bundle.write(tmp_path / name)
        Bundle.open(tmp_path / name)


def test_saved_files_have_usual_permissions(saved):
    _, path = saved
    umask = os.umask(0)
    os.umask(umask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~umask


# Construction.


def test_tables_of_wrong_kind_are_refused(saved):
    clusters, groups = saved[0].clusters, saved[0].groups
    with pytest.raises(TypeError, match=r"clusters.level: expected a NumPy array, got list"):
        dataclasses.replace(clusters, level=clusters.level.tolist())
    with pytest.raises(
        ValueError, match=r"clusters.offset: expected dtype int64 and shape \(\d+,\), got int32"
    ):
        dataclasses.replace(clusters, offset=clusters.offset.astype(np.int32))
    with pytest.raises(
        ValueError, match=r"clusters.box: .* shape \(\d+, 2, 3\), got float32 and \(\d+, 6\)"
    ):
        dataclasses.replace(clusters, box=clusters.box.reshape(-1, 6))
    with pytest.raises(ValueError, match=r"groups.ball: expected a C-contiguous array"):
        dataclasses.replace(groups, ball=np.asfortranarray(groups.ball))
    with pytest.raises(TypeError, match="groups: expected Groups, got Clusters"):
        Bundle(clusters, clusters, saved[0].gaussians)


def test_tables_that_do_not_fit_are_refused(saved):
    bundle, _ = saved
    gaussians = random_gaussians(np.random.default_rng(0), bundle.num_gaussians + 1)
    with pytest.raises(ValueError, match=r"clusters.offset\[-1\]: expected \d+ gaussians"):
        Bundle(bundle.clusters, bundle.groups, gaussians)
    weight = bundle.groups.weight.copy()
    weight[0] = np.float32(np.nan)
    with pytest.raises(
        ValueError, match=r"groups.weight\[0\]: expected a positive number, got nan"
    ):
        Bundle(bundle.clusters, dataclasses.replace(bundle.groups, weight=weight), bundle.gaussians)


def test_a_ball_that_barely_sticks_out_is_refused():
    bundle = random_bundle(11, num_levels=3)
    ball = bundle.groups.ball.copy()
    above = bundle.groups.parent[0]
    needed = (np.linalg.norm(ball[above, :3].astype(np.float64) - ball[0, :3]) + ball[0, 3]) * (
        1 + 4e-6
    )
    ball[above, 3] = np.float32(needed * (1 - 1e-6))
    with pytest.raises(
        ValueError, match=r"groups.ball\[0\]: expected a ball inside the ball of group"
    ):
        Bundle(bundle.clusters, dataclasses.replace(bundle.groups, ball=ball), bundle.gaussians)


def test_config_that_no_reader_would_accept_is_refused(saved):
    bundle, path = saved
    # The config alone is within the limit for headers, but the whole header is not.
    large = Bundle(
        bundle.clusters, bundle.groups, bundle.gaussians, {"note": "x" * ((1 << 20) - 100)}
    )
    expected = "at most 1048576 bytes of JSON in the header, which includes it"
    message = rf"config: expected {expected}, got (\d+); "
    with pytest.raises(ValueError, match=message) as error:
        large.write(path)
    assert int(re.search(message, str(error.value))[1]) > 1048576
    assert_same_gaussians(Bundle.open(path).gaussians, bundle.gaussians)


@pytest.mark.parametrize("config", [{"a": float("nan")}, {"a": {1, 2}}, {"a": np.float32(1)}])
def test_config_that_is_not_json_is_refused(saved, config):
    bundle, _ = saved
    with pytest.raises(ValueError, match="config: expected values that JSON can represent"):
        Bundle(bundle.clusters, bundle.groups, bundle.gaussians, config)


def test_ids_out_of_range_are_refused(saved):
    bundle, _ = saved
    for read in (
        bundle.cluster_gaussians,
        bundle.level_gaussians,
        bundle.read_page,
        bundle.level_range,
    ):
        for index in (-1, 1000):
            with pytest.raises(ValueError, match=r"(cluster|level|page): expected 0 to \d+, got"):
                read(index)


def test_info_describes_every_level(saved):
    bundle, path = saved
    info = Bundle.open(path).info()
    assert info["path"] == str(path)
    assert json.loads(json.dumps(info, allow_nan=False)) == info
    assert info == bundle.info() | {"path": str(path)}
    assert info["bytes"] == path.stat().st_size
    assert info["config"] == {"seed": 3}
    assert [row["level"] for row in info["levels"]] == [0, 1, 2]
    assert sum(row["gaussians"] for row in info["levels"]) == bundle.num_gaussians
    assert sum(row["clusters"] for row in info["levels"]) == len(bundle.clusters)
    error = bundle.groups.error[bundle.groups.level == 2].mean(0)
    assert info["levels"][2]["error_color"] == pytest.approx(error[0])
    assert info["levels"][2]["error_alpha"] == pytest.approx(error[1])


def test_unknown_errors_are_none_in_info(saved):
    bundle, _ = saved
    groups = dataclasses.replace(bundle.groups, error=np.full_like(bundle.groups.error, np.nan))
    assert (
        Bundle(bundle.clusters, groups, bundle.gaussians).info()["levels"][1]["error_color"] is None
    )
