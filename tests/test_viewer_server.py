"""The viewer's server and command: where they listen, what a tab begins with, and how they end."""

import os
import signal
import socket
import subprocess
import sys
import threading
import urllib.request

import numpy as np
import pytest

import scenes_lod
import v3dg
import v3dg.cli
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.server import Site, start_view

pytest.importorskip("viser")

pytestmark = [
    # A site that closes while somebody is just connecting leaves viser's end of the connection to the
    # collector.
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.usefixtures("collected_connections"),
]


@pytest.fixture(scope="module")
def bundle():
    rng = np.random.default_rng(0)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 3000, size=0.5), 64)


@pytest.fixture(scope="module")
def scene_view(bundle):
    return SceneView(bundle, device="cpu")


def listens_at(port, host):
    with socket.socket() as client:
        return client.connect_ex((host, port)) == 0


def test_viewer_is_served_to_this_machine_alone(scene_view):
    site = Site(scene_view, port=0)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{site.port}") as answer:
            assert answer.status == 200
        assert not listens_at(site.port, "127.0.0.2")
    finally:
        site.close()
    assert not listens_at(site.port, "127.0.0.1")


def test_taken_port_is_passed_over(scene_view):
    first = Site(scene_view, port=0)
    second = Site(scene_view, port=first.port)
    try:
        assert second.port != first.port
        assert listens_at(second.port, "127.0.0.1")
    finally:
        second.close()
        first.close()


def test_address_of_another_machine_is_refused(scene_view):
    with pytest.raises(ValueError, match=r"host: expected an address of this machine, got 192\.0\.2\.1"):
        Site(scene_view, host="192.0.2.1")


def test_missing_extra_is_named(scene_view, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'v3dg\[viewer\]'"):
        Site(scene_view)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_tab_begins_with_all_of_the_scene_in_view(scene_view, up):
    view = start_view(scene_view, up)
    figures = scene_view.frame(view, (160, 90), Settings(tolerance=0.0)).figures
    assert figures.gaussians_in_view > 0.95 * scene_view.num_gaussians
    above = np.dot(np.array(view.position) - scene_view.center, up)
    assert above > 0.3 * scene_view.radius
    camera = view.camera(160, 90, scene_view.near)
    assert -camera.viewmat[1, :3] @ up > 0.8  # upright


def test_command_says_where_and_ends_with_an_interrupt(bundle, tmp_path):
    bundle.write(tmp_path / "blob.v3dg")
    environment = os.environ | {"PYTHONPATH": os.path.dirname(os.path.dirname(v3dg.__file__))}
    process = subprocess.Popen(
        [sys.executable, "-m", "v3dg", "view", "blob.v3dg", "--port", "0"],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        # Whoever starts the tests in the background has them ignore interrupts, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    line = process.stdout.readline()
    try:
        assert line.startswith("http://127.0.0.1:")
        assert "blob.v3dg" in line
        address = line.split()[0]
        with socket.create_connection(("127.0.0.1", int(address.rsplit(":", 1)[1]))) as silent:
            silent.shutdown(socket.SHUT_WR)
            assert silent.recv(1) == b""  # the server has seen it
        with urllib.request.urlopen(address) as answer:
            assert answer.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0
    assert stderr == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["asset.ply", "--budget", "9"],
            "--budget: expected a bundle or a scene, got the asset asset.ply; build a bundle",
        ),
        (["asset.ply", "--port", "70000"], "--port: expected 0 to 65535, got 70000"),
        (["asset.ply", "--tolerance", "inf"], "--tolerance: expected a number, got inf"),
        (["asset.ply", "--host", "192.0.2.1"], "host: expected an address of this machine, got 192.0.2.1"),
        (["nothing.v3dg"], "nothing.v3dg: expected a file, got a path where there is none"),
    ],
)
def test_command_refuses_what_cannot_be_meant(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    v3dg.write_asset("asset.ply", scenes_lod.blob(np.random.default_rng(0), 50))
    assert v3dg.cli.main(["view", *arguments]) != 0
    assert message in capsys.readouterr().err


def test_closing_leaves_no_thread_behind(scene_view):
    before = set(threading.enumerate())
    Site(scene_view, port=0).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(10)
        assert not thread.is_alive(), thread
