import json
import os
import sys

import numpy as np
import pytest
from PIL import Image

import v3dg
from command_line import run
from v3dg import cli
from v3dg.demo import run_demo

VIEWS = ((3.3, 0.36), (40.0, 0.4))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    picture = tmp_path_factory.mktemp("demo") / "demo.png"
    return run_demo(
        picture, num_gaussians=3000, instances=60, size=(96, 112), views=VIEWS, progress=False
    )


def test_demo_measures_every_distance(demo):
    assert [c["distance"] for c in demo["columns"]] == [d for d, _ in VIEWS]
    for column in demo["columns"]:
        for panel in (column["full"], column["bundle"]):
            assert 0 < panel["gaussians"] <= panel["gaussians_selected"]
            assert 0 < panel["flip"] < 0.5
            assert panel["psnr"] > 10
            assert panel["select_ms"] + panel["draw_ms"] > 0
    far = demo["columns"][-1]
    assert far["bundle"]["gaussians"] < far["full"]["gaussians"] / 4
    assert json.loads(json.dumps(demo)) == demo


def test_demo_writes_its_picture_and_nothing_else(demo):
    folder = os.path.dirname(demo["picture"])
    assert os.listdir(folder) == ["demo.png"]
    with Image.open(demo["picture"]) as image:
        pixels = np.asarray(image)
    assert pixels.shape[1] > 2 * 96
    assert pixels.shape[0] > 2 * 112
    assert pixels.std() > 20


def test_demo_refuses_a_bad_path_before_it_works(tmp_path):
    with pytest.raises(ValueError, match=r"\.png"):
        run_demo(tmp_path / "demo.tiff", num_gaussians=10**9)


def test_demo_keeps_its_files_to_go_on_with(tmp_path):
    small = {"num_gaussians": 1000, "instances": 5, "size": (32, 32), "views": VIEWS[:1]}
    folder = tmp_path / "new" / "kept"
    result = run_demo(tmp_path / "demo.png", keep=folder, progress=False, **small)
    assert result["kept"] == [str(folder / f"donut{end}") for end in (".ply", ".v3dg", "s.json")]
    scene, cameras = v3dg.read_scene(folder / "donuts.json")
    assert len(scene) == 5
    assert scene.bundles[0].path == str(folder / "donut.v3dg")
    assert len(v3dg.read_asset(folder / "donut.ply")) == 1000
    assert list(cameras) == ["0, distance 3.3"]
    with pytest.raises(ValueError, match=r"donut\.ply: expected a new file"):
        run_demo(tmp_path / "demo.png", keep=folder, progress=False, **small)


def test_demo_command(tmp_path):
    arguments = ["demo", "--gaussians", 1000, "--instances", 7, "--size", 64, 64, "--quiet"]
    done = run(*arguments, "--json", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["columns"]) == 5
    assert os.listdir(tmp_path) == ["v3dg_demo.png"]
    text = run(*arguments, cwd=tmp_path).stdout
    assert text.startswith("7 instances of 1,000 gaussians")
    assert text.count("distance") == 10


def test_without_flip_there_are_other_errors(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    arguments = ["--gaussians", "1000", "--instances", "7", "--size", "64", "64", "--quiet"]
    assert cli.main(["demo", *arguments, "-o", str(tmp_path / "demo.png")]) == 0
    assert capsys.readouterr().out.splitlines()[3].split()[-2] == "-"
