"""Pools: pictures of scenes of which only a part is in memory, both settled and while
pages arrive, and with faulty files."""

import itertools
import os
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress

import numpy as np
import pytest

import v3dg.pool
from benchmarks.evaluation.steadiness import tile_means
from devices import host
from frames import Renderer, arrays, render
from partial import rule
from random_bundle import random_bundle
from scenes_lod import blob, lod_bundle
from v3dg import Bundle, Camera, Scene, pick
from v3dg._device import CPU
from v3dg.render import CutRequest
from v3dg.residency import residency

CAMERA = Camera.look_at((0, -9, 1), (0, 0, 0), (0, 0, 1), 0.9, width=93, height=61)
NEAR = Camera.look_at((2, -2, 1), (0, 0, 0), (0, 0, 1), 0.7, width=93, height=61)
AWAY = Camera.look_at((0, -9, 1), (0, -20, 0), (0, 0, 1), 0.9, width=93, height=61)
FINE = {"tolerance": 0.5}


@pytest.fixture
def asset():
    """An asset of SH degree 1 with about 250 pages."""
    rng = np.random.default_rng(0)
    return lod_bundle(rng, blob(rng, 5000, sh_degree=1), 32)


@pytest.fixture
def path(asset, tmp_path):
    asset.write(tmp_path / "asset.v3dg")
    return tmp_path / "asset.v3dg"


@pytest.fixture(params=["mixed", "coded"])
def scene(request, asset, path):
    """Return a scene of instances of files with different SH degrees.

    If the parameter is "coded", all files store codes. Otherwise, they store rows, and
    a bundle in memory is added.
    """
    rng, scene = np.random.default_rng(1), Scene()
    is_coded = request.param == "coded"
    many = coded(asset, path.with_name("many.v3dg")) if is_coded else Bundle.open(path)
    scene.add(many, positions=2 * rng.normal(size=(3, 3)), quaternions=rng.normal(size=(3, 4)))
    few = lod_bundle(rng, blob(rng, 2000), 32)
    few = coded(few, path.with_name("few.v3dg")) if is_coded else few
    scene.add(few, positions=(1.0, 0, 0), importance=2)
    rough = lod_bundle(rng, blob(rng, 1500, sh_degree=3 if is_coded else 2), 32)
    scene.add(coded(rough, path.with_name("rough.v3dg")), positions=(-1.0, 0, 0.5))
    return scene


def coded(bundle, path):
    """Return the bundle as a file of codes."""
    Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec="quantized").write(path)
    return Bundle.open(path)


def scaled(scene, memory):
    """Return the size of a pool that holds about as many gaussians of this scene as a
    pool of the size `memory` holds rows."""
    return (
        memory if any(bundle.codec == "float32" for bundle in scene.bundles) else int(0.3 * memory)
    )


def status(renderer):
    return renderer.pool_frame.core.status()


def assert_same(image, expected):
    for one, other in zip(arrays(image), arrays(expected), strict=True):
        np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize(
    "options",
    [
        {"tolerance": 0.0},
        FINE,
        {"tolerance": 20.0},
        {"budget": 4000},
        {"tolerance": 0.1, "min_level": 2},
        {"tolerance": 20.0, "fade": 1.05},
        {"budget": 4000, "fade": 1.5},
    ],
)
def test_settled_picture_is_that_of_all_pages(scene, device, options):
    renderer, whole = Renderer(scene, device=device, memory="64MB"), Renderer(scene, device=device)
    for camera in (CAMERA, NEAR, AWAY, CAMERA):
        renderer.settle(camera, **options)
        image = renderer.render(camera, **options)
        assert image.stats.missing == image.stats.failed == 0
        assert_same(image, whole.render(camera, **options))


@pytest.mark.parametrize("memory", ["64MB", 500_000])
def test_stills_are_settled(scene, device, memory):
    """This also holds if pages of other views are resident at the beginning."""
    cameras = [CAMERA, NEAR, AWAY]
    if memory != "64MB":
        memory = scaled(scene, memory)
    pictures = render(scene, cameras, device=device, memory=memory, **FINE)
    for camera, picture in zip(cameras, pictures, strict=True):
        tolerance = picture.stats.tolerance
        assert (tolerance > 0.5) == (memory != "64MB")
        assert_same(picture, render(scene, camera, device=device, tolerance=tolerance))


def test_pool_that_is_just_large_enough_settles_wherever_the_camera_goes(path, device):
    scene = Scene()
    scene.add(Bundle.open(path))
    coarse = {"tolerance": 300.0}
    roomy = Renderer(scene, device=device, memory="64MB")
    slots = status_after(roomy, CAMERA, **coarse).needed
    assert slots < 0.8 * status(roomy).num_slots
    renderer = Renderer(scene, device=device, memory=memory_for(scene, device, slots + 2))
    rng = np.random.default_rng(3)
    num_fine = 0
    for _ in range(12):
        eye = rng.normal(size=3) * rng.choice([3.0, 8.0])
        camera = Camera.look_at(eye, 0.3 * rng.normal(size=3), (0, 0, 1), 0.7, width=93, height=61)
        now = status_after(renderer, camera, **coarse)
        assert now.num_resident <= now.num_slots == slots + 2
        image = renderer.render(camera, **coarse)
        assert_same(image, render(scene, camera, device=device, tolerance=image.stats.tolerance))
        if status_after(roomy, camera, **coarse).needed <= slots:
            num_fine += 1
            assert image.stats.tolerance == np.float32(300)
    assert num_fine > 2


def status_after(renderer, camera, **options):
    renderer.settle(camera, **options)
    return status(renderer)


def memory_for(scene, device, num_slots):
    """Return the size in bytes of a pool with this number of slots."""
    low, high = 1 << 10, 1 << 26
    while high - low > 64:
        middle = (low + high) // 2
        try:
            few = status_of_new(scene, device, middle) < num_slots
        except ValueError:
            few = True
        low, high = (middle, high) if few else (low, middle)
    assert status_of_new(scene, device, high) == num_slots
    return high


def status_of_new(scene, device, memory):
    renderer = Renderer(scene, device=device, memory=memory)
    renderer.render(AWAY).stats  # noqa: B018
    return status(renderer).num_slots


def test_shortage_raises_the_tolerance_alike_whatever_was_there_before(scene, device):
    pictures = []
    for before in ([], [NEAR], [AWAY, CAMERA, NEAR]):
        renderer = Renderer(scene, device=device, memory=scaled(scene, 150_000))
        for camera in before:
            renderer.settle(camera, tolerance=3.0)
            renderer.render(camera, tolerance=3.0).stats  # noqa: B018
        renderer.settle(CAMERA, **FINE)
        pictures.append(renderer.render(CAMERA, **FINE))
        assert pictures[-1].stats.missing == 0
        assert pictures[-1].stats.tolerance > 0.5
        assert_same(pictures[-1], pictures[0])
    tolerance = pictures[0].stats.tolerance
    assert_same(pictures[0], render(scene, CAMERA, device=device, tolerance=tolerance))


@pytest.mark.parametrize(("sh_degree", "most"), [(0, 18), (3, 48)])
def test_resident_gaussian_of_a_quantised_bundle_takes_its_code(tmp_path, device, sh_degree, most):
    rng = np.random.default_rng(0)
    made = lod_bundle(rng, blob(rng, 40_000, sh_degree=sh_degree), 170)
    bundle = coded(made, tmp_path / "coded.v3dg")
    ends = [bundle.page_range(page) for page in range(bundle.num_pages - 1)]
    slot = max(
        int(bundle.clusters.offset[page.stop] - bundle.clusters.offset[page.start]) for page in ends
    )
    few, many = (memory_for(bundle, device, count) for count in (100, 200))
    of_gaussians = 7 / 8 * (many - few)  # the rest is for pages that are being loaded
    assert 16 + 8 * sh_degree < of_gaussians / (100 * slot) <= most


def test_frames_become_finer_until_nothing_is_missing(scene, device):
    renderer = Renderer(scene, device=device, memory="64MB")
    first = renderer.render(CAMERA, **FINE)
    assert first.color.shape == (61, 93, 3)
    missing, deadline = [], time.monotonic() + 60
    # On a device, a picture reports what the picture before it missed.
    while (len(missing) < 4 or any(missing[-4:])) and time.monotonic() < deadline:
        missing.append(renderer.render(CAMERA, **FINE).stats.missing)
        time.sleep(0.01)
    assert missing[-1] == 0
    assert_same(renderer.render(CAMERA, **FINE), render(scene, CAMERA, device=device, **FINE))
    assert status(renderer).bytes_in > 0


@pytest.mark.parametrize(("memory", "most"), [("64MB", 1), ("8MB", 3), ("4MB", 5)])
def test_few_pictures_miss_pages_after_a_teleport(device, monkeypatch, memory, most):
    """The limit is the ratio of the bytes that are needed to the eighth of the pool
    that is loaded at once, plus one. Pages of all 13 levels are requested at once.
    """
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    rng = np.random.default_rng(0)
    bundle = lod_bundle(rng, blob(rng, 20_000), 32)
    assert bundle.num_levels == 13
    renderer = Renderer(bundle, device=device, memory=memory)
    renderer.render(AWAY, tolerance=20.0).stats  # noqa: B018
    num_missed, missing = 0, 1
    while missing and num_missed <= most:
        renderer.render(NEAR, tolerance=1.0).stats  # noqa: B018
        missing = status(renderer).missing
        num_missed += missing > 0
        while renderer.pool_frame.core.read_one():
            pass
    assert 0 < num_missed <= most
    assert status(renderer).needed > 900


def test_shortage_raises_the_tolerance_from_frame_to_frame(scene, device):
    renderer = Renderer(scene, device=device, memory=scaled(scene, 150_000))
    tolerances = [FINE["tolerance"]]
    # Frames are faster than decisions about the tolerance, so many are needed.
    while tolerances[-1] <= 1 and len(tolerances) < 20_000:
        tolerances.append(renderer.render(CAMERA, **FINE).stats.tolerance)
    steps = np.array(tolerances[1:]) / tolerances[:-1]
    assert (steps <= 1.0201).all()
    assert (steps >= 0.98).all()
    assert tolerances[-1] > 1


@pytest.mark.parametrize("seed", range(3))
def test_pages_are_there_together_with_those_above_them(scene, device, seed, monkeypatch):
    """Frames and reads alternate in random order, and the pool is too small for most
    views."""
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    rng = np.random.default_rng(seed)
    renderer = Renderer(
        scene, device=device, memory=scaled(scene, int(rng.integers(60_000, 160_000)))
    )
    num_changes, before = 0, None
    for _ in range(80):
        eye = rng.choice([1.5, 4.0, 12.0]) * rng.normal(size=3)
        camera = Camera.look_at(eye, rng.normal(size=3), (0, 0, 1), 0.9, width=61, height=43)
        for _ in range(int(rng.integers(1, 4))):
            renderer.render(camera, tolerance=float(rng.choice([0.5, 5.0, 50.0]))).stats  # noqa: B018
            core = renderer.pool_frame.core
            for _ in range(int(rng.integers(0, 40))):
                core.read_one()
        there = [core.resident(b) for b in range(len(scene.bundles))]
        for bundle, pages in zip(scene.bundles, there, strict=True):
            assert pages[-1]
            assert pages[bundle.groups.parent][pages[:-1]].all()
        now = core.status()
        assert sum(pages[:-1].sum() for pages in there) == now.num_resident <= now.num_slots
        num_changes += before is not None and any(
            (a & ~b).any() for a, b in zip(before, there, strict=True)
        )
        before = there
    assert num_changes > 0  # otherwise no page was evicted


def order_of_reading(scene, monkeypatch):
    """Return (bundle, page) for what a picture misses, in the order in which it is
    read; one page arrives at a time."""
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    renderer = Renderer(scene, device="cpu", memory="64MB")
    renderer.render(CAMERA, **FINE)
    core, order = renderer.pool_frame.core, []
    missing, before = core.status().missing, [core.resident(b) for b in range(len(scene.bundles))]
    for _ in range(missing):
        assert core.read_one()
        renderer.render(CAMERA, **FINE)
        there = [core.resident(b) for b in range(len(scene.bundles))]
        came = [np.flatnonzero(now & ~then) for now, then in zip(there, before, strict=True)]
        (new,) = [(b, int(page)) for b, pages in enumerate(came) for page in pages]
        order.append(new)
        before = there
    assert status(renderer).missing == 0
    return order


def test_no_page_is_read_before_those_above_it(scene, monkeypatch):
    """A page that has been read can be drawn in the next picture."""
    assert len(order_of_reading(scene, monkeypatch)) > 100


def test_neighbours_in_a_file_are_read_one_after_another(path, monkeypatch):
    """Each level fits in one read of 512 KiB, except for the finest level."""
    bundle = Bundle.open(path)
    scene = Scene()
    scene.add(bundle)
    pages = np.array([page for _, page in order_of_reading(scene, monkeypatch)])
    assert len(pages) > 100
    level = bundle.groups.level[pages]
    assert (np.diff(pages) < 0).sum() <= bundle.num_levels + 1
    assert (np.diff(level[np.diff(pages, prepend=-1) < 0]) <= 0).all()


def film_of_arriving_pages(scene, device, options, num_frames=150):
    """Return pictures of a camera at rest, from the coarsest level on, and the number
    of frames in which pages fade in."""
    renderer, pictures, arrived = Renderer(scene, device=device, memory="64MB"), [], []
    for _ in range(num_frames):
        image = renderer.render(CAMERA, **options)
        pictures.append(arrays(image)[0])
        core = renderer.pool_frame.core
        arrived.append([core.arrived(b) for b in range(len(scene.bundles))])
        while core.read_one():
            pass
        num_there = [core.resident(b).sum() for b in range(len(scene.bundles))]
        have_arrived = num_there == [(pages == 8).sum() for pages in arrived[-1]]
        if have_arrived and image.stats.missing == 0 and len(pictures) > 8:
            break
    return pictures, arrived


def worst_tile(pictures):
    """Return the root mean square of the difference of two pictures, in 255ths, of the
    tile where it is largest."""
    changes = (np.square(255.0 * (b - a)).mean(-1) for a, b in itertools.pairwise(pictures))
    return max(np.sqrt(tile_means(change).max()) for change in changes)


def test_pages_fade_in_level_by_level(scene, device, monkeypatch):
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    options = {"tolerance": 20.0, "fade": 1.02}
    pictures, arrived = film_of_arriving_pages(scene, device, options)
    assert 3 * 8 < len(pictures) < 150
    for before, now in itertools.pairwise(arrived):
        for bundle, a, b in zip(scene.bundles, before, now, strict=True):
            assert ((b - a >= 0) & (b - a <= 1)).all()
            assert (b[bundle.groups.parent][b[:-1] > 0] == 8).all()
    whole = Renderer(scene, device=device).render(CAMERA, **options)
    np.testing.assert_array_equal(pictures[-1], arrays(whole)[0])
    at_once, _ = film_of_arriving_pages(scene, device, {"tolerance": 20.0})
    assert worst_tile(pictures) < worst_tile(at_once) / 2


def test_settling_ends_what_fades_in(scene, device):
    options, whole = {"tolerance": 5.0, "fade": 1.05}, Renderer(scene, device=device)
    renderer = Renderer(scene, device=device, memory="64MB")
    for camera in (CAMERA, NEAR):
        for _ in range(5):
            renderer.render(camera, **options).stats  # noqa: B018
        renderer.settle(camera, **options)
        for _ in range(3):
            assert_same(renderer.render(camera, **options), whole.render(camera, **options))


def test_what_is_read_since_settling_does_not_fade_in(scene, device):
    """Pages that are read during `settle` are complete in the next picture."""
    renderer = Renderer(scene, device=device, memory="64MB")
    pool = renderer.pool_frame.core
    options = {"budget": None, "min_level": 0, "fade": 1.05, **FINE}
    renderer.pool_frame.settle(scene, CAMERA, CutRequest(**options), seconds=0.0)
    while not pool.wait(1.0):
        pass
    assert renderer.render(CAMERA, **options).stats.bytes_in > 0
    there = pool.resident(0)
    assert there.sum() > 1
    assert (pool.arrived(0)[there] == 8).all()


def test_without_a_fade_pages_are_there_at_once(scene, device, monkeypatch):
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    _, arrived = film_of_arriving_pages(scene, device, FINE)
    assert set(np.unique(np.concatenate([np.concatenate(pages) for pages in arrived]))) == {0, 8}


def test_pages_that_come_again_fade_in_again(device, monkeypatch):
    """The pool has room for one view, but not for two. Frames without a fade are drawn
    in between. No page of the last picture is evicted.

    """
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    rng, scene = np.random.default_rng(0), Scene()
    for place in range(3):
        scene.add(lod_bundle(rng, blob(rng, 1500), 32), positions=(40.0 * place, 0, 0))
    renderer = Renderer(scene, device=device, memory=250_000)
    before = needs = [np.zeros(bundle.num_pages) > 0 for bundle in scene.bundles]
    num_left = num_fading = 0
    for k in range(300):
        x = 40.0 * (k // 12 % 3)
        camera = Camera.look_at((x, -4, 1), (x, 0, 0), (0, 0, 1), 0.9, width=61, height=43)
        fade = 1.05 if rng.random() < 0.95 else None
        tolerance = renderer.render(camera, tolerance=5.0, fade=fade).stats.tolerance
        core, now = renderer.pool_frame.core, []
        for b, bundle in enumerate(scene.bundles):
            there, arrived = core.resident(b), core.arrived(b)
            assert (arrived[bundle.groups.parent][arrived[:-1] > 0] == 8).all()
            assert (arrived[~there] == 0).all()
            assert fade is not None or (arrived[there] == 8).all()
            has_left = before[b] & ~there
            assert not (has_left & (needs[b] > 1)).any()
            num_left += int(has_left.sum())
            num_fading += int(((arrived > 0) & (arrived < 8)).sum())
            now.append(there)
        before = now
        needs = residency.scene(scene, CPU).core.page_needs(camera.core, rule(tolerance, fade=fade))
        for _ in range(int(rng.integers(0, 60))):
            core.read_one()
    assert num_left > 100
    assert num_fading > 300


def test_gaussians_of_a_file_stay_on_the_disk(path, device):
    bundle = Bundle.open(path)
    render(bundle, CAMERA, device=device, memory="64MB", **FINE).stats  # noqa: B018
    assert "FilePages" in type(bundle._pages).__name__


def test_scene_may_change(scene, asset, device):
    renderer = Renderer(scene, device=device, memory="64MB")
    for change in (
        lambda: scene.move([0], positions=[[0.5, 0, 0]]),
        lambda: scene.remove([1]),
        lambda: scene.add(asset, positions=(0.0, 1, 0)),
        lambda: scene.set_importance(3.0),
    ):
        change()
        renderer.settle(CAMERA, **FINE)
        assert_same(renderer.render(CAMERA, **FINE), render(scene, CAMERA, device=device, **FINE))


@pytest.mark.parametrize("num_levels", [0, 1, 4])
def test_small_bundles(num_levels, device):
    bundle = random_bundle(5, num_levels=num_levels)
    image = render(bundle, CAMERA, device=device, memory="1MB", tolerance=0.0)
    assert_same(image, render(bundle, CAMERA, device=device, tolerance=0.0))


def test_what_a_pool_cannot_do_is_refused(asset, device):
    with pytest.raises(ValueError, match="memory: expected at least"):
        render(asset, CAMERA, device=device, memory=1000)
    with pytest.raises(ValueError, match="memory: expected a positive number of bytes"):
        Renderer(asset, device=device, memory="plenty")
    if device == "cuda":
        with pytest.raises(ValueError, match="color_by: expected 'appearance'"):
            Renderer(asset, device=device, memory="1MB", color_by="level")
    with pytest.raises(ValueError, match="color_by: expected 'appearance' or"):
        Renderer(asset, device=device, memory="1MB", color_by="colour")
    with pytest.raises(ValueError, match=r"memory: expected None for an asset, .*; leave it out"):
        Renderer(asset.gaussians, device=device, memory="1MB")
    cut = v3dg.select(asset, CAMERA, device=device)
    with pytest.raises(ValueError, match="cut: a renderer with a pool selects its own cut"):
        render(asset, CAMERA, cut=cut, device=device, memory="1MB")
    renderer = Renderer(asset, device=device)
    renderer.settle(CAMERA)  # all pages are resident


def damage(path, page):
    bundle = Bundle.open(path)
    with open(path, "r+b") as file:
        file.seek(int(bundle._file.places[page]) + 5)
        byte = file.read(1)
        file.seek(-1, os.SEEK_CUR)
        file.write(bytes([byte[0] ^ 1]))


def draws_coarser(renderer):
    """Return the pictures until pages failed. After that, coarser pages are drawn."""
    deadline = time.monotonic() + 30
    while (image := renderer.render(CAMERA, tolerance=0.0)).stats.failed == 0:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    assert host(image.alpha).max() > 0.1
    return image


def test_damaged_page_leaves_the_picture_coarser_and_is_named(path, device):
    whole = render(Bundle.open(path), CAMERA, device=device, tolerance=0.0)
    damage(path, 3)
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device=device, memory="64MB")
    draws_coarser(renderer)
    with pytest.raises(ValueError, match=r"asset\.v3dg: page 3: the hash does not match"):
        renderer.settle(CAMERA, tolerance=0.0)
    # All pages except the damaged one are resident.
    assert host(renderer.render(CAMERA, tolerance=0.0).alpha).max() > 0.1
    damage(path, 3)  # the camera returns
    renderer.settle(CAMERA, tolerance=0.0)
    assert_same(renderer.render(CAMERA, tolerance=0.0), whole)


def test_of_pages_that_are_read_together_only_the_damaged_ones_fail(path, device):
    damaged = [3, 4, 40]  # page 3 belongs to the finest level, so no page is below it
    for page in damaged:
        damage(path, page)
    renderer = Renderer(Bundle.open(path), device=device, memory="64MB")
    deadline = time.monotonic() + 30
    while draws_coarser(renderer).stats.failed < 3 or status(renderer).missing > 3:
        assert time.monotonic() < deadline
    renderer.render(CAMERA, tolerance=0.0).stats  # noqa: B018  brings what was read since
    assert status(renderer).failed == 3
    assert np.flatnonzero(~renderer.pool_frame.core.resident(0)).tolist() == damaged


def test_truncated_file_is_an_error_and_not_a_crash(path, device):
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device=device, memory="64MB")
    os.truncate(path, int(bundle._file.places[2]))
    draws_coarser(renderer)
    with pytest.raises(
        ValueError, match=r"asset\.v3dg: page \d+ is missing; the file was truncated"
    ):
        renderer.settle(CAMERA, tolerance=0.0)


def test_replaced_file_changes_nothing(path, asset, device):
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device=device, memory="64MB")
    renderer.render(CAMERA, **FINE).stats  # noqa: B018
    random_bundle(1).write(path)
    renderer.settle(CAMERA, **FINE)
    assert_same(renderer.render(CAMERA, **FINE), render(asset, CAMERA, device=device, **FINE))


def test_coarsest_page_has_to_be_readable(path, device):
    damage(path, Bundle.open(path).num_pages - 1)
    with pytest.raises(ValueError, match="the hash does not match"):
        render(Bundle.open(path), CAMERA, device=device, memory="64MB")


def test_failing_disk_is_an_error_of_the_system(path, device):
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device=device, memory="64MB")
    renderer.render(AWAY).stats  # noqa: B018  makes the pool
    own = {fd for fd in map(int, os.listdir("/proc/self/fd")) if links_to(fd, path)}
    memory = os.open("/proc/self/mem", os.O_RDONLY)  # reads of the first pages fail
    kept = os.dup(bundle._file._fd)
    try:
        for fd in own:
            os.dup2(memory, fd)
        draws_coarser(renderer)
        with pytest.raises(OSError, match=r"asset\.v3dg: page \d+: Input/output error"):
            renderer.settle(CAMERA, tolerance=0.0)
    finally:
        for fd in own:
            os.dup2(kept, fd)
        os.close(memory)
        os.close(kept)
    renderer.settle(CAMERA, tolerance=0.0)
    assert renderer.render(CAMERA, tolerance=0.0).stats.missing == 0


def links_to(fd, path):
    try:
        return os.readlink(f"/proc/self/fd/{fd}") == os.fspath(path)
    except OSError:
        return False


def test_disk_that_does_not_answer_ends_the_wait(path, device, monkeypatch):
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    renderer = Renderer(Bundle.open(path), device=device, memory="64MB")
    start = time.monotonic()
    with pytest.raises(TimeoutError, match="pages are missing and none arrived"):
        renderer.settle(CAMERA, timeout=0.2, **FINE)
    assert time.monotonic() - start < 20
    for _ in range(3):
        image = renderer.render(CAMERA, **FINE)  # `render` does not wait for pages
    assert image.stats.missing > 0
    core = renderer.pool_frame.core
    while core.read_one():  # read page by page, beginning with the most urgent
        before = image.stats.missing
        image = renderer.render(CAMERA, **FINE)
        assert image.stats.missing <= before
    image = [renderer.render(CAMERA, **FINE) for _ in range(3)][-1]
    assert_same(image, render(Bundle.open(path), CAMERA, device=device, **FINE))


def test_child_of_a_fork_is_told_to_make_another(path):
    renderer = Renderer(Bundle.open(path), device="cpu", memory="64MB")
    # fork while threads are reading, because a lock of theirs may be held at that
    # moment
    for k in range(20):
        renderer.render([CAMERA, NEAR][k % 2], **FINE)
        child = os.fork()
        if child == 0:
            try:
                renderer.settle(NEAR, **FINE)
            except RuntimeError as error:
                os._exit(7 if "from before a fork" in str(error) else 8)
            os._exit(9)
        assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7


@pytest.mark.parametrize("num_threads", [2, 4])
def test_stills_of_threads_are_settled(path, num_threads):
    """The threads share a pool with room for about one view. No thread draws with the
    pages that were loaded for another."""
    scene = Scene()
    scene.add(Bundle.open(path), positions=[[-1.0, 0, 0], [1, 0, 0]])
    cameras = [CAMERA, NEAR, AWAY] * 8
    expected = [
        arrays(render(scene, camera, device="cpu", memory=300_000, **FINE))
        for camera in cameras[:3]
    ]
    with ThreadPoolExecutor(num_threads) as threads:
        images = list(
            threads.map(
                lambda camera: render(scene, camera, device="cpu", memory=300_000, **FINE), cameras
            )
        )
    for k, image in enumerate(images):
        assert image.stats.missing == 0
        for plane, other in zip(arrays(image), expected[k % 3], strict=True):
            np.testing.assert_array_equal(plane, other)


def test_only_the_last_pool_of_stills_is_kept(path):
    """A pool has threads and memory. If pools were kept, they would accumulate while a
    bundle is drawn with many sizes."""
    bundle = Bundle.open(path)
    render(bundle, CAMERA, device="cpu", memory="64MB", **FINE)
    before = len(os.listdir("/proc/self/task"))
    for megabytes in range(65, 75):
        render(bundle, CAMERA, device="cpu", memory=f"{megabytes}MB", **FINE)
        render(bundle, CAMERA, device="cpu", memory=f"{megabytes}MB", color_by="level", **FINE)
    assert len(os.listdir("/proc/self/task")) <= before


def test_stills_of_one_size_share_a_pool_whatever_its_text(path):
    bundle = Bundle.open(path)
    render(bundle, CAMERA, device="cpu", memory="64MiB", **FINE)
    before = set(os.listdir("/proc/self/task"))
    render(bundle, CAMERA, device="cpu", memory=64 << 20, **FINE)
    assert set(os.listdir("/proc/self/task")) <= before  # no thread of another pool


def test_children_of_a_fork_draw_stills(path):
    """A child process has its own pool, even if threads of the parent use the other
    one."""
    bundle = Bundle.open(path)
    expected = arrays(render(bundle, NEAR, device="cpu", memory="64MB", **FINE))
    is_over = threading.Event()

    def draw():
        while not is_over.is_set():
            render(bundle, CAMERA, device="cpu", memory="64MB", **FINE)

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        for _ in range(20):
            child = os.fork()
            if child == 0:
                code = 9
                with suppress(BaseException):
                    image = render(bundle, NEAR, device="cpu", memory="64MB", **FINE)
                    is_same = all(map(np.array_equal, arrays(image), expected))
                    code = 7 if is_same else 8
                os._exit(code)
            assert exit_code(child) == 7
    finally:
        is_over.set()
        thread.join()


def test_picking_from_a_pool_of_another_process_is_refused(path):
    """This also holds while another thread of the parent draws. The child does not wait
    for the lock of that thread."""
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device="cpu", memory="64MB")
    renderer.settle(CAMERA, **FINE)
    is_over = threading.Event()

    def draw():
        while not is_over.is_set():
            renderer.render(CAMERA, **FINE)

    thread = threading.Thread(target=draw)
    thread.start()
    try:
        for _ in range(20):
            child = os.fork()
            if child == 0:
                code = 9
                try:
                    pick(bundle, CAMERA, 40, 30, renderer=renderer)
                except RuntimeError as error:
                    code = 7 if "from before a fork" in str(error) else 8
                os._exit(code)
            assert exit_code(child) == 7
    finally:
        is_over.set()
        thread.join()


def exit_code(child):
    """Return the exit code of a child process, or -9 if it does not end within a
    minute."""
    end = time.monotonic() + 60
    while time.monotonic() < end:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return os.waitstatus_to_exitcode(status)
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


@pytest.mark.gpu
def test_devices_need_the_same_pages(scene):
    renderers = [Renderer(scene, device=device, memory="64MB") for device in ("cpu", "cuda")]
    for camera in (CAMERA, NEAR, AWAY):
        for options in (FINE, {"tolerance": 20.0}, {"budget": 4000}):
            found = [status_after(renderer, camera, **options) for renderer in renderers]
            assert found[0].needed == found[1].needed
            assert found[0].missing == found[1].missing == 0


@pytest.mark.gpu
def test_pictures_that_are_drawn_ahead_are_finished_later(scene):
    """Many pictures of views with different pages are in flight, and no result is read
    until the end."""
    renderer = Renderer(scene, device="cuda", memory=scaled(scene, 150_000))
    rng = np.random.default_rng(5)
    cameras = [
        Camera.look_at(4 * rng.normal(size=3), (0, 0, 0), (0, 0, 1), 0.8, width=93, height=61)
        for _ in range(60)
    ]
    images = [renderer.render(camera, tolerance=30.0) for camera in cameras]
    assert all(np.isfinite(host(image.color)).all() for image in images)
    now = status(renderer)
    assert now.failed == 0
    assert now.num_resident <= now.num_slots
    renderer.settle(CAMERA, tolerance=30.0)
    image = renderer.render(CAMERA, tolerance=30.0)
    assert_same(image, render(scene, CAMERA, device="cuda", tolerance=image.stats.tolerance))


@pytest.mark.gpu
def test_pages_that_leave_before_a_frame_has_them_are_not_drawn(scene):
    """The pool loads pages for several pictures before a frame applies the changes."""
    renderer = Renderer(scene, device="cuda", memory=scaled(scene, 150_000))
    rng = np.random.default_rng(7)
    for _ in range(20):
        cameras = [
            Camera.look_at(3 * rng.normal(size=3), (0, 0, 0), (0, 0, 1), 0.8, width=93, height=61)
            for _ in range(4)
        ]
        for image in [renderer.render(camera, tolerance=30.0) for camera in cameras]:
            image.stats  # noqa: B018
            time.sleep(0.005)  # for other threads to decide
        for camera in cameras[:2]:
            renderer.settle(camera, tolerance=30.0)
            image = renderer.render(camera, tolerance=30.0)
            assert_same(
                image, render(scene, camera, device="cuda", tolerance=image.stats.tolerance)
            )


@pytest.mark.gpu
def test_graphs_of_a_pool_are_refused(scene):
    import torch

    renderer = Renderer(scene, device="cuda", memory="64MB")
    renderer.render(CAMERA).stats  # noqa: B018
    with torch.cuda.graph(torch.cuda.CUDAGraph()):
        torch.zeros(1, device="cuda")  # because torch warns of empty graphs
        with pytest.raises(RuntimeError, match="cannot be captured in a CUDA graph"):
            renderer.render(CAMERA)
