"""The command `v3dg render`: cameras without a file, backgrounds, films and
panoramas."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from PIL import Image

import scenes_lod
import v3dg
from v3dg import cli
from v3dg.cli._views import picture_paths
from v3dg.io import subject_name

SMALL = ("--size", "64", "48", "--quiet", "--device", "cpu")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("render")
    blob = scenes_lod.blob(np.random.default_rng(0), 400, size=0.4)
    v3dg.write_asset(folder / "blob.ply", blob)
    return folder


@pytest.fixture
def render(folder, tmp_path, monkeypatch, capsys):
    """Run the command in the folder of the asset; its pictures go to another folder."""
    monkeypatch.chdir(folder)

    def run(*options, output="out.png"):
        path = tmp_path / "new" / output
        arguments = ["render", "blob.ply", "-o", str(path), *SMALL, "--json", *map(str, options)]
        code = cli.main(arguments)
        captured = capsys.readouterr()
        return code, captured.err or json.loads(captured.out), path

    return run


def pixels(path):
    with Image.open(path) as image:
        return np.asarray(image)


def drawn(camera, **options):
    return v3dg.render("blob.ply", camera, device="cpu", **options)


def test_eye_and_target_place_the_camera(render):
    code, _, path = render("--eye", 1, -2, 3, "--target", 0.1, 0, 0, "--fov", 60, "--up", "y")
    assert code == 0
    camera = v3dg.Camera.look_at(
        (1, -2, 3), (0.1, 0, 0), (0, 1, 0), math.radians(60), width=64, height=48
    )
    drawn(camera).save(path.with_name("expected.png"))
    np.testing.assert_array_equal(pixels(path), pixels(path.with_name("expected.png")))


def test_an_eye_alone_looks_at_the_middle(render):
    assert render("--eye", 0, 0, 9, "--up", "y")[0] == 0
    _, _, path = render("--eye", 0, 0, 9, "--up", "y", "--fov", 20)
    rows, columns = np.nonzero(pixels(path).max(axis=2) > 30)
    # This is the middle of the box, which is not exactly the middle of the blob's rows.
    assert abs(rows.mean() - 24) < 8
    assert abs(columns.mean() - 32) < 8


def test_a_link_of_the_viewer_places_the_camera(render):
    link = "http://127.0.0.1:8080/#at=0.5,0,-3&turn=1,0,0,0&focus=0,0,0&fov=50&up=-y&show=level"
    for text in (link, link.partition("#")[2], link.replace(",", "%2C")):
        code, _, path = render("--at", text)
        assert code == 0
        focal = 24 / math.tan(math.radians(25))
        K = [[focal, 0, 32], [0, focal, 24], [0, 0, 1]]
        viewmat = np.eye(4)
        viewmat[:3, 3] = (-0.5, 0, 3)
        drawn(v3dg.Camera(viewmat, K, 64, 48)).save(path.with_name("expected.png"))
        np.testing.assert_array_equal(pixels(path), pixels(path.with_name("expected.png")))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--at", "http://x/#up=z"), "link: expected the address of the viewer's page"),
        (("--at", "#at=1,2&turn=1,0,0,0"), "3 numbers in at=, got 1,2"),
        (("--at", "#at=1,2,nan&turn=1,0,0,0"), "3 numbers in at=, got 1,2,nan"),
        (("--at", "#at=1,2,3&turn=0,0,0,0"), "a quaternion of length 1 in turn="),
        (("--at", "#x", "--eye", 1, 2, 3), "--eye, --at: expected only one of these options"),
        (("--target", 1, 2, 3), "--target: expected --eye together with it"),
        (("--eye", 1, 2, 3, "--views", 3), "--views: expected a subject without cameras"),
        (("--eye", 1, 2, 3, "--fov", 180), "--fov: expected 0.001 to 179"),
        (("--background", "nocolor"), "--background: expected three numbers"),
        (("--projection", "equirectangular"), "--size: expected a width of twice the height"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_read(render, options, message):
    code, error, path = render(*options)
    assert code in (1, 2)
    assert message in error
    assert not path.exists()


def test_a_transparent_picture_has_straight_alpha(render):
    code, _, path = render("--background", "none")
    assert code == 0
    _, _, black = render(output="black.png")
    _, _, white = render("--background", "white", output="white.png")
    picture = pixels(path).astype(float)
    assert picture.shape == (48, 64, 4)
    alpha = picture[..., 3:] / 255
    assert 0.2 < alpha.mean() < 0.9
    np.testing.assert_allclose(alpha * picture[..., :3], pixels(black), atol=1.6)
    over_white = alpha * picture[..., :3] + 255 * (1 - alpha)
    np.testing.assert_allclose(over_white, pixels(white), atol=2.1)
    assert (
        "a .png for a transparent background" in render("--background", "none", output="a.jpg")[1]
    )


def test_views_become_a_film(render):
    av = pytest.importorskip("av")
    code, result, path = render("--views", 5, "--fps", 10, output="film.mp4")
    assert code == 0, result
    assert result["film"] == str(path)
    with av.open(str(path)) as film:
        stream = film.streams.video[0]
        assert stream.average_rate == 10
        assert sum(1 for _ in film.decode(stream)) == 5
    assert (
        "with equal and even sizes for a film, got 63 x 48"
        in render("--size", 63, 48, output="odd.mp4")[1]
    )


def test_a_film_flies_through_cameras_at_an_even_pace(render, tmp_path):
    av = pytest.importorskip("av")
    cameras = {}
    for angle in (0.0, 0.1, 0.5, 0.6, 1.0, 1.4):
        eye = (4 * math.sin(angle), -1, -4 * math.cos(angle))
        cameras[f"{angle}.png"] = v3dg.Camera.look_at(
            eye, (0, 0, 0), (0, -1, 0), width=64, height=48
        )
    v3dg.write_cameras(tmp_path / "transforms.json", cameras)
    options = ("--cameras", tmp_path / "transforms.json", "--fps", 10)
    code, result, path = render(*options, "--seconds", 2, output="film.mp4")
    assert code == 0, result
    with av.open(str(path)) as film:
        pictures = [picture.to_ndarray(format="rgb24") / 255 for picture in film.decode(video=0)]
    assert len(pictures) == 21
    for picture, camera in ((pictures[0], cameras["0.0.png"]), (pictures[-1], cameras["1.4.png"])):
        assert np.abs(picture - drawn(camera).color).mean() < 0.02
    steps = [np.abs(second - first).mean() for first, second in itertools.pairwise(pictures)]
    assert max(steps) < 2 * np.median(steps)
    alone = render(*options, "--camera", 0, "--seconds", 2, output="film.mp4")[1]
    assert "--seconds: expected at least two cameras, got only 0.0.png" in alone
    assert "a film (.mp4) as output" in render("--views", 3, "--seconds", 2)[1]


def test_render_says_what_is_not_drawn(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(folder)
    blob = scenes_lod.blob(np.random.default_rng(0), 400, size=0.4)
    means = blob.means.copy()
    means[:100] = np.nan
    v3dg.write_asset(tmp_path / "wrong.ply", dataclasses.replace(blob, means=means))
    for asset, is_told in ((tmp_path / "wrong.ply", True), ("blob.ply", False)):
        assert cli.main(["render", str(asset), "-o", str(tmp_path / "out.png"), *SMALL]) == 0
        text = "100 of 400 gaussians cannot be drawn: 100 with a position that is not finite"
        assert (text in capsys.readouterr().out) == is_told


def test_panorama_shows_all_directions(render):
    options = ("--eye", 0, 0, 4, "--up", "y", "--size", 128, 64)
    code, _, path = render(*options, "--projection", "equirectangular", "--background", "white")
    assert code == 0
    covered = (pixels(path) < 250).any(axis=2)
    assert covered[32, 64]  # ahead
    assert not covered[:, :32].any()
    assert not covered[:10].any()


def test_panoramas_have_a_size_by_default(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 200, size=0.4), 32).write("blob.v3dg")
    command = ["render", "blob.v3dg", "--device", "cpu", "--projection", "equirectangular"]
    assert cli.main([*command, "-o", "around.png"]) == 0
    assert pixels("around.png").shape == (800, 1600, 3)


def test_panorama_is_drawn_from_the_camera_of_a_scene(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 500, size=0.4), 32).write("blob.v3dg")
    camera = v3dg.Camera.look_at((0, -3, 0), (0, 0, 0), (0, 0, 1), width=64, height=32)
    scene = v3dg.Scene.of(v3dg.Bundle.open("blob.v3dg"))
    v3dg.write_scene("scene.json", scene, cameras={"front": camera})
    command = ["render", "scene.json", "--device", "cpu", "--size", "128", "64"]
    assert cli.main([*command, "--projection", "equirectangular", "-o", "around.png"]) == 0
    assert pixels("around.png").any()


def test_panoramas_of_a_budget_are_combined_from_pinholes(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    rng = np.random.default_rng(0)
    scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 2000, size=0.4), 32).write("blob.v3dg")
    command = ["render", "blob.v3dg", "--device", "cpu", "--size", "128", "64", "--json"]
    command += ["--eye", "0", "0", "3", "--up", "y", "--projection", "equirectangular"]
    results = {}
    for name, options in (("rays", []), ("pinholes", ["--budget", "900"])):
        assert cli.main([*command, *options, "-o", f"{name}.png"]) == 0
        results[name] = json.loads(capsys.readouterr().out)["pictures"][0]
    assert "draw_ms" not in results["rays"]
    assert results["rays"]["gaussians_selected"] > 900
    assert results["pinholes"]["gaussians_selected"] <= 26 * 900
    assert results["pinholes"]["draw_ms"] > 0
    difference = np.abs(pixels("rays.png").astype(int) - pixels("pinholes.png"))
    assert 0 < difference.mean() < 20
    command.remove("--json")
    assert cli.main([*command, "--budget", "900"]) == 0
    assert "combined from 26 pinholes" in capsys.readouterr().out


def test_names_of_photographs_give_no_second_suffix(tmp_path):
    paths = picture_paths(tmp_path / "x.png", ["a.png", "b.JPG", "c.d", "2/e.jpeg"])
    assert [path.name for path in paths] == ["x_a.png", "x_b.png", "x_c.d.png", "x_2_e.png"]
    same = picture_paths(tmp_path / "x.png", ["a.png", "a.jpg"])
    assert [path.name for path in same] == ["x_0.png", "x_1.png"]


@pytest.mark.parametrize(
    ("path", "name"),
    [
        ("town/lod-meta.json", "town"),
        ("town/meta.json", "town"),
        ("https://host/town/lod-meta.json?key=1", "town"),
        ("town/a.sog", "a"),
        ("meta.v3dg", "meta"),
    ],
)
def test_files_that_are_always_called_alike_are_named_after_their_folder(path, name):
    assert subject_name(path) == name


def test_info_says_the_first_view_that_render_draws(render, capsys):
    _, _, path = render()
    assert cli.main(["info", "blob.ply", "--json"]) == 0
    view = json.loads(capsys.readouterr().out)["first_view"]
    assert view["is_inside"] is False
    eye = v3dg.first_camera("blob.ply").position
    np.testing.assert_allclose(view["eye"], eye, rtol=1e-6)
    drawn(v3dg.first_camera("blob.ply", 64, 48)).save(path.with_name("expected.png"))
    np.testing.assert_array_equal(pixels(path), pixels(path.with_name("expected.png")))
