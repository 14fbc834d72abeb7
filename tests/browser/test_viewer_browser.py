"""Uses the viewer in Chromium as a person does. The tests need playwright, and Chromium
on PATH."""

import base64
import io
import itertools
import json
from urllib.parse import urlsplit

import numpy as np
import pytest
from PIL import Image

import chromium
import scenes_lod
import v3dg
from v3dg.viewer.frame import SceneView
from v3dg.viewer.link import read_link
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
SHOWS = (
    "Colour",
    "Level",
    "Cluster",
    "Error",
    "Depth",
    "Alpha",
    "Gaussians per pixel",
    "Difference to all gaussians",
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    rng = np.random.default_rng(0)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 600, size=0.3), 64)
    path = tmp_path_factory.mktemp("viewer") / "blob.v3dg"
    bundle.write(path)
    scene = v3dg.Scene()
    scene.add(v3dg.Bundle.open(path), positions=rng.normal(size=(200, 3)), scales=np.full(200, 0.3))
    scene_view = SceneView(scene, device="cpu")
    cameras = {"from the side": v3dg.Camera.look_at((6, 0, 0), (0, 0, 0), width=640, height=480)}
    site = Site(scene_view, name="blobs", cameras=cameras, port=0)
    site.scene_view, site.folder = scene_view, path.parent
    yield site
    site.close()


class Tab:
    """A browser tab with the viewer: what can be seen in it, and actions of a user."""

    def __init__(self, browser, url, size=(900, 600), **options):
        self.errors = []
        context = browser.new_context(viewport={"width": size[0], "height": size[1]}, **options)
        context.grant_permissions(["clipboard-read", "clipboard-write"])
        self.page = context.new_page()
        self.page.on("console", lambda m: m.type == "error" and self.errors.append(m.text))
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.goto(url)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.page.context.close()
        assert self.errors == []

    def figure(self, name):
        cell = self.page.locator(f"#panel tr:has(td:text-is('{name}')) td").last
        return float(cell.inner_text().split()[0].replace(",", ""))

    def settled(self):
        """Wait until the picture is drawn in full and the page reports this. Return its
        8-bit values."""
        self.page.wait_for_timeout(300)  # waits until earlier actions were sent
        self.page.wait_for_selector("body[data-state=ready]", timeout=1000 * SECONDS)
        self.page.wait_for_timeout(300)  # waits until the browser has drawn it
        return self.seen()

    def seen(self):
        """Return the middle of the picture, which no control covers."""
        box = self.page.locator("#stage").bounding_box()
        clip = box | {"y": 90, "height": box["height"] - 220}
        return np.asarray(
            Image.open(io.BytesIO(self.page.screenshot(clip=clip))).convert("RGB")
        ).astype(int)

    def view(self):
        """Return the camera and the settings in the page's address."""
        self.page.wait_for_timeout(300)  # waits until earlier actions have begun
        self.page.wait_for_function("() => !viewer.requests.isMoving && !viewer.frames.isDue")
        hash = self.page.evaluate("location.hash").removeprefix("#")
        return dict(part.split("=", 1) for part in hash.split("&"))

    def position(self):
        return np.array([float(x) for x in self.view()["at"].split(",")])

    def drag(self, start=(200, 400), end=(300, 380), **options):
        self.page.mouse.move(*start)
        self.page.mouse.down(**options)
        self.page.mouse.move(*end, steps=8)
        self.page.mouse.up(**options)

    def open(self, folder):
        self.page.locator("#panel summary", has_text=folder).click()

    def set(self, slider, value):
        """Set the value of a slider in the same way as its keys."""
        self.page.get_by_role("slider", name=slider, exact=True).evaluate(
            "(e, v) => { e.value = v; e.dispatchEvent(new Event('input')); }", value
        )

    def press(self, name):
        self.page.get_by_role("button", name=name, exact=True).click()

    def saved(self, name):
        with self.page.expect_download(timeout=1000 * SECONDS) as download:
            self.press(name)
        with open(download.value.path(), "rb") as file:
            return download.value.suggested_filename, file.read()


@pytest.fixture
def tab(browser, site):
    with Tab(browser, site.url) as tab:
        tab.settled()
        yield tab


def differ(first, second):
    return (abs(first - second).max(axis=2) > 20).mean()


def test_picture_is_there_and_follows_the_camera_and_a_slider(tab):
    first = tab.settled()
    assert (first.max(axis=2) > 30).mean() > 0.05
    assert differ(first, tab.settled()) == 0
    tab.drag()
    turned = tab.settled()
    assert differ(first, turned) > 0.02
    selected = tab.figure("selected")
    tab.set("Tolerance px²", 32)
    coarse = tab.settled()
    # Near the asset, most of the picture shows fine detail, so few gaussians are
    # selected.
    assert tab.figure("selected") < 0.9 * selected
    assert differ(turned, coarse) > 0.001


def test_page_of_a_token_reaches_the_viewer(browser, site):
    elsewhere = Site(site.scene_view, host="0.0.0.0", port=0)
    try:
        path = urlsplit(elsewhere.url).path
        with Tab(browser, f"http://127.0.0.1:{elsewhere.port}{path}") as tab:
            assert (tab.settled().max(axis=2) > 30).mean() > 0.05
    finally:
        elsewhere.close()


def test_page_asks_what_is_up_where_that_is_assumed(browser, site):
    asking = Site(site.scene_view, name="blobs", port=0, up=(0, -1, 0), asks_up=True)
    question = "#question:not([hidden])"
    try:
        with Tab(browser, asking.url) as tab:
            first = tab.settled()
            group = tab.page.get_by_role("radiogroup", name="Which way is up?")
            assert group.get_by_role("radio").all_inner_texts() == ["x", "y", "z", "-x", "-y", "-z"]
            checked = group.locator("[aria-checked=true]")
            assert checked.all_inner_texts() == ["-y"]
            group.get_by_role("radio", name="x", exact=True).click()
            assert differ(first, tab.settled()) > 0.02
            assert tab.view()["up"] == "x"
            assert checked.all_inner_texts() == ["x"]
            group.get_by_role("button").click()
            tab.page.wait_for_selector(question, state="hidden")
            link = tab.page.url
        with Tab(browser, link) as tab:  # this asset declares its up axis
            tab.settled()
            assert tab.page.locator(question).count() == 0
    finally:
        asking.close()
    with Tab(browser, site.url) as tab:
        tab.settled()
        assert tab.page.locator(question).count() == 0


def test_drag_is_answered_while_the_mouse_is_still_down(tab):
    """First the existing picture is moved. Then drafts follow, which are marked as
    drafts."""
    first = tab.settled()
    tab.page.mouse.move(200, 400)
    tab.page.mouse.down()
    tab.page.mouse.move(400, 380, steps=8)
    is_whole = (
        "viewer.picture.message.final && viewer.picture.message.number === viewer.requests.number"
    )
    told = tab.page.evaluate(f"[document.body.dataset.state, {is_whole}]")
    assert told in (["moving", False], ["refining", False], ["ready", True])
    assert differ(first, tab.seen()) > 0.02
    tab.page.wait_for_selector("body[data-state=ready]", timeout=1000 * SECONDS)
    assert differ(first, tab.seen()) > 0.02
    assert tab.page.locator("#picture").evaluate("e => e.style.transform") == "none"
    tab.page.mouse.up()


def test_moved_picture_is_nearly_the_one_that_follows(browser, site):
    """The moved picture and the next picture show the asset from the same position.
    They are compared where both have content."""
    with Tab(browser, site.url) as tab:
        tab.settled()
        tab.page.get_by_role("radio", name="Fly").click()
        first = tab.settled()
        tab.page.evaluate("viewer.connection.send = () => {}")  # so that no further picture arrives
        tab.drag((200, 300), (260, 300))
        # If the browser needs a long time for a frame, the picture follows the camera
        # less often.
        tab.page.wait_for_timeout(300)
        moved = tab.seen()
        assert differ(first, moved) > 0.02
        tab.page.evaluate("delete viewer.connection.send; viewer.requests.reset(); viewer.redraw()")
        after = tab.settled()
    middle = np.s_[:, 100:400]
    assert (
        abs(moved[middle] - after[middle]).mean() < 0.2 * abs(first[middle] - after[middle]).mean()
    )


def test_larger_pictures_of_where_the_camera_was_are_left_out(tab):
    tab.settled()
    tab.page.evaluate(
        """async () => {
            window.before = viewer.picture.message;
            viewer.requests.number += 1;  // the camera moves
            // Without bytes: it is not even looked at.
            await viewer.picture.show({ ...viewer.picture.message }, null);
        }"""
    )
    assert tab.page.evaluate("viewer.picture.message === window.before")


def test_every_mode_looks_different(tab):
    pictures = []
    for name in SHOWS:
        tab.page.get_by_label("Show", exact=True).select_option(name)
        pictures.append(tab.settled())
    for first, second in itertools.combinations(pictures, 2):
        assert differ(first, second) > 0.01


def test_tabs_have_their_own_camera_and_settings(browser, site, tab):
    with Tab(browser, site.url) as other:
        first = other.settled()
        tab.drag()
        tab.page.get_by_label("Show", exact=True).select_option("Depth")
        tab.settled()
        assert differ(first, other.settled()) == 0


def test_frozen_cut_stays_when_the_camera_goes_away(tab):
    selected = tab.figure("selected")
    tab.page.get_by_label("Freeze the cut").check()
    tab.settled()
    tab.page.mouse.move(300, 400)
    tab.page.mouse.wheel(0, 800)
    tab.settled()
    assert tab.figure("selected") == selected


def test_budget_is_kept(tab):
    assert tab.figure("selected") > 10_000
    tab.page.get_by_label("Limit gaussians").check()
    tab.set("Millions", np.log(0.01))
    tab.settled()
    assert 0 < tab.figure("selected") <= 10_000
    assert tab.figure("tolerance") > 3


def test_keys_fly_at_a_pace_that_suits_the_scene(browser, site):
    """Keys move the camera by as many radii of the scene per second in a donut as in a
    world."""
    shares = []
    for scale in (1e-3, 1.0, 1e4):
        scene = v3dg.Scene()
        rows = np.random.default_rng(1).normal(size=(50, 3)) * scale
        scene.add(site.scene_view.scene.bundles[0], positions=rows, scales=np.full(50, 0.3 * scale))
        scene_view = SceneView(scene, device="cpu")
        world = Site(scene_view, port=0)
        try:
            with Tab(browser, world.url) as tab:
                tab.settled()
                before = tab.position()
                for key in ("w", "d"):
                    tab.page.keyboard.down(key)
                    tab.page.wait_for_timeout(1000)
                    tab.page.keyboard.up(key)
                tab.settled()
                shares.append(np.linalg.norm(tab.position() - before) / scene_view.radius)
        finally:
            world.close()
    assert min(shares) > 0.2
    assert max(shares) < 3 * min(shares)


def test_who_goes_on_pushing_against_what_is_near_comes_through(tab):
    tab.settled()
    tab.page.evaluate("viewer.camera.ahead = 0.01 * viewer.scene.radius")
    paces = tab.page.evaluate(
        """[0, 1, 10].map((seconds) => {
            for (let t = 0; t < seconds; t += 0.02) viewer.camera.move([0, 0, 1], 0.02);
            return viewer.camera.pace / viewer.scene.radius;
        })"""
    )
    assert paces[0] == pytest.approx(0.02)
    assert paces[0] < paces[1] < paces[2] == pytest.approx(0.2)
    tab.page.evaluate("viewer.camera.move([0, 0, 0], 0.02)")
    assert tab.page.evaluate("viewer.camera.pace / viewer.scene.radius") == pytest.approx(0.02)


def test_speed_slider_and_keys_change_the_pace(tab):
    pace = tab.page.evaluate("viewer.camera.pace")
    tab.set("Speed", np.log(4))
    assert tab.page.evaluate("viewer.camera.pace") == pytest.approx(4 * pace, rel=0.02)
    tab.page.keyboard.press("+")
    assert tab.page.evaluate("viewer.camera.pace") == pytest.approx(6 * pace, rel=0.02)


def test_walking_keeps_its_height_and_flying_does_not(tab):
    def after_w(mode):
        tab.page.get_by_role("radio", name=mode).click()
        before = tab.position()
        tab.page.keyboard.down("w")
        tab.page.wait_for_timeout(500)
        tab.page.keyboard.up("w")
        tab.settled()
        return tab.position() - before

    walked = after_w("Walk")
    assert np.linalg.norm(walked[:2]) > 0.1
    assert abs(walked[2]) < 1e-5
    assert after_w("Fly")[2] < -0.05  # the camera looks down from above


def test_gamepad_moves_and_turns(browser, site):
    stick = "[0, -1, 0.5, 0]"
    buttons = "Array(16).fill({ value: 0, pressed: false })"
    pad = f"{{ connected: true, mapping: 'standard', axes: {stick}, buttons: {buttons} }}"
    with Tab(browser, site.url) as tab:
        tab.settled()
        before = tab.view()
        tab.page.evaluate(
            f"navigator.getGamepads = () => [{pad}]; window.dispatchEvent(new "
            "Event('gamepadconnected'))"
        )
        tab.page.wait_for_timeout(500)
        tab.page.evaluate("navigator.getGamepads = () => []")
        after = tab.view()
    assert before["at"] != after["at"]
    assert before["turn"] != after["turn"]


def test_up_axis_is_changed_in_the_page(tab):
    tab.settled()
    tab.page.get_by_label("Up", exact=True).select_option("y")
    tab.press("Show all")
    tab.settled()
    down = tab.page.evaluate("viewer.camera.down")
    assert down[1] < -0.8
    assert tab.view()["up"] == "y"


def test_link_leads_to_the_same_picture(browser, site, tab):
    tab.drag()
    tab.page.get_by_label("Show", exact=True).select_option("Level")
    tab.set("Tolerance px²", 12)
    tab.page.get_by_role("radio", name="Fly").click()
    first = tab.settled()
    tab.open("Places")
    tab.press("Copy link")
    link = tab.page.evaluate("navigator.clipboard.readText()")
    assert "show=level" in link
    with Tab(browser, link) as other:
        assert differ(first, other.settled()) < 0.002
        assert other.page.get_by_role("slider", name="Tolerance px²").input_value() == "12"
        assert other.page.get_by_role("radio", name="Fly").get_attribute("aria-checked") == "true"


def test_python_reads_the_camera_of_a_link(tab):
    tab.drag()
    tab.settled()
    camera = tab.page.evaluate("() => ({ ...viewer.camera.view(1), focus: viewer.camera.focus })")
    place = read_link(tab.page.evaluate("() => location.origin + viewer.linkState.hash"))
    assert place.view.position == pytest.approx(camera["position"], rel=1e-5, abs=1e-5)
    assert place.view.wxyz == pytest.approx(camera["wxyz"], abs=1e-6)
    assert place.view.fov_y == pytest.approx(camera["fov_y"], rel=1e-4)
    assert place.focus == pytest.approx(camera["focus"], rel=1e-5, abs=1e-5)


def test_background_is_chosen_and_kept_in_the_link(browser, tab):
    assert (tab.settled()[:5, :5] == 0).all()
    tab.page.get_by_label("Background").fill("#ff8000")
    corner = tab.settled()[:5, :5].reshape(-1, 3).astype(int)
    assert abs(corner - (255, 128, 0)).max() < 12
    link = tab.page.evaluate("() => location.href.split('#')[0] + viewer.linkState.hash")
    assert "background=ff8000" in link
    with Tab(browser, link) as other:
        corner = other.settled()[:5, :5].reshape(-1, 3).astype(int)
        assert abs(corner - (255, 128, 0)).max() < 12


@pytest.mark.parametrize(
    "hash",
    [
        "#at=1,2&turn=x&show=nothing&mode=fall&fov=NaN&up=q",
        "#%E0%A4%A",
        "#at=1e999,0,0&turn=0,0,0,0",
        "#up=constructor",
    ],
)
def test_wrong_links_show_the_scene(browser, site, hash):
    with Tab(browser, site.url + "/" + hash) as tab:
        assert (tab.settled().max(axis=2) > 30).mean() > 0.05


def test_a_link_that_asks_for_what_is_not_there_is_told_so(browser, site):
    with Tab(browser, site.url + "/#show=residency&split=0.5") as tab:
        tab.page.wait_for_function(
            "() => document.querySelector('#notices').innerText.includes('residency')"
        )
        assert "mode residency is not there" in tab.page.inner_text("#notices")
        view = tab.view()
        assert "show" not in view
        # the memory is divided only if there is a pool
        assert float(view["split"]) == 0.5


def test_bookmarks_outlive_the_page_and_lead_back(tab):
    tab.drag()
    first = tab.settled()
    tab.page.keyboard.press("b")
    tab.open("Places")
    tab.press("Show all")
    assert differ(first, tab.settled()) > 0.02
    tab.page.reload()
    tab.settled()
    tab.page.keyboard.press("1")
    tab.page.wait_for_timeout(900)
    assert differ(first, tab.settled()) < 0.01


def test_go_to_a_point_an_instance_and_a_camera(tab):
    tab.open("Places")

    def go(where):
        tab.page.get_by_label("Go to").fill(where)
        tab.press("Go")
        tab.page.wait_for_timeout(900)
        tab.settled()
        return [float(x) for x in tab.view()["focus"].split(",")]

    assert go("1 2 3") == [1, 2, 3]
    scene = tab.page.evaluate("viewer.scene.instances")
    assert scene == 200
    go("#7")
    assert tab.page.evaluate("viewer.instances.selected.instance") == 7
    go("from the side")
    np.testing.assert_allclose(tab.position(), (6, 0, 0))
    go("nowhere")
    assert "Go to: expected" in tab.page.inner_text("#notices")


def test_clicked_instance_is_selected_moved_undone_and_saved(browser, site):
    scene = v3dg.Scene()
    scene.add(site.scene_view.scene.bundles[0], positions=[(0, 0, 0), (4, 0, 0)], scales=[0.5, 0.5])
    pair = Site(SceneView(scene, device="cpu"), name="pair", port=0)
    try:
        with Tab(
            browser, pair.url + "/#at=2,-14,0&turn=0.70710678,-0.70710678,0,0&focus=2,0,0"
        ) as tab:
            before = tab.settled()
            layer = tab.page.locator("#overlay")
            # There is nothing to blend over the picture.
            assert layer.evaluate("e => e.style.opacity") == "0"
            at = tab.page.evaluate("viewer.overlay.projection.place([4, 0, 0])")
            tab.page.mouse.click(*at)
            tab.page.wait_for_function("() => viewer.instances.selected?.instance === 1")
            tip = tab.page.evaluate(
                "viewer.overlay.projection.place(viewer.overlay.handles.tip(2))"
            )
            assert layer.evaluate("e => e.style.opacity") == "1"
            tab.drag(tip, (tip[0], tip[1] - 60))
            tab.page.get_by_role("radio", name="Turn").click()
            ring = tab.page.evaluate(
                "viewer.overlay.projection.place(viewer.overlay.handles.ring(1)[6])"
            )
            tab.drag(ring, (ring[0] - 60, ring[1]))
            tab.page.get_by_role("radio", name="Scale").click()
            middle = tab.page.evaluate(
                "viewer.overlay.projection.place(viewer.instances.selected.pose.position)"
            )
            tab.drag((middle[0] + 59, middle[1]), (middle[0] + 118, middle[1]))
            assert differ(before, tab.settled()) > 0.01
            np.testing.assert_allclose(scene.positions[0], 0)
            assert 1 < scene.positions[1, 2] < 4
            np.testing.assert_allclose(scene.positions[1, :2], (4, 0), atol=1e-6)
            assert abs(scene.quaternions[1, 2]) > 0.1
            assert 0.8 < scene.scales[1] < 1.2
            tab.open("Instances")
            name, content = tab.saved("Save scene (.json)")
            (site.folder / name).write_bytes(content)
            np.testing.assert_array_equal(
                v3dg.read_scene(site.folder / name)[0].positions, scene.positions
            )
            for _ in range(3):
                tab.page.keyboard.press("Control+z")
            tab.page.keyboard.press("Escape")
            assert differ(before, tab.settled()) < 0.002
            np.testing.assert_allclose(scene.positions[1], (4, 0, 0))
    finally:
        pair.close()


def test_double_click_flies_to_what_is_there(tab):
    box = tab.page.locator("#stage").bounding_box()
    before = tab.position()
    tab.page.mouse.dblclick(box["width"] / 2, box["height"] / 2)
    tab.page.wait_for_timeout(1500)
    tab.settled()
    assert np.linalg.norm(tab.position()) < 0.6 * np.linalg.norm(before)


def test_dropped_file_is_shown(tab, tmp_path):
    v3dg.write_asset(tmp_path / "few.ply", scenes_lod.blob(np.random.default_rng(3), 300, size=0.5))
    content = base64.b64encode((tmp_path / "few.ply").read_bytes()).decode()
    tab.page.evaluate(
        """async (content) => {
            const bytes = Uint8Array.from(atob(content), (c) => c.charCodeAt(0));
            const transfer = new DataTransfer();
            transfer.items.add(new File([bytes], "few.ply"));
            const options = { dataTransfer: transfer, cancelable: true };
            window.dispatchEvent(new DragEvent("drop", options));
        }""",
        content,
    )
    tab.page.wait_for_selector("#panel h1:text-is('few')", timeout=1000 * SECONDS)
    tab.page.wait_for_timeout(900)  # waits until the camera has arrived
    assert tab.settled().max() > 60
    assert tab.figure("selected") == 300
    # A first view fills this share of the window.
    assert tab.figure("in the frustum") >= 0.96 * 300


def test_photographs_lie_over_the_picture_of_their_camera(browser, site, tmp_path):
    Image.fromarray(np.full((48, 64, 3), (0, 200, 0), np.uint8)).save(tmp_path / "side.png")
    camera = v3dg.Camera.look_at((0, 3, 0), (0, 0, 0), width=64, height=48)
    captured = Site(
        site.scene_view,
        cameras={"side": camera},
        photographs={"side": tmp_path / "side.png"},
        port=0,
    )
    try:
        with Tab(browser, captured.url) as tab:
            tab.settled()
            at = tab.page.evaluate(
                "viewer.overlay.projection.place("
                "[0, 3 - viewer.fileCameras.frustumSize * viewer.scene.radius, 0])"
            )
            tab.page.mouse.click(*at)
            tab.page.wait_for_selector("#photograph:visible")
            tab.settled()
            tab.open("Cameras of the file")
            tab.set("Photograph %", 100)
            tab.page.wait_for_timeout(300)
            assert abs(tab.seen()[200, 300] - (0, 200, 0)).max() < 12
            tab.drag()
            tab.settled()
            assert not tab.page.locator("#photograph").is_visible()
    finally:
        captured.close()


def test_phone_has_the_picture_to_itself(browser, site):
    with Tab(
        browser, site.url, (390, 760), has_touch=True, is_mobile=True, device_scale_factor=2
    ) as tab:
        picture = tab.settled()
        assert tab.page.locator("#stage").bounding_box()["width"] == 390
        assert not tab.page.locator("#panel").is_visible()
        assert (picture.max(axis=2) > 30).mean() > 0.03
        # The window is narrow, so the first view fits the width of the subject into it.
        homes = "viewer.scene.homes.map((home) => home.view.aspect)"
        aspects = tab.page.evaluate(homes)
        assert min(aspects) <= tab.page.evaluate("viewer.look.aspect") < max(aspects)
        edges = np.concatenate([picture[:, :4].reshape(-1, 3), picture[:, -4:].reshape(-1, 3)])
        assert (edges.max(axis=1) > 60).mean() < 0.05  # stray gaussians reach the borders
        tab.page.touchscreen.tap(195, 300)
        tab.page.get_by_role("button", name="Panel").tap()
        assert tab.page.locator("#panel").bounding_box()["y"] > 380
        tab.page.get_by_role("button", name="Panel").tap()
        assert not tab.page.locator("#panel").is_visible()
        tab.page.get_by_role("radio", name="Fly").tap()
        pad = tab.page.locator("#pad").bounding_box()
        before = tab.position()
        tab.page.evaluate(
            """([x, y]) => {
                const pad = document.getElementById("pad");
                pad.setPointerCapture = () => {};
                const at = { clientX: x, clientY: y, pointerId: 1, bubbles: true };
                pad.dispatchEvent(new PointerEvent("pointerdown", at));
                setTimeout(() => pad.dispatchEvent(new PointerEvent("pointerup", at)), 500);
            }""",
            [pad["x"] + 55, pad["y"] + 10],
        )
        tab.page.wait_for_timeout(800)
        tab.settled()
        assert np.linalg.norm(tab.position() - before) > 0.1


def test_panel_is_folded_away(tab):
    wide = tab.page.locator("#stage").bounding_box()["width"]
    tab.page.keyboard.press("p")
    tab.settled()
    assert tab.page.locator("#stage").bounding_box()["width"] > wide + 200


def test_heading_of_the_panel_covers_what_is_scrolled_below_it(tab):
    def heading():
        box = tab.page.locator("#panel h1").bounding_box()
        clip = box | {"width": 200}
        return np.asarray(Image.open(io.BytesIO(tab.page.screenshot(clip=clip)))).astype(int)

    tab.settled()
    before = heading()
    for distance in (60, 100, 140):
        tab.page.locator("#panel").evaluate("(panel, y) => panel.scrollTo(0, y)", distance)
        tab.page.wait_for_timeout(200)
        assert differ(before, heading()) == 0


def test_page_says_when_the_viewer_is_gone_and_comes_back_with_it(browser, site):
    first = Site(site.scene_view, port=0)
    with Tab(browser, first.url) as tab:
        tab.settled()
        first.close()
        tab.page.wait_for_selector("body[data-state=connecting]")
        again = Site(site.scene_view, port=first.port)
        try:
            assert again.port == first.port
            tab.page.wait_for_selector("body[data-state=ready]", timeout=1000 * SECONDS)
        finally:
            again.close()
        tab.errors = [error for error in tab.errors if "ERR_CONNECTION_REFUSED" not in error]


def test_pictures_paths_and_scenes_are_saved(tab, site, tmp_path):
    name, png = tab.saved("Save picture")
    assert name == "blobs.png"
    width, height = Image.open(io.BytesIO(png)).size
    box = tab.page.locator("#stage").bounding_box()
    assert (width, height) == (box["width"], box["height"])
    tab.open("Path")
    tab.press("Add this view")
    tab.drag()
    tab.settled()
    tab.press("Add this view")
    name, content = tab.saved("Save cameras (transforms.json)")
    (tmp_path / name).write_bytes(content)
    cameras = v3dg.read_cameras(tmp_path / name)
    assert len(cameras) == 61
    first, *_, last = cameras.values()
    assert np.linalg.norm(first.position - last.position) > 0.1
    np.testing.assert_allclose(last.position, tab.position(), rtol=1e-5)
    tab.open("Instances")
    name, content = tab.saved("Save scene (.json)")
    (site.folder / name).write_bytes(content)
    scene, cameras = v3dg.read_scene(site.folder / name)
    assert len(scene) == 200
    assert len(cameras) == 61
    assert json.loads(content)["format"] == "v3dg-scene"


def test_flight_is_recorded_and_played(tab):
    tab.open("Path")
    tab.page.get_by_label("Record").check()
    start = tab.position()
    tab.drag()
    tab.page.wait_for_timeout(300)
    tab.page.get_by_label("Record").uncheck()
    end = tab.position()
    tab.press("Show all")
    tab.page.wait_for_timeout(900)
    np.testing.assert_allclose(tab.position(), start, rtol=1e-3)
    tab.press("Play")
    tab.page.wait_for_timeout(3000)
    tab.settled()
    np.testing.assert_allclose(tab.position(), end, rtol=1e-5)


def test_path_is_played_in_a_frame_that_began_before_it_came(tab):
    start = tab.page.evaluate(
        """() => {
            const { view } = viewer.look;
            const views = [view, { ...view, position: [9, 9, 9] }];
            viewer.path.play({ type: "play", fps: 0.1, views });
            viewer.path.playFrame(performance.now() - 50);
            return view.position;
        }"""
    )
    assert tab.page.evaluate("viewer.camera.position") == start


def test_film_of_a_path_is_saved(tab, tmp_path):
    av = pytest.importorskip("av")
    tab.open("Path")
    tab.press("Add this view")
    tab.drag()
    tab.settled()
    tab.press("Add this view")
    name, content = tab.saved("Save film (.mp4)")
    assert name == "blobs.mp4"
    with av.open(io.BytesIO(content)) as film:
        pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
    assert len(pictures) == 61
    assert pictures[0].shape == (720, 1280, 3)
    assert (abs(pictures[0].astype(int) - pictures[-1]).max(axis=2) > 20).mean() > 0.02


def test_camera_goes_to_one_of_the_file_and_back(tab):
    first = tab.settled()
    tab.open("Cameras of the file")
    tab.page.get_by_label("Camera", exact=True).select_option("from the side")
    tab.page.wait_for_timeout(900)
    aside = tab.settled()
    assert differ(first, aside) > 0.02
    tab.press("Show all")
    tab.page.wait_for_timeout(900)
    assert differ(first, tab.settled()) < 0.01


def test_a_box_is_drawn_dragged_and_saved_as_a_new_asset(browser, site, tmp_path):
    bundle = site.scene_view.scene.bundles[0]
    alone = Site(SceneView(bundle, device="cpu"), name="blob", port=0, edits_folder=tmp_path)
    try:
        with Tab(browser, alone.url) as tab:
            # The first view frames nearly all gaussians; the box of all gaussians is
            # larger.
            tab.settled()
            tab.page.mouse.move(300, 300)
            for _ in range(5):
                tab.page.mouse.wheel(0, 1500)
                tab.page.wait_for_timeout(300)
            before = tab.settled()
            tab.open("Crop")
            tab.press("Draw a box")
            tab.page.wait_for_function("() => viewer.crop.isOn")
            assert differ(before, tab.settled()) > 0.002
            # This face is on the left, because the panel covers the picture on the
            # right.
            face = "viewer.crop.inWorld(viewer.crop.middleOf({ axis: 0, end: 0 }))"
            place = f"viewer.overlay.projection.place({face})"
            handle = tab.page.evaluate(place)
            low, high = tab.page.evaluate("viewer.crop.box")
            target = [(low[0] + high[0]) / 2, *(np.add(low, high) / 2)[1:].tolist()]
            end = tab.page.evaluate(f"viewer.overlay.projection.place({target})")
            tab.drag(handle, end)
            dragged = tab.page.evaluate("viewer.crop.box")
            # The face is where the pointer released it, and no other face has moved.
            np.testing.assert_allclose(dragged[0][0], target[0], atol=0.02 * (high[0] - low[0]))
            assert dragged[1] == high
            assert dragged[0][1:] == low[1:]
            assert tab.page.evaluate("viewer.crop.text").startswith("box:")
            tab.page.get_by_label("Part").select_option("outside")
            tab.page.get_by_label("New file").fill("rest.ply")
            tab.press("Save as a new asset")
            tab.page.wait_for_function(
                "() => document.body.innerText.includes('rest.ply was written')"
            )
            whole = bundle.level_gaussians(0)
            expected = v3dg.crop_box(whole, *dragged, keep="outside")
            assert 0 < len(expected) < len(whole)
            written = v3dg.read_asset(tmp_path / "rest.ply")
            np.testing.assert_array_equal(written.means, expected.means)
            tab.page.locator("#overlay").focus()
            tab.page.keyboard.press("Escape")
            assert differ(before, tab.settled()) < 0.002
    finally:
        alone.close()
