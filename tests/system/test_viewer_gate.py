"""Which addresses may use the viewer, and what effects messages can have."""

import copy
import http.client
import io
import json
import random
import socket
import time
from dataclasses import asdict
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import v3dg
from v3dg.viewer.exports import bundle_names
from v3dg.viewer.frame import SceneView
from v3dg.viewer.server import Site, start_view
from v3dg.viewer.view import View

websockets = pytest.importorskip("websockets")
messages = pytest.importorskip("v3dg.viewer.messages")
viewer_client = pytest.importorskip("viewer_client")
gate = pytest.importorskip("v3dg.viewer.gate")

pytestmark = [
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.usefixtures("collected_connections"),
]

SIZE = (64, 48)
SECONDS = 60


@pytest.fixture
def opened(blob_view):
    """Return a function that opens sites. They are closed after the test."""
    sites = []

    def open_site(**options):
        sites.append(Site(blob_view, port=0, **options))
        return sites[-1]

    yield open_site
    for site in sites:
        assert site.close()


def status(site, path="/", **headers):
    """Return the HTTP status of the response to a request for the web page."""
    connection = http.client.HTTPConnection("127.0.0.1", site.port, timeout=SECONDS)
    connection.request("GET", path, headers=headers)
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer.status


def connects(site, path="/", **headers):
    """Return whether a web page with these headers may connect to the site."""
    try:
        viewer_client.Tab(site.port, path, additional_headers=headers).__exit__()
    except websockets.exceptions.InvalidStatus as refusal:
        return refusal.response.status_code != 403
    return True


def gets_a_picture(site, blob_view, path="/"):
    with viewer_client.Tab(site.port, path) as tab:
        tab.look(start_view(blob_view, (0, 0, 1)), SIZE)
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            pictures = tab.pictures(time.perf_counter() + 0.3)
            if any(picture.size == SIZE for _, picture in pictures):
                return True
    return False


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.example",
        "http://127.0.0.1",
        "http://127.0.0.1:1",
        "http://localhost:{port}",
        "http://127.0.0.1:{port}.evil.example",
        "http://evil@127.0.0.1:{port}",
        "null",
        "",
        "file://",
        "http://[",
        "ftp://127.0.0.1:{port}",
        "http://127.0.0.1:{port}/",
    ],
)
def test_other_pages_cannot_use_the_viewer(opened, origin):
    site = opened()
    origin = origin.format(port=site.port)
    assert not connects(site, Origin=origin)
    assert status(site, Origin=origin) == 403


@pytest.mark.parametrize(
    "host",
    [
        "evil.example:{port}",
        "127.0.0.1.evil.example:{port}",
        "localhost.evil.example",
        "192.0.2.1:{port}",
        "2130706433:{port}",
        "",
        "[",
        "[]",
        "[::1",
        "[::1]]",
        "[v1.a]",
        "[::1%1]",
        "evil.example@127.0.0.1.example",
        "evil.example@127.0.0.1",
        "127.0.0.1:x",
        "\u212aocalhost",
        "localhost/",
    ],
)
def test_names_that_others_lead_here_are_refused(opened, host):
    """If a foreign host name resolves to this machine, the Origin of a web page under
    that name equals its Host."""
    site = opened()
    host = host.format(port=site.port)
    assert status(site, Host=host.encode()) == 403
    message = "GET /connection HTTP/1.1\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    message += f"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {'A' * 22}==\r\n"
    with socket.create_connection(("127.0.0.1", site.port)) as connection:
        connection.sendall(f"{message}Host: {host}\r\nOrigin: http://{host}\r\n\r\n".encode())
        assert connection.recv(12) == b"HTTP/1.1 403"


@pytest.mark.parametrize("name", ["127.0.0.1", "localhost", "LOCALHOST", "127.8.7.6", "[::1]"])
def test_this_machine_may_use_the_viewer_by_any_of_its_names(opened, name):
    """All of its names are accepted with other ports, too, because a port may be
    forwarded."""
    site = opened()
    for host in (f"{name}:{site.port}", f"{name}:9999", name):
        assert site._gate.refusal(request(Host=host, Origin=f"http://{host}")) is None
        assert site._gate.refusal(request(Host=host, Origin=f"https://{host}")) is None
    assert status(site) == 200
    assert connects(site, Origin=f"http://127.0.0.1:{site.port}")


def request(path="/", **headers):
    return websockets.http11.Request(path, websockets.datastructures.Headers(**headers))


TAB = {"Sec-Fetch-Mode": "navigate", "Sec-Fetch-Dest": "document"}


@pytest.mark.parametrize(
    "relation", ["cross-site", "same-site", "", "Same-Origin", "none, cross-site"]
)
def test_pages_of_other_sites_are_shown_nothing(opened, relation):
    """The browser sends how other sites are related to the viewer, even with requests
    for pictures, which have no Origin."""
    site = opened()
    for path in ("/", "/main.js", "/photograph/0", "/connection"):
        for destination in ("image", "script", "style", "iframe", "object", "empty"):
            for mode in ("no-cors", "cors", "navigate"):
                said = {
                    "Sec-Fetch-Mode": mode,
                    "Sec-Fetch-Dest": destination,
                    "Sec-Fetch-Site": relation,
                }
                assert status(site, path, **said) == 403, (path, said)
    assert not connects(site, **{"Sec-Fetch-Site": relation})
    assert not connects(site, **{"Sec-Fetch-Site": relation}, **TAB)
    assert status(site, "/main.js", **{"Sec-Fetch-Site": relation}, **TAB) == 403


def test_a_link_on_another_page_opens_the_viewer_in_a_tab(opened):
    site = opened()
    for path in ("/", "/index.html", "/?x"):
        assert status(site, path, **{"Sec-Fetch-Site": "cross-site"}, **TAB) == 200


@pytest.mark.parametrize("relation", ["same-origin", "none"])
def test_the_viewers_own_page_is_let_in(opened, relation):
    site = opened()
    assert (
        status(site, "/main.js", **{"Sec-Fetch-Site": relation, "Sec-Fetch-Dest": "script"}) == 200
    )
    assert connects(site, **{"Sec-Fetch-Site": relation, "Sec-Fetch-Mode": "websocket"})


WEBSOCKET = (
    "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
    f"Sec-WebSocket-Key: {'A' * 22}==\r\n"
)


@pytest.mark.parametrize(
    ("path", "more", "answer"),
    [
        ("/", "", 200),
        ("/nothing", "", 404),
        ("/", "Origin: http://evil.example\r\n", 403),
        ("/connection", WEBSOCKET, 101),
        ("/connection", WEBSOCKET + "Origin: http://evil.example\r\n", 403),
        ("/connection", WEBSOCKET.replace("==", ""), 400),
        ("/connection", "Upgrade: x\r\n", 426),
    ],
)
def test_every_answer_is_for_the_viewers_own_page_alone(opened, path, more, answer):
    site = opened()
    with socket.create_connection(("127.0.0.1", site.port)) as connection:
        connection.sendall(f"GET {path} HTTP/1.1\r\nHost: 127.0.0.1\r\n{more}\r\n".encode())
        said = b""
        while b"\r\n\r\n" not in said:
            said += connection.recv(1 << 16)
    lines = said.split(b"\r\n\r\n")[0].decode().lower().split("\r\n")
    assert lines[0].split()[1] == str(answer)
    for line in (
        "cross-origin-resource-policy: same-origin",
        "cross-origin-opener-policy: same-origin",
        "x-content-type-options: nosniff",
        "x-frame-options: deny",
        "referrer-policy: no-referrer",
        "cache-control: no-store",
    ):
        assert lines.count(line) == 1, line
    assert not [line for line in lines if line.startswith("server:")]


def test_an_upgrade_elsewhere_is_refused_in_silence(opened, capfd):
    site = opened()
    with pytest.raises(websockets.exceptions.InvalidStatus, match="200"):
        websockets.sync.client.connect(f"ws://127.0.0.1:{site.port}")
    assert capfd.readouterr() == ("", "")


def test_a_page_is_shown_in_no_other_and_runs_only_its_own_files(opened):
    site = opened()
    connection = http.client.HTTPConnection("127.0.0.1", site.port, timeout=SECONDS)
    connection.request("GET", "/?x=http://evil.example")
    policy = connection.getresponse().headers["Content-Security-Policy"]
    connection.close()
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules["default-src"] == rules["frame-ancestors"] == rules["base-uri"] == "'none'"
    assert rules["script-src"] == rules["connect-src"] == rules["style-src"] == "'self'"


@pytest.mark.parametrize(
    "path",
    [
        "/../gate.py",
        "/%2e%2e/gate.py",
        "/page/index.html",
        "/photograph/0",
        "/thumbnail/0",
        "/photograph/x",
    ],
)
def test_nothing_but_the_page_is_handed_out(opened, path):
    assert status(opened(), path) == 404


def test_photographs_of_cameras_are_handed_out_small(opened, tmp_path):
    Image.fromarray(np.full((900, 2400, 3), 200, np.uint8)).save(tmp_path / "a.png")
    (tmp_path / "b.png").write_bytes(b"no picture")
    camera = v3dg.Camera.look_at((9, 0, 0), (0, 0, 0), width=64, height=48)
    photographs = {name: tmp_path / f"{name}.png" for name in ("a", "b", "gone")}
    site = opened(
        cameras=dict.fromkeys(("none", "a", "b", "gone"), camera), photographs=photographs
    )
    connection = http.client.HTTPConnection("127.0.0.1", site.port, timeout=SECONDS)
    for path, size in (("/photograph/1", (1600, 600)), ("/thumbnail/1", (240, 90))):
        connection.request("GET", path)
        with Image.open(io.BytesIO(connection.getresponse().read())) as picture:
            assert picture.size == size
    connection.close()
    for place in (0, 2, 3, 4, -1):
        assert status(site, f"/photograph/{place}") == 404


def test_a_photograph_that_cannot_be_decoded_is_not_there(opened, tmp_path, monkeypatch):
    """Pillow may also raise SyntaxError and struct.error for damaged files."""

    def fail(*_):
        raise SyntaxError("not a TIFF file")

    monkeypatch.setattr(Image, "open", fail)
    camera = v3dg.Camera.look_at((9, 0, 0), (0, 0, 0), width=64, height=48)
    site = opened(cameras={"a": camera}, photographs={"a": tmp_path / "a.tif"})
    assert status(site, "/photograph/0") == 404


@pytest.mark.parametrize("host", ["0.0.0.0", "::"])
def test_other_machines_need_the_token(opened, blob_view, host):
    if host == "::" and not socket.has_dualstack_ipv6():
        pytest.skip("this machine has no IPv6")
    site = opened(host=host)
    token = urlsplit(site.url).path
    assert len(token) > 20
    gate = site._gate
    assert gate.refusal(request(f"{token}?fixedDpr=1", Host="any.example")) is None
    begun = token.rstrip("/")
    wrong = (
        begun,
        begun[:-1] + "/",
        begun + "x/",
        token.swapcase(),
        "/x" + token,
        "/é/",
        "/\udcff/",
        "/",
        "",
        "//",
        "/?",
    )
    for path in wrong:
        assert gate.refusal(request(path, Host="any.example")) is not None, path
    other = request(token, Host="any.example", Origin="http://evil.example")
    assert gate.refusal(other) is not None
    if host == "0.0.0.0":
        assert status(site) == 403
        assert (
            status(site, token)
            == status(site, token + "?x")
            == status(site, token + "main.js")
            == 200
        )
        assert status(site, token + ".." + token) == 404
        assert not connects(site)
        assert gets_a_picture(site, blob_view, token)


def test_this_machine_alone_needs_no_token(opened):
    site = opened(host="localhost")
    assert site.url == f"http://localhost:{site.port}"
    assert Site.close(site)


def test_no_two_sites_have_the_same_token(opened):
    assert urlsplit(opened(host="0.0.0.0").url).path != urlsplit(opened(host="0.0.0.0").url).path


def test_where_no_port_is_free_the_viewer_does_not_wait_for_ever(blob_view):
    with (
        socket.create_server(("127.0.0.1", 65535)),
        pytest.raises(ValueError, match="port: expected a free port"),
    ):
        Site(blob_view, port=65535)


@pytest.mark.parametrize(
    "window", [(100_000, 100_000), (1 << 20, 1), (1, 1 << 20), (4096, 4096), (30, 20)]
)
def test_the_largest_picture_is_not_the_windows(window):
    view = {"wxyz": (1, 0, 0, 0), "position": (0, 0, 0), "fov_y": 1, "aspect": 1}
    look = messages.read_message(json.dumps({"type": "look", "view": view, "size": window}))
    width, height = look.request().size
    assert 1 <= width <= 4096
    assert 1 <= height <= 4096
    if max(window) <= 4096:
        assert (width, height) == window


def test_bundles_go_by_their_names(blob_bundle, tmp_path):
    scene = v3dg.Scene()
    for name in ("secret/a.v3dg", "secret/more/b.v3dg"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        blob_bundle.write(tmp_path / name)
        scene.add(v3dg.Bundle.open(tmp_path / name))
    assert bundle_names(scene) == ["a.v3dg", "more/b.v3dg"]
    assert bundle_names(v3dg.Scene()) == []
    error = OSError(5, "cannot be read", str(tmp_path / "secret" / "a.v3dg"))
    assert SceneView(scene, device="cpu").explain(error) == "[Errno 5] cannot be read: 'a.v3dg'"


# Malicious messages.

NASTY = [
    None, True, False, 0, -1, 1, 3.14, 1e-300, 1e300, -1e308,
    float("nan"), float("inf"), -float("inf"), 2**63, -(2**63), 2**64 - 1,
    "", "nan", "1e400", "\x1b[31m", "x" * 5000, "\x00", [], [0], [[[]]], {},
    {"value": 1}, [0, 0, 0], [0, 0, 0, 0], [1e15] * 3, [float("nan")] * 4,
]  # fmt: skip


def mutated(rng, message):
    """Return the message with one or more changes."""
    message = copy.deepcopy(message)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        place, nasty = message, copy.deepcopy(rng.choice(NASTY))
        while place:
            key = rng.choice(list(place) if isinstance(place, dict) else range(len(place)))
            if not isinstance(place[key], (dict, list)) or rng.random() < 0.4:
                break
            place = place[key]
        if isinstance(place, dict):
            if rng.random() < 0.2:
                place.pop(key, None)
                key = rng.choice(("x", "type", "frozen", "instance", "look"))
            place[key] = nasty
        elif place:
            place[key] = nasty
    return message


def hostile(rng, messages, kinds):
    """Return a random message that no browser sends."""
    choice, message = rng.random(), mutated(rng, rng.choice(messages))
    if choice < 0.7:
        return message
    if choice < 0.8:
        return {**message, "type": rng.choice(kinds)}
    text = list(json.dumps(message))
    if choice < 0.85:
        return "".join(text[: rng.randrange(len(text))])
    if choice < 0.95:
        for _ in range(rng.randint(1, 4)):
            text[rng.randrange(len(text))] = chr(rng.randrange(256))
        return "".join(text)
    return rng.choice(("text", "{}", "", "[" * 3000, "NaN", b"bytes", b"", b"x" * 100_000))


def test_no_message_ends_the_viewer(opened, blob_view, capfd):
    """Thousands of wrong messages, with valid ones in between, are sent while the
    viewer draws. The viewer ignores the wrong ones and continues."""
    aside = v3dg.Camera.look_at((9, 0, 0), (0, 0, 0), width=64, height=48)
    site, rng = opened(cameras={"aside": aside}), random.Random(7)
    kinds = [kind.__struct_config__.tag for kind in messages.Message.__args__]
    home, sent = start_view(blob_view, (0, 0, 1)), 0
    path = [(0.1, home), (0.1, View((1, 0, 0, 0), (0, 0, -9), 1.0, 1.5))]
    poses = blob_view.scene.poses
    while sent < 4000:
        with viewer_client.Tab(site.port) as tab:
            ours = [tab.look(home, SIZE)]
            ours += [dict(tab.change(shows="depth", budget=10_000, frozen=asdict(home)))] * 4
            ours += [tab.pick(at=(0.5, 0.5)), tab.pick(instance=0), tab.move(0, (0, 0, 0))]
            ours += [tab.save(what, path) for what in ("picture", "cameras", "play", "scene")]
            ours += [{"type": "stop"}, {"type": "open", "name": "a.ply", "size": 100}]
            tab.pictures(time.perf_counter() + 0.3)
            try:
                for _ in range(400):
                    tab.send(hostile(rng, ours, kinds))
                    sent += 1
                tab.pictures(time.perf_counter() + 0.2)
                tab.look(View((1, 0, 0, 0), (1e15, -1e15, 0), 1e-4, 1.0), (1, 1 << 20))
                tab.pictures(time.perf_counter() + 0.2)
            except websockets.exceptions.ConnectionClosed:
                pass  # the viewer may close such a connection
    for now, before in zip(blob_view.scene.poses, poses, strict=True):
        assert np.isfinite(now).all()
        assert now.shape == before.shape
    blob_view.scene.move(positions=poses[0], quaternions=poses[1], scales=poses[2])
    assert gets_a_picture(site, blob_view)
    assert capfd.readouterr() == ("", "")
