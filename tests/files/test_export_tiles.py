"""3D Tiles of bundles and scenes, and `.glb` files; browser/test_export_browser.py
opens them in CesiumJS."""

import json
import math
import os

import numpy as np
import pytest

import v3dg
from command_line import fails, run
from random_bundle import random_bundle
from v3dg.export import write_tiles

SSE = 16 / math.sqrt(3)


def tiles_of(tile, depth=0):
    """Return a tile and all tiles below it."""
    yield tile
    for child in tile.get("children", []):
        yield from tiles_of(child)


def corners(tile):
    box = np.array(tile["boundingVolume"]["box"])
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    return box[:3] + signs @ box[3:].reshape(3, 3)


def assert_inside(points, tile):
    box = np.array(tile["boundingVolume"]["box"])
    half = np.diag(box[3:].reshape(3, 3))
    assert (np.abs(points - box[:3]) <= half * (1 + 1e-6) + 1e-6).all()


def upright(gaussians):
    """Return the means of a tile's content, whose y is up, in the tile's frame, whose z
    is up."""
    # reading a `.glb` rotates the gaussians by half a turn about z
    in_file = gaussians.means * [-1, -1, 1]
    return in_file[:, [0, 2, 1]] * [1, -1, 1]


@pytest.fixture(params=range(4))
def bundle(request):
    return random_bundle(request.param, num_levels=1 + request.param, sh_degree=request.param)


def bundle_tree(folder):
    return json.loads((folder / "bundle" / "tileset.json").read_text())


def test_any_depth_of_tiles_is_a_level_of_the_bundle(tmp_path, bundle):
    """Replacing all tiles of one height by their children gives the level below, and
    nothing is lost."""
    write_tiles(bundle, tmp_path / "tiles")
    front = [bundle_tree(tmp_path / "tiles")["root"]]
    if "content" not in front[0]:
        front = front[0]["children"]
    for level in reversed(range(bundle.num_levels)):
        files = [tile["content"]["uri"] for tile in front if "content" in tile]
        found = np.concatenate(
            [upright(v3dg.read_asset(tmp_path / "tiles/bundle" / f)) for f in files]
        )
        wanted = bundle.level_gaussians(level).means
        np.testing.assert_allclose(
            *(m[np.lexsort(m.round(3).T)] for m in (found, wanted)), atol=2e-3
        )
        front = [child for tile in front for child in tile.get("children", [])]
    assert front == []


def test_tiles_hold_what_is_below_them(tmp_path, bundle):
    write_tiles(bundle, tmp_path / "tiles")
    root = bundle_tree(tmp_path / "tiles")["root"]
    assert root["refine"] == "REPLACE"
    for tile in tiles_of(root):
        if "content" in tile:
            assert_inside(
                upright(v3dg.read_asset(tmp_path / "tiles/bundle" / tile["content"]["uri"])), tile
            )
        for child in tile.get("children", []):
            assert_inside(corners(child), tile)
            assert child["geometricError"] <= tile["geometricError"]


def test_a_tile_is_replaced_where_selection_would_replace_its_group(tmp_path, bundle):
    """At the same distance, a screen-space error of 16 px corresponds to the tolerance
    of 3 px²."""
    write_tiles(bundle, tmp_path / "tiles")
    groups = bundle.groups
    found = {
        int(tile["content"]["uri"].split("_")[1].split(".")[0]): tile["geometricError"]
        for tile in tiles_of(bundle_tree(tmp_path / "tiles")["root"])
        if tile.get("content", {}).get("uri", "0").split("_")[0] not in ("0", "asset.glb")
    }
    for g, error in found.items():
        # so far away that the solid angle of a ball equals that of a disc
        focal, distance = 900.0, 1e4
        footprint = math.pi * (groups.ball[g, 3] * focal / distance) ** 2 * groups.weight[g]
        assert (error * focal / distance / 16) ** 2 == pytest.approx(footprint / 3, rel=1e-5)


def test_a_scene_is_a_tile_an_instance(tmp_path):
    bundles = [random_bundle(seed, num_levels=3) for seed in (1, 2)]
    scene = v3dg.Scene()
    turns = [[1, 0, 0, 0], [0.5, 0.5, -0.5, 0.5], [1, 0, 0, 1]]
    scene.add([bundles[0], bundles[1], bundles[0]], np.eye(3) * 9, turns, [1, 2, 0.5])
    done = write_tiles(scene, tmp_path / "a/b")
    assert (done.bundles, done.instances) == (2, 3)
    assert done.tiles == sum(1 for _ in (tmp_path / "a/b").rglob("*.glb"))
    root = json.loads((tmp_path / "a/b/tileset.json").read_text())["root"]
    # A tileset without rotation: z is up.
    np.testing.assert_allclose(np.reshape(root["transform"], (4, 4)), np.eye(4), atol=1e-12)
    assert len(root["children"]) == 3
    for i, tile in enumerate(root["children"]):
        matrix = np.reshape(tile["transform"], (4, 4)).T
        np.testing.assert_allclose(matrix[:3, :3], scene.scales[i] * scene.rotations[i], atol=1e-12)
        np.testing.assert_allclose(matrix[:3, 3], scene.positions[i])
        below = json.loads((tmp_path / "a/b" / tile["content"]["uri"]).read_text())
        assert below["root"]["boundingVolume"] == tile["boundingVolume"]
        assert_inside(corners(tile) @ matrix[:3, :3].T + matrix[:3, 3], root)
        assert below["extensionsRequired"] == ["3DTILES_content_gltf"]


def test_the_page_frames_the_finest_level(tmp_path):
    """The coarse gaussians reach far beyond the finest ones. If the web page framed
    them, the asset would be tiny in the first view."""
    bundle = random_bundle(3, num_levels=4)
    scene = v3dg.Scene()
    scene.add(bundle, [[5, 0, 0], [0, 9, 1]], [1, 0, 0, 0], [2, 1])
    write_tiles(scene, tmp_path / "tiles", up="z")
    document = json.loads((tmp_path / "tiles" / "tileset.json").read_text())
    corners = bundle.clusters.box[np.array(bundle.level_range(0))].reshape(-1, 3)
    placed = np.concatenate([2 * corners + np.array([5, 0, 0]), corners + np.array([0, 9, 1])])
    low = placed.min(axis=0)
    high = placed.max(axis=0)
    ball = [*((low + high) / 2), np.linalg.norm(high - low) / 2]
    np.testing.assert_allclose(document["extras"]["ball"], ball, rtol=1e-5)


def test_up_is_up(tmp_path):
    write_tiles(random_bundle(3), tmp_path / "tiles", up="-y")
    root = json.loads((tmp_path / "tiles/tileset.json").read_text())["root"]
    turn = np.reshape(root["transform"], (4, 4)).T[:3, :3]
    np.testing.assert_allclose(turn @ [0, -1, 0], [0, 0, 1], atol=1e-12)


def test_the_command_says_how_to_look_at_tiles(tmp_path):
    random_bundle(3).write(tmp_path / "a.v3dg")
    done = run("export", "a.v3dg", "--to", "tiles", "--quiet", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "cp -r node_modules/cesium/Build/Cesium a_web/cesium" in done.stdout
    assert {"index.html", "tileset.json", "v3dg-export.json", "a"} == set(
        os.listdir(tmp_path / "a_web")
    )
    (tmp_path / "a_web" / "cesium").mkdir()
    (tmp_path / "a_web" / "cesium" / "Cesium.js").touch()
    again = run("export", "a.v3dg", "--to", "tiles", "--quiet", cwd=tmp_path)
    assert "npm" not in again.stdout
    assert (tmp_path / "a_web" / "cesium" / "Cesium.js").is_file()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").touch()
    fails(
        1,
        "mine: expected a new folder",
        "export",
        "a.v3dg",
        "--to",
        "tiles",
        "-o",
        "mine",
        cwd=tmp_path,
    )
    with pytest.raises(
        ValueError, match="bundle: expected at least one gaussian to export, got none"
    ):
        write_tiles(random_bundle(num_levels=0), tmp_path / "none")
    assert sorted(os.listdir(tmp_path)) == ["a.v3dg", "a_web", "mine"]
