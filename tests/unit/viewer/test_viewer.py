"""The viewer without a browser. test_viewer_tab.py and test_viewer_browser.py open it
in one."""

import contextlib
import math
import threading
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import scenes_lod
import v3dg
from v3dg import DEFAULT_FADE, Camera, Gaussians, Scene, _core
from v3dg.pictures import to_8bit
from v3dg.viewer.frame import MOST_COUNTED, Frame, SceneView, Settings, Stopped
from v3dg.viewer.pacing import PATIENCE_SECONDS, Draft, Pacer, RenderLoop, Request, finer_sizes
from v3dg.viewer.path import CameraPath
from v3dg.viewer.view import View, look_at

SIZE = (96, 64)
SECONDS = 20  # a time that nothing here needs


# Views.


def test_view_takes_over_a_camera_and_gives_it_back():
    rng = np.random.default_rng(0)
    for _ in range(50):
        camera = scenes_lod.random_camera(rng)
        again = View.of_camera(camera).camera(camera.width, camera.height, camera.near)
        np.testing.assert_allclose(again.viewmat, camera.viewmat, atol=1e-12)
        np.testing.assert_allclose(again.K, camera.K, rtol=1e-12)


@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1), (1, -2, 2)])
def test_view_takes_over_half_turns(axis):
    axis = np.array(axis) / np.linalg.norm(axis)
    viewmat = np.eye(4)
    viewmat[:3, :3] = 2 * np.outer(axis, axis) - np.eye(3)
    camera = Camera(viewmat, [[50, 0, 32], [0, 50, 24], [0, 0, 1]], 64, 48)
    again = View.of_camera(camera).camera(64, 48, 0.01)
    np.testing.assert_allclose(again.viewmat, viewmat, atol=1e-12)


def test_view_shows_the_same_at_any_size():
    view = look_at((1, -4, 2), (0, 0, 0), (0, 0, 1), 0.8, 1.5)
    small, large = view.camera(61, 40, 0.01), view.camera(610, 401, 0.01)
    np.testing.assert_allclose(small.K[:2] / [[61], [40]], large.K[:2] / [[610], [401]])
    assert 2 * math.atan(large.height / 2 / large.fy) == pytest.approx(0.8)
    assert large.width / large.fx / (large.height / large.fy) == pytest.approx(1.5)


# Frames.


def stack(opacities):
    """Return round gaussians one behind the other on the axis of `AXIS`."""
    count = len(opacities)
    means = np.zeros((count, 3), np.float32)
    means[:, 1] = np.arange(count) * 0.01
    return Gaussians(
        means=means,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        scales=np.full((count, 3), 0.2, np.float32),
        opacities=np.asarray(opacities, np.float32),
        sh=np.ones((count, 1, 3), np.float32),
    )


AXIS = look_at((0, -3, 0), (0, 0, 0), (0, 0, 1), 0.8, 1.5)


@pytest.fixture(scope="module")
def crowd():
    rng = np.random.default_rng(3)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 600, size=0.3), 32)
    scene = Scene()
    scene.add(bundle, positions=rng.normal(size=(40, 3)), quaternions=rng.normal(size=(40, 4)))
    return scene


@pytest.fixture(scope="module")
def view():
    return look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.7, 1.5)


@pytest.fixture
def scene_view(crowd, device):
    return SceneView(crowd, device=device)


def drawn(scene_view, view, device, **options):
    """Return the picture of `v3dg.render` and its statistics."""
    image = v3dg.render(
        scene_view.scene, view.camera(*SIZE, scene_view.near), device=device, **options
    )
    color = image.color if device == "cpu" else image.color.cpu().numpy()
    return to_8bit(color), image.stats


@pytest.mark.parametrize("shows", ["appearance", "level", "cluster"])
@pytest.mark.parametrize("fade", [None, DEFAULT_FADE])
def test_frame_is_the_picture_of_render(scene_view, view, device, shows, fade):
    frame = scene_view.frame(view, SIZE, Settings(shows=shows, tolerance=20.0, fade=fade))
    picture, stats = drawn(scene_view, view, device, tolerance=20.0, color_by=shows, fade=fade)
    np.testing.assert_array_equal(frame.pixels, picture)
    assert frame.figures.gaussians_selected == stats.gaussians_selected
    assert frame.figures.gaussians_in_frustum == stats.gaussians_in_frustum
    assert frame.size == SIZE


def test_figures_count_gaussians_by_level(scene_view, view):
    figures = scene_view.frame(view, SIZE, Settings(tolerance=20.0)).figures
    assert sum(figures.levels) == figures.gaussians_selected
    assert np.count_nonzero(figures.levels) > 2
    finest = scene_view.frame(view, SIZE, Settings(tolerance=0.0)).figures
    assert finest.levels[0] == finest.gaussians_selected > figures.gaussians_selected
    coarse = scene_view.frame(view, SIZE, Settings(tolerance=0.0, min_level=2)).figures
    assert coarse.levels[:2] == (0, 0)
    assert coarse.levels[2] == coarse.gaussians_selected


def test_budget_is_kept_and_one_too_small_is_an_error(scene_view, view):
    budget = 3000
    figures = scene_view.frame(view, SIZE, Settings(tolerance=0.0, budget=budget)).figures
    assert 0 < figures.gaussians_selected <= budget
    assert figures.tolerance > 0
    with pytest.raises(ValueError, match="budget: expected at least"):
        scene_view.frame(view, SIZE, Settings(tolerance=0.0, budget=1))


def test_alpha_and_depth_are_shown(scene_view, view, device):
    camera = view.camera(*SIZE, scene_view.near)
    options = {"tolerance": 0.0, "fade": DEFAULT_FADE, "depth": True}
    image = v3dg.render(scene_view.scene, camera, **options, device=device)
    alpha, depth = (
        np.asarray(p if device == "cpu" else p.cpu()) for p in (image.alpha, image.depth)
    )
    shown = scene_view.frame(view, SIZE, Settings(shows="alpha", tolerance=0.0))
    np.testing.assert_array_equal(shown.pixels, np.repeat(to_8bit(alpha)[..., None], 3, axis=2))
    shown = scene_view.frame(view, SIZE, Settings(shows="depth", tolerance=0.0))
    far, near = shown.value_range
    inside = (alpha > 0.99) & (depth > near) & (depth < far)
    assert inside.sum() > 100
    brightness = shown.pixels.astype(float).sum(axis=2)[inside]
    assert (np.diff(brightness[np.argsort(depth[inside])]) < 30).all()
    assert brightness[np.argmin(depth[inside])] > brightness[np.argmax(depth[inside])] + 100
    assert (shown.pixels[alpha == 0] == 0).all()


def test_an_empty_picture_is_black_in_every_mode(scene_view):
    away = look_at((0, -60, 0), (0, -70, 0), (0, 0, 1), 0.5, 1.5)
    for shows in ("appearance", "level", "depth", "alpha", "count", "error", "difference"):
        frame = scene_view.frame(away, SIZE, Settings(shows=shows, split=0.0))
        assert not frame.pixels.any()
        assert frame.figures.gaussians_in_frustum == 0


@pytest.mark.parametrize(
    ("opacities", "count"),
    [([0.1] * 5, 5), ([0.1] * 40, 40), ([1.0, 0.999, 0.5, 0.5], 2), ([0.91] * 8, 4)],
)
def test_count_is_of_the_gaussians_that_a_pixel_is_blended_of(opacities, count):
    """At the default tolerance, gaussians behind the one that reduces the transmittance
    to 1e-4 or less are not blended."""
    scene_view = SceneView(stack(opacities), device="cpu")
    camera = AXIS.camera(33, 33, 0.01)
    cut = v3dg.select(scene_view.scene, camera, device="cpu")
    window = (0, 0, 33, 33)
    planes = scene_view._draw_on_cpu(cut, camera, window, "count", None)
    counts = planes.depth
    assert counts[16, 16] == count
    assert planes.gaussians_in_frustum == len(opacities)
    alpha = v3dg.render(scene_view.scene, camera, device="cpu").alpha
    np.testing.assert_array_equal(counts > 0, alpha > 0)


def test_count_is_shown_on_a_scale_of_octaves(device):
    pixels = {}
    for number in (2, 16):
        frame = SceneView(stack([0.01] * number), device=device).frame(
            AXIS, (33, 33), Settings(shows="count")
        )
        pixels[number] = frame.pixels[16, 16]
        assert frame.value_range == (1.0, MOST_COUNTED)
    for number, pixel in pixels.items():
        np.testing.assert_array_equal(pixel, to_8bit(_core.ramp(np.array(math.log2(number) / 8))))


@pytest.mark.parametrize("share", [0.25, 0.5, 1.0])
def test_error_is_the_share_of_the_tolerance_that_is_used(share, device):
    """Each instance has its own value; it has none where its finest level is drawn."""
    rng = np.random.default_rng(0)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 600, size=0.3), 64)
    scene = Scene()
    scene.add(bundle, positions=[[-2, 0, 0], [3, 8, 0]])
    scene_view, size = SceneView(scene, device=device), (120, 60)
    view = look_at((0, -12, 0), (0, 0, 0), (0, 0, 1), 0.6, 2.0)
    near, far = (
        metrics.max() for metrics in scenes_lod.group_metrics(scene, view.camera(*size, 0.01))
    )
    assert far < 0.5 * near
    frame = scene_view.frame(
        view, size, Settings(shows="error", tolerance=float(near) / share, fade=None)
    )
    assert frame.value_range == (0.0, pytest.approx(near / share))
    camera = view.camera(*size, 0.01)
    alpha = v3dg.render(scene, camera, tolerance=float(near) / share, device="cpu").alpha[..., None]
    for half, metric in ((slice(0, 60), near), (slice(60, 120), far)):
        wanted = to_8bit(_core.ramp(np.array(share * metric / near)) * alpha[:, half])
        assert wanted.max() > 20
        np.testing.assert_allclose(frame.pixels[:, half].astype(int), wanted, atol=2)
    finest = scene_view.frame(view, size, Settings(shows="error", tolerance=0.0, fade=None)).pixels
    alpha = v3dg.render(scene, camera, tolerance=0.0, device="cpu").alpha[..., None]
    np.testing.assert_allclose(
        finest.astype(int), to_8bit(_core.ramp(np.array(0.0)) * alpha), atol=2
    )


def test_difference_is_to_all_gaussians_and_amplified(scene_view, view):
    none = scene_view.frame(view, SIZE, Settings(shows="difference", tolerance=0.0, fade=None))
    assert not none.pixels.any()
    one, ten = (
        scene_view.frame(
            view, SIZE, Settings(shows="difference", tolerance=20.0, gain=gain)
        ).pixels.astype(int)
        for gain in (1, 10)
    )
    assert one.max() > 10
    assert abs(np.minimum(10 * one, 255) - ten).max() <= 5


def test_split_shows_all_gaussians_on_the_left(scene_view, view, device):
    settings = Settings(tolerance=20.0, split=0.25)
    pixels = scene_view.frame(view, SIZE, settings).pixels
    fine, _ = drawn(scene_view, view, device, tolerance=0.0)
    coarse, _ = drawn(scene_view, view, device, tolerance=20.0, fade=DEFAULT_FADE)
    np.testing.assert_array_equal(pixels[:, :23], fine[:, :23])
    np.testing.assert_array_equal(pixels[:, 25:], coarse[:, 25:])
    assert (pixels[:, 23:25] == 255).all()
    assert not np.array_equal(fine[:, :23], coarse[:, :23])
    np.testing.assert_array_equal(
        scene_view.frame(view, SIZE, replace(settings, split=1.0)).pixels[:, :-1], fine[:, :-1]
    )


def test_frozen_cut_stays_while_the_camera_moves(scene_view, view):
    far = look_at((0, -30, 1), (0, 0, 0), (0, 0, 1), 0.7, 1.5)
    there = scene_view.frame(far, SIZE, Settings())
    here = scene_view.frame(view, SIZE, Settings())
    frozen = scene_view.frame(view, SIZE, Settings(frozen=far))
    np.testing.assert_array_equal(frozen.figures.levels, there.figures.levels)
    assert frozen.figures.gaussians_selected < here.figures.gaussians_selected
    assert not np.array_equal(frozen.pixels, here.pixels)
    assert not np.array_equal(frozen.pixels, there.pixels)


def test_asset_is_drawn_whole_and_has_one_level(view):
    asset = scenes_lod.blob(np.random.default_rng(1), 500)
    scene_view = SceneView(asset, device="cpu")
    assert scene_view.num_levels == 1
    assert scene_view.num_gaussians == 500
    for fade, filter_px2 in ((None, 0.0), (DEFAULT_FADE, 0.05)):
        frame = scene_view.frame(view, SIZE, Settings(fade=fade))
        camera = view.camera(*SIZE, scene_view.near)
        how = {"filter_px2": filter_px2, "antialiased": True}
        whole = to_8bit(v3dg.rasterize(asset, camera, **how).color)
        assert abs(frame.pixels.astype(int) - whole).max() <= 1
        assert whole.any()


def test_scene_of_nothing_is_drawn():
    frame = SceneView(Scene(), device="cpu").frame(AXIS, SIZE, Settings())
    assert not frame.pixels.any()


def test_a_picture_that_is_stopped_is_given_up(crowd, view):
    scene_view, stop = SceneView(crowd, device="cpu"), _core.Stop()
    stop.request()
    for shows in ("appearance", "count", "error", "difference"):
        with pytest.raises(Stopped):
            scene_view.frame(view, SIZE, Settings(shows=shows), stop)


def test_a_stop_ends_a_long_picture_early():
    rng = np.random.default_rng(5)
    scene = Scene()
    scene.add(
        scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 4000, size=0.2), 256),
        positions=rng.normal(size=(2000, 3)),
    )
    scene_view, settings = SceneView(scene, device="cpu"), Settings(tolerance=0.0)
    view = look_at((0, -9, 0), (0, 0, 0), (0, 0, 1), 0.7, 1.5)
    start = time.monotonic()
    undisturbed = scene_view.frame(view, (800, 600), settings).pixels
    whole = time.monotonic() - start
    in_bands = scene_view.frame(view, (800, 600), settings, _core.Stop()).pixels
    np.testing.assert_array_equal(in_bands, undisturbed)
    shortest = whole
    for part in range(4, 14):  # the machine may be busy at times
        stop = _core.Stop()
        timer = threading.Timer(whole / part, stop.request)
        start = time.monotonic()
        timer.start()
        with contextlib.suppress(Stopped):
            scene_view.frame(view, (800, 600), settings, stop)
            continue
        shortest = min(shortest, time.monotonic() - start)
    assert shortest < 0.6 * whole


# Pacing.


def paced(milliseconds, full=(1920, 1080), pictures=60):
    """Return the drafts that a pacer chooses if one takes this long."""
    pacer, drafts = Pacer(60.0), []
    for _ in range(pictures):
        drafts.append(pacer.draft(full))
        pacer.drew(drafts[-1], milliseconds(drafts[-1]))
    return drafts


def test_pacer_finds_the_largest_picture_in_time_and_stays_there():
    def cost(draft):
        return 10 + draft.size[0] * draft.size[1] / 4000

    drafts = paced(cost)
    assert len(set(drafts[30:])) == 1
    width, height = drafts[-1].size
    assert drafts[-1].coarser == 1
    assert width / height == pytest.approx(16 / 9, rel=0.02)
    assert 0.5 * 60 < cost(drafts[-1]) <= 60


def test_pacer_takes_a_coarser_cut_where_the_smallest_picture_is_too_slow():
    def cost(draft):
        return 9 + 400 / draft.coarser

    drafts = paced(cost)
    assert len(set(drafts[30:])) == 1
    assert drafts[-1].size == (480, 270)
    assert 0.5 * 60 < cost(drafts[-1]) <= 60


def test_pacer_keeps_to_its_limits():
    assert paced(lambda draft: 1.0)[-1] == Draft((1920, 1080))
    assert paced(lambda draft: 1e4)[-1] == Draft((480, 270), 64.0)


def test_pacer_gives_way_at_once_and_takes_back_slowly():
    pacer, full = Pacer(60.0), (1600, 800)
    pacer.drew(Draft(full), 60.0)
    assert pacer.draft(full) == Draft(full)
    pacer.drew(Draft(full), 240.0)
    assert pacer.draft(full) == Draft((800, 400))
    pacer.drew(Draft((800, 400)), 15.0)
    assert 800 < pacer.draft(full).size[0] < 1600


def test_the_first_picture_after_a_rest_has_half_the_work():
    pacer, full = Pacer(60.0), (1920, 1080)
    for _ in range(60):
        draft = pacer.draft(full)
        pacer.drew(draft, 40 * math.prod(draft.size) / (960 * 540))
    pacer.rested()
    assert math.prod(pacer.draft(full).size) == pytest.approx(math.prod(draft.size) / 2, rel=0.02)


def test_sizes_double_up_to_the_full_one():
    assert finer_sizes((100, 50), (800, 400)) == [(200, 100), (400, 200), (800, 400)]
    assert finer_sizes((300, 150), (800, 400)) == [(800, 400)]
    assert finer_sizes((800, 400), (800, 400)) == []


# The render loop.


class FakeSceneView:
    """Records what is drawn. Pictures with widths in `hold` wait for a stop, up to a
    tolerance."""

    draws_all_while_moving, pool = False, None

    def __init__(self):
        self.drawn, self.hold, self.held_until = [], (), math.inf
        self.tolerances, self.steps = iter(()), []  # the tolerance of the budget
        self.is_held = threading.Event()

    def frame(self, view, size, settings, stop, steps):
        self.drawn.append((view, size, settings))
        self.steps.append(steps)
        if isinstance(view, Exception):
            raise view
        is_held = size[0] in self.hold and settings.tolerance <= self.held_until
        while stop.is_requested or (is_held and size[0] in self.hold):
            self.is_held.set()
            if stop.is_requested:
                raise Stopped
            time.sleep(1e-3)
        figures = SimpleNamespace(tolerance=next(self.tolerances, 1.0))
        return Frame(
            np.full((size[1], size[0], 3), view, np.uint8), figures, settings.shows, None, None
        )


class NoPacer:
    """Always has time for everything."""

    def draft(self, full):
        return Draft(full)

    def drew(self, draft, milliseconds):
        pass

    def rested(self):
        pass


@pytest.fixture
def rendering(request):
    """Return a render loop, its view, and what it sent: (view, size, whether the
    picture is final)."""
    scene_view = FakeSceneView()
    sent = []
    errors = []
    is_done = threading.Event()

    def send(frame, number, *, is_final):
        sent.append((frame.pixels[0, 0, 0], frame.size, is_final))
        if is_final:
            is_done.set()

    def fail(error):
        errors.append(error)
        is_done.set()

    loop = RenderLoop(scene_view, send, fail, getattr(request, "param", None))
    yield SimpleNamespace(
        loop=loop, scene_view=scene_view, sent=sent, errors=errors, is_final=is_done
    )
    assert loop.close(SECONDS)


def wait(event):
    assert event.wait(SECONDS)
    event.clear()


def test_a_request_is_answered_small_and_then_in_full(rendering):
    rendering.loop.ask(Request(7, (160, 80), Settings()))
    wait(rendering.is_final)
    assert rendering.sent == [(7, (40, 20), False), (7, (80, 40), False), (7, (160, 80), True)]


@pytest.mark.parametrize("rendering", [NoPacer()], indirect=True)
@pytest.mark.parametrize(("budget", "sent"), [(None, 1), (100, 4)])
def test_at_rest_pictures_follow_until_the_tolerance_of_a_budget_has_arrived(
    rendering, budget, sent
):
    rendering.scene_view.draws_all_while_moving = True
    rendering.scene_view.tolerances = iter((4.0, 3.0, 2.0, 2.0))
    rendering.loop.ask(Request(7, (160, 80), Settings(budget=budget)))
    end = time.monotonic() + SECONDS
    while len(rendering.sent) < sent and time.monotonic() < end:
        time.sleep(0.01)
    time.sleep(0.3)
    assert rendering.sent == sent * [(7, (160, 80), True)]
    assert len(set(map(id, rendering.scene_view.steps))) == 1
    assert rendering.scene_view.steps[0] is not None


def test_larger_pictures_do_not_follow_smaller_ones(rendering):
    rendering.loop.ask(Request(7, (160, 80), Settings(budget=100)))
    wait(rendering.is_final)
    first, *others = rendering.scene_view.steps
    assert first is not None
    assert others == [None, None]


def test_a_new_request_ends_a_large_picture(rendering):
    rendering.scene_view.hold = (80, 160)
    rendering.loop.ask(Request(1, (160, 80), Settings()))
    wait(rendering.scene_view.is_held)
    rendering.scene_view.hold = ()
    rendering.loop.ask(Request(2, (160, 80), Settings()))
    wait(rendering.is_final)
    assert (1, (160, 80), True) not in rendering.sent
    assert rendering.sent[-1] == (2, (160, 80), True)


def test_a_larger_picture_that_is_late_is_not_sent(rendering):
    draw = rendering.scene_view.frame

    def frame(view, size, *rest):
        picture = draw(view, size, *rest)
        if (view, size) == (1, (80, 40)):  # a new picture is requested when it is nearly finished
            rendering.loop.ask(Request(2, (160, 80), Settings()))
        return picture

    rendering.scene_view.frame = frame
    rendering.loop.ask(Request(1, (160, 80), Settings()))
    wait(rendering.is_final)
    assert rendering.sent[0] == (1, (40, 20), False)
    assert (1, (80, 40), False) not in rendering.sent
    assert rendering.sent[-1] == (2, (160, 80), True)


def test_of_many_requests_the_last_is_drawn(rendering):
    for view in range(200):
        rendering.loop.ask(Request(view, (160, 80), Settings()))
    wait(rendering.is_final)
    assert rendering.sent[-1] == (199, (160, 80), True)
    assert len(rendering.sent) < 200


def test_a_comparison_of_too_many_gaussians_waits_for_the_rest(rendering):
    settings = Settings(shows="difference", split=0.5, tolerance=0.0)
    rendering.loop.ask(Request(3, (160, 80), settings))
    wait(rendering.is_final)
    first, *others = rendering.scene_view.drawn
    assert (first[2].shows, first[2].split) == ("appearance", 0.0)
    assert first[2].tolerance > 0
    assert all(other[2] == settings for other in others)


def test_few_gaussians_are_compared_while_moving(rendering):
    settings = Settings(shows="difference", tolerance=0.0)
    rendering.scene_view.draws_all_while_moving = True
    rendering.loop.ask(Request(3, (160, 80), settings))
    wait(rendering.is_final)
    assert all(drawn[2] == settings for drawn in rendering.scene_view.drawn)


@pytest.mark.parametrize("rendering", [NoPacer()], indirect=True)
def test_a_coarser_cut_is_replaced_at_rest_though_the_size_is_the_same(rendering):
    settings = Settings(tolerance=0.5)
    rendering.loop.ask(Request(1, (16, 8), settings))
    wait(rendering.is_final)
    coarser = replace(settings, tolerance=v3dg.DEFAULT_TOLERANCE)
    assert rendering.scene_view.drawn == [(1, (16, 8), coarser), (1, (16, 8), settings)]
    assert [final for *_, final in rendering.sent] == [False, True]


@pytest.mark.parametrize("rendering", [NoPacer()], indirect=True)
def test_what_is_drawn_in_full_at_once_is_not_drawn_again(rendering):
    rendering.loop.ask(Request(1, (16, 8), Settings()))
    wait(rendering.is_final)
    rendering.loop.ask(Request(2, (16, 8), Settings()))
    wait(rendering.is_final)
    assert rendering.sent == [(1, (16, 8), True), (2, (16, 8), True)]


def test_an_error_is_told_and_the_next_request_is_drawn(rendering):
    rendering.loop.ask(Request(ValueError("no such cut"), (160, 80), Settings()))
    wait(rendering.is_final)
    assert [str(error) for error in rendering.errors] == ["no such cut"]
    rendering.loop.ask(Request(5, (160, 80), Settings()))
    wait(rendering.is_final)
    assert rendering.sent[-1] == (5, (160, 80), True)


def test_a_draft_that_takes_too_long_is_given_up_for_a_newer_request(rendering):
    rendering.scene_view.hold, rendering.scene_view.held_until = (40,), Settings().tolerance
    rendering.loop.ask(Request(1, (160, 80), Settings()))
    wait(rendering.scene_view.is_held)
    rendering.loop.ask(Request(2, (160, 80), Settings()))
    assert len(rendering.scene_view.drawn) == 1  # this may take a short time
    time.sleep(PATIENCE_SECONDS)
    rendering.loop.ask(Request(3, (160, 80), Settings()))
    wait(rendering.is_final)
    (_, _, first), (view, _, second), *_ = rendering.scene_view.drawn
    assert view == 3
    assert second.tolerance > first.tolerance
    assert rendering.sent[-1] == (3, (160, 80), True)


def test_the_least_draft_is_finished_so_that_something_is_seen(rendering):
    rendering.scene_view.hold = tuple(range(1, 200))
    for view in range(60):
        rendering.loop.ask(Request(view, (160, 80), Settings()))
        time.sleep(PATIENCE_SECONDS / 4)
    widths = [size[0] for _, size, _ in rendering.scene_view.drawn]
    assert widths[-1] == round(160 / 4)
    assert len(widths) < 12  # the last picture is not abandoned
    rendering.scene_view.hold = ()
    wait(rendering.is_final)
    assert len(rendering.sent) > 1


@pytest.mark.parametrize("failing", ["frame", "send", "fail"])
def test_no_error_ends_the_loop(rendering, failing):
    def broken(*_):
        raise MemoryError("no more")

    if failing == "frame":
        rendering.loop.ask(Request(MemoryError(), (160, 80), Settings()))
        wait(rendering.is_final)
    else:
        working = rendering.loop._send, rendering.loop._fail
        rendering.loop._send = broken
        rendering.loop._fail = broken if failing == "fail" else working[1]
        rendering.loop.ask(Request(4, (160, 80), Settings()))
        time.sleep(0.2)
        rendering.loop._send, rendering.loop._fail = working
    rendering.loop.ask(Request(5, (160, 80), Settings()))
    wait(rendering.is_final)
    while not rendering.sent:
        wait(rendering.is_final)
    assert rendering.sent[-1] == (5, (160, 80), True)


def test_closing_ends_the_thread_in_the_middle_of_a_picture(rendering):
    rendering.scene_view.hold = (80, 160)
    rendering.loop.ask(Request(1, (160, 80), Settings()))
    wait(rendering.scene_view.is_held)
    assert rendering.loop.close(SECONDS)
    assert not any(thread.name == "v3dg render loop" for thread in threading.enumerate())


# Paths.


def path_of(views, seconds=1.0):
    return CameraPath([(seconds, view) for view in views])


def view_at(path, seconds):
    return path.views_at(np.array([seconds]))[0]


def turned(angle, sign=1.0):
    return View(
        (sign * math.cos(angle / 2), 0.0, 0.0, sign * math.sin(angle / 2)),
        (angle, 2.0, 3.0),
        0.7,
        1.5,
    )


def test_path_goes_through_its_views():
    views = [
        look_at((math.cos(a), math.sin(2 * a), a), (0, 0, 0), (0, 0, 1), 0.7 + a / 9, 1.5)
        for a in (0, 1, 2)
    ]
    path = path_of(views, 2.0)
    assert path.times.tolist() == [0.0, 2.0, 4.0]
    for place, view in enumerate(views):
        at = view_at(path, 2.0 * place)
        np.testing.assert_allclose(at.position, view.position, atol=1e-12)
        np.testing.assert_allclose(abs(np.dot(at.wxyz, view.wxyz)), 1, atol=1e-12)
        assert at.fov_y == pytest.approx(view.fov_y)
    assert view_at(path, -1.0).position == pytest.approx(views[0].position)
    assert view_at(path, 9.0).position == pytest.approx(views[-1].position)


def test_path_does_not_care_for_a_quaternions_sign():
    plain, flipped = (
        path_of([turned(0.1), turned(0.5, sign), turned(0.9)]) for sign in (1.0, -1.0)
    )
    for t in np.linspace(0, 2, 9):
        assert abs(np.dot(view_at(plain, t).wxyz, view_at(flipped, t).wxyz)) == pytest.approx(1)


def test_straight_path_at_one_speed_stays_so():
    path = path_of([turned(0.2 * i) for i in range(5)])
    for t in np.linspace(0, 4, 17):
        np.testing.assert_allclose(view_at(path, t).position, (0.2 * t, 2, 3), atol=1e-12)


def test_path_is_smooth_where_times_are_uneven():
    angles = ((1.0, 0.0), (0.5, 0.3), (2.0, 1.0), (1.0, 0.2))
    path = CameraPath([(seconds, turned(angle)) for seconds, angle in angles])
    hair = 1e-5
    for joint in path.times[1:-1]:
        before, at, after = (
            np.array(view_at(path, joint + shift).position) for shift in (-hair, 0, hair)
        )
        np.testing.assert_allclose((at - before) / hair, (after - at) / hair, atol=1e-3)


def test_path_becomes_cameras():
    path = path_of([turned(0.0), turned(1.0)])
    cameras = path.cameras(10, 64, 48, 0.01)
    assert list(cameras) == [f"{i:02}" for i in range(11)]
    np.testing.assert_allclose(cameras["10"].position, (1, 2, 3))
    assert len(path_of([turned(0.0)]).cameras(10, 64, 48, 0.01)) == 2


def test_path_through_views_has_an_even_pace():
    views = [turned(angle) for angle in (0.0, 0.1, 0.5, 0.6, 1.4)]
    path = CameraPath.through(views, 7.0)
    np.testing.assert_allclose(path.times, [0.0, 0.5, 2.5, 3.0, 7.0])
    resting = CameraPath.through([views[1]] * 3, 2.0)
    np.testing.assert_allclose(resting.times, [0.0, 1.0, 2.0])
    assert view_at(resting, 0.7).position == pytest.approx(views[1].position)
    paused = CameraPath.through([views[0], views[0], views[4]], 1.0)
    assert 0 < paused.times[1] < 0.01


def test_empty_path_is_an_error():
    with pytest.raises(ValueError, match="path: expected at least one view"):
        view_at(CameraPath(), 0.0)
