"""The names of files are accepted by `v3dg.open`, and by functions that take a bundle,
a scene or an asset."""

import json

import numpy as np
import pytest

import v3dg
from random_bundle import random_bundle


@pytest.fixture
def bundle():
    return random_bundle(0)


@pytest.fixture
def camera():
    return v3dg.turntable((0, 0, 0), 4, 1, width=48, height=32)[0]


def test_open_gives_what_the_name_says(bundle, camera, tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", bundle.level_gaussians(0))
    bundle.write(tmp_path / "a.v3dg")
    scene = v3dg.Scene()
    scene.add(v3dg.open(tmp_path / "a.v3dg"), positions=[[0, 0, 0], [3, 0, 0]])
    scene.save(tmp_path / "a.json", {"front": camera})
    assert isinstance(v3dg.open(str(tmp_path / "a.ply")), v3dg.Gaussians)
    assert isinstance(v3dg.open(tmp_path / "a.v3dg"), v3dg.Bundle)
    assert len(v3dg.open(tmp_path / "a.json")) == 2
    with pytest.raises(ValueError, match=r"a\.txt: expected a file name that ends in"):
        v3dg.open(tmp_path / "a.txt")


def test_files_stand_for_what_is_in_them(bundle, camera, tmp_path):
    asset, file, scene = (str(tmp_path / name) for name in ("a.ply", "a.v3dg", "a.json"))
    v3dg.write_asset(asset, bundle.level_gaussians(0))
    bundle.write(file)
    placed = v3dg.Scene()
    placed.add(file, positions=[[0, 0, 0], [3, 0, 0]])
    placed.save(scene, {"front": camera})
    for path in (tmp_path / "a.ply", asset, file, scene):
        for draw in (
            lambda what: v3dg.render(what, camera, device="cpu"),
            lambda what: v3dg.Renderer(what, device="cpu").render(camera),
        ):
            np.testing.assert_array_equal(draw(path).color, draw(v3dg.open(path)).color)
    for path in (file, scene):
        for chosen in (
            lambda what: v3dg.select(what, camera, device="cpu").cluster_ids,
            lambda what: v3dg.pick(what, camera, 24, 16),
        ):
            np.testing.assert_equal(chosen(path), chosen(v3dg.open(path)))
        v3dg.write_tiles(path, tmp_path / "tiles")
        v3dg.write_site(path, tmp_path / "site")
    assert (
        json.loads((tmp_path / "site" / "site.json").read_text())["cameras"][0]["name"] == "front"
    )
    v3dg.write_streamed_sog(file, tmp_path / "sog")
    drawn = v3dg.rasterize(asset, camera)
    np.testing.assert_array_equal(drawn.color, v3dg.rasterize(v3dg.open(asset), camera).color)
    config = v3dg.BuildConfig(steps=0)
    built = v3dg.build_bundle(asset, config=config, device="cpu", progress=False)
    assert built.config == v3dg.build_bundle(v3dg.open(asset), config=config, device="cpu").config
    v3dg.write_asset(tmp_path / "b.ply", asset)
    assert (tmp_path / "b.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()


def test_files_of_another_kind_are_named(bundle, camera, tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", bundle.level_gaussians(0))
    for call in (
        lambda: v3dg.select(tmp_path / "a.ply", camera),
        lambda: v3dg.write_site(tmp_path / "a.ply", tmp_path / "site"),
        lambda: v3dg.write_tiles(tmp_path / "a.ply", tmp_path / "tiles"),
        lambda: v3dg.write_streamed_sog(tmp_path / "a.ply", tmp_path / "sog"),
    ):
        with pytest.raises(TypeError, match=r"expected .*a Bundle, got Gaussians"):
            call()
    for call in (lambda: v3dg.render("none.v3dg", camera), lambda: v3dg.Scene().add("none.v3dg")):
        with pytest.raises(FileNotFoundError, match=r"none\.v3dg"):
            call()
    for call in (
        lambda: v3dg.render(bundle, "a.json"),
        lambda: v3dg.select(bundle, "a.json"),
        lambda: v3dg.pick(bundle, "a.json", 0, 0),
        lambda: v3dg.rasterize(bundle.level_gaussians(0), "a.json"),
    ):
        with pytest.raises(
            TypeError, match=r"camera: .* got str; v3dg\.read_cameras reads camera files"
        ):
            call()


def test_no_camera_and_no_bundle_are_named(bundle, tmp_path):
    with pytest.raises(TypeError, match=r"camera: expected .*, got NoneType"):
        v3dg.select(bundle, None)
    with pytest.raises(ValueError, match="n: expected 0 cameras or more, got -3"):
        v3dg.turntable((0, 0, 0), 1, -3)
    with pytest.raises(TypeError, match=r"bundle: expected a Bundle, got int"):
        v3dg.write_streamed_sog(3, tmp_path / "web")


@pytest.mark.parametrize("name", ["a.v3dg", "a.json"])
def test_a_bundle_or_a_scene_read_as_an_asset_is_sent_to_open(name):
    with pytest.raises(ValueError, match=r"v3dg\.open opens bundles \(\.v3dg\) and scenes"):
        v3dg.read_asset(name)


@pytest.mark.parametrize(
    ("name", "got"),
    [("a.sog", "begins with b''"), ("a.glb", "complete .glb file of glTF 2.0, got 0 bytes")],
)
def test_empty_files_are_told_in_our_words(tmp_path, name, got):
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match=f"{name}: expected a .*{got}"):
        v3dg.read_asset(tmp_path / name)


def test_nothing_is_written_that_cannot_be_opened(bundle, tmp_path):
    bundle.write(tmp_path / "a.v3dg")
    v3dg.write_asset(tmp_path / "a.ply", bundle.level_gaussians(0))
    scene = v3dg.Scene.of(v3dg.open(tmp_path / "a.v3dg"))
    before = sorted(tmp_path.iterdir())
    for write in (
        lambda: bundle.write(tmp_path / "x.ply"),
        lambda: v3dg.levels.build_file(tmp_path / "a.ply", tmp_path / "x.ply"),
    ):
        with pytest.raises(ValueError, match=r"x\.ply: expected a file name ending in \.v3dg"):
            write()
    for name in ("noname", "scene.txt", "meta.json"):
        with pytest.raises(
            ValueError, match=rf"{name}: expected a file name ending in \.json \(but not meta"
        ):
            scene.save(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before


def test_cameras_without_names_are_told_so(bundle, camera, tmp_path):
    bundle.write(tmp_path / "a.v3dg")
    scene = v3dg.Scene.of(v3dg.open(tmp_path / "a.v3dg"))
    for write in (v3dg.write_cameras, lambda path, cameras: scene.save(path, cameras)):
        with pytest.raises(
            TypeError, match=r"^cameras: expected a mapping from names to cameras, .* got list"
        ):
            write(tmp_path / "t.json", [camera])
        with pytest.raises(TypeError, match=r"cameras\['a'\]: expected a Camera, got NoneType"):
            write(tmp_path / "t.json", {"a": None})
    assert [path.name for path in tmp_path.iterdir()] == ["a.v3dg"]


def test_scenes_are_saved_and_loaded(bundle, camera, tmp_path):
    (tmp_path / "bundles").mkdir()
    bundle.write(tmp_path / "bundles" / "a.v3dg")
    scene = v3dg.Scene()
    scene.add(
        v3dg.open(tmp_path / "bundles" / "a.v3dg"), positions=[[0, 1, 2], [3, 4, 5]], scales=2
    )
    scene.save(tmp_path / "a.json", {"front": camera})
    again = v3dg.Scene.load(tmp_path / "a.json")
    np.testing.assert_array_equal(again.positions, scene.positions)
    assert again.bundles[0].path == str(tmp_path / "bundles" / "a.v3dg")
    assert list(v3dg.read_scene(tmp_path / "a.json")[1]) == ["front"]


def test_a_scene_of_bundles_in_memory_says_what_to_do_first(bundle, tmp_path):
    with pytest.raises(
        ValueError, match=r"scene.bundles\[0\]: .* got one in memory or at a URL; write it"
    ):
        v3dg.Scene.of(bundle).save(tmp_path / "a.json")
    assert list(tmp_path.iterdir()) == []
