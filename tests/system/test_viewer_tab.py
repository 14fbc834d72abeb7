"""A browser tab of the viewer, seen from the web page's end of the connection.
viewer_client plays the page."""

import io
import json
import time
from dataclasses import asdict

import numpy as np
import pytest
from PIL import Image

import scenes_lod
import v3dg
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.server import Site, start_view
from v3dg.viewer.view import look_at

viewer_client = pytest.importorskip("viewer_client")

pytestmark = [
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
    site.folder, site.scene = path.parent, scene
    site.home = start_view(SceneView(scene, device="cpu"), (0, 0, 1), SIZE[0] / SIZE[1])
    yield site
    assert site.close()


def in_json(settings):
    """Return settings in the form in which the web page receives them."""
    return json.loads(json.dumps(asdict(settings)))


@pytest.fixture
def tab(site):
    with viewer_client.Tab(site.port) as tab:
        tab.look(site.home, SIZE)
        settled(tab)
        yield tab


def settled(tab):
    """Return the settled picture: in full size, and for the last request."""
    last, end = None, time.monotonic() + 60
    while time.monotonic() < end:
        pictures = tab.pictures(time.perf_counter() + 0.1)
        last = pictures[-1][1] if pictures else last
        if last is not None and tab.is_answered:
            return np.asarray(last).astype(int)
    pytest.fail(f"no picture in full: {tab.figures} {tab.failures} {tab.notices}")


def wait_for(tab, condition):
    end = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < end, (tab.figures, tab.notices, tab.answers)
        tab.pictures(time.perf_counter() + 0.1)


def saved(tab, what, name, path=()):
    tab.save(what, path)
    wait_for(tab, lambda: name in tab.files)
    return tab.files[name]


def beside(site):
    """Return the view rotated by a quarter of a turn."""
    x, y, z = site.home.position
    return look_at((-y, x, z), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect)


def test_page_is_told_what_there_is(tab, site):
    assert tab.hello["settings"] == tab.hello["defaults"] == in_json(Settings())
    assert tab.hello["up"] == [0, 0, 1]
    assert [camera["name"] for camera in tab.hello["cameras"]] == ["aside"]
    assert tab.hello["cameras"][0]["view"]["position"] == [9, 0, 0]
    assert (tab.scene["name"], tab.scene["instances"], tab.scene["has_files"]) == (
        "blobs",
        30,
        True,
    )
    assert (
        len({tuple(color) for color in tab.scene["level_colors"]})
        == site.scene.bundles[0].num_levels
    )


def test_page_is_told_what_a_tab_begins_with(blob_bundle):
    scene_view = SceneView(blob_bundle, device="cpu")
    site = Site(scene_view, port=0, tolerance=0.0, budget=5000)
    try:
        with viewer_client.Tab(site.port) as tab:
            expected = in_json(Settings(tolerance=0.0, budget=5000))
            assert tab.hello["settings"] == expected
            assert tab.hello["defaults"] == in_json(Settings())
    finally:
        site.close()


def test_tab_gets_a_small_picture_and_then_the_full_one(site):
    with viewer_client.Tab(site.port) as tab:
        tab.look(site.home, SIZE)
        sizes = []
        while not tab.is_answered:
            sizes += [picture.size for _, picture in tab.pictures(time.perf_counter() + 0.1)]
    assert sizes[0][0] < SIZE[0]
    assert sizes == sorted(sizes)
    assert sizes[-1] == SIZE


def test_picture_tells_where_it_is_seen_from_and_how_far(tab, site):
    tab.look(beside(site), SIZE)
    settled(tab)
    assert tab.figures["view"]["position"] == list(beside(site).position)
    away = np.linalg.norm(beside(site).position)
    assert 0.5 * away < tab.figures["distance"] < 1.5 * away
    tab.look(look_at((50, 0, 0), (60, 0, 0), (0, 0, 1), 0.8, 1.5), SIZE)
    settled(tab)
    assert tab.figures["distance"] is None


def test_asset_has_one_level():
    scene_view = SceneView(scenes_lod.blob(np.random.default_rng(0), 500), device="cpu")
    site = Site(scene_view, port=0)
    try:
        with viewer_client.Tab(site.port) as tab:
            assert len(tab.scene["level_colors"]) == 1
            assert not tab.scene["has_files"]
            tab.look(start_view(scene_view, (0, 0, 1)), SIZE)
            tab.change(shows="cluster")
            assert settled(tab).max() > 30
    finally:
        site.close()


def test_picture_follows_the_camera(tab, site):
    tab.look(site.home, SIZE)
    first = settled(tab)
    assert (first.max(axis=2) > 30).mean() > 0.03
    tab.look(beside(site), SIZE)
    assert (abs(first - settled(tab)).max(axis=2) > 30).mean() > 0.02


def test_settings_change_the_cut(tab):
    def selected(**settings):
        tab.change(**settings)
        settled(tab)
        return tab.figures["gaussians_selected"]

    everything = selected(tolerance=0)
    assert sum(tab.figures["levels"]) == everything
    assert tab.figures["memory_bytes"] > 10 << 20
    assert selected(tolerance=32) < 0.7 * everything
    assert selected(tolerance=0, min_level=2) < 0.7 * everything
    assert 0 < selected(min_level=0, budget=10_000) <= 10_000
    assert tab.figures["tolerance"] > 0


def test_modes_have_ranges(tab):
    for shows, values in (("depth", (float, float)), ("count", (1.0, 256.0)), ("appearance", None)):
        tab.change(shows=shows)
        settled(tab)
        given = tab.figures["range"]
        if shows == "depth":
            assert given[0] > given[1] > 0
        else:
            assert given == (None if values is None else list(values))
    tab.change(shows="difference", gain=30, tolerance=32)
    assert settled(tab).max() > 30
    tab.change(split=1)
    assert settled(tab).max() > 30


def test_fade_is_on_until_it_is_switched_off(tab):
    selected = []
    for fade in (v3dg.DEFAULT_FADE, None, v3dg.DEFAULT_FADE):
        tab.change(tolerance=40, fade=fade)
        settled(tab)
        selected.append(tab.figures["gaussians_selected"])
    assert selected[1] < selected[0] == selected[2]


def test_frozen_cut_is_kept_until_it_is_let_go(tab, site):
    selected = tab.figures["gaussians_selected"]
    x, y, z = site.home.position
    tab.change(frozen=asdict(site.home))
    tab.look(
        look_at((6 * x, 6 * y, 6 * z), (0, 0, 0), (0, 0, 1), site.home.fov_y, site.home.aspect),
        SIZE,
    )
    settled(tab)
    assert tab.figures["gaussians_selected"] == selected
    tab.change(frozen=None)
    settled(tab)
    assert tab.figures["gaussians_selected"] < selected


def test_what_cannot_be_drawn_is_explained(blob_view):
    site = Site(blob_view, port=0, budget=3)
    try:
        with viewer_client.Tab(site.port) as tab:
            assert tab.hello["settings"]["budget"] == 3
            tab.settings["budget"] = 3
            tab.look(start_view(blob_view, (0, 0, 1)), SIZE)
            wait_for(tab, lambda: tab.failures)
            assert "budget: expected at least" in tab.failures[0]
            tab.change(budget=1_000_000)
            settled(tab)
    finally:
        site.close()


@pytest.mark.parametrize("memory", [None, "64MB"])
def test_click_finds_an_instance_and_its_point(site, memory):
    (one,) = site.scene.bundles
    scene = v3dg.Scene()
    scene.add(one, positions=[(0, 0, 0), (0, 30, 0), (0, 60, 5)], scales=np.full(3, 2.0))
    lonely = Site(SceneView(scene, device="cpu", memory=memory), port=0)
    try:
        with viewer_client.Tab(lonely.port) as tab:
            tab.look(look_at((-60, 30, 0), (0, 30, 0), (0, 0, 1), 0.9, SIZE[0] / SIZE[1]), SIZE)
            settled(tab)
            tab.pick(at=(0.5, 0.5))
            wait_for(tab, lambda: "picked" in tab.answers)
            found = tab.answers.pop("picked")
            assert (found["instance"], found["pose"]["position"]) == (1, [0, 30, 0])
            assert found["pose"]["scale"] == 2
            assert abs(found["point"][1] - 30) < 1
            low, high = np.array(found["box"])
            assert (low < high).all()
            tab.pick(at=(0.5, 0.01))
            wait_for(tab, lambda: "picked" in tab.answers)
            assert "instance" not in tab.answers.pop("picked")
            tab.pick(instance=2)
            wait_for(tab, lambda: "picked" in tab.answers)
            assert tab.answers["picked"]["pose"]["position"] == [0, 60, 5]
            tab.pick(instance=3)
            wait_for(tab, lambda: tab.notices)
            assert tab.notices == ["instance: expected 0 to 2, got 3"]
    finally:
        lonely.close()


def test_moved_instance_is_seen_in_every_tab_and_saved(site, tmp_path):
    scene = v3dg.Scene()
    scene.add(site.scene.bundles[0], positions=[(0, 0, 0), (1, 0, 0)])
    shared = Site(SceneView(scene, device="cpu"), name="pair", port=0)
    view = look_at((0, -9, 0), (0, 0, 0), (0, 0, 1), 0.8, SIZE[0] / SIZE[1])
    try:
        with viewer_client.Tab(shared.port) as tab, viewer_client.Tab(shared.port) as other:
            tab.look(view, SIZE)
            other.look(view, SIZE)
            before = settled(other)
            other.figures = {}
            tab.move(1, (1.5, 0.5, 2), (0, 0, 0, 1), 0.5)
            assert (abs(settled(other) - before).max(axis=2) > 30).mean() > 0.02
            content = saved(tab, "scene", "pair.json", [(0.5, view)])
        (site.folder / "pair.json").write_bytes(content)
        moved, cameras = v3dg.read_scene(site.folder / "pair.json")
        assert moved.positions.tolist() == [[0, 0, 0], [1.5, 0.5, 2]]
        assert moved.quaternions[1].tolist() == [0, 0, 0, 1]
        assert moved.scales.tolist() == [1, 0.5]
        assert len(cameras) == 2
    finally:
        shared.close()


def test_dropped_file_is_shown_in_its_tab_alone(tab, site, tmp_path):
    tab.change()
    before = settled(tab)
    v3dg.write_asset(tmp_path / "few.ply", scenes_lod.blob(np.random.default_rng(5), 400, size=0.5))
    with viewer_client.Tab(site.port) as other:
        other.look(site.home, SIZE)
        other.drop("few.ply", (tmp_path / "few.ply").read_bytes(), piece=1000)
        wait_for(other, lambda: other.scene["name"] == "few")
        assert (other.scene["instances"], len(other.scene["level_colors"])) == (1, 1)
        other.look(site.home, SIZE)
        settled(other)
        assert other.figures["gaussians_selected"] == 400
        other.drop("broken.v3dg", b"no bundle")
        wait_for(other, lambda: other.notices)
        assert "broken.v3dg" in other.notices[0]
        assert "/" not in other.notices[0]
        assert other.scene["name"] == "few"
    tab.change()
    assert abs(settled(tab) - before).max() == 0
    assert tab.scene["name"] == "blobs"


def test_path_is_saved_as_cameras_a_scene_and_a_film(tab, site, tmp_path):
    tab.save("cameras")
    wait_for(tab, lambda: tab.notices)
    assert "path: expected at least one view" in tab.notices[0]
    path = [(0.5, site.home), (0.5, beside(site))]

    (tmp_path / "cameras.json").write_bytes(saved(tab, "cameras", "transforms.json", path))
    cameras = list(v3dg.read_cameras(tmp_path / "cameras.json").values())
    assert len(cameras) == 16
    np.testing.assert_allclose(cameras[0].position, site.home.position, atol=1e-9)
    np.testing.assert_allclose(cameras[-1].position, beside(site).position, atol=1e-9)

    (site.folder / "scene.json").write_bytes(saved(tab, "scene", "blobs.json", path))
    scene, cameras = v3dg.read_scene(site.folder / "scene.json")
    assert (len(scene), len(cameras)) == (30, 16)

    av = pytest.importorskip("av")
    with av.open(io.BytesIO(saved(tab, "film", "blobs.mp4", path))) as film:
        pictures = [frame.to_ndarray(format="rgb24").astype(int) for frame in film.decode(video=0)]
    assert len(pictures) == 16
    assert pictures[0].shape == (SIZE[1], SIZE[0], 3)
    assert (abs(pictures[0] - pictures[-1]).max(axis=2) > 30).mean() > 0.02


def test_path_is_played_smoothly(tab, site):
    tab.save("play", [(0.1, site.home), (0.5, beside(site))])
    wait_for(tab, lambda: "play" in tab.answers)
    positions = np.array([view["position"] for view in tab.answers["play"]["views"]])
    assert len(positions) == 16
    np.testing.assert_allclose(positions[[0, -1]], [site.home.position, beside(site).position])
    steps = np.linalg.norm(np.diff(positions, axis=0), axis=1)
    assert 0 < steps.min() < steps.max() < 2 * np.median(steps)


def test_picture_is_saved_in_full(tab, site):
    tab.look(site.home, SIZE)
    shown = settled(tab)
    with Image.open(io.BytesIO(saved(tab, "picture", "blobs.png"))) as picture:
        pixels = np.asarray(picture).astype(int)
    assert pixels.shape == shown.shape
    assert abs(pixels - shown).mean() < 3  # JPEG causes small differences
