import errno
import os
import pickle
import shutil
import signal
import subprocess
import sys
import textwrap
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import v3dg
from v3dg import BuildConfig, Gaussians, _core, _files, cleaning
from v3dg.gaussians import gaussian_bytes
from v3dg.io import open_asset
from v3dg.levels import external_split
from v3dg.levels import leaves_on_disk as on_disk
from v3dg.levels.digest import digest_of
from v3dg.levels.leaves import MemoryLeaves
from v3dg.levels.leaves_on_disk import DiskLeaves, leaves_on_disk
from v3dg.levels.scratch import RowFile

CONFIG = BuildConfig(cluster_size=7)
PLENTY = 1 << 30
FIELDS = ("means", "quats", "scales", "opacities", "sh")


def asset_of(means, sh_degree=0, seed=0):
    rng = np.random.default_rng(seed)
    n = len(means)

    def random(*shape):
        return rng.uniform(0.1, 0.9, (n, *shape)).astype(np.float32)

    means = np.ascontiguousarray(means, np.float32)
    return Gaussians(means, random(4), random(3), random(), random((sh_degree + 1) ** 2, 3))


def some_asset(n, sh_degree=0, seed=0):
    return asset_of(np.random.default_rng(seed).normal(size=(n, 3)), sh_degree, seed)


def broken(asset, rows):
    """Return the same gaussians, with some among them that cannot be drawn."""
    opacities = asset.opacities.copy()
    opacities[rows] = np.resize(np.float32([np.nan, 1e-4]), len(rows))
    return replace(asset, opacities=opacities)


def in_split_order(asset, config=CONFIG):
    asset = asset.subset(cleaning.examine(asset).drawable)
    depth = _core.num_halvings(len(asset), config.cluster_size)
    return asset.subset(_core.median_split(asset.means, np.array([0, len(asset)]), depth)[0])


def assert_same(got, expected):
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(got, name), getattr(expected, name), name)


@pytest.fixture
def small(monkeypatch):
    """Read few gaussians at a time, as if there were much less memory than the minimum
    that is allowed."""

    def sizes(block=1 << 16, node=100, bucket=20):
        chosen = on_disk._Sizes(0, block, node, bucket)
        monkeypatch.setattr(on_disk._Sizes, "of", lambda *_: chosen)

    return sizes


# ---- the external split

NORMAL = np.random.default_rng(1).normal(size=(3000, 3))
GRID = np.random.default_rng(2).integers(-2, 3, (3000, 3))
SHAPES = {
    "scattered": NORMAL,
    "on a grid, with zeros of both signs": GRID * np.where(NORMAL > 0, 0.5, -0.5),
    "all at one place": np.zeros((3000, 3)) * np.sign(NORMAL),
    "on a line": NORMAL * [0, 1, 0],
    "on a line, in few places": np.round(NORMAL * [0, 0, 1], 1),
    "of all magnitudes": NORMAL * 10.0 ** np.random.default_rng(3).integers(-44, 18, (3000, 1)),
    "in order": np.sort(NORMAL, axis=0),
    "against the order": -np.sort(NORMAL, axis=0),
    "nearly as wide as high": np.float32(NORMAL) + np.float32(1e6),
}


def split_on_disk(folder, means, depth, num_fitting):
    means = np.ascontiguousarray(means, np.float32)
    files = []
    try:
        for name, width in (("a", 4), ("b", 4), ("order", 1)):
            files.append(RowFile(folder / name, width, np.uint32, must_be_new=True))
        files[0].write(0, external_split.points_of(means, np.arange(len(means))))
        external_split.split((files[0], files[1]), len(means), depth, num_fitting, files[2])
        return files[2].read(0, len(means))
    finally:
        for file in files:
            file.__exit__()
            file.path.unlink()


@pytest.mark.parametrize("shape", SHAPES)
def test_external_split_is_the_median_split(tmp_path, shape, monkeypatch):
    monkeypatch.setattr(external_split, "_AT_ONCE", 37)
    counts = [1, 2, 3, 63, 64, 65, 66, 127, 128, 129, 500]
    for count in counts:
        means = np.ascontiguousarray(SHAPES[shape][:count], np.float32)
        for cluster_size, num_fitting in ((1, 1), (3, 17), (200, 16)):
            depth = _core.num_halvings(count, cluster_size)
            expected, _ = _core.median_split(means, np.array([0, count]), depth)
            got = split_on_disk(tmp_path, means, depth, num_fitting)
            np.testing.assert_array_equal(got, expected, f"{count}, {cluster_size}, {num_fitting}")


# ---- leaves


@pytest.mark.parametrize("sh_degree", [0, 3])
def test_leaves_on_disk_are_those_in_memory(tmp_path, small, sh_degree):
    asset = broken(some_asset(70_001, sh_degree), np.arange(5, 70_000, 300))
    cuts = [0, 1, 40_000, 40_000, 70_001]
    paths = [tmp_path / f"{i}.ply" for i in range(4)]
    for path, first, last in zip(paths, cuts[:-1], cuts[1:], strict=True):
        v3dg.write_asset(path, asset.subset(slice(first, last)))
    read = Gaussians.concatenate([v3dg.read_asset(path) for path in paths])
    expected = in_split_order(read)
    with pytest.warns(cleaning.AssetWarning) as told:
        memory = MemoryLeaves(read, CONFIG)
    small(node=5000, bucket=600)
    with ExitStack() as stack:
        with pytest.warns(cleaning.AssetWarning) as told_again:
            disk = stack.enter_context(
                leaves_on_disk(paths, tmp_path / "scratch", memory=0, config=CONFIG)
            )
        assert isinstance(disk, DiskLeaves)
        assert [str(w.message) for w in told] == [str(w.message) for w in told_again]
        for leaves in (memory, disk, pickle.loads(pickle.dumps(disk))):
            assert leaves.num_gaussians == len(expected)
            assert leaves.asset_gaussians == 70_001
            assert leaves.sh_degree == sh_degree
            assert leaves.dropped == cleaning.examine(read).counts
            assert list(leaves.dropped) == list(cleaning.examine(read).counts)
            assert leaves.digest == digest_of(read)
            assert_same(leaves.read(0, len(expected)), expected)
            for first, last in (
                (0, 0),
                (0, 1),
                (599, 1201),
                (len(expected) - 3, len(expected)),
                (7, 7),
            ):
                assert_same(leaves.read(first, last), expected.subset(slice(first, last)))
        with ThreadPoolExecutor(8) as pool:
            for i, part in enumerate(
                pool.map(lambda i: disk.read(i * 1000, i * 1000 + 1000), range(60))
            ):
                assert_same(part, expected.subset(slice(i * 1000, i * 1000 + 1000)))
    assert not (tmp_path / "scratch").exists()


@pytest.mark.parametrize("shape", SHAPES)
def test_any_positions_and_few_at_a_time(tmp_path, small, shape):
    for count in (1, 2, 7, 8, 127, 128, 129, 1025):
        asset = asset_of(SHAPES[shape][:count])
        paths = [tmp_path / "a.ply", tmp_path / "b.ply"]
        for path, rows in zip(paths, (slice(0, count // 3), slice(count // 3, count)), strict=True):
            v3dg.write_asset(path, asset.subset(rows))
        expected = in_split_order(Gaussians.concatenate([v3dg.read_asset(path) for path in paths]))
        for block, node, bucket in ((13, 1, 1), (100, 30, 11), (5000, 5000, 5000)):
            small(block, node, bucket)
            with leaves_on_disk(paths, tmp_path / "scratch", memory=0, config=CONFIG) as leaves:
                assert_same(leaves.read(0, count), expected)


def test_clusters_larger_than_memory_keep_the_order_of_the_file(tmp_path, small):
    asset = some_asset(1000)
    v3dg.write_asset(tmp_path / "a.ply", asset)
    small(node=10, bucket=10)
    config = BuildConfig(cluster_size=300)
    with leaves_on_disk(
        [tmp_path / "a.ply"], tmp_path / "scratch", memory=0, config=config
    ) as leaves:
        assert_same(
            leaves.read(0, 1000), in_split_order(v3dg.read_asset(tmp_path / "a.ply"), config)
        )
        assert_same(
            leaves.read(200, 501),
            in_split_order(v3dg.read_asset(tmp_path / "a.ply"), config).subset(slice(200, 501)),
        )


def test_an_asset_that_fits_makes_no_scratch(tmp_path):
    asset = some_asset(1000, 1)
    v3dg.write_asset(tmp_path / "a.ply", asset)
    with leaves_on_disk(
        [tmp_path / "a.ply"], tmp_path / "s", memory=PLENTY, config=CONFIG
    ) as leaves:
        assert isinstance(leaves, MemoryLeaves)
        assert not (tmp_path / "s").exists()
        assert_same(leaves.read(0, 1000), in_split_order(v3dg.read_asset(tmp_path / "a.ply")))
    assert not (tmp_path / "s").exists()


def test_leaves_of_tensors_are_read_to_the_host():
    pytest.importorskip("torch")
    asset = broken(some_asset(1000), np.array([4, 700]))
    with pytest.warns(cleaning.AssetWarning):
        leaves = MemoryLeaves(asset.torch(), CONFIG)
    part = leaves.read(10, 20)
    assert isinstance(part.means, np.ndarray)
    assert_same(part, in_split_order(asset).subset(slice(10, 20)))


def test_lower_degrees_get_zeros(tmp_path, small):
    parts = [some_asset(500, 1, seed=1), some_asset(300, 3, seed=2), some_asset(200, 0, seed=3)]
    paths = [tmp_path / f"{i}.ply" for i in range(3)]
    for path, part in zip(paths, parts, strict=True):
        v3dg.write_asset(path, part)
    read = [v3dg.read_asset(path) for path in paths]
    higher = [np.pad(g.sh, ((0, 0), (0, 16 - g.sh.shape[1]), (0, 0))) for g in read]
    padded = Gaussians.concatenate([replace(g, sh=sh) for g, sh in zip(read, higher, strict=True)])
    small()
    with leaves_on_disk(paths, tmp_path / "s", memory=0, config=CONFIG) as leaves:
        assert leaves.sh_degree == 3
        assert leaves.digest == digest_of(padded)
        assert_same(leaves.read(0, 1000), in_split_order(padded))


# ---- files


def every_kind(folder, asset):
    """Yield files of all kinds that can be written here, and some that cannot be
    read."""
    paths = [
        folder / name for name in ("a.ply", "b.compressed.ply", "c.spz", "d.sog", "e.splat", "f.pt")
    ]
    for path in paths[:4]:
        v3dg.write_asset(path, asset)
    records = np.zeros(
        len(asset), [("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)]
    )
    records["mean"], records["scale"], records["rgba"] = asset.means, asset.scales, 200
    records["quat"] = 255
    paths[4].write_bytes(records.tobytes())
    torch = pytest.importorskip("torch")
    g = asset.torch()
    tensors = {
        "means": g.means,
        "scales": g.scales.log(),
        "quats": g.quats,
        "opacities": g.opacities.logit(),
    }
    torch.save({"splats": {**tensors, "sh0": g.sh[:, :1], "shN": g.sh[:, 1:]}}, paths[5])
    return paths


@pytest.mark.parametrize("sh_degree", [0, 2])
def test_files_are_read_in_any_runs_of_rows(tmp_path, sh_degree):
    for encoding in ("ascii", "binary_big_endian"):
        asset = some_asset(1500, sh_degree)
        v3dg.write_asset(tmp_path / f"{encoding}.ply", asset, encoding=encoding)
    paths = [
        *every_kind(tmp_path, asset),
        tmp_path / "ascii.ply",
        tmp_path / "binary_big_endian.ply",
    ]
    for path in paths:
        whole = v3dg.read_asset(path)
        file = open_asset(path)
        assert (file.num_gaussians, file.sh_degree) == (len(whole), whole.sh_degree)
        for first, last in (
            (0, 0),
            (0, 700),
            (700, 701),
            (701, 1500),
            (3, 5),
            (255, 513),
            (1500, 1500),
        ):
            assert_same(file.read(first, last), whole.subset(slice(first, last)))


def test_rows_with_lists_are_read_in_runs(tmp_path):
    asset = some_asset(900)
    path = tmp_path / "a.ply"
    v3dg.write_asset(path, asset)
    head, mark, rows = path.read_bytes().partition(b"end_header\n")
    records = np.frombuffer(rows, np.uint8).reshape(900, -1)
    lists = [bytes([i % 5]) + bytes(i % 5) + row.tobytes() for i, row in enumerate(records)]
    head = head.replace(
        b"property float x\n", b"property list uchar uchar tags\nproperty float x\n"
    )
    (tmp_path / "lists.ply").write_bytes(head + mark + b"".join(lists))
    whole, file = v3dg.read_asset(path), open_asset(tmp_path / "lists.ply")
    for first, last in ((0, 300), (300, 301), (301, 900), (10, 20), (500, 900)):
        assert_same(file.read(first, last), whole.subset(slice(first, last)))


def test_runs_of_a_ply_are_within_it(tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(10))
    file = _core.PlyFile(os.fspath(tmp_path / "a.ply"))
    for first, last in ((-1, 3), (4, 3), (0, 11)):
        with pytest.raises(ValueError, match="rows: expected 0 <= first <= last <= 10, got"):
            file.read(first, last)


def test_all_kinds_make_one_build(tmp_path, small):
    asset = some_asset(800, 1)
    paths = every_kind(tmp_path, asset)
    small()
    with leaves_on_disk(paths, tmp_path / "s", memory=0, config=CONFIG) as leaves:
        assert leaves.asset_gaussians == 6 * 800
        assert leaves.num_gaussians == 6 * 800


# ---- what goes wrong


def test_nothing_to_draw_is_refused(tmp_path, small):
    v3dg.write_asset(tmp_path / "none.ply", some_asset(0))
    v3dg.write_asset(tmp_path / "dark.ply", broken(some_asset(3), [1]).subset([1, 1]))
    for path, message in (
        ("none", "at least one gaussian, got none"),
        ("dark", "at least one gaussian that can be drawn"),
    ):
        small()
        with (
            pytest.raises(ValueError, match=f"asset: expected {message}"),
            leaves_on_disk([tmp_path / f"{path}.ply"], tmp_path / "s", memory=0, config=CONFIG),
        ):
            pass
        assert not (tmp_path / "s").exists()


def test_wrong_values_can_be_refused(tmp_path, small):
    asset = broken(some_asset(50), [0])
    v3dg.write_asset(tmp_path / "a.ply", asset)
    small()
    for leaves in (
        lambda: MemoryLeaves(asset, CONFIG, "refuse"),
        lambda: leaves_on_disk(
            [tmp_path / "a.ply"], tmp_path / "s", memory=0, config=CONFIG, unusable="refuse"
        ).__enter__(),
    ):
        with pytest.raises(
            ValueError, match="expected only gaussians that can be drawn, but 1 of 50"
        ):
            leaves()


def test_too_little_memory_is_told_before_work_begins(tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(50))
    with (
        pytest.raises(
            ValueError, match=r"^memory: expected at least \d+ MiB, got 10\.0 MiB; allow more"
        ),
        leaves_on_disk([tmp_path / "a.ply"], tmp_path / "s", memory=10 << 20, config=CONFIG),
    ):
        pass
    assert not (tmp_path / "s").exists()


def test_a_file_that_must_be_read_whole_says_what_it_takes(tmp_path):
    v3dg.write_asset(tmp_path / "a.spz", some_asset(400_000))
    with (
        pytest.raises(
            ValueError, match=r"memory: expected at least \d+ MiB for .*a.spz, which must"
        ),
        leaves_on_disk([tmp_path / "a.spz"], tmp_path / "s", memory=100 << 20, config=CONFIG),
    ):
        pass


def test_too_small_a_disk_is_told_before_work_begins(tmp_path, small, monkeypatch):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(50_000))
    small()
    monkeypatch.setattr(on_disk.shutil, "disk_usage", lambda _: SimpleNamespace(free=1 << 20))
    with (
        pytest.raises(OSError, match=r"s: expected 3 MiB free for scratch files, got 1 MiB"),
        leaves_on_disk([tmp_path / "a.ply"], tmp_path / "s", memory=0, config=CONFIG),
    ):
        pass
    assert not (tmp_path / "s").exists()


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOSPC, "No space left on device"), KeyboardInterrupt()]
)
@pytest.mark.parametrize("writes", [0, 1, 2, 3, 5, 40])
def test_an_error_leaves_no_scratch(tmp_path, small, monkeypatch, error, writes):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(1000))
    small()
    left, write = [writes], _files.write_at

    def failing(*args):
        left[0] -= 1
        if left[0] < 0:
            raise error
        write(*args)

    monkeypatch.setattr(_files, "write_at", failing)
    with (
        pytest.raises(type(error)) as raised,
        leaves_on_disk([tmp_path / "a.ply"], tmp_path / "s", memory=0, config=CONFIG),
    ):
        pass
    assert not (tmp_path / "s").exists()
    if isinstance(error, OSError):
        assert raised.value.errno == errno.ENOSPC
        assert Path(raised.value.filename).parent == tmp_path / "s"


def test_files_that_change_meanwhile_are_found(tmp_path, small, monkeypatch):
    path = tmp_path / "a.ply"
    v3dg.write_asset(path, some_asset(1000))
    small()
    split = external_split.split

    def meanwhile(*args):
        v3dg.write_asset(path, some_asset(1000, seed=1))
        split(*args)

    monkeypatch.setattr(external_split, "split", meanwhile)
    with (
        pytest.raises(
            ValueError, match=r"a.ply: expected a file that does not change during the build"
        ),
        leaves_on_disk([path], tmp_path / "s", memory=0, config=CONFIG),
    ):
        pass
    assert not (tmp_path / "s").exists()


def test_scratch_in_use_and_files_of_others_are_kept(tmp_path, small):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(1000))
    small()

    def leaves():
        return leaves_on_disk([tmp_path / "a.ply"], tmp_path / "s", memory=0, config=CONFIG)

    with leaves() as first:
        with pytest.raises(RuntimeError, match="another build is using it"), leaves():
            pass
        first.read(0, 1000)
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / "letter").write_text("dear")
    with (
        pytest.raises(
            ValueError, match="expected scratch files of a build, got another file, 'letter'"
        ),
        leaves(),
    ):
        pass
    assert (tmp_path / "s" / "letter").read_text() == "dear"
    # Scratch files have such a name, too, so the file is moved to it.
    (tmp_path / "s" / "letter").rename(tmp_path / "s" / "order")
    with (
        pytest.raises(
            ValueError, match="expected scratch files of a build, got another file, 'order'"
        ),
        leaves(),
    ):
        pass
    assert (tmp_path / "s" / "order").read_text() == "dear"
    shutil.rmtree(tmp_path / "s")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "rows").write_text("dear")
    (tmp_path / "s").symlink_to("elsewhere")
    with pytest.raises(NotADirectoryError), leaves():
        pass
    assert (tmp_path / "elsewhere" / "rows").read_text() == "dear"


CHILD = """
    import sys, time, resource
    import numpy as np
    import v3dg
    from v3dg.levels.leaves_on_disk import leaves_on_disk, DiskLeaves
    import concurrent.futures, tqdm
    def peak():
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10
    before = peak()
    paths, folder, memory = sys.argv[3:], sys.argv[1], int(sys.argv[2])
    with leaves_on_disk(paths, folder, memory=memory, config=v3dg.BuildConfig()) as leaves:
        print(type(leaves).__name__, peak() - before, flush=True)
        if memory > 1:
            for first in range(0, leaves.num_gaussians, 100_000):
                leaves.read(first, min(first + 100_000, leaves.num_gaussians))
            print(peak() - before, flush=True)
        {end}
"""


def child(folder, memory, paths, end="pass"):
    code = textwrap.dedent(CHILD).format(end=end)
    command = [sys.executable, "-c", code, str(folder), str(memory), *map(str, paths)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize(
    ("suffix", "sh_degree", "mib", "mib_for_all"),
    [
        (".ply", 0, 64, 180),
        (".ply", 3, 200, 500),
        (".compressed.ply", 3, 200, 500),
        (".spz", 0, 110, 230),
    ],
)
def test_peak_memory_is_what_was_given(tmp_path, suffix, sh_degree, mib, mib_for_all):
    paths = [tmp_path / f"{i}{suffix}" for i in range(3)]
    for i, path in enumerate(paths):
        v3dg.write_asset(path, some_asset(400_000, sh_degree, seed=i))
    for memory, kind in ((mib << 20, "DiskLeaves"), (mib_for_all << 20, "MemoryLeaves")):
        process = child(tmp_path / "s", memory, paths)
        output, _ = process.communicate(timeout=300)
        assert process.returncode == 0
        name, prepared, read = output.split()
        assert name == kind
        assert int(prepared) < memory
        # The memory of a read includes its result.
        assert int(read) < memory + 100_000 * gaussian_bytes(sh_degree)


def test_scratch_of_a_killed_build_is_removed_by_the_next(tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(1_500_000))
    process = child(tmp_path / "s", 64 << 20, [tmp_path / "a.ply"], end="time.sleep(600)")
    assert process.stdout.readline().startswith("DiskLeaves")
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=60)
    process.stdout.close()
    assert (tmp_path / "s" / "rows").exists()
    v3dg.write_asset(tmp_path / "b.ply", some_asset(10))
    with leaves_on_disk(
        [tmp_path / "b.ply"], tmp_path / "s", memory=PLENTY, config=CONFIG
    ) as leaves:
        assert leaves.num_gaussians == 10
        assert not (tmp_path / "s" / "rows").exists()
    assert not (tmp_path / "s").exists()


def test_points_leave_the_disk_before_the_rows_are_written(tmp_path, small, monkeypatch):
    v3dg.write_asset(tmp_path / "a.ply", some_asset(300))
    small()
    open_names = []
    write_rows = on_disk._write_rows

    def look_and_write(*arguments):
        # A removed file takes space until it is closed.
        descriptors = Path("/proc/self/fd").iterdir()
        open_names.extend(os.readlink(link) for link in descriptors if link.is_symlink())
        return write_rows(*arguments)

    monkeypatch.setattr(on_disk, "_write_rows", look_and_write)
    with leaves_on_disk([tmp_path / "a.ply"], tmp_path / "s", memory=0, config=CONFIG):
        pass
    scratch = [name for name in open_names if name.startswith(f"{tmp_path}/s/")]
    assert sorted(scratch) == [str(tmp_path / "s" / name) for name in ("order", "rows")]
