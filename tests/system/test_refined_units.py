"""Refinements in units: what they leave unchanged, that they depend neither on workers
nor on interruptions, and how units are made."""

import os
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from rooms import room
from v3dg import BuildConfig, _core
from v3dg._device import CPU
from v3dg.bundle.parts import divided
from v3dg.cli import refine as command
from v3dg.levels import build_file, discard_levels, levels_path
from v3dg.levels.refined import RefineRequest, with_refined_levels
from v3dg.levels.refined_units import refined_bundle
from v3dg.levels.unfinished import locked_units, units_folder
from v3dg.levels.viewpoints import cameras_that_see
from v3dg.levels.whole import devices_for
from v3dg.refine import refine_file

QUICK = BuildConfig(cluster_size=32, steps=0)
NUM_LEAVES = 1600
UNIT_LEAVES = 500
NUM_UNITS = 4
REQUEST = RefineRequest(steps=6, drop=0.02, seed=3)


@pytest.fixture(autouse=True)
def small(monkeypatch):
    """Make units small, and refinements short."""
    monkeypatch.setattr("v3dg.levels.refine_sizes.UNIT_LEAVES", UNIT_LEAVES)
    monkeypatch.setattr("v3dg.levels.quality._LEAST_PICTURES", REQUEST.steps)
    monkeypatch.setattr("v3dg.levels.quality._GAUSSIANS_PER_PICTURE", 1 << 40)
    monkeypatch.setattr("v3dg.levels.refined._NUM_WEIGHING_PICTURES", 20)


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    path = tmp_path_factory.mktemp("asset") / "asset.ply"
    v3dg.write_asset(path, make_asset(num_gaussians=NUM_LEAVES, seed=0))
    return path


@pytest.fixture(scope="module")
def asset(file):
    return v3dg.read_asset(file)


@pytest.fixture(scope="module")
def draft(asset):
    return v3dg.build_bundle(asset, config=QUICK, seed=3, device="cpu", progress=False)


def in_file(bundle, folder):
    """The bundle, opened from the file draft.v3dg."""
    bundle.write(folder / "draft.v3dg")
    return v3dg.Bundle.open(folder / "draft.v3dg")


def build(file, output, *, device="cpu", **options):
    return build_file(
        file,
        output,
        config=QUICK,
        seed=3,
        device=device,
        progress=False,
        quality="standard",
        **options,
    )


def bytes_of(bundle, folder):
    path = folder / "bytes.v3dg"
    bundle.write(path)
    return path.read_bytes()


def names_in(folder):
    return sorted(path.name for path in folder.iterdir())


def test_units_are_subtrees_that_fit(draft):
    division = divided(draft, UNIT_LEAVES)
    level = draft.clusters.level
    assert len(division.units) == NUM_UNITS
    of_units = np.concatenate([unit.clusters for unit in division.units])
    np.testing.assert_array_equal(np.sort(of_units), np.flatnonzero(level < division.top))
    for unit in division.units:
        bundle = unit.of(draft)
        assert len(bundle.level_gaussians(0)) <= UNIT_LEAVES
        assert bundle.num_levels == division.top
        for number in range(bundle.num_levels):
            rows = unit.clusters[bundle.level_range(number)]
            assert (level[rows] == number).all()
        rows = [np.arange(*draft.clusters.offset[c : c + 2]) for c in unit.clusters]
        expected = draft.gaussians.subset(np.concatenate(rows))
        np.testing.assert_array_equal(bundle.gaussians.means, expected.means)
        np.testing.assert_array_equal(bundle.groups.ball, draft.groups.ball[unit.groups])


def test_the_part_above_begins_below_the_units_tops(draft):
    division = divided(draft, UNIT_LEAVES)
    upper = division.upper.of(draft)
    first = division.upper.first_level
    assert 1 <= first < division.top
    assert len(upper.level_gaussians(0)) <= UNIT_LEAVES
    assert upper.num_levels == draft.num_levels - first
    for level in range(upper.num_levels):
        expected = draft.level_gaussians(first + level).means
        np.testing.assert_array_equal(upper.level_gaussians(level).means, expected)


def test_a_bundle_that_fits_is_refined_as_a_whole(draft, device, tmp_path, monkeypatch):
    devices = devices_for(device)
    expected = with_refined_levels(draft, REQUEST, (), devices[0], progress=False)
    assert divided(draft, NUM_LEAVES) is None
    monkeypatch.setattr("v3dg.levels.refine_sizes.UNIT_LEAVES", NUM_LEAVES)
    refined = refined_bundle(draft, replace(REQUEST, seen_from="outside"), devices, False)
    assert "units" not in refined.config["refined"]
    expected.config = refined.config
    assert bytes_of(refined, tmp_path) == bytes_of(expected, tmp_path)


def test_a_tree_without_such_subtrees_is_refined_as_a_whole(asset):
    two_levels = replace(QUICK, min_gaussians=NUM_LEAVES // 2)
    bundle = v3dg.build_bundle(asset, config=two_levels, device="cpu", progress=False)
    assert bundle.num_levels == 2
    assert divided(bundle, UNIT_LEAVES) is None
    refined = refined_bundle(bundle, REQUEST, [CPU], progress=False)
    assert "units" not in refined.config["refined"]


@pytest.fixture(scope="module")
def refined(draft):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("v3dg.levels.refine_sizes.UNIT_LEAVES", UNIT_LEAVES)
        patch.setattr("v3dg.levels.refined._NUM_WEIGHING_PICTURES", 20)
        return refined_bundle(draft, REQUEST, [CPU], progress=False)


def test_level_0_and_the_tables_stay(draft, refined):
    assert refined.config["refined"] == REQUEST.record() | {"units": NUM_UNITS}
    for name, values in vars(draft.level_gaussians(0)).items():
        np.testing.assert_array_equal(values, getattr(refined.level_gaussians(0), name))
    for table in ("clusters", "groups"):
        for name, values in vars(getattr(draft, table)).items():
            if name not in ("box", "offset"):
                np.testing.assert_array_equal(values, getattr(getattr(refined, table), name))
    sizes, refined_sizes = (np.diff(bundle.clusters.offset) for bundle in (draft, refined))
    assert (refined_sizes <= sizes).all()
    assert refined_sizes.sum() < sizes.sum()
    boxes = _core.bound_by_boxes(refined.gaussians.rows, refined.clusters.offset)
    has_gaussians = refined_sizes > 0
    np.testing.assert_array_equal(refined.clusters.box[has_gaussians], boxes[has_gaussians])


def test_all_other_levels_move(draft):
    request = replace(REQUEST, steps=100, drop=0)
    refined = refined_bundle(draft, request, [CPU], progress=False)
    # The last level has one gaussian, which is in few cuts.
    for level in range(1, draft.num_levels - 1):
        means, moved = (bundle.level_gaussians(level).means for bundle in (draft, refined))
        assert means.shape == moved.shape
        assert not np.array_equal(means, moved)


def test_the_part_above_leaves_the_levels_of_units_alone(draft):
    """It is compared with the first of its levels, drawn with the filter of that level,
    and moves only the levels that no unit has."""
    division = divided(draft, UNIT_LEAVES)
    upper = division.upper.of(draft)
    first = division.top - division.upper.first_level
    assert first >= 2
    request = replace(REQUEST, steps=100)
    refined = with_refined_levels(
        upper, request, (), CPU, progress=False, first_level=first, target_px2=0.05
    )
    for level in range(upper.num_levels - 1):
        means, moved = (bundle.level_gaussians(level).means for bundle in (upper, refined))
        assert np.array_equal(means, moved) == (level < first)
    blurred = with_refined_levels(
        upper, request, (), CPU, progress=False, first_level=first, target_px2=1.0
    )
    assert not np.array_equal(refined.gaussians.means, blurred.gaussians.means)


def test_workers_and_files_do_not_change_the_bytes(draft, refined, file, tmp_path):
    expected = bytes_of(refined, tmp_path)
    opened = in_file(draft, tmp_path)
    for number, devices in enumerate(([CPU], [CPU] * 3)):
        folder = tmp_path / str(number)
        of_file = refined_bundle(opened, REQUEST, devices, progress=False, folder=folder)
        of_file.write(tmp_path / "out.v3dg")
        assert (tmp_path / "out.v3dg").read_bytes() == expected
        assert names_in(folder) == [f"{unit}.v3dg" for unit in range(NUM_UNITS + 1)]
        assert bytes_of(refined_bundle(draft, REQUEST, devices, False), tmp_path) == expected
    assert not opened.is_in_memory
    built, _ = build(file, tmp_path / "built.v3dg")
    assert built.config["refined"]["units"] == NUM_UNITS
    assert (tmp_path / "built.v3dg").read_bytes() == expected
    assert not units_folder(levels_path(tmp_path / "built.v3dg")).exists()


@pytest.mark.parametrize("codec", ["float32", "quantized"])
def test_both_codecs_are_refined_in_units(asset, tmp_path, codec):
    bundle = v3dg.build_bundle(asset, config=QUICK, codec=codec, device="cpu", progress=False)
    bundle.write(tmp_path / "draft.v3dg")
    opened = v3dg.Bundle.open(tmp_path / "draft.v3dg")
    of_file = refined_bundle(opened, REQUEST, [CPU], progress=False, folder=tmp_path / "units")
    of_file.write(tmp_path / "out.v3dg")
    in_memory = refined_bundle(bundle, REQUEST, [CPU], progress=False)
    assert in_memory.codec == codec
    assert (tmp_path / "out.v3dg").read_bytes() == bytes_of(in_memory, tmp_path)


class Interrupted(Exception):
    pass


def test_an_interrupted_refinement_continues_after_the_last_unit(
    refined, file, tmp_path, monkeypatch
):
    expected = bytes_of(refined, tmp_path)
    output = tmp_path / "out.v3dg"
    folder = units_folder(levels_path(output))
    refine = with_refined_levels
    calls = []
    most_calls = 0

    def counted(*arguments, **options):
        if len(calls) == most_calls:
            raise Interrupted
        calls.append(arguments)
        return refine(*arguments, **options)

    monkeypatch.setattr("v3dg.levels.refined_units.with_refined_levels", counted)
    with pytest.raises(Interrupted):
        build(file, output, resume=True)
    assert not folder.exists()
    for most_calls in (1, 3, NUM_UNITS):
        with pytest.raises(Interrupted):
            build(file, output, resume=True)
        assert names_in(folder) == [f"{unit}.v3dg" for unit in range(most_calls)]
        assert len(calls) == most_calls
    with monkeypatch.context() as patch:
        patch.setattr("v3dg.bundle.bundle.Bundle.write", lambda *_: 1 / 0)
        most_calls = NUM_UNITS + 2
        with pytest.raises(ZeroDivisionError):
            build(file, output, resume=True)
    assert build(file, output, resume=True)[1] is True
    assert output.read_bytes() == expected
    assert names_in(tmp_path) == ["bytes.v3dg", "out.v3dg"]
    assert build(file, output, resume=True)[1] is False


def test_units_of_another_refinement_are_made_again(draft, tmp_path):
    opened = in_file(draft, tmp_path)
    folder = tmp_path / "units"
    camera = v3dg.turntable((0, 0, 0), 3.0, 1, width=64, height=64)[0]
    for request in (
        REQUEST,
        replace(REQUEST, seed=4),
        replace(REQUEST, cameras=(camera,)),
        replace(REQUEST, cameras=(replace(camera, near=0.1),)),
    ):
        of_file = refined_bundle(opened, request, [CPU], progress=False, folder=folder)
        expected = refined_bundle(draft, request, [CPU], progress=False)
        np.testing.assert_array_equal(of_file.gaussians.means, expected.gaussians.means)


def test_a_build_that_starts_again_removes_units(file, tmp_path):
    output = tmp_path / "out.v3dg"
    levels = levels_path(output)
    build(file, output)
    output.rename(levels)
    folder = units_folder(levels)
    folder.mkdir()
    for name in ("0.v3dg", "12.v3dg", ".3.v3dg.0123456789abcdef.tmp", "notes.txt"):
        (folder / name).touch()
    discard_levels(levels)
    assert names_in(folder) == ["notes.txt"]


def test_a_damaged_unit_is_named(draft, tmp_path):
    opened = in_file(draft, tmp_path)
    folder = tmp_path / "units"
    refined_bundle(opened, REQUEST, [CPU], progress=False, folder=folder)
    (folder / "1.v3dg").write_bytes(b"something else")
    with pytest.raises(ValueError, match=r"1\.v3dg: "):
        refined_bundle(opened, REQUEST, [CPU], progress=False, folder=folder)


def test_the_bar_counts_all_units(draft, tmp_path):
    opened = in_file(draft, tmp_path)
    total = (NUM_UNITS + 1) * (20 + REQUEST.steps)
    folder = tmp_path / "units"
    states = []

    def note(*state):
        states.append(state)

    for _ in range(2):  # the second time, all units are there
        states.clear()
        refined_bundle(opened, REQUEST, [CPU], note, folder)
        assert {state[1] for state in states} == {total}
        numbers = [state[0] for state in states]
        assert numbers == sorted(numbers)
        assert numbers[-1] == total
        assert any(f"unit 2/{NUM_UNITS}" in state[2] for state in states)


@pytest.mark.parametrize("num_devices", [1, 3])
def test_what_a_progress_function_raises_ends_all_units(draft, num_devices):
    def stop(*_):
        raise Interrupted

    with pytest.raises(Interrupted):
        refined_bundle(draft, REQUEST, [CPU] * num_devices, stop)


def test_a_room_in_units_is_seen_from_inside(monkeypatch):
    monkeypatch.setattr("v3dg.levels.refine_sizes.UNIT_LEAVES", 900)
    bundle = v3dg.build_bundle(room(), config=QUICK, device="cpu", progress=False)
    refined = refined_bundle(bundle, REQUEST, [CPU], progress=False)
    record = refined.config["refined"]
    assert record["units"] == len(divided(bundle, 900).units) == 4
    assert record["eyes"] == 96


def test_cameras_of_a_unit_see_some_of_it(draft):
    camera = v3dg.turntable((0, 0, 0), 5.0, 1, width=64, height=64)[0]
    eye = camera.position
    outwards = v3dg.Camera.look_at(eye, 2 * eye, (0, 1, 0), width=64, height=64)
    assert cameras_that_see(draft, [camera, outwards]) == (camera,)
    assert cameras_that_see(draft, [outwards]) == (outwards,)
    assert cameras_that_see(draft, []) == ()


SCRIPT = f"""
import sys
from v3dg import BuildConfig
from v3dg.levels import build_file, quality, refine_sizes, refined
refine_sizes.UNIT_LEAVES = {UNIT_LEAVES}
refined._NUM_WEIGHING_PICTURES = 20
quality._LEAST_PICTURES = {REQUEST.steps}
quality._GAUSSIANS_PER_PICTURE = 1 << 40
build_file(
    sys.argv[1], sys.argv[2], config=BuildConfig(cluster_size=32, steps=0), seed=3,
    progress=False, device="cpu", quality="standard", resume=True,
)
"""


def test_a_refinement_that_is_killed_again_and_again_gets_to_its_end(file, tmp_path):
    """The bytes are those of a refinement in one go."""
    output = tmp_path / "out" / "out.v3dg"
    output.parent.mkdir()
    folder = units_folder(levels_path(output))
    arguments = [sys.executable, "-c", SCRIPT, file, output]
    environment = os.environ | {"PYTHONPATH": ":".join(map(str, sys.path))}
    num_kills = 0
    finished = set()
    while not output.exists():
        process = subprocess.Popen(arguments, env=environment)
        while process.poll() is None:
            names = {path.name for path in folder.glob("*.v3dg")}
            # The process may already write the result, which a kill would interrupt, if
            # the levels above the units are finished.
            if num_kills < len(names) <= NUM_UNITS:
                process.send_signal(signal.SIGKILL)
                assert finished < names
                finished = names
                num_kills += 1
                break
            time.sleep(0.001)
        process.wait()
    assert num_kills >= 2
    build(file, tmp_path / "one.v3dg")
    assert output.read_bytes() == (tmp_path / "one.v3dg").read_bytes()
    assert names_in(output.parent) == ["out.v3dg"]


def test_the_command_refines_in_units(draft, tmp_path, capsys):
    draft.write(tmp_path / "draft.v3dg")
    output = tmp_path / "refined.v3dg"
    command.run(
        command.Refine(
            bundle=tmp_path / "draft.v3dg",
            output=output,
            steps=REQUEST.steps,
            seed=REQUEST.seed,
            device="cpu",
            quiet=True,
        )
    )
    line = capsys.readouterr().out.strip()
    assert f"6 steps for each of {NUM_UNITS} units and the levels above them" in line
    expected = refined_bundle(draft, REQUEST, [CPU], progress=False)
    assert output.read_bytes() == bytes_of(expected, tmp_path)
    assert names_in(tmp_path) == ["bytes.v3dg", "draft.v3dg", "refined.v3dg"]


def refuses(work):
    with pytest.raises(RuntimeError, match=r"\.units: another refinement is using it; wait"):
        work()


def test_a_second_refinement_with_the_same_output_is_refused(draft, file, tmp_path):
    output = tmp_path / "out.v3dg"
    draft = in_file(draft, tmp_path)
    options = {"steps": REQUEST.steps, "device": "cpu", "progress": False}
    with locked_units(units_folder(output)) as folder:
        refuses(lambda: refine_file(draft, output, **options))
        refuses(lambda: v3dg.refine_bundle(draft, folder=folder, **options))
    assert names_in(tmp_path) == ["draft.v3dg"]
    refine_file(draft, output, **options)
    assert names_in(tmp_path) == ["draft.v3dg", "out.v3dg"]
    built = tmp_path / "built.v3dg"
    with locked_units(units_folder(levels_path(built))):
        refuses(lambda: build(file, built))


def test_a_lock_on_a_folder_that_was_removed_is_none(tmp_path, monkeypatch):
    """If a refinement ends and removes the folder that another one has opened, the lock
    of the latter would protect nothing."""
    folder = tmp_path / "out.units"
    locked = []

    def lock(descriptor, *_):
        if not locked:
            folder.rmdir()
        locked.append(os.fstat(descriptor))

    monkeypatch.setattr("v3dg._files.lock", lock)
    with locked_units(folder):
        assert os.path.samestat(locked[-1], folder.stat())
    assert len(locked) == 2
    assert names_in(tmp_path) == []


def test_a_failed_refinement_keeps_units_and_ends_the_lock(draft, tmp_path):
    draft = in_file(draft, tmp_path)
    (tmp_path / "out.units").mkdir()
    (tmp_path / "out.units" / "0.v3dg").write_bytes(b"none")
    with pytest.raises(ValueError, match=r"0\.v3dg"):
        refine_file(draft, tmp_path / "out.v3dg", steps=6, device="cpu", progress=False)
    with locked_units(tmp_path / "out.units"):
        assert names_in(tmp_path / "out.units") == ["0.v3dg"]
