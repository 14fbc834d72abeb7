"""Pools whose size depends on the free memory of the device. No pool is used if
everything fits there."""

import numpy as np
import pytest

import v3dg
import v3dg.pool
from frames import Renderer, arrays, render
from scenes_lod import blob, lod_bundle
from v3dg import Bundle, Camera, Scene, _core, _device
from v3dg._device import CPU
from v3dg.residency import residency

CAMERA = Camera.look_at((0, -9, 1), (0, 0, 0), (0, 0, 1), 0.9, width=93, height=61)
GIB = 1 << 30


@pytest.fixture(params=["float32", "quantized"])
def path(request, tmp_path):
    rng = np.random.default_rng(0)
    bundle = lod_bundle(rng, blob(rng, 5000, sh_degree=1), 32)
    path = tmp_path / "asset.v3dg"
    Bundle(bundle.clusters, bundle.groups, bundle.gaussians, codec=request.param).write(path)
    return path


@pytest.fixture
def free(monkeypatch):
    """Set the free memory of the device that draws, and of the host."""

    def set_free(num_bytes, where=None):
        real = v3dg.pool.free_on
        monkeypatch.setattr(
            v3dg.pool,
            "free_on",
            lambda device: num_bytes if where in (None, device) else real(device),
        )

    return set_free


def assert_same(image, expected):
    for one, other in zip(arrays(image), arrays(expected), strict=True):
        np.testing.assert_array_equal(one, other)


def size_of(path, device):
    """Return the size of a whole bundle on the device and, if the device is not the
    host, on the host."""
    return residency.bytes_to_add([Bundle.open(path)], _device.resolve(device))


def test_a_picture_asks_once_for_the_scene(path, device, monkeypatch):
    renderer = Renderer(Bundle.open(path), device=device)
    renderer.render(CAMERA)
    num_calls = 0
    scene_of = residency.scene

    def counted(*arguments):
        nonlocal num_calls
        num_calls += 1
        return scene_of(*arguments)

    monkeypatch.setattr(residency, "scene", counted)
    renderer.render(CAMERA)
    assert num_calls == 1


def test_all_is_resident_where_it_fits(path, device):
    renderer = Renderer(Bundle.open(path), device=device)
    assert renderer.memory is None
    assert renderer.render(CAMERA).stats.memory is None
    assert "all is resident" in repr(renderer)


def test_what_does_not_fit_gets_a_pool_and_says_so(path, device, free):
    needed = max(size_of(path, device).values())
    free(needed)  # a quarter of this is kept free, so there is too little
    bundle = Bundle.open(path)
    renderer = Renderer(bundle, device=device)
    assert renderer.memory == needed // 2
    assert "a pool of" in repr(renderer)
    still = render(bundle, CAMERA, device=device, tolerance=0.5)
    assert still.stats.memory == needed // 2
    assert still.stats.missing == 0
    whole = render(
        Bundle.open(path), CAMERA, device=device, memory=None, tolerance=still.stats.tolerance
    )
    assert_same(still, whole)
    assert not bundle.is_in_memory


def test_the_rule_is_what_is_free_less_a_quarter_of_it_or_a_gib(path, device, free):
    """The rule is exact to the byte: a quarter of the free memory is kept free, but at
    most 1 GiB."""
    where, bundle = _device.resolve(device), Bundle.open(path)
    needed = max(size_of(path, device).values())
    least = -(-needed * 4 // 3)  # of which three quarters suffice
    while least - least // 4 < needed:
        least += 1
    free(least)
    assert v3dg.pool.chosen_bytes([bundle], where) is None
    free(least - 2)
    assert v3dg.pool.chosen_bytes([bundle], where) == (least - 2) // 2

    class Large:
        """Claims a size of 10 GiB."""

        codec, is_in_memory, page_bytes, num_gaussians = "quantized", False, 10 * GIB, 0

    def bytes_to_add(bundles, device):
        return {device: bundles[0].page_bytes}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(residency, "bytes_to_add", bytes_to_add)
        free(11 * GIB)
        assert v3dg.pool.chosen_bytes([Large], where) is None
        free(11 * GIB - 1)
        assert v3dg.pool.chosen_bytes([Large], where) == (11 * GIB - 1) // 2


@pytest.mark.gpu
def test_the_host_has_to_hold_what_a_gpu_draws_whole(path, free):
    bundle = Bundle.open(path)
    # a quarter of this is kept free, so there is too little
    free(bundle.page_bytes, CPU)
    assert Renderer(bundle, device="cuda").memory is not None


def test_what_is_there_needs_no_room(path, device, free):
    bundle = Bundle.open(path)
    render(bundle, CAMERA, device=device)
    free(0)
    assert Renderer(bundle, device=device).memory is None
    assert Renderer(Bundle.open(path), device=device, memory=None).memory is None


def test_a_scene_that_outgrows_what_is_free_goes_on_in_a_pool(path, device, free):
    scene = Scene()
    scene.add(Bundle.open(path))
    renderer = Renderer(scene, device=device)
    needed = max(size_of(path, device).values())
    free(needed)
    assert renderer.render(CAMERA, tolerance=2.0).stats.memory is None
    scene.add(Bundle.open(path), positions=(3.0, 0, 0))
    renderer.settle(CAMERA, tolerance=2.0)
    image = renderer.render(CAMERA, tolerance=2.0)
    assert image.stats.memory == renderer.memory == needed // 2
    assert_same(
        image, render(scene, CAMERA, device=device, memory=None, tolerance=image.stats.tolerance)
    )


def test_what_needs_all_is_drawn_of_all(path, device, free):
    free(1)
    bundle = Bundle.open(path)
    if device == "cuda":
        assert render(bundle, CAMERA, device=device, color_by="level").stats.memory is None
    asset = bundle.gaussians
    assert render(asset, CAMERA, device=device).stats.memory is None
    free(max(size_of(path, device).values()))
    other = Bundle.open(path)
    cut = v3dg.select(other, CAMERA, device=device)
    with pytest.raises(
        ValueError, match=r"cut: a renderer with a pool selects its own cut; .*memory=None"
    ):
        render(other, CAMERA, device=device, cut=cut)
    assert render(other, CAMERA, device=device, cut=cut, memory=None).stats.memory is None


def test_what_is_free_on_the_host_follows_the_container(monkeypatch):
    from v3dg.levels import memory

    monkeypatch.setattr(memory._system, "available_memory", lambda: 4096 << 10)
    texts = {
        "/sys/fs/cgroup/memory.max": "3000000\n",
        "/sys/fs/cgroup/memory.current": "1000000\n",
    }
    monkeypatch.setattr(memory.Path, "read_text", lambda self, **_: texts[str(self)])
    assert v3dg.pool.free_on(CPU) == 2_000_000
    texts["/sys/fs/cgroup/memory.max"] = "max\n"
    assert v3dg.pool.free_on(CPU) == 4096 << 10


# Colours.


@pytest.fixture
def scene(path):
    """Two instances of one bundle, and one of another."""
    scene = Scene()
    scene.add(Bundle.open(path), positions=[(0.0, 0, 0), (2.5, 0, 0)])
    scene.add(Bundle.open(path), positions=(-2.5, 1, 0))
    return scene


@pytest.mark.parametrize("by", ["level", "cluster", "residency"])
@pytest.mark.parametrize(
    "options", [{"tolerance": 2.0}, {"budget": 4000}, {"tolerance": 0.5, "min_level": 2}]
)
def test_false_colors_of_a_settled_pool_are_those_of_all(scene, by, options):
    whole = render(scene, CAMERA, device="cpu", memory=None, color_by=by, **options)
    pooled = render(scene, CAMERA, device="cpu", memory="64MB", color_by=by, **options)
    assert pooled.stats.memory is not None
    assert_same(pooled, whole)


@pytest.mark.parametrize("fade", [None, 1.3])
def test_residency_tells_what_waits_for_pages_from_what_is_wanted(scene, monkeypatch, fade):
    there, alpha_there = _core.missing_colors(np.zeros(())), 0.1
    options = {"tolerance": 0.5, "fade": fade}

    def share_missing(image):
        covered = image.alpha > alpha_there
        return (
            np.abs(image.color[covered] / image.alpha[covered][:, None] - there).max(axis=1) > 0.1
        )

    # Nothing is read until it is requested.
    monkeypatch.setattr(v3dg.pool, "NUM_THREADS", 0)
    renderer = Renderer(scene, device="cpu", memory="64MB", color_by="residency")
    first = renderer.render(CAMERA, **options)
    assert share_missing(first).mean() > 0.99  # the coarsest pages everywhere
    far = Camera.look_at((0, -60, 1), (0, 0, 0), (0, 0, 1), 0.13, width=93, height=61)
    coarse = renderer.render(far, tolerance=1e9)
    assert share_missing(coarse).mean() == 0  # the coarsest pages suffice here
    shares = [share_missing(first).mean()]
    pool = renderer.pool_frame.core
    while renderer.render(CAMERA, **options).stats.missing:
        for _ in range(20):
            pool.read_one()
        shares.append(share_missing(renderer.render(CAMERA, **options)).mean())
    for _ in range(40 if fade else 0):  # until the last page has faded in
        shares.append(share_missing(renderer.render(CAMERA, **options)).mean())
    assert any(0.05 < share < 0.95 for share in shares)
    assert shares[-1] == 0


def test_what_misses_more_is_redder():
    shades = _core.missing_colors(np.array([0.5, 1.0, 1.1, 4.0, 64.0, 1e6, np.inf]))
    np.testing.assert_array_equal(shades[0], shades[1])
    assert (shades[2:, 0] > 2 * shades[1, 0]).all()
    assert (np.diff(shades[2:5, 1]) < -0.05).all()
    np.testing.assert_array_equal(shades[5], shades[6])
