"""Files at URLs, as fsspec fetches them."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

import v3dg
from random_bundle import random_bundle, random_gaussians
from v3dg import cli

fsspec = pytest.importorskip("fsspec")


@pytest.fixture
def there(monkeypatch):
    """A place that only fsspec reaches."""
    monkeypatch.setattr("v3dg._urls._fetched", {})
    memory = fsspec.filesystem("memory")
    yield memory
    memory.rm("/", recursive=True)


@pytest.fixture
def asset(there, tmp_path):
    gaussians = random_gaussians(np.random.default_rng(0), 300)
    v3dg.write_asset(tmp_path / "a.ply", gaussians)
    there.put_file(str(tmp_path / "a.ply"), "/in/a.ply")
    return gaussians


@pytest.fixture
def bundle(there, tmp_path):
    bundle = random_bundle(0)
    bundle.write(tmp_path / "a.v3dg")
    there.put_file(str(tmp_path / "a.v3dg"), "/in/a.v3dg")
    return bundle


@pytest.mark.parametrize("url", ["memory://in/a.ply", Path("memory://in/a.ply"), "memory://in/a%2Eply?x=1"])
def test_assets_are_read_from_urls(there, asset, url):
    if "%" in str(url):
        there.mv("/in/a.ply", "/in/a%2Eply?x=1")
    for read in (v3dg.open, v3dg.read_asset):
        np.testing.assert_array_equal(read(url).means, asset.means)


def test_bundles_are_opened_from_urls_and_fetched_once(there, bundle):
    first = v3dg.open("memory://in/a.v3dg")
    there.rm("/in/a.v3dg")
    again = v3dg.Bundle.open("memory://in/a.v3dg")
    for opened in (first, again):
        np.testing.assert_array_equal(opened.level_gaussians(0).means, bundle.level_gaussians(0).means)


def test_a_file_here_of_that_name_comes_first(there, asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "memory:" / "in").mkdir(parents=True)
    v3dg.write_asset("memory:/in/a.ply", asset.subset(slice(0, 7)))
    assert len(v3dg.read_asset("memory://in/a.ply")) == 7


def test_commands_take_urls_and_write_into_the_working_folder(there, asset, bundle, tmp_path, monkeypatch):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert cli.main(["info", "memory://in/a.ply"]) == 0
    assert cli.main(["build", "memory://in/a.ply", "--quiet", "--device", "cpu"]) == 0
    assert cli.main(["render", "memory://in/a.v3dg", "--device", "cpu", "--size", "16", "16"]) == 0
    assert cli.main(["export", "memory://in/a.v3dg", "--quiet"]) == 0
    assert sorted(path.name for path in Path().iterdir()) == ["a.png", "a.v3dg", "a_web"]


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("memory://in/none.ply", r"memory://in/none\.ply: expected a file, got FileNotFoundError"),
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("memory://in/scene.json", "expected a scene that is here, got a URL"),
        ("memory://in/lod-meta.json", "got one of a file that names others"),
        ("memory://in/a.txt", "expected a file ending in"),
    ],
)
def test_what_is_not_fetched_is_an_error_of_one_line(there, url, message, capsys):
    assert cli.main(["info", url]) == 1
    said = capsys.readouterr().err
    assert re.search(message, said)
    assert said.count("\n") == 1


def test_scenes_fetch_nothing(there, bundle, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    document = {"format": "v3dg-scene", "version": 1, "instances": []}
    for names in (["memory://in/a.v3dg"], ["memory://in/a.v3dg", "none.v3dg"]):
        bundles = {str(number): name for number, name in enumerate(names)}
        Path("a.json").write_text(json.dumps({**document, "bundles": bundles}))
        with pytest.raises((OSError, ValueError), match=r"a\.v3dg"):
            v3dg.open("a.json")
    assert v3dg._urls._fetched == {}


def test_no_scene_is_saved_with_what_goes_at_the_end(there, bundle, tmp_path):
    scene = v3dg.Scene.of(v3dg.open("memory://in/a.v3dg"))
    with pytest.raises(ValueError, match="got one in memory or at a URL; write it and open that"):
        scene.save(tmp_path / "a.json")


def test_without_fsspec_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(ImportError, match=r"files at URLs: expected fsspec.*pip install 'fsspec\[http\]"):
        v3dg.open("memory://in/b.ply")
