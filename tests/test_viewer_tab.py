"""A tab of the viewer, from the browser's side of its connection, which viewer_client plays."""

import io
import re
import time

import numpy as np
import pytest
from PIL import Image

import scenes_lod
import v3dg
from v3dg.viewer.figures import figures_html
from v3dg.viewer.frame import Figures, Frame, SceneView
from v3dg.viewer.server import Site, start_view
from v3dg.viewer.view import look_at

pytest.importorskip("viser")
viewer_client = pytest.importorskip("viewer_client")

pytestmark = [
    # A site that closes while somebody is just connecting leaves viser's end of the connection to the
    # collector.
    pytest.mark.filterwarnings("ignore:unclosed:ResourceWarning"),
    pytest.mark.usefixtures("collected_connections"),
]

SIZE = (240, 160)


@pytest.fixture(scope="module")
def site(blob_bundle, tmp_path_factory):
    path = tmp_path_factory.mktemp("tab") / "blob.v3dg"
    blob_bundle.write(path)
    scene = v3dg.Scene()
    positions = np.random.default_rng(1).normal(size=(30, 3))
    scene.add(v3dg.Bundle.open(path), positions=positions, scales=np.full(30, 0.5))
    cameras = {"aside": v3dg.Camera.look_at((9, 0, 0), (0, 0, 0), width=64, height=48)}
    site = Site(SceneView(scene, device="cpu"), name="blobs", cameras=cameras, port=0)
    site.folder = path.parent
    site.home = start_view(SceneView(scene, device="cpu"), (0, 0, 1), SIZE[0] / SIZE[1])
    yield site
    site.close()


@pytest.fixture
def tab(site):
    with viewer_client.Tab(site.port) as tab:
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
    with viewer_client.Tab(site.port) as tab:
        tab.look(site.home, SIZE)
        sizes = []
        while SIZE not in sizes:
            sizes += [picture.size for _, picture in tab.pictures(time.perf_counter() + 1)]
    assert sizes[0][0] < SIZE[0]
    assert sizes == sorted(sizes)


def test_asset_has_no_controls_of_levels():
    scene_view = SceneView(scenes_lod.blob(np.random.default_rng(0), 500), device="cpu")
    site = Site(scene_view, port=0)
    try:
        with viewer_client.Tab(site.port) as tab:
            tab.look(start_view(scene_view, (0, 0, 1)), SIZE)
            settled(tab)
            assert tab.visible("Resolution %")
            assert not tab.visible("Tolerance px²")
            assert "Level" not in tab.options("Show")
            tab.set("Show", "Cluster")
            assert settled(tab).max() > 30
    finally:
        site.close()


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


def test_fade_is_on_until_it_is_switched_off(tab):
    tab.set("Tolerance px²", 4)
    settled(tab)
    fading = figure(tab, "selected")
    tab.set("Fade", False)
    settled(tab, lambda: figure(tab, "selected") < fading)
    tab.set("Fade", True)
    settled(tab, lambda: figure(tab, "selected") == fading)


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


def test_what_cannot_be_drawn_is_explained(blob_view):
    site = Site(blob_view, port=0, budget=3)
    try:
        with viewer_client.Tab(site.port) as tab:
            tab.look(start_view(blob_view, (0, 0, 1)), SIZE)
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

    beside = site.folder / "scene.json"
    beside.write_bytes(saved(tab, "Save scene (.json)", "blobs.json"))
    scene, cameras = v3dg.read_scene(beside)
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
