"""Opening bundles: tables are read and hashed while they are checked, and several files
are opened at once."""

import os

import numpy as np
import pytest

import v3dg
from support.file_hash import PIECE, file_hash
from support.random_bundle import random_bundle
from v3dg import Bundle, Clusters, Gaussians, Groups, _core

# size in bytes from which tables are read and hashed on separate threads
LARGE = 5 << 20


SIZES = [0, 1, 127, 128, 129, 256, 4097, PIECE - 200, PIECE, PIECE + 1, 10 * PIECE]
SIZES += [LARGE, LARGE + 1, LARGE + (1 << 20) - 3]


@pytest.mark.parametrize("in_pieces", [False, True])
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("num_before", [0, 1, 128, 200, PIECE, 3 * PIECE + 5])
def test_what_is_read_is_hashed_behind_what_was_before(tmp_path, size, num_before, in_pieces):
    rng = np.random.default_rng(size + num_before)
    data, before = (rng.integers(0, 256, count, np.uint8) for count in (size, num_before))
    digest = bytearray(file_hash(before.tobytes() + data.tobytes(), 3 if in_pieces else 2))
    path = tmp_path / "data"
    for is_sound in (True, False):
        path.write_bytes(b"other" + data.tobytes() + digest + b"more")
        with open(path, "rb") as file:
            place = (file.fileno(), before.tobytes(), 5, size + 16)
            reading = _core.HashedReader().read(str(path), *place, in_pieces)
        read = reading.wait()
        np.testing.assert_array_equal(read[:size], data)
        assert read[size:].tobytes() == digest
        assert not read.flags.writeable
        assert reading.is_sound() == is_sound
        digest[size % 16] ^= 1 << size % 8


@pytest.mark.parametrize("in_pieces", [False, True])
def test_of_several_that_come_together_each_is_sound_or_not(tmp_path, in_pieces):
    reader, before = _core.HashedReader(), bytes(8)
    sizes = [100, 0, 5000, 70_000, LARGE, 1, 128, 120, 300_000, 8, *range(20)]
    readings = []
    for number, size in enumerate(sizes):
        data = np.full(size, number, np.uint8)
        digest = file_hash(before + data.tobytes(), 3 if in_pieces else 2)
        path = tmp_path / str(number)
        path.write_bytes(data.tobytes() + (digest if number % 3 else digest[::-1]))
        with open(path, "rb") as file:
            readings.append(reader.read(str(path), file.fileno(), before, 0, size + 16, in_pieces))
        assert readings[-1].wait().ctypes.data % 8 == 0
    for number, (reading, size) in enumerate(zip(readings, sizes, strict=True)):
        assert reading.is_sound() == (number % 3 > 0)
        np.testing.assert_array_equal(reading.wait()[:size], number)


@pytest.mark.parametrize("size", [1000, LARGE])
def test_a_file_that_ends_before_is_told(tmp_path, size):
    path = tmp_path / "data"
    path.write_bytes(bytes(size - 1))
    with open(path, "rb") as file:
        reading = _core.HashedReader().read(str(path), file.fileno(), b"", 0, size, True)
    with pytest.raises(ValueError, match=r"data: size: expected .*bytes.* 0, .*truncated"):
        reading.wait()


@pytest.mark.parametrize("size", [1000, LARGE])
def test_what_the_system_cannot_read_is_an_error_with_the_name(tmp_path, size):
    descriptor = os.open(tmp_path, os.O_RDONLY)
    try:
        reading = _core.HashedReader().read(str(tmp_path), descriptor, b"", 0, size, True)
        with pytest.raises(IsADirectoryError, match=tmp_path.name):
            reading.wait()
    finally:
        os.close(descriptor)


@pytest.fixture(scope="module")
def large(tmp_path_factory):
    """A file with large tables: one level of many clusters with one gaussian each."""
    count = 120_000
    none = np.full(count, -1, np.int32)
    clusters = Clusters(
        offset=np.arange(count + 1),
        level=np.zeros(count, np.int32),
        own_group=none,
        parent_group=none,
        box=np.zeros((count, 2, 3), np.float32),
        filter_px2=np.zeros(count, np.float32),
        antialiased=np.zeros(count, np.uint8),
    )
    groups = Groups(
        ball=np.zeros((0, 4), np.float32),
        weight=np.zeros(0, np.float32),
        parent=np.zeros(0, np.int32),
        level=np.zeros(0, np.int32),
        error=np.zeros((0, 2), np.float32),
    )
    quats = np.tile(np.float32([1, 0, 0, 0]), (count, 1))
    zeros = np.zeros((count, 3), np.float32)
    gaussians = Gaussians(zeros, quats, zeros + 1, np.ones(count, np.float32), zeros[:, None])
    path = tmp_path_factory.mktemp("large") / "large.v3dg"
    Bundle(clusters, groups, gaussians).write(path)
    return path


def test_large_tables_come_whole(large):
    opened = Bundle.open(large)
    assert len(opened.clusters) == 120_000
    np.testing.assert_array_equal(opened.clusters.offset, np.arange(120_001))


def test_damage_of_large_tables_is_found_wherever_it_is(large, tmp_path):
    data = bytearray(large.read_bytes())
    start = 8 + int.from_bytes(data[:8], "little") + 120_000 * 56 + -(120_000 * 56) % 4096
    path = tmp_path / "damaged.v3dg"
    # Values that pass every other check: a bit of a box, of the hash of a page, and of
    # the hash of the file.
    for place in (start + 8 * 120_001 + 12 * 120_000 + 1_000_000, len(data) - 20, len(data) - 1):
        data[place] ^= 1
        path.write_bytes(data)
        with pytest.raises(
            ValueError, match=r"damaged\.v3dg: hash: does not match the header and the tables"
        ):
            Bundle.open(path)
        data[place] ^= 1
    for end in (len(data) - 1, len(data) - (3 << 20)):
        path.write_bytes(data[:end])
        with pytest.raises(ValueError, match=r"damaged\.v3dg: size: .*truncated"):
            Bundle.open(path)


def test_damage_is_called_damage_where_a_table_cannot_be(tmp_path):
    path = tmp_path / "damaged.v3dg"
    bundle = random_bundle(3)
    bundle.write(path)
    data = bytearray(path.read_bytes())
    place = bytes(data).index(bundle.clusters.offset.tobytes())
    data[place] ^= 1  # the first offset should be 0
    path.write_bytes(data)
    with pytest.raises(
        ValueError, match=r"damaged\.v3dg: hash: does not match the header and the tables"
    ):
        Bundle.open(path)


def test_several_files_open_in_order(tmp_path):
    bundles = [random_bundle(seed) for seed in range(20)]
    paths = [tmp_path / f"{number}.v3dg" for number in range(20)]
    for bundle, path in zip(bundles, paths, strict=True):
        bundle.write(path)
    opened = Bundle.open_all(paths)
    assert [bundle.path for bundle in opened] == [str(path) for path in paths]
    for one, bundle in zip(opened, bundles, strict=True):
        np.testing.assert_array_equal(one.clusters.box, bundle.clusters.box)
        np.testing.assert_array_equal(one.gaussians.means, bundle.gaussians.means)
    assert Bundle.open_all([]) == []


def test_the_first_file_with_a_fault_is_named(tmp_path):
    paths = [tmp_path / f"{number}.v3dg" for number in range(12)]
    for path in paths:
        random_bundle(3).write(path)
    for number in (5, 9):
        paths[number].write_bytes(paths[number].read_bytes()[:-1])
    with pytest.raises(ValueError, match=r"[\\/]5\.v3dg: "):
        Bundle.open_all(paths)
    paths[2].unlink()
    with pytest.raises(FileNotFoundError, match=r"[\\/]2\.v3dg"):
        Bundle.open_all(paths)
    damaged = bytearray(paths[1].read_bytes())
    damaged[-1] ^= 1  # the hash of the file is compared last
    paths[1].write_bytes(damaged)
    with pytest.raises(ValueError, match=r"[\\/]1\.v3dg: hash: "):
        Bundle.open_all(paths)
    with pytest.raises(ValueError, match=r"[\\/]1\.v3dg: hash: "):
        Bundle.open_all([paths[0], paths[1]])


def test_a_scene_file_has_its_bundles_once_and_by_name(tmp_path):
    bundles = [random_bundle(seed) for seed in range(6)]
    for number, bundle in enumerate(bundles):
        bundle.write(tmp_path / f"{number}.v3dg")
    scene = v3dg.Scene()
    scene.add(
        [Bundle.open(tmp_path / f"{number % 6}.v3dg") for number in range(6)], np.zeros((6, 3))
    )
    v3dg.write_scene(tmp_path / "scene.json", scene, [f"{number % 3}.v3dg" for number in range(6)])
    opened = v3dg.open(tmp_path / "scene.json")
    assert [bundle.path for bundle in opened.bundles] == [
        str(tmp_path / f"{n}.v3dg") for n in range(3)
    ]
    assert opened.instance_bundle.tolist() == [0, 1, 2, 0, 1, 2]
