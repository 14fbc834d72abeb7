"""The viewer with a pool: its pictures become those of the whole scene while pages
arrive; and what a viewer with a pool lacks."""

import math
import threading
import time
from dataclasses import replace

import numpy as np
import pytest

import v3dg.pool
from scenes_lod import blob, lod_bundle
from v3dg import Bundle, Renderer, Scene, _core, pick
from v3dg.pictures import to_8bit
from v3dg.pool import Pool
from v3dg.viewer.frame import SceneView, Settings
from v3dg.viewer.pacing import RenderLoop, Request
from v3dg.viewer.view import look_at

VIEW = look_at((0, -4, 1), (0, 0, 0), (0, 0, 1), 0.8, 1.5)
ASIDE = look_at((3, -2, 1), (0, 0, 0), (0, 0, 1), 0.8, 1.5)
SIZE = (120, 80)
SECONDS = 60


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    rng = np.random.default_rng(3)
    path = tmp_path_factory.mktemp("pool") / "blob.v3dg"
    lod_bundle(rng, blob(rng, 5000, sh_degree=1), 32).write(path)
    scene = Scene()
    scene.add(Bundle.open(path), positions=rng.normal(size=(4, 3)), scales=np.full(4, 0.4))
    return scene


@pytest.mark.parametrize("shows", ["appearance", "level", "cluster", "depth", "alpha"])
@pytest.mark.parametrize(
    "given", [{"tolerance": 1.0}, {"tolerance": 2.0, "fade": None}, {"budget": 3000}]
)
def test_a_picture_that_waits_is_that_of_all(scene, shows, given):
    whole = SceneView(scene, device="cpu", memory=None)
    pooled = SceneView(scene, device="cpu", memory="64MB")
    settings = Settings(shows=shows, **given)
    for view in (VIEW, ASIDE):
        expected = whole.frame(view, SIZE, settings)
        frame = pooled.frame(view, SIZE, settings, None, None, math.inf)
        np.testing.assert_array_equal(frame.pixels, expected.pixels)
        assert frame.figures.missing == expected.figures.missing == 0
        assert frame.figures.gaussians_selected == expected.figures.gaussians_selected
        assert (frame.value_range, frame.distance) == (expected.value_range, expected.distance)
    assert pooled.pool is not None
    assert whole.pool is None


def test_a_pool_is_taken_where_not_all_fits(scene, monkeypatch):
    again = Scene()
    again.add(Bundle.open(scene.bundles[0].path))
    assert SceneView(again, device="cpu").pool is None
    monkeypatch.setattr(v3dg.pool, "free_on", lambda _: 500_000)
    assert SceneView(again, device="cpu").pool.memory == 250_000


def test_residency_shows_what_is_missing_until_it_is_there(scene):
    pooled = SceneView(scene, device="cpu", memory="64MB")
    settings = Settings(shows="residency", tolerance=0.5, fade=None)
    first = pooled.frame(VIEW, SIZE, settings)
    assert first.figures.missing > 0
    settled = pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
    alpha = (
        pooled.frame(VIEW, SIZE, Settings(shows="alpha", tolerance=0.5, fade=None)).pixels[..., :1]
        / 255
    )
    there = to_8bit(_core.missing_colors(np.zeros(())) * alpha)
    np.testing.assert_allclose(settled.pixels.astype(int), there, atol=2)
    assert (first.pixels[..., 0] > first.pixels[..., 2] + 20).any()  # yellow or red


@pytest.mark.parametrize(
    "settings",
    [
        Settings(shows="difference", tolerance=4.0),
        Settings(shows="error"),
        Settings(shows="count", fade=None),
        Settings(split=0.4),
        Settings(split=1.0),
        Settings(split=0.4, shows="difference", budget=3000),
        Settings(frozen=ASIDE),
        Settings(frozen=ASIDE, shows="error", fade=None),
    ],
    ids=lambda s: f"{s.shows}-{s.split}-{'frozen' if s.frozen else 'free'}",
)
def test_what_is_compared_frozen_and_measured_is_that_of_all(scene, settings):
    whole = SceneView(scene, device="cpu", memory=None)
    pooled = SceneView(scene, device="cpu", memory="64MB")
    assert set(pooled.modes) == {*whole.modes, "residency"}
    assert pooled.shows_cuts
    expected = whole.frame(VIEW, SIZE, settings)
    frame = pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
    np.testing.assert_array_equal(frame.pixels, expected.pixels)
    np.testing.assert_array_equal(frame.figures.levels, expected.figures.levels)
    assert frame.figures.missing == 0
    assert frame.figures.tolerance == expected.figures.tolerance
    assert (frame.value_range, frame.distance) == (expected.value_range, expected.distance)
    if settings.frozen is not None:  # of another camera
        free = pooled.frame(VIEW, SIZE, replace(settings, frozen=None), None, None, math.inf)
        assert (free.pixels != frame.pixels).any()


@pytest.mark.gpu
@pytest.mark.parametrize("shows", ["appearance", "depth", "alpha"])
def test_on_cuda_a_pool_offers_what_its_frames_have(scene, shows):
    whole, pooled = (SceneView(scene, device="cuda", memory=memory) for memory in (None, "64MB"))
    assert pooled.modes == ("appearance", "depth", "alpha")
    assert whole.shows_cuts
    assert not pooled.shows_cuts
    for given in ({"tolerance": 1.0}, {"budget": 3000}):
        settings = Settings(shows=shows, **given)
        expected = whole.frame(VIEW, SIZE, settings)
        frame = pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
        np.testing.assert_allclose(frame.pixels.astype(int), expected.pixels.astype(int), atol=1)
        assert frame.figures.gaussians_selected == expected.figures.gaussians_selected
        assert (frame.figures.missing, len(frame.figures.levels)) == (0, 0)


def test_a_pool_without_room_for_all_compares_with_the_finest_that_it_has_room_for(scene):
    pooled = SceneView(scene, device="cpu", memory=1_000_000)
    coarse = Settings(shows="difference", tolerance=500.0, fade=None)
    frame = pooled.frame(VIEW, SIZE, coarse, None, None, math.inf)
    assert frame.figures.missing == 0
    assert frame.figures.tolerance == 500.0
    assert frame.pixels.any()
    finest = Settings(shows="difference", tolerance=0.0, fade=None)
    frame = pooled.frame(VIEW, SIZE, finest, None, None, math.inf)
    assert frame.figures.tolerance > 0  # there is not enough memory for all pages
    assert not frame.pixels.any()  # both have the same tolerance


def test_a_click_finds_what_is_resident(scene):
    whole = SceneView(scene, device="cpu", memory=None)
    pooled = SceneView(scene, device="cpu", memory="64MB")
    settings = Settings(tolerance=0.5, fade=None)
    places = [(x, y) for x in range(4, SIZE[0], 16) for y in range(4, SIZE[1], 16)]
    early = [pooled.pick(VIEW, SIZE, *place, settings) for place in places]  # the coarsest pages
    assert {pick.level for pick in early if pick is not None} == {pooled.num_levels - 1}
    pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
    bytes_in = pooled.pool.pool_frame.core.status().bytes_in
    found = [pooled.pick(VIEW, SIZE, *place, settings) for place in places]
    expected = [whole.pick(VIEW, SIZE, *place, settings) for place in places]
    assert pooled.pool.pool_frame.core.status().bytes_in == bytes_in
    assert len([pick for pick in found if pick is not None]) > 5
    for one, other in zip(found, expected, strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            assert (one.instance, one.cluster, one.level) == (
                other.instance,
                other.cluster,
                other.level,
            )
            assert (one.weight, one.depth) == (other.weight, other.depth)


def test_picks_of_a_renderer_without_a_pool_are_refused(scene):
    camera = VIEW.camera(*SIZE, 0.01)
    with pytest.raises(ValueError, match="renderer: expected a renderer with a pool on the CPU"):
        pick(scene, camera, 1, 1, renderer=Renderer(scene, device="cpu", memory=None))


def test_a_still_is_cut_once_and_a_settled_one_twice(scene, monkeypatch):
    """The first cut shows that no page is missing, and the second is drawn."""
    pooled, settings = SceneView(scene, device="cpu", memory="64MB"), Settings(tolerance=0.5)
    pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
    core, asks, selects = pooled.pool.pool_frame._pool, [], []
    asked = core.core

    class Counting:
        def __getattr__(self, name):
            if name == "settle_step":
                asks.append(name)
            return getattr(asked, name)

    settle = Pool.settle

    def counted(pool, *given):
        pool.core = Counting()
        try:
            settle(pool, *given)
        finally:
            pool.core = asked

    monkeypatch.setattr(Pool, "settle", counted)
    monkeypatch.setattr("v3dg.viewer.frame.select_by", lambda *given: selects.append(given))
    pooled.frame(VIEW, SIZE, settings)
    assert not asks
    pooled.frame(VIEW, SIZE, settings, None, None, math.inf)
    assert len(asks) == 1
    assert not selects


@pytest.fixture
def loop(scene):
    """Return a render loop with a pool, and what it sent: (frame, whether it is final,
    number)."""
    pooled = SceneView(scene, device="cpu", memory="64MB")
    sent = []
    is_done = threading.Event()
    errors = []

    def send(frame, number, *, is_final):
        sent.append((frame, is_final, number))
        if is_final:
            is_done.set()

    def fail(error):
        errors.append(error)
        is_done.set()

    loop = RenderLoop(pooled, send, fail)
    loop.sent = sent
    loop.is_final = is_done
    loop.errors = errors
    yield loop
    assert loop.close(SECONDS)


def test_pictures_follow_until_nothing_is_missing(scene, loop):
    settings = Settings(tolerance=0.5)
    for number, view in enumerate((VIEW, ASIDE)):
        loop.is_final.clear()
        loop.ask(Request(view, SIZE, settings, number))
        assert loop.is_final.wait(SECONDS)
        frame, _, of = loop.sent[-1]
        assert of == number
        assert frame.size == SIZE
        assert frame.figures.missing == 0
        expected = SceneView(scene, device="cpu", memory=None).frame(view, SIZE, settings)
        np.testing.assert_array_equal(frame.pixels, expected.pixels)
        time.sleep(0.3)  # time in which nothing remains to be drawn
    assert [final for _, final, _ in loop.sent].count(True) == 2
    assert not loop.errors


def test_pictures_are_sent_while_pages_come_in(loop, monkeypatch):
    """One page arrives at a time, from a slow disk."""
    pool = loop._scene_view.pool.pool_frame
    real, calls = pool.settle, []

    def settle(*given, seconds, **options):
        calls.append(seconds)
        real(*given, seconds=0.0, **options)

    monkeypatch.setattr(pool, "settle", settle)
    loop.ask(Request(VIEW, SIZE, Settings(tolerance=0.5)))
    assert loop.is_final.wait(SECONDS)
    assert not loop.errors
    missing = [frame.figures.missing for frame, _, _ in loop.sent]
    assert missing[0] > 0
    assert missing[-1] == 0
    assert set(calls) == {0.1}


def test_damage_is_told_and_the_draft_stays(tmp_path):
    rng = np.random.default_rng(3)
    path = tmp_path / "blob.v3dg"
    lod_bundle(rng, blob(rng, 3000), 32).write(path)
    bundle = Bundle.open(path)
    with open(path, "r+b") as file:
        file.seek(int(bundle._file.places[0]) + 5)
        file.write(b"\x00\xff\x00\xff")
    pooled, sent, told = SceneView(bundle, device="cpu", memory="64MB"), [], threading.Event()
    errors = []
    loop = RenderLoop(
        pooled,
        lambda frame, _, *, is_final: sent.append((frame, is_final)),
        lambda error: (errors.append(error), told.set()),
    )
    try:
        loop.ask(Request(VIEW, SIZE, Settings(tolerance=0.0)))
        assert told.wait(SECONDS)
    finally:
        assert loop.close(SECONDS)
    assert "page 0: the hash does not match" in pooled.explain(errors[0])
    assert "/" not in pooled.explain(errors[0])
    assert sent
    assert not any(is_final for _, is_final in sent)
