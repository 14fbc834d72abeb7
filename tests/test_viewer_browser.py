"""The viewer in Chromium, as a person uses it. Wants playwright, and Chromium where PATH finds it."""

import io
import itertools
import json
import re
import socket
import time
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import chromium
import scenes_lod
import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

pytest.importorskip("viser")
pytest.importorskip("playwright.sync_api")

pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(chromium.PROGRAM is None, reason="neither chromium nor google-chrome is installed"),
]

SECONDS = 60


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    rng = np.random.default_rng(0)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 600, size=0.3), 64)
    path = tmp_path_factory.mktemp("viewer") / "blob.v3dg"
    bundle.write(path)
    scene = v3dg.Scene()
    scene.add(v3dg.Bundle.open(path), positions=rng.normal(size=(200, 3)), scales=np.full(200, 0.3))
    scene_view = SceneView(scene, device="cpu")
    cameras = {"from the side": v3dg.Camera.look_at((6, 0, 0), (0, 0, 0), width=640, height=480)}
    site = Site(scene_view, name="blobs", cameras=cameras, port=0)
    site.scene_view, site.folder = scene_view, path.parent
    yield site
    site.close()


class Tab:
    """A tab and what can be seen and done there."""

    def __init__(self, browser, url):
        self.errors = []
        self.page = browser.new_page(viewport={"width": 900, "height": 600})
        self.page.on("console", lambda m: m.type == "error" and self.errors.append(m.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url + ("&" if "?" in url else "?") + "fixedDpr=1")

    def figure(self, name):
        found = re.search(rf"{name}\s+([\d,.]+)", self.page.inner_text("body"))
        return float(found[1].replace(",", "")) if found else None

    def settled(self):
        """The picture, 8 bit, once it is drawn in full."""
        canvas = self.page.locator("canvas").first
        end = time.monotonic() + SECONDS
        self.page.wait_for_timeout(600)  # until what was done before has come to the tab
        while abs((self.figure("picture") or 0) - canvas.bounding_box()["width"]) > 1:
            assert time.monotonic() < end, self.page.inner_text("body")
            self.page.wait_for_timeout(200)
        self.page.wait_for_timeout(300)  # until the browser has drawn it
        return self.seen()

    def seen(self):
        box = self.page.locator("canvas").first.bounding_box()
        # Below the notices that the tab begins with.
        png = self.page.screenshot(clip=box | {"y": 200, "height": box["height"] - 200})
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(int)

    def drag(self):
        self.page.mouse.move(200, 400)
        self.page.mouse.down()
        self.page.mouse.move(300, 380, steps=8)
        self.page.mouse.up()

    def show(self, before, after):
        self.page.locator(f'input[value="{before}"]').first.click()
        self.page.get_by_role("option", name=after, exact=True).click()

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def saved(self, name):
        with self.page.expect_download(timeout=1000 * SECONDS) as download:
            self.press(name)
        with open(download.value.path(), "rb") as file:
            return download.value.suggested_filename, file.read()


@pytest.fixture
def tab(browser, site):
    tab = Tab(browser, f"{site.url}/")
    yield tab
    tab.page.close()
    assert tab.errors == []


def differ(first, second):
    return (abs(first - second).max(axis=2) > 20).mean()


def test_picture_is_there_and_follows_the_camera_and_a_slider(tab):
    first = tab.settled()
    assert (first.max(axis=2) > 30).mean() > 0.05
    assert differ(first, tab.settled()) == 0
    tab.drag()
    turned = tab.settled()
    assert differ(first, turned) > 0.02
    selected = tab.figure("selected")
    tab.page.get_by_role("slider").first.press("End")
    coarse = tab.settled()
    assert tab.figure("selected") < 0.7 * selected
    assert differ(turned, coarse) > 0.001


def test_page_of_a_token_reaches_the_viewer(browser, site):
    elsewhere = Site(site.scene_view, host="0.0.0.0", port=0)
    try:
        tab = Tab(browser, f"http://127.0.0.1:{elsewhere.port}{urlsplit(elsewhere.url).path}")
        assert (tab.settled().max(axis=2) > 30).mean() > 0.05
        tab.page.close()
    finally:
        elsewhere.close()


def test_page_talks_to_no_other_server(browser, site):
    """Which could have it run anything in the name of this one."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        other.settimeout(3)
        tab = Tab(browser, f"{site.url}/?websocket=ws://127.0.0.1:{other.getsockname()[1]}")
        with pytest.raises(TimeoutError):
            other.accept()
        tab.page.close()


def test_picture_comes_while_the_mouse_is_still_down(tab):
    first = tab.settled()
    tab.page.mouse.move(200, 400)
    tab.page.mouse.down()
    tab.page.mouse.move(400, 380, steps=8)
    tab.page.wait_for_timeout(2000)
    assert differ(first, tab.seen()) > 0.02
    tab.page.mouse.up()


def test_every_mode_looks_different(tab):
    names = [
        "Colour",
        "Level",
        "Cluster",
        "Depth",
        "Alpha",
        "Gaussians per pixel",
        "Difference to all gaussians",
    ]
    pictures = [tab.settled()]
    for before, after in itertools.pairwise(names):
        tab.show(before, after)
        pictures.append(tab.settled())
    for i, first in enumerate(pictures):
        for second in pictures[:i]:
            assert differ(first, second) > 0.01


def test_tabs_have_their_own_camera_and_settings(browser, site, tab):
    other = Tab(browser, site.url)
    first = other.settled()
    tab.settled()
    tab.drag()
    tab.show("Colour", "Depth")
    tab.settled()
    assert differ(first, other.settled()) == 0
    other.page.close()
    assert other.errors == []


def test_frozen_cut_stays_when_the_camera_goes_away(tab):
    tab.settled()
    selected = tab.figure("selected")
    tab.page.get_by_role("checkbox").nth(2).click()
    tab.settled()
    tab.page.mouse.move(300, 400)
    tab.page.mouse.wheel(0, 800)
    tab.page.wait_for_timeout(500)
    tab.settled()
    assert tab.figure("selected") == selected


def test_budget_is_kept(tab):
    tab.settled()
    assert tab.figure("selected") > 10_000
    tab.page.get_by_role("checkbox").first.click()
    tab.page.get_by_text("Millions").wait_for()
    tab.page.get_by_role("slider").nth(1).press("Home")
    tab.settled()
    assert 0 < tab.figure("selected") <= 10_000
    assert tab.figure("tolerance") > 3


def test_pictures_paths_and_scenes_are_saved(tab, site, tmp_path):
    tab.settled()
    name, png = tab.saved("Save picture")
    assert name == "blobs.png"
    width, height = Image.open(io.BytesIO(png)).size
    box = tab.page.locator("canvas").first.bounding_box()
    assert abs(width - box["width"]) <= 1
    assert abs(height - box["height"]) <= 1
    tab.page.get_by_text("Path", exact=True).click()
    tab.press("Add this view")
    tab.drag()
    tab.settled()
    tab.press("Add this view")
    name, content = tab.saved("Save cameras (transforms.json)")
    (tmp_path / name).write_bytes(content)
    cameras = v3dg.read_cameras(tmp_path / name)
    assert len(cameras) == 61
    first, *_, last = cameras.values()
    assert np.linalg.norm(first.position - last.position) > 0.1
    name, content = tab.saved("Save scene (.json)")
    (site.folder / name).write_bytes(content)
    scene, cameras = v3dg.read_scene(site.folder / name)
    assert len(scene) == 200
    assert len(cameras) == 61
    assert json.loads(content)["format"] == "v3dg-scene"


def test_film_of_a_path_is_saved(tab, tmp_path):
    av = pytest.importorskip("av")
    tab.settled()
    tab.page.get_by_text("Path", exact=True).click()
    tab.press("Add this view")
    tab.drag()
    tab.settled()
    tab.press("Add this view")
    name, content = tab.saved("Save film (.mp4)")
    assert name == "blobs.mp4"
    with av.open(io.BytesIO(content)) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == 61
    assert pictures[0].shape == (720, 1280, 3)
    assert (abs(pictures[0].astype(int) - pictures[-1]).max(axis=2) > 20).mean() > 0.02


def test_camera_goes_to_one_of_the_file_and_back(tab):
    first = tab.settled()
    tab.page.get_by_text("Camera", exact=True).click()
    tab.page.wait_for_timeout(800)  # until the folder is open
    tab.page.locator('input[class*="Select-input"]:visible').last.click()
    tab.page.get_by_role("option", name="from the side", exact=True).click()
    aside = tab.settled()
    assert differ(first, aside) > 0.02
    tab.press("Show all")
    assert differ(first, tab.settled()) < 0.01
