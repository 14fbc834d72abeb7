"""Files at URLs, as fsspec fetches them."""

import http.server
import json
import pickle
import re
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import v3dg
from command_line import TESTS_ENVIRONMENT
from random_bundle import random_bundle, random_gaussians
from scenes_lod import blob, lod_bundle
from v3dg import cli

fsspec = pytest.importorskip("fsspec")

FAR = v3dg.Camera.look_at((0, -60, 4), (0, 0, 0), width=93, height=61)
NEAR = v3dg.Camera.look_at((0, -9, 1), (0, 0, 0), width=93, height=61)
COARSE, FINE = {"tolerance": 20.0}, {"tolerance": 0.0}
URL = "memory://in/many.v3dg"


@pytest.fixture
def there(monkeypatch):
    """A place that only fsspec reaches."""
    monkeypatch.setattr("v3dg._urls.opened._opened", {})
    memory = fsspec.filesystem("memory")
    yield memory
    memory.rm("/", recursive=True)


@pytest.fixture
def fetched(there, monkeypatch):
    """The parts of files that were fetched from there, in a list."""
    parts, fetch = [], type(there).cat_file

    def counted(self, path, start=None, end=None, **options):
        data = fetch(self, path, start, end, **options)
        parts.append((start, len(data)))
        return data

    monkeypatch.setattr(type(there), "cat_file", counted)
    return parts


def put(there, tmp_path, seed=0):
    """A bundle of about 250 pages there; the same here."""
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


@pytest.mark.parametrize("url", ["memory://in/a.ply", Path("memory://in/a.ply"), "memory://in/a%2Eply?x=1"])
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
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(bundle)).groups.ball, bundle.groups.ball)
    assert pickle.loads(pickle.dumps(bundle)).path == URL


def test_pictures_fetch_what_they_need_and_no_part_twice(fetched, many):
    bundle, here = v3dg.open(URL), v3dg.open(many)
    before = num_bytes(fetched)
    renderer = v3dg.Renderer(bundle, device="cpu")
    renderer.settle(FAR, **COARSE)
    assert same_picture(renderer.render(FAR, **COARSE), v3dg.render(here, FAR, device="cpu", **COARSE))
    of_far = num_bytes(fetched) - before
    assert 0 < of_far < bundle.page_bytes / 4
    assert same_picture(
        v3dg.render(bundle, FAR, device="cpu", **COARSE), v3dg.render(here, FAR, device="cpu", **COARSE)
    )
    assert num_bytes(fetched) - before == of_far
    assert not bundle.is_in_memory
    picture = v3dg.render(bundle, NEAR, device="cpu", **FINE)
    assert same_picture(picture, v3dg.render(here, NEAR, device="cpu", **FINE))
    for level in range(bundle.num_levels):
        np.testing.assert_array_equal(bundle.level_gaussians(level).means, here.level_gaussians(level).means)
    np.testing.assert_array_equal(v3dg.open(URL).gaussians.sh, here.gaussians.sh)
    # Blocks in which pages meet may have been on their way for two of them.
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
    assert same_picture(renderer.render(NEAR, **FINE), v3dg.render(many, NEAR, device="cpu", **FINE))


def test_a_server_that_does_not_answer_ends_the_wait(there, many, monkeypatch):
    renderer = v3dg.Renderer(v3dg.open(URL), device="cpu", memory="64MB")
    answers, fetch = threading.Event(), type(there).cat_file

    def slow(*given, **options):
        answers.wait(60)
        return fetch(*given, **options)

    monkeypatch.setattr(type(there), "cat_file", slow)
    start = time.monotonic()
    with pytest.raises(TimeoutError, match="pages are missing and none came in"):
        renderer.settle(NEAR, timeout=0.2, **FINE)
    assert renderer.render(NEAR, **FINE).stats.missing > 0  # which waits for nothing
    assert time.monotonic() - start < 30
    answers.set()
    renderer.settle(NEAR, **FINE)
    assert same_picture(renderer.render(NEAR, **FINE), v3dg.render(many, NEAR, device="cpu", **FINE))


@pytest.mark.parametrize("is_shorter", [False, True])
def test_what_changes_at_its_url_is_an_error_until_it_is_opened_again(there, many, tmp_path, is_shorter):
    bundle = v3dg.open(URL)
    if is_shorter:
        there.pipe_file("/in/many.v3dg", many.read_bytes()[:5000])
        message = r"expected \d+ bytes at \d+, got \d+; it has changed, open it again"
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
    """Also with threads that wait for Python."""
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
    """Of one folder, which knows ranges, and counts."""

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
            re.fullmatch(r"bytes=(\d+)-(\d+)", self.headers.get("Range", "")) if self.knows_ranges else None
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
    """A web server of a folder, its address and the bytes of what it sent."""
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
def test_bundles_of_a_web_server_are_read_in_parts(web, tmp_path, knows_ranges, monkeypatch, capsys):
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
    assert f"{web.address}/none.v3dg: the server answered 404 Not Found; check" in capsys.readouterr().err


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
    assert cli.main(["render", "memory://in/a.v3dg", "--device", "cpu", "--size", "16", "16", "--json"]) == 0
    assert '"subject": "memory://in/a.v3dg"' in capsys.readouterr().out
    assert cli.main(["export", "memory://in/a.v3dg", "--quiet"]) == 0
    assert sorted(path.name for path in Path().iterdir()) == ["a.png", "a.v3dg", "a_web"]


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("memory://in/none.ply", r"memory://in/none\.ply: there is no such file; check the address"),
        ("nowhere://in/a.ply", "Protocol not known: nowhere"),
        ("memory://in/scene.json", "expected a scene that is here, got a URL"),
        ("memory://in/lod-meta.json", "got one of a file that names others"),
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
    with pytest.raises(ValueError, match="got one in memory or at a URL; write it and open that"):
        scene.save(tmp_path / "a.json")


def test_without_fsspec_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "fsspec", None)
    with pytest.raises(ImportError, match=r"files at URLs: expected fsspec.*pip install 'fsspec\[http\]"):
        v3dg.open("memory://in/b.ply")
