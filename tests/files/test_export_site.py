"""`v3dg export` writes scenes and bundles as web pages; browser/test_export_browser.py
opens them in a browser."""

import json
import os

import numpy as np
import pytest

import v3dg
from command_line import fails, run
from random_bundle import random_bundle, random_gaussians
from v3dg.export import write_site
from v3dg.rotations import rotation_from_quaternion


@pytest.fixture
def place(tmp_path, monkeypatch):
    """An empty folder with two bundles, and a scene of three instances with a
    camera."""
    monkeypatch.chdir(tmp_path)
    for seed in (1, 2):
        random_bundle(seed, num_levels=2 + seed, sh_degree=seed).write(f"a b{seed}.v3dg")
    bundles = [v3dg.Bundle.open(f"a b{seed}.v3dg") for seed in (1, 2)]
    scene = v3dg.Scene()
    turns = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [1, 0, 0, 1]]
    scene.add([bundles[0], bundles[1], bundles[0]], np.eye(3) * 9, turns, [1, 2, 0.5], [1, 4, 1])
    camera = v3dg.Camera.look_at((3, -20, 5), (1, 2, 0), width=640, height=480)
    v3dg.write_scene("town.json", scene, ["a b1.v3dg", "a b2.v3dg"], {"gate": camera})
    return tmp_path


def site_of(folder):
    return json.loads((folder / "site.json").read_text())


def test_a_scene_has_each_bundle_once_with_all_levels(place):
    done = run("export", "town.json", "-o", "deep/er/site", "--json", "--quiet", cwd=place)
    assert done.returncode == 0, done.stderr
    result, site = json.loads(done.stdout), site_of(place / "deep/er/site")
    scene, _ = v3dg.read_scene("town.json")
    assert (result["bundles"], result["instances"], result["has_engine"]) == (2, 3, False)
    for listed, bundle in zip(site["bundles"], scene.bundles, strict=True):
        index = json.loads((place / "deep/er/site" / listed["url"]).read_text())
        assert index["counts"] == listed["counts"]
        counts = [len(bundle.level_gaussians(i)) for i in range(bundle.num_levels)]
        # Chunks are divided further, down to one gaussian each.
        assert index["counts"][: len(counts)] == counts
        assert index["counts"][-1] == json.dumps(index["tree"]).count('"lods"')
    for level, name in ((0, "gaussians"), (-1, "coarsest")):
        counts = [listed["counts"][level] for listed in site["bundles"]]
        assert result[name] == sum(counts[b] for b in scene.instance_bundle)


def test_a_scene_has_its_instances_and_cameras(place):
    scene, cameras = v3dg.read_scene("town.json")
    write_site(scene, "site", cameras)
    site = site_of(place / "site")
    found = site["instances"]
    assert found["bundle"] == scene.instance_bundle.tolist()
    for name in ("positions", "quaternions", "scales", "importance"):
        np.testing.assert_allclose(found[name], getattr(scene, name).ravel(), rtol=1e-8)
    for name in ("rotation", "camera_rotation"):
        # The site has y up, so z becomes y.
        np.testing.assert_allclose(np.array(site[name]).T @ [0, 0, 1], [0, 1, 0], atol=1e-12)
    view, camera = site["cameras"][0], cameras["gate"]
    assert view["name"] == "gate"
    np.testing.assert_allclose(view["position"], [3, -20, 5])
    right, down, forward = np.array(view["axes"])
    towards = np.array([1, 2, 0]) - [3, -20, 5]
    np.testing.assert_allclose(forward, towards / np.linalg.norm(towards), atol=1e-12)
    np.testing.assert_allclose(np.cross(right, down), forward, atol=1e-12)
    assert down[2] < 0
    assert np.tan(view["fov_y"] / 2) * camera.fy == pytest.approx(240)


@pytest.mark.parametrize("up", ["x", "y", "z", "-x", "-y", "-z"])
def test_what_is_up_is_up_in_the_page(place, up):
    """In the files of a single bundle y points down; the web page rotates them so that
    y points up."""
    bundle = v3dg.Bundle.open("a b1.v3dg")
    write_site(bundle, "site", up=up)
    written = v3dg.read_asset("site/lod-meta.json").means @ np.array(
        site_of(place / "site")["rotation"]
    )
    axis, sign = "xyz".index(up[-1]), -1 if up[0] == "-" else 1
    heights = sign * bundle.level_gaussians(0).means[:, axis]
    np.testing.assert_allclose(np.sort(written[:, 1]), np.sort(heights), atol=1e-3)


def test_an_asset_of_one_level_has_coarser_ones_that_begin_somewhere(place):
    bundle = random_bundle(5, num_levels=1)
    write_site(bundle, "site")
    (listed,) = site_of(place / "site")["bundles"]
    assert listed["counts"][0] == bundle.num_gaussians
    assert listed["counts"][-1] == 1
    assert listed["reach"] > 0


def test_levels_reach_as_far_as_selection_has_them():
    """Beyond `reach` times the focal length over √tolerance, half of the groups of
    level 1 suffice."""
    bundle = random_bundle(3, num_levels=5)
    detail = v3dg.export._common.detail_of(bundle)
    first = bundle.groups.level == 1
    radius, weight = bundle.groups.ball[first, 3], bundle.groups.weight[first]
    focal, tolerance = 700.0, 3.0
    distance = focal * detail["reach"] / np.sqrt(tolerance)
    fits = np.pi * (radius / distance) ** 2 * focal**2 * weight <= tolerance * (1 + 1e-6)
    assert 0.5 <= fits.mean() <= 0.5 + 1 / len(fits)
    assert detail["ratio"] >= 1.2


def test_the_engine_is_brought_from_npm_and_kept(place):
    build = place / "node_modules/playcanvas/build"
    build.mkdir(parents=True)
    (build / "playcanvas.min.mjs").write_text("engine")
    bundle = v3dg.Bundle.open("a b1.v3dg")
    assert write_site(bundle, "site").has_engine
    (build / "playcanvas.min.mjs").unlink()
    # the engine of the export that this one replaces
    assert write_site(bundle, "site", chunk=10**6).has_engine
    assert (place / "site/playcanvas.min.mjs").read_text() == "engine"


def test_the_command_says_how_to_look_at_it(place):
    done = run("export", "a b1.v3dg", "--quiet", cwd=place)
    assert done.returncode == 0, done.stderr
    assert "npm install playcanvas@" in done.stdout
    assert "python -m http.server --bind 127.0.0.1 --directory 'a b1_web'" in done.stdout
    assert "http://127.0.0.1:8000/" in done.stdout
    names = set(os.listdir(place / "a b1_web"))
    assert {"index.html", "site.json", "lod-meta.json", "settings.json", "0_0"} < names


def test_bad_input_is_named_and_nothing_is_left(place):
    (place / "town.txt").touch()
    v3dg.write_asset("asset.ply", random_gaussians(np.random.default_rng(0), 5))
    before = sorted(os.listdir(place))
    fails(
        2, "--chunk: expected at least 1, got 0", "export", "a b1.v3dg", "--chunk", "0", cwd=place
    )
    fails(1, "expected a file ending in", "export", "town.txt", cwd=place)
    fails(
        1,
        "got an asset; build a bundle from it with v3dg build asset.ply",
        "export",
        "asset.ply",
        cwd=place,
    )
    fails(
        1, "chunk: expected at least", "export", "a b1.v3dg", "-o", "x/y", "--chunk", "1", cwd=place
    )
    with pytest.raises(
        ValueError, match="scene: expected at least one instance to export, got none"
    ):
        write_site(v3dg.Scene(), "site")
    scene, cameras = v3dg.read_scene("town.json")
    with pytest.raises(
        TypeError, match=r"cameras: expected a mapping from names to cameras.*, got list"
    ):
        write_site(scene, "site", list(cameras.values()))
    with pytest.raises(ValueError, match="up: expected 'x' or"):
        write_site(v3dg.Bundle.open("a b1.v3dg"), "site", up="up")
    assert sorted(os.listdir(place)) == before


def test_rotations_of_the_page_are_rotations():
    for up in ("x", "y", "z", "-x", "-y", "-z"):
        for frame in ("y", "z"):
            turn = v3dg.export._common.rotation_to(up, frame)
            np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
            assert np.linalg.det(turn) == pytest.approx(1)
    identity = rotation_from_quaternion(np.array([1.0, 0, 0, 0]))
    np.testing.assert_allclose(v3dg.export._common.rotation_to("z", "z"), identity, atol=1e-12)
