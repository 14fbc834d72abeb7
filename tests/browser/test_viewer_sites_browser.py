"""A web page of another site learns nothing about the viewer in Chromium, not even the
size of a picture. The tests need playwright, and Chromium on PATH. The other page has
another port. It has either the viewer's host name, which the browser treats as the same
site, or another host name, which the browser treats as a different site.
"""

import http.server
import threading

import numpy as np
import pytest
from PIL import Image

import chromium
import scenes_lod
import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site

pytest.importorskip("websockets")
pytest.importorskip("playwright.sync_api")

pytestmark = [
    pytest.mark.witness,
    pytest.mark.skipif(
        chromium.PROGRAM is None, reason="neither chromium nor google-chrome is installed"
    ),
]

SECONDS = 60
# Each probe reports what it learned: "nothing" if the browser reports only a failure.
PROBES = """async (viewer) => {
  const element = (tag, fields) => new Promise((resolve) => {
    const node = document.createElement(tag);
    node.onload = node.onloadedmetadata = () => resolve(`loaded ${node.naturalWidth ?? ""}`);
    node.onerror = () => resolve("nothing");
    Object.assign(node, fields);
    document.body.append(node);
  });
  const asked = (path, options) =>
    fetch(viewer + path, options).then((a) => `${a.type}`, () => "nothing");
  const connected = (path) => new Promise((resolve) => {
    const socket = new WebSocket(viewer.replace("http", "ws") + path);
    socket.onopen = () => resolve("open");
    socket.onclose = () => resolve("nothing");
  });
  const probes = {
    photograph: element("img", { src: viewer + "photograph/0" }),
    thumbnail: element("img", { src: viewer + "thumbnail/0" }),
    missing: element("img", { src: viewer + "photograph/1" }),
    icon: element("img", { src: viewer + "icon.svg" }),
    anonymous: element("img", { crossOrigin: "anonymous", src: viewer + "thumbnail/0" }),
    script: element("script", { src: viewer + "math.js" }),
    module: element("script", { type: "module", src: viewer + "math.js" }),
    style: element("link", { rel: "stylesheet", href: viewer + "style.css" }),
    video: element("video", { src: viewer + "photograph/0" }),
    embedded: element("object", { data: viewer + "photograph/0" }),
    fetched: asked("thumbnail/0", {}),
    opaque: asked("thumbnail/0", { mode: "no-cors" }),
    kept: asked("main.js", { mode: "no-cors", cache: "force-cache" }),
    connection: connected("connection"),
  };
  const learned = {};
  for (const [name, probe] of Object.entries(probes)) learned[name] = await probe;
  const entries = performance.getEntriesByType("resource")
    .filter((entry) => entry.name.startsWith(viewer));
  learned.sizes = entries.reduce(
    (sum, entry) => sum + entry.decodedBodySize + entry.transferSize, 0);
  return learned;
}"""
NAMES = (
    "photograph",
    "thumbnail",
    "missing",
    "icon",
    "anonymous",
    "script",
    "module",
    "style",
    "video",
)
NAMES += ("embedded", "fetched", "opaque", "kept", "connection")
NOTHING = dict.fromkeys(NAMES, "nothing")
FRAME = """(viewer) => new Promise((resolve) => {
  const frame = document.createElement("iframe");
  frame.onload = () => resolve(frame.contentWindow.length);
  frame.src = viewer;
  document.body.append(frame);
})"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    rng = np.random.default_rng(0)
    photograph = tmp_path_factory.mktemp("photographs") / "a.png"
    Image.fromarray(rng.integers(0, 255, (90, 160, 3), np.uint8)).save(photograph)
    scene_view = SceneView(
        scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 300, size=0.3), 64), device="cpu"
    )
    camera = v3dg.Camera.look_at((6, 0, 0), (0, 0, 0), width=160, height=90)
    site = Site(scene_view, cameras={"a": camera}, photographs={"a": photograph}, port=0)
    yield site
    site.close()


class Blank(http.server.BaseHTTPRequestHandler):
    """A web page of another site. The tests provide its scripts."""

    def do_GET(self):
        body = b"<!doctype html><title>other</title><body>"
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_):
        pass


@pytest.fixture(scope="module")
def other_port():
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Blank) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield server.server_port
        server.shutdown()
        thread.join()


@pytest.fixture(params=["127.0.0.1", "localhost"])
def other(browser, other_port, request):
    """Yield a web page of the same site, and one of another site. The viewer is opened
    as 127.0.0.1."""
    page = browser.new_page()
    page.goto(f"http://{request.param}:{other_port}/")
    yield page
    page.close()


def test_another_page_learns_nothing(other, site):
    learned = other.evaluate(PROBES, f"{site.url}/")
    assert learned.pop("sizes") == 0
    assert learned == NOTHING


def test_another_page_learns_nothing_by_another_name_of_this_machine(other, site):
    learned = other.evaluate(PROBES, f"http://localhost:{site.port}/")
    assert learned.pop("sizes") == 0
    assert learned == NOTHING


def test_the_viewers_own_page_has_all_of_it(browser, site):
    """This shows that the probes find something where they are allowed to."""
    page = browser.new_page()
    page.goto(site.url)
    learned = page.evaluate(PROBES, f"{site.url}/")
    page.close()
    assert learned["photograph"] == learned["thumbnail"] == "loaded 160"
    assert learned["script"] == learned["module"] == learned["style"] == "loaded "
    assert learned["fetched"] == "basic"
    assert learned["connection"] == "open"


def test_another_page_cannot_frame_the_viewer(other, site):
    assert other.evaluate(FRAME, site.url) == 0
    frame = other.frames[-1]
    assert frame.query_selector("#stage") is None


def test_a_link_opens_the_viewer_without_a_handle_on_it(other, site):
    with other.expect_popup() as opened:
        other.evaluate("(viewer) => { window.tab = window.open(viewer); }", site.url)
    tab = opened.value
    tab.wait_for_selector("body:not([data-state='connecting']) #stage", timeout=SECONDS * 1000)
    assert tab.evaluate("window.opener") is None
    assert other.evaluate("window.tab.closed")
    tab.close()
