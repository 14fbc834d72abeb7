"""Builds that end with a refinement: which builds do, what stays unchanged, and what an
interrupted refinement leaves behind."""

import os
import re
import shlex
import signal
import subprocess
import sys
import time
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from rooms import room
from v3dg import BuildConfig, build_bundle
from v3dg._device import CPU
from v3dg.cli import build as command
from v3dg.gaussians import gaussian_bytes
from v3dg.levels import DraftWarning, build_file, levels_path
from v3dg.levels.default_quality import chosen_quality
from v3dg.levels.quality import refinement_of
from v3dg.levels.refine_sizes import refine_bytes

QUICK = BuildConfig(cluster_size=64, steps=0)
STEPS = 12
PATIENCE = 60
SCRIPT = """
import sys
from v3dg import BuildConfig
from v3dg.cli import build as command
from v3dg.levels import build_file
build_file(
    sys.argv[1], sys.argv[2], config=BuildConfig(cluster_size=64, steps=0), progress=False,
    device=sys.argv[3], quality="standard",
)
"""


@pytest.fixture(scope="module")
def asset():
    return make_asset(num_gaussians=1000, seed=0)


@pytest.fixture
def short(monkeypatch):
    """Make refinements short by using few pictures."""
    monkeypatch.setattr("v3dg.levels.quality._LEAST_PICTURES", STEPS)
    monkeypatch.setattr("v3dg.levels.quality._GAUSSIANS_PER_PICTURE", 1 << 40)
    monkeypatch.setattr("v3dg.levels.refined._NUM_WEIGHING_PICTURES", 40)


@pytest.fixture
def file(asset, tmp_path):
    path = tmp_path / "asset.ply"
    v3dg.write_asset(path, asset)
    return path


def bytes_of(bundle, folder):
    path = folder / "bytes.v3dg"
    bundle.write(path)
    return path.read_bytes()


def refined_by_hand(asset, device, seed=0, steps=STEPS):
    bundle = build_bundle(asset, config=QUICK, seed=seed, device=device, progress=False)
    return v3dg.refine_bundle(bundle, steps=steps, seed=seed, device=device, progress=False)


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


@pytest.mark.parametrize(
    ("quality", "num_gaussians", "sh_degree", "steps"),
    [
        ("standard", 1000, 0, 18_010),
        ("standard", 500_000, 3, 23_000),
        ("standard", 4_000_000, 0, 58_000),
        ("best", 500_000, 0, 115_000),
        # An asset of 10 million gaussians has four units of 2.5 million, or eight of
        # 1.25 million.
        ("standard", 10_000_000, 0, 43_000),
        ("standard", 10_000_000, 3, 30_500),
        ("best", 10_000_000, 0, 215_000),
    ],
)
def test_large_assets_are_refined_by_more_pictures(quality, num_gaussians, sh_degree, steps):
    request = refinement_of(quality, num_gaussians, sh_degree, 7)
    assert (request.steps, request.seed) == (steps, 7)
    assert refinement_of("draft", num_gaussians, sh_degree, 7) is None


@pytest.mark.parametrize("sh_degree", range(4))
def test_the_memory_of_a_refinement_has_a_limit(sh_degree):
    of_million = refine_bytes(1_000_000, sh_degree)
    assert of_million == 12 * 1_000_000 * gaussian_bytes(sh_degree)
    assert refine_bytes(100_000_000, sh_degree) < 10e9
    assert refine_bytes(100_000_000, sh_degree) > of_million


def test_a_build_of_a_quality_is_a_build_and_a_refinement(short, asset, device, tmp_path):
    for quality, steps in (("standard", STEPS), ("best", 5 * STEPS)):
        bundle = build_bundle(
            asset, config=QUICK, seed=3, device=device, progress=False, quality=quality
        )
        expected = refined_by_hand(asset, device, seed=3, steps=steps)
        assert bytes_of(bundle, tmp_path) == bytes_of(expected, tmp_path)
        assert bundle.config["refined"] == {"steps": steps, "drop": 0.02, "seed": 3}


def test_level_0_stays(short, asset, device):
    draft = build_bundle(asset, config=QUICK, device=device, progress=False)
    bundle = build_bundle(asset, config=QUICK, device=device, progress=False, quality="standard")
    assert "refined" not in draft.config
    for name, values in vars(draft.level_gaussians(0)).items():
        np.testing.assert_array_equal(values, getattr(bundle.level_gaussians(0), name))
    assert not np.array_equal(draft.level_gaussians(1).means, bundle.level_gaussians(1).means)


def test_workers_do_not_change_the_bytes(short, file, device, tmp_path, monkeypatch):
    """Neither the number of workers nor storing the levels in a file changes the
    bytes."""
    monkeypatch.setattr("v3dg.levels.whole.UNIT_LEAVES", 300)
    expected = bytes_of(refined_by_hand(file, device), tmp_path)
    output = tmp_path / "out.v3dg"
    for num_workers in (None, 1, 3):
        executor = None
        if num_workers is not None:
            executor = ThreadPoolExecutor(num_workers)
        _, is_built = build_file(
            file,
            output,
            config=QUICK,
            device=device,
            progress=False,
            quality="standard",
            executor=executor,
        )
        assert is_built
        assert output.read_bytes() == expected
        assert names_in(tmp_path) == ["asset.ply", "bytes.v3dg", "out.v3dg"]


MOMENTS = {
    "it begins": "v3dg.levels.refined.without_unseen",
    "gaussians move": "v3dg.levels.refined.Cuts.refined",
    "it is written": "v3dg.bundle.bundle.Bundle.write",
    "it is there": "v3dg.levels.unfinished.Path.unlink",
}


@pytest.mark.parametrize("moment", MOMENTS)
def test_a_refinement_that_is_interrupted_begins_again(
    short, file, device, tmp_path, monkeypatch, moment
):
    """The levels remain as a complete bundle, and are not built again."""
    expected = bytes_of(refined_by_hand(file, device), tmp_path)
    output = tmp_path / "out.v3dg"

    def build(**options):
        return build_file(
            file, output, config=QUICK, device=device, progress=False, quality="standard", **options
        )

    def interrupt(*_, **__):
        raise KeyboardInterrupt

    def fail(*_):
        raise AssertionError("built a level again")

    with monkeypatch.context() as patch:
        patch.setattr(MOMENTS[moment], interrupt)
        with pytest.raises(KeyboardInterrupt):
            build()
    left = v3dg.Bundle.open(levels_path(output))
    assert "refined" not in left.config
    assert output.exists() == (moment == "it is there")
    monkeypatch.setattr("v3dg.levels.simplify.LevelBuilder._simplify", fail)
    _, is_built = build(resume=True)
    assert is_built == (moment != "it is there")
    assert output.read_bytes() == expected
    assert not levels_path(output).exists()
    assert build(resume=True)[1] is False


def test_a_build_that_is_killed_leaves_its_levels(file, device, tmp_path):
    """A refinement with 18,010 pictures is far from its end when it is killed."""
    output = tmp_path / "out.v3dg"
    roots = [str(Path(path).parents[1]) for path in (v3dg.__file__, Path(__file__).parent)]
    roots.append(os.environ.get("PYTHONPATH", ""))
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, file, output, device],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(roots)},
    )
    try:
        levels = levels_path(output)
        end = time.monotonic() + PATIENCE
        while process.poll() is None and time.monotonic() < end and not is_bundle(levels):
            time.sleep(0.01)
        process.send_signal(signal.SIGKILL)
        assert process.wait(PATIENCE) == -signal.SIGKILL
    finally:
        process.kill()
        process.wait()
    # A process that is killed while it refines cannot remove the folder of units.
    assert set(names_in(tmp_path)) - {"out.v3dg.units"} == {"asset.ply", "out.v3dg.partial"}
    units = tmp_path / "out.v3dg.units"
    units.mkdir(exist_ok=True)
    draft, is_built = build_file(
        file, output, config=QUICK, device=device, progress=False, resume=True
    )
    assert is_built
    assert not units.exists()
    expected = build_bundle(file, config=QUICK, device=device, progress=False)
    assert bytes_of(draft, tmp_path) == bytes_of(expected, tmp_path)


def is_bundle(path):
    try:
        v3dg.Bundle.open(path)
    except (OSError, ValueError):
        return False
    return True


def test_levels_at_a_path_stay_as_they_are_built(short, asset, device, tmp_path):
    """A build with another quality then continues from the finished levels."""
    levels = tmp_path / "levels"
    options = {"config": QUICK, "device": device, "progress": False, "resume_path": levels}
    bundle = build_bundle(asset, quality="standard", **options)
    assert bundle.path is None
    assert bytes_of(bundle, tmp_path) == bytes_of(refined_by_hand(asset, device), tmp_path)
    draft = build_bundle(asset, **options, quality="draft")
    assert draft.path == str(levels)
    assert "refined" not in draft.config


def test_a_bundle_of_another_quality_is_built_again(short, file, device, tmp_path):
    output = tmp_path / "out.v3dg"
    options = {"config": QUICK, "device": device, "progress": False, "resume": True}
    for quality in ("draft", "standard", "best", "draft"):
        for expected in (True, False):
            bundle, is_built = build_file(file, output, quality=quality, **options)
            assert is_built == expected
            assert ("refined" in bundle.config) == (quality != "draft")


def test_an_asset_without_levels_is_built_once(short, file, device, tmp_path):
    config = replace(QUICK, min_gaussians=1000)
    for expected in (True, False):
        bundle, is_built = build_file(
            file,
            tmp_path / "out.v3dg",
            config=config,
            device=device,
            progress=False,
            quality="standard",
            resume=True,
        )
        assert bundle.num_levels == 1
        assert is_built == expected


def test_an_asset_that_is_too_large_to_be_refined_is_refused_before(file, tmp_path, monkeypatch):
    monkeypatch.setattr("v3dg.levels.refine_sizes._COPIES", 1 << 20)
    monkeypatch.setattr("v3dg.levels.refine_sizes._UNIT_BYTES", 1 << 60)
    options = {"config": QUICK, "device": "cpu", "progress": False, "memory": "1GiB"}
    message = r"memory: expected at least [\d,]+ MiB to refine an asset of 1,000 gaussians, got"
    with pytest.raises(ValueError, match=message):
        build_file(file, tmp_path / "out.v3dg", quality="standard", **options)
    assert names_in(tmp_path) == ["asset.ply"]
    build_file(file, tmp_path / "out.v3dg", **options, quality="draft")


def test_a_wrong_quality_is_refused(asset):
    with pytest.raises(ValueError, match="quality: expected"):
        build_bundle(asset, config=QUICK, progress=False, quality="good")


class SmallGpu:
    """A device that claims to be a GPU, which suffices for choices that are made before
    anything is computed on it."""

    is_cuda = True


@pytest.mark.parametrize(
    ("config", "is_gpu", "num_gaussians", "memory", "expected"),
    [
        (BuildConfig(), True, 1000, 1 << 30, "standard"),
        (BuildConfig(), False, 1000, 1 << 30, "draft"),
        (QUICK, True, 1000, 1 << 30, "draft"),
        (BuildConfig(), True, 4_000_000, 1 << 40, "standard"),
        (BuildConfig(), True, 100_000_000, 1 << 40, "standard"),
        (BuildConfig(), True, 100_000, 1 << 20, "100,000 gaussians takes .* MiB of the host"),
        (BuildConfig(), True, 4_100_000, 1 << 40, "4,100,000 gaussians takes .* MiB of the GPU"),
    ],
)
def test_a_build_is_refined_by_default_where_that_is_quick(
    monkeypatch, config, is_gpu, num_gaussians, memory, expected
):
    """A build is refined on a GPU with enough memory. An asset that is built in units
    needs no more memory than one unit. If a build is not refined, the reason is
    printed."""
    monkeypatch.setattr("v3dg.levels.default_quality.free_on", lambda _: 2_700_000_000)
    device = SmallGpu() if is_gpu else CPU
    leaves = SimpleNamespace(num_gaussians=num_gaussians, sh_degree=0)
    if expected in ("standard", "draft"):
        assert chosen_quality(None, config, leaves, device, memory) == expected
    else:
        with pytest.warns(DraftWarning, match=expected):
            assert chosen_quality(None, config, leaves, device, memory) == "draft"
    for named in ("draft", "standard", "best"):
        assert chosen_quality(named, config, leaves, device, memory) == named


def test_the_command_says_why_a_large_asset_stays_a_draft(file, tmp_path, monkeypatch, capsys):
    def choose(*_):
        warnings.warn("quality: refining takes 1 MiB", DraftWarning, stacklevel=1)
        return "draft"

    monkeypatch.setattr("v3dg.levels.files.chosen_quality", choose)
    options = {"cluster_size": 64, "up": "z", "device": "cpu", "quiet": True}
    command.run(command.Build(assets=(file,), output=tmp_path / "a.v3dg", **options))
    assert "quality: refining takes 1 MiB" in capsys.readouterr().err


def test_viewpoints_of_a_draft_are_refused(asset):
    with pytest.raises(ValueError, match="seen_from: expected auto for levels that are not"):
        build_bundle(
            asset, config=QUICK, progress=False, device="cpu", seen_from="inside", quality="draft"
        )


@pytest.mark.parametrize("seen_from", ["auto", "both"])
def test_a_build_of_a_room_says_from_where_it_is_seen(
    short, tmp_path, monkeypatch, capsys, seen_from
):
    """The recorded viewpoints are kept if the build is continued."""
    monkeypatch.setattr("v3dg.cli.build.BuildConfig", lambda: QUICK)
    file = tmp_path / "room.ply"
    v3dg.write_asset(file, room())
    options = {"up": "-y", "device": "cpu", "quality": "standard", "seen_from": seen_from}
    options |= {"assets": (file,), "output": tmp_path / "room.v3dg", "quiet": True}
    command.run(command.Build(**options))
    eyes = v3dg.Bundle.open(tmp_path / "room.v3dg").config["refined"]["eyes"]
    where = "from inside" if seen_from == "auto" else "from outside and from inside"
    line = f"refined by {STEPS} pictures, seen {where}: {eyes} eyes"
    assert line in capsys.readouterr().out.splitlines()
    command.run(command.Build(**options, resume=True))
    assert "kept as it was" in capsys.readouterr().out
    other = {"auto": "both", "both": "auto"}[seen_from]
    command.run(command.Build(**(options | {"seen_from": other}), resume=True))
    assert "kept as it was" not in capsys.readouterr().out


def test_the_command_builds_each_quality(short, file, tmp_path, capsys):
    """If a draft was built without being requested, the command prints how to refine
    it, and how long that takes."""
    output = tmp_path / "a scene.v3dg"
    for quality in (None, "draft", "standard"):
        command.run(
            command.Build(
                assets=(file,),
                output=output,
                cluster_size=64,
                up="z",
                device="cpu",
                quality=quality,
            )
        )
        lines = capsys.readouterr().out.splitlines()
        advice = [line for line in lines if line.startswith("draft: ")]
        assert ("refined" in v3dg.Bundle.open(output).config) == (quality == "standard")
        assert len(advice) == (quality is None)
        if advice:
            assert re.search(r"takes about \d+ (s|minutes|hours) on this CPU", advice[0])
            words = shlex.split(advice[0].split("`")[1])
            refined = str(tmp_path / "a scene_refined.v3dg")
            assert words == ["v3dg", "refine", str(output), refined, "--steps", str(STEPS)]
