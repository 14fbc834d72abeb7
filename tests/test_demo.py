import json
import os
import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

import v3dg
from v3dg.demo import count_text, run_demo, table_text, time_text

VIEWS = ((3.3, 0.36), (40.0, 0.4))


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    picture = tmp_path_factory.mktemp("demo") / "demo.png"
    return run_demo(picture, num_gaussians=3000, instances=60, size=(96, 112), views=VIEWS, progress=False)


def test_demo_measures_every_distance(demo):
    assert [c.distance for c in demo.columns] == [d for d, _ in VIEWS]
    for column in demo.columns:
        for panel in (column.full, column.bundle):
            assert 0 < panel.gaussians <= panel.gaussians_selected
            assert 0 < panel.flip < 0.5
            assert panel.milliseconds > 0
    far = demo.columns[-1]
    assert far.bundle.gaussians < far.full.gaussians / 4


def test_demo_shows_the_numbers(demo):
    table = table_text(demo)
    assert len(table.splitlines()) == 4 + len(VIEWS)
    assert count_text(demo.columns[0].full.gaussians) in table
    assert json.loads(json.dumps(demo.as_dict()))["instances"] == 60


def test_demo_writes_its_picture_and_nothing_else(demo):
    folder = os.path.dirname(demo.picture)
    assert os.listdir(folder) == ["demo.png"]
    with Image.open(demo.picture) as image:
        pixels = np.asarray(image)
    assert pixels.shape[1] > 2 * 96
    assert pixels.shape[0] > 2 * 112
    assert pixels.std() > 20


def test_demo_refuses_a_bad_path_before_it_works(tmp_path):
    with pytest.raises(ValueError, match="create it first"):
        run_demo(tmp_path / "no" / "demo.png", num_gaussians=10**9)
    with pytest.raises(ValueError, match=r"\.png"):
        run_demo(tmp_path / "demo.tiff", num_gaussians=10**9)


def test_demo_command(tmp_path):
    arguments = ["--gaussians", "1000", "--instances", "7", "--size", "64", "64", "--json", "--quiet"]
    command = [sys.executable, "-m", "v3dg", "demo", *arguments]
    environment = os.environ | {"PYTHONPATH": os.path.dirname(os.path.dirname(v3dg.__file__))}
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    assert len(json.loads(done.stdout)["columns"]) == 5
    assert os.listdir(tmp_path) == ["v3dg_demo.png"]


@pytest.mark.parametrize(
    ("count", "text"),
    [
        (0, "0"),
        (940, "940"),
        (1000, "1.00 k"),
        (12_345, "12.3 k"),
        (4_560_000, "4.56 M"),
        (160_000_000, "160 M"),
    ],
)
def test_counts_have_three_digits(count, text):
    assert count_text(count) == text


@pytest.mark.parametrize(("milliseconds", "text"), [(34.4, "34 ms"), (1250, "1.25 s"), (12_800, "12.8 s")])
def test_times_have_few_digits(milliseconds, text):
    assert time_text(milliseconds) == text


def test_without_flip_the_error_is_psnr(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "flip_evaluator", None)
    options = {"num_gaussians": 1000, "instances": 7, "size": (64, 64), "views": VIEWS, "progress": False}
    result = run_demo(tmp_path / "demo.png", **options)
    assert "PSNR" in table_text(result)
    assert "FLIP" not in table_text(result)
    assert result.as_dict()["columns"][0]["full"]["flip"] is None
