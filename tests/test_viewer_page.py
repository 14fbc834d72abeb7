"""The viewer's page: how it is served, and, with Chromium and playwright, how it looks and answers."""

import gc
import io
import os
import re
import signal
import socket
import subprocess
import sys
import threading
import time
import urllib.request

import numpy as np
import pytest
from PIL import Image

import scenes_lod
import v3dg
import v3dg.cli
from v3dg.viewer.frame import Figures, Frame, Settings, Stage
from v3dg.viewer.page import Site, figures_html, start_view
from v3dg.viewer.view import look_at

pytest.importorskip("viser")

# A site that closes while somebody is just connecting leaves viser's end of that connection to the collector.
pytestmark = pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning")


@pytest.fixture(scope="module", autouse=True)
def collected_connections():
    """Nothing of that is left to the tests after these."""
    yield
    gc.collect()


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
    frame = Frame(np.zeros((9, 16, 3), np.uint8), figures, "depth", (8.0, 2.0))
    text = figures_html(frame)
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
        address = line.split()[0]
        with socket.create_connection(("127.0.0.1", int(address.rsplit(":", 1)[1]))) as silent:
            silent.shutdown(socket.SHUT_WR)
            assert silent.recv(1) == b""  # the server has seen it
        with urllib.request.urlopen(address) as page:
            assert page.status == 200
    finally:
        process.send_signal(signal.SIGINT)
        _, stderr = process.communicate(timeout=60)
    assert process.returncode == 0
    assert stderr == ""


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["asset.ply", "--budget", "9"], "--budget: asset.ply has no levels to choose from; build a bundle"),
        (["asset.ply", "--port", "70000"], "--port: expected 0 to 65535, got 70000"),
        (["asset.ply", "--tolerance", "inf"], "--tolerance: expected a number, got inf"),
        (["asset.ply", "--host", "192.0.2.1"], "host: expected an address of this machine, got 192.0.2.1"),
        (["nothing.v3dg"], "nothing.v3dg: expected a file, got nothing there"),
    ],
)
def test_command_refuses_what_cannot_be_meant(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    v3dg.save("asset.ply", scenes_lod.blob(np.random.default_rng(0), 50))
    assert v3dg.cli.main(["view", *arguments]) != 0
    assert message in capsys.readouterr().err


def test_asset_has_no_controls_of_levels():
    from viewer_client import Tab

    stage = Stage(scenes_lod.blob(np.random.default_rng(0), 500))
    site = Site(stage, port=0)
    try:
        with Tab(site.port) as tab:
            tab.look(start_view(stage, (0, 0, 1)), SIZE)
            settled(tab)
            assert tab.visible("Resolution %")
            assert not tab.visible("Tolerance px²")
            assert "Level" not in tab.options("Show")
            tab.set("Show", "Cluster")
            assert settled(tab).max() > 30
    finally:
        site.close()


def test_closing_leaves_no_thread_behind(stage):
    before = set(threading.enumerate())
    Site(stage, port=0).close()
    for thread in set(threading.enumerate()) - before:
        thread.join(10)
        assert not thread.is_alive(), thread


# A browser tab, played by viewer_client.

SIZE = (240, 160)


@pytest.fixture(scope="module")
def site(bundle, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "blob.v3dg"
    bundle.save(path)
    scene = v3dg.Scene()
    positions = np.random.default_rng(1).normal(size=(30, 3))
    scene.add(v3dg.Bundle.open(path), positions=positions, scales=np.full(30, 0.5))
    cameras = {"aside": v3dg.Camera.look_at((9, 0, 0), (0, 0, 0), width=64, height=48)}
    site = Site(Stage(scene), name="blobs", cameras=cameras, port=0)
    site.home = start_view(Stage(scene), (0, 0, 1), SIZE[0] / SIZE[1])
    yield site
    site.close()


@pytest.fixture
def tab(site):
    from viewer_client import Tab

    with Tab(site.port) as tab:
        tab.look(site.home, SIZE)
        settled(tab)
        yield tab


def settled(tab, until=lambda: True):
    """The picture at rest: full, and nothing comes after it."""
    last = None
    end = time.monotonic() + 60
    while time.monotonic() < end:
        pictures = tab.pictures(time.perf_counter() + 0.6)
        if pictures:
            last = pictures[-1][1]
        elif last is not None and last.size == SIZE and until():
            return np.asarray(last).astype(int)
    pytest.fail(f"no picture in full: {tab.text} {tab.notices}")


def figure(tab, name):
    found = re.search(rf">{name}</td><td[^>]*>([\d.,e+-]+)", tab.text)
    return float(found[1].replace(",", ""))


def wait_for(tab, condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, (tab.text, tab.notices)
        tab.pictures(time.perf_counter() + 0.1)


def saved(tab, button, name):
    tab.set(button, True)
    wait_for(tab, lambda: name in tab.files)
    return tab.files[name]


def add_to_path(tab, count):
    tab.set("Add this view", True)
    wait_for(tab, lambda: any(f"{count} views" in update for update in tab.updates))


def test_tab_gets_a_small_picture_and_then_the_full_one(site):
    from viewer_client import Tab

    with Tab(site.port) as tab:
        tab.look(site.home, SIZE)
        sizes = []
        while SIZE not in sizes:
            sizes += [picture.size for _, picture in tab.pictures(time.perf_counter() + 1)]
    assert sizes[0][0] < SIZE[0]
    assert sizes == sorted(sizes)


def test_picture_follows_the_camera(tab, site):
    tab.look(site.home, SIZE)
    first = settled(tab)
    assert (first.max(axis=2) > 30).mean() > 0.03
    x, y, z = site.home.position
    tab.look(look_at((-y, x, z), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect), SIZE)
    assert (abs(first - settled(tab)).max(axis=2) > 30).mean() > 0.02


def test_controls_change_the_cut(tab):
    everything = figure(tab, "selected")
    tab.set("Tolerance px²", 32)
    settled(tab)
    assert figure(tab, "selected") < 0.7 * everything
    tab.set("Tolerance px²", 0)
    tab.set("Finest level", 2)
    settled(tab)
    assert figure(tab, "selected") < 0.7 * everything
    tab.set("Finest level", 0)
    settled(tab)
    tab.set("Limit gaussians", True)
    tab.set("Millions", 0.01)
    settled(tab)
    assert 0 < figure(tab, "selected") <= 10_000
    assert figure(tab, "tolerance") > 0


def test_modes_are_chosen_and_have_a_legend(tab):
    tab.set("Show", "Depth")
    settled(tab, lambda: "near" in tab.text)
    tab.set("Show", "Gaussians per pixel")
    settled(tab, lambda: "256+" in tab.text)
    tab.set("Show", "Difference to all gaussians")
    tab.set("Amplify", 30)
    tab.set("Tolerance px²", 32)
    assert settled(tab).max() > 30
    tab.set("Split", 1)
    assert settled(tab, lambda: "256+" not in tab.text).max() > 30


def test_frozen_cut_is_kept_until_it_is_let_go(tab, site):
    selected = figure(tab, "selected")
    tab.set("Freeze the cut", True)
    settled(tab)
    x, y, z = site.home.position
    away = look_at((6 * x, 6 * y, 6 * z), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect)
    tab.look(away, SIZE)
    settled(tab)
    assert figure(tab, "selected") == selected
    tab.set("Freeze the cut", False)
    settled(tab)
    assert figure(tab, "selected") < selected


def test_what_cannot_be_drawn_is_explained(stage):
    from viewer_client import Tab

    site = Site(stage, port=0, budget=3)
    try:
        with Tab(site.port) as tab:
            tab.look(start_view(stage, (0, 0, 1)), SIZE)
            wait_for(tab, lambda: "budget: expected at least" in tab.text)
            tab.set("Millions", 1.0)
            settled(tab)
    finally:
        site.close()


def test_path_is_saved_as_cameras_a_scene_and_a_film(tab, site, tmp_path):
    tab.set("Save cameras (transforms.json)", True)
    wait_for(tab, lambda: tab.notices)
    assert "path: expected at least one view" in tab.notices[0]
    tab.set("Seconds a view", 0.5)
    add_to_path(tab, 1)
    x, y, z = site.home.position
    tab.look(look_at((-y, x, z), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect), SIZE)
    settled(tab)
    add_to_path(tab, 2)

    (tmp_path / "cameras.json").write_bytes(saved(tab, "Save cameras (transforms.json)", "transforms.json"))
    cameras = list(v3dg.read_cameras(tmp_path / "cameras.json").values())
    assert len(cameras) == 16
    np.testing.assert_allclose(cameras[0].position, (x, y, z), atol=1e-9)
    np.testing.assert_allclose(cameras[-1].position, (-y, x, z), atol=1e-9)

    (tmp_path / "scene.json").write_bytes(saved(tab, "Save scene (.json)", "blobs.json"))
    scene, cameras = v3dg.read_scene(tmp_path / "scene.json")
    assert (len(scene), len(cameras)) == (30, 16)

    av = pytest.importorskip("av")
    tab.set("Size", "as the window")
    with av.open(io.BytesIO(saved(tab, "Save film (.mp4)", "blobs.mp4"))) as film:
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(video=0)]
    assert len(pictures) == 16
    assert pictures[0].shape == (SIZE[1], SIZE[0], 3)
    assert (abs(pictures[0] - pictures[-1]).max(axis=2) > 30).mean() > 0.02


def test_flight_is_recorded_and_played(tab, site):
    x, y, z = site.home.position
    tab.set("Record", True)
    tab.pictures(time.perf_counter() + 0.3)
    for step in range(1, 6):
        away = look_at((x, y, z + 0.2 * step), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect)
        tab.look(away, SIZE)
        tab.pictures(time.perf_counter() + 0.1)
    tab.set("Record", False)
    wait_for(tab, lambda: re.search(r"[2-9] views", str(tab.updates)))
    tab.positions.clear()
    tab.set("Play", True)
    wait_for(tab, lambda: tab.positions and abs(tab.positions[-1][2] - z - 1) < 1e-6)
    heights = [position[2] for position in tab.positions]
    assert len(heights) > 3
    assert np.diff(heights).min() > -0.05


def test_picture_is_saved_in_full(tab, site):
    tab.look(site.home, SIZE)
    shown = settled(tab)
    with Image.open(io.BytesIO(saved(tab, "Save picture", "blobs.png"))) as picture:
        pixels = np.asarray(picture).astype(int)
    assert pixels.shape == shown.shape
    assert abs(pixels - shown).mean() < 3  # but for JPEG
