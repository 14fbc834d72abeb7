"""The viewer's server and its command: the address, the first messages to a browser
tab, and how both end."""

import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest

import scenes_lod
import v3dg
import v3dg.cli
from v3dg.viewer.frame import Settings
from v3dg.viewer.server import Site, start_view

websockets = pytest.importorskip("websockets")

pytestmark = [
    # If a site closes while a client is connecting, only the garbage collector closes
    # the site's end of the connection.
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.usefixtures("collected_connections"),
]


def listens_at(port, host):
    with socket.socket() as client:
        return client.connect_ex((host, port)) == 0


def test_viewer_is_served_to_this_machine_alone(blob_view):
    site = Site(blob_view, port=0)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{site.port}") as answer:
            assert answer.status == 200
        assert not listens_at(site.port, "127.0.0.2")
    finally:
        site.close()
    assert not listens_at(site.port, "127.0.0.1")


def test_taken_port_is_passed_over(blob_view):
    first = Site(blob_view, port=0)
    second = Site(blob_view, port=first.port)
    try:
        assert second.port != first.port
        assert listens_at(second.port, "127.0.0.1")
    finally:
        second.close()
        first.close()


@pytest.mark.parametrize(
    ("options", "up"),
    [({}, (0, -1, 0)), ({"up": "x"}, (1, 0, 0)), ({"up": (0, 0, -1)}, (0, 0, -1))],
)
def test_the_viewer_in_python_takes_the_axis_of_the_commands(blob_bundle, options, up):
    scene = v3dg.Scene.of(blob_bundle)
    scene.up = "-y"
    site = v3dg.view(scene, port=0, device="cpu", **options)
    try:
        assert site._greeting.up == up
    finally:
        site.close()


def test_an_axis_that_is_none_is_refused_by_the_viewer(blob_bundle):
    with pytest.raises(ValueError, match=r"^up: expected 'x' or .*, got 'Z'"):
        v3dg.view(blob_bundle, up="Z")


def test_address_of_another_machine_is_refused(blob_view):
    with pytest.raises(
        ValueError, match=r"host: expected an address of this machine, got 192\.0\.2\.1"
    ):
        Site(blob_view, host="192.0.2.1")


@pytest.mark.parametrize("module", ["msgspec", "websockets.asyncio.server"])
def test_missing_extra_is_named_with_all_that_it_needs(blob_view, monkeypatch, module):
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(ImportError, match=r"pip install 'msgspec>=\S+' 'websockets>=\S+'$"):
        Site(blob_view)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_tab_begins_with_all_of_the_scene_in_view(blob_view, up):
    view = start_view(blob_view, up)
    figures = blob_view.frame(view, (160, 90), Settings(tolerance=0.0)).figures
    assert figures.gaussians_in_frustum > 0.95 * blob_view.num_gaussians
    above = np.dot(np.array(view.position) - blob_view.framing.center, up)
    assert above > 0.3 * blob_view.framing.radius
    camera = view.camera(160, 90, blob_view.near)
    assert -camera.viewmat[1, :3] @ up > 0.8  # the camera is upright


@contextlib.contextmanager
def viewing(bundle, folder, *options):
    """Start the command in a separate session. Yield it, and the line with its address,
    once it has printed that line."""
    bundle.write(folder / "blob.v3dg")
    environment = os.environ | {"PYTHONPATH": os.path.dirname(os.path.dirname(v3dg.__file__))}
    process = subprocess.Popen(
        [sys.executable, "-m", "v3dg", "view", "blob.v3dg", "--port", "0", *options],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
        # If the tests are started in the background, they ignore interrupts, and
        # children inherit this.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    try:
        yield process, process.stdout.readline()
    finally:
        process.kill()
        process.communicate()


def ends(process, *signals):
    """Return whether the command ends correctly after these signals, which are sent at
    short intervals."""
    for number in signals:
        process.send_signal(number)
        time.sleep(random.uniform(0.0, 0.05))
    _, stderr = process.communicate(timeout=30)
    assert (process.returncode, stderr) == (130, "v3dg: error: interrupted\n")


def test_command_says_where_and_ends_with_an_interrupt(blob_bundle, tmp_path):
    with viewing(blob_bundle, tmp_path) as (process, line):
        assert line.startswith("http://127.0.0.1:")
        assert "blob.v3dg" in line
        address = line.split()[0]
        with socket.create_connection(("127.0.0.1", int(address.rsplit(":", 1)[1]))) as silent:
            silent.shutdown(socket.SHUT_WR)
            assert silent.recv(1) == b""  # the server has noticed it
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
        ends(process, signal.SIGINT)


@pytest.mark.parametrize(
    ("options", "environment", "opens"),
    [
        ((), {}, True),
        (("--no-browser",), {}, False),
        (("--host", "0.0.0.0"), {}, False),
        ((), {"SSH_CONNECTION": "1"}, False),
        ((), {"BROWSER": ""}, False),
    ],
)
def test_command_opens_a_browser_where_there_is_one(
    blob_bundle, tmp_path, monkeypatch, options, environment, opens
):
    browser = tmp_path / "browser"
    browser.write_text('#!/bin/sh\necho "$1" > "$(dirname "$0")/opened"\n')
    browser.chmod(0o755)
    usual = {"BROWSER": str(browser), "DISPLAY": "", "WAYLAND_DISPLAY": ""}
    for name, value in {**usual, **environment}.items():
        monkeypatch.setenv(name, value)
    if "SSH_CONNECTION" not in environment:
        monkeypatch.delenv("SSH_CONNECTION", raising=False)
    with viewing(blob_bundle, tmp_path, *options) as (process, line):
        end = time.monotonic() + (30 if opens else 1)
        while not (tmp_path / "opened").exists() and time.monotonic() < end:
            time.sleep(0.05)
        time.sleep(0.1)  # give the file time to be written
        ends(process, signal.SIGINT)
    assert (tmp_path / "opened").exists() == opens
    if opens:
        assert (tmp_path / "opened").read_text().strip() == line.split()[0]


def test_photographs_of_cameras_are_found(tmp_path):
    from v3dg.cli.view import _photographs

    (tmp_path / "images").mkdir()
    (tmp_path / "sparse" / "0").mkdir(parents=True)
    for name in ("a.jpg", "b.png"):
        (tmp_path / "images" / name).write_bytes(b"")
    names = ("a.jpg", "images/b", "images/c.png", "x" * 5000)
    by_colmap = _photographs(tmp_path / "sparse" / "0", names)
    assert {name: path.name for name, path in by_colmap.items()} == {
        "a.jpg": "a.jpg",
        "images/b": "b.png",
    }
    assert _photographs(tmp_path / "transforms.json", names).keys() == {"a.jpg", "images/b"}


INTERRUPTS = int(os.environ.get("V3DG_INTERRUPTS", "1"))
JOBS = ("film", "picture", "play", "cameras")


@pytest.mark.parametrize(
    "signals", [(signal.SIGINT,), (signal.SIGINT,) * 2, (signal.SIGTERM, signal.SIGINT)]
)
@pytest.mark.parametrize("turn", range(INTERRUPTS))
def test_command_ends_at_once_whatever_a_tab_does(blob_bundle, blob_view, tmp_path, signals, turn):
    """The environment variable V3DG_INTERRUPTS sets the number of rounds. Each round
    interrupts at another moment of drawing and of starting jobs."""
    viewer_client = pytest.importorskip("viewer_client")
    home, end = start_view(blob_view, (0, 0, 1)), time.monotonic() + random.uniform(0.2, 1.0)
    with viewing(blob_bundle, tmp_path) as (process, line):
        tab = viewer_client.Tab(int(line.split()[0].rsplit(":", 1)[1]))
        while time.monotonic() < end:
            tab.look(home, (3000, 2000))
            tab.pictures(time.perf_counter() + 0.05)
            for job in JOBS:
                tab.save(job, [(1.0, home), (1.0, home)])
            if random.random() < 0.3:
                tab.send({"type": "stop"})
        began = time.monotonic()
        ends(process, *signals)
        assert time.monotonic() - began < 10  # a film of 3000 x 2000 takes longer
        with contextlib.suppress(websockets.exceptions.ConnectionClosed):
            tab.pictures(time.perf_counter() + 0.1)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["asset.ply", "--budget", "9"],
            "--budget: expected a bundle or a scene, got the asset asset.ply; build a bundle",
        ),
        (["asset.ply", "--port", "70000"], "--port: expected 0 to 65535, got 70000"),
        (["asset.ply", "--tolerance", "inf"], "--tolerance: expected a finite number, got inf"),
        (
            ["asset.ply", "--host", "192.0.2.1"],
            "host: expected an address of this machine, got 192.0.2.1",
        ),
        (["nothing.v3dg"], "nothing.v3dg: expected a file, got a path that does not exist"),
    ],
)
def test_command_refuses_what_cannot_be_meant(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    v3dg.write_asset("asset.ply", scenes_lod.blob(np.random.default_rng(0), 50))
    assert v3dg.cli.main(["view", *arguments]) != 0
    assert message in capsys.readouterr().err


def test_cameras_without_names_are_refused(blob_view):
    before = set(threading.enumerate())
    with pytest.raises(
        TypeError, match=r"cameras: expected a mapping from names to cameras.*, got list"
    ):
        Site(blob_view, port=0, cameras=v3dg.turntable((0, 0, 0), 3.0, 2))
    assert set(threading.enumerate()) == before


def test_closing_leaves_no_thread_behind(blob_view):
    before = set(threading.enumerate())
    Site(blob_view, port=0).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(10)
        assert not thread.is_alive(), thread
