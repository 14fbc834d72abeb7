"""What people who know Python and its notebooks expect."""

import io
import json

import numpy as np
import pytest
from PIL import Image

import v3dg
from random_bundle import random_bundle, random_gaussians
from v3dg import _extras, cli
from v3dg.cli._common import UsageError
from v3dg.rotations import rotation_from_quaternion


@pytest.fixture
def bundle():
    return random_bundle(0)


@pytest.fixture
def camera():
    return v3dg.turntable((0, 0, 0), 4, 1, width=48, height=32)[0]


def test_pictures_show_themselves_in_notebooks(bundle, camera):
    drawn = v3dg.rasterize(bundle.level_gaussians(0), camera)
    for picture in (v3dg.render(bundle, camera, device="cpu"), drawn):
        shown = np.asarray(Image.open(io.BytesIO(picture._repr_png_())))
        np.testing.assert_array_equal(shown, v3dg.pictures.to_8bit(picture.color))


def test_bundles_show_their_levels_in_notebooks(bundle):
    shown = bundle._repr_html_()
    assert shown.count("<tr>") == 1 + bundle.num_levels
    for level in bundle.info()["levels"]:
        assert (
            f"<td>{level['level']}<td>{level['clusters']:,}<td>{level['gaussians']:,}<td>" in shown
        )


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


@pytest.mark.parametrize("kind", ["numpy", "torch"])
def test_transform_moves_turns_and_scales(kind):
    asset = random_gaussians(np.random.default_rng(0), 5)
    given = asset if kind == "numpy" else asset.torch("cpu")
    turn = np.array([2.0, 0, 0, 2.0])  # a quarter about z, of any length
    moved = given.transform(turn, (1, 2, 3), 3.0)
    assert type(moved.means) is type(given.means)
    rotation = rotation_from_quaternion(turn / np.linalg.norm(turn))
    np.testing.assert_allclose(
        moved.numpy().means, 3 * asset.means @ rotation.T + (1, 2, 3), atol=1e-5
    )
    np.testing.assert_allclose(moved.numpy().scales, 3 * asset.scales, rtol=1e-6)
    np.testing.assert_array_equal(moved.numpy().opacities, asset.opacities)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (((0, 0, 0, 0),), "quaternion: expected a rotation, got a quaternion of zeros"),
        (((1, 0, 0, 0), (0, 0)), "position: expected shape"),
        (((1, 0, 0, 0), (0, 0, 0), 0), "scale: expected a positive number, got 0"),
    ],
)
def test_transform_names_what_is_wrong(arguments, message):
    with pytest.raises(ValueError, match=message):
        random_gaussians(np.random.default_rng(0), 5).transform(*arguments)


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
        with pytest.raises(TypeError, match=r"camera: .* got str; v3dg\.read_cameras reads files"):
            call()


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
            ValueError, match=rf"{name}: expected a file name ending in \.json, not meta"
        ):
            scene.save(tmp_path / name)
    assert sorted(tmp_path.iterdir()) == before


def test_an_axis_that_is_none_is_refused_where_it_is_set(bundle):
    scene = v3dg.Scene.of(bundle)
    scene.up = "-y"
    with pytest.raises(ValueError, match=r"^up: expected 'x' or .*, got 'q'"):
        scene.up = "q"
    assert scene.up == "-y"
    scene.up = None
    assert scene.up is None


@pytest.mark.parametrize(
    ("image", "error", "message"),
    [
        (np.zeros((3, 4)), ValueError, r"shape \(H, W, 3\) with at least one pixel, got \(3, 4\)"),
        (np.zeros((0, 4, 3)), ValueError, r"at least one pixel, got \(0, 4, 3\)"),
        (np.full((3, 4, 3), np.nan), ValueError, r"got some that are no numbers \(nan\)"),
        (np.zeros((3, 4, 3), int), ValueError, r"uint8, or floats in \[0,1\], got int64"),
        ([[[0, 0, 0]]], TypeError, "a NumPy array or a torch tensor, got list"),
    ],
)
def test_what_is_no_picture_is_not_written(image, error, message, tmp_path):
    with pytest.raises(error, match=f"^image: expected .*{message}"):
        v3dg.pictures.write_picture(tmp_path / "a.png", image)
    assert list(tmp_path.iterdir()) == []


def test_a_tensor_of_a_training_is_written(tmp_path):
    torch = pytest.importorskip("torch")
    for kind, value in ((torch.float32, 1.0), (torch.uint8, 255)):
        image = torch.full((2, 3, 3), value, dtype=kind, requires_grad=kind == torch.float32)
        v3dg.pictures.write_picture(tmp_path / "a.png", image)
        np.testing.assert_array_equal(v3dg.pictures.read_picture(tmp_path / "a.png"), 255)


def test_cameras_without_names_are_told_so(bundle, camera, tmp_path):
    bundle.write(tmp_path / "a.v3dg")
    scene = v3dg.Scene.of(v3dg.open(tmp_path / "a.v3dg"))
    for write in (v3dg.write_cameras, lambda path, cameras: scene.save(path, cameras)):
        with pytest.raises(
            TypeError, match=r"^cameras: expected cameras by their names, .* got list"
        ):
            write(tmp_path / "t.json", [camera])
        with pytest.raises(TypeError, match=r"cameras\['a'\]: expected a Camera, got NoneType"):
            write(tmp_path / "t.json", {"a": None})
    assert [path.name for path in tmp_path.iterdir()] == ["a.v3dg"]


@pytest.mark.parametrize("name", ["a.v3dg", "a.json"])
def test_a_bundle_or_a_scene_read_as_an_asset_is_sent_to_open(name):
    with pytest.raises(ValueError, match=r"v3dg\.open opens bundles \(\.v3dg\) and scenes"):
        v3dg.read_asset(name)


def test_no_camera_and_no_bundle_are_named(bundle, tmp_path):
    with pytest.raises(TypeError, match=r"camera: expected .*, got NoneType"):
        v3dg.render(bundle, None)
    with pytest.raises(TypeError, match=r"camera: expected .*, got NoneType"):
        v3dg.select(bundle, None)
    with pytest.raises(ValueError, match="n: expected 0 cameras or more, got -3"):
        v3dg.turntable((0, 0, 0), 1, -3)
    with pytest.raises(TypeError, match=r"bundle: expected a Bundle, got int"):
        v3dg.write_streamed_sog(3, tmp_path / "web")
    with pytest.raises(ValueError, match="nowhere; create it first"):
        v3dg.write_usd(bundle, tmp_path / "nowhere" / "a.usda")


@pytest.mark.parametrize(
    ("name", "got"), [("a.sog", "begins with b''"), ("a.glb", "whole, got 0 bytes")]
)
def test_empty_files_are_told_in_our_words(tmp_path, name, got):
    (tmp_path / name).touch()
    with pytest.raises(ValueError, match=f"{name}: expected a .*{got}"):
        v3dg.read_asset(tmp_path / name)


@pytest.mark.parametrize(
    ("typed", "message"),
    [
        ("rendr a.v3dg", "perhaps you meant render; run v3dg --help"),
        ("render a.v3dg --tolerence 3", "perhaps you meant --tolerance; run v3dg"),
        ("build a.ply --cluster-sise 3", "perhaps you meant --cluster-size; run v3dg"),
        ("build --cluster-sise 3 a.ply", "--cluster-sise: expected an option of v3dg build"),
        ("render --toleranze=3 a.v3dg", "perhaps you meant --tolerance; run v3dg render"),
        ("render --quite a.v3dg", "perhaps you meant --quiet; run v3dg render"),
        ("export a.json --out site", "perhaps you meant --output; run v3dg export"),
    ],
)
def test_slips_on_the_command_line_are_told_what_may_be_meant(typed, message):
    with pytest.raises(UsageError, match=message):
        cli.parse(typed.split())


def test_nothing_is_guessed_where_nothing_is_alike():
    with pytest.raises(UsageError) as error:
        cli.parse(["xyzzy"])
    assert "perhaps" not in str(error.value)
    with pytest.raises(
        UsageError, match="--steps: expected an option of v3dg build, got none; run"
    ):
        cli.parse(["build", "a.ply", "--steps", "3"])


@pytest.mark.parametrize("command", [name for name in cli.COMMANDS if name != "completion"])
def test_every_command_can_be_quiet_and_print_json(command):
    options = cli.COMMANDS[command][0].__dataclass_fields__
    assert {"quiet", "json"} <= options.keys()


def test_doctor_says_what_is_there_and_how_to_get_the_rest(monkeypatch, capsys, tmp_path):
    compiler = tmp_path / "c++"
    compiler.write_text("#!/bin/sh\necho g++ 99.1\n")
    compiler.chmod(0o755)
    for name in ("CXX", "CUDACXX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setitem(_extras.EXTRAS, "nowhere", _extras.Extra("nowhere-at-all>=7", "nothing"))
    assert cli.main(["doctor"]) == 0
    lines = capsys.readouterr().out.splitlines()
    told = dict(line.split("  ", 1) for line in lines)
    assert told["compiler"].strip() == "g++ 99.1"
    assert told["GPU, driver"].strip().startswith("missing, to draw and build with CUDA")
    assert told["nowhere-at-all"].strip() == "missing, for nothing: pip install 'nowhere-at-all>=7'"
    assert v3dg.__version__ in told["v3dg"]


def test_doctor_prints_json(capsys):
    assert cli.main(["doctor", "--json"]) == 0
    parts = json.loads(capsys.readouterr().out)["parts"]
    assert all(
        (part["found"] is None) == (part["missing"] is not None)
        for part in parts
        if part["part"] != "CUDA"
    )
    assert {"v3dg", "Python", "compiler", "CUDA", "torch", "web browser"} <= {
        part["part"] for part in parts
    }
