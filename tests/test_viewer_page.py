"""The viewer's page: how it is served, and, with Chromium and playwright, how it looks and answers."""

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
from v3dg.viewer.frame import Figures, Frame, Settings, Stage
from v3dg.viewer.page import Site, figures_html, start_view

pytest.importorskip("viser")


@pytest.fixture(scope="module")
def bundle():
    rng = np.random.default_rng(0)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 3000, size=0.5), 64)


@pytest.fixture(scope="module")
def stage(bundle):
    return Stage(bundle)


def listens_at(port, host):
    with socket.socket() as client:
        return client.connect_ex((host, port)) == 0


def test_page_is_served_to_this_machine_alone(stage):
    site = Site(stage, port=0)
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{site.port}") as page:
            assert page.status == 200
        assert not listens_at(site.port, "127.0.0.2")
    finally:
        site.close()
    assert not listens_at(site.port, "127.0.0.1")


def test_taken_port_is_passed_over(stage):
    first = Site(stage, port=0)
    second = Site(stage, port=first.port)
    try:
        assert second.port != first.port
        assert listens_at(second.port, "127.0.0.1")
    finally:
        second.close()
        first.close()


def test_address_of_another_machine_is_refused(stage):
    with pytest.raises(ValueError, match=r"host: expected an address of this machine, got 192\.0\.2\.1"):
        Site(stage, host="192.0.2.1")


def test_missing_extra_is_named(stage, monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(ImportError, match=r"pip install 'v3dg\[viewer\]'"):
        Site(stage)


@pytest.mark.parametrize("up", [(0, 0, 1), (0, -1, 0), (1, 0, 0)])
def test_page_begins_with_all_of_the_scene_in_view(stage, up):
    view = start_view(stage, up)
    figures = stage.frame(view, (160, 90), Settings(tolerance=0.0)).figures
    assert figures.gaussians_in_view > 0.95 * stage.num_gaussians
    above = np.dot(np.array(view.position) - stage.center, up)
    assert above > 0.3 * stage.radius
    camera = view.camera(160, 90, stage.near)
    assert -camera.viewmat[1, :3] @ up > 0.8  # upright


def test_figures_are_in_the_panel():
    figures = Figures(1234567, 7654, 3.0, 1.25, 45.6, np.array([10, 0, 40]), 300 << 20)
    frame = Frame(np.zeros((9, 16, 3), np.uint8), figures, (8.0, 2.0))
    text = figures_html(frame, "depth")
    for expected in (
        "1,234,567",
        "7,654",
        "3 px²",
        "1.2 ms",
        "45.6 ms",
        "16 x 9",
        "300 MiB",
        "8",
        "level 2: 40",
    ):
        assert expected in text


def test_command_says_where_and_ends_with_an_interrupt(bundle, tmp_path):
    bundle.save(tmp_path / "blob.v3dg")
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
        with urllib.request.urlopen(line.split()[0]) as page:
            assert page.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0
    assert stderr == ""


def test_closing_leaves_no_thread_behind(stage):
    before = set(threading.enumerate())
    Site(stage, port=0).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(10)
        assert not thread.is_alive(), thread
