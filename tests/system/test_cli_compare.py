import json
import os
import struct
import subprocess
import sys
import tracemalloc
import zlib

import numpy as np
import pytest
from PIL import Image

import v3dg
from benchmarks.worlds.procedural import make_asset
from command_line import fails, run
from v3dg import cli, metrics
from v3dg.pictures import read_picture, write_picture


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """An asset, its bundle, and a scene of the bundle with one near and one far
    camera."""
    folder = tmp_path_factory.mktemp("compare")
    asset = make_asset(1000)
    v3dg.write_asset(folder / "tuft.ply", asset)
    bundle = v3dg.build_bundle(
        asset, config=v3dg.BuildConfig(steps=20), progress=False, device="cpu"
    )
    bundle.write(folder / "tuft.v3dg")
    scene = v3dg.Scene()
    scene.add(bundle, positions=[[0, 0, 0]])
    cameras = {
        name: v3dg.Camera.look_at((0, -distance, 1), (0, 0, 0.4), width=64, height=48)
        for name, distance in (("near", 4), ("far", 20))
    }
    v3dg.write_scene(folder / "scene.json", scene, ["tuft.v3dg"], cameras)
    return folder


def compare(folder, *arguments):
    done = run("compare", *arguments, "--quiet", "--json", cwd=folder)
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_an_asset_and_itself_are_equal(folder, tmp_path):
    options = ("--views", 2, "--size", 64, 48, "-o", tmp_path / "c.png")
    result = compare(folder, "tuft.ply", "tuft.ply", *options)
    assert [view["camera"] for view in result["views"]] == ["0", "1"]
    for numbers in (*result["views"], result["mean"]):
        assert (numbers["flip"], numbers["psnr"], numbers["ssim"]) == (0, None, 1)


def test_many_views_are_measured_by_several_processes_alike(folder, tmp_path):
    """View 0 of a turntable is the same for any number of views; the others are in
    order."""
    options = ("--size", 64, 48, "-o", tmp_path / "c.png", "--tolerance", 100, "--views")
    one, many = (compare(folder, "tuft.ply", "tuft.v3dg", *options, n)["views"] for n in (1, 9))
    assert [view["camera"] for view in many] == list("012345678")
    assert len({view["flip"] for view in many}) == 9
    for name in ("flip", "psnr", "ssim"):
        assert many[0][name] == one[0][name]


def test_error_grows_with_the_tolerance_and_shrinks_the_cut(folder, tmp_path):
    def mean(tolerance):
        options = (
            "--views",
            2,
            "--size",
            64,
            48,
            "-o",
            tmp_path / "c.png",
            "--tolerance",
            tolerance,
        )
        return compare(folder, "tuft.ply", "tuft.v3dg", *options)["mean"]

    fine, coarse = mean(10), mean(300)
    assert 0 < fine["flip"] < coarse["flip"]
    assert fine["psnr"] > coarse["psnr"]
    assert fine["ssim"] > coarse["ssim"]
    assert fine["gaussians_selected"] > coarse["gaussians_selected"] > 0


def test_a_scene_is_compared_from_its_own_cameras(folder, tmp_path):
    result = compare(
        folder,
        "scene.json",
        "scene.json",
        "--budget",
        300,
        "--pictures",
        "all",
        "-o",
        tmp_path / "c.png",
    )
    assert [view["camera"] for view in result["views"]] == ["near", "far"]
    assert all(0 < view["gaussians_selected"] <= 300 for view in result["views"])
    assert sorted(os.listdir(tmp_path)) == ["c_far.png", "c_near.png"]
    assert result["worst"] == max(result["views"], key=lambda view: view["flip"])["camera"]


def test_the_scene_gives_the_cameras_whichever_it_is(folder, tmp_path):
    result = compare(
        folder,
        "tuft.ply",
        "scene.json",
        "--camera",
        "near",
        "--tolerance",
        0,
        "-o",
        tmp_path / "c.png",
    )
    assert [view["camera"] for view in result["views"]] == ["near"]
    assert result["mean"]["flip"] < 1e-3


def test_supersampling_the_reference_shows_aliasing(folder, tmp_path):
    options = ("--camera", "far", "--tolerance", 0, "-o", tmp_path / "c.png", "--supersample")
    once, thrice = (
        compare(folder, "scene.json", "scene.json", *options, n)["mean"] for n in (1, 3)
    )
    assert once["flip"] == 0
    assert thrice["flip"] > 0


def test_two_pictures(folder, tmp_path):
    rng = np.random.default_rng(1)
    reference = rng.random((40, 60, 3))
    write_picture(tmp_path / "a.png", reference)
    write_picture(tmp_path / "b.png", reference * 0.8)
    result = compare(tmp_path, "a.png", "b.png")
    eight_bit = [np.asarray(Image.open(tmp_path / f"{name}.png")) / 255 for name in "ab"]
    assert result["mean"]["psnr"] == pytest.approx(metrics.psnr(*eight_bit), rel=1e-4)
    assert result["mean"]["ssim"] == pytest.approx(metrics.ssim(*eight_bit), rel=1e-4)
    assert result["mean"]["flip"] == pytest.approx(metrics.flip(*eight_bit), rel=1e-3)
    with Image.open(tmp_path / "compare.png") as sheet:
        left = np.asarray(sheet)[:, 6 : 6 + 5 * 60]
    enlarged = np.asarray(Image.open(tmp_path / "a.png")).repeat(5, axis=0).repeat(5, axis=1)
    shown = [(left[top : top + 5 * 40] == enlarged).all() for top in range(left.shape[0] - 5 * 40)]
    assert any(shown), "the reference, five times as large"


def test_text_names_the_view_that_differs_most(folder, tmp_path):
    done = run(
        "compare",
        "scene.json",
        "scene.json",
        "--tolerance",
        30,
        "-o",
        tmp_path / "c.png",
        "--quiet",
        cwd=folder,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["view", "FLIP", "PSNR", "SSIM", "gaussians"]
    assert [line.split()[0] for line in lines[1:4]] == ["near", "far", "mean"]
    assert "which has the largest difference" in lines[-1]


def test_a_view_that_shows_no_coarser_level_says_so(folder, tmp_path):
    command = (
        "compare",
        "tuft.ply",
        "tuft.v3dg",
        "-o",
        tmp_path / "c.png",
        "--views",
        1,
        "--quiet",
        "--size",
    )
    near, far = (run(*command, size, size, cwd=folder).stdout for size in (500, 20))
    assert "every view needs the finest level" in near
    assert "every view needs the finest level" not in far


def test_errors(folder, tmp_path):
    write_picture(tmp_path / "a.png", np.zeros((8, 8, 3)))
    write_picture(tmp_path / "b.png", np.zeros((8, 9, 3)))
    fails(2, "got one of each", "compare", tmp_path / "a.png", "tuft.ply", cwd=folder)
    fails(1, "b.png: expected 8 x 8 px", "compare", "a.png", "b.png", cwd=tmp_path)
    fails(1, "nowhere.ply", "compare", "nowhere.ply", "tuft.v3dg", cwd=folder)
    fails(1, "c.gif", "compare", "tuft.ply", "tuft.v3dg", "-o", "c.gif", cwd=folder)
    fails(2, "--supersample", "compare", "tuft.ply", "tuft.ply", "--supersample", 0, cwd=folder)
    (tmp_path / "compare.png").symlink_to("a.png")
    fails(
        2,
        "compare.png: expected an output that is not the input a.png",
        "compare",
        "a.png",
        "b.png",
        cwd=tmp_path,
    )


def chunk(kind, data):
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def grey_png(side, *chunks, depth=8, rows=1):
    """Return a grey PNG that claims a side of any length but has only this number of
    rows."""
    header = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, depth, 0, 0, 0, 0))
    data = zlib.compress(bytes((1 + side * depth // 8) * rows))
    return b"\x89PNG\r\n\x1a\n" + b"".join(
        [header, *chunks, chunk(b"IDAT", data), chunk(b"IEND", b"")]
    )


POSTSCRIPT = b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 8 8\n%%EndComments\nshowpage\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"not a picture", "expected a PNG or a JPEG, got another file"),
        (b"", "expected a PNG or a JPEG, got another file"),
        (POSTSCRIPT, "expected a PNG or a JPEG, got another file"),
        (grey_png(8)[:50], "expected a PNG or a JPEG that is not damaged, got"),
        (
            grey_png(12_000),
            "expected a picture of at most 65,500 px a side and at most 33,554,432 px in total",
        ),
        (grey_png(20_000), "expected a PNG or a JPEG that is not damaged, got Image size"),
        (grey_png(2**31 - 1), "expected a PNG or a JPEG that is not damaged, got Image size"),
        (grey_png(8, depth=16, rows=8), "expected 8 bits per channel, got 16"),
    ],
)
def test_pictures_that_users_hand_in_are_refused_before_they_cost(tmp_path, content, message):
    write_picture(tmp_path / "a.png", np.zeros((8, 8, 3)))
    (tmp_path / "c.png").write_bytes(content)
    for path in ("c.png", tmp_path / "c.png"):
        fails(1, f"{path}: {message}", "compare", "a.png", path, cwd=tmp_path)
    tracemalloc.start()
    with pytest.raises(ValueError, match=r"c\.png: expected"):
        read_picture(tmp_path / "c.png")
    assert tracemalloc.get_traced_memory()[1] < 10 << 20
    tracemalloc.stop()


def test_no_program_is_started_for_a_picture(tmp_path, monkeypatch):
    def refuse(*arguments, **options):
        raise AssertionError(f"starts {arguments}")

    (tmp_path / "c.png").write_bytes(POSTSCRIPT)
    monkeypatch.setattr(subprocess, "Popen", refuse)
    with pytest.raises(ValueError, match="expected a PNG or a JPEG"):
        read_picture(tmp_path / "c.png")


def test_more_pictures_in_a_file_are_not_looked_at(tmp_path):
    """An animation has several pictures. Only the first is compared."""
    animated = grey_png(8, chunk(b"acTL", bytes(8)), rows=8)
    (tmp_path / "a.png").write_bytes(grey_png(8, rows=8))
    (tmp_path / "b.png").write_bytes(animated)
    done = run("compare", "a.png", "b.png", "--quiet", "--json", cwd=tmp_path)
    assert done.stderr == ""
    assert json.loads(done.stdout)["mean"]["psnr"] is None


def test_pictures_of_all_views_have_names_of_their_own(folder, tmp_path):
    scene = json.loads((folder / "scene.json").read_text())
    scene["bundles"] = {name: str(folder / path) for name, path in scene["bundles"].items()}
    first, second = scene["cameras"]
    first["name"], second["name"] = "a/b", "a:b"
    (tmp_path / "scene.json").write_text(json.dumps(scene))
    for command in (
        ["compare", "scene.json", "scene.json", "--pictures", "all"],
        ["render", "scene.json"],
    ):
        done = run(*command, "-o", "c.png", "--json", cwd=tmp_path)
        assert done.returncode == 0, done.stderr
        result = json.loads(done.stdout)
        rows = result.get("views") or result["pictures"]
        assert [(row["camera"], row["picture"]) for row in rows] == [
            ("a/b", "c_0.png"),
            ("a:b", "c_1.png"),
        ]


def test_without_flip_views_are_compared_by_psnr(folder, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    subjects = [str(folder / name) for name in ("tuft.ply", "tuft.v3dg")]
    options = [
        "--views",
        "3",
        "--size",
        "64",
        "48",
        "--tolerance",
        "300",
        "-o",
        str(tmp_path / "c.png"),
        "--quiet",
    ]
    assert cli.main(["compare", *subjects, *options, "--json"]) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["mean"]["flip"] is None
    worst = min(result["views"], key=lambda view: view["psnr"])
    assert result["worst"] == worst["camera"]
    assert cli.main(["compare", *subjects, *options]) == 0
    assert "pip install 'flip-evaluator>=1.6'" in capsys.readouterr().out
