"""Data that is kept for bundles and scenes on a device: it is created once, and freed
with its owner or with all other data."""

import gc
import itertools
import weakref
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import scenes_lod
from devices import host
from v3dg import Camera, Renderer, Scene, _core, _device, render, select
from v3dg._device import CPU
from v3dg.residency import Residency, residency

CAMERA = Camera.look_at((0, -6, 1), (0, 0, 0), (0, 0, 1), 0.9, width=67, height=41)


def bundle(seed, num=200):
    rng = np.random.default_rng(seed)
    return scenes_lod.lod_bundle(rng, scenes_lod.blob(rng, num, sh_degree=1), 32)


@pytest.fixture
def where(device):
    return _device.resolve(device)


@pytest.fixture
def made(monkeypatch):
    """Count the objects that the core creates, by the name of their kind."""
    made = []
    for name in ("ClusterTable", "Model", "Palette", "SceneFrame", "ResidentScene"):
        monkeypatch.setattr(_core, name, counted(getattr(_core, name), made))
    return made


def counted(kind, made):
    def make(*args, **options):
        made.append(kind.__name__)
        return kind(*args, **options)

    return make


def test_all_is_made_once_for_a_bundle_and_a_device(where, made):
    asset, other = bundle(0), bundle(1)
    first = residency.table(asset), residency.model(asset, where)
    for _ in range(2):
        render(asset, CAMERA, device=where).stats  # noqa: B018  waits for the picture
        select(asset, CAMERA, device=where)
        assert (residency.table(asset), residency.model(asset, where)) == first
    assert sorted(made) == ["ClusterTable", "Model", "ResidentScene", "SceneFrame"]
    assert residency.table(other) is not first[0]
    assert residency.model(other, where) is not first[1]
    del made[:]
    for color_by in ("level", "cluster"):
        render(asset, CAMERA, color_by=color_by, device=where).stats  # noqa: B018
    assert sorted(made) == 2 * ["Palette"] + 2 * ["SceneFrame"]  # of the same gaussians


def test_scene_of_one_bundle_has_the_bundles_own_model(where, made):
    asset, scene = bundle(0), Scene()
    scene.add(asset, positions=np.random.default_rng(0).normal(size=(5, 3)))
    for subject in (asset, scene):
        render(subject, CAMERA, device=where).stats  # noqa: B018
    assert sorted(made) == ["ClusterTable", "Model", *2 * ["ResidentScene"], *2 * ["SceneFrame"]]


def test_added_bundle_leaves_the_others_where_they_are(where, made):
    first, second, scene = bundle(0), bundle(1), Scene()
    scene.add(first)
    render(scene, CAMERA, device=where).stats  # noqa: B018
    model, gaussians = residency.model(first, where), residency.gaussians(first, where)
    resident = residency.scene(scene, where)
    del made[:]
    scene.add(second, positions=(1.0, 0, 0))
    image = render(scene, CAMERA, device=where)
    assert image.stats.gaussians_selected > 0
    assert residency.model(first, where) is model
    assert residency.gaussians(first, where) is gaussians
    now = residency.scene(scene, where)
    assert (now is resident) == where.is_cuda  # on the CPU, a drawing keeps what it uses alive
    assert now.bundles == (first, second)
    assert sorted(set(made) - {"ResidentScene"}) == ["ClusterTable", "Model"]
    assert len(made) == 2 + (now is not resident)
    again = Scene()
    again.add(first)
    again.add(second, positions=(1.0, 0, 0))
    np.testing.assert_array_equal(
        host(image.color), host(render(again, CAMERA, device=where).color)
    )


def test_scene_is_taken_over_as_it_is_now(where):
    asset, scene = bundle(0), Scene()
    scene.add(asset, positions=np.zeros((3, 3)))
    for change in (
        lambda: scene.move(positions=[[0.5, 0, 0], [1, 0, 0], [0, 1, 0]]),
        lambda: scene.remove([1]),
        lambda: scene.set_importance([5.0, 0.1]),
        lambda: scene.add(bundle(1), positions=(0.0, 0.0, 1.0)),
        lambda: scene.move([0], scales=0.3),
    ):
        render(scene, CAMERA, device=where).stats  # noqa: B018
        change()
        fresh = Scene()
        for i, b in enumerate(scene.instance_bundle):
            poses = scene.positions[i], scene.quaternions[i], scene.scales[i]
            fresh.add(scene.bundles[b], *poses, importance=scene.importance[i])
        for kept, expected in zip(
            drawn_and_chosen(scene, where), drawn_and_chosen(fresh, where), strict=True
        ):
            np.testing.assert_array_equal(kept, expected)


def drawn_and_chosen(scene, where):
    image = render(scene, CAMERA, depth=True, device=where)
    cut = select(scene, CAMERA, device=where)
    return *host((image.color, image.alpha, image.depth)), cut.instance_ids, cut.cluster_ids


def test_bytes_grow_with_what_is_there(where):
    kept, asset = Residency(), bundle(0)
    assert kept.num_bytes(where) == 0
    sizes = [0]
    for make in (
        lambda: kept.model(asset, where),
        lambda: kept.model(bundle_that_stays, where),
    ):
        make()
        sizes.append(kept.num_bytes(where))
        make()
        assert kept.num_bytes(where) == sizes[-1]
    # A gaussian of degree 1 has 23 floats in every layout.
    assert sizes[1] >= 23 * 4 * len(asset.gaussians)
    assert all(a < b for a, b in itertools.pairwise(sizes))
    if where != CPU:
        assert kept.num_bytes(CPU) == 0


bundle_that_stays = bundle(1)


def test_what_is_cleared_is_made_again(where):
    asset = bundle(0)
    image = render(asset, CAMERA, device=where)
    renderer = Renderer(asset, device=where)
    model, table = residency.model(asset, where), residency.table(asset)
    residency.clear()
    assert residency.num_bytes(where) == 0
    assert residency.table(asset) is not table
    assert residency.model(asset, where) is not model
    for again in (
        render(asset, CAMERA, device=where),
        renderer.render(CAMERA),
    ):  # keeps its data
        np.testing.assert_array_equal(host(again.color), host(image.color))


def test_nothing_keeps_a_bundle_or_a_scene_alive(where):
    asset, scene = bundle(0), Scene()
    scene.add(asset)
    for subject in (asset, scene):
        render(subject, CAMERA, device=where).stats  # noqa: B018
        select(subject, CAMERA, device=where)
    before = residency.num_bytes(where)
    gone = weakref.ref(asset), weakref.ref(scene)
    del asset, scene, subject
    gc.collect()
    assert [ref() for ref in gone] == [None, None]
    assert residency.num_bytes(where) < before


def test_threads_get_the_same(where, made):
    kept, assets = Residency(), [bundle(seed) for seed in range(3)]

    def ask(i):
        asset = assets[i % 3]
        return (
            i % 3,
            kept.table(asset),
            kept.model(asset, where),
            kept.gaussians(asset, where),
            kept.scene(asset, where),
        )

    with ThreadPoolExecutor(8) as pool:
        found = list(pool.map(ask, range(48)))
    assert len({tuple(map(id, things[1:])) for things in found}) == 3
    assert sorted(made) == sorted(3 * ["ClusterTable", "Model", "ResidentScene"])


def test_no_lock_is_held_for_ever_in_a_child():
    """If a process forks while another thread uses the cache, the child has a lock that
    nobody releases."""
    kept = Residency()
    with ThreadPoolExecutor(1) as pool:
        pool.submit(kept.lock.acquire).result()  # the child does not have this thread
        kept._after_fork()
        assert kept.table(bundle(0)) is not None


def test_what_is_no_scene_is_refused(where):
    for call in (
        lambda: residency.scene(7, where),
        lambda: render(7, CAMERA, device=where),
        lambda: Renderer(7, device=where),
        lambda: select(7, CAMERA, device=where),
    ):
        with pytest.raises(TypeError, match="subject: expected a Scene or a Bundle, got int"):
            call()
