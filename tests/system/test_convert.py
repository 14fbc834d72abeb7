"""`v3dg convert` writes assets, levels and cuts in every format that can be written."""

import json
import zipfile

import numpy as np
import pytest

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import fails, run


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with an asset, a bundle and a scene of two instances and two cameras."""
    folder = tmp_path_factory.mktemp("convert")
    asset = make_asset(2000)
    v3dg.write_asset(folder / "tuft.ply", asset)
    v3dg.build_bundle(
        asset, config=v3dg.BuildConfig(cluster_size=64, steps=0), progress=False
    ).write(folder / "tuft.v3dg")
    scene = {
        "format": "v3dg-scene",
        "version": 1,
        "bundles": {"tuft": "tuft.v3dg"},
        "instances": [{"bundle": "tuft", "position": [3 * i, 0, 0]} for i in range(2)],
        "cameras": [
            {"name": "near", "width": 64, "height": 48, "eye": [0, -4, 2], "target": [0, 0, 0.4]},
            {"name": "far", "width": 64, "height": 48, "eye": [0, -60, 9], "target": [1.5, 0, 0]},
        ],
    }
    (folder / "scene.json").write_text(json.dumps(scene))
    return folder


def converted(folder, *arguments):
    done = run("convert", *arguments, "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    result = json.loads(done.stdout)
    assert result["bytes"] == (folder / arguments[1]).stat().st_size
    return result, v3dg.read_asset(folder / arguments[1])


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog", ".glb"])
def test_an_asset_becomes_any_format_and_that_a_ply(folder, suffix):
    asset = v3dg.read_asset(folder / "tuft.ply")
    result, _ = converted(folder, "tuft.ply", f"a{suffix}")
    assert result["gaussians"] == len(asset)
    assert result["sh_degree"] == asset.sh_degree
    _, back = converted(folder, f"a{suffix}", "back.ply")
    np.testing.assert_allclose(back.means.mean(axis=0), asset.means.mean(axis=0), atol=1e-3)


def test_versions_of_spz(folder):
    sizes = {
        v: converted(folder, "tuft.ply", "a.spz", "--spz-version", v)[0]["bytes"] for v in (2, 3, 4)
    }
    assert sizes[2] < sizes[3]
    fails(
        2,
        "--spz-version: expected a .spz as output",
        "convert",
        "tuft.ply",
        "a.sog",
        "--spz-version",
        4,
        cwd=folder,
    )
    fails(2, "--spz-version", "convert", "tuft.ply", "b.spz", "--spz-version", 5, cwd=folder)


def test_a_level_of_a_bundle(folder):
    bundle = v3dg.Bundle.open(folder / "tuft.v3dg")
    for level in (None, 0, bundle.num_levels - 1):
        arguments = [] if level is None else ["--level", level]
        result, gaussians = converted(folder, "tuft.v3dg", "level.ply", *arguments)
        assert result["level"] == (level or 0)
        np.testing.assert_array_equal(gaussians.means, bundle.level_gaussians(level or 0).means)


def test_a_bundle_becomes_one_of_another_codec_and_back(folder):
    def write(*arguments):
        done = run("convert", *arguments, "--json", cwd=folder)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)["codec"]

    assert write("tuft.v3dg", "same.v3dg") == "float32"
    assert (folder / "same.v3dg").read_bytes() == (folder / "tuft.v3dg").read_bytes()
    assert write("tuft.v3dg", "small.v3dg", "--codec", "quantized") == "quantized"
    assert (folder / "small.v3dg").stat().st_size < (folder / "tuft.v3dg").stat().st_size / 3
    assert write("small.v3dg", "again.v3dg") == "quantized"
    assert (folder / "again.v3dg").read_bytes() == (folder / "small.v3dg").read_bytes()
    assert write("small.v3dg", "back.v3dg", "--codec", "float32") == "float32"
    small, back = (v3dg.Bundle.open(folder / name) for name in ("small.v3dg", "back.v3dg"))
    np.testing.assert_array_equal(back.gaussians.means, small.gaussians.means)
    assert write("back.v3dg", "again.v3dg", "--codec", "quantized") == "quantized"
    assert (folder / "again.v3dg").read_bytes() == (folder / "small.v3dg").read_bytes()
    text = run("info", "small.v3dg", cwd=folder).stdout
    assert "bundle, version 3 (quantized)" in text


def test_the_cut_of_a_bundle_for_a_turntables_camera(folder):
    result, fine = converted(folder, "tuft.v3dg", "cut.ply", "--tolerance", "0")
    _, coarse = converted(folder, "tuft.v3dg", "cut.ply", "--budget", 500)
    bundle = v3dg.Bundle.open(folder / "tuft.v3dg")
    assert len(coarse) <= 500 < len(fine) <= len(bundle.level_gaussians(0))
    assert result["tolerance"] == 0


def test_the_cut_of_a_scene_for_one_of_its_cameras(folder):
    scene, cameras = v3dg.read_scene(folder / "scene.json")
    for outside, cull in (("drop", True), ("keep", False)):
        result, gaussians = converted(
            folder,
            "scene.json",
            "cut.ply",
            "--camera",
            "near",
            "--tolerance",
            "2",
            "--outside",
            outside,
        )
        wanted = v3dg.select(scene, cameras["near"], tolerance=2, cull=cull, device="cpu")
        assert result["clusters"] == len(wanted)
        np.testing.assert_array_equal(gaussians.means, wanted.gaussians(device="cpu").means)


def test_cameras_of_a_file(folder):
    camera = v3dg.Camera.look_at((0, -30, 2), (0, 0, 0), (0, 0, 1), fov_x=0.8, width=64, height=48)
    v3dg.write_cameras(folder / "transforms.json", {"a": camera})
    _, gaussians = converted(folder, "tuft.v3dg", "cut.ply", "--cameras", "transforms.json")
    wanted = v3dg.select(v3dg.Bundle.open(folder / "tuft.v3dg"), camera, device="cpu")
    assert len(gaussians) == wanted.num_gaussians


def test_a_camera_that_sees_nothing_gives_an_empty_file(folder):
    camera = v3dg.Camera.look_at(
        (0, -30, 2), (0, -60, 2), (0, 0, 1), fov_x=0.8, width=64, height=48
    )
    v3dg.write_cameras(folder / "away.json", {"a": camera})
    _, gaussians = converted(folder, "tuft.v3dg", "nothing.spz", "--cameras", "away.json")
    assert len(gaussians) == 0


def test_what_cannot_be_meant_is_refused(folder):
    fails(2, "--level: expected 0 to", "convert", "tuft.v3dg", "x.ply", "--level", "99", cwd=folder)
    fails(
        2,
        "--level: expected no scene, camera, tolerance or budget together with it",
        "convert",
        "tuft.v3dg",
        "x.ply",
        "--level",
        "1",
        "--budget",
        "9",
        cwd=folder,
    )
    fails(
        2,
        "expected a bundle or a scene, got an asset",
        "convert",
        "tuft.ply",
        "x.ply",
        "--level",
        "1",
        cwd=folder,
    )
    fails(
        2,
        "--camera: expected exactly one camera, got 2",
        "convert",
        "scene.json",
        "x.ply",
        cwd=folder,
    )
    fails(
        1,
        "x.obj: expected a file name that ends in .compressed.ply, .ply,",
        "convert",
        "tuft.ply",
        "x.obj",
        cwd=folder,
    )
    fails(
        2,
        "--views: expected exactly one camera",
        "convert",
        "tuft.v3dg",
        "x.ply",
        "--views",
        "3",
        cwd=folder,
    )
    fails(2, "expected a bundle as input", "convert", "tuft.ply", "x.v3dg", cwd=folder)
    fails(
        2,
        "without options that select or change a part",
        "convert",
        "tuft.v3dg",
        "x.v3dg",
        "--level",
        "1",
        cwd=folder,
    )
    fails(
        2,
        "--codec: expected an output",
        "convert",
        "tuft.ply",
        "x.ply",
        "--codec",
        "float32",
        cwd=folder,
    )
    fails(1, "Not a directory", "convert", "tuft.ply", "tuft.v3dg/x.ply", cwd=folder)
    options = ("--camera", "far", "--budget", "1")
    fails(1, "budget: expected at least", "convert", "scene.json", "x.ply", *options, cwd=folder)


def test_the_meta_json_of_an_asset_is_no_scene(folder):
    (folder / "sog").mkdir()
    v3dg.write_asset(folder / "a.sog", v3dg.read_asset(folder / "tuft.ply"))
    with zipfile.ZipFile(folder / "a.sog") as bundle:
        bundle.extractall(folder / "sog")
    for command in (["info"], ["render", "-o", "picture.png", "--size", 64, 48]):
        done = run(command[0], "sog/meta.json", *command[1:], "--json", cwd=folder)
        assert done.returncode == 0, done.stderr
    result, _ = converted(folder, "sog/meta.json", "back.ply")
    assert result["gaussians"] == 2000
