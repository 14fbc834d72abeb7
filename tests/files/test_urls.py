"""Files at URLs, which fsspec fetches."""

import contextlib
import gc
import http.server
import json
import os
import pickle
import re
import signal
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from pathlib import Path

import numpy as np
import pytest

import v3dg
from command_line import TESTS_ENVIRONMENT
from fuzz.attacks import servers
from gltf_files import GltfFile
from random_bundle import random_bundle, random_gaussians
from scenes_lod import blob, lod_bundle
from v3dg import _urls, cli
from v3dg._urls.addresses import Reach, reach_of
from v3dg._urls.failures import DownloadError
from v3dg._urls.http import WebSource

fsspec = pytest.importorskip("fsspec")

FAR = v3dg.Camera.look_at((0, -60, 4), (0, 0, 0), width=93, height=61)
NEAR = v3dg.Camera.look_at((0, -9, 1), (0, 0, 0), width=93, height=61)
COARSE, FINE = {"tolerance": 20.0}, {"tolerance": 0.0}
URL = "memory://in/many.v3dg"


@pytest.fixture
def there(monkeypatch):
    """A place that only fsspec can reach."""
    monkeypatch.setattr("v3dg._urls.opened._opened", {})
    memory = fsspec.filesystem("memory")
    yield memory
    memory.rm("/", recursive=True)


@pytest.fixture
def fetched(there, monkeypatch):
    """Return a list of the parts of files that were fetched from there."""
    parts, fetch = [], type(there).cat_file

    def counted(self, path, start=None, end=None, **options):
        data = fetch(self, path, start, end, **options)
        parts.append((start, len(data)))
        return data

    monkeypatch.setattr(type(there), "cat_file", counted)
    return parts


def put(there, tmp_path, seed=0):
    """A bundle of about 250 pages there, and the same file here."""
    rng = np.random.default_rng(seed)
    path = tmp_path / "many.v3dg"
    lod_bundle(rng, blob(rng, 5000, sh_degree=1), 32).write(path)
    there.put_file(str(path), "/in/many.v3dg")
    return path


@pytest.fixture
def many(there, tmp_path):
    return put(there, tmp_path)


def num_bytes(parts):
    return sum(size for _, size in parts)


def same_picture(first, second):
    return np.array_equal(first.color, second.color) and np.array_equal(first.alpha, second.alpha)


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


@pytest.mark.parametrize(
    "url", ["memory://in/a.ply", Path("memory://in/a.ply"), "memory://in/a%2Eply?x=1"]
)
def test_assets_are_read_from_urls(there, asset, url):
    if "%" in str(url):
        there.mv("/in/a.ply", "/in/a%2Eply?x=1")
    for read in (v3dg.open, v3dg.read_asset):
        np.testing.assert_array_equal(read(url).means, asset.means)


def test_opening_a_bundle_fetches_its_tables(fetched, many, capsys):
    bundle = v3dg.open(URL)
    size, pages = many.stat().st_size, bundle.page_bytes
    assert 0 < num_bytes(fetched) <= size - pages + 4096 < size / 4
    assert cli.main(["info", URL]) == 0
    assert num_bytes(fetched) <= size - pages + 4096
    assert bundle.path == URL
    np.testing.assert_array_equal(
        pickle.loads(pickle.dumps(bundle)).groups.ball, bundle.groups.ball
    )
    assert pickle.loads(pickle.dumps(bundle)).path == URL


def test_pictures_fetch_what_they_need_and_no_part_twice(fetched, many):
    bundle, here = v3dg.open(URL), v3dg.open(many)
    before = num_bytes(fetched)
    renderer = v3dg.Renderer(bundle, device="cpu")
    renderer.settle(FAR, **COARSE)
    assert same_picture(
        renderer.render(FAR, **COARSE), v3dg.render(here, FAR, device="cpu", **COARSE)
    )
    of_far = num_bytes(fetched) - before
    assert 0 < of_far < bundle.page_bytes / 4
    assert same_picture(
        v3dg.render(bundle, FAR, device="cpu", **COARSE),
        v3dg.render(here, FAR, device="cpu", **COARSE),
    )
    assert num_bytes(fetched) - before == of_far
    assert not bundle.is_in_memory
    picture = v3dg.render(bundle, NEAR, device="cpu", **FINE)
    assert same_picture(picture, v3dg.render(here, NEAR, device="cpu", **FINE))
    for level in range(bundle.num_levels):
        np.testing.assert_array_equal(
            bundle.level_gaussians(level).means, here.level_gaussians(level).means
        )
    np.testing.assert_array_equal(v3dg.open(URL).gaussians.sh, here.gaussians.sh)
    # Blocks that contain parts of two pages may have been requested for both.
    assert num_bytes(fetched) <= many.stat().st_size + 1024 * len(fetched)
    count = len(fetched)
    assert bundle.gaussians is not None
    assert len(fetched) == count


def test_long_parts_come_in_pieces(fetched, many, monkeypatch):
    monkeypatch.setattr("v3dg._urls.opened._MOST_BLOCKS", 12)
    np.testing.assert_array_equal(v3dg.open(URL).gaussians.means, v3dg.open(many).gaussians.means)
    assert max(size for _, size in fetched) == 12 * 1024
    assert num_bytes(fetched) == many.stat().st_size


def test_a_server_that_fails_leaves_the_picture_coarser_and_is_named(there, many, monkeypatch):
    other = v3dg.open(URL)
    v3dg._urls.opened._opened.clear()
    renderer = v3dg.Renderer(v3dg.open(URL), device="cpu", memory="64MB")

    def fails(*_, **__):
        raise ConnectionError("503, Service Unavailable")

    with monkeypatch.context() as patch:
        patch.setattr(type(there), "cat_file", fails)
        message = r"^memory://in/many\.v3dg: page \d+: the connection was lost.* \(503, Service"
        with pytest.raises(OSError, match=message):
            renderer.settle(NEAR, **FINE)
        image = renderer.render(NEAR, **FINE)
        assert image.stats.missing > 0
        assert image.alpha.max() > 0.1
        with pytest.raises(OSError, match="503, Service Unavailable"):
            v3dg.open(URL).level_gaussians(0)
        with pytest.raises(OSError, match="503, Service Unavailable"):
            v3dg.Renderer(other, device="cpu", memory="64MB")  # reads the coarsest page
    renderer.settle(NEAR, **FINE)
    assert same_picture(
        renderer.render(NEAR, **FINE), v3dg.render(many, NEAR, device="cpu", **FINE)
    )


def test_a_server_that_does_not_answer_ends_the_wait(there, many, monkeypatch):
    renderer = v3dg.Renderer(v3dg.open(URL), device="cpu", memory="64MB")
    answers, fetch = threading.Event(), type(there).cat_file

    def slow(*given, **options):
        answers.wait(60)
        return fetch(*given, **options)

    monkeypatch.setattr(type(there), "cat_file", slow)
    start = time.monotonic()
    with pytest.raises(TimeoutError, match="pages are missing and none arrived"):
        renderer.settle(NEAR, timeout=0.2, **FINE)
    assert renderer.render(NEAR, **FINE).stats.missing > 0  # does not wait
    assert time.monotonic() - start < 30
    answers.set()
    renderer.settle(NEAR, **FINE)
    assert same_picture(
        renderer.render(NEAR, **FINE), v3dg.render(many, NEAR, device="cpu", **FINE)
    )


@pytest.mark.parametrize("is_shorter", [False, True])
def test_what_changes_at_its_url_is_an_error_until_it_is_opened_again(
    there, many, tmp_path, is_shorter
):
    bundle = v3dg.open(URL)
    if is_shorter:
        there.pipe_file("/in/many.v3dg", many.read_bytes()[:5000])
        message = r"expected \d+ bytes at offset \d+, got \d+; the file has changed, open it again"
    else:
        put(there, tmp_path, seed=1)
        message = "the hash does not match"
    with pytest.raises((OSError, ValueError), match=rf"^memory://in/many\.v3dg: .*{message}"):
        v3dg.render(bundle, NEAR, device="cpu", **FINE)
    with pytest.raises((OSError, ValueError), match=rf"^memory://in/many\.v3dg: .*{message}"):
        bundle.level_gaussians(0)
    if not is_shorter:
        picture = v3dg.render(URL, NEAR, device="cpu", **FINE)
        assert same_picture(picture, v3dg.render(many, NEAR, device="cpu", **FINE))


def test_a_place_that_knows_no_parts_is_fetched_whole_once(there, fetched, many, monkeypatch):
    counted = type(there).cat_file
    monkeypatch.setattr(type(there), "cat_file", lambda self, path, *_, **__: counted(self, path))
    picture = v3dg.render(URL, NEAR, device="cpu", **FINE)
    assert same_picture(picture, v3dg.render(many, NEAR, device="cpu", **FINE))
    assert fetched == [(None, many.stat().st_size)]


def test_a_file_of_unknown_size_is_fetched_whole(there, fetched, many, monkeypatch):
    info = type(there).info
    monkeypatch.setattr(type(there), "info", lambda self, path: info(self, path) | {"size": None})
    np.testing.assert_array_equal(v3dg.open(URL).gaussians.means, v3dg.open(many).gaussians.means)
    assert fetched == []


def test_a_process_ends_while_parts_are_on_their_way(tmp_path):
    """This also holds while threads wait for Python."""
    code = """
import sys, time
import fsspec, numpy as np
from pathlib import Path
import test_urls, v3dg
there = fsspec.filesystem("memory")
test_urls.put(there, Path(sys.argv[1]))
renderer = v3dg.Renderer(v3dg.open(test_urls.URL), device="cpu", memory="64MB")
type(there).cat_file = lambda *_, **__: time.sleep(float(sys.argv[2])) or b""
for _ in range(3):
    renderer.render(test_urls.NEAR, tolerance=0.0).stats
    time.sleep(0.05)
"""
    for seconds in ("60", "0.05", "0"):
        command = [sys.executable, "-c", code, tmp_path, seconds]
        done = subprocess.run(
            command, env=TESTS_ENVIRONMENT, capture_output=True, text=True, timeout=50, check=False
        )
        assert (done.returncode, done.stderr) == (0, "")


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Serves one folder, with ranges, and counts the bytes that it sends."""

    protocol_version = "HTTP/1.1"
    knows_ranges = True

    def log_message(self, *_):
        pass

    def do_HEAD(self):
        self.answer(with_body=False)

    def do_GET(self):
        self.answer(with_body=True)

    def answer(self, with_body):
        path = Path(self.translate_path(self.path))
        if not path.is_file():
            return self.send_error(404)
        body = path.read_bytes()
        asked = (
            re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", ""))
            if self.knows_ranges
            else None
        )
        if asked:
            self.send_response(206)
            self.send_header("Content-Range", f"bytes {asked[1]}-{asked[2]}/{len(body)}")
            body = body[int(asked[1]) : int(asked[2]) + 1]
        else:
            self.send_response(200)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Last-Modified", self.date_time_string(int(path.stat().st_mtime)))
        self.end_headers()
        if with_body:
            self.server.sent.append(len(body))
            self.wfile.write(body)


@pytest.fixture
def web(tmp_path, monkeypatch):
    """A web server of a folder: its address and the number of bytes that it sent."""
    pytest.importorskip("aiohttp")
    monkeypatch.setattr("v3dg._urls.opened._opened", {})

    class Handler(_Handler):
        def __init__(self, *given):
            super().__init__(*given, directory=tmp_path)

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.sent, server.handler = [], Handler
    server.address = f"http://127.0.0.1:{server.server_port}"
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server
    server.shutdown()
    server.server_close()


@pytest.mark.parametrize("knows_ranges", [True, False])
def test_bundles_of_a_web_server_are_read_in_parts(
    web, tmp_path, knows_ranges, monkeypatch, capsys
):
    web.handler.knows_ranges = knows_ranges
    rng = np.random.default_rng(0)
    lod_bundle(rng, blob(rng, 5000, sh_degree=1), 32).write(tmp_path / "many.v3dg")
    size = (tmp_path / "many.v3dg").stat().st_size
    monkeypatch.chdir(tmp_path)
    url = f"{web.address}/many.v3dg"
    assert cli.main(["info", url]) == 0
    assert (sum(web.sent) < size / 4) == knows_ranges
    picture = v3dg.render(url, FAR, device="cpu", **COARSE)
    assert same_picture(picture, v3dg.render("many.v3dg", FAR, device="cpu", **COARSE))
    assert sum(web.sent) < size / 2 if knows_ranges else web.sent == [size]
    picture = v3dg.render(url, NEAR, device="cpu", **FINE)
    assert same_picture(picture, v3dg.render("many.v3dg", NEAR, device="cpu", **FINE))
    assert cli.main(["render", url.replace("many", "none"), "--device", "cpu"]) == 1
    assert (
        f"{web.address}/none.v3dg: the server answered 404 Not Found; check"
        in capsys.readouterr().err
    )


def test_a_file_here_of_that_name_comes_first(there, asset, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "memory:" / "in").mkdir(parents=True)
    v3dg.write_asset("memory:/in/a.ply", asset.subset(slice(0, 7)))
    assert len(v3dg.read_asset("memory://in/a.ply")) == 7


def test_commands_take_urls_and_write_into_the_working_folder(
    there, asset, bundle, tmp_path, monkeypatch, capsys
):
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert cli.main(["info", "memory://in/a.ply"]) == 0
    assert capsys.readouterr().out.startswith("memory://in/a.ply: asset, ")
    assert cli.main(["build", "memory://in/a.ply", "--quiet", "--device", "cpu"]) == 0
    assert (
        cli.main(
            ["render", "memory://in/a.v3dg", "--device", "cpu", "--size", "16", "16", "--json"]
        )
        == 0
    )
    assert '"subject": "memory://in/a.v3dg"' in capsys.readouterr().out
    assert cli.main(["export", "memory://in/a.v3dg", "--quiet"]) == 0
    assert sorted(path.name for path in Path().iterdir()) == ["a.png", "a.v3dg", "a_web"]


@pytest.mark.parametrize(
    ("url", "message"),
    [
        (
            "memory://in/none.ply",
            r"memory://in/none\.ply: there is no such file; check the address",
        ),
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("memory://in/scene.json", "expected a scene on this machine, got a URL"),
        ("memory://in/lod-meta.json", "got the URL of a file that refers to other files"),
        ("memory://in/a.txt", "memory://in/a.txt: expected a file ending in"),
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
    assert v3dg._urls.opened._opened == {}


def test_no_scene_is_saved_with_what_goes_at_the_end(there, bundle, tmp_path):
    scene = v3dg.Scene.of(v3dg.open("memory://in/a.v3dg"))
    with pytest.raises(
        ValueError, match="got one in memory or at a URL; write it to a file and open that"
    ):
        scene.save(tmp_path / "a.json")


def test_without_fsspec_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(
        ImportError, match=r"files at URLs: expected fsspec.*pip install 'fsspec\[http\]"
    ):
        v3dg.open("memory://in/b.ply")


# ---- Names, and what is shown of them.
@pytest.mark.parametrize(
    ("url", "text"),
    [
        ("https://me:pw@host:80/a/b.ply?sig=s#f", "https://host:80/a/b.ply"),
        ("https:/me:pw@host/a.ply", "https://host/a.ply"),
        ("https://token@host/a.ply?X-Amz-Signature=s", "https://host/a.ply"),
        ("https://me:p@w@host/a.ply", "https://host/a.ply"),
        ("https://me:p/w@host/a.ply", "https://host/a.ply"),
        ("https://me:p?w@host/a.ply", "https://host/a.ply"),
        ("https://me:p#w@host/a.ply", "https://host/a.ply"),
        ("https://host/@scope/a.ply", "https://host/@scope/a.ply"),
        ("https://host:8080/@scope/a.ply", "https://host:8080/@scope/a.ply"),
        ("https://[::1]:80/@scope/a.ply", "https://[::1]:80/@scope/a.ply"),
        ("s3://bucket/a.v3dg?versionId=1", "s3://bucket/a.v3dg"),
        ("file:/a/b.ply", "file:///a/b.ply"),
        ("a/b?c@d.ply", "a/b?c@d.ply"),
    ],
)
def test_a_url_is_shown_without_what_may_be_secret(url, text):
    assert _urls.shown(url) == _urls.shown(Path(url)) == text


def test_urls_in_other_texts_are_shown_without_secrets():
    text = "Cannot connect (https://me:pw@host/a.ply?sig=s): see 'http://host/b#x', https://host/c."
    assert _urls.cleaned(text) == (
        "Cannot connect (https://host/a.ply): see 'http://host/b', https://host/c."
    )


SECRETS = "me:hunter2@"


def secret_url(web, name):
    return f"{web.address.replace('//', f'//{SECRETS}')}/{name}?sig=s1gnature&token=Zm9v"


def test_no_output_has_a_password_or_a_signature(web, tmp_path, monkeypatch, capsys):
    (tmp_path / "here").mkdir()
    random_bundle(0).write(tmp_path / "a.v3dg")
    v3dg.write_asset(tmp_path / "a.ply", random_gaussians(np.random.default_rng(0), 300))
    monkeypatch.chdir(tmp_path / "here")
    bundle, asset, none = (secret_url(web, name) for name in ("a.v3dg", "a.ply", "none.ply"))
    small = ["--size", "16", "16", "--device", "cpu"]
    for code, command in (
        (0, ["info", bundle]),
        (0, ["info", asset, "--json"]),
        (0, ["render", bundle, *small, "--json"]),
        (0, ["compare", asset, bundle, *small, "--views", "1", "--json"]),
        (0, ["build", asset, "--device", "cpu", "--json"]),
        (0, ["export", bundle]),
        (0, ["convert", bundle, "b.ply"]),
        (1, ["info", none]),
        (1, ["build", none]),
        (1, ["build", none, asset, "-o", "many", "--device", "cpu", "--json"]),
        (1, ["info", secret_url(web, "scene.json")]),
        (1, ["export", asset]),
        (2, ["info", asset, bundle]),
        (2, ["convert", asset, "b.ply", "--level", "0"]),
    ):
        assert cli.main(command) == code, command
        told = "".join(capsys.readouterr())
        assert not re.search("hunter2|s1gnature|Zm9v", told), (command, told)
    names = sorted(path.name for path in Path().rglob("*"))
    assert not re.search("hunter2|s1gnature|Zm9v|sig=", " ".join(names))
    assert {"a.png", "a.v3dg", "a_web", "b.ply"} <= set(names)


def test_errors_and_their_causes_have_no_password(web):
    with pytest.raises(FileNotFoundError) as caught:
        v3dg.open(secret_url(web, "none.v3dg"))
    text = "".join(traceback.format_exception_only(caught.value))
    assert "hunter2" not in text
    assert caught.value.__suppress_context__
    assert caught.value.__cause__ is None


def test_what_is_shown_of_a_bundle_has_no_password_and_its_copy_knows_it(web, tmp_path):
    random_bundle(0).write(tmp_path / "a.v3dg")
    url = secret_url(web, "a.v3dg")
    bundle = v3dg.open(url)
    assert "hunter2" not in repr(bundle) + str(bundle.info())
    assert bundle.path == pickle.loads(pickle.dumps(bundle)).path == url


# ---- Addresses.
@pytest.mark.parametrize(
    ("reach", "addresses"),
    [
        (
            Reach.PUBLIC,
            "8.8.8.8 1.1.1.1 172.32.0.1 2606:4700::1111 ::ffff:8.8.8.8 64:ff9b::808:808 "
            "2002:808:808::1",
        ),
        (
            Reach.PRIVATE,
            "10.0.0.1 172.16.0.1 172.31.255.255 192.168.1.1 100.64.0.1 198.18.0.1 203.0.113.9",
        ),
        (
            Reach.PRIVATE,
            "fc00::1 fd12::1 fec0::1 2001:db8::1 ::ffff:10.0.0.1 2002:c0a8:101::1 64:ff9b::a00:1",
        ),
        (Reach.PRIVATE, "64:ff9b:1::1 100::1 4000::1"),
        (
            Reach.HOST,
            "127.0.0.1 127.255.0.9 0.0.0.0 0.1.2.3 169.254.169.254 224.0.0.1 255.255.255.255 "
            "240.0.0.1",
        ),
        (
            Reach.HOST,
            "::1 :: fe80::1 fe80::1%eth0 ff02::1 ::ffff:127.0.0.1 ::ffff:0.0.0.0 ::127.0.0.1",
        ),
        (Reach.HOST, "64:ff9b::7f00:1 2002:7f00:1::1 2001:0:808:808::80ff:fffe"),
    ],
)
def test_addresses_have_a_reach(reach, addresses):
    assert {address: reach_of(address) for address in addresses.split()} == dict.fromkeys(
        addresses.split(), reach
    )


def test_what_is_no_address_is_refused():
    with pytest.raises(ValueError, match="does not appear"):
        reach_of("example.com")


NAMES = {
    "public.test": ["127.0.0.1"],
    "also-public.test": ["127.0.0.1"],
    "private.test": ["127.0.0.2"],
    "both.test": ["127.0.0.1", "127.0.0.2"],
}


@pytest.fixture
def names(web, monkeypatch):
    """Make this server all of these hosts: 127.0.0.1 then counts as public, and other
    addresses as private."""
    known = dict(NAMES)

    async def resolve(host, port):
        return known[host]

    monkeypatch.setattr("v3dg._urls.http._sessions", {})
    monkeypatch.setattr("v3dg._urls.http.resolve", resolve)
    is_public = ["127.0.0.1", "93.184.216.34"]
    monkeypatch.setattr(
        "v3dg._urls.http.reach_of", lambda at: Reach.PUBLIC if at in is_public else Reach.PRIVATE
    )
    return known


def redirecting(web, places):
    """Make the server redirect each path to an address, in which `{port}` is its own
    port."""
    answer = web.handler.answer

    def redirected(self, with_body):
        place = places.get(self.path)
        if place is None:
            return answer(self, with_body)
        self.send_response(302)
        self.send_header("Location", place.format(port=web.server_port))
        self.send_header("Content-Length", "0")
        self.end_headers()

    web.handler.answer = redirected


@pytest.mark.parametrize(
    "places",
    [
        {"/a.ply": "http://private.test:{port}/b.ply"},
        {"/a.ply": "http://127.0.0.2:{port}/b.ply"},
        {"/a.ply": "http://[::1]:{port}/b.ply"},
        {"/a.ply": "http://[::ffff:127.0.0.2]:{port}/b.ply"},
        {"/a.ply": "http://0.0.0.0:{port}/b.ply"},
        {"/a.ply": "//private.test:{port}/b.ply"},
        {
            "/a.ply": "http://also-public.test:{port}/c.ply",
            "/c.ply": "http://private.test:{port}/b.ply",
        },
    ],
)
def test_no_public_server_sends_us_on_to_a_private_address(web, names, tmp_path, places):
    v3dg.write_asset(tmp_path / "b.ply", random_gaussians(np.random.default_rng(0), 300))
    redirecting(web, places)
    message = r"/a\.ply: refused a redirect from a public server to a private address"
    with pytest.raises(PermissionError, match=message):
        v3dg.open(f"http://public.test:{web.server_port}/a.ply")
    assert web.sent == []


@pytest.mark.parametrize("host", ["also-public.test", "both.test"])
def test_public_servers_send_us_on_to_public_addresses(web, names, tmp_path, host):
    v3dg.write_asset(tmp_path / "b.ply", random_gaussians(np.random.default_rng(0), 300))
    redirecting(web, {"/a.ply": f"http://{host}:{{port}}/b.ply"})
    assert len(v3dg.open(f"http://public.test:{web.server_port}/a.ply")) == 300


def test_a_name_that_becomes_private_is_refused(web, names, tmp_path):
    random_bundle(0).write(tmp_path / "a.v3dg")
    source = WebSource(fsspec.filesystem("http"), f"http://public.test:{web.server_port}/a.v3dg")
    names["public.test"] = ["127.0.0.2"]
    web.sent.clear()
    with pytest.raises(DownloadError, match="refused a redirect"):
        source.read_parts([(0, 8)], lambda data, offset: None)
    assert web.sent == []


def test_an_address_is_checked_once_more_when_a_connection_is_made(web, monkeypatch):
    monkeypatch.setattr("v3dg._urls.http._sessions", {})
    monkeypatch.setattr(
        "v3dg._urls.http.reach_of", lambda at: Reach.PUBLIC if at == "8.8.8.8" else Reach.HOST
    )
    answers = iter([["8.8.8.8"], ["127.0.0.1"]])

    async def resolve(host, port):
        return next(answers)

    monkeypatch.setattr("v3dg._urls.http.resolve", resolve)
    with pytest.raises(PermissionError, match="refused a redirect"):
        v3dg.open(f"http://public.test:{web.server_port}/a.v3dg")
    assert web.sent == []


# ---- What answers may cost, and what is told of those that are wrong.
@pytest.mark.parametrize(
    ("name", "kind", "message"),
    [
        (
            "status 401",
            PermissionError,
            "the server answered 401 Unauthorized; check the user, the password",
        ),
        ("status 403", PermissionError, "the server answered 403 Forbidden; "),
        ("status 404", FileNotFoundError, "the server answered 404 Not Found; check the address"),
        ("status 410", FileNotFoundError, "the server answered 410 Gone; "),
        ("status 418", ConnectionError, "the server answered 418 "),
        (
            "status 503",
            ConnectionError,
            "the server answered 503 Service Unavailable; try again later",
        ),
        ("status 504", TimeoutError, "the server answered 504 Gateway Timeout; "),
        ("never answers", TimeoutError, "the server did not answer in time; "),
        ("drips a part", TimeoutError, "the server did not answer in time; "),
        ("drips the head", TimeoutError, "the server did not answer in time; "),
        ("reset", ConnectionError, "the connection was lost or could not be made"),
        ("no HTTP", ConnectionError, "the server's answer is not valid HTTP"),
        ("redirects to itself", ConnectionError, "expected at most 10 redirects, got more"),
        (
            "redirects to a file",
            ConnectionError,
            "the server redirects to something other than a web address",
        ),
        ("gzip bomb", ConnectionError, "expected an uncompressed answer, got a compressed one"),
        ("404 without end", FileNotFoundError, "the server answered 404"),
        ("claims 4 TB, honest parts", ValueError, "size: expected "),
        ("part without end", ValueError, "expected at most 1024 bytes, got more"),
        (
            "part longer than asked",
            ValueError,
            r"expected 1024 bytes at offset 0, got \d+; the file has changed",
        ),
        (
            "parts, then none",
            ConnectionError,
            "the server sent parts of the file before but no longer does",
        ),
        ("whole without end", ValueError, r"expected at most \d+ bytes, got more"),
        ("forged tables of 1 GB", ValueError, "clusters: expected at most 262144"),
        (
            "forged tables of 4 TB",
            ValueError,
            "clusters: expected at most 39268534564 clusters for the size of its pages",
        ),
        (
            "forged tables of 2 TB",
            ValueError,
            "tables: expected at most 1073741824 bytes for a file at a URL",
        ),
        ("unknown size without end", ValueError, "expected at most 1048576 bytes, got more"),
        ("asset without end", ValueError, r"expected at most \d+ bytes, got more"),
    ],
)
def test_a_server_that_lies_is_an_error_that_says_what_is_wrong(
    name, kind, message, tmp_path, monkeypatch
):
    pytest.importorskip("aiohttp")
    monkeypatch.setattr("v3dg._urls.http.PATIENCE_S", 0.5)
    monkeypatch.setattr("v3dg._urls.opened._MOST_UNKNOWN_BYTES", 1 << 20)
    suffix, _, behaviour = servers.BEHAVIOURS[name]
    file = tmp_path / f"x.{suffix}"
    bundle = random_bundle(0)
    bundle.write(file) if suffix == "v3dg" else v3dg.write_asset(file, bundle.gaussians)
    server = servers.Server(file.read_bytes(), behaviour)
    url = f"http://127.0.0.1:{server.port}/{file.name}"
    try:
        with pytest.raises(kind, match=f"^{url}: {message}"):
            v3dg.open(f"{url}?sig=x")
    finally:
        server.close()
    assert server.sent < len(server.body) + (16 << 20)


def test_hosts_that_are_not_there_are_errors_that_say_so(web, monkeypatch):
    web.shutdown()
    web.server_close()
    with pytest.raises(
        ConnectionRefusedError, match="the connection was refused; check the host and the port"
    ):
        v3dg.open(f"{web.address}/a.ply")
    with pytest.raises(ConnectionError, match="the name of the host is unknown"):
        v3dg.open("http://nowhere.invalid/a.ply")


def test_a_server_without_tls_is_an_error_that_says_so(web):
    with pytest.raises(ConnectionError, match="no secure connection"):
        v3dg.open(f"{web.address.replace('http', 'https')}/a.ply")


def test_no_more_is_fetched_than_there_is_room_for(web, tmp_path, monkeypatch):
    v3dg.write_asset(tmp_path / "a.ply", random_gaussians(np.random.default_rng(0), 300))
    monkeypatch.setattr("v3dg._urls.opened._SPARE_BYTES", 1 << 60)
    with pytest.raises(
        OSError, match=r"/a\.ply: no space for the file in .*; set TMPDIR to a folder with more"
    ):
        v3dg.open(f"{web.address}/a.ply")
    assert web.sent == []


@pytest.mark.parametrize("host", ["me:hunter2/x@host", "me:hunter2#x@host"])
def test_a_url_that_is_none_is_an_error_without_its_password(host):
    pytest.importorskip("aiohttp")
    with pytest.raises(ValueError, match="expected a URL with a host; check the URL") as caught:
        v3dg.open(f"http://{host}/a.ply")
    assert "hunter2" not in str(caught.value)


def test_a_chain_of_places_is_refused():
    with pytest.raises(ValueError, match="got a chain of URLs with '::'; download the file"):
        v3dg.open("zip://a.zip::http://127.0.0.1:1/a.ply")


# ---- What stays, and what is read again.
@pytest.mark.parametrize("ends_by", ["SIGKILL", "SIGINT", "SIGTERM"])
def test_nothing_fetched_stays_however_a_process_ends(web, tmp_path, ends_by):
    (tmp_path / "tmp").mkdir()
    v3dg.write_asset(tmp_path / "a.ply", random_gaussians(np.random.default_rng(0), 300))
    code = "import sys, time, v3dg; v3dg.open(sys.argv[1]); print(1, flush=True); time.sleep(60)"
    process = subprocess.Popen(
        [sys.executable, "-c", code, f"{web.address}/a.ply"],
        env=TESTS_ENVIRONMENT | {"TMPDIR": str(tmp_path / "tmp")},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    assert process.stdout.readline() == b"1\n"
    assert list((tmp_path / "tmp").iterdir()) == []
    process.send_signal(getattr(signal, ends_by))
    process.wait(30)
    process.stdout.close()
    assert list((tmp_path / "tmp").iterdir()) == []
    assert len(web.sent) == 1


@pytest.mark.parametrize("has_tags", [True, False])
def test_an_asset_that_changed_is_read_anew_and_another_is_not_fetched_twice(
    web, tmp_path, has_tags
):
    first, second = (random_gaussians(np.random.default_rng(seed), 300) for seed in (0, 1))
    if not has_tags:
        web.handler.date_time_string = lambda *_: ""
    url = f"{web.address}/a.ply"
    v3dg.write_asset(tmp_path / "a.ply", first)
    os.utime(tmp_path / "a.ply", (1000, 1000))
    for _ in range(2):
        np.testing.assert_array_equal(v3dg.open(url).means, first.means)
    assert len(web.sent) == (1 if has_tags else 2)
    v3dg.write_asset(tmp_path / "a.ply", second)
    np.testing.assert_array_equal(v3dg.open(url).means, second.means)


def test_descriptors_of_what_has_changed_are_closed(web, tmp_path):
    v3dg.write_asset(tmp_path / "a.ply", random_gaussians(np.random.default_rng(0), 300))
    counts = []
    for time_s in range(12):
        os.utime(tmp_path / "a.ply", (time_s, time_s))
        v3dg.open(f"{web.address}/a.ply")
        gc.collect()
        counts.append(sum(target.endswith("(deleted)") for target in _open_files()))
    assert counts[-1] == counts[0]


def _open_files():
    """Yield the targets of this process's descriptors; other threads may close some
    meanwhile."""
    for name in os.listdir("/proc/self/fd"):
        with contextlib.suppress(FileNotFoundError):
            yield os.readlink(f"/proc/self/fd/{name}")


@pytest.mark.parametrize(
    "name", ["a.ply", "a.spz", "a.sog", "a.glb", "a.compressed.ply", "a.usdc", "a.usda"]
)
def test_every_format_is_read_from_a_url_and_names_it_in_errors(there, tmp_path, name, capsys):
    if ".usd" in name:
        pytest.importorskip("pxr")
    v3dg.write_asset(tmp_path / name, random_gaussians(np.random.default_rng(0), 300))
    there.put_file(str(tmp_path / name), f"/in/{name}")
    np.testing.assert_array_equal(
        v3dg.open(f"memory://in/{name}").means, v3dg.open(tmp_path / name).means
    )
    there.pipe_file(f"/in/{name}", (tmp_path / name).read_bytes()[:200])
    with pytest.raises(ValueError, match=rf"memory://in/{re.escape(name)}") as caught:
        v3dg.open(f"memory://in/{name}")
    assert "/proc/" not in str(caught.value)
    assert tempfile.gettempdir() not in str(caught.value)


def test_a_gltf_at_a_url_has_its_buffers_inside(there, tmp_path):
    """It is read through an open file of this process, whose folder contains all other
    open files."""
    asset = random_gaussians(np.random.default_rng(0), 30)
    file = GltfFile()
    file.nodes({"mesh": file.mesh(asset)})
    there.put_file(str(file.write(tmp_path / "a.gltf")), "/in/a.gltf")
    assert len(v3dg.open("memory://in/a.gltf")) == 30
    (tmp_path / "a.bin").write_bytes(file.blob)
    with open(tmp_path / "a.bin", "rb") as secret:
        for uri in ("a.bin", str(secret.fileno())):
            there.put_file(str(file.write(tmp_path / "a.gltf", uri)), f"/in/{uri}.gltf")
            with pytest.raises(
                ValueError, match="got one that refers to other files; download its folder"
            ):
                v3dg.open(f"memory://in/{uri}.gltf")
