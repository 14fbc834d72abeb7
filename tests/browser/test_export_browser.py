"""Exports are opened in SuperSplat's own viewer and in their own pages, in Chromium.
The tests need playwright, Chromium on PATH, and environment variables:
SUPERSPLAT_VIEWER is the folder `public` of `npm install
@playcanvas/supersplat-viewer@1.36.2`, PLAYCANVAS the file `build/playcanvas.min.mjs` of
`npm install playcanvas@2.23.3`, and CESIUM the folder `Build/Cesium` of `npm install
cesium@1.145.0`.
"""

import functools
import http.server
import io
import json
import os
import shutil
import threading

import numpy as np
import pytest
from PIL import Image

import chromium
import v3dg
from benchmarks.worlds.procedural import make_donut
from v3dg.export import write_site, write_streamed_sog, write_tiles
from v3dg.metrics import psnr

pytest.importorskip("playwright.sync_api")

VIEWER, ENGINE = os.environ.get("SUPERSPLAT_VIEWER"), os.environ.get("PLAYCANVAS")
pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(
        chromium.PROGRAM is None, reason="neither chromium nor google-chrome is installed"
    ),
]

SIDE = 300


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves files and records the names of the files that were requested."""

    def log_message(self, *_):
        self.server.asked.append(self.path)


@pytest.fixture(scope="module")
def bundle():
    config = v3dg.BuildConfig(steps=60)
    return v3dg.build_bundle(
        make_donut(20_000, sh_degree=2), config=config, progress=False, quality="draft"
    )


@pytest.fixture(scope="module")
def server(tmp_path_factory, bundle):
    folder = tmp_path_factory.mktemp("web") / "site"
    shutil.copytree(VIEWER, folder) if VIEWER else folder.mkdir()
    write_streamed_sog(bundle, folder / "donut", chunk=6000, up="z")
    handler = functools.partial(Handler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.asked, server.folder = [], folder
        threading.Thread(target=server.serve_forever).start()
        yield server
        server.shutdown()


CESIUM = os.environ.get("CESIUM")
needs_viewer = pytest.mark.skipif(
    VIEWER is None, reason="SUPERSPLAT_VIEWER does not name its folder"
)
needs_engine = pytest.mark.skipif(
    ENGINE is None, reason="PLAYCANVAS does not name the engine's file"
)


def seen(browser, server, options=""):
    """Wait until the viewer's picture no longer changes. Return it (H, W, 3), and the
    levels whose files were requested."""
    errors = []
    server.asked.clear()
    page = browser.new_page(viewport={"width": SIDE, "height": SIDE})
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on(
        "console",
        lambda m: (
            m.type == "error" and "favicon" not in m.location["url"] and errors.append(m.text)
        ),
    )
    address = f"http://127.0.0.1:{server.server_address[1]}/index.html"
    page.goto(
        f"{address}?content=donut/lod-meta.json&settings=donut/settings.json&webgl&noui&noanim&fullload{options}"
    )
    picture = before = None
    for _ in range(60):
        page.wait_for_timeout(1000)
        before, picture = (
            picture,
            np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255,
        )
        if picture.max() > 0.2 and np.array_equal(before, picture):
            break
    page.close()
    assert errors == []
    levels = {
        path.split("/")[2][0] for path in server.asked if path.startswith("/donut/") and "_" in path
    }
    return picture, levels


def wanted(bundle, server):
    """Return our picture from the viewer's camera, with the viewer's filter."""
    pose = json.loads((server.folder / "donut" / "settings.json").read_text())["cameras"][0][
        "initial"
    ]
    # The viewer's y axis points up, and it shows -y of an asset as up. The asset was
    # rotated so that z is up.
    back = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    eye, target = (back @ np.array(pose[name]) for name in ("position", "target"))
    fov = np.radians(pose["fov"])
    camera = v3dg.Camera.look_at(eye, target, (0, 0, 1), fov_x=fov, width=SIDE, height=SIDE)
    return np.clip(v3dg.rasterize(bundle.level_gaussians(0), camera, filter_px2=0.3).color, 0, 1)


@needs_viewer
def test_the_viewer_shows_what_we_do(browser, server, bundle):
    picture, levels = seen(browser, server)
    assert levels == {"0"}
    assert psnr(picture, wanted(bundle, server)) > 32


@needs_viewer
def test_a_budget_brings_coarser_levels_that_look_alike(browser, server, bundle):
    picture, levels = seen(browser, server, "&budget=0.006")
    assert "0" not in levels
    assert psnr(picture, wanted(bundle, server)) > 28


@pytest.fixture(scope="module")
def town(bundle):
    """Return ninety instances from near to far, and a camera."""
    rng = np.random.default_rng(0)
    scene = v3dg.Scene()
    positions = np.stack([rng.uniform(-4, 4, 90), rng.uniform(0, 40, 90), np.zeros(90)], axis=1)
    scene.add(bundle, positions, rng.normal(size=(90, 4)), rng.uniform(0.5, 1.5, 90))
    return scene, v3dg.Camera.look_at((0, -4, 3), (0, 6, 0), width=SIDE, height=SIDE)


def page_of(browser, server, town, query):
    """Return the picture of a town's page once it no longer changes, and the number of
    gaussians in it."""
    scene, camera = town
    folder = server.folder / "town"
    if not folder.exists():
        write_site(scene, folder, {"gate": camera})
        shutil.copy(ENGINE, folder)
    return settled(browser, server, f"town/index.html?webgl&noui&{query}")


def settled(browser, server, address):
    """Return the picture of one of our pages once it no longer changes, and the number
    of gaussians in it."""
    page = browser.new_page(viewport={"width": SIDE, "height": SIDE})
    errors = []
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.goto(f"http://127.0.0.1:{server.server_address[1]}/{address}")
    states = [None, None]
    for _ in range(180):
        page.wait_for_timeout(1000)
        states.append(page.evaluate("window.v3dg ? [window.v3dg.ready, window.v3dg.drawn] : null"))
        if states[-1] and states[-1][0] and states[-1] == states[-2] == states[-3]:
            break
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255
    page.close()
    assert errors == []
    assert states[-1][0], "the page did not settle"
    return picture, states[-1][1]


@needs_engine
def test_the_page_of_a_scene_shows_what_we_do(browser, server, town):
    scene, camera = town
    picture, drawn = page_of(browser, server, town, "tolerance=1")
    assert 20_000 < drawn < 90 * 20_000
    color = np.clip(v3dg.render(scene, camera, tolerance=1, device="cpu").color, 0, 1)
    assert psnr(picture, color) > 28


@needs_engine
@pytest.mark.parametrize("budget", [50_000, 10_000])
def test_the_page_of_a_scene_keeps_its_budget(browser, server, town, budget):
    _, drawn = page_of(browser, server, town, f"budget={budget}&tolerance=0.1")
    assert 0.9 * budget < drawn <= budget


# Widths and heights in CSS px, which determine the levels that the web page chooses,
# and device pixels per CSS px. The desktop has few device pixels, because software
# draws them.
SIZES = {"desktop": (1920, 1080, 0.1), "phone": (390, 844, 3)}
BUDGET = 20_000


@pytest.fixture(scope="module")
def crowd(server, bundle):
    """Return the folder of a page with 225 instances, and cameras inside and around the
    crowd. The chunks are so small that the bundle's coarsest levels would leave most of
    them empty."""
    rng = np.random.default_rng(1)
    row = np.arange(15) * 1.5 - 10.5
    positions = np.stack([*np.meshgrid(row, row), np.zeros((15, 15))], axis=-1).reshape(-1, 3)
    scene = v3dg.Scene()
    scene.add(bundle, positions, [1, 0, 0, 0], rng.uniform(0.8, 1.2, 225))
    eyes = {
        "inside": ((0.3, 0.6, 0.3), (5, 8, 0)),
        "corner": ((-12, -12, 1), (0, 0, 0)),
        "above": ((0, -3, 8), (0, 2, 0)),
        "far": ((60, 60, 30), (0, 0, 0)),
    }
    cameras = {
        name: v3dg.Camera.look_at(eye, target, width=1920, height=1080)
        for name, (eye, target) in eyes.items()
    }
    write_site(scene, server.folder / "crowd", cameras, chunk=2048)
    shutil.copy(ENGINE, server.folder / "crowd")
    return "crowd"


class WatchedPage:
    """One of our web pages, with the number of gaussians that each of its frames
    drew."""

    RECORD = """
        window.frames_drawn = [];
        let last;
        Object.defineProperty(window, "v3dg", {
            get: () => last,
            set(state) { last = state; window.frames_drawn.push(state.drawn); },
        });
    """

    def __init__(self, browser, server, address, size):
        width, height, pixels = SIZES[size]
        viewport = {"width": width, "height": height}
        self.context = browser.new_context(viewport=viewport, device_scale_factor=pixels)
        self.page = self.context.new_page()
        self.errors = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(self.RECORD)
        self.page.goto(f"http://127.0.0.1:{server.server_address[1]}/{address}")

    def settled(self):
        """Return the number of gaussians that are drawn once everything is loaded that
        the view needs."""
        self.page.wait_for_function("window.v3dg?.ready", timeout=120_000)
        return self.page.evaluate("window.v3dg.drawn")

    def drawn(self):
        """Return the numbers of gaussians that the frames since the last call drew."""
        return self.page.evaluate("window.frames_drawn.splice(0)")

    def go_to(self, camera):
        self.page.evaluate(
            """(camera) => {
                const views = document.getElementById("view");
                views.value = camera;
                views.dispatchEvent(new Event("change"));
                window.v3dg = { ready: false, drawn: 0 };
            }""",
            camera,
        )

    def set_budget(self, budget):
        self.page.evaluate(
            """(budget) => {
                const range = document.getElementById("budget");
                range.value = Math.log10(budget);
                range.dispatchEvent(new Event("input"));
                window.v3dg = { ready: false, drawn: 0 };
            }""",
            budget,
        )


@pytest.fixture
def watched(browser, server, crowd, request):
    page = WatchedPage(
        browser,
        server,
        f"{crowd}/index.html?webgl&noui&budget={BUDGET}&tolerance=0.1",
        request.param,
    )
    yield page
    page.context.close()
    assert page.errors == []


@needs_engine
@pytest.mark.parametrize("watched", SIZES, indirect=True)
def test_the_budget_holds_inside_a_crowd_and_after_jumps(watched):
    """The budget holds in every frame, also while levels are loaded."""
    assert 0.8 * BUDGET < watched.settled() <= BUDGET
    for camera in (1, 0, 3, 2):
        watched.go_to(camera)
        assert 0.8 * BUDGET < watched.settled() <= BUDGET
        assert max(watched.drawn()) <= BUDGET


@needs_engine
@pytest.mark.parametrize("watched", SIZES, indirect=True)
def test_the_budget_holds_in_movement(watched):
    watched.settled()
    for key in ("KeyW", "KeyA", "KeyE"):
        watched.page.keyboard.down(key)
        watched.page.wait_for_timeout(3000)
        watched.page.keyboard.up(key)
    assert 0.8 * BUDGET < watched.settled() <= BUDGET
    drawn = watched.drawn()
    assert len(set(drawn)) > 5  # otherwise the camera did not move
    assert max(drawn) <= BUDGET


@needs_engine
@pytest.mark.parametrize("watched", ["phone"], indirect=True)
def test_a_budget_that_changes_holds(watched):
    for budget in (100_000, 12_000, 40_000):
        watched.settled()
        watched.set_budget(budget)
        assert 0.7 * budget < watched.settled() <= budget


@pytest.mark.skipif(CESIUM is None, reason="CESIUM does not name its folder")
def test_cesium_shows_tiles_and_fewer_from_far(browser, server, bundle):
    """Seen from near, CesiumJS shows the tiles of the asset itself, one for each group
    of level 1."""
    write_tiles(bundle, server.folder / "tiles", up="z")
    (server.folder / "tiles" / "cesium").symlink_to(CESIUM)
    picture, near = settled(browser, server, "tiles/index.html?distance=1.2")
    assert near == (bundle.groups.level == 1).sum()
    side = picture[SIDE // 4 : -SIDE // 4, SIDE // 4 : -SIDE // 4]
    assert (side.max(axis=2) > 0.2).mean() > 0.5
    _, far = settled(browser, server, "tiles/index.html?distance=40")
    assert 0 < far < near / 8
