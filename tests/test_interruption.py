"""Builds that are killed at any moment: what they leave, and what resuming makes of it.

V3DG_KILLS sets how many are killed; docs/notes/robustness.md has the record of a long run.
"""

import os
import random
import subprocess
import sys
import time
from pathlib import Path

import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset

KILLS = int(os.environ.get("V3DG_KILLS", "3"))
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(v3dg.__file__).parent.parent)}
BUILD = [sys.executable, "-m", "v3dg", "build", "asset.ply", "-o", "out.v3dg", "--quiet"]


def started(folder, *options):
    return subprocess.Popen(
        [*BUILD, *options],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(folder, *options):
    process = started(folder, *options)
    _, errors = process.communicate()
    assert process.returncode == 0, errors


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """The bundle of a build that nothing interrupts, and the seconds it took."""
    folder = tmp_path_factory.mktemp("whole")
    v3dg.write_asset(folder / "asset.ply", make_asset(num_gaussians=2000, seed=0))
    start = time.perf_counter()
    finished(folder)
    return (
        (folder / "asset.ply").read_bytes(),
        (folder / "out.v3dg").read_bytes(),
        time.perf_counter() - start,
    )


def test_killed_builds_leave_nothing_or_all_and_resume_to_the_same_bytes(whole, tmp_path):
    asset, expected, seconds = whole
    (tmp_path / "asset.ply").write_bytes(asset)
    rng = random.Random(0)
    output = tmp_path / "out.v3dg"
    seen = {"killed": 0, "absent": 0, "whole": 0, "to resume": 0, "temporary": 0}
    while seen["killed"] < KILLS:
        process = started(tmp_path, "--resume")
        time.sleep(rng.uniform(0, 1.1 * seconds))
        process.kill()
        process.communicate()
        seen["killed"] += process.returncode != 0
        names = {path.name for path in tmp_path.iterdir()} - {"asset.ply", "out.v3dg", "out.v3dg.partial"}
        # What a bundle or a picture is written to before it gets its name.
        assert all(name.startswith(".out.v3dg.") and name.endswith(".tmp") for name in names), names
        seen["temporary"] += len(names)
        seen["to resume"] += (tmp_path / "out.v3dg.partial").exists()
        if output.exists():
            assert output.read_bytes() == expected
            seen["whole"] += 1
            output.unlink()
        else:
            seen["absent"] += 1
        for name in names:
            (tmp_path / name).unlink()
    finished(tmp_path, "--resume")
    assert output.read_bytes() == expected
    assert sorted(os.listdir(tmp_path)) == ["asset.ply", "out.v3dg"]
    print(seen)  # for the record, with `pytest -s`


def test_two_builds_to_one_path_do_not_disturb_each_other(whole, tmp_path):
    asset, expected, _ = whole
    (tmp_path / "asset.ply").write_bytes(asset)
    processes = [started(tmp_path) for _ in range(2)]
    errors = [process.communicate()[1] for process in processes]
    refused = [error for process, error in zip(processes, errors, strict=True) if process.returncode != 0]
    assert len(refused) < 2
    assert all("out.v3dg.partial: another build is using it" in error for error in refused)
    assert (tmp_path / "out.v3dg").read_bytes() == expected
    assert sorted(os.listdir(tmp_path)) == ["asset.ply", "out.v3dg"]
