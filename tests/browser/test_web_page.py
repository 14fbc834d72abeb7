"""The web page of `write_web_page` streams a scene and draws it as `v3dg.render` does.
See test_web_renderer.py for what the tests need."""

import json
import time

import numpy as np
import pytest

import scenes_lod
import v3dg
import web_pages
from v3dg.metrics import psnr
from web_server import serving

pytestmark = web_pages.NEEDS

WIDTH = 240
HEIGHT = 160
LEAST_PSNR = 45
SECONDS = 30
TOLERANCE = 3
NOTICES = """
window.notices = [];
new MutationObserver(() => {
  const text = document.getElementById("notice")?.textContent ?? "";
  if (text !== "" && text !== window.notices.at(-1)) window.notices.push(text);
}).observe(document, { subtree: true, childList: true, characterData: true });
"""


@pytest.fixture(scope="module")
def webgpu():
    """Return Chromium with WebGPU in software."""
    with web_pages.chromium_with_webgpu() as browser:
        yield browser


@pytest.fixture(scope="module")
def scene():
    scene = v3dg.Scene()
    for degree in (0, 2):
        rng = np.random.default_rng(degree)
        blob = scenes_lod.blob(rng, 3000, size=0.4, sh_degree=degree)
        bundle = scenes_lod.lod_bundle(rng, blob, 64)
        bundle = v3dg.Bundle(bundle.clusters, bundle.groups, bundle.gaussians, {}, "quantized")
        positions = rng.normal(size=(4, 3)) * 2
        scene.add(bundle, positions, rng.normal(size=(4, 4)), opacity=(1, 0.8, 0.6, 1))
    return scene


CAMERAS = {
    "<b>front</b>": v3dg.Camera.look_at(
        (2, -6, 2), (0, 0, 0), fov_x=0.9, width=WIDTH, height=HEIGHT
    )
}


@pytest.fixture
def site(scene, tmp_path):
    v3dg.write_web_page(scene, tmp_path / "site", CAMERAS, up="z")
    return tmp_path / "site"


class Tab:
    """A browser tab in Chromium that shows the web page."""

    def __init__(self, browser, url):
        self.page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT})
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(NOTICES)
        self.page.goto(url)

    def wait(self, condition):
        """Wait until a condition is true. The page's policy forbids Playwright's own
        wait."""
        end = time.monotonic() + SECONDS
        while not self.page.evaluate(f"() => Boolean({condition})"):
            assert time.monotonic() < end, (condition, self.notices, self.errors)
            time.sleep(0.05)

    def settle(self):
        self.wait("window.viewer?.isSettled && viewer.hasPicture")

    @property
    def notices(self):
        return self.page.evaluate("() => window.notices")

    @property
    def num_gaussians(self):
        return self.page.evaluate("() => viewer.numGaussians")

    def picture(self):
        numbers = self.page.evaluate("async () => Array.from(await viewer.picture())")
        return np.array(numbers, np.float32).reshape(HEIGHT, WIDTH, 4)[..., :3]


@pytest.fixture
def open_tab(webgpu):
    tabs = []

    def open_url(url):
        tabs.append(Tab(webgpu, url))
        return tabs[-1]

    yield open_url
    for tab in tabs:
        tab.page.close()


def expected_picture(scene):
    camera = CAMERAS["<b>front</b>"]
    cut = v3dg.select(scene, camera, tolerance=TOLERANCE, fade=v3dg.DEFAULT_FADE, device="cpu")
    image = v3dg.render(scene, camera, cut=cut, device="cpu")
    return np.asarray(image.color), cut.num_gaussians


def test_a_streamed_scene_is_drawn_as_by_render(scene, site, open_tab):
    expected, count = expected_picture(scene)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        assert tab.num_gaussians == count
        assert psnr(np.clip(tab.picture(), 0, 1), np.clip(expected, 0, 1)) >= LEAST_PSNR
        assert tab.errors == []
        assert tab.notices == []
        ranges = [wanted for path, wanted in server.requests if path.endswith(".v3dg")]
        assert len(ranges) > 4
        assert None not in ranges


def test_a_still_camera_draws_nothing(site, open_tab):
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        time.sleep(0.5)
        before = tab.page.evaluate("() => viewer.numFrames")
        time.sleep(0.5)
        assert tab.page.evaluate("() => viewer.numFrames") == before
        tab.page.keyboard.press("w")
        tab.wait(f"viewer.numFrames > {before}")


def test_a_camera_of_the_file_orbits_around_the_scene(site, open_tab):
    camera = CAMERAS["<b>front</b>"]
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        ball = tab.page.evaluate("() => viewer.ball")
        away = np.linalg.norm(camera.position - ball[:3])
        assert tab.page.evaluate("() => page.camera.distance") == pytest.approx(away)
        tab.page.mouse.move(100, 60)
        tab.page.mouse.down()
        tab.page.mouse.move(130, 70, steps=3)
        tab.page.mouse.up()
        assert tab.page.evaluate("() => page.camera.distance") == pytest.approx(away)
        moved = tab.page.evaluate("() => page.camera.position")
        assert np.linalg.norm(camera.position - moved) > 0.1 * away


def test_a_budget_bounds_what_is_drawn(site, open_tab):
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        before = tab.num_gaussians
        tab.page.evaluate("() => viewer.set({ budget: 2000 })")
        tab.wait("viewer.isSettled")
        assert tab.num_gaussians <= 2000 < before


OPEN_WITH_A_SMALL_POOL = """async () => {
  const { open } = await import("./viewer/viewer.js");
  const { camera } = viewer;
  viewer.close();
  const canvas = document.createElement("canvas");
  window.viewer = await open(canvas, "scene.json", { poolBytes: 40_000 });
  window.viewer.setCamera(camera);
}"""


def test_a_small_pool_holds_a_coarser_picture(scene, site, open_tab):
    _, count = expected_picture(scene)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        whole = tab.page.evaluate("() => viewer.memoryBytes")
        tab.page.evaluate(OPEN_WITH_A_SMALL_POOL)
        tab.settle()
        assert tab.num_gaussians < count
        assert tab.page.evaluate("() => viewer.memoryBytes") < whole - 2**26
        assert tab.picture().max() > 0.3
        assert tab.errors == []


def test_a_lost_device_is_replaced(scene, site, open_tab):
    expected, count = expected_picture(scene)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        tab.page.evaluate("() => { viewer.renderer.device.destroy(); }")
        tab.wait("window.notices.includes('WebGPU: the device was lost; starting it again')")
        tab.settle()
        assert tab.num_gaussians == count
        assert psnr(np.clip(tab.picture(), 0, 1), np.clip(expected, 0, 1)) >= LEAST_PSNR


def test_a_server_without_ranges_sends_whole_files(scene, site, open_tab):
    expected, _ = expected_picture(scene)
    with serving(site) as server:
        server.has_ranges = False
        tab = open_tab(server.url)
        tab.settle()
        assert psnr(np.clip(tab.picture(), 0, 1), np.clip(expected, 0, 1)) >= LEAST_PSNR
        names = [path for path, _ in server.requests if path.endswith(".v3dg")]
        assert len(names) == 2


def test_a_lost_connection_leaves_a_coarser_picture_until_it_is_back(site, open_tab):
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.wait("window.viewer?.renderer?.cut")
        tab.page.evaluate("() => viewer.set({ tolerance: 1e6 })")
        tab.settle()
        coarse = tab.num_gaussians
        server.is_lost = True
        tab.page.evaluate("() => viewer.set({ tolerance: 0.01 })")
        tab.wait("window.notices.length > 0")
        assert tab.notices[0].endswith(": the connection is lost; trying again")
        assert tab.num_gaussians >= coarse
        server.is_lost = False
        tab.settle()
        assert tab.num_gaussians > coarse
        tab.wait("document.getElementById('notice').textContent === ''")


def test_a_changed_file_leaves_a_coarser_picture_and_a_line(site, open_tab):
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.wait("window.viewer?.renderer?.cut")
        tab.page.evaluate("() => viewer.set({ tolerance: 1e6 })")
        tab.settle()
        for path in site.glob("*.v3dg"):
            data = bytearray(path.read_bytes())
            data[5000 : len(data) // 2] = bytes(len(data) // 2 - 5000)
            path.write_bytes(data)
        tab.page.evaluate("() => viewer.set({ tolerance: 0.01 })")
        tab.wait("window.notices.length > 0")
        assert tab.notices[0].endswith("; reload the page")
        tab.settle()
        assert tab.num_gaussians > 0


@pytest.mark.parametrize(
    ("damage", "expected"),
    [
        (lambda data: b"PK" + data[2:], "expected a v3dg bundle; write it with v3dg"),
        (lambda data: data[:-40] + b"\xff" + data[-39:], "do not match their hash"),
        (lambda data: data[:-100], "expected a file of"),
    ],
)
def test_a_damaged_bundle_is_left_out_with_a_line(site, open_tab, damage, expected):
    path = min(site.glob("*.v3dg"))
    path.write_bytes(damage(path.read_bytes()))
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        assert path.name in tab.notices[0]
        assert expected in tab.notices[0]
        assert tab.num_gaussians > 0


def test_tables_that_contradict_each_other_are_refused(site, open_tab):
    """They are refused even if their hash is correct, as in a malicious file."""
    path = min(site.glob("*.v3dg"))
    data = bytearray(path.read_bytes())
    header, start = web_pages.header_of(data)
    first = start + header["groups.parent"]["data_offsets"][0]
    data[first : first + 4] = (2**30).to_bytes(4, "little")
    web_pages.renew_hash(data)
    path.write_bytes(data)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        assert "its tables contradict each other" in tab.notices[0]


def test_pages_that_are_not_finite_are_refused(site, open_tab):
    path = min(site.glob("*.v3dg"))
    data = bytearray(path.read_bytes())
    web_pages.spoil_page(data, 0)
    path.write_bytes(data)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.wait("window.viewer?.renderer?.cut")
        tab.page.evaluate("() => viewer.set({ tolerance: 0.001 })")
        tab.wait("window.notices.length > 0")
        assert tab.notices[0].endswith("a page has invalid ranges; write the file again")
        tab.settle()
        assert np.isfinite(tab.picture()).all()


def test_a_bundle_whose_coarsest_page_is_not_finite_is_left_out(site, open_tab):
    path = min(site.glob("*.v3dg"))
    data = bytearray(path.read_bytes())
    web_pages.spoil_page(data, -1)
    path.write_bytes(data)
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        assert tab.notices == [f"{path.name}: a page has invalid ranges; write the file again"]
        assert tab.num_gaussians > 0


def test_names_are_no_markup_and_the_policy_allows_only_the_server(site, open_tab):
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.settle()
        page = tab.page
        options = page.evaluate(
            "() => [...document.querySelectorAll('#view option')]"
            ".map((option) => option.textContent)"
        )
        assert options == ["<b>front</b>"]
        assert page.evaluate("() => document.querySelector('b')") is None
        blocked = page.evaluate("() => fetch('http://127.0.0.1:9/').then(() => 'sent', String)")
        assert "Refused to connect" in blocked or "Failed to fetch" in blocked
        policy = page.evaluate("() => document.querySelector('meta[http-equiv]').content")
        assert policy.startswith("default-src 'none'; script-src 'self' 'wasm-unsafe-eval'")


def test_a_scene_may_not_name_files_of_other_servers(site, open_tab):
    document = json.loads((site / "scene.json").read_text())
    document["bundles"]["bundle_0"] = "http://example.org/a.v3dg"
    (site / "scene.json").write_text(json.dumps(document))
    with serving(site) as server:
        tab = open_tab(server.url)
        tab.wait("window.notices.length > 0")
        expected = "scene.json: bundles.bundle_0: expected a file of this server"
        assert tab.notices == [expected]
