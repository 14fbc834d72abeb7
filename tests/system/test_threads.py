"""Threads, forked processes, and torch in the same process give the same results,
without deadlocks."""

import copy
import hashlib
import itertools
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import scenes
import scenes_lod
import v3dg
from command_line import TESTS_ENVIRONMENT
from devices import host

CAMERA = scenes.camera(131, 97, fx=90.0, cx=60.0, cy=55.0, pose=scenes.pose(8))
SECONDS = 120  # more time than any of these programs needs on a busy machine


def digest(*arrays):
    return hashlib.sha256(
        b"".join(np.ascontiguousarray(host(a)).tobytes() for a in arrays)
    ).hexdigest()


def asset(seed=20, num=3000):
    return scenes.trained_like(seed, CAMERA, num)


def picture(gaussians, device="cpu"):
    raster = v3dg.rasterize(
        gaussians if device == "cpu" else gaussians.torch(device), CAMERA, filter_px2=0.1
    )
    return digest(raster.color, raster.alpha, raster.depth)


def gradient(gaussians, device="cpu"):
    g = gaussians.torch(device)
    g.means.requires_grad_()
    v3dg.rasterize(g, CAMERA, filter_px2=0.1).color.square().sum().backward()
    return digest(g.means.grad)


def crowd(seed=0):
    rng = np.random.default_rng(seed)
    bundle = scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, 600, sh_degree=1), 64)
    return scenes_lod.random_scene(rng, bundle, 40, spread=3.0)


def frame(scene, device="cpu"):
    camera = v3dg.Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=203, height=117)
    image = v3dg.render(scene, camera, tolerance=1.0, depth=True, device=device)
    return digest(image.color, image.alpha, image.depth)


def frame_and_cut(scene, device):
    """Draw a frame and select a cut. Both use the resident data of a scene."""
    cut = v3dg.select(scene, CAMERA, tolerance=2.0, device=device)
    return frame(scene, device), digest(cut.instance_ids, cut.cluster_ids)


def bundle_of(gaussians, device="cpu"):
    config = v3dg.BuildConfig(cluster_size=64, steps=3, num_views=4, image_size=16)
    bundle = v3dg.build_bundle(
        gaussians, config=config, device=device, progress=False, quality="draft"
    )
    return digest(bundle.gaussians.means, bundle.gaussians.sh, bundle.groups.ball)


# ---- threads of Python


@pytest.mark.parametrize(
    ("work", "subjects"),
    [
        (picture, [asset(seed) for seed in range(3)]),
        (gradient, [asset(seed) for seed in range(3)]),
        (frame_and_cut, [crowd(seed) for seed in range(3)]),
        (
            bundle_of,
            [asset(seed, 100 + 200 * seed) for seed in range(3)],
        ),  # with groups of several sizes
    ],
    ids=["rasterize", "backward", "render", "build"],
)
def test_threads_get_what_one_gets_alone(work, subjects, device):
    if work is gradient:
        pytest.importorskip("torch")
    alone = [work(subject, device) for subject in subjects]
    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(work, subjects[i % 3], device) for i in range(24)]
        together = [job.result(SECONDS) for job in jobs]
    assert together == [alone[i % 3] for i in range(24)]


def test_threads_may_draw_a_bundle_that_was_never_drawn(device):
    """The resident data of a bundle is created when it is first drawn, by all threads
    at once."""
    expected = frame(crowd(3), device)
    scene, start = crowd(3), threading.Barrier(8)

    def draw(_):
        start.wait(SECONDS)
        return frame(scene, device)

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(draw, range(8))) == {expected}


@pytest.mark.gpu
def test_streams_of_several_threads_get_what_one_gets_alone():
    torch = pytest.importorskip("torch")
    scene = crowd(4)
    expected = frame_and_cut(scene, "cuda")

    def on_a_stream_of_its_own(_):
        with torch.cuda.stream(torch.cuda.Stream()):
            return [frame_and_cut(scene, "cuda") for _ in range(10)]

    with ThreadPoolExecutor(4) as pool:
        for found in pool.map(on_a_stream_of_its_own, range(4)):
            assert found == 10 * [expected]


def test_threads_may_share_a_renderer_of_an_asset(device, hasty):
    """The pictures have many sizes.

    Memory for them is allocated while other threads draw.
    """
    subject = asset() if device == "cpu" else asset().torch(device)
    cameras = [CAMERA.scaled(1 + k % 4) for k in range(8)]

    def pictures(renderer):
        images = [renderer.render(camera) for camera in cameras]
        return [digest(image.color, image.alpha) for image in images]

    expected = pictures(v3dg.Renderer(subject, device=device))
    renderer = v3dg.Renderer(subject, device=device)
    with ThreadPoolExecutor(8) as pool:
        jobs = [pool.submit(pictures, renderer) for _ in range(8)]
        assert all(job.result(SECONDS) == expected for job in jobs)


# ---- scenes that change


@pytest.fixture
def hasty():
    """Make threads take turns as often as possible."""
    interval = sys.getswitchinterval()
    sys.setswitchinterval(1e-6)
    yield
    sys.setswitchinterval(interval)


def while_another_changes(change, work, times):
    """Return the results of many calls of `work`, while a thread calls `change` with 0,
    1, 2 and so on."""
    stop = threading.Event()

    def go_on():
        for i in itertools.count():
            if stop.is_set():
                return
            change(i)

    with ThreadPoolExecutor(3) as pool:
        changing = pool.submit(go_on)
        try:
            drawing = [pool.submit(lambda: [work() for _ in range(times)]) for _ in range(2)]
            return [one for job in drawing for one in job.result(SECONDS)]
        finally:
            stop.set()
            changing.result(SECONDS)


def test_frames_of_a_scene_that_moves_are_old_or_new(device, hasty):
    scene, rng = crowd(5), np.random.default_rng(0)
    poses = [
        {
            "positions": rng.normal(size=(40, 3)),
            "quaternions": rng.normal(size=(40, 4)),
            "scales": size,
        }
        for size in (0.5, 1.5)
    ]
    expected = set()
    for pose in poses:
        scene.move(**pose)
        expected.add(frame(scene, device))
    found = while_another_changes(
        lambda i: scene.move(**poses[i % 2]), lambda: frame(scene, device), 20
    )
    assert set(found) <= expected


def test_frames_of_a_scene_that_grows_and_shrinks_are_old_or_new(device, hasty):
    """Meanwhile, a bundle is also added. A cut of removed instances is refused, or
    drawn as it was."""
    scene, other = crowd(6), crowd(7).bundles[0]
    cut = v3dg.select(scene, CAMERA, tolerance=2.0, device=device)

    def drawn_as_cut():
        try:
            return digest(v3dg.render(scene, CAMERA, cut=cut, device=device).color)
        except ValueError as error:
            return str(error)

    def changed(i):
        if i % 2 == 0:
            scene.add(other, positions=[[0, 0, 0], [0, 1, 0]])
        else:
            scene.remove([40, 41])

    expected = {frame(scene, device), frame_of_grown(scene, other, device)}
    as_cut, refused = drawn_as_cut(), "cut: instances were removed from the scene"
    found = while_another_changes(changed, lambda: (frame(scene, device), drawn_as_cut()), 20)
    assert {drawn for drawn, _ in found} <= expected
    assert all(cut == as_cut or cut.startswith(refused) for _, cut in found)


def frame_of_grown(scene, bundle, device):
    grown = copy.copy(scene)
    grown.add(bundle, positions=[[0, 0, 0], [0, 1, 0]])
    assert len(grown) == len(scene) + 2
    return frame(grown, device)


def test_threads_that_change_a_scene_lose_nothing(device, hasty):
    scene, bundles = v3dg.Scene(), [crowd(seed).bundles[0] for seed in range(4)]

    def fill(k):
        ids = []
        for i in range(50):
            ids += scene.add(bundles[k], positions=[[k, i, 0], [k, i, 1]])
            scene.set_importance(2.0, [ids[-1]])
        return ids

    with ThreadPoolExecutor(4) as pool:
        ids = [job.result(SECONDS) for job in [pool.submit(fill, k) for k in range(4)]]
    assert sorted(itertools.chain(*ids)) == list(range(400))
    for k, mine in enumerate(ids):
        assert all(scene.bundles[b] is bundles[k] for b in scene.instance_bundle[mine])
        np.testing.assert_array_equal(scene.positions[mine][:, 0], k)
        np.testing.assert_array_equal(scene.importance[mine], 50 * [1, 2])
    frame(scene, device)


READING = {"PlyFile.read", "ply_write"}
DRAWING = {
    *("rasterize", "rasterize_backward", "gather"),
    *("ResidentScene.select", "SceneFrame.draw", "AssetFrame.draw"),
}
BUILDING = {"median_split", "bound_spheres", "merge", "bound_by_boxes", "fit_level"}
LONG = READING | DRAWING | BUILDING


def call_what_takes_long(folder):
    import torch

    many = scenes.random_gaussians(0, CAMERA, 100_000, sh_degree=1)
    v3dg.write_asset(folder / "many.ply", many)
    v3dg.read_asset(folder / "many.ply")
    gradient(many)
    with torch.no_grad():
        picture(many)
    config = v3dg.BuildConfig(cluster_size=256, steps=0, num_views=4, image_size=16)
    v3dg.build_bundle(many, config=config, device="cpu", progress=False)
    scene = crowd()
    scene.add(scene.bundles[0], positions=np.zeros((3000, 3)))
    frame(scene)
    v3dg.render(many, CAMERA, device="cpu")
    cut = v3dg.select(scene, CAMERA, tolerance=0.0, device="cpu")
    cut.gaussians(device="cpu")
    v3dg.render(scene, CAMERA, cut=cut, device="cpu")


def test_other_threads_go_on_while_the_core_is_at_work(tmp_path, monkeypatch):
    """A thread that reads the clock all the time is never blocked for most of a
    call."""
    pytest.importorskip("torch")
    looks, stop, blocked = [], threading.Event(), dict.fromkeys(LONG, 1.0)

    def look():
        while not stop.wait(1e-4):
            looks.append(time.monotonic())

    def watched(name, call):
        def run(*args, **options):
            del looks[:]
            begin = time.monotonic()
            result = call(*args, **options)
            end = time.monotonic()
            gaps = np.diff([begin, *(t for t in looks if begin < t < end), end])
            blocked[name] = min(blocked[name], gaps.max() / (end - begin))
            return result

        return run

    for name in LONG:
        *owner, function = name.split(".")
        place = getattr(v3dg._core, owner[0]) if owner else v3dg._core
        monkeypatch.setattr(place, function, watched(name, getattr(place, function)))
    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        for _ in range(10):  # the machine may be busy
            call_what_takes_long(tmp_path)
            if max(blocked.values()) < 0.5:
                break
    finally:
        stop.set()
        watcher.join()
    assert max(blocked.values()) < 0.5, blocked


# ---- processes


def run(script, **environment):
    """Return what a separate script prints; it may not hang."""
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", script],
        env=TESTS_ENVIRONMENT | environment,
        capture_output=True,
        text=True,
        check=False,
        timeout=SECONDS,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.split()


ALL = """
from test_threads import asset, bundle_of, crowd, frame, picture
def everything():
    return picture(asset()), frame(crowd()), bundle_of(asset(num=300))
"""


@pytest.fixture(scope="module")
def expected():
    return [picture(asset()), frame(crowd()), bundle_of(asset(num=300))]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_one_thread_gives_the_same(expected, threads):
    assert run(ALL + "print(*everything())", OMP_NUM_THREADS=threads) == expected


def test_forked_process_gives_the_same(expected):
    """The same holds for a child of a child, and for the parent afterwards."""
    script = """
import os
def in_child(work):
    sys.stdout.flush()
    pid = os.fork()
    if pid == 0:
        work()
        sys.stdout.flush()
        os._exit(0)
    assert os.waitpid(pid, 0)[1] == 0
show = lambda: print(*everything())
show()
in_child(lambda: (show(), in_child(show)))
show()
"""
    assert run("import sys\n" + ALL + script, OMP_NUM_THREADS="4") == 4 * expected


def test_processes_may_be_forked_while_threads_draw(expected):
    """Data loaders use multiprocessing, which forks a process whose threads are at
    work."""
    script = """
import multiprocessing, threading
stop = threading.Event()
def draw():
    while not stop.is_set():
        everything()
everything()
threads = [threading.Thread(target=draw) for _ in range(2)]
for t in threads: t.start()
with multiprocessing.get_context("fork").Pool(2) as pool:
    for result in [pool.apply_async(everything) for _ in range(4)]:
        print(*result.get(100))
stop.set()
for t in threads: t.join()
"""
    assert run(ALL + script, OMP_NUM_THREADS="4") == 4 * expected


def test_threads_of_torch_are_no_hindrance(expected):
    pytest.importorskip("torch")
    script = """
import threading
import torch
stop = threading.Event()
matrix = torch.rand(300, 300)
product = matrix @ matrix
def multiply():
    while not stop.is_set():
        assert torch.equal(matrix @ matrix, product)
threads = [threading.Thread(target=multiply) for _ in range(2)]
for t in threads: t.start()
print(*everything())
stop.set()
for t in threads: t.join()
"""
    assert run(ALL + script) == expected


@pytest.mark.skipif(
    "libasan" in Path("/proc/self/maps").read_text(), reason="the address checks need all addresses"
)
def test_memory_that_runs_out_is_an_error_and_nothing_else():
    """Memory may run out at any moment. The process continues, and gives the same
    results once there is memory again."""
    script = """
import resource
from collections import Counter
from test_threads import asset, bundle_of, crowd, frame, gradient, picture
def size():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[0]) * resource.getpagesize()
subjects = (asset(), asset(), crowd(), asset(num=300))
for work, subject in zip((picture, gradient, frame, bundle_of), subjects):
    expected, seen = work(subject), Counter()
    for room in [*range(0, 2 << 20, 128 << 10), *range(2 << 20, 24 << 20, 1 << 20)]:
        resource.setrlimit(resource.RLIMIT_AS, (size() + room, resource.RLIM_INFINITY))
        try:
            assert work(subject) == expected
            seen["done"] += 1
        except (MemoryError, RuntimeError) as error:  # of threads that cannot start
            seen[type(error).__name__] += 1
        finally:
            resource.setrlimit(resource.RLIMIT_AS, (resource.RLIM_INFINITY,) * 2)
    print(work.__name__, seen["MemoryError"] > 0, work(subject) == expected)
"""
    pytest.importorskip("torch")
    # With a single arena that returns freed memory at once, the memory limit takes
    # effect soon.
    allocator = {
        "MALLOC_ARENA_MAX": "1",
        "MALLOC_TRIM_THRESHOLD_": "0",
        "MALLOC_MMAP_THRESHOLD_": "16384",
    }
    printed = run(script, OMP_NUM_THREADS="1", **allocator)
    works = ("picture", "gradient", "frame", "bundle_of")
    assert printed == [word for work in works for word in (work, "True", "True")]


def test_thread_that_ends_before_its_first_line_is_an_error(monkeypatch):
    """A thread ends before its first line if there is no memory to begin it.
    threading.Thread would then wait for ever."""
    starts_nothing = SimpleNamespace(start_new_thread=lambda work, arguments: 0)
    monkeypatch.setattr(sys.modules["v3dg.levels.fit"], "_thread", starts_nothing)
    with pytest.raises(MemoryError, match="ended at once"):
        bundle_of(asset(num=300))
