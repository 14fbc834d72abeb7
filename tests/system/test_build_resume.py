"""Builds that are interrupted or killed and then continue, and the unfinished bundles
that they leave."""

import errno
import hashlib
import os
import resource
import signal
import subprocess
import sys
import time
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import v3dg
import v3dg.levels
from benchmarks.worlds.procedural import make_asset
from random_bundle import random_gaussians
from v3dg import BuildConfig, _files, build_bundle
from v3dg.bundle import file
from v3dg.bundle.file import BundlePlan
from v3dg.levels import leaves_on_disk
from v3dg.levels.digest import digest_of
from v3dg.levels.unfinished import _open_locked

CONFIG = BuildConfig(cluster_size=32, steps=400, first_steps=400)
# This build would run for days, so it can only have stopped at the checkpoint of the
# first level.
ENDLESS = replace(CONFIG, steps=1_000_000, first_steps=1_000_000)
SCRIPT = """
import sys
import v3dg
from benchmarks.worlds.procedural import make_asset
asset = make_asset(num_gaussians=1000, seed=0)
config = v3dg.BuildConfig(cluster_size=32, steps=int(sys.argv[1]), first_steps=int(sys.argv[1]))
if sys.argv[4] == "cuda":
    import torch
    torch.zeros(1, device="cuda")  # so that the device is up
print("ready", flush=True)
try:
    bundle = v3dg.build_bundle(
        asset, config=config, seed=7, progress=False, device=sys.argv[4], resume_path=sys.argv[2],
        quality="draft",
    )
except KeyboardInterrupt:
    sys.exit(130)
bundle.write(sys.argv[3])
"""
# With fewer bytes in the journal, only leaves may be finished.
TWO_RECORDS = 3700
# This limit in seconds is generous, because a build that ignored the interrupt would
# take days.
PATIENCE = 60


@pytest.fixture(scope="module")
def asset():
    return make_asset(num_gaussians=1000, seed=0)


def bytes_of(bundle, folder):
    path = folder / "bytes.v3dg"
    bundle.write(path)
    return path.read_bytes()


@pytest.fixture(scope="module")
def whole(asset, device, tmp_path_factory):
    """The bundle of a build that nothing interrupts."""
    bundle = build_bundle(
        asset, config=CONFIG, seed=7, progress=False, device=device, quality="draft"
    )
    return bytes_of(bundle, tmp_path_factory.mktemp("whole"))


@contextmanager
def started_build(config, device, folder):
    """Start a build in a separate process. It is killed at the end of the test if it
    still runs."""
    roots = os.pathsep.join(
        str(Path(file).parents[1]) for file in (v3dg.__file__, Path(__file__).parent)
    )
    environment = os.environ | {"PYTHONPATH": roots}
    arguments = [str(config.steps), str(folder / "levels"), str(folder / "out.v3dg"), device]
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *arguments],
        cwd=folder,
        env=environment,
        stdout=subprocess.PIPE,
        text=True,
        # Signals are handled as in a terminal, however the tests were started.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    try:
        assert process.stdout.readline() == "ready\n"
        yield process
    finally:
        process.kill()
        process.wait()
        process.stdout.close()


def wait_for_growth(path, process, before=0):
    """Wait until `path` has more than `before` bytes; return their number, or None if
    the process ended first."""
    while process.poll() is None:
        if path.exists() and (now := path.stat().st_size) > before:
            return now
        time.sleep(0.002)
    return None


def names_in(folder):
    return sorted(p.name for p in folder.iterdir())


def test_ctrl_c_ends_a_build_at_once(tmp_path, device):
    with started_build(ENDLESS, device, tmp_path) as process:
        time.sleep(0.5)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    assert names_in(tmp_path) == []


def test_interrupted_build_resumes_to_the_same_bytes(asset, whole, tmp_path, device):
    with started_build(CONFIG, device, tmp_path) as process:
        assert wait_for_growth(tmp_path / "levels", process, len(whole) + TWO_RECORDS)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 130
    assert names_in(tmp_path) == ["levels"]
    bundle = build_bundle(
        asset,
        config=CONFIG,
        seed=7,
        progress=False,
        device=device,
        resume_path=tmp_path / "levels",
        quality="draft",
    )
    assert names_in(tmp_path) == ["levels"]
    assert bytes_of(bundle, tmp_path) == whole


def test_killed_builds_resume_to_the_same_bytes(asset, whole, tmp_path, device):
    levels = tmp_path / "levels"
    seen = len(whole) + TWO_RECORDS
    for _ in range(3):
        with started_build(CONFIG, device, tmp_path) as process:
            seen = wait_for_growth(levels, process, seen) or seen
            process.kill()
            process.wait()
        assert names_in(tmp_path) == ["levels"]
    bundle = build_bundle(
        asset,
        config=CONFIG,
        seed=7,
        progress=False,
        device=device,
        resume_path=levels,
        quality="draft",
    )
    assert names_in(tmp_path) == ["levels"]
    assert bytes_of(bundle, tmp_path) == whole


QUICK = BuildConfig(cluster_size=64, steps=0)


@pytest.fixture
def checkpoint(asset, tmp_path, monkeypatch):
    """All levels of a build that was interrupted before it could join them."""

    def interrupt(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("v3dg.levels.whole.assemble", interrupt)
        with pytest.raises(KeyboardInterrupt):
            build_bundle(asset, config=QUICK, progress=False, resume_path=tmp_path / "levels")
    return tmp_path / "levels"


@pytest.fixture(scope="module")
def expected(asset, tmp_path_factory):
    """The bytes of a build that nothing interrupts."""
    return bytes_of(
        build_bundle(asset, config=QUICK, progress=False), tmp_path_factory.mktemp("expected")
    )


def test_finished_levels_are_not_built_again(asset, checkpoint, monkeypatch):
    def fail(*_):
        raise AssertionError("built a level again")

    monkeypatch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", fail)
    assert build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint).num_levels > 3


def test_level_that_was_cut_off_is_built_again(asset, checkpoint, expected):
    left = checkpoint.read_bytes()
    journal = np.linspace(len(expected), len(left) - 1, 9).astype(int)
    for num_bytes in (0, 1, 20, 100, len(expected) // 2, len(expected) - 1, *journal):
        checkpoint.write_bytes(left[:num_bytes])
        bundle = build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
        assert bundle.path == str(checkpoint)
        assert checkpoint.read_bytes() == expected


FINISHING = {
    "tables": ("v3dg.bundle.file.BundlePlan.write_tables", 1),
    "the end of the header": ("v3dg._files.write_at", 2),
    "the header": ("v3dg.bundle.file.BundlePlan.write_header", 1),
    "the journal": ("os.ftruncate", 1),
}


@pytest.mark.parametrize("place", FINISHING)
@pytest.mark.parametrize("moment", ["before", "after"])
def test_a_kill_while_it_becomes_a_bundle_loses_nothing(
    asset, checkpoint, expected, place, moment, monkeypatch
):
    """The process is killed before or after any of the steps.

    No level is built again.
    """
    target, calls = FINISHING[place]
    *_, name = target.split(".")
    original = {
        "write_tables": BundlePlan.write_tables,
        "write_header": BundlePlan.write_header,
        "write_at": _files.write_at,
        "ftruncate": os.ftruncate,
    }[name]
    left = [calls]

    def killed(*arguments):
        left[0] -= 1
        if left[0] > 0 or moment == "after":
            original(*arguments)
        if left[0] == 0:
            raise KeyboardInterrupt

    def fail(*_):
        raise AssertionError("built a level again")

    monkeypatch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", fail)
    with monkeypatch.context() as patch:
        patch.setattr(target, killed)
        with pytest.raises(KeyboardInterrupt):
            build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
    build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
    assert checkpoint.read_bytes() == expected


def test_what_is_unfinished_is_no_bundle(asset, checkpoint):
    with pytest.raises(ValueError, match="levels: expected a bundle, got an unfinished one"):
        v3dg.Bundle.open(checkpoint)


@pytest.mark.parametrize("changed", ["asset", "config", "seed", "device", "version"])
def test_checkpoint_of_another_build_is_refused(asset, checkpoint, changed, monkeypatch):
    before = checkpoint.read_bytes()
    config, seed = QUICK, 0
    if changed == "asset":
        asset = make_asset(num_gaussians=1000, seed=1)
    elif changed == "config":
        config = replace(config, distance=4.5)
    elif changed == "seed":
        seed = 1
    elif changed == "device":
        monkeypatch.setattr("v3dg._device.describe", lambda _: "another")
    else:
        monkeypatch.setattr("v3dg.levels.unfinished.__version__", "0.0.0")
    with pytest.raises(
        ValueError, match="another asset, config, seed, device or version; remove it"
    ):
        build_bundle(
            asset, config=config, seed=seed, progress=False, resume_path=checkpoint, quality="draft"
        )
    assert checkpoint.read_bytes() == before


def test_damaged_checkpoint_is_named(asset, checkpoint, expected):
    good = checkpoint.read_bytes()
    rng = np.random.default_rng(0)
    damaged = {"text": b"not levels", "zeros": bytes(1000), "archive": b"PK\x03\x04" + bytes(1000)}
    pages, journal = rng.integers(0, len(expected), 30), rng.integers(len(expected), len(good), 30)
    # Places in the header, the pages and the journal. The end of the journal consists
    # mainly of numbers of clusters and digests.
    for place in (
        *range(0, 42, 7),
        *pages,
        *journal,
        *rng.integers(len(good) - 500, len(good), 20),
    ):
        flipped = bytearray(good)
        flipped[place] ^= 1 << rng.integers(8)
        damaged[f"bit flipped in byte {place} of {len(good)}"] = bytes(flipped)
    refused = []
    for damage, content in damaged.items():
        checkpoint.write_bytes(content)
        try:
            build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
        except ValueError as error:
            refused.append(str(error))
        # The new size makes a level look truncated, or is stored where the header and
        # the tables begin.
        else:
            assert checkpoint.read_bytes() == expected, damage
    assert len(refused) > len(damaged) / 2
    assert [
        message for message in refused if not message.endswith("remove it to start again")
    ] == []


def test_resume_path_needs_a_folder(asset, tmp_path):
    with pytest.raises(ValueError, match="resume_path: expected a file in an existing folder"):
        build_bundle(asset, config=QUICK, progress=False, resume_path=tmp_path / "no" / "levels")
    (tmp_path / "folder").mkdir()
    with pytest.raises(IsADirectoryError, match="folder"):
        build_bundle(asset, config=QUICK, progress=False, resume_path=tmp_path / "folder")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: expected an ordinary file, got a device or a pipe"):
        build_bundle(asset, config=QUICK, progress=False, resume_path=tmp_path / "pipe")


def test_a_second_build_to_the_same_place_is_refused(asset, tmp_path):
    """The first build continues undisturbed."""
    with started_build(ENDLESS, "cpu", tmp_path) as process:
        wait_for_growth(tmp_path / "levels", process)
        for use in (
            lambda: build_bundle(
                asset, config=QUICK, progress=False, resume_path=tmp_path / "levels"
            ),
            lambda: v3dg.levels.discard_levels(tmp_path / "levels"),
        ):
            with pytest.raises(
                RuntimeError, match="levels: another build is using it; wait for it"
            ):
                use()
        assert process.poll() is None
        assert names_in(tmp_path) == ["levels"]
    v3dg.levels.discard_levels(tmp_path / "levels")
    v3dg.levels.discard_levels(tmp_path / "levels")
    assert names_in(tmp_path) == []


def test_the_digest_of_an_asset_is_the_one_of_the_format_page():
    asset = random_gaussians(np.random.default_rng(0), 70_000, sh_degree=1)

    def blake2b(*pieces):
        return hashlib.blake2b(b"".join(pieces), digest_size=16)

    def block(first, last):
        arrays = (asset.means, asset.quats, asset.scales, asset.opacities, asset.sh)
        return blake2b(*(array[first:last].tobytes() for array in arrays)).digest()

    assert digest_of(asset) == blake2b(block(0, 65_536), block(65_536, 70_000)).hexdigest()


@pytest.mark.parametrize("target", ["absent", "levels of another", "text"])
def test_links_at_the_levels_are_refused(asset, checkpoint, tmp_path, target):
    """Links in the place of the levels are neither written through nor removed, because
    they may lead anywhere."""
    checkpoint.rename(tmp_path / "levels of another")
    (tmp_path / "text").write_bytes(b"")
    before = {name: (tmp_path / name).read_bytes() for name in names_in(tmp_path)}
    checkpoint.symlink_to(tmp_path / target)
    for use in (
        lambda: build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint),
        lambda: v3dg.levels.discard_levels(checkpoint),
    ):
        with pytest.raises(
            ValueError, match="levels: expected an ordinary file, got a symbolic link"
        ):
            use()
    checkpoint.unlink()
    assert {name: (tmp_path / name).read_bytes() for name in names_in(tmp_path)} == before


def test_levels_are_for_their_owner_alone(checkpoint):
    assert checkpoint.stat().st_mode & 0o777 == 0o600


def test_a_lock_on_a_file_that_was_removed_is_none(tmp_path, monkeypatch):
    """If a build ends and removes the file that another build has opened, a lock on
    this file would no longer protect anything."""
    path = tmp_path / "levels"

    def lock(descriptor, name):
        if not locked:
            path.unlink()
        locked.append(name)

    locked = []
    monkeypatch.setattr("v3dg._files.lock", lock)
    with _open_locked(path) as file:
        assert os.path.samestat(os.fstat(file.fileno()), path.stat())
    assert len(locked) == 2


def test_levels_that_a_kill_left_beside_a_bundle_are_removed(asset, tmp_path):
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    options = {"config": QUICK, "progress": False}
    v3dg.levels.build_file(
        tmp_path / "asset.ply", tmp_path / "out.v3dg", **options, quality="draft"
    )
    (tmp_path / "out.v3dg.partial").touch()
    _, is_built = v3dg.levels.build_file(
        tmp_path / "asset.ply", tmp_path / "out.v3dg", resume=True, **options, quality="draft"
    )
    assert not is_built
    assert names_in(tmp_path) == ["asset.ply", "out.v3dg"]


def test_what_is_no_levels_stays(asset, tmp_path):
    """A user's file with the name of an unfinished bundle is neither removed nor
    written to."""
    v3dg.write_asset(tmp_path / "asset.ply", asset)
    (tmp_path / "out.v3dg.partial").write_text("a download that goes on")
    for resume in (False, True):
        with pytest.raises(
            ValueError, match=r"out\.v3dg\.partial: .*(move it elsewhere|got another file)"
        ):
            v3dg.levels.build_file(
                tmp_path / "asset.ply",
                tmp_path / "out.v3dg",
                config=QUICK,
                progress=False,
                resume=resume,
            )
    assert (tmp_path / "out.v3dg.partial").read_text() == "a download that goes on"


def test_a_bundle_that_was_not_moved_yet_is_discarded(asset, tmp_path):
    v3dg.build_bundle(asset, config=QUICK, progress=False).write(tmp_path / "out.v3dg")
    (tmp_path / "out.v3dg").rename(tmp_path / "out.v3dg.partial")
    v3dg.levels.discard_levels(tmp_path / "out.v3dg.partial")
    assert names_in(tmp_path) == []


@contextmanager
def files_of_at_most(num_bytes):
    """Make writes beyond this size fail, as on a full disk."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (num_bytes, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))


def test_a_full_disk_leaves_what_can_be_gone_on_with(asset, checkpoint, expected):
    """If no level was finished, nothing remains."""
    whole = checkpoint.read_bytes()
    journal = np.linspace(len(expected), len(whole) - 1, 5).astype(int)
    for num_bytes in (0, 10, 1000, len(expected) // 2, *journal):
        checkpoint.unlink(missing_ok=True)
        with (
            files_of_at_most(num_bytes),
            pytest.raises(OSError, match=r"File too large: '.*levels'"),
        ):
            build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
        left = checkpoint.read_bytes() if checkpoint.exists() else b""
        assert len(left) <= num_bytes
        assert len(left) == 0 or len(left) > len(expected)
        build_bundle(asset, config=QUICK, progress=False, resume_path=checkpoint)
        assert checkpoint.read_bytes() == expected


# ---- assets that do not fit in memory


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiles")
    for i in range(2):
        v3dg.write_asset(folder / f"{i}.ply", make_asset(num_gaussians=1200, seed=i))
    return [folder / f"{i}.ply" for i in range(2)]


@pytest.fixture
def bounded(tiles, monkeypatch):
    """Build the tiles on disk and in several units, as if they were many and memory
    small."""
    monkeypatch.setattr("v3dg.levels.whole.UNIT_LEAVES", 400)
    sizes = leaves_on_disk._Sizes(in_memory=0, in_block=1 << 16, in_node=700, in_bucket=300)
    monkeypatch.setattr(leaves_on_disk._Sizes, "of", lambda *_: sizes)
    config = BuildConfig(cluster_size=32, steps=0, num_views=1)

    def build(output):
        v3dg.levels.build_file(
            tiles, output, config=config, progress=False, device="cpu", resume=True
        )
        return output.read_bytes()

    return build


def test_a_disk_that_is_full_at_any_write_of_a_bounded_build(bounded, tmp_path, monkeypatch):
    """Of each kind of write, the first, the last and some in between fail after half of
    their bytes."""
    write, kinds = _files.write_at, []
    expected = bounded(tmp_path / "whole.v3dg")

    def kind_of(descriptor, offset):
        name = os.path.basename(os.readlink(f"/proc/self/fd/{descriptor}"))
        is_journal = offset >= len(expected)
        return name if name in leaves_on_disk._NAMES else "journal" if is_journal else "tables"

    def noted(descriptor, data, offset):
        kinds.append(kind_of(descriptor, offset))
        write(descriptor, data, offset)

    def noted_pages(*arguments):
        kinds.append("pages")
        return file.write_pages(*arguments)

    def full_pages(path, descriptor, run, codec, gaussians):
        left[0] -= kind == "pages"
        if kind != "pages" or left[0] >= 0:
            return file.write_pages(path, descriptor, run, codec, gaussians)
        first, last = run.places[[0, -1]].tolist()
        os.pwrite(descriptor, b"?" * ((last - first) // 2), first)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    def full(descriptor, data, offset):
        # The head of the file is overwritten in place, which needs no more space.
        is_head_again = left[0] < 0 and offset == 0
        if is_head_again or kind_of(descriptor, offset) != kind:
            return write(descriptor, data, offset)
        left[0] -= 1
        if left[0] >= 0:
            return write(descriptor, data, offset)
        write(descriptor, memoryview(data)[: len(data) // 2], offset)
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(_files, "write_at", noted)
    monkeypatch.setattr("v3dg.levels.unfinished.write_pages", noted_pages)
    assert bounded(tmp_path / "whole2.v3dg") == expected
    assert set(kinds) == {*leaves_on_disk._NAMES, "journal", "pages", "tables"}
    monkeypatch.setattr(_files, "write_at", full)
    monkeypatch.setattr("v3dg.levels.unfinished.write_pages", full_pages)
    output = tmp_path / "out" / "out.v3dg"
    output.parent.mkdir()
    for kind in sorted(set(kinds)):
        for place in np.unique(np.linspace(0, kinds.count(kind) - 1, 5).astype(int)).tolist():
            left = [place]
            with pytest.raises(OSError, match="No space left on device") as raised:
                bounded(output)
            folder = f"{output}.scratch" if kind in leaves_on_disk._NAMES else output.parent
            assert os.path.dirname(raised.value.filename) == str(folder)
            assert set(names_in(output.parent)) <= {"out.v3dg.partial"}
            left = [sys.maxsize]
            assert bounded(output) == expected
            assert names_in(output.parent) == ["out.v3dg"]
            output.unlink()
