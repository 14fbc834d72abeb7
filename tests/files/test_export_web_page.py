"""The folder that `write_web_page` writes. tests/browser/test_web_page.py opens it in a
browser."""

import json
import re
import shutil

import numpy as np
import pytest

import v3dg
from command_line import run
from random_bundle import random_bundle
from v3dg.export import web_page


@pytest.fixture
def compiled_core(tmp_path, monkeypatch):
    """Stand in for the compiled core, which an installation may lack."""
    web = tmp_path / "modules"
    shutil.copytree(web_page._WEB, web)
    (web / "core.wasm").write_bytes(b"\0asm")
    monkeypatch.setattr(web_page, "_WEB", web)


@pytest.fixture
def scene():
    scene = v3dg.Scene()
    scene.add(random_bundle(1), [(0, 0, 0), (2, 0, 0)], tint=(1, 0.5, 0.5), importance=2)
    scene.add(random_bundle(2, sh_degree=1, codec="quantized"), (0, 3, 0), opacity=0.5)
    return scene


@pytest.mark.usefixtures("compiled_core")
def test_the_scene_file_has_what_the_scene_has(scene, tmp_path):
    written = v3dg.write_web_page(scene, tmp_path / "page", up="z")
    read, cameras = v3dg.read_scene(tmp_path / "page" / "scene.json")
    assert written.bundles == len(read.bundles) == 2
    assert written.instances == len(read) == 3
    assert read.up == "z"
    assert [bundle.codec for bundle in read.bundles] == ["quantized", "quantized"]
    np.testing.assert_array_equal(read.positions, scene.positions)
    np.testing.assert_array_equal(read.factors, scene.factors)
    np.testing.assert_array_equal(read.importance, scene.importance)
    assert list(cameras) == ["start"]
    num_bytes = sum(
        path.stat().st_size
        for path in (tmp_path / "page").rglob("*")
        if path.is_file() and path.name != "v3dg-export.json"
    )
    assert written.bytes == num_bytes


@pytest.mark.usefixtures("compiled_core")
def test_a_quantised_file_is_copied(tmp_path):
    random_bundle(3, codec="quantized").write(tmp_path / "a b.v3dg")
    v3dg.write_web_page(tmp_path / "a b.v3dg", tmp_path / "page")
    copied = (tmp_path / "page" / "a_b.v3dg").read_bytes()
    assert copied == (tmp_path / "a b.v3dg").read_bytes()


@pytest.mark.usefixtures("compiled_core")
def test_the_page_has_all_modules_that_it_imports(scene, tmp_path):
    v3dg.write_web_page(scene, tmp_path / "page")
    modules = tmp_path / "page" / "viewer"
    names = {path.name for path in modules.iterdir()}
    for path in modules.glob("*.js"):
        text = path.read_text(encoding="utf-8")
        imported = re.findall(r'from "\./([\w.]+)"', text)
        imported += re.findall(r'new URL\("([\w.]+)", import', text)
        assert set(imported) <= names, path.name
    page = (tmp_path / "page" / "index.html").read_text(encoding="utf-8")
    for name in re.findall(r'(?:src|href)="viewer/([\w.]+)"', page):
        assert name in names


@pytest.mark.usefixtures("compiled_core")
def test_a_later_export_replaces_an_earlier_one(scene, tmp_path):
    v3dg.write_web_page(scene, tmp_path / "page")
    (tmp_path / "page" / "mine.txt").write_text("mine")
    v3dg.write_web_page(random_bundle(4), tmp_path / "page")
    bundles = list((tmp_path / "page").glob("*.v3dg"))
    assert len(bundles) == 1
    assert (tmp_path / "page" / "mine.txt").read_text() == "mine"


@pytest.mark.usefixtures("compiled_core")
def test_a_scene_without_instances_is_refused(tmp_path):
    with pytest.raises(ValueError, match="scene: expected at least one instance to export"):
        v3dg.write_web_page(v3dg.Scene(), tmp_path / "page")
    assert not (tmp_path / "page").exists()


def test_an_installation_without_the_core_says_so(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(web_page, "_CORE", "missing.wasm")
    with pytest.raises(RuntimeError, match="web page: this installation has no core"):
        v3dg.write_web_page(scene, tmp_path / "page")
    assert not (tmp_path / "page").exists()


@pytest.mark.skipif(
    not (web_page._WEB / "core.wasm").is_file(), reason="the core for web pages is not compiled"
)
def test_the_command_writes_the_page(scene, tmp_path):
    scene.bundles[0].write(tmp_path / "a.v3dg")
    done = run("export", tmp_path / "a.v3dg", "--to", "v3dg", "-o", tmp_path / "page", "--json")
    result = json.loads(done.stdout)
    assert result["bundles"] == result["instances"] == 1
    assert (tmp_path / "page" / "index.html").is_file()
