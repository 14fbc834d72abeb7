"""An export in SuperSplat's own viewer, in Chromium.

Wants playwright, Chromium where PATH finds it, and the viewer: `npm install @playcanvas/supersplat-viewer`,
whose folder `public` the environment variable SUPERSPLAT_VIEWER names.
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
from v3dg.export import write_streamed_sog
from v3dg.metrics import psnr

pytest.importorskip("playwright.sync_api")

VIEWER = os.environ.get("SUPERSPLAT_VIEWER")
pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(chromium.PROGRAM is None, reason="neither chromium nor google-chrome is installed"),
    pytest.mark.skipif(VIEWER is None, reason="SUPERSPLAT_VIEWER does not name its folder"),
]

SIDE = 300


class Handler(http.server.SimpleHTTPRequestHandler):
    """Serves files, and remembers which."""

    def log_message(self, *_):
        self.server.asked.append(self.path)


@pytest.fixture(scope="module")
def bundle():
    config = v3dg.BuildConfig(steps=60)
    return v3dg.build_bundle(make_donut(20_000, sh_degree=2), config=config, progress=False)


@pytest.fixture(scope="module")
def server(tmp_path_factory, bundle):
    folder = tmp_path_factory.mktemp("web") / "site"
    shutil.copytree(VIEWER, folder)
    write_streamed_sog(bundle, folder / "donut", chunk=6000, up="z")
    handler = functools.partial(Handler, directory=folder)
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        server.asked, server.folder = [], folder
        threading.Thread(target=server.serve_forever).start()
        yield server
        server.shutdown()


def seen(browser, server, options=""):
    """The picture that the viewer settles at, (H, W, 3), and the levels whose files it asked for."""
    errors = []
    server.asked.clear()
    page = browser.new_page(viewport={"width": SIDE, "height": SIDE})
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on(
        "console",
        lambda m: m.type == "error" and "favicon" not in m.location["url"] and errors.append(m.text),
    )
    address = f"http://127.0.0.1:{server.server_address[1]}/index.html"
    page.goto(
        f"{address}?content=donut/lod-meta.json&settings=donut/settings.json&webgl&noui&noanim&fullload{options}"
    )
    picture = before = None
    for _ in range(60):
        page.wait_for_timeout(1000)
        before, picture = picture, np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB")) / 255
        if picture.max() > 0.2 and np.array_equal(before, picture):
            break
    page.close()
    assert errors == []
    levels = {path.split("/")[2][0] for path in server.asked if path.startswith("/donut/") and "_" in path}
    return picture, levels


def wanted(bundle, server):
    """Our picture from where the viewer looks, with the filter that it has."""
    pose = json.loads((server.folder / "donut" / "settings.json").read_text())["cameras"][0]["initial"]
    # The viewer has y up, and shows -y of an asset as up; the asset was turned so that z is.
    back = np.array([[-1, 0, 0], [0, 0, 1], [0, 1, 0]])
    eye, target = (back @ np.array(pose[name]) for name in ("position", "target"))
    fov = np.radians(pose["fov"])
    camera = v3dg.Camera.look_at(eye, target, (0, 0, 1), fov_x=fov, width=SIDE, height=SIDE)
    return np.clip(v3dg.rasterize(bundle.level_gaussians(0), camera, filter_px2=0.3).color, 0, 1)


def test_the_viewer_shows_what_we_do(browser, server, bundle):
    picture, levels = seen(browser, server)
    assert levels == {"0"}
    assert psnr(picture, wanted(bundle, server)) > 32


def test_a_budget_brings_coarser_levels_that_look_alike(browser, server, bundle):
    picture, levels = seen(browser, server, "&budget=0.006")
    assert "0" not in levels
    assert psnr(picture, wanted(bundle, server)) > 28
