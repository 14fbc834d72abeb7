"""The command `v3dg refine`."""

import json

import pytest

import v3dg
from command_line import fails, run
from v3dg.donut import make_donut


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("refine")
    asset = make_donut(2000)
    v3dg.write_asset(folder / "donut.ply", asset)
    config = v3dg.BuildConfig(steps=0, cluster_size=128)
    v3dg.build_bundle(asset, config=config, device="cpu", progress=False).write(
        folder / "donut.v3dg"
    )
    v3dg.write_cameras(folder / "eyes.json", {"front": v3dg.turntable((0, 0, 0), 3, 1)[0]})
    return folder


def test_a_bundle_is_refined(folder):
    options = ("--steps", 5, "--drop", 0, "--seed", 3, "--device", "cpu")
    done = run("refine", "donut.v3dg", "refined.v3dg", *options, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert (result["output"], result["steps"]) == ("refined.v3dg", 5)
    written = v3dg.Bundle.open(folder / "refined.v3dg")
    assert written.config["refined"] == {"steps": 5, "drop": 0, "seed": 3}
    assert written.num_gaussians == v3dg.Bundle.open(folder / "donut.v3dg").num_gaussians


def test_info_tells_how_levels_were_built_from_how_they_were_refined(folder):
    """The settings of both are shown, even if a setting of the refinement has the name
    and the default of one of the build."""
    bundle = v3dg.Bundle.open(folder / "donut.v3dg")
    about = {"refined": {"steps": v3dg.BuildConfig().steps, "drop": 0.1, "seed": 3}}
    config = bundle.config | about
    v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, config).write(
        folder / "told.v3dg"
    )
    text = " ".join(run("info", "told.v3dg", cwd=folder).stdout.split())
    assert f"refined drop=0.1, refined seed=3, refined steps={about['refined']['steps']}" in text
    assert " steps=0," in text
    assert text.count(" seed=") == 2


def test_cameras_say_from_where(folder):
    options = ("--steps", 2, "--cameras", "eyes.json", "--device", "cpu", "--quiet")
    done = run("refine", "donut.v3dg", "seen.v3dg", *options, cwd=folder)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert done.stdout.startswith("seen.v3dg: 2 steps, ")
    assert v3dg.Bundle.open(folder / "seen.v3dg").config["refined"]["cameras"] == 1


def test_lens_distortion_is_left_out_if_told(folder):
    """Most camera models of COLMAP have a lens with distortion."""
    document = json.loads((folder / "eyes.json").read_text())
    (folder / "bent.json").write_text(json.dumps(document | {"camera_model": "OPENCV", "k1": 0.1}))
    command = (
        "refine",
        "donut.v3dg",
        "bent.v3dg",
        "--steps",
        1,
        "--cameras",
        "bent.json",
        "--device",
        "cpu",
    )
    fails(1, "expected a pinhole, got OPENCV with distortion", *command, cwd=folder)
    done = run(*command, "--distortion", "ignore", cwd=folder)
    assert done.returncode == 0, done.stderr
    assert v3dg.Bundle.open(folder / "bent.v3dg").config["refined"]["cameras"] == 1


def test_what_cannot_be_meant_is_told(folder):
    (folder / "no_eyes.json").write_text('{"frames": []}')
    before = sorted(folder.iterdir())
    fails(
        2,
        "an output that is not the input donut.v3dg",
        "refine",
        "donut.v3dg",
        "donut.v3dg",
        cwd=folder,
    )
    fails(
        2,
        "x.ply: expected a file name ending in .v3dg",
        "refine",
        "donut.v3dg",
        "x.ply",
        cwd=folder,
    )
    fails(1, "a file ending in .v3dg, got a .ply", "refine", "donut.ply", "x.v3dg", cwd=folder)
    fails(1, "Not a directory", "refine", "donut.v3dg", "donut.v3dg/x.v3dg", cwd=folder)
    fails(
        1,
        "steps: expected at least 1 step",
        "refine",
        "donut.v3dg",
        "x.v3dg",
        "--steps",
        0,
        cwd=folder,
    )
    fails(1, "none.json", "refine", "donut.v3dg", "x.v3dg", "--cameras", "none.json", cwd=folder)
    found = "cameras, got a file with none"
    fails(1, found, "refine", "donut.v3dg", "x.v3dg", "--cameras", "no_eyes.json", cwd=folder)
    assert sorted(folder.iterdir()) == before
